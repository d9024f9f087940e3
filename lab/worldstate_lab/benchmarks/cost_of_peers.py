"""The same computations by peer libraries, where they are installed.

`published_chain` restates the chain of the published acoustic baseline in its amortised form: scipy's STFT of
the whole file, channel by channel, its cost shared among the hops; then for every hop two segments of half a
second through pyroomacoustics' SRP, thirty azimuths, 50-1500 Hz. `published_chain_per_call` is the same where
the sound comes as a stream, so that every hop transforms its own second.
"""

from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np

from worldstate.frontend.array.microphone_array import roof_array_56
from worldstate.ground.typing import Complex64Array, Float32Array, FloatArray

from .stopwatch import Milliseconds, elapsed_ms

NFFT, REPEATS = 512, 9
SRP_BAND_HZ, FEATURE_BAND_HZ = [300.0, 1800.0], [50.0, 1500.0]


def peer_times(
    sound: Float32Array, frames: Complex64Array, sample_rate_hz: int, azimuths_rad: FloatArray
) -> dict[str, Milliseconds]:
    """Return milliseconds per hop of each peer, keys beginning with ``peer_``; empty where none is installed.

    Shapes: sound (n, M), frames (frames, bins, M), azimuths_rad (D,).
    """
    if find_spec("pyroomacoustics") is None:
        return {}
    import pyroomacoustics

    positions = roof_array_56().positions_m.T
    spectra = np.ascontiguousarray(frames.transpose(2, 1, 0))

    def on_a_tenth(method: Any) -> Milliseconds:
        peer = method(positions, sample_rate_hz, NFFT, azimuth=azimuths_rad)
        locate = partial(peer.locate_sources, spectra, freq_range=SRP_BAND_HZ)
        return [elapsed_ms(locate) for _ in range(REPEATS)]

    file_ms, halves_ms, second_ms = _published_chain(sound, sample_rate_hz, pyroomacoustics.doa.SRP)
    shared_ms = 0.1 * file_ms * sample_rate_hz / len(sound)
    return {
        "peer_pyroomacoustics_srp": on_a_tenth(pyroomacoustics.doa.SRP),
        "peer_pyroomacoustics_music": on_a_tenth(pyroomacoustics.doa.MUSIC),
        "peer_published_chain": [ms + shared_ms for ms in halves_ms],
        "peer_published_chain_per_call": [ms + second_ms for ms in halves_ms],
    }


def _published_chain(
    sound: Float32Array, sample_rate_hz: int, method: Any
) -> tuple[float, Milliseconds, float]:
    """Return the STFT of the file, SRP of two half seconds several times, and the STFT of one second."""
    from scipy.signal import stft

    def transform(part: Float32Array) -> list[Any]:
        return [stft(channel, sample_rate_hz, nperseg=NFFT)[2] for channel in part.T]

    file_ms = elapsed_ms(lambda: transform(sound))
    second_ms = elapsed_ms(lambda: transform(sound[:sample_rate_hz]))
    second = np.stack(transform(sound[:sample_rate_hz]))
    azimuths = np.radians(np.linspace(-90.0, 90.0, 30))
    peer = method(roof_array_56().positions_m.T, sample_rate_hz, NFFT, azimuth=azimuths)
    half = second.shape[2] // 2

    def one_hop() -> None:
        for segment in (second[..., :half], second[..., half : 2 * half]):
            peer.locate_sources(segment, freq_range=FEATURE_BAND_HZ)

    return file_ms, [elapsed_ms(one_hop) for _ in range(REPEATS)], second_ms
