"""First stage of a cascade, which selects the seconds of a recording to process, from four microphones.

A second is selected if its level or the coherence of the four microphones exceeds the recording's usual
value. The seconds before it, which the sequence needs, and after it are also processed.
"""

import numpy as np

from worldstate.adapters.audio.sound_file import open_sound
from worldstate.adapters.source import Source
from worldstate.frontend.array.steering import cross_spectra
from worldstate.frontend.spectra.stft import StreamingStft, band_bins
from worldstate.ground import TINY
from worldstate.ground.typing import BoolArray, FloatArray

# Measured on ten simulated minutes of a calm street (SB1, seed 5) and ten of a town (TA1, seed 6), with seven
# microphones: these values keep 27 % and 56 % of the seconds, 7 of 7 and 25 of 25 onsets, and the 2 s before
# T0 of 9 of 9 and 32 of 36 vehicles. 2 dB and 0.05 keep 46 % and 68 % of the seconds, the same onsets, and 9
# and 34 vehicles.
LOUDER_DB, MORE_COHERENT, USUAL = 3.0, 0.08, 20.0  # The last is a percentile of the seconds
BEFORE_S, AFTER_S = 3, 2  # A sequence uses 3 s
_MICROPHONES, _BAND_HZ = 4, (150.0, 1500.0)
_FRAME_S = 0.04
# One recording in this many is processed fully, to measure which of its approaches the cascade keeps.
SAMPLED = 20


def kept_seconds(source: Source) -> BoolArray:
    """Return which seconds of a recording are selected, shape (n,)."""
    told, n_microphones = [], source.array.n_microphones
    with open_sound(source.sound, n_microphones, channels=source.array.channels, strict=False) as audio:
        rate_hz = audio.sample_rate_hz
        nfft = 1 << round(np.log2(_FRAME_S * rate_hz))
        chosen = np.unique(np.linspace(0, audio.channels - 1, _MICROPHONES).round().astype(int))
        stft = StreamingStft(len(chosen), nfft, band_bins(_BAND_HZ, rate_hz, nfft))
        for block in audio.blocks(rate_hz):
            told.append(_level_and_coherence(stft.push(np.ascontiguousarray(block[:, chosen]))))
    marks = np.array(told)
    above = marks - np.percentile(marks, USUAL, axis=0) > (LOUDER_DB, MORE_COHERENT)
    return np.convolve(above.any(axis=1), np.ones(BEFORE_S + AFTER_S + 1))[BEFORE_S:][: len(marks)] > 0.0


def _level_and_coherence(frames: np.ndarray) -> FloatArray:
    r"""Return the level in dB and the mean over bins and pairs of :math:`|S_{mn}| / \sqrt{S_{mm} S_{nn}}`."""
    if not len(frames):  # The last block may be shorter than a frame
        return np.zeros(2)
    cross = np.abs(cross_spectra(frames.transpose(1, 0, 2)))
    powers = np.diagonal(cross, axis1=1, axis2=2)
    first, second = np.triu_indices(frames.shape[2], 1)
    coherence = cross[:, first, second] / np.sqrt(powers[:, first] * powers[:, second] + TINY**2)
    return np.array([10.0 * np.log10(powers.mean() / len(frames) + TINY), coherence.mean()])
