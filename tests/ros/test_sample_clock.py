"""Sample counts: bad stamps lose no samples, and losses are found."""

import io
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from worldstate.adapters.audio.sound_file import RawPcm, open_sound
from worldstate.adapters.ros.bag_input import is_bag, read_bag, read_sound
from worldstate.adapters.ros.bag_writer import bag_writer
from worldstate.adapters.ros.message_types import header
from worldstate.adapters.ros.sample_clock import begins_again, contradiction, lost_before
from worldstate.cli.main import main
from worldstate.ground.errors import InputFileError
from worldstate.ground.typing import FloatArray, IntArray

MS, SECOND = 10**6, 10**9
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
def test_late_stamps_are_no_losses(kind: str, seed: int, length_ns: int, drift: float) -> None:
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
def test_permanent_delays_are_losses(places: list[int], length_ns: int, jitter: bool) -> None:
    """The oracle is the removed messages; without jitter each loss precedes the next message."""
    after = 400 + 500 * MS // length_ns
    kept = np.setdiff1d(np.arange(after), places)
    stamps = T0 + kept * length_ns
    if jitter:
        stamps += np.random.default_rng(len(places)).integers(0, length_ns // 3, len(kept))
    missing, _ = lost_before(stamps, np.full(len(kept), float(length_ns)))
    assert abs(missing.sum() / length_ns - len(places)) <= (0.4 if jitter else 1e-6)
    if not jitter:
        steps = np.diff(kept, prepend=-1) - 1
        np.testing.assert_allclose(missing / length_ns, steps, atol=1e-6)


@pytest.mark.parametrize("first_late_s", [0.0, 0.3, 2.5])
def test_the_first_sample_is_not_later_than_later_messages_allow(first_late_s: float) -> None:
    stamps, spans = even(400)
    stamps[0] += round(first_late_s * SECOND)
    stamps[1:20] = np.maximum(stamps[1:20], stamps[0] + np.arange(1, 20))
    missing, early_ns = lost_before(stamps, spans)
    assert early_ns == pytest.approx(first_late_s * SECOND)
    assert not missing.any()


@given(passes=st.integers(2, 4), count=st.integers(260, 500))
@settings(max_examples=20, deadline=None)
def test_a_repeated_bag_continues_the_count(passes: int, count: int) -> None:
    stamps, spans = np.tile(even(count)[0], passes), even(count * passes)[1]
    found = begins_again(stamps, spans)
    assert found == [(k * count, k * count * 10 * MS) for k in range(1, passes)]


INFO = {"channels": 4, "sample_rate": 8000, "sample_format": "S16LE", "coding_format": "wave"}
SOUND = np.random.default_rng(1).integers(-9000, 9000, (6 * 8000, 4), dtype=np.int16)
FORMAT = RawPcm(io.BytesIO(), 8000, 4, "s16")


def write_bag(
    path: Path,
    stamps: IntArray,
    *,
    step: int = 640,
    recorded: IntArray | None = None,
    info: object = True,
    **storage: str,
) -> Path:
    """Write 6 s in messages of so many bytes, stamped at their beginning; -1 is no stamp."""
    data, kind = SOUND.tobytes(), "AudioDataStamped"
    recorded = stamps if recorded is None else recorded
    with bag_writer(path, **storage) as write:
        if info is not False:
            about = INFO | (info if isinstance(info, dict) else {})
            write("/info", "audio_common_msgs/msg/AudioInfo", int(recorded.min()) - 1, about)
        for k, (stamp_ns, recorded_ns) in enumerate(zip(stamps, recorded, strict=True)):
            piece = np.frombuffer(data[k * step : (k + 1) * step], np.uint8)
            values = {"header": header(max(int(stamp_ns), 0)), "audio": {"data": piece}}
            write("/audio", f"audio_common_msgs/msg/{kind}", int(recorded_ns), values)
    return path


def heard(path: Path, stated: RawPcm | None = None) -> np.ndarray:
    with open_sound(read_sound(path, None, stated)[0], 4) as audio:
        found = np.concatenate(list(audio.blocks()))
        assert audio.frames == len(found)
    return found * 2**15


@pytest.mark.parametrize("kind", [*KINDS, "zero", "a loop"])
def test_every_sample_of_a_bag_is_read(kind: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    stamps = late(kind, 600, 10 * MS, np.random.default_rng(3))
    recorded = even(600)[0] + 3 * MS
    if kind == "zero":
        stamps[:] = -1
    elif kind == "a loop":
        stamps = np.tile(stamps[:300], 2)
    path = write_bag(tmp_path / "bag", stamps, recorded=recorded)
    np.testing.assert_array_equal(heard(path), SOUND)
    assert "missing" not in caplog.text
    assert ("begin again at 3.000 s" in caplog.text) is (kind == "a loop")


@pytest.mark.parametrize("step", [101, 1001, 1277, 4099])
def test_samples_may_be_split_between_messages(
    step: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    stamps = T0 + np.arange(-(-SOUND.nbytes // step)) * step * SECOND // (8 * 8000)
    np.testing.assert_array_equal(heard(write_bag(tmp_path / "whole", stamps, step=step)), SOUND)
    assert not caplog.text


@pytest.mark.parametrize("step", [1001, 1277])
def test_a_lost_message_does_not_shift_channels(step: int, tmp_path: Path) -> None:
    """Messages may split samples; later samples keep their channels."""
    count = -(-SOUND.nbytes // step)
    stamps, lost = T0 + np.arange(count) * step * SECOND // (8 * 8000), range(40, 43)
    data, path = SOUND.tobytes(), tmp_path / "bag"
    with bag_writer(path) as write:
        write("/info", "audio_common_msgs/msg/AudioInfo", T0 - 1, INFO)
        for k in set(range(count)) - set(lost):
            piece = np.frombuffer(data[k * step : (k + 1) * step], np.uint8)
            values = {"header": header(int(stamps[k])), "audio": {"data": piece}}
            write("/audio", "audio_common_msgs/msg/AudioDataStamped", int(stamps[k]), values)
    found = heard(path)
    assert len(found) == len(SOUND)
    same = (found == SOUND).all(axis=1)
    assert same[: 40 * step // 8 - 1].all() and same[43 * step // 8 + 1 :].all()


def test_a_repeated_bag_shifts_boxes_and_odometry(tmp_path: Path) -> None:
    stamps = np.tile(even(300)[0], 2)
    recorded = even(600)[0] + 3 * MS
    data, step, path = SOUND.tobytes(), 640, tmp_path / "bag"
    with bag_writer(path) as write:
        write("/info", "audio_common_msgs/msg/AudioInfo", T0 - 1, INFO)
        for k in range(600):
            piece = np.frombuffer(data[k * step : (k + 1) * step], np.uint8)
            values = {"header": header(int(stamps[k])), "audio": {"data": piece}}
            write("/audio", "audio_common_msgs/msg/AudioDataStamped", int(recorded[k]), values)
            if k % 10 == 5:
                twist = {"twist": {"linear": {"x": 0.1 * k}}}
                at = header(int(stamps[k]))
                write("/boxes", "vision_msgs/msg/Detection2DArray", int(recorded[k]) + 1, {"header": at})
                write("/odom", "nav_msgs/msg/Odometry", int(recorded[k]) + 1, {"header": at, "twist": twist})
    held = read_bag(path)
    assert held.detections is not None and held.ego is not None
    wanted = [T0 + k * 10 * MS for k in range(5, 600, 10)]
    assert held.detections.stamps_ns.tolist() == wanted
    assert [one.stamp_ns for one in held.ego.told] == wanted
    np.testing.assert_allclose([one.speed_mps for one in held.ego.told], 0.1 * np.arange(5, 600, 10))


def test_disordered_boxes_and_odometry_cost_only_themselves(tmp_path: Path) -> None:
    stamps, _ = even(600)
    order = [0, 2, 1, 3, 3, 4]
    data, path = SOUND.tobytes(), tmp_path / "bag"
    with bag_writer(path) as write:
        write("/info", "audio_common_msgs/msg/AudioInfo", T0 - 1, INFO)
        values = {"header": header(T0), "audio": {"data": np.frombuffer(data, np.uint8)}}
        write("/audio", "audio_common_msgs/msg/AudioDataStamped", T0, values)
        for k, place in enumerate(order):
            at = header(int(stamps[place * 10]))
            write("/boxes", "vision_msgs/msg/Detection2DArray", T0 + k, {"header": at})
            write("/odom", "nav_msgs/msg/Odometry", T0 + k, {"header": at})
    held = read_bag(path)
    assert held.detections is not None and held.ego is not None
    assert (
        held.detections.stamps_ns.tolist()
        == [one.stamp_ns for one in held.ego.told]
        == stamps[:50:10].tolist()
    )


@pytest.mark.parametrize(
    ("case", "info", "stretch", "said"),
    [
        ("a third of the rate", {"sample_rate": 2667}, 1, "stamps advance by 6.0 s while 18.0 s of samples"),
        (
            "three times the rate",
            {"sample_rate": 24_000},
            1,
            "stamps advance by 6.0 s while 2.0 s of samples",
        ),
        ("passes that were mixed", {}, 2, "stamps advance by 3.0 s while 6.0 s of samples were sent"),
    ],
)
def test_stamps_that_contradict_the_rate_raise_an_error(
    case: str, info: dict[str, int], stretch: int, said: str, tmp_path: Path
) -> None:
    path = write_bag(tmp_path / "bag", T0 + np.arange(600) // stretch * 10 * MS, info=info)
    with pytest.raises(InputFileError, match=re.escape(said) + ".*--topic"):
        read_sound(path)


def test_the_audio_format_can_be_given(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bare = write_bag(tmp_path / "bare", even(600)[0], info=False)
    wrong = write_bag(tmp_path / "wrong", even(600)[0], info={"sample_rate": 24_000})
    array = tmp_path / "ring.csv"
    array.write_text("0.05,0,0\n0,0.05,0\n-0.05,0,0\n0,-0.05,0\n")
    with pytest.raises(InputFileError, match=r"AudioInfo.* or --topic audio=.*:RATE:CHANNELS:FORMAT"):
        read_sound(bare)
    for path in (bare, wrong):
        np.testing.assert_array_equal(heard(path, FORMAT), SOUND)
        words = ["array", "bearings", str(path), "--array", str(array), "--out", str(tmp_path / "b.csv")]
        assert main([*words, "--topic", "audio=:8000:4:s16"]) == 0
        assert len((tmp_path / "b.csv").read_text().splitlines()) == 52
        capsys.readouterr()
        assert main([*words, "--topic", "audio=:8000:4"]) in (0, 2)
        assert main([*words, "--topic", "audio=:8k:4:s16"]) == 2
        assert "topics: expected RATE:CHANNELS:FORMAT" in capsys.readouterr().err
    assert main(["array", "check", "a.wav", "--array", str(array), "--topic", "audio=:8000:4:s16"]) == 2
    assert "topics: expected a bag" in capsys.readouterr().err


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_folder_without_metadata_is_read_from_its_files(
    storage: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = write_bag(tmp_path / "bag", even(600)[0], storage=storage)
    (path / "metadata.yaml").unlink()
    assert is_bag(path)
    np.testing.assert_array_equal(heard(path), SOUND)
    assert "metadata.yaml is missing, `ros2 bag reindex` writes it" in caplog.text
    (path / "out_multi.wav").touch()
    assert not is_bag(path), "a recording with a log beside it"


@pytest.mark.parametrize(("storage", "way"), [("mcap", "`mcap recover"), ("sqlite3", "`sqlite3 IN .recover")])
def test_a_truncated_bag_raises_an_error_with_the_recovery_command(
    storage: str, way: str, tmp_path: Path
) -> None:
    path = write_bag(tmp_path / "bag", even(600)[0], storage=storage)
    (file,) = (one for one in path.iterdir() if one.suffix != ".yaml")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    for name in (file, path):
        with pytest.raises(InputFileError, match=re.escape(way)):
            heard(name)


def test_24_bit_samples_in_four_bytes_are_detected(tmp_path: Path) -> None:
    wide = np.random.default_rng(2).normal(0.0, 1e5, (16_000, 4)).astype("<i4")
    for said, right in (("S24LE", False), ("S24_32LE", True)):
        path = tmp_path / said
        with bag_writer(path) as write:
            write("/info", "audio_common_msgs/msg/AudioInfo", T0 - 1, INFO | {"sample_format": said})
            for k in range(20):
                piece = np.frombuffer(wide[800 * k : 800 * (k + 1)].tobytes(), np.uint8)
                values = {"header": header(T0 + k * 100 * MS), "audio": {"data": piece}}
                write("/audio", "audio_common_msgs/msg/AudioDataStamped", T0 + k * 100 * MS, values)
        if right:
            np.testing.assert_allclose(heard(path) * 256, wide, atol=1e-2)
        else:
            with pytest.raises(InputFileError, match=r"expected samples of s24, got .* like those of s24_32"):
                read_sound(path)
