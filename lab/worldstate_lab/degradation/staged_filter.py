"""Filter results on recordings and streams in staged states: dry or rainy sound, clean or degraded camera.

A sweep over images needs recordings with video, and processing an hour of them takes hours. On a stream, the
boxes of the camera are degraded instead: each is removed with the probability in the table of miss rates for
the degradation, which the camera reports.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from worldstate.abduction.co_evidence import MissRateTable, default_miss_rates
from worldstate.adapters.acoustic import asked_again
from worldstate.adapters.camera.box_linking import overlaps
from worldstate.adapters.camera.camera_health import DegradationLog
from worldstate.adapters.camera.detections import (
    DetectionFilter,
    DetectionFrame,
    DetectionLog,
    kept_and_parked,
)
from worldstate.adapters.camera.miss_rates import MissRates
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.vision_query import MAX_IMAGE_AGE_S, VisionQuery
from worldstate.adapters.files.model_file import read_model
from worldstate.adapters.listener import measure_steps
from worldstate.adapters.source import Source, open_source, unoccluded_sector
from worldstate.core.filter import WorldFilter
from worldstate.frontend.array.steering import one_blas_thread
from worldstate.ground.typing import BoolArray, FloatArray
from worldstate.ground.values import SECONDS_PER_HOUR, nanoseconds
from worldstate.measurement.measurement import Measurement
from worldstate.operations.detectors.miss_rate_measurement import MIN_OVERLAP
from worldstate.operations.metrics.approach_table import poisson_interval, rising_edges
from worldstate.operations.recordings.hop_table import HOP_S, HopTable, hop_stream, joined
from worldstate_lab.metrics.intervals import middle, poisson_upper, stratified_draws

from .awareness import Estimate
from .conditions import (
    CLEAN,
    LENS,
    OFF,
    RAIN,
    RAIN_DB,
    READINGS,
    ROOF,
    Condition,
    StagedDetector,
    all_conditions,
    degradation_in,
    detections_in,
    level_rms,
    rained,
)

# Increased whenever the same sound and looks would give different beliefs.
VERSION = 7


@dataclass(frozen=True, slots=True)
class Camera:
    """One detector on the camera of one recording."""

    detector: StagedDetector
    rates: MissRates  # Miss rates of this detector, measured on other recordings
    boxes: HopTable  # Its detections; see `conditions.look`
    readings: HopTable  # Quality of the images

    def look(self, source: Source, images: str, d: DegradationLog) -> VisionQuery:
        """Return the channel to be queried in a condition of the camera."""
        return VisionQuery(
            source.camera,
            detections_in(self.boxes, images),
            self.rates.table,
            d,
            self.detector.keep,
            unoccluded_sector(source.context),
            self.rates.clutter_rate,
        )


def cameras(
    detectors: Iterable[StagedDetector], rates: Mapping[str, MissRates], looks: Mapping[str, HopTable]
) -> list[Camera]:
    """Return every detector with its detections in one recording."""
    return [Camera(one, rates[one.name], looks[one.name], looks[READINGS]) for one in detectors]


def filter_in_conditions(
    source: Source,
    behind: Sequence[Camera],
    seed: Sequence[int],
    conditions: Sequence[Condition] = all_conditions(),
) -> dict[str, HopTable]:
    """Return the filter's results on one recording with each detector, all conditions concatenated.

    Columns are those of a hop stream and four more. `condition` is the name. `degradation` is the estimated
    d. `presence` is the probability of a hidden or visible vehicle, from the entities that the filter
    publishes. `found` is true if a moving object in view was detected, whereas `seen` is true for any
    detection.
    """
    rms = level_rms(source)
    with one_blas_thread():
        levels = sorted({state.sound_level for state in conditions})
        heard = {level: _heard(source, level, rms, seed) for level in levels}
        reference = _reference(source, [one.stamp_ns for one in next(iter(heard.values()))])
        return {
            one.detector.name: joined(
                _filtered(source, one, heard[state.sound_level], reference, state) for state in conditions
            )
            for one in behind
        }


def _heard(source: Source, level: int, dry_rms: float, seed: int | Sequence[int]) -> list[Measurement]:
    """Return the measurements of a recording or stream at a level of rain on the roof."""
    # The same noise at every level, only louder, so that differences between levels do not come from the
    # noise.
    wet = rained(source, level, dry_rms, np.random.default_rng(seed)) if level else source
    return [measured for _, measured in measure_steps(wet)]


def by_condition(filtered: HopTable) -> dict[str, HopTable]:
    """Split the concatenated conditions of `filter_in_conditions`."""
    names = filtered.columns["condition"]
    first = np.sort(np.unique(names, return_index=True)[1])
    parts = {
        key: np.split(column, first[1:]) for key, column in filtered.columns.items() if key != "condition"
    }
    return {
        str(names[start]): replace(filtered, columns={key: split[i] for key, split in parts.items()})
        for i, start in enumerate(first)
    }


def _filtered(
    source: Source,
    camera: Camera,
    measured: Sequence[Measurement],
    reference: Sequence[FloatArray],
    state: Condition,
) -> HopTable:
    stamps_ns = [one.stamp_ns for one in measured]
    query, found, d = None, np.zeros(len(measured), bool), np.ones(len(measured))
    if state.family != OFF:
        read = degradation_in(camera.readings, state.camera.name, camera.rates)
        query = camera.look(source, state.camera.name, read)
        found, d = _found(reference, query, stamps_ns), np.array([read(stamp_ns) for stamp_ns in stamps_ns])
    asked = [asked_again(one, query) for one in measured]
    there = [any(sighting.moving for sighting in m.sightings) for m in measured]
    return hop_stream(asked, name=state.name, there=there).replace(
        presence=np.array(_presence(source, asked)),
        found=found,
        degradation=d,
        condition=np.full(len(asked), state.name),
    )


def _reference(source: Source, stamps_ns: Sequence[int]) -> list[FloatArray]:
    """Return the moving reference boxes at each stamp."""
    if source.detections is None:
        return [np.empty((0, 4))] * len(stamps_ns)
    return _moving_boxes(source.detections, stamps_ns, DetectionFilter())


def _moving_boxes(log: DetectionLog, stamps_ns: Sequence[int], keep: DetectionFilter) -> list[FloatArray]:
    """Return the accepted moving boxes, shape (boxes, 4), of the frame at each stamp."""
    longest_ns, found = nanoseconds(MAX_IMAGE_AGE_S), []
    for number in (log.latest(stamp_ns, longest_ns) for stamp_ns in stamps_ns):
        boxes_px = np.empty((0, 4))
        if number is not None:
            kept, still = kept_and_parked(log, number, keep)
            boxes_px = log.frames[number].boxes_px[kept[~still]]
        found.append(boxes_px)
    return found


def _found(reference: Sequence[FloatArray], query: VisionQuery, stamps_ns: Sequence[int]) -> BoolArray:
    """Return whether a moving reference box was detected at each stamp, counted as for a miss rate."""
    detected = _moving_boxes(query.detections, stamps_ns, query.keep) if query.detections else []
    found = [
        (overlaps(there, boxes) >= MIN_OVERLAP).any()
        for there, boxes in zip(reference, detected, strict=True)
    ]
    return np.array(found, dtype=bool)


def _presence(source: Source, measurements: Sequence[Measurement]) -> list[float]:
    r"""Return the probability of any vehicle at every hop, :math:`1 - \prod_i (1 - r_i)`.

    It uses the entities and not the explanations: entities keep the evidence of the camera and of the
    sequence while the current window is uninformative.
    """
    world, presence = WorldFilter(context=source.context, policy=source.policy), []
    for measurement in measurements:
        world = world.predict_to(measurement.stamp_ns).update(measurement)
        absent = (1.0 - one.existence_probability for one in world.state.entities if one.moving)
        presence.append(1.0 - math.prod(absent))
    return presence


# Increased whenever the same stream would give different advisories.
STREAM_VERSION = 3
# Half and full degradation for the camera; only the heaviest rain, because each level needs a pass over the
# sound.
STATES = (
    Condition(CLEAN),
    Condition(LENS, 2),
    Condition(LENS, 4),
    Condition(OFF),
    Condition(ROOF, 4),
    Condition(RAIN, 4),
)
# Onsets come in bursts, so minutes are resampled and not onsets.
_PIECE_HOPS = round(60.0 / HOP_S)


@dataclass(frozen=True, slots=True)
class FalseAdvisories:
    """One state of camera and rain compared with the clean one, on the same hours."""

    name: str
    onsets: int
    per_hour: Estimate  # Onsets per hour with the exact interval
    upper_90: float  # Upper bound of the rate at a confidence of 0.9
    ratio: Estimate  # Ratio to the clean camera, over draws of minutes that are the same for both


@dataclass(frozen=True, slots=True)
class StreamSweep:
    """All states on the same hours."""

    hours: float
    rows: tuple[FalseAdvisories, ...]


def states_told() -> list[str]:
    """Return the settings that the advisories depend on, besides stream, model and seed."""
    return [*(state.name for state in STATES), *map(repr, RAIN_DB), repr(default_miss_rates())]


def staged_advisories(path: Path, model: Path | None, seed: int) -> HopTable:
    """Return the advisories of a stream in all states, concatenated: `condition`, `time_s`, `advised`."""
    source = open_source(path, model=read_model(model))
    with one_blas_thread():
        return joined(_advised(source, seed))


def stream_sweep(streams: Iterable[HopTable], seed: int) -> StreamSweep:
    """Count the onsets of every state, and compare them with those of the clean camera minute by minute."""
    parts = [[one.advised[one.condition == state.name] for state in STATES] for one in streams]
    hours = sum(flags[0].size for flags in parts) * HOP_S / SECONDS_PER_HOUR
    onsets = np.concatenate([np.stack([_by_minute(one) for one in flags], axis=1) for flags in parts])
    chosen = stratified_draws([0] * len(onsets), np.random.default_rng(seed))
    drawn = onsets[chosen].sum(axis=1)
    return StreamSweep(hours, tuple(_row(at, onsets.sum(axis=0), drawn, hours) for at in range(len(STATES))))


def _row(at: int, onsets: FloatArray, drawn: FloatArray, hours: float) -> FalseAdvisories:
    count = int(onsets[at])
    with np.errstate(divide="ignore", invalid="ignore"):
        share, shares = float(onsets[at] / onsets[0]), drawn[:, at] / drawn[:, 0]
    rate = Estimate(count / hours, *poisson_interval(count, hours))
    return FalseAdvisories(
        STATES[at].name, count, rate, poisson_upper(count, hours), Estimate(share, *middle(shares))
    )


def _by_minute(advised: BoolArray) -> FloatArray:
    minutes = rising_edges(advised) // _PIECE_HOPS
    return np.bincount(minutes, minlength=-(-advised.size // _PIECE_HOPS)).astype(np.float64)


def _advised(source: Source, seed: int) -> Iterator[HopTable]:
    rms, heard = level_rms(source), dict[int, list[Measurement]]()
    for state in STATES:
        level = state.sound_level
        if level not in heard:
            # One level at a time: the measurements of an hour need half a gigabyte.
            heard = {level: _heard(source, level, rms, seed)}
        yield _followed(source, heard[level], state, seed)


def _followed(source: Source, measured: Sequence[Measurement], state: Condition, seed: int) -> HopTable:
    """Return whether an advisory is on in a state, on either side, at every hop."""
    world, query, advised = source.world(), _query(source, state, seed), []
    for one in measured:
        world = world.predict_to(one.stamp_ns).update(asked_again(one, query))
        advised.append(any(cue.advisory is not None for cue in world.state.cues))
    times = np.array([one.stamp_ns for one in measured]) * 1e-9
    return HopTable(
        {"condition": np.full(len(times), state.name), "time_s": times, "advised": np.array(advised)}
    )


def _query(source: Source, state: Condition, seed: int) -> VisionQuery | None:
    """Return the camera of a state, which reports its degradation; None for no camera."""
    if state.family == OFF or source.detections is None:
        return None
    table, degradation = default_miss_rates(), state.degradation if state.family in (LENS, RAIN) else 0.0
    # The same random numbers in every state: an object that a better camera misses, a worse one misses too.
    rng = np.random.default_rng(seed)
    return VisionQuery(
        source.camera,
        missed(source.detections, source.camera, table, degradation, rng),
        table,
        degradation,
        source.settings.boxes,
        unoccluded_sector(source.context),
    )


def missed(
    detections: DetectionLog,
    camera: PinholeCamera,
    table: MissRateTable,
    degradation: float,
    rng: np.random.Generator,
) -> DetectionLog:
    r"""Return a log without the boxes that a camera with degradation d would also have missed.

    .. math:: P(missed \mid reported) = \frac{\beta(\theta, d) - \beta(\theta, 0)}{1 - \beta(\theta, 0)}
    """
    frames = []
    for frame in detections.frames:
        azimuths = np.array(
            [
                camera.sighting(box, label, float(score)).azimuth_rad
                for box, label, score in zip(frame.boxes_px, frame.labels, frame.scores, strict=True)
            ]
        )
        before, after = table.over(azimuths), table.over(azimuths, degradation)
        left = 1.0 - before
        # Outside the table nothing is detected, so nothing more can be missed.
        share = np.divide(after - before, left, out=np.zeros_like(left), where=left > 0.0)
        kept = np.flatnonzero(rng.random(len(azimuths)) >= share).tolist()
        frames.append(
            DetectionFrame(frame.boxes_px[kept], frame.scores[kept], tuple(frame.labels[i] for i in kept))
        )
    return replace(detections, frames=tuple(frames))
