"""The published feature against a plain loop over its formula, and against pyroomacoustics' real part."""

import numpy as np
import pyroomacoustics
import pytest
import scipy.signal

from worldstate.frontend.array.microphone_array import MicrophoneArray, roof_array_56
from worldstate.frontend.direction.feature import feature_steering, pair_sum, published_feature
from worldstate.frontend.spectra.stft import StreamingStft
from worldstate.frontend.stream import FrontEnd

RATE = 47_998
RIGHT_POSITIVE_DEG = np.linspace(-90.0, 90.0, 30)


def plain_feature(segments: list[np.ndarray], positions: np.ndarray, rate: float) -> np.ndarray:
    """The formula, pair by pair in double precision; segments (M, 257, frames), base_link positions."""
    bins = np.arange(round(50 / rate * 512), round(1500 / rate * 512))
    x, right = positions[:, 0], -positions[:, 1]
    values = []
    for spectra in segments:
        phases = np.exp(1j * np.angle(spectra[:, bins]))
        for azimuth in np.radians(RIGHT_POSITIVE_DEG):
            tau = (x * np.cos(azimuth) + right * np.sin(azimuth)) / 343.0
            total = 0.0 + 0.0j
            for i in range(len(positions)):
                for j in range(i + 1, len(positions)):
                    steer = np.exp(-2j * np.pi * rate / 512 * bins * (tau[i] - tau[j]))
                    total += np.sum((phases[i] * phases[j].conj()).sum(axis=1) * steer)
            pairs = len(positions) * (len(positions) - 1) / 2
            values.append(abs(total) / (spectra.shape[2] * len(bins) * pairs))
    return np.array(values)


def street(array: MicrophoneArray, seed: int, seconds: float = 1.0, rate: int = RATE) -> np.ndarray:
    """A white source to the left at 40 deg and noise, float32 (n, M)."""
    rng, n = np.random.default_rng(seed), int(seconds * rate)
    wave = np.fft.rfft(rng.standard_normal(n))[:, None]
    wave = wave * array.steering(np.fft.rfftfreq(n, 1 / rate), np.radians(40.0))[:, :, 0]
    noise = rng.standard_normal((n, array.n_microphones))
    return (np.fft.irfft(wave, n, axis=0) + noise).astype(np.float32)


def small_array() -> MicrophoneArray:
    return MicrophoneArray(np.random.default_rng(3).uniform(-0.4, 0.4, (7, 3)))


def test_whole_window_equals_the_plain_formula() -> None:
    array = small_array()
    window = street(array, 0)
    spectra = np.stack(
        [scipy.signal.stft(channel, RATE, nperseg=512)[2] for channel in window.T.astype(float)]
    )
    half = spectra.shape[2] // 2
    assert spectra.shape[2] == 189
    plain = plain_feature([spectra[..., :half], spectra[..., half : 2 * half]], array.positions_m, RATE)
    np.testing.assert_allclose(published_feature(window, array, RATE), plain, rtol=1e-4)


def test_a_stream_equals_the_plain_formula_per_half() -> None:
    array = small_array()
    sound = street(array, 1, seconds=1.3)
    frame = FrontEnd(array, RATE).process(sound)[2]
    start, middle, end = round(0.2 * RATE), round(0.7 * RATE), round(1.2 * RATE)
    assert frame.sample_index == end
    spectra = scipy.signal.stft(sound, nperseg=512, axis=0, boundary=None, padded=False)[2].transpose(1, 0, 2)
    ends = 512 + 256 * np.arange(spectra.shape[2])
    halves = [spectra[..., (ends > a) & (ends <= b)] for a, b in ((start, middle), (middle, end))]
    np.testing.assert_allclose(frame.feature, plain_feature(halves, array.positions_m, RATE), rtol=1e-4)


def test_twice_the_real_part_plus_the_diagonal_is_pyroomacoustics() -> None:
    array = roof_array_56()
    frames = StreamingStft(56, 512, range(0, 257)).push(street(array, 4, seconds=0.2))
    right_handed = array.positions_m * [1.0, -1.0, 1.0]
    peer = pyroomacoustics.doa.SRP(right_handed.T, RATE, 512, azimuth=np.radians(RIGHT_POSITIVE_DEG))
    peer.locate_sources(frames.transpose(2, 1, 0).astype(np.complex128), freq_range=[50.0, 1500.0])
    used = frames[:, 1:16]
    sums = pair_sum(used / np.abs(used), feature_steering(array, range(1, 16), RATE))
    pairs = 56 * 55 / 2
    expected = 2 * sums.real / (len(frames) * 15 * pairs) + 56 / pairs
    np.testing.assert_allclose(expected, peer.grid.values, rtol=1e-4)


def test_a_source_on_the_left_is_in_the_first_half_of_a_segment() -> None:
    feature = published_feature(street(roof_array_56(), 5), roof_array_56(), RATE).reshape(2, 30)
    assert feature.min() >= 0
    assert feature.max() <= 1
    loudest = RIGHT_POSITIVE_DEG[feature.argmax(axis=1)]
    np.testing.assert_allclose(loudest, -40.0, atol=4.0)


@pytest.mark.parametrize("rate", [16_000, 48_000])
def test_other_rates_agree_too(rate: int) -> None:
    array = small_array()
    sound = street(array, 6, rate=rate)
    stream = FrontEnd(array, rate).process(sound)[0].feature
    whole = published_feature(sound, array, rate)
    assert np.corrcoef(stream, whole)[0, 1] > 0.99
