"""The published feature and its classes: against a plain restatement, and pyroomacoustics' real part.

The shipped model was trained on the released feature windows. The restatement follows the formula in double
precision and shares nothing with the library but the place of the microphones.
"""

from collections.abc import Iterable
from itertools import pairwise

import numpy as np
import pyroomacoustics
import pytest
import scipy.signal
import soundfile
from acoular_scene import RATE
from plane_waves import noise_from

from worldstate.adapters.files.model_file import read_model
from worldstate.frontend.array.microphone_array import MicrophoneArray, roof_array_56
from worldstate.frontend.array.steering import cross_spectra
from worldstate.frontend.direction.feature import feature_steering, pair_sum, published_feature
from worldstate.frontend.spectra.stft import StreamingStft
from worldstate.frontend.stream import FrontEnd

ROOF = roof_array_56()
SMALL = MicrophoneArray(np.random.default_rng(3).uniform(-0.4, 0.4, (7, 3)))
RIGHT_POSITIVE_DEG = np.linspace(-90.0, 90.0, 30)


def plain_feature(segments: Iterable[np.ndarray], positions_m: np.ndarray) -> np.ndarray:
    """|sum over frames, bins and pairs i < j| over their number, of spectra (257, M, frames) per segment."""
    bins, pairs = (
        np.arange(round(50 / RATE * 512), round(1500 / RATE * 512)),
        len(positions_m) * (len(positions_m) - 1) / 2,
    )
    ahead, right, azimuths = positions_m[:, 0], -positions_m[:, 1], np.radians(RIGHT_POSITIVE_DEG)
    early_s = (np.outer(ahead, np.cos(azimuths)) + np.outer(right, np.sin(azimuths))) / 343.0
    turn, values = np.exp(2j * np.pi * RATE / 512 * bins[:, None, None] * early_s), []
    for spectra in segments:
        phases = np.exp(1j * np.angle(spectra[bins]))
        products = np.triu(phases @ np.conj(phases).transpose(0, 2, 1), 1)
        total = np.sum(np.conj(turn) * (products @ turn), axis=(0, 1))
        values.append(np.abs(total) / (spectra.shape[2] * len(bins) * pairs))
    return np.concatenate(values)


def plain_window(window: np.ndarray, positions_m: np.ndarray) -> np.ndarray:
    """The feature of a window with zero-padded edges; an odd last frame is omitted."""
    spectra = scipy.signal.stft(window.astype(np.float64), RATE, nperseg=512, axis=0)[2]
    half = spectra.shape[2] // 2
    return plain_feature((spectra[..., :half], spectra[..., half : 2 * half]), positions_m)


def street(array: MicrophoneArray, seed: int, seconds: float = 1.0, rate: int = RATE) -> np.ndarray:
    """A white source to the left at 40 deg and noise, float32 (n, M)."""
    return noise_from(array, np.radians(40.0), rate, seconds, seed, noise=1.0)


def test_a_stream_equals_the_plain_formula_per_half() -> None:
    sound = street(SMALL, 1, seconds=1.3)
    frame = FrontEnd(SMALL, RATE).process(sound)[2]
    edges = [round(time_s * RATE) for time_s in (0.2, 0.7, 1.2)]
    assert frame.sample_index == edges[2]
    spectra = scipy.signal.stft(sound, nperseg=512, axis=0, boundary=None, padded=False)[2]
    ends = 512 + 256 * np.arange(spectra.shape[2])
    halves = [spectra[..., (ends > a) & (ends <= b)] for a, b in pairwise(edges)]
    np.testing.assert_allclose(frame.feature, plain_feature(halves, SMALL.positions_m), rtol=1e-4)


def test_twice_the_real_part_plus_the_diagonal_is_pyroomacoustics() -> None:
    frames = StreamingStft(56, 512, range(0, 257)).push(street(ROOF, 4, seconds=0.2))
    right_handed = ROOF.positions_m * [1.0, -1.0, 1.0]
    peer = pyroomacoustics.doa.SRP(right_handed.T, RATE, 512, azimuth=np.radians(RIGHT_POSITIVE_DEG))
    peer.locate_sources(frames.transpose(2, 1, 0).astype(np.complex128), freq_range=[50.0, 1500.0])
    used = frames[:, 1:16].transpose(1, 0, 2)
    sums = pair_sum(cross_spectra(used / np.abs(used)), feature_steering(ROOF, range(1, 16), RATE))
    pairs = 56 * 55 / 2
    expected = 2 * sums.real / (len(frames) * 15 * pairs) + 56 / pairs
    np.testing.assert_allclose(expected, peer.grid.values, rtol=1e-4)


@pytest.mark.parametrize("rate", [16_000, 48_000])
def test_other_rates_agree_too(rate: int) -> None:
    sound = street(SMALL, 6, rate=rate)
    stream = FrontEnd(SMALL, rate).process(sound)[0].feature
    assert np.corrcoef(stream, published_feature(sound, SMALL, rate))[0, 1] > 0.99


def classes_of(features: list[np.ndarray]) -> np.ndarray:
    signature = read_model().signature
    return np.array(signature.classes)[signature.predict_proba(np.array(features)).argmax(axis=1)]


def compare(windows: Iterable[np.ndarray], array: MicrophoneArray = ROOF) -> np.ndarray:
    """Check the features of every window, return our classes once they are found equal."""
    every = list(windows)
    ours = [published_feature(window, array, RATE) for window in every]
    plain = [plain_window(window, array.positions_m) for window in every]
    np.testing.assert_allclose(ours, plain, rtol=1e-4)
    np.testing.assert_array_equal(classes_of(ours), classes_of(plain))
    return classes_of(ours)


def test_a_whole_window_equals_the_plain_formula() -> None:
    compare([street(SMALL, 0)], SMALL)


@pytest.mark.long
def test_same_class_on_a_simulated_recording_and_in_noise(approach) -> None:
    sound, rate = soundfile.read(approach.audio_path, dtype="float32")
    assert rate == RATE
    found = compare(sound[start : start + RATE] for start in range(0, len(sound) - RATE + 1, RATE))
    rng = np.random.default_rng(2)
    drawn = zip(range(6), rng.uniform(-1.5, 1.5, 6), 10.0 ** rng.uniform(-1.0, 0.5, 6), strict=True)
    more = compare(noise_from(ROOF, azimuth, RATE, 1.0, seed, noise) for seed, azimuth, noise in drawn)
    assert len(set(found) | set(more)) >= 3
