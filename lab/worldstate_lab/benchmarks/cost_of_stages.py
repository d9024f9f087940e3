"""What the front-end does for every hop, part by part, with a clock between."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worldstate.frontend.approach.looming import looming
from worldstate.frontend.approach.tone import ENGINE_BAND_HZ, ToneStage
from worldstate.frontend.array.microphone_array import ChannelMask, roof_array_56
from worldstate.frontend.array.steering import Steering, cross_spectra
from worldstate.frontend.direction.bearing import find_peaks
from worldstate.frontend.direction.feature import feature_steering, pair_sum_of, segment_feature
from worldstate.frontend.direction.music import MusicStage
from worldstate.frontend.direction.srp import normalised, steered_power
from worldstate.frontend.health.channel_monitor import ChannelMonitor
from worldstate.frontend.levels import LevelMeter
from worldstate.frontend.settings import FrontEndSettings
from worldstate.frontend.spectra.stft import StreamingStft, bin_frequencies_hz, power, whiten
from worldstate.ground.typing import Float32Array

from .stopwatch import Milliseconds, elapsed_ms

RATE_HZ, NFFT = 47_998, 512
SRP_BINS, FEATURE_BINS = range(3, 19), range(1, 16)
AZIMUTHS_RAD = np.radians(np.arange(-90.0, 91.0))
GOAL = ("stft", "phat", "srp181_new_frames", "srp181_running_second", "feature")
"""Stages of the first goal, in milliseconds."""
MORE = ("peaks", "bands", "looming", "tone", "music", "channel_watching")
"""Stages that `everything` adds to them."""


def srp_beams() -> Steering:
    """Beams of the search grid, 300-1800 Hz.

    Examples
    --------
    >>> srp_beams().n_directions
    181
    """
    return Steering.towards(roof_array_56(), bin_frequencies_hz(SRP_BINS, RATE_HZ, NFFT), AZIMUTHS_RAD)


def stage_times(hops: list[Float32Array]) -> dict[str, Milliseconds]:
    """Time every stage on every hop, in turn, as the stream does them.

    Shapes: hops (n, 56).
    """
    stages = _Stages()
    times: dict[str, Milliseconds] = {name: [] for name in (*GOAL, *MORE, "goal")}
    for samples in hops:
        for name, stage in stages.of(samples):
            times[name].append(elapsed_ms(stage))
        times["goal"].append(sum(times[name][-1] for name in GOAL))
    return times


class _Stages:
    """The state of every stage, and what one hands to the next."""

    def __init__(self) -> None:
        array, everyone = roof_array_56(), ChannelMask.all_of(56)
        self._mask = everyone
        self._stft = StreamingStft(56, NFFT, range(1, 19))
        self._beams, self._feature_beams = srp_beams(), feature_steering(array, FEATURE_BINS, RATE_HZ)
        self._meter = LevelMeter(56, RATE_HZ, FrontEndSettings())
        self._tone = ToneStage(array, RATE_HZ, ENGINE_BAND_HZ)
        self._music = MusicStage([self._beams], AZIMUTHS_RAD, 1, 56, window_hops=10)
        self._monitor = ChannelMonitor(array, bin_frequencies_hz(FEATURE_BINS, RATE_HZ, NFFT), RATE_HZ)
        self._powers: list[NDArray[Any]] = []
        self._pairs: list[NDArray[Any]] = []
        self._energies: list[NDArray[Any]] = []

    def of(self, samples: Float32Array) -> list[tuple[str, Callable[[], object]]]:
        """Return the stages of one hop, to be called in this order."""
        return [
            ("stft", partial(self._transform, samples)),
            ("phat", self._whiten),
            ("srp181_new_frames", self._steer),
            ("srp181_running_second", self._sum),
            ("feature", self._feature),
            ("peaks", lambda: find_peaks(self._srp, AZIMUTHS_RAD)),
            ("bands", lambda: self._meter.push(samples)),
            ("looming", self._loom),
            ("tone", partial(self._fit_tone, samples)),
            ("music", self._score),
            ("channel_watching", partial(self._watch, samples)),
        ]

    def _transform(self, samples: Float32Array) -> None:
        self._spectra = self._stft.push(samples)

    def _whiten(self) -> None:
        self._power = power(self._spectra)
        self._whitened = whiten(self._spectra, self._power)

    def _steer(self) -> None:
        self._powers = [*self._powers[-9:], steered_power(self._whitened[:, 2:18], self._beams)]

    def _sum(self) -> None:
        self._srp = normalised(np.sum(self._powers, axis=0), 187, len(SRP_BINS), 56)

    def _feature(self) -> None:
        self._matrices = cross_spectra(self._whitened[:, 0:15].transpose(1, 0, 2))
        self._pairs = [*self._pairs[-9:], pair_sum_of(self._matrices, self._feature_beams)]
        halves = self._pairs[:5], self._pairs[-5:]
        np.concatenate([segment_feature(half, 94, len(FEATURE_BINS), 56) for half in halves])

    def _loom(self) -> None:
        self._energies = [*self._energies[-9:], self._power[:, 2:18].sum(axis=1, dtype=np.float64)]
        means = np.array([energies.mean() for energies in self._energies])
        if len(means) == 10:
            looming(np.arange(-0.95, 0.0, 0.1), np.log(means), floor_std=0.08)

    def _fit_tone(self, samples: Float32Array) -> None:
        self._tone.push(samples, self._mask)
        self._tone.read()

    def _score(self) -> None:
        self._music.push(self._spectra[:, 2:18])
        self._music.read(self._mask)

    def _watch(self, samples: Float32Array) -> None:
        self._monitor.push(samples, self._energies[-1], self._power, self._matrices)
