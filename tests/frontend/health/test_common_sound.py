"""Independent noise is not heard from the first sample on, whatever array, spectrum and level."""

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from worldstate.adapters.acoustic import AcousticAdapter, heard_of
from worldstate.adapters.files.array_file import named_arrays
from worldstate.frontend.array.microphone_array import MicrophoneArray, roof_array_56
from worldstate.frontend.health.common_sound import NOTHING_IN_COMMON
from worldstate.frontend.hop_spectra import BANDS, NoiseMeter
from worldstate.frontend.settings import FrontEndSettings
from worldstate.frontend.stream import AcousticFrame, FrontEnd
from worldstate.operations.recordings.channel_report import HealthLog

RATE = 16_000
REAL = Path(os.environ.get("FOUR_MICROPHONES", Path(__file__).parents[4] / "shared" / "four-microphones"))
# Not documented: an upright turned square, 6.5 cm from corner to corner, is near what fits its sound.
BOARD = [[0.0, 0.0137, -0.0293], [0.0, -0.0293, -0.0137], [0.0, -0.0137, 0.0293], [0.0, 0.0293, 0.0137]]
ROOF = roof_array_56().positions_m
ARRAYS = {
    "4 of the roof": ROOF[[0, 20, 30, 42]],
    "7 of the roof": ROOF[::8][:7],
    "8 of the roof": ROOF[3::7][:8],
    "16 of the roof": ROOF[::3][:16],
    "the roof": ROOF,
    "two, 0.1 m": np.array([[0.0, 0.05, 0.0], [0.0, -0.05, 0.0]]),
    **{name: np.array(board["positions_m"]) for name, board in named_arrays().items()},
}
# Exponents of the amplitude over frequency, below which it is flat.
SPECTRA = {"white": 0.0, "pink": -0.5, "wind": -1.5}


def shaped(white: np.ndarray, spectrum: str) -> np.ndarray:
    """Give white sound (n, M) a spectrum, at a mean square of 1."""
    frequencies = np.maximum(np.fft.rfftfreq(len(white), 1.0 / RATE), 20.0)
    coloured = np.fft.rfft(white, axis=0) * frequencies[:, None] ** SPECTRA[spectrum]
    sound = np.fft.irfft(coloured, len(white), axis=0)
    return np.asarray(sound / sound.std())


def street(array: MicrophoneArray, spectrum: str, noise_db: float, seed: int = 0) -> np.ndarray:
    """A wave from the left, and noise of its spectrum that is independent between the microphones."""
    rng, n = np.random.default_rng(seed), 2 * RATE
    wave = np.fft.rfft(rng.standard_normal(n))[:, None]
    wave = wave * array.steering(np.fft.rfftfreq(n, 1.0 / RATE), 0.7)[:, :, 0]
    noise = shaped(rng.standard_normal((n, array.n_microphones)), spectrum)
    sound = shaped(np.fft.irfft(wave, n, axis=0), spectrum) + 10.0 ** (noise_db / 20.0) * noise
    return np.asarray(0.01 * sound, np.float32)


def frames_of(array: MicrophoneArray, sound: np.ndarray) -> list[AcousticFrame]:
    return FrontEnd(array, RATE, FrontEndSettings.heard_at(RATE)).process(sound)


@pytest.mark.parametrize("spectrum", SPECTRA)
@pytest.mark.parametrize("name", ARRAYS)
def test_of_independent_noise_nothing_is_heard(name: str, spectrum: str) -> None:
    array = MicrophoneArray(ARRAYS[name])
    for noise_db in (10.0, 20.0, 30.0):
        frames = frames_of(array, street(array, spectrum, noise_db))
        assert max(heard_of(frame).share for frame in frames) < 0.2
        assert {frame.unheard for frame in frames} == {NOTHING_IN_COMMON}
    assert all(frame.heard == 1.0 for frame in frames_of(array, street(array, spectrum, -6.0)))


def test_where_a_diffuse_field_leaves_no_coherence_it_decides_nothing() -> None:
    pair = MicrophoneArray([[0.0, 0.34, 0.0], [0.0, -0.34, 0.0]])
    assert all(frame.unheard is None for frame in frames_of(pair, street(pair, "white", 30.0)))


def test_samples_of_another_format_are_not_heard() -> None:
    """Bits that are no samples have all values alike."""
    array = MicrophoneArray(ROOF[:4])
    dealt = np.random.default_rng(0).integers(-(2**15), 2**15, (2 * RATE, 4), np.int16)
    assert max(frame.heard or 0.0 for frame in frames_of(array, dealt)) == 0.0


def test_the_sensor_is_impaired_and_the_recording_not_healthy() -> None:
    array, log = roof_array_56(), HealthLog()
    noise = np.random.default_rng(0).standard_normal((2 * RATE, 56)).astype(np.float32)
    adapter = AcousticAdapter(array, RATE, Unasked(), front_end_settings=FrontEndSettings.heard_at(RATE))
    for measured in adapter.measure(noise):
        assert (measured.fault, measured.heard.usable) == (NOTHING_IN_COMMON, False)
        log.add(adapter.last_frame)
    assert log.summary().is_deaf and not log.summary().is_healthy


class Unasked:
    """A model that may not learn from what was not heard."""

    def evidence(self, feature: np.ndarray) -> object:
        raise AssertionError("asked of noise")


@settings(max_examples=30)
@given(st.integers(0, 40), st.floats(-3.0, 6.0), st.floats(-1.0, 0.15))
def test_what_is_usual_is_not_learned_from_what_was_not_heard(hops: int, nats: float, common: float) -> None:
    one, other, quiet = NoiseMeter(), NoiseMeter(), np.full(BANDS, -12.0)
    for _ in range(hops):
        assert one.push(quiet + nats, 0.0, common) == (0.0, NOTHING_IN_COMMON)
    for hop in range(30):
        level = quiet + 0.01 * hop
        assert one.push(level, 0.5, 0.6) == other.push(level, 0.5, 0.6)
    assert one.excess_db == other.excess_db


@pytest.mark.long
@pytest.mark.skipif(not REAL.is_dir(), reason=f"no recordings in {REAL}")
def test_real_streets_are_heard() -> None:
    """At most one hop in a hundred of real streets, four microphones, has nothing in common."""
    from worldstate.adapters.audio.sound_file import open_sound

    array, unheard = MicrophoneArray(BOARD), []
    for path in sorted(REAL.glob("*.flac"))[::6]:
        with open_sound(path, 4) as audio:
            rate = audio.sample_rate_hz
            front_end = FrontEnd(array, rate, FrontEndSettings.heard_at(rate))
            frames = [frame for block in audio.blocks(rate) for frame in front_end.process(block)]
        unheard += [frame.unheard == NOTHING_IN_COMMON for frame in frames]
    assert len(unheard) > 300 and np.mean(unheard) <= 0.01
