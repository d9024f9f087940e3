"""Sound and positions: exchanged, random, of another size, mirrored and turned; rooms by pyroomacoustics."""

import json
from pathlib import Path

import numpy as np
import pyroomacoustics as pra
import pytest
import soundfile
from plane_waves import array_check, plane_wave, position_check

from worldstate.adapters.files.array_file import read_array
from worldstate.cli.main import main
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.health.fitted_positions import FittedPositions, fit_positions
from worldstate.frontend.health.position_check import PositionCheck, PositionVerdict
from worldstate.ground.errors import InvalidArgumentError
from worldstate.simulation.emitters.syntheses import voice

RATE = 16_000


def ring(n: int, radius_m: float) -> np.ndarray:
    angle = 2.0 * np.pi * np.arange(n) / n
    return radius_m * np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])


def room(positions: np.ndarray, azimuths_deg: tuple[float, ...], seed: int = 0) -> np.ndarray:
    """Return talkers one after the other, two seconds each, in a room with 0.4 s of reverberation."""
    rng = np.random.default_rng(seed)
    absorption, order = pra.inverse_sabine(0.4, [6.0, 5.0, 2.8])
    box = pra.ShoeBox([6.0, 5.0, 2.8], fs=RATE, materials=pra.Material(absorption), max_order=min(order, 25))
    box.add_microphone_array((positions + np.array([2.8, 2.4, 1.2])).T)
    for turn, azimuth in enumerate(np.radians(azimuths_deg)):
        place = [2.8 + 1.3 * np.cos(azimuth), 2.4 + 1.3 * np.sin(azimuth), 1.4]
        box.add_source(place, signal=voice(2 * RATE, RATE, rng), delay=2.0 * turn)
    box.simulate()
    sound = box.mic_array.signals.T[: 2 * RATE * len(azimuths_deg)]
    noise = rng.standard_normal(sound.shape) * 0.1
    return (0.1 * (sound / sound.std() + noise)).astype(np.float32)


def taken(sound: np.ndarray, positions: np.ndarray) -> PositionCheck:
    return position_check(MicrophoneArray(positions), sound, RATE)


def verdict(sound: np.ndarray, positions: np.ndarray, heard_from_deg: float | None = None) -> PositionVerdict:
    check = taken(sound, positions)
    heard_from = None if heard_from_deg is None else float(np.radians(heard_from_deg))
    return check.verdict(np.ones(len(positions), bool), heard_from)


@pytest.fixture(scope="module")
def talkers() -> np.ndarray:
    return room(ring(6, 0.045), (20.0, 100.0, -130.0, -40.0))


def test_an_exchange_is_named_and_a_random_order_does_not_fit(talkers: np.ndarray) -> None:
    there = ring(6, 0.045)
    claimed = there[[0, 2, 1, 3, 4, 5]]
    placed = claimed[list(verdict(talkers, claimed).order)]
    apart, expected = (np.linalg.norm(one[:, None] - one, axis=-1) for one in (placed, there))
    np.testing.assert_allclose(apart, expected, atol=1e-9)
    assert verdict(talkers, there[[3, 0, 4, 1, 5, 2]]).order is not None


@pytest.mark.parametrize("factor", [0.7, 1.3, 39.37])
def test_a_wrong_size_is_estimated(talkers: np.ndarray, factor: float) -> None:
    size = verdict(talkers, factor * ring(6, 0.045)).size
    assert size is not None
    assert size * factor == pytest.approx(1.0, abs=0.12)


def test_a_sound_from_a_known_side_shows_the_mounting() -> None:
    there = ring(6, 0.045)
    sound = np.concatenate([room(there, (40.0,), seed) for seed in (1, 2)])
    assert verdict(sound, there, 40.0).fits
    assert verdict(sound, there * [1.0, -1.0, 1.0], 40.0).mounting == ("mirrored",)
    assert "turned by 120 degrees" in verdict(sound, np.roll(there, 2, axis=0), 40.0).mounting
    # Without a known side there is no conclusion.
    assert verdict(sound, there * [1.0, -1.0, 1.0]).fits


@pytest.mark.parametrize(
    "sound", [np.zeros((RATE * 4, 6)), np.random.default_rng(0).standard_normal((RATE * 4, 6))]
)
def test_silence_and_independent_noise_allow_no_conclusion(sound: np.ndarray) -> None:
    found = verdict(sound.astype(np.float32), ring(6, 0.045))
    assert found.fits
    assert "coherent sound" in found.unjudged[0]


def checked(folder: Path, sound: np.ndarray, positions: np.ndarray, *options: str) -> int:
    return array_check(folder, MicrophoneArray(positions), sound, RATE, *options)


def test_the_command_reports_an_exchange_and_clipping(talkers, tmp_path, capsys):
    assert checked(tmp_path, talkers, ring(6, 0.045)) == 0
    assert "mirrored or rotated" in capsys.readouterr().out
    assert checked(tmp_path, talkers, ring(6, 0.045)[[1, 0, 2, 3, 4, 5]], "--json") == 1
    report = json.loads(capsys.readouterr().out)
    assert report["condition"] == "impaired"
    assert not report["positions"]["fit"]
    limit = float(talkers.std())
    assert checked(tmp_path, talkers.clip(-limit, limit), ring(6, 0.045)) == 1
    assert "not healthy: clipped 1, 2, 3, 4, 5, 6" in capsys.readouterr().out


@pytest.mark.parametrize("divisor", [39.37, 25.0])
def test_an_array_too_small_is_refused_with_its_unit(talkers, tmp_path, capsys, divisor):
    sound, array = tmp_path / "some.wav", tmp_path / "mics.json"
    soundfile.write(sound, talkers, RATE)
    array.write_text(json.dumps((ring(6, 0.045) / divisor).tolist()))
    assert main(["array", "check", str(sound), "--array", str(array)]) == 2
    assert "inches" in capsys.readouterr().err


SQUARE = ring(4, 0.032)


@pytest.fixture(scope="module")
def around() -> list[np.ndarray]:
    """Two recordings of talkers from six sides each."""
    return [room(SQUARE, tuple(range(turn, 360, 60)), seed=turn) for turn in (0, 30)]


def fitted(sounds: list[np.ndarray], claimed: np.ndarray) -> FittedPositions:
    return fit_positions([taken(one, claimed) for one in sounds], np.ones(len(claimed), bool))


def error_m(found: np.ndarray, there: np.ndarray) -> float:
    """Return the largest position error, up to a rotation or a reflection."""
    a, b = ((one - one.mean(axis=0))[:, :2] for one in (found, there))
    u, _, v = np.linalg.svd(a.T @ b)
    return float(np.linalg.norm(a @ (u @ v) - b, axis=1).max())


@pytest.mark.parametrize(
    "claimed",
    [
        1.4 * SQUARE,
        0.7 * SQUARE,
        SQUARE[[0, 2, 1, 3]],
        SQUARE + 0.006 * np.random.default_rng(2).standard_normal((4, 3)) * [1.0, 1.0, 0.0],
    ],
)
def test_positions_are_recovered_up_to_a_turn(around: list[np.ndarray], claimed: np.ndarray) -> None:
    found = fitted(around, claimed)
    assert error_m(found.positions_m, SQUARE) < 0.004
    assert error_m(claimed, SQUARE) > 0.006
    assert found.explained > found.explained_before + 0.005
    assert not any("less than 4 s" in one for one in found.unjudged)
    assert any("mirrored or rotated" in one for one in found.unjudged)
    assert any(one.startswith("z: 0.77 or 1.3 times") for one in found.unjudged)


def waves(positions: np.ndarray, azimuths_deg: tuple[float, ...]) -> np.ndarray:
    """Return plane waves of white noise one after the other, three seconds each."""
    rng, array = np.random.default_rng(0), MicrophoneArray(positions)
    sounds = [(rng.normal(0.0, 0.1, 3 * RATE), azimuth) for azimuth in np.radians(azimuths_deg)]
    sound = np.concatenate([plane_wave(array, one, azimuth, RATE) for one, azimuth in sounds])
    return (sound + rng.normal(0.0, 0.01, sound.shape)).astype(np.float32)


HEXAGON = ring(6, 0.0463)


def test_talkers_in_a_live_room_give_positions_that_are_centimetres_off() -> None:
    """A plain descent from positions that are 20 mm off ends 86 mm off."""
    sound = room(HEXAGON, tuple(range(0, 360, 60)), seed=1)
    given = HEXAGON + 0.02 * np.random.default_rng(3).standard_normal((6, 3)) * [1.0, 1.0, 0.0]
    found = fitted([sound], given)
    assert error_m(found.positions_m, HEXAGON) < 0.005 < 0.05 < error_m(given, HEXAGON)


# Cards that started up to 10 ms apart.
LATE_CARDS = [np.roll(one, 32 * k) for k, one in enumerate(waves(HEXAGON, (0.0, 100.0, 220.0)).T)]


@pytest.mark.parametrize(
    ("sound", "problem"),
    [
        (waves(HEXAGON, (40.0, 55.0)), "several sides, got sound from"),
        (np.column_stack(LATE_CARDS), "that some positions fit, the best explain 0."),
    ],
    ids=["nearly one side", "late cards"],
)
def test_sound_that_shows_no_positions_is_refused(sound: np.ndarray, problem: str) -> None:
    claimed = HEXAGON + 0.006 * np.random.default_rng(2).standard_normal((6, 3)) * [1.0, 1.0, 0.0]
    with pytest.raises(InvalidArgumentError, match=problem):
        fitted([sound], claimed)


def test_fitting_true_positions_returns_them(around: list[np.ndarray]) -> None:
    """Any fit is better by chance on its own sound, so it is evaluated on other sound."""
    found = fitted(around, SQUARE)
    np.testing.assert_array_equal(found.positions_m, SQUARE)
    assert found.explained == found.explained_before


def test_an_unusable_channel_keeps_its_position() -> None:
    sound = np.column_stack([room(ring(5, 0.032), (-30.0, 0.0, 30.0), seed=3), np.zeros(3 * 2 * RATE)])
    claimed = np.vstack([1.4 * ring(5, 0.032), [0.1, 0.2, 0.0]])
    found = fit_positions([taken(sound.astype(np.float32), claimed)], np.arange(6) < 5)
    np.testing.assert_array_equal(found.positions_m[5], claimed[5])
    assert found.explained > found.explained_before


def test_insufficient_waves_raise_an_error(around: list[np.ndarray]) -> None:
    quiet = [np.zeros((4 * RATE, 4), np.float32)]
    with pytest.raises(InvalidArgumentError, match="2 s of coherent sound"):
        fitted(quiet, SQUARE)
    with pytest.raises(InvalidArgumentError, match="3 to 16"):
        fit_positions([taken(quiet[0], SQUARE)], np.arange(4) < 2)
    others = [taken(around[0], SQUARE), PositionCheck(MicrophoneArray(SQUARE), 48_000)]
    with pytest.raises(InvalidArgumentError, match="one sample rate"):
        fit_positions(others, np.ones(4, bool))


def test_the_command_writes_an_array_file(around, tmp_path, capsys):
    soundfile.write(tmp_path / "other.wav", around[1], RATE, subtype="PCM_24")
    options = ("--fit", str(tmp_path / "fitted.xml"), "--also", str(tmp_path / "other.wav"))
    checked(tmp_path, around[0], 1.4 * SQUARE, *options)
    printed = capsys.readouterr().out
    assert "of the coherent sound, those given" in printed
    table = [line for line in printed.splitlines() if line.count(",") == 2 and line[:1] in "x-0"]
    (tmp_path / "pasted.csv").write_text("\n".join(table))
    written = read_array(tmp_path / "fitted.xml").positions_m
    np.testing.assert_array_equal(read_array(tmp_path / "pasted.csv").positions_m, written)
    assert "not determined: z: 0.77 or 1.3 times" in printed
    assert error_m(read_array(tmp_path / "fitted.xml").positions_m, SQUARE) < 0.004
    assert checked(tmp_path, around[0], 1.4 * SQUARE, "--fit") == 1
    assert "\nx,y,z\n" in capsys.readouterr().out
    assert checked(tmp_path, around[0], SQUARE, "--fit", str(tmp_path / "fitted.txt")) == 2
    assert "ends in .csv or .xml" in capsys.readouterr().err
    assert checked(tmp_path, around[0], SQUARE, "--also", "other.wav") == 2
    assert "expected --fit" in capsys.readouterr().err


@pytest.mark.parametrize("seed", range(3))
def test_three_plane_waves_give_the_positions_from_any_start(seed: int) -> None:
    rng = np.random.default_rng(seed)
    there = rng.permutation(HEXAGON) if seed else HEXAGON
    turn = rng.uniform(-180.0, 180.0)
    claimed = HEXAGON + rng.normal(0.0, 0.01, (6, 3)) * [1.0, 1.0, 0.0]
    found = fitted([waves(there, (turn, turn + 100.0, turn + 220.0))], claimed)
    assert error_m(found.positions_m, there) < 0.001 < 0.01 < error_m(claimed, there)
    assert found.explained > 0.97 > found.explained_before
