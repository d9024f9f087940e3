"""Sound at the microphones of an array, and checks of the array with it."""

from pathlib import Path

import numpy as np
import soundfile

from worldstate.adapters.files.array_file import write_array_xml
from worldstate.cli.main import main
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.health.position_check import PositionCheck

# Exponents of the amplitude over frequency, below which it is flat.
SPECTRA = {"white": 0.0, "pink": -0.5, "wind": -1.5}


def plane_wave(
    array: MicrophoneArray, sound: np.ndarray, azimuth_rad: float, rate: float, elevation_rad: float = 0.0
) -> np.ndarray:
    """Return a sound (n,) of a far source at every microphone, (n, M), with exact fractional delays."""
    steering = array.steering(np.fft.rfftfreq(len(sound), 1 / rate), azimuth_rad, elevation_rad)[:, :, 0]
    return np.fft.irfft(np.fft.rfft(sound)[:, None] * steering, len(sound), axis=0)


def noise_from(
    array: MicrophoneArray, azimuth_rad: float, rate: float, seconds: float, seed: int = 0, noise: float = 0.1
) -> np.ndarray:
    """Return a white plane wave in sensor noise, float32 (n, M)."""
    rng, n = np.random.default_rng(seed), round(seconds * rate)
    wave = plane_wave(array, rng.standard_normal(n), azimuth_rad, rate)
    return (wave + noise * rng.standard_normal((n, array.n_microphones))).astype(np.float32)


def shaped(white: np.ndarray, spectrum: str, rate: float) -> np.ndarray:
    """Give white sound (n, M) a spectrum, at a mean square of 1."""
    frequencies = np.maximum(np.fft.rfftfreq(len(white), 1.0 / rate), 20.0)
    coloured = np.fft.rfft(white, axis=0) * frequencies[:, None] ** SPECTRA[spectrum]
    sound = np.fft.irfft(coloured, len(white), axis=0)
    return np.asarray(sound / sound.std())


def position_check(array: MicrophoneArray, sound: np.ndarray, rate: int) -> PositionCheck:
    """Return the check of the positions after a recording (n, M), second by second."""
    check = PositionCheck(array, rate)
    for start in range(0, len(sound), rate):
        check.push(sound[start : start + rate].astype(np.float32))
    return check


def array_check(folder: Path, array: MicrophoneArray, sound: np.ndarray, rate: int, *options: str) -> int:
    """Write an array and its sound, and return the exit status of `worldstate array check`."""
    soundfile.write(folder / "some.wav", sound, rate, subtype="FLOAT")
    write_array_xml(folder / "mics.xml", array)
    return main(["array", "check", str(folder / "some.wav"), "--array", str(folder / "mics.xml"), *options])
