"""Tracking of a vehicle from behind a real corner into view: identity, hand-over, bearings, tracks.

The vehicle of an approach is the first box that appears on its side at T0, with the boxes of later images
that continue it. The entity in view that is nearest to a box is matched to it if it is within 15 degrees.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from worldstate.abduction.sequence.sequence_inputs import SIDES
from worldstate.adapters.camera.box_linking import AzimuthBox, linked_boxes
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.vision_query import VisionQuery
from worldstate.adapters.listener import Step
from worldstate.ground.typing import AnyArray, BoolArray, FloatArray, IndexArray
from worldstate.ground.values import nanoseconds, seconds, wrap_angle
from worldstate.measurement.measurement import Bearing
from worldstate.operations.labelling.pass_labels import LONGEST_GAP_S
from worldstate.operations.metrics.approach_table import SLACK_S, mean_of, share_interval
from worldstate.operations.recordings.hop_table import HOP_S, HopTable, joined
from worldstate.state import Entity, WorldState
from worldstate_lab.methods.oc_sort import OcSort
from worldstate_lab.metrics.intervals import middle, pooled_draws
from worldstate_lab.metrics.track_measures import gated_median_deg, gospa_bearing
from worldstate_lab.trials.listening import box_table, frame_row, likely_movers, nearest_entity, reference_rad

from .hearing import Chain
from .recordings import CornerRecording

# Boxes jump by up to 14 degrees when a vehicle leaves one crop of the detector for the next. With a limit of
# 8 degrees, as for pass labels, half of the vehicles have 11 boxes or fewer; with 15 degrees the median is
# 17.
NEAR_RAD = math.radians(15.0)
EARLY_S = 0.3  # T0 agrees with the images to within this time
HIDDEN_S, STATED_S = 1.0, 3.0  # Times before T0, for hidden entities and for times to visible
LATE = 0.9  # Quantile of the delays of a hand-over
# Delays of the images after a bearing. If the error is smallest at a delay other than 0, the sound and the
# images are not synchronous.
SHIFTS_S = tuple(round(0.1 * i, 1) for i in range(-2, 9))
_NOW = SHIFTS_S.index(0.0)
WORLD, OC_SORT, PARTS = "world-state", "OC-SORT", ("localised", "missed", "false")
CUE_COLUMNS = ("before_s", "risk", "other_risk", "low_s", "best_s", "high_s")
BEARING_COLUMNS = ("error_rad", "std_rad", "prominence", "usable")  # Errors have shape (n, shifts)
Row = dict[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """Result of tracking the vehicle of one approach."""

    recording: CornerRecording
    identity: str  # Identity of the entity in view: kept, another, none hidden; no box
    delay_s: float  # Time from the first box to a visible entity, infinite if there is none; NaN: no box
    side: str | None  # Side of the first entity matched to the vehicle
    cues: HopTable  # Cues in the last seconds before T0
    bearings: HopTable  # Acoustic bearings of hops with a moving box, computed without the camera
    # By method; shape (images, 4): number of boxes, then the parts of GOSPA in degrees
    costs: Mapping[str, FloatArray]


def tracked(chain: Chain, recording: CornerRecording) -> Tracked | None:
    """Track an approach with the camera, and again with every second image; None without a hazard.

    Examples
    --------
    >>> from pathlib import Path
    >>> from worldstate.adapters import read_model
    >>> from worldstate_lab.sequences.hearing import ovad_chain
    >>> calm = CornerRecording(Path("here"), "2_00_0009", "SA1", "none", 7.0, 9.95)
    >>> tracked(ovad_chain(read_model(None)), calm) is None
    True
    """
    if recording.hazard_free:
        return None
    source, steps = chain.source(recording), _by_image(chain, recording)
    vision = source.camera_channel()
    boxes = box_table(source, vision)
    vehicle = [one for one in _vehicle(boxes, recording) if _number(one.time_s) in steps]
    there = [(one.middle_rad, _there(steps[_number(one.time_s)].state, "visible")) for one in vehicle]
    found = [nearest_entity(entities, azimuth, NEAR_RAD) for azimuth, entities in there]
    delays_s = (one.time_s - vehicle[0].time_s for one, entity in zip(vehicle, found, strict=True) if entity)
    return Tracked(
        recording,
        _identity(steps, found, recording),
        next(delays_s, math.inf if vehicle else math.nan),
        next((one.direction for one in found if one), None),
        HopTable.of_rows(CUE_COLUMNS, _cue_rows(steps.values(), recording)),
        _bearings(steps.values(), vision, recording.t0_s),
        _costs(chain, recording, boxes, vision.keep.min_score),
    )


def _number(time_s: float) -> int:
    """Return a time in tenths of a second, which numbers images and hops."""
    return round(time_s / HOP_S)


def _by_image(chain: Chain, recording: CornerRecording) -> dict[int, Step]:
    return {_number(step.state.time_s): step for step in chain.steps(recording)}


def _vehicle(boxes: HopTable, recording: CornerRecording) -> list[AzimuthBox]:
    """Return the boxes of the vehicle that comes into view, at most one per image; empty if none does."""
    images: dict[float, list[AzimuthBox]] = {}
    for i in np.flatnonzero(boxes.moving):
        at_s, azimuth = float(boxes.time_s[i]), float(boxes.azimuth_rad[i])
        box = AzimuthBox(at_s, math.nan, math.nan, azimuth, math.nan, str(boxes.class_name[i]))
        images.setdefault(at_s, []).append(box)
    first_s, sign = recording.t0_s - EARLY_S - SLACK_S, 1.0 if recording.side == SIDES[0] else -1.0
    linked = linked_boxes(sorted(images.items()), NEAR_RAD, LONGEST_GAP_S)
    coming = [one for one in linked if one[0].time_s >= first_s and sign * one[0].middle_rad > 0.0]
    return min(coming, key=lambda one: one[0].time_s, default=[])


def _there(state: WorldState, status: str) -> list[Entity]:
    return [one for one in likely_movers(state) if one.status == status]


def _identity(steps: Mapping[int, Step], found: Sequence[Entity | None], recording: CornerRecording) -> str:
    """Return whether the entity matched in most images was hidden on the vehicle's side just before T0."""
    if not found:
        return "no box"
    last = (steps.get(n) for n in range(_number(recording.t0_s - HIDDEN_S), _number(recording.t0_s)))
    there = (entity for one in last if one is not None for entity in _there(one.state, "hidden"))
    hidden = {one.id for one in there if one.direction == recording.side}
    kept = np.mean([one is not None and one.id in hidden for one in found]) > 0.5
    return "kept" if kept else "another" if hidden else "none hidden"


def _cue_rows(steps: Iterable[Step], recording: CornerRecording) -> Iterator[tuple[float, ...]]:
    """Yield the published values of both sides in the seconds before T0."""
    for step in steps:
        before_s = recording.t0_s - step.state.time_s
        if SLACK_S < before_s <= STATED_S + SLACK_S:
            own, other = sorted(step.state.cues, key=lambda cue: cue.direction != recording.side)
            low_s, _, high_s = own.time_to_visible_s or (math.nan,) * 3
            best_s = math.nan if own.horizon_s is None else own.horizon_s
            risks = (math.nan if cue.risk is None else cue.risk for cue in (own, other))
            yield before_s, *risks, low_s, best_s, high_s


def _bearings(steps: Iterable[Step], vision: VisionQuery, t0_s: float) -> HopTable:
    """Return the bearings after T0, with their errors against images slightly earlier and later."""
    rows = []
    for step in steps:
        frame, usable = step.frame, isinstance(step.measurement.bearing, Bearing)
        later = (replace(frame, stamp_ns=frame.stamp_ns + nanoseconds(shift_s)) for shift_s in SHIFTS_S)
        errors = [wrap_angle(frame.bearing_rad - reference_rad(one, vision)) for one in later]
        if seconds(frame.stamp_ns) > t0_s + SLACK_S and math.isfinite(errors[_NOW]):
            rows.append((errors, frame.bearing_std_rad, frame_row(frame)[1], usable))
    table = HopTable.of_rows(BEARING_COLUMNS, rows)
    return table.replace(error_rad=table.error_rad.reshape(-1, len(SHIFTS_S)))


def _costs(chain: Chain, recording: CornerRecording, boxes: HopTable, score: float) -> dict[str, FloatArray]:
    """Return the GOSPA of every method's tracks in the withheld images."""
    steps = _by_image(replace(chain, image_step=2), recording)
    log, rows = chain.source(recording).detections, {WORLD: list[FloatArray](), OC_SORT: list[FloatArray]()}
    assert log is not None
    tracks = _oc_sort(boxes, score, len(log))
    for image, stamp_ns in list(enumerate(log.stamps_ns.tolist()))[1::2]:
        step, truth = steps.get(_number(seconds(stamp_ns))), boxes.azimuth_rad[_moving_in(boxes, image)]
        # Entities that left the view are kept for some seconds, but the camera is not queried for them.
        there = [] if step is None else _there(step.state, "visible")
        seen = [one.azimuth_rad for one in there if one.visibility.answer != "unqueried"]
        for method, azimuths in ((WORLD, seen), (OC_SORT, tracks[image])) if step else ():
            one = gospa_bearing(azimuths, truth)
            rows[method].append(np.r_[len(truth), np.degrees([one.localisation, one.missed, one.false])])
    return {method: np.array(some).reshape(-1, 1 + len(PARTS)) for method, some in rows.items()}


def _moving_in(boxes: HopTable, image: int) -> IndexArray:
    return np.flatnonzero((boxes.frame == image) & boxes.moving.astype(bool))


def _oc_sort(boxes: HopTable, min_score: float, images: int) -> dict[int, list[float]]:
    """Return the azimuths that OC-SORT predicts in every second image, which it does not receive."""
    # The tracker steps from one received image to the next: with empty steps between, no track would have
    # enough consecutive boxes to be confirmed. Half of a track's last motion predicts its position in the
    # image between.
    camera, sort, found = PinholeCamera.ovad(), OcSort(min_score), dict[int, list[float]]()
    last: dict[int, float] = {}
    for image in range(0, images, 2):
        rows = _moving_in(boxes, image)
        certain = [one for one in sort.step(boxes.box_px[rows], boxes.score[rows]) if one.certain]
        now = {one.track: float(camera.azimuth(one.box_px[[0, 2]].mean())) for one in certain}
        found[image + 1] = [at + 0.5 * (at - last.get(track, at)) for track, at in now.items()]
        last = now
    return found


Rows = Callable[[Sequence[Tracked], np.random.Generator], Row]


def tracking_figures(found: Sequence[Tracked], rng: np.random.Generator) -> Row:
    """Return identity, hand-over and bearing error of at least one approach; `tracking` has the details.

    Intervals are over recordings drawn with `rng`; figures without data are None.
    """
    rows: dict[str, Rows] = {"identity": _identities, "bearing": _bearing_row, "gospa_deg": _gospa_rows}
    names = sorted({one.recording.junction for one in found})
    groups = {"all": found} | {k: [one for one in found if one.recording.junction == k] for k in names}
    tracking = {name: {key: of(some, rng) for key, some in groups.items()} for name, of in rows.items()}
    late = _hand_over(found, rng)
    return {
        "identity_kept": tracking["identity"]["all"]["kept"],
        "hand_over_delay_s": late["median_s"],
        "bearing_error_deg": tracking["bearing"]["all"]["median_deg"],
        "tracking": {**tracking, "hand_over": late, "before_t0": _before(found, rng)},
    }


def _share(name: str, hits: Sequence[bool]) -> Row:
    """Return a share, its count and its exact interval; None if there are no cases."""
    n, count = len(hits), sum(hits)
    interval = share_interval(count, n) if n else None
    return {name: mean_of(hits), f"{name}_count": f"{count} of {n}", f"{name}_interval": interval}


def _pooled(
    name: str,
    some: Sequence[Tracked],
    parts: Sequence[FloatArray | BoolArray],
    rng: np.random.Generator,
    of: Callable[..., Any] = np.median,
) -> Row:
    """Return a figure over the values of all recordings, with its central interval over draws of them."""
    numbers = [np.asarray(one, np.float64) for one in parts]
    values = np.concatenate([np.empty(0), *numbers])
    if not values.size:
        return {name: None, f"{name}_interval": None}
    strata = [(one.recording.junction, one.recording.side) for one in some]
    drawn = [of(one) if one.size else np.nan for one in pooled_draws(numbers, strata, rng)]
    return {name: float(of(values)), f"{name}_interval": middle(np.array(drawn))}


def _identities(some: Sequence[Tracked], rng: np.random.Generator) -> Row:
    """Return the share of approaches whose entity in view was hidden before, and the counts of the others."""
    stated = [one.identity for one in some]
    others = {name: stated.count(name) for name in ("another", "none hidden", "no box")}
    return {**_share("kept", [one == "kept" for one in stated]), **others}


def _hand_over(some: Sequence[Tracked], rng: np.random.Generator) -> Row:
    """Return how many vehicles in view become a visible entity, and their delays."""
    seen = [one for one in some if not math.isnan(one.delay_s)]
    parts = [np.array([one.delay_s] * math.isfinite(one.delay_s)) for one in seen]
    late = _pooled("late_s", seen, parts, rng, lambda delays_s: np.quantile(delays_s, LATE))
    found = _share("found", [math.isfinite(one.delay_s) for one in seen])
    side = _share("right_side", [one.side == one.recording.side for one in seen])
    return {**found, **side, **_pooled("median_s", seen, parts, rng), **late}


def _before(some: Sequence[Tracked], rng: np.random.Generator) -> Row:
    """Return how often the riskier side is the vehicle's, and the errors of the published times."""
    cues = [one.cues for one in some]
    errors = [np.abs(one.best_s - one.before_s) for one in cues]
    stated = [one[np.isfinite(one)] for one in errors]
    within = [(one.low_s <= one.before_s) & (one.before_s <= one.high_s) for one in cues]
    inside = [hits[np.isfinite(one.low_s)] for hits, one in zip(within, cues, strict=True)]
    return {
        **_share("side_at_t0", _right_side(cues, 0.0)),
        **_share("side_1s_before", _right_side(cues, 1.0)),
        **_share("stated", [len(one) > 0 for one in stated]),
        **_pooled("time_error_s", some, stated, rng),
        **_pooled("time_coverage", some, inside, rng, np.mean),
        "time_hops": sum(map(len, stated)),
    }


def _right_side(cues: Sequence[HopTable], before_s: float) -> list[bool]:
    """Return whether the vehicle's side is the riskier one at the hop nearest to a time before T0."""
    rows = [(one, int(np.abs(one.before_s - before_s).argmin())) for one in cues if len(one)]
    return [bool(one.risk[row] > one.other_risk[row]) for one, row in rows]


def _bearing_row(some: Sequence[Tracked], rng: np.random.Generator) -> Row:
    """Return errors of acoustic bearings against the nearest moving box."""
    every = [one.bearings for one in some]
    hops = joined(every)
    surest = HopTable({"error_rad": hops.error_rad[:, _NOW], "prominence": hops.prominence})
    later = zip(SHIFTS_S, np.degrees(np.abs(hops.error_rad)).T, strict=True)
    known = [(f"{shift_s:g}", errors[np.isfinite(errors)]) for shift_s, errors in later]
    return {
        **_errors(some, every, rng),
        "usable": _errors(some, [_only(one, one.usable) for one in every], rng),
        "surest_deg": gated_median_deg(surest) if len(hops) else None,
        "images_later_s": {shift: float(np.median(one)) if one.size else None for shift, one in known},
    }


def _only(bearings: HopTable, kept: AnyArray) -> HopTable:
    return HopTable({name: column[kept.astype(bool)] for name, column in bearings.columns.items()})


def _errors(some: Sequence[Tracked], bearings: Sequence[HopTable], rng: np.random.Generator) -> Row:
    """Return the median error, and the mean squared error over the published variance, ideally 1."""
    errors = [one.error_rad[:, _NOW] for one in bearings]
    squares = [(error / one.std_rad) ** 2 for error, one in zip(errors, bearings, strict=True)]
    return {
        "hops": sum(map(len, errors)),
        **_pooled("median_deg", some, [np.degrees(np.abs(one)) for one in errors], rng),
        **_pooled("nees_median", some, squares, rng),
        **_pooled("nees_mean", some, squares, rng, np.mean),
    }


def _gospa_rows(some: Sequence[Tracked], rng: np.random.Generator) -> Row:
    """Return the mean GOSPA of every method in withheld images with a moving box, and in the others."""
    found: Row = {}
    for method in (WORLD, OC_SORT):
        costs = [one.costs[method] for one in some]
        with_box = [one[one[:, 0] > 0.0, 1:] for one in costs]
        others = np.concatenate([one[one[:, 0] == 0.0, -1] for one in costs])
        found[method] = {
            **_pooled("total", some, [one.sum(axis=1) for one in with_box], rng, np.mean),
            **{name: mean_of(np.concatenate(with_box)[:, i]) for i, name in enumerate(PARTS)},
            "images": sum(map(len, with_box)),
            "false_without_box": mean_of(others),
        }
    return found
