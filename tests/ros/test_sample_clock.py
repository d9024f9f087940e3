"""Sample counts: bad stamps lose no samples, and losses are found."""

import io
import re
from collections.abc import Iterator

import numpy as np
import pytest
from bag_messages import Message, bag_of, block, box, heard, image, info, moved, pcm, read_bag, sound_of
from hypothesis import given, settings
from hypothesis import strategies as st

from worldstate.adapters.audio.sound_file import RawPcm
from worldstate.adapters.ros.bag_input import is_bag, read_sound
from worldstate.adapters.ros.sample_clock import begins_again, contradiction, lost_before
from worldstate.cli.main import main
from worldstate.ground import FloatArray, InputFileError, IntArray

MS, TENTH_NS, SECOND = 10**6, 10**8, 10**9
T0 = 1_700_000_000 * SECOND


def even(count: int, length_ns: int = 10 * MS) -> tuple[IntArray, FloatArray]:
    return T0 + np.arange(count) * length_ns, np.full(count, float(length_ns))


def late(kind: str, count: int, length_ns: int, rng: np.random.Generator) -> IntArray:
    """Return stamps of messages without losses as recorders and drivers write them."""
    stamps, k = even(count, length_ns)[0], np.arange(count)
    if kind == "jitter":
        return stamps + rng.integers(0, 5 * length_ns, count)
    if kind == "noise":
        return stamps + np.round(rng.normal(0.0, 2.0 * length_ns, count)).astype(np.int64)
    if kind == "bursts":
        many = int(rng.integers(2, 40))
        return stamps[0] + np.minimum(k // many * many + many, count) * length_ns + k % many * 200_000
    if kind == "stalls":
        begin, until = np.sort(rng.integers(0, count - 60, 2))
        return np.maximum(stamps, stamps[until] + k) if rng.random() < 0.5 else stamps + (k < begin) * SECOND
    places = rng.choice(np.arange(1, count - 1), count // 8, replace=False)
    changed = stamps.copy()
    if kind == "repeated":
        changed[places] = stamps[places - 1]
    elif kind == "exchanged":
        changed[places], changed[places - 1] = stamps[places - 1], stamps[places]
    elif kind == "far off":
        changed[places[:3]] += rng.choice([-3600, -1, 1, 3600], 3) * SECOND
    elif kind == "all the same":
        changed[:] = T0
    elif kind == "early":
        changed[places] -= int(0.9 * length_ns)
    return changed


KINDS = "jitter", "noise", "bursts", "stalls", "repeated", "exchanged", "far off", "all the same", "early"
lengths = st.sampled_from([2 * MS, 10 * MS, 21_333_333, 100 * MS])


@pytest.mark.parametrize("kind", KINDS)
@given(seed=st.integers(0, 10_000), length_ns=lengths, drift=st.floats(-2e-4, 2e-4))
@settings(max_examples=30, deadline=None)
def test_late_stamps_are_no_losses(kind, seed, length_ns, drift):
    stamps = late(kind, 400, length_ns, np.random.default_rng(seed))
    stamps += np.round(np.arange(400) * length_ns * drift).astype(np.int64)
    spans = np.full(400, float(length_ns))
    missing, _ = lost_before(stamps, spans)
    assert not missing.any()
    assert begins_again(stamps, spans) == []
    assert contradiction(stamps, spans, missing) == ""


@given(
    places=st.lists(st.integers(5, 330), min_size=1, max_size=60, unique=True),
    length_ns=lengths,
    jitter=st.booleans(),
)
@settings(max_examples=60, deadline=None)
def test_permanent_delays_are_losses(places, length_ns, jitter):
    """The oracle is the removed messages; without jitter each loss precedes the next message."""
    after = 400 + 500 * MS // length_ns
    kept = np.setdiff1d(np.arange(after), places)
    stamps = T0 + kept * length_ns
    if jitter:
        stamps += np.random.default_rng(len(places)).integers(0, length_ns // 3, len(kept))
    missing, _ = lost_before(stamps, np.full(len(kept), float(length_ns)))
    assert abs(missing.sum() / length_ns - len(places)) <= (0.4 if jitter else 1e-6)
    if not jitter:
        np.testing.assert_allclose(missing / length_ns, np.diff(kept, prepend=-1) - 1, atol=1e-6)


@pytest.mark.parametrize("first_late_s", [0.0, 0.3, 2.5])
def test_the_first_sample_is_not_later_than_later_messages_allow(first_late_s):
    stamps, spans = even(400)
    stamps[0] += round(first_late_s * SECOND)
    stamps[1:20] = np.maximum(stamps[1:20], stamps[0] + np.arange(1, 20))
    missing, early_ns = lost_before(stamps, spans)
    assert early_ns == pytest.approx(first_late_s * SECOND)
    assert not missing.any()


@given(passes=st.integers(2, 4), count=st.integers(260, 500))
@settings(max_examples=20, deadline=None)
def test_a_repeated_bag_continues_the_count(passes, count):
    stamps, spans = np.tile(even(count)[0], passes), even(count * passes)[1]
    assert begins_again(stamps, spans) == [(k * count, k * count * 10 * MS) for k in range(1, passes)]


SOUND = np.random.default_rng(1).integers(-9000, 9000, (6 * 8000, 4), dtype=np.int16)
FORMAT = RawPcm(io.BytesIO(), 8000, 4, "s16")


def spoken(
    stamps: IntArray,
    recorded: IntArray | None = None,
    step: int = 640,
    data: bytes = SOUND.tobytes(),
    **about: object,
) -> Iterator[Message]:
    """Yield sound in messages of so many bytes, stamped at their beginning; -1 is no stamp."""
    recorded = stamps if recorded is None else recorded
    yield info(int(recorded.min()) - 1, **about)
    for k, (stamp_ns, recorded_ns) in enumerate(zip(stamps.tolist(), recorded.tolist(), strict=True)):
        yield pcm(data[k * step : (k + 1) * step], stamp_ns, recorded_ns)


def begins(step: int) -> IntArray:
    return T0 + np.arange(-(-SOUND.nbytes // step)) * step * SECOND // (8 * 8000)


@pytest.mark.parametrize("kind", [*KINDS, "zero", "a loop"])
def test_every_sample_of_a_bag_is_read(kind, tmp_path, caplog):
    stamps = late(kind, 600, 10 * MS, np.random.default_rng(3))
    if kind == "zero":
        stamps[:] = -1
    elif kind == "a loop":
        stamps = np.tile(stamps[:300], 2)
    path = bag_of(tmp_path / "bag", spoken(stamps, even(600)[0] + 3 * MS))
    np.testing.assert_array_equal(heard(path) * 2**15, SOUND)
    assert "missing" not in caplog.text
    assert ("begin again at 3.000 s" in caplog.text) is (kind == "a loop")


@pytest.mark.parametrize("step", [101, 1001, 1277, 4099])
def test_samples_may_be_split_between_messages(step, tmp_path, caplog):
    path = bag_of(tmp_path / "whole", spoken(begins(step), step=step))
    np.testing.assert_array_equal(heard(path) * 2**15, SOUND)
    assert not caplog.text


@pytest.mark.parametrize("step", [1001, 1277])
def test_a_lost_message_does_not_shift_channels(step, tmp_path):
    """Messages may split samples; later samples keep their channels."""
    messages = [*spoken(begins(step), step=step)]
    del messages[41:44]
    found = heard(bag_of(tmp_path / "bag", messages)) * 2**15
    assert len(found) == len(SOUND)
    same = (found == SOUND).all(axis=1)
    assert same[: 40 * step // 8 - 1].all() and same[43 * step // 8 + 1 :].all()


def test_a_repeated_bag_shifts_boxes_and_odometry(tmp_path):
    stamps, recorded, seen = np.tile(even(300)[0], 2), even(600)[0] + 3 * MS, range(5, 600, 10)
    images = [image(int(stamps[k]), int(recorded[k]) + 1) for k in seen]
    driven = [moved(int(stamps[k]), int(recorded[k]) + 1, 0.1 * k) for k in seen]
    held = read_bag(bag_of(tmp_path / "bag", [*spoken(stamps, recorded), *images, *driven]))
    assert held.detections is not None and held.ego is not None
    wanted = [T0 + k * 10 * MS for k in seen]
    assert held.detections.stamps_ns.tolist() == wanted
    assert [one.stamp_ns for one in held.ego.told] == wanted
    np.testing.assert_allclose([one.speed_mps for one in held.ego.told], 0.1 * np.arange(5, 600, 10))


# Tenths of a second of the stamps of detections and odometry, or None; all are recorded.
STAMPED = {
    "as they were": lambda k: k,
    "not at all": lambda k: None,
    "some not": lambda k: None if k % 3 == 1 else k,
    "out of order": lambda k: k ^ 1,
    "all alike": lambda k: 0,
    "ten alike": lambda k: k // 10 * 10,
    "delivered twice": lambda k: k // 2 * 2,
}


@pytest.mark.parametrize("name", STAMPED)
def test_bad_stamps_lose_no_boxes_or_odometry(name, tmp_path, caplog):
    messages = list[Message]()
    for k in range(40):
        recorded_ns, tenth = 3 * SECOND + k * TENTH_NS, STAMPED[name](k)
        stamp_ns = 0 if tenth is None else 3 * SECOND + tenth * TENTH_NS
        found = [box(10.0 + k, 20, 30, 40, "car", 0.8)] * (k > 0)
        messages += [block(sound_of(800), recorded_ns), image(stamp_ns, recorded_ns, *found)]
        messages.append(moved(stamp_ns, recorded_ns, 0.1 * k))
    held = read_bag(bag_of(tmp_path / "bag", messages))
    assert held.detections is not None and held.ego is not None and held.ego.moves and held.array is None
    kept = range(1, 40, 2) if name == "delivered twice" else range(40)
    order = [k ^ 1 for k in kept] if name == "out of order" else [*kept]
    boxes = [frame.boxes_px.tolist() for frame in held.detections.frames]
    # An image without boxes was searched.
    assert boxes == [[[10.0 + k, 20.0, 40.0 + k, 60.0]] * (k > 0) for k in order]
    assert {(*frame.labels, *frame.scores) for frame in held.detections.frames} <= {(), ("car", 0.8)}
    assert [round(10 * one.speed_mps) for one in held.ego.told] == order
    times = [(ns - 3 * SECOND) // TENTH_NS for ns in held.detections.stamps_ns.tolist()]
    assert times == [one.stamp_ns // TENTH_NS - 30 for one in held.ego.told]
    assert times == [k - (name == "delivered twice") for k in kept]
    assert ("do not advance" in caplog.text) is (name in ("all alike", "ten alike"))


@pytest.mark.parametrize(
    ("info", "stretch", "said"),
    [
        ({"sample_rate": 2667}, 1, "stamps advance by 6.0 s while 18.0 s of samples"),
        ({"sample_rate": 24_000}, 1, "stamps advance by 6.0 s while 2.0 s of samples"),
        ({}, 2, "stamps advance by 3.0 s while 6.0 s of samples were sent"),  # mixed passes
    ],
)
def test_stamps_that_contradict_the_rate_raise_an_error(info, stretch, said, tmp_path):
    path = bag_of(tmp_path / "bag", spoken(T0 + np.arange(600) // stretch * 10 * MS, **info))
    with pytest.raises(InputFileError, match=re.escape(said) + ".*--topic"):
        read_sound(path)


def test_the_audio_format_can_be_given(tmp_path, capsys, refused):
    bare = bag_of(tmp_path / "bare", [*spoken(even(600)[0])][1:])
    wrong = bag_of(tmp_path / "wrong", spoken(even(600)[0], sample_rate=24_000))
    array = tmp_path / "ring.csv"
    array.write_text("0.05,0,0\n0,0.05,0\n-0.05,0,0\n0,-0.05,0\n")
    with pytest.raises(InputFileError, match=r"AudioInfo.* or --topic audio=.*:RATE:CHANNELS:FORMAT"):
        read_sound(bare)
    for path in (bare, wrong):
        np.testing.assert_array_equal(heard(path, stated=FORMAT) * 2**15, SOUND)
        words = ["array", "bearings", str(path), "--array", str(array), "--out", str(tmp_path / "b.csv")]
        assert main([*words, "--topic", "audio=:8000:4:s16"]) == 0
        assert len((tmp_path / "b.csv").read_text().splitlines()) == 52
        capsys.readouterr()
        assert main([*words, "--topic", "audio=:8000:4"]) in (0, 2)
        assert "topics: expected RATE:CHANNELS:FORMAT" in refused([*words, "--topic", "audio=:8k:4:s16"])
    assert main(["array", "check", "a.wav", "--array", str(array), "--topic", "audio=:8000:4:s16"]) == 2
    assert "topics: expected a bag" in capsys.readouterr().err


@pytest.mark.parametrize(("storage", "way"), [("mcap", "`mcap recover"), ("sqlite3", "`sqlite3 IN .recover")])
def test_incomplete_bags_are_read_or_name_the_command_that_mends_them(storage, way, tmp_path, caplog):
    path = bag_of(tmp_path / "bag", spoken(even(600)[0]), storage)
    (path / "metadata.yaml").unlink()
    assert is_bag(path)
    np.testing.assert_array_equal(heard(path) * 2**15, SOUND)
    assert "metadata.yaml is missing, `ros2 bag reindex` writes it" in caplog.text
    (file,) = path.iterdir()
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    for name in (file, path):
        with pytest.raises(InputFileError, match=re.escape(way)):
            heard(name)
    (path / "out_multi.wav").touch()
    assert not is_bag(path), "a recording with a log beside it"


def test_24_bit_samples_in_four_bytes_are_detected(tmp_path):
    wide = np.random.default_rng(2).normal(0.0, 1e5, (16_000, 4)).astype("<i4")
    stamps, each = T0 + np.arange(20) * TENTH_NS, {"step": 12_800, "data": wide.tobytes()}
    right = bag_of(tmp_path / "right", spoken(stamps, **each, sample_format="S24_32LE"))
    np.testing.assert_allclose(heard(right) * 2**23, wide, atol=1e-2)
    wrong = bag_of(tmp_path / "wrong", spoken(stamps, **each, sample_format="S24LE"))
    with pytest.raises(InputFileError, match=r"expected samples of s24, got .* like those of s24_32"):
        read_sound(wrong)
