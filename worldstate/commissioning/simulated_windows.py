"""Labelled windows from processed streams, and a window model trained on them.

Streams contain situations that single recordings lack: vehicles from both sides at once or one behind
another, and hours of distant vehicles and of vehicles in plain view, which are no hazards.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy.signal

from worldstate.abduction.sequence.sequence_inputs import HOP_S, SIDES
from worldstate.abduction.signature.ensemble import KINDS, EnsembleModel, log_levels, site_reference
from worldstate.abduction.signature.ensemble_training import OPEN_FIELD, SimulatedWindows
from worldstate.abduction.signature.site_estimate import SiteEstimate, SiteEstimateSettings
from worldstate.abduction.signature.window_classes import BOTH, DIRECT
from worldstate.adapters.datasets.feature_table import N_FEATURES, FeatureTable
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.array.steering import one_blas_thread
from worldstate.frontend.direction.feature import FEATURE_BAND_HZ, feature_nfft
from worldstate.frontend.settings import FrontEndSettings
from worldstate.frontend.stream import FrontEnd
from worldstate.ground.parallel import in_processes
from worldstate.ground.typing import BoolArray, Float32Array, FloatArray, IndexArray, TextArray
from worldstate.operations.training.site_references import simulated_beside, with_site_references
from worldstate.operations.training.training import fit_ensemble
from worldstate.simulation.scene.junction import open_road
from worldstate.simulation.scene.presets import preset
from worldstate.simulation.scene.settings import EGO_SPEEDS_MPS
from worldstate.simulation.sound.delay import KNOT_SAMPLES
from worldstate.simulation.sound.ego_sound import ego_noise
from worldstate.simulation.sound.propagation import add_sources
from worldstate.simulation.sound.receiver import Receiver, standing_m
from worldstate.simulation.sound.renderers import add_ambience
from worldstate.simulation.sound.static_field import StaticSources, StreetSound

from .heard_stream import HeardStream
from .sequence_training import SILENT_KINDS

UNUSED = ""
# A window is hidden if it ends at most a second before a vehicle comes into view. If a second vehicle comes
# within 2.5 s, it is equally loud.
HIDDEN_S, SECOND_S = 1.0, 2.5
# Delay of the windows of a moving ego, whose released hidden windows end half a second after T0.
MOVING_LATE_S = 0.5
# A window is in view from half a second after the vehicle's arrival (the released front windows end 1.5 s
# after it). A vehicle farther away is hardly audible. Until a second after a vehicle has left, windows get no
# other class.
FRONT_S, NEAR_M, WINDOW_S = (0.5, 0.0), 25.0, 1.0
# A window is empty if no vehicle comes within this time, and none came in the second before.
CALM_S = 5.0


# Shortest intervals between windows: hidden ones, which overlap, and the others, which are the majority.
EVERY_S, REST_EVERY_S = 0.5, 10.0
# Weight of a hidden window relative to a real one; all windows in view, and all empty ones, weigh as much as
# all hidden ones. The sides of real and simulated hazards have different patterns, and this weight is a
# compromise: at 0.15, 0.3, 0.6 and 0.9 the side is right in 77, 88, 94 and 94 % of the windows of streams,
# and in 91, 91, 82 and 76 % of real windows at left-out junctions, with the same AUROC. If a quarter of the
# weight is given to the other side, as in windows of simulated recordings, it is 77 and 94 % at 0.3.
WEIGHT = 0.3


def hop_labels(stream: HeardStream) -> TextArray:
    """Return the class of the second before each hop, shape (n,); empty if there is no clear class."""
    left, right = (_comes_within(stream, HIDDEN_S, side) for side in SIDES)
    left_soon, right_soon = (_comes_within(stream, SECOND_S, side) for side in SIDES)
    both = (left & right_soon) | (right & left_soon)
    late_s = MOVING_LATE_S if stream.ego_moves else 0.0
    near, lately = _in_view(stream, FRONT_S[0] + late_s, FRONT_S[1]), _in_view(stream, 0.0, WINDOW_S)
    # The hop at which a vehicle comes into view is still its last hidden one.
    covered = _in_view(stream, late_s + 0.5 * HOP_S, WINDOW_S)
    anyone = _comes_within(stream, CALM_S) | _comes_within(stream, CALM_S, quiet=True)
    calm = ~anyone & ~lately
    # A vehicle in view masks one behind it, so the window is a clean example of neither.
    clean = ~covered & ~_comes_within(stream, SECOND_S, quiet=True)
    one = (left & ~right_soon & clean, right & ~left_soon & clean)
    known = (both & clean, *one, near & ~anyone, calm)
    return np.select(known, (BOTH, "left", "right", "front", "none"), UNUSED)


def stream_windows(streams: Sequence[HeardStream]) -> SimulatedWindows:
    """Cut windows from streams, with a reference of all windows of the same site."""
    cut = [_cut(stream) for stream in streams]
    features = np.concatenate([stream.hops.feature[rows] for stream, rows, _ in cut]).astype(np.float64)
    sites = np.concatenate([np.full(len(rows), stream.site) for stream, rows, _ in cut])
    labels = np.concatenate([names for _, _, names in cut])
    references = np.empty((len(sites), 3 * features.shape[1]))
    for site in np.unique(sites):
        references[sites == site] = site_reference(log_levels(features[sites == site]))
    weights = WEIGHT * _balance(labels)
    # A hazard has all its weight on its own side: see `WEIGHT`.
    return SimulatedWindows(np.hstack([features, references]), labels, sites, weights, np.zeros(len(labels)))


def _cut(stream: HeardStream) -> tuple[HeardStream, IndexArray, TextArray]:
    labels, time = hop_labels(stream), stream.hops.time_s
    rows = []
    for name in np.unique(labels[labels != UNUSED]):
        apart = REST_EVERY_S if name in ("none", "front") else EVERY_S
        rows.append(_thinned(np.flatnonzero(labels == name), time, apart))
    kept = np.sort(np.concatenate(rows)) if rows else np.zeros(0, np.intp)
    return stream, kept, labels[kept]


def _balance(labels: TextArray) -> FloatArray:
    """Return weights with equal sums for hidden, in view and empty, as in the released windows."""
    weights, hidden = np.ones(len(labels)), np.isin(labels, (*SIDES, BOTH))
    for name in ("front", "none"):
        here = labels == name
        weights[here] = hidden.sum() / max(here.sum(), 1)
    return weights


def _thinned(rows: IndexArray, time_s: FloatArray, apart_s: float) -> IndexArray:
    """Return rows at least this far apart; the last one, just before a vehicle is visible, is kept."""
    kept: list[int] = []
    for row in rows[::-1].tolist():
        if not kept or time_s[kept[-1]] - time_s[row] >= apart_s - 1e-6:
            kept.append(row)
    return np.array(kept[::-1], np.intp)


def _comes_within(stream: HeardStream, seconds: float, side: str = "", *, quiet: bool = False) -> BoolArray:
    """Return the hops before a vehicle, or a quiet one, comes into view from a hidden arm, shape (n,)."""
    vehicles = stream.vehicles
    asked = vehicles.hazard & (np.isin(vehicles.kind, SILENT_KINDS) == quiet)
    entries = vehicles.entry_s[asked & ((vehicles.arm == side) | (side == ""))]
    left_s = entries[None, :] - stream.hops.time_s[:, None]
    latest_s = -MOVING_LATE_S if stream.ego_moves else 0.0
    return np.asarray(((left_s >= latest_s) & (left_s <= seconds)).any(axis=1))


def _in_view(stream: HeardStream, after_s: float, stays_s: float) -> BoolArray:
    """Return the hops between given times after a near vehicle's arrival and departure, shape (n,)."""
    rows, time = stream.rows, stream.hops.time_s
    near = np.zeros(len(time), np.bool_)
    seen = stream.in_view_within(NEAR_M)
    for number in np.unique(rows.vehicle[seen]):
        mine = rows.time_s[seen & (rows.vehicle == number)]
        near |= (time >= mine[0] + after_s) & (time <= mine[-1] + stays_s)
    return near


def learned_beside(
    streams: Sequence[HeardStream], open_field: SimulatedWindows, tables: Sequence[FeatureTable] = ()
) -> SimulatedWindows:
    """Return windows of streams, of sources in the open and of simulated recordings together."""
    recordings = [simulated_beside(tables)] if tables else []
    return SimulatedWindows.joined([*recordings, stream_windows(streams), open_field])


def window_model(table: FeatureTable, beside: SimulatedWindows | None) -> EnsembleModel:
    """Fit a window model to a table and to additional windows."""
    return replace(fit_ensemble(with_site_references(table), beside), domain=table.domain)


def posteriors_along(model: EnsembleModel, features: FloatArray) -> FloatArray:
    """Return the posteriors of `SiteSignature` hop by hop along a stream, shape (n, classes).

    Shapes: features (n, 60).
    """
    chosen, estimate = SiteEstimateSettings(), SiteEstimate.start(model.n_features)
    references = np.empty((len(features), model.home.size))
    for row, feature in enumerate(np.asarray(features, np.float64)):
        references[row] = estimate.reference(model)
        estimate = estimate.updated(feature, HOP_S, chosen)
    return model.posteriors(log_levels(features), references)


# 180 windows with a weight of 0.1 reduced those with p > 0.5 for the other side from 39 to 3 % (prototype).
# With more windows, or more weight, real hidden vehicles are classified as direct.
N_OPEN, OPEN_WEIGHT = 180, 1.0
RATE_HZ = 6000.0
SNR_DB = (-6.0, 25.0)
DISTANCES_M, SPEEDS_MPS, MOVING_SHARE = (5.0, 60.0), (2.0, 12.0), 0.5
# Engines and tyres fall by 0 to 9 dB per octave in the band of the feature.
_SLOPES_DB = (0.0, 9.0)
# Emission starts this long before reception, because sound takes 0.18 s over 60 m.
_HEAD_S, _WINDOW_S, _SCALE_PA = 0.4, 1.0, 20.0


@dataclass(frozen=True, slots=True)
class OpenSource:
    """One source in the open: its position in the middle of the window, its motion and its level.

    It does not depend on a site. Such windows train a model on sources whose bearing is their true direction.
    """

    azimuth_rad: float
    distance_m: float
    velocity_mps: tuple[float, float]
    snr_db: float  # Level above the ambience, in the band of the feature


def drawn_source(rng: np.random.Generator) -> OpenSource:
    """Draw a source at any azimuth; half of the sources are at rest.

    Examples
    --------
    >>> SNR_DB[0] <= drawn_source(np.random.default_rng(1)).snr_db <= SNR_DB[1]
    True
    """
    speed = rng.uniform(*SPEEDS_MPS) if rng.random() < MOVING_SHARE else 0.0
    heading = rng.uniform(-np.pi, np.pi)
    azimuth_rad, distance_m = rng.uniform(-np.pi, np.pi), float(np.exp(rng.uniform(*np.log(DISTANCES_M))))
    velocity_mps = speed * np.cos(heading), speed * np.sin(heading)
    return OpenSource(azimuth_rad, distance_m, velocity_mps, rng.uniform(*SNR_DB))


def open_field_features(
    array: MicrophoneArray, n: int, rng: np.random.Generator, jobs: int = 1, moving_ego: bool = False
) -> FloatArray:
    """Return the features of n windows of drawn sources in the open, shape (n, 60)."""
    return np.array(list(in_processes(partial(_drawn_feature, array, moving_ego), rng.spawn(n), jobs)))


def _drawn_feature(array: MicrophoneArray, moving_ego: bool, rng: np.random.Generator) -> FloatArray:
    return open_feature(array, drawn_source(rng), rng, rng.uniform(*EGO_SPEEDS_MPS) if moving_ego else 0.0)


def open_field_windows(features: FloatArray) -> SimulatedWindows:
    """Return windows in the open for training: class direct, without a site reference.

    Shapes: features (n, 60).
    """
    n = len(features)
    nowhere = np.full((n, len(KINDS) * N_FEATURES), np.nan)
    names = np.full(n, DIRECT), np.full(n, OPEN_FIELD)
    return SimulatedWindows(np.hstack([features, nowhere]), *names, np.full(n, OPEN_WEIGHT), np.zeros(n))


def open_feature(
    array: MicrophoneArray, source: OpenSource, rng: np.random.Generator, ego_mps: float = 0.0
) -> FloatArray:
    """Render a second of one source in the open and return its feature, shape (60,)."""
    blocks = -(-round(_WINDOW_S * RATE_HZ) // KNOT_SAMPLES)
    knots = np.arange(blocks + 1) * KNOT_SAMPLES / RATE_HZ
    skew = preset().delay_mismatch_s * rng.standard_normal(array.n_microphones)
    receiver = Receiver(standing_m(array), skew, knots)
    sound, ambience = np.zeros((2, array.n_microphones, receiver.samples), np.float32)
    with one_blas_thread():
        _add_source(sound, source, receiver, rng)
        add_ambience(ambience, receiver, open_road().site, preset(), rng)
    if ego_mps:
        # The ego's own noise is part of the background; the motion of the array is left out.
        speed = np.full(receiver.samples, ego_mps)
        ambience += ego_noise(receiver.positions_m, speed, RATE_HZ, rng, preset().ego_engine_db).T
    gain = 10.0 ** (source.snr_db / 20.0) * _level(ambience) / _level(sound)
    heard = (ambience + np.float32(gain) * sound)[:, : round(_WINDOW_S * RATE_HZ)]
    front_end = FrontEnd(array, RATE_HZ, FrontEndSettings(nfft=feature_nfft(RATE_HZ), watch_channels=False))
    return np.asarray(front_end.process(np.clip(heard.T / _SCALE_PA, -1.0, 1.0))[-1].feature)


def _add_source(out: Float32Array, source: OpenSource, receiver: Receiver, rng: np.random.Generator) -> None:
    blocks = int((_HEAD_S + _WINDOW_S) * RATE_HZ) // KNOT_SAMPLES + 1
    knots = -_HEAD_S + np.arange(blocks + 1) * KNOT_SAMPLES / RATE_HZ
    since = knots - 0.5 * _WINDOW_S
    x = source.distance_m * np.cos(source.azimuth_rad) + source.velocity_mps[0] * since
    y = source.distance_m * np.sin(source.azimuth_rad) + source.velocity_mps[1] * since
    street = StreetSound(StaticSources(out, RATE_HZ), open_road().site, preset(), receiver)
    add_sources(street, [street.source(_tilted(blocks * KNOT_SAMPLES, rng), knots, (x, y))])
    street.static.render()


def _tilted(samples: int, rng: np.random.Generator) -> Float32Array:
    """Draw noise with a random slope; below 50 Hz it is flat."""
    frequency = np.maximum(np.fft.rfftfreq(samples, 1.0 / RATE_HZ), FEATURE_BAND_HZ[0])
    shape = (frequency / FEATURE_BAND_HZ[0]) ** (-rng.uniform(*_SLOPES_DB) / 6.02)
    return np.asarray(np.fft.irfft(np.fft.rfft(rng.standard_normal(samples)) * shape, samples), np.float32)


def _level(sound: Float32Array) -> float:
    band = scipy.signal.butter(4, FEATURE_BAND_HZ, "bandpass", fs=RATE_HZ, output="sos")
    return float(np.sqrt(np.square(scipy.signal.sosfilt(band, sound)).mean()))
