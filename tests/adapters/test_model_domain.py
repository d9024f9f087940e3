"""The domain of a model: another array or rate raises an error, another channel order is accepted."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
from hypothesis import given, settings
from hypothesis import strategies as st
from made_up_sound import model_of, plane_wave
from scipy.spatial.transform import Rotation
from worldstate_lab.cli.main import main as study

from worldstate import Context, MicrophoneArray, Odometry
from worldstate.adapters import AcousticAdapter, read_array, read_model, save_model, write_array_xml
from worldstate.adapters.datasets.feature_table import FeatureTable, read_features, write_features
from worldstate.adapters.datasets.ovad import choose_array
from worldstate.adapters.files import array_file as arrays
from worldstate.adapters.files.acoustic_domain import domain_of
from worldstate.adapters.files.odometry_file import OdometryLog
from worldstate.adapters.listener import Listener, listen, measure_steps
from worldstate.adapters.source import ListenSettings, open_source
from worldstate.cli.main import main
from worldstate.commissioning.heard_stream import CommissionSettings, learned_streams
from worldstate.frontend import FrontEndSettings, ovad_array, roof_array_56
from worldstate.ground.errors import InputFileError, OutOfDomainError
from worldstate.ground.serialisation import encode
from worldstate.measurement.measurement import Bearing
from worldstate.state.world_state import why_not

RATE = 47_998
HERE = np.array(ovad_array().positions_m)
RNG = np.random.default_rng(10)
SHUFFLED, EIGHT = HERE[RNG.permutation(56)], MicrophoneArray(HERE[:8], "eight")


WRONG = {
    "x and y swapped": (HERE[:, [1, 0, 2]], "axes swapped"),
    "y and z swapped": (HERE[:, [0, 2, 1]], "axes swapped"),
    "in the file's axes": (np.stack([-HERE[:, 1], HERE[:, 2], HERE[:, 0]], 1), "axes swapped"),
    "millimetres": (1e3 * HERE, "looks like millimetres"),
    "mirrored": (HERE * [1, -1, 1], "looks mirrored"),
    "half a turn": (HERE * [1, -1, -1], "looks turned by half a turn"),
    "one missing": (HERE[1:], "55 microphones, expected 56"),
    "another array": (roof_array_56().positions_m, "elsewhere"),
    "noise of 5 mm": (HERE + 0.005 * RNG.standard_normal(HERE.shape), "elsewhere"),
    "scaled": (0.5 * HERE, "looks scaled by 0.5"),
    "rolled": (Rotation.from_euler("x", 7.0, degrees=True).apply(HERE), "looks rotated by 7 deg"),
    "yawed": (Rotation.from_euler("z", 20.0, degrees=True).apply(HERE), "looks rotated by 20 deg"),
    "shuffled and wrong": (SHUFFLED * [1, 1, 0.9], "elsewhere"),
    "one moved": (HERE + np.eye(56)[7][:, None] * [0, 0.003, 0], "microphones up to 3 mm elsewhere"),
    "a quarter turn": (HERE[:, [1, 0, 2]] * [-1, 1, 1], "axes swapped"),
    "one twice": (np.vstack([HERE[:55], HERE[:1]]), "microphones 1 and 56 0 m apart"),
}
FORMS = "xml", "csv", "json"
RIGHT = {
    "the same": HERE,
    "rounded to a millimetre": HERE.round(3),
    "elsewhere on the vehicle": HERE + np.array([1.2, 0.0, 1.7]),
    "reversed": HERE[::-1],
    "shuffled": SHUFFLED,
}


def test_a_board_with_a_shipped_model_is_used_by_name(tmp_path, monkeypatch, capsys, caplog) -> None:
    """Without a model only bearings are published, with a hint on `model make`."""
    monkeypatch.setattr(arrays, "MODELS", tmp_path)
    sound = 0.01 * np.random.default_rng(0).standard_normal((40_000, 7))
    soundfile.write(tmp_path / "own.wav", sound, 16_000)
    run = ["run", str(tmp_path / "own.wav"), "--array", "xmos", "--json"]
    assert Listener("xmos", 16_000).push(sound)[-1].no_model is not None
    assert "worldstate model make" in caplog.text
    assert main(run) == 0 and "(no model 16)" in capsys.readouterr().out
    made = model_of(read_array("xmos"))
    save_model(tmp_path / "xmos.json.gz", made)
    states = Listener("xmos", 16_000).push(sound)
    assert [state.stamp_ns for state in states] == [10**9 + 10**8 * hop for hop in range(15)]
    assert main(run) == 0 and states[-1].no_model is None
    assert Listener("uma-8", 16_000).world.no_model is not None
    with pytest.raises(OutOfDomainError, match="not the array of the model"):
        Listener("uma-8", 16_000, model=made)


@pytest.mark.parametrize("name", list(arrays.named_arrays()))
def test_a_model_ships_for_every_board_and_is_used_at_once(name: str) -> None:
    """Its card has an exam and real recordings, and lists no labelled windows."""
    board = read_array(name)
    model = read_model(array=board)
    assert model.domain is not None and (model.domain.array, model.domain.ego_motion) == (name, "standing")
    np.testing.assert_array_equal(model.domain.positions_m, board.positions_m)
    card = model.provenance
    assert card.fit_for_use and card.exam["approaches"] >= 20 and card.kinds and card.real
    assert not any("OVAD" in source.name for source in card.sources)
    rng = np.random.default_rng(0)
    common, own = rng.standard_normal((32_000, 1)), rng.standard_normal((32_000, board.n_microphones))
    *_, last = Listener(name, 16_000).push(0.01 * (common + 0.3 * own))
    assert last.no_sequence is None and "uncalibrated" not in why_not(last)


def test_the_shipped_roof_model_learned_no_windows_of_a_data_set() -> None:
    """It replaces the usual model if the licence of OVAD's windows is not acceptable."""
    free, usual = read_model("simulated-56"), read_model()
    assert free.domain is not None and usual.domain is not None
    assert free.domain.ego_motion == "standing"
    np.testing.assert_array_equal(free.domain.positions_m, usual.domain.positions_m)
    learned = [[one.name for one in model.provenance.sources] for model in (free, usual)]
    assert [any("OVAD" in name for name in names) for names in learned] == [False, True]
    assert {one.own for one in free.provenance.real} == {True, False} and free.provenance.kinds
    common = 0.01 * np.random.default_rng(0).standard_normal((96_000, 1))
    *_, last = Listener(ovad_array(), 48_000, model="simulated-56").push(np.repeat(common, 56, axis=1))
    assert "uncalibrated" not in why_not(last)


@pytest.fixture
def alone(approach, tmp_path: Path) -> Path:
    """Return the sound of the session's recording as a file outside of a data set."""
    path = tmp_path / "some.wav"
    path.symlink_to(approach.audio_path)
    return path


def array_file(path: Path, positions: np.ndarray) -> Path:
    """Write positions by suffix, because the writer of the library refuses wrong ones."""
    rows = positions.tolist()
    marks = "".join(f'<pos Name="m" x="{-y}" y="{z}" z="{x}"/>' for x, y, z in rows)
    lines = "".join(f"{x},{y},{z}\n" for x, y, z in rows)
    texts = {".json": json.dumps(rows), ".csv": f"x,y,z\n{lines}", ".xml": f"<MicArray>{marks}</MicArray>"}
    path.write_text(texts[path.suffix])
    return path


@pytest.mark.long
@pytest.mark.parametrize(("case", "form"), list(zip(WRONG, 7 * FORMS, strict=False)))
@pytest.mark.parametrize("beside", ["model", "data set"])
def test_a_wrong_array_is_refused(case, form, beside, alone, approach, tmp_path) -> None:
    positions, why = WRONG[case]
    said = "expected positions in metres" if case == "millimetres" else why
    path, model = (alone, "simulated-56") if beside == "model" else (approach.folder, None)
    mics = array_file(tmp_path / f"mics.{form}", positions)
    with pytest.raises((OutOfDomainError, InputFileError), match=re.escape(said)):
        open_source(path, array=mics, model=model)
    if case != "one twice":  # no such object can be made
        with pytest.raises(OutOfDomainError, match=why):
            AcousticAdapter(MicrophoneArray(positions), RATE, read_model().signature)


@pytest.mark.parametrize("case", RIGHT)
def test_equal_positions_are_accepted_in_any_order_and_offset(case: str, alone: Path) -> None:
    assert open_source(alone, array=MicrophoneArray(RIGHT[case])).policy.alpha == 0.02
    AcousticAdapter(MicrophoneArray(RIGHT[case]), RATE, read_model().signature)


def test_a_nearly_matching_array_has_no_model_and_a_reason(alone, tmp_path, refused, caplog) -> None:
    """Commands that need a model, or have one as an option, raise an error."""
    mics, out = tmp_path / "mics.xml", tmp_path / "m.json"
    write_array_xml(mics, MicrophoneArray(HERE * [1, -1, 1]))
    heard = [str(alone), "--array", str(mics)]
    assert main(["run", *heard]) == 0
    for said in ("mics.xml", "OVAD", "56 microphones", "mm elsewhere", "looks mirrored", "model make"):
        assert said in caplog.text
    line = refused(["run", *heard, "--model", "simulated-56"]).strip()
    assert "\n" not in line and "looks mirrored" in line and "--uncalibrated" in line
    assert "looks mirrored" in refused(["model", "threshold", *heard, "--out", str(out)])
    assert not out.exists()


def test_uncalibrated_and_unfit_models_state_no_budget(alone, tmp_path, caplog, capsys) -> None:
    model, path, free = read_model(), tmp_path / "quick.json", ListenSettings(uncalibrated=True)
    save_model(path, replace(model, provenance=replace(model.provenance, fit_for_use=False)))
    for more, alpha in (
        ({}, 0.02),
        ({"settings": free}, None),
        ({"array": roof_array_56(), "settings": free}, None),
        ({"model": path}, None),
    ):
        state = next(listen(alone, **more))
        assert state.calibrated is (alpha is not None) and [cue.alpha for cue in state.cues] == [alpha] * 2
    assert "unfit for use" in caplog.text
    assert main(["model", "show", str(path)]) == 0
    assert "unfit for use" in capsys.readouterr().out
    # It is not used for another array either.
    with pytest.raises(OutOfDomainError):
        open_source(alone, model=path, array=roof_array_56())


def test_a_moving_ego_uses_the_model_for_drives(alone: Path, tmp_path: Path) -> None:
    folder = tmp_path / "DA1" / "left" / "1_05_0000"
    folder.mkdir(parents=True)
    (folder / "out_multi.wav").symlink_to(alone)
    standing, moving = read_model(), read_model(moving_ego=True)
    drives, stands = Context(ego_speed_mps=8.0), Context(ego_speed_mps=0.0)
    for source, model in (
        (open_source(folder), moving),
        (open_source(alone, context=drives), moving),
        (open_source(alone, context=stands), standing),
        (open_source(alone), standing),
        (open_source(alone, moving_ego=True), moving),
    ):
        assert encode(source.model) == encode(model.signature) and source.policy.alpha == 0.02
    # A given model is kept, without a budget if the ego motion does not match.
    assert open_source(folder, model=standing).policy.alpha == 0.0
    assert open_source(alone, context=stands, model=moving).policy.alpha == 0.0


@settings(max_examples=12, deadline=None)
@given(st.lists(st.floats(-15.0, 15.0), min_size=6, max_size=6), st.booleans())
def test_hops_above_the_learned_speed_are_unheard(speeds_mps: list[float], moves: bool) -> None:
    """Expected by the latest speed at each hop: the model for drives covers up to 30 km/h."""
    sound = np.random.default_rng(1).uniform(-0.01, 0.01, (72_000, 56)).astype(np.float32)
    listener = Listener(ovad_array(), 48_000, moving_ego=moves)
    for hop, speed_mps in enumerate(speeds_mps):
        listener.add(Odometry("wheels", 950_000_000 + 100_000_000 * hop, speed_mps))
    states = listener.push(sound)
    outside = [abs(one) > (30.0 / 3.6 if moves else 0.2) for one in speeds_mps]
    heard = [one.heard for one in states]
    assert [bool(one and one[0].share == 0.0 and "ego" in (one[0].reason or "")) for one in heard] == outside
    assert not [one for one, out in zip(states, outside, strict=True) if out and one.no_sequence is None]


def test_a_drive_above_the_learned_speed_warns_once(alone: Path, caplog: pytest.LogCaptureFixture) -> None:
    fast = OdometryLog((Odometry("wheels", 0, 12.0), Odometry("wheels", 1_500_000_000, 3.0)))
    states = [*listen(alone, odometry=fast)]
    told = [one for one in caplog.messages if "faster than the model learned" in one]
    assert len(told) == 1 and "12.0 m/s" in told[0] and "8.3" in told[0]
    assert not [cue for one in states for cue in one.cues if one.stamp_ns < 1.5e9 and cue.advisory]
    slow = [one.heard for one in states if one.stamp_ns >= 1.5e9]
    assert slow and all(one and one[0].share > 0.0 for one in slow)


@pytest.mark.parametrize(("moves", "motion"), [(False, "standing"), (True, "moving")])
def test_a_model_of_simulated_streets_has_the_ego_motion_in_them(moves: bool, motion: str) -> None:
    """Junctions of the three renderers have names S.., T.. and M..; the ego motion is the same in all."""
    plan = learned_streams(CommissionSettings(junctions=2, moving_ego=moves))
    assert domain_of(ovad_array(), [6000.0], [one.site.name for one in plan]).ego_motion == motion
    both = domain_of(ovad_array(), [6000.0], ["DTA101", *(one.site.name for one in plan), "MB101"])
    assert both.ego_motion == "any"


def test_other_frames_or_another_feature_are_refused() -> None:
    model = read_model().signature
    with pytest.raises(OutOfDomainError, match=r"512 samples at 47040 to 48960 Hz, got 512 at 16000 Hz"):
        AcousticAdapter(ovad_array(), 16_000, model, front_end_settings=FrontEndSettings(nfft=512))
    for rate in (44_100, 48_000):
        AcousticAdapter(ovad_array(), rate, model)
    assert model.domain is not None
    other = replace(model, domain=replace(model.domain, feature="another 1"))
    with pytest.raises(OutOfDomainError, match="feature: the model was made with another 1"):
        AcousticAdapter(ovad_array(), RATE, other)


def test_permuted_channels_give_the_model_the_same_feature() -> None:
    sound = sum(RNG.standard_normal((RATE, n), dtype=np.float32) for n in (1, 56))
    order = RNG.permutation(56)
    model = read_model().signature
    (there,) = AcousticAdapter(ovad_array(), RATE, model).front_end.process(sound)
    shuffled = AcousticAdapter(MicrophoneArray(HERE[order]), RATE, model)
    (found,) = shuffled.front_end.process(sound[:, order])
    np.testing.assert_allclose(found.feature, there.feature, rtol=2e-4)
    free = AcousticAdapter(MicrophoneArray(HERE[order]), RATE, model, uncalibrated=True)
    (unordered,) = free.front_end.process(sound[:, order])
    assert abs(unordered.feature / there.feature - 1.0).max() > 0.005  # The feature depends on the order


def test_another_channel_order_is_logged_and_gives_the_same_bearings(tmp_path, approach, caplog) -> None:
    """A sound file uses the given order, a data set its own."""
    order = RNG.permutation(56)
    mics = array_file(tmp_path / "mics.csv", HERE[order])
    sound = plane_wave(ovad_array(), RATE, np.radians(20.0), 1.2)[:, order]
    soundfile.write(tmp_path / "some.wav", sound, RATE, subtype="PCM_24")
    (_, first), *_ = measure_steps(open_source(tmp_path / "some.wav", array=mics))
    assert isinstance(first.bearing, Bearing)
    assert abs(np.degrees(first.bearing.azimuth_rad) - 20.0) < 1.0
    assert "in another order" in caplog.text
    caplog.clear()
    np.testing.assert_allclose(open_source(approach.folder, array=mics).array.positions_m, HERE, atol=1e-9)
    assert "in another order" in caplog.text


@pytest.mark.long
def test_a_data_set_is_read_with_its_own_array(tmp_path: Path, approach) -> None:
    own = open_source(approach.folder).array.positions_m
    assert np.array_equal(own, open_source(approach.folder, array=approach.array_path).array.positions_m)
    assert np.array_equal(own, open_source(approach.audio_path).array.positions_m)
    mics = tmp_path / "mics.xml"
    write_array_xml(mics, roof_array_56())
    words = ["sim", "make", "--out", str(tmp_path / "sim"), "--static", "1", "--duration", "1.2"]
    assert main([*words, "--array", str(mics)]) == 0
    folder = tmp_path / "sim" / "SA1" / "left" / "1_00_0000"
    found = choose_array(tmp_path / "sim").positions_m
    assert np.array_equal(found, choose_array(folder).positions_m)
    np.testing.assert_allclose(found, roof_array_56().positions_m)
    assert open_source(folder).model is None  # the model that ships was not made for it
    assert main(["run", str(folder), "--model", "simulated-56"]) == 2
    assert main(words) == 2  # one data set, one array


def windows() -> FeatureTable:
    labels, keys = np.array(["front", "left", "none", "right"] * 15), np.arange(60).astype(str)
    features, sites = np.random.default_rng(0).random((60, 60)) + 0.1, np.repeat(["SA1", "SB2"], 30)
    return FeatureTable(features, labels, keys, sites, keys, (None,) * 60)


@pytest.mark.long
def test_a_table_and_its_model_keep_their_array(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_features(tmp_path / "t.csv", replace(windows(), domain=domain_of(EIGHT, [44_100], ["SA1"])))
    domain = read_features(tmp_path / "t.csv").domain
    assert domain is not None and domain.array == "eight"
    assert np.array_equal(domain.positions_m, EIGHT.positions_m)
    train = ["model", "fit", str(tmp_path / "t.csv"), "--out", str(tmp_path / "m.json")]
    assert main(train) == 0
    domain = read_model(tmp_path / "m.json").domain
    assert domain is not None and (len(domain.positions_m), domain.ego_motion) == (8, "standing")
    write_features(tmp_path / "t.csv", windows())  # The array of the other table is removed
    assert read_features(tmp_path / "t.csv").domain is None
    capsys.readouterr()
    assert main(train) == 0
    assert "states no array: taken as OVAD's" in capsys.readouterr().err
    domain = read_model(tmp_path / "m.json").domain
    assert domain is not None and np.array_equal(domain.positions_m, HERE)


def test_evaluating_a_table_of_another_array_is_refused(tmp_path, capsys) -> None:
    made = model_of(ovad_array(), RATE)
    unseen = replace(made.provenance, training_recordings=())
    save_model(tmp_path / "m.json", replace(made, provenance=unseen))
    words = ["windows", str(tmp_path / "t.csv"), "--model", str(tmp_path / "m.json"), "--group", "all"]
    for array, why in (
        (EIGHT, "eight: not the array of the model"),
        (MicrophoneArray(HERE[::-1]), "in another order"),
    ):
        write_features(tmp_path / "t.csv", replace(windows(), domain=domain_of(array, [RATE], ["SA1"])))
        assert study(words) == 2
        assert why in capsys.readouterr().err
    # A table without an array is taken as OVAD's.
    write_features(tmp_path / "t.csv", replace(windows(), environments=np.array(["SA1"] * 60)))
    assert study(words) == 0


@pytest.mark.long
def test_calibration_keeps_the_domain_of_the_signature_and_refuses_another(tmp_path, refused) -> None:
    """Thresholds and streams are valid for one array and one signature only."""
    elsewhere = MicrophoneArray(HERE * [1, -1, 1], "mirrored")
    save_model(tmp_path / "own.json", model_of(elsewhere, RATE))
    quiet, mics = tmp_path / "quiet.wav", array_file(tmp_path / "mics.csv", elsewhere.positions_m)
    soundfile.write(quiet, 0.01 * RNG.standard_normal((RATE * 2, 56)), RATE, subtype="FLOAT")
    out, streams = tmp_path / "out.json", tmp_path / "s.npz"
    words, own = ["--alpha", "0.2", "--out", str(out)], ["--model", str(tmp_path / "own.json")]
    heard = ["--array", str(mics), *own, "--save-streams", str(streams)]
    assert main(["model", "threshold", str(quiet), *heard, *words]) == 0
    written = read_model(out).domain
    assert written is not None and written.array == "mirrored"
    assert main(["model", "threshold", str(streams), *own, *words]) == 0
    out.unlink()
    said = refused(["model", "threshold", str(streams), *words])
    assert "made with another model's signature" in said and not out.exists()


def test_evaluate_refuses_a_model_of_another_array(tmp_path, capsys) -> None:
    save_model(tmp_path / "roof.json", model_of(roof_array_56(), RATE))
    assert study(["table", "--out", str(tmp_path / "e"), "--model", str(tmp_path / "roof.json")]) == 2
    assert "not the array of the model" in capsys.readouterr().err
    assert not (tmp_path / "e" / "streets").exists()
