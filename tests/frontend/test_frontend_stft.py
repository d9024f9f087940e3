"""The streaming transform against scipy's, in blocks of any length."""

import numpy as np
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st

from worldstate.frontend.spectra.stft import StreamingStft


def whole_file_spectra(samples: np.ndarray, nfft: int, bins: range) -> np.ndarray:
    """scipy's frames (frames, bins, M), on the scale of a plain windowed sum."""
    spectra = scipy.signal.stft(samples, nperseg=nfft, axis=0, boundary=None, padded=False)[2]
    return spectra[bins.start : bins.stop].transpose(2, 0, 1) * nfft / 2


@settings(deadline=None)
@given(
    lengths=st.lists(st.integers(0, 150), min_size=1, max_size=30),
    half=st.sampled_from([4, 16, 32]),
    seed=st.integers(0, 2**32 - 1),
)
def test_blocks_of_any_length_give_scipys_frames(lengths: list[int], half: int, seed: int) -> None:
    nfft, bins = 2 * half, range(0, half + 1)
    samples = np.random.default_rng(seed).standard_normal((sum(lengths), 3)).astype(np.float32)
    stft = StreamingStft(3, nfft, bins)
    blocks = np.split(samples, np.cumsum(lengths)[:-1])
    frames = np.concatenate([stft.push(block) for block in blocks])
    if len(samples) < nfft:
        assert len(frames) == 0
    else:
        np.testing.assert_allclose(frames, whole_file_spectra(samples, nfft, bins), atol=2e-5 * nfft**0.5)


def test_the_bins_in_use_agree_to_single_precision() -> None:
    samples = np.random.default_rng(1).standard_normal((9600, 8)).astype(np.float32)
    frames = StreamingStft(8, 512, range(1, 19)).push(samples)
    expected = whole_file_spectra(samples, 512, range(1, 19))
    assert frames.dtype == np.complex64
    assert np.abs(frames - expected).max() < 1e-6 * np.abs(expected).max()


def test_a_large_offset_does_not_leak_beyond_the_window() -> None:
    samples = np.full((2048, 1), 1000.0, np.float32)
    frames = StreamingStft(1, 512, range(2, 19)).push(samples)
    assert np.abs(frames).max() < 1e-6 * 1000 * 512
