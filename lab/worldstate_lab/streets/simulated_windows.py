"""Labelled feature windows of simulated junctions, laid out as the released real ones.

The program released with the real recordings says where its windows lie. With a standing ego the hazard and
hazard-free windows end at T0, the frame of the 10-Hz video in which the vehicle comes into sight; with a
moving ego they end 0.5 s later. The front window ends 1.5 s after the first. Rendered at a quarter of the
array's rate with a quarter of the frame length, which leaves the feature's bins (50-1500 Hz) where they are.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np
import scipy.signal

from worldstate.adapters.datasets.feature_extraction import WINDOW_S, window_ends_s
from worldstate.adapters.datasets.feature_table import FeatureTable
from worldstate.adapters.datasets.ovad import FRAME_RATE_HZ
from worldstate.frontend.array.microphone_array import MicrophoneArray, ovad_array
from worldstate.frontend.array.steering import cross_spectra, one_blas_thread
from worldstate.frontend.direction.feature import (
    FEATURE_BAND_HZ,
    FEATURE_RATE_HZ,
    FEATURE_SEGMENTS,
    feature_nfft,
    feature_steering,
    pair_sum_of,
    segment_feature,
)
from worldstate.frontend.spectra.stft import band_bins, whiten
from worldstate.ground.checks import in_range
from worldstate.ground.typing import Complex64Array, Float32Array, FloatArray
from worldstate.simulation.dataset.recording import simulate_recording
from worldstate.simulation.parallel import in_processes
from worldstate.simulation.scene.junction import SITES
from worldstate.simulation.scene.presets import Preset, preset
from worldstate.simulation.scene.settings import SimulationSettings, draw_settings

DECIMATION = 4
RATE_HZ = FEATURE_RATE_HZ / DECIMATION
NFFT = feature_nfft(RATE_HZ)
# Changes whenever a window of the same seed would be another one.
LAYOUT = 3
# The first window is a second long and ends at T0 at the earliest; the last ends a frame (.1 s), a moving
# ego's delay (.5 s) and the front window's (1.5 s) after it.
ENTRY_S, DURATION_S = 1.65, 3.8
FRAME_S = 1.0 / FRAME_RATE_HZ
MAX_PER_CLASS = 1000
# Any permutation will do; one and the same, or seeds would differ by their arrays.
PERMUTATION = 56


@dataclass(frozen=True, slots=True)
class WindowPlan:
    """One simulated recording, from which one or two windows are cut."""

    number: int
    environment: str
    approach: str
    seed: np.random.SeedSequence


def simulated_window_pair(
    per_approach: int,
    seed: int,
    *,
    sites: Sequence[str] = SITES,
    jobs: int = 1,
    levels: Preset | None = None,
    progress: Callable[[], None] = lambda: None,
) -> tuple[FeatureTable, FeatureTable]:
    """Simulate windows of junctions: their features, and those with the microphones' positions permuted."""
    in_range("per_approach", per_approach, 1, MAX_PER_CLASS)
    in_range("jobs", jobs, 1, 256)
    rows = []
    work = partial(windows_of_recording, preset() if levels is None else levels)
    for found in in_processes(work, _plans(per_approach, seed, sites), jobs):
        rows += found
        progress()
    features, labels, environments, recordings = zip(*rows, strict=True)
    keys = np.array(recordings)
    about = np.array(labels), keys, np.array(environments), keys, (None,) * len(rows)
    right, permuted = np.array(features).transpose(1, 0, 2)
    return FeatureTable(right, *about), FeatureTable(permuted, *about)


# Features (2, 60), class, junction, recording.
Row = tuple[FloatArray, str, str, str]


def _plans(per_approach: int, seed: int, sites: Sequence[str]) -> list[WindowPlan]:
    approaches = ["left", "right", "none", "none"] * per_approach
    wanted = [(name, approach) for name in sites for approach in approaches]
    seeds = np.random.SeedSequence(seed).spawn(len(wanted))
    return [WindowPlan(i, *what, child) for i, (what, child) in enumerate(zip(wanted, seeds, strict=True))]


def windows_of_recording(levels: Preset, plan: WindowPlan) -> list[Row]:
    """Simulate one recording and return the features of its windows by right and permuted positions."""
    rng = np.random.default_rng(plan.seed)
    scene = _scene(plan, levels, rng)
    first_frame_s = ENTRY_S + float(rng.uniform(0.0, FRAME_S))
    audio = simulate_recording(scene, rng).audio
    ends = window_ends_s(plan.approach, first_frame_s, not scene.ego.stands)
    about = (plan.environment, str(plan.number))
    arrays = ovad_array(), permuted_array()
    return [
        (window_features(_cut(audio, end - WINDOW_S), arrays), label, *about) for label, end in ends.items()
    ]


def _scene(plan: WindowPlan, levels: Preset, rng: np.random.Generator) -> SimulationSettings:
    """Draw a scene in which the vehicle, or the end of a hazard-free window, comes at `ENTRY_S`."""
    drawn = draw_settings(plan.environment, plan.approach, rng, DURATION_S)
    ego = drawn.ego
    if not ego.stands:
        ego = replace(ego, stop_s=ego.stop_s - drawn.entry_s + ENTRY_S)
    return replace(drawn, entry_s=ENTRY_S, ego=ego, sample_rate_hz=RATE_HZ, preset=levels)


def _cut(audio: Float32Array, start_s: float) -> Float32Array:
    first = round(start_s * RATE_HZ)
    return audio[first : first + round(WINDOW_S * RATE_HZ)]


@lru_cache(maxsize=1)
def permuted_array() -> MicrophoneArray:
    """Return OVAD's positions dealt to other channels, once for all: an array whose geometry is wrong."""
    positions = ovad_array().positions_m
    return MicrophoneArray(positions[np.random.default_rng(PERMUTATION).permutation(len(positions))])


def window_features(samples: Float32Array, arrays: Sequence[MicrophoneArray]) -> FloatArray:
    """Compute the published feature of a window at `RATE_HZ` by each array, shape (n, 56) -> (arrays, 60)."""
    bins = band_bins(FEATURE_BAND_HZ, RATE_HZ, NFFT)
    spectra = scipy.signal.stft(samples, nperseg=NFFT, axis=0)[2][bins.start : bins.stop]
    whitened = whiten(np.ascontiguousarray(spectra.transpose(2, 0, 1), np.complex64))
    length = len(whitened) // FEATURE_SEGMENTS
    with one_blas_thread():
        matrices = [
            cross_spectra(whitened[i * length :][:length].transpose(1, 0, 2)) for i in range(FEATURE_SEGMENTS)
        ]
        return np.array([_feature(matrices, array, bins, length) for array in arrays])


def _feature(matrices: list[Complex64Array], array: MicrophoneArray, bins: range, length: int) -> FloatArray:
    steering = feature_steering(array, bins, RATE_HZ, NFFT)
    sums = [pair_sum_of(one, steering) for one in matrices]
    return np.concatenate([segment_feature([s], length, len(bins), array.n_microphones) for s in sums])
