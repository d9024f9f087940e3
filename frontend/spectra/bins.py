"""Which DFT bins a frequency band covers."""

import numpy as np

from worldstate.ground.errors import InvalidArgumentError


def band_bins(band_hz: tuple[float, float], sample_rate_hz: float, nfft: int) -> range:
    """Bins of a band by pyroomacoustics' rule: ``k = round(f N / fs)``, upper end excluded."""
    low, high = (int(np.round(frequency / sample_rate_hz * nfft)) for frequency in band_hz)
    if not 0 <= low < high:
        raise InvalidArgumentError(
            f"band_hz: expected a band of at least one bin of {nfft}, got {band_hz} Hz"
        )
    if high > nfft // 2:
        raise InvalidArgumentError(
            f"band_hz: expected less than half the sample rate of {sample_rate_hz} Hz, got {band_hz} Hz: "
            "choose a lower band, or sound of a higher rate (simulate: --bandwidth)"
        )
    return range(low, high)


def bin_frequencies_hz(bins: range, sample_rate_hz: float, nfft: int) -> np.ndarray:
    """Centre frequencies ``f_k = k fs / N`` of the bins, Hz, shape (bins,)."""
    return np.arange(bins.start, bins.stop) * (sample_rate_hz / nfft)
