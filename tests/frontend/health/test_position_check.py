"""Sound and positions: exchanged, random, of another size, mirrored and turned; rooms by pyroomacoustics."""

import json
from pathlib import Path

import numpy as np
import pyroomacoustics as pra
import pytest
import soundfile

from worldstate.cli.main import main
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.health.position_check import PositionCheck, PositionVerdict
from worldstate.simulation.emitters.syntheses import voice

RATE = 16_000


def ring(n: int, radius_m: float) -> np.ndarray:
    angle = 2.0 * np.pi * np.arange(n) / n
    return radius_m * np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])


def room(positions: np.ndarray, azimuths_deg: tuple[float, ...], seed: int = 0) -> np.ndarray:
    """Return talkers one after the other, two seconds each, in a room with .4 s of reverberation."""
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


def verdict(sound: np.ndarray, positions: np.ndarray, heard_from_deg: float | None = None) -> PositionVerdict:
    check = PositionCheck(MicrophoneArray(positions), RATE)
    for start in range(0, len(sound), RATE):
        check.push(sound[start : start + RATE])
    heard_from = None if heard_from_deg is None else float(np.radians(heard_from_deg))
    return check.verdict(np.ones(len(positions), bool), heard_from)


@pytest.fixture(scope="module")
def talkers() -> np.ndarray:
    return room(ring(6, 0.045), (20.0, 100.0, -130.0, -40.0))


def test_right_positions_fit(talkers: np.ndarray) -> None:
    found = verdict(talkers, ring(6, 0.045))
    assert found.fits
    # What no sound shows is said.
    assert any("mirrored or turned" in one for one in found.unjudged)


def test_two_exchanged_are_named(talkers: np.ndarray) -> None:
    claimed = ring(6, 0.045)[[0, 2, 1, 3, 4, 5]]
    found = verdict(talkers, claimed)
    assert found.order is not None
    apart = np.linalg.norm(claimed[:, None] - claimed, axis=-1)
    order = np.array(found.order)
    there = ring(6, 0.045)
    np.testing.assert_allclose(
        apart[order][:, order], np.linalg.norm(there[:, None] - there, axis=-1), atol=1e-9
    )


def test_a_random_order_fits_nowhere(talkers: np.ndarray) -> None:
    assert verdict(talkers, ring(6, 0.045)[[3, 0, 4, 1, 5, 2]]).order is not None


@pytest.mark.parametrize("factor", [0.7, 1.3, 39.37])
def test_another_size(talkers: np.ndarray, factor: float) -> None:
    size = verdict(talkers, factor * ring(6, 0.045)).size
    assert size is not None
    assert size * factor == pytest.approx(1.0, abs=0.12)


def test_mountings_show_in_a_sound_from_a_known_side() -> None:
    sound, there = room(ring(6, 0.045), (40.0,), seed=1), ring(6, 0.045)
    sound = np.concatenate([sound, room(there, (40.0,), seed=2)])
    assert verdict(sound, there, 40.0).fits
    assert verdict(sound, there * [1.0, -1.0, 1.0], 40.0).mounting == ("mirrored",)
    assert "turned by 120 degrees" in verdict(sound, np.roll(there, 2, axis=0), 40.0).mounting
    # Without its side nothing is concluded.
    assert verdict(sound, there * [1.0, -1.0, 1.0]).fits


@pytest.mark.parametrize(
    "sound", [np.zeros((RATE * 4, 6)), np.random.default_rng(0).standard_normal((RATE * 4, 6))]
)
def test_nothing_is_concluded_of_silence_and_own_noise(sound: np.ndarray) -> None:
    found = verdict(sound.astype(np.float32), ring(6, 0.045))
    assert found.fits
    assert "sound that all microphones hear" in found.unjudged[0]


def run(folder: Path, sound: np.ndarray, positions: np.ndarray, *options: str) -> int:
    soundfile.write(folder / "some.wav", sound, RATE, subtype="PCM_24")
    (folder / "mics.json").write_text(json.dumps(positions.tolist()))
    return main(["array", "check", str(folder / "some.wav"), "--array", str(folder / "mics.json"), *options])


def test_the_command(talkers: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(tmp_path, talkers, ring(6, 0.045)) == 0
    assert "mirrored or turned" in capsys.readouterr().out
    assert run(tmp_path, talkers, ring(6, 0.045)[[1, 0, 2, 3, 4, 5]], "--json") == 1
    report = json.loads(capsys.readouterr().out)
    assert report["condition"] == "impaired"
    assert not report["positions"]["fit"]


@pytest.mark.parametrize(("divisor", "unit"), [(39.37, "inches"), (25.0, "inches")])
def test_an_array_too_small_is_refused_with_its_unit(
    talkers: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str], divisor: float, unit: str
) -> None:
    assert run(tmp_path, talkers, ring(6, 0.045) / divisor) == 2
    assert unit in capsys.readouterr().err


def test_clipped_sound_is_impaired(
    talkers: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    limit = float(talkers.std())
    assert run(tmp_path, talkers.clip(-limit, limit), ring(6, 0.045)) == 1
    assert "impaired" in capsys.readouterr().out
