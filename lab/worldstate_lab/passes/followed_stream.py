"""Streams processed by the complete filter: measurements, and the beliefs of the filter.

If only the truth of a stream was kept, a simulated camera reports boxes frame by frame.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from worldstate.abduction.sequence.sequence_inputs import SIDES
from worldstate.abduction.sequence.sequence_model import HORIZONS_S
from worldstate.abduction.sequence.street_sides import StreetListener
from worldstate.adapters.camera.detections import DetectionFilter, DetectionLog, Row, frame_of_rows
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.vision_query import VisionQuery
from worldstate.adapters.files.model_file import Model
from worldstate.adapters.listener import learn_passes
from worldstate.adapters.source import street_listener
from worldstate.belief.street_model import FilterSettings, StreetModel
from worldstate.commissioning.alarm_curve import measurements
from worldstate.commissioning.commission import parts_of, stream_evidence
from worldstate.commissioning.heard_stream import HeardStream, junction_named
from worldstate.commissioning.sequence_training import StreamTruth, stream_truth
from worldstate.core.filter import WorldFilter
from worldstate.ground import LEAST_HEARD
from worldstate.ground.typing import BoolArray, FloatArray
from worldstate.measurement.measurement import Measurement
from worldstate.operations.metrics.approach_table import AFTER_S
from worldstate.simulation.camera.simulated_detector import BOX_NOISE_PX, inside, miss_rate, project
from worldstate.simulation.scene.junction import Site
from worldstate.simulation.scene.kinds import VehicleKind, vehicle_kind
from worldstate.state import Entity, RiskCue, WorldState
from worldstate.state.context import Context
from worldstate.state.cue import Tally

FRAME_S = 0.1
_STILL_M = 1e-3  # Least motion per 0.1 s: slower vehicles keep their heading


def stream_detections(heard: HeardStream, rng: np.random.Generator) -> DetectionLog:
    """Return the boxes of all vehicles in view, with the miss rate of the paper's detector."""
    site, frames = junction_named(heard.site), dict[int, list[Row]]()
    kinds = dict(zip(heard.vehicles.vehicle.tolist(), heard.vehicles.kind.tolist(), strict=True))
    for number, name in kinds.items():
        kind, mine = vehicle_kind(name), heard.rows.vehicle == number
        x, y, seen = heard.rows.x_m[mine], heard.rows.y_m[mine], heard.rows.in_view[mine]
        time_s = heard.rows.time_s[mine]
        crossing = _crossing(x, y)
        for at in np.flatnonzero(seen).tolist():
            box = _box(site, kind, float(x[at]), float(y[at]), int(crossing[at]))
            if box is None or rng.random() < miss_rate(float(x[at]), float(y[at])):
                continue
            noisy = inside(box + rng.normal(0.0, BOX_NOISE_PX, 4))
            frame = round(float(time_s[at]) / FRAME_S)
            score = float(np.clip(rng.normal(0.95, 0.03), 0.3, 0.999))
            frames.setdefault(frame, []).append((noisy, score, kind.label))
    last = round(float(heard.hops.time_s[-1]) / FRAME_S)
    every = [frame_of_rows(frames.get(at, [])) for at in range(last + 1)]
    return DetectionLog.at_rate(every, 1.0 / FRAME_S, source=heard.hops.name)


def without_passes(detections: DetectionLog, heard: HeardStream) -> DetectionLog:
    """Return a log whose camera fails at every T0 and stays off during the approach."""
    entries_s = heard.vehicles.entry_s[heard.vehicles.hazard]
    since_s = detections.stamps_ns[:, None] * 1e-9 - entries_s[np.isfinite(entries_s)]
    alive = ~((since_s >= 0.0) & (since_s < AFTER_S)).any(axis=1)
    frames = tuple(detections.frames[at] for at in np.flatnonzero(alive).tolist())
    return replace(detections, stamps_ns=detections.stamps_ns[alive], frames=frames)


def _crossing(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return whether a vehicle drives left (1), right (-1) or along the ego's street (0), per row."""
    dx, dy = (np.gradient(one) if one.size > 1 else np.zeros(one.size) for one in (x, y))
    sideways = np.abs(dy) > np.maximum(np.abs(dx), _STILL_M)
    return np.asarray(np.where(sideways, np.sign(dy), 0.0))


def _box(site: Site, kind: VehicleKind, x: float, y: float, crossing: int) -> FloatArray | None:
    # Rows contain the front axle: the body extends from the bumper ahead of it to one length behind the
    # bumper.
    if crossing:
        front = y + crossing * kind.axles_m[0]
        ends = sorted((front, front - crossing * kind.length_m))
        return project(site, x, (ends[0], ends[1]), kind)
    half = 0.5 * kind.width_m
    return project(site, x, (y - half, y + half), kind)


@dataclass(frozen=True, slots=True, eq=False)
class FollowedStream:
    """The snapshots of a stream as columns; the two sides are left and right."""

    time_s: FloatArray  # shape (n,)
    advisory: BoolArray  # shape (n, 2)
    risk: FloatArray  # shape (n, 2)
    within: FloatArray  # shape (n, 2, horizons): Chances by horizon; NaN if none is published
    time_to_visible_s: FloatArray  # shape (n, 2, 3): Low, best, high; NaN if none is published
    masked: BoolArray  # shape (n,): Whether the snapshot gives a reason for reduced audibility
    unheard: BoolArray  # shape (n,): Whether the snapshot marks the hop as inaudible
    entities: tuple[tuple[Entity, ...], ...]  # Entities of every hop
    tallies: tuple[Tally, ...]  # Counts of the watch over the alarm's budget, at every hop

    def hidden(self, hop: int, side: int, least: float = 0.0) -> list[Entity]:
        """Return the entities hidden on a side at a hop with at least this existence probability."""
        return [
            one
            for one in self.entities[hop]
            if one.status != "visible" and _share(one, SIDES[side]) > 0.0
            if one.existence_probability * _share(one, SIDES[side]) >= least
        ]


def _share(entity: Entity, side: str) -> float:
    """Return P(an entity is on a side | it exists)."""
    known = {one.direction: one.probability for one in entity.sides}
    return known.get(side, 0.0) if known else float(entity.direction == side)


@dataclass(frozen=True, slots=True, eq=False)
class PassedStream:
    """A stream with its truth and the beliefs of the filter."""

    heard: HeardStream
    truth: StreamTruth
    followed: FollowedStream


def filtered(
    world: WorldFilter, measurements: Iterable[Measurement], street: StreetListener | None = None
) -> FollowedStream:
    """Filter a stream; return the belief after every measurement. `street` learns from passes."""
    states: list[WorldState] = []
    for measurement in measurements:
        world = world.update(measurement)
        learn_passes(street, world.state)
        states.append(world.state)
    cues, never = list(map(cues_of, states)), [np.nan] * 3
    return FollowedStream(
        time_s=np.array([state.stamp_ns for state in states]) * 1e-9,
        advisory=np.array([[cue.advisory is not None for cue in hop] for hop in cues]),
        risk=np.array([[cue.risk for cue in hop] for hop in cues]),
        within=np.array([list(map(chances, hop)) for hop in cues]),
        time_to_visible_s=np.array([[cue.time_to_visible_s or never for cue in hop] for hop in cues]),
        masked=np.array([any(one.reason for one in state.heard or ()) for state in states]),
        unheard=np.array([all(one.share < LEAST_HEARD for one in state.heard or ()) for state in states]),
        entities=tuple(state.entities for state in states),
        tallies=tuple(Tally() if state.budget is None else state.budget.tally for state in states),
    )


def cues_of(state: WorldState) -> list[RiskCue]:
    """Return the cues of the left and of the right side."""
    return sorted(state.cues, key=lambda cue: SIDES.index(cue.direction))


def chances(cue: RiskCue) -> list[float]:
    """Return the chances of coming into view by horizon, NaN if the cue has none."""
    return list((cue.within or {}).values()) or [np.nan] * len(HORIZONS_S)


CameraKind = Literal["all", "cars", "none", "dies"]
# Every vehicle, however small its box. OVAD's authors keep only cars above 100 px.
EVERYBODY = DetectionFilter(frozenset({"car", "truck", "bus", "train", "motorcycle", "bicycle"}), 0.5, 20.0)


def passed_stream(path: Path, model: Model, camera: CameraKind = "all", seed: int = 0) -> PassedStream:
    """Return a stream with the filter's beliefs at every hop; `seed` draws the camera's misses.

    The filter learns the sound of each arm from the vehicles that come into view.

    Raises
    ------
    InvalidArgumentError
        If the model has no sequence model; `commission` makes one.
    """
    street = street_listener(model.domain, None, None)
    heard, measured = stream_measurements(path, model, camera, seed, street)
    settings = FilterSettings(street=model.street or StreetModel())
    world = WorldFilter(Context(), model.policies.for_alpha(0.02), settings)
    return PassedStream(heard, stream_truth(heard), filtered(world, measured, street))


def stream_measurements(
    path: Path, model: Model, camera: CameraKind, seed: int, street: StreetListener | None = None
) -> tuple[HeardStream, Iterator[Measurement]]:
    """Return a stream with the measurements of microphones and camera, hop by hop."""
    windows, sequence = parts_of(model)
    heard, vision = HeardStream.load(path), None
    if camera != "none":
        boxes = DetectionFilter() if camera == "cars" else EVERYBODY
        detections = stream_detections(heard, np.random.default_rng(seed))
        if camera == "dies":
            detections = without_passes(detections, heard)
        vision = VisionQuery(PinholeCamera.ovad(), detections, keep=boxes)
    evidence = stream_evidence(windows, heard)
    return heard, measurements(heard, windows, sequence, evidence, vision, street, model.guard)
