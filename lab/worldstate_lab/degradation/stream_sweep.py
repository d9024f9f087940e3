"""False advisories while the camera fails, on hours of street in which nobody comes out of a hidden arm.

A sweep over images needs filmed recordings, and an hour of them takes hours. On a stream the boxes of the
camera are staged instead: each is left out as often as the table of miss rates says of the degradation, which
the camera states. The rain on the roof is staged on the sound, as on filmed recordings.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from worldstate.abduction.absence import MissRateTable, default_miss_rates
from worldstate.adapters.acoustic import asked_again
from worldstate.adapters.camera.detections import DetectionFrame, DetectionLog
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.vision_query import VisionQuery, VisionSettings
from worldstate.adapters.files.model_file import read_model
from worldstate.adapters.listen import Source, measure_steps, open_source, unoccluded_sector
from worldstate.ground.blas_threads import one_blas_thread
from worldstate.ground.typing import BoolArray, FloatArray
from worldstate.measurement.measurement import Measurement
from worldstate.operations.metrics.approach_table import SECONDS_PER_HOUR, poisson_interval, rising_edges
from worldstate.operations.recordings.hop_stream import HOP_S
from worldstate.operations.recordings.hop_table import HopTable, joined
from worldstate_lab.metrics.intervals import DRAWS, middle, poisson_upper

from .awareness import Estimate
from .conditions import CLEAN, LENS, OFF, RAIN, RAIN_DB, ROOF, Condition, level_rms, rained

# Changes whenever the same stream would give other advisories.
VERSION = 3
# Half of the way and all of it for the camera; of the rain the heaviest, as each level is heard anew.
STATES = (
    Condition(CLEAN),
    Condition(LENS, 2),
    Condition(LENS, 4),
    Condition(OFF),
    Condition(ROOF, 4),
    Condition(RAIN, 4),
)
# Onsets come in bursts: minutes are drawn, not onsets.
_PIECE_HOPS = round(60.0 / HOP_S)


@dataclass(frozen=True, slots=True)
class FalseAdvisories:
    """One state of camera and roof beside the clean one, on the same hours."""

    name: str
    onsets: int
    per_hour: Estimate  # With the exact interval
    upper_90: float  # What the rate does not exceed with a confidence of .9
    ratio: Estimate  # To the clean camera, over draws of minutes, the same for both


@dataclass(frozen=True, slots=True)
class StreamSweep:
    """All states on the same hours."""

    hours: float
    rows: tuple[FalseAdvisories, ...]


def states_told() -> list[str]:
    """Return all that the advisories depend on beside the stream, the model and the seed."""
    return [*(state.name for state in STATES), *map(repr, RAIN_DB), repr(default_miss_rates(90.0))]


def staged_advisories(path: Path, model: Path | None, seed: int) -> HopTable:
    """Return the advisories of a stream in every state end to end: `condition`, `time_s`, `advised`."""
    source = open_source(path, model=read_model(model))
    with one_blas_thread():
        return joined(_advised(source, seed))


def stream_sweep(streams: Iterable[HopTable], seed: int, draws: int = DRAWS) -> StreamSweep:
    """Count the onsets of every state, and hold them against those of the clean camera minute by minute."""
    parts = [[one.advised[one.condition == state.name] for state in STATES] for one in streams]
    hours = sum(flags[0].size for flags in parts) * HOP_S / SECONDS_PER_HOUR
    onsets = np.concatenate([np.stack([_by_minute(one) for one in flags], axis=1) for flags in parts])
    chosen = np.random.default_rng(seed).integers(len(onsets), size=(draws, len(onsets)))
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
            wet = rained(source, level, rms, np.random.default_rng(seed)) if level else source
            # One level at a time: an hour of measurements takes half a gigabyte.
            heard = {level: [measured for _, measured in measure_steps(wet)]}
        yield _followed(source, heard[level], state, seed)


def _followed(source: Source, measured: Sequence[Measurement], state: Condition, seed: int) -> HopTable:
    """Return at every hop whether the world-state warns in a state, of either side."""
    world, query, advised = source.world(), _query(source, state, seed), []
    for one in measured:
        world = world.predict_to(one.stamp_ns).update(asked_again(one, query))
        advised.append(any(cue.advisory is not None for cue in world.state.cues))
    times = np.array([one.stamp_ns for one in measured]) * 1e-9
    return HopTable(
        {"condition": np.full(len(times), state.name), "time_s": times, "advised": np.array(advised)}
    )


def _query(source: Source, state: Condition, seed: int) -> VisionQuery | None:
    """Return the camera of a state, which knows how degraded it is; None for none."""
    if state.family == OFF or source.detections is None:
        return None
    table, degradation = default_miss_rates(90.0), state.degradation if state.family in (LENS, RAIN) else 0.0
    # The same luck in every state: what is missed with a better camera is missed with a worse one.
    rng = np.random.default_rng(seed)
    return VisionQuery(
        source.camera,
        missed(source.detections, source.camera, table, degradation, rng),
        table,
        degradation,
        VisionSettings(keep=source.settings.boxes),
        unoccluded_sector(source.context),
    )


def missed(
    detections: DetectionLog,
    camera: PinholeCamera,
    table: MissRateTable,
    degradation: float,
    rng: np.random.Generator,
) -> DetectionLog:
    r"""Return a log without the boxes that a camera degraded by d would have missed as well.

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
        # Beyond the table nothing is seen, and nothing more can be missed.
        share = np.divide(after - before, left, out=np.zeros_like(left), where=left > 0.0)
        kept = np.flatnonzero(rng.random(len(azimuths)) >= share).tolist()
        frames.append(
            DetectionFrame(frame.boxes_px[kept], frame.scores[kept], tuple(frame.labels[i] for i in kept))
        )
    return replace(detections, frames=tuple(frames))
