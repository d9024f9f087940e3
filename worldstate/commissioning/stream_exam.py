"""Exam of a sequence model on streams: detected approaches, alarms per hour, calibration, times.

An approach is one vehicle, two from both sides at once, or one with another behind it. Approaches are further
apart in time than the longest lead time of an alarm, so the first hop in alarm is used.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from worldstate.abduction.cueing.risk_map import brier_skill, expected_calibration_error
from worldstate.abduction.sequence.sequence_inputs import SIDES
from worldstate.abduction.sequence.sequence_model import (
    HORIZONS_S,
    LONGEST_S,
    SMOOTHED_HOPS,
    SequencePosterior,
)
from worldstate.adapters.files.model_file import KindShare, Model
from worldstate.ground import TINY, BoolArray, FloatArray, wrap_angle
from worldstate.ground.checks import check_shape
from worldstate.operations.figure_style import figure_file, legend_beside
from worldstate.operations.metrics.approach_table import (
    AFTER_S,
    HORIZON_S,
    SLACK_S,
    ApproachOutcome,
    ApproachTable,
    Figures,
    StreamApproach,
    auroc,
    hop_outcome,
    mean_of,
)
from worldstate.operations.recordings.hop_table import HOP_S

from .heard_stream import ROW_S, HeardStream
from .road_user_training import CLASS_OF
from .sequence_training import QUIET_KINDS, StreamTruth

# A second vehicle arrives up to six seconds after the first; drivers differ by another half second.
TOGETHER_S = 7.0
_SECOND = {"both": "both", "queue": "follows"}  # Flow of the second vehicle by that of the first
_CALIBRATED_S = (1.0, 2.0, 3.0)
# The ten hops before T0; at T0 itself the vehicle is practically in view.
_LAST_SECOND_S = np.arange(1, 11) * HOP_S


@dataclass(frozen=True, slots=True, eq=False)
class ExaminedStream:
    """A stream, a model's readings, and the advisories of the filter with an independently set alarm."""

    heard: HeardStream
    truth: StreamTruth
    posterior: SequencePosterior
    advised: BoolArray  # shape (n, 2)


def approaches(heard: HeardStream) -> list[StreamApproach]:
    """Collect the approaches of a stream from the flows of its vehicles."""
    vehicles = heard.vehicles
    order = np.argsort(vehicles.entry_s)
    left = [i for i in order.tolist() if vehicles.hazard[i] and np.isfinite(vehicles.entry_s[i])]
    found = []
    while left:
        first = left.pop(0)
        flow, entry_s = vehicles.flow[first], vehicles.entry_s[first]
        # The leader is the only vehicle of that arm within this time before its follower.
        second = [
            i
            for i in left
            if vehicles.flow[i] == _SECOND.get(flow) and vehicles.entry_s[i] - entry_s < TOGETHER_S
            if (vehicles.arm[i] == vehicles.arm[first]) == (flow == "queue")
        ][:1]
        left = [i for i in left if i not in second]
        every = [first, *second]
        found.append(
            StreamApproach(
                flow if flow in ("both", "queue") else "single",
                tuple(vehicles.entry_s[every].tolist()),
                tuple(SIDES.index(arm) for arm in vehicles.arm[every]),
                tuple(vehicles.kind[every].tolist()),
                bool(np.isin(vehicles.kind[every], list(QUIET_KINDS)).any()),
            )
        )
    return found


def smoothed_log_odds(posterior: SequencePosterior) -> FloatArray:
    """Return the 0.3 s mean of the log-odds of coming into view within three seconds, shape (n, 2)."""
    within = np.clip(posterior.within()[..., -1], TINY, 1.0 - TINY)
    log_odds = np.log(within) - np.log1p(-within)
    recent = np.arange(len(log_odds))[:, None] + np.arange(1 - SMOOTHED_HOPS, 1)
    return np.asarray(log_odds[np.maximum(recent, 0)].mean(axis=1))


def _louder(posterior: SequencePosterior) -> FloatArray:
    return np.asarray(smoothed_log_odds(posterior).max(axis=1))


def examine(streams: Sequence[ExaminedStream]) -> Figures:
    """Return the figures of some streams together, for a table and for JSON."""
    every = _table(streams)
    loud = every.loud()
    found = loud.detections()
    for flow in ("single", "both", "queue"):
        found[f"detected_{flow}"] = loud.of_flow(flow).detections()["detected"]
    found["detected_quiet"] = mean_of([one.detected for one in every.outcomes if one.approach.quiet])
    found |= loud.sides() | loud.standing()
    found["onsets_after"] = mean_of([one.onsets_after for one in loud.outcomes])
    found |= _ranking(streams) | loud.false_alarms() | _worst(streams)
    return found | _calibration(streams) | _by_kind(every.outcomes)


def alarm_outcomes(
    heard: HeardStream, time_s: FloatArray, raised: BoolArray, longest_s: float = HORIZON_S
) -> list[ApproachOutcome]:
    """Return the outcome of every approach that is entirely within the hops, shapes (n,) and (n, 2)."""
    # A drive has no other hops: its vehicles come into view before the horizon of 8 s has passed.
    before_s = 0.0 if heard.ego_moves else HORIZON_S
    return [
        hop_outcome(one, time_s, raised, longest_s)
        for one in approaches(heard)
        if one.entries_s[0] - before_s >= time_s[0] and max(one.entries_s) + AFTER_S <= time_s[-1]
    ]


def _table(streams: Sequence[ExaminedStream]) -> ApproachTable:
    return approach_table([(one.heard, one.advised) for one in streams])


def approach_table(
    alarms: Sequence[tuple[HeardStream, BoolArray]], longest_s: float = HORIZON_S
) -> ApproachTable:
    """Return the approach table of streams, given their alarms by side, shape (n, 2)."""
    return ApproachTable(
        [told for one, on in alarms for told in alarm_outcomes(one, one.hops.time_s, on, longest_s)],
        [on for one, on in alarms if one.hazard_free],
    )


def _ranking(streams: Sequence[ExaminedStream]) -> Figures:
    """Return the mean AUROC over the last second before T0, and the AUROC at single earlier times."""
    times = {f"auroc_{before:g}s_before": np.array([before]) for before in _CALIBRATED_S}
    asked = {"auroc_last_second": _LAST_SECOND_S, **times}
    areas = {name: float(auroc_before(streams, before_s).mean()) for name, before_s in asked.items()}
    return {name: area if np.isfinite(area) else None for name, area in areas.items()}


def _by_kind(told: Sequence[ApproachOutcome]) -> Figures:
    # In half of the other approaches a car comes with a bicycle, and the car is the audible one.
    alone = [one for one in told if len(one.approach.kinds) == 1]
    found: Figures = {}
    for kind in sorted({one.approach.kinds[0] for one in alone}):
        figures = ApproachTable([one for one in alone if one.approach.kinds[0] == kind], ()).detections()
        found |= {f"approaches_{kind}": figures["approaches"], f"detected_{kind}": figures["detected"]}
        found[f"lead_{kind}_s"] = figures["lead_s"]
    return found


def _worst(streams: Sequence[ExaminedStream]) -> Figures:
    """Return the detected share at the worst junction, and the largest number of onsets at any junction."""
    sites = {one.heard.site for one in streams}
    there = [_table([one for one in streams if one.heard.site == site]).loud().figures() for site in sites]
    shares, rates = ([one[name] for one in there] for name in ("detected", "onsets_per_hour"))
    return {
        "detected_worst_junction": min((one for one in shares if one is not None), default=None),
        "onsets_per_hour_worst_junction": max((one for one in rates if one is not None), default=None),
    }


def _calibration(streams: Sequence[ExaminedStream]) -> Figures:
    within = np.concatenate([one.posterior.within().reshape(-1, len(HORIZONS_S)) for one in streams])
    coming_s = np.concatenate([one.truth.coming_s.reshape(-1) for one in streams])
    stated = np.concatenate([one.posterior.time_to_visible_s().reshape(-1, 3) for one in streams])
    return chance_figures(within, coming_s) | time_figures(stated, coming_s)


def chance_figures(within: FloatArray, coming_s: FloatArray) -> Figures:
    """Return Brier skill and ECE of the chances at 1, 2 and 3 s, shapes (n, horizons) and (n,)."""
    found: Figures = {}
    for horizon_s in _CALIBRATED_S:
        said, true = within[:, HORIZONS_S.index(horizon_s)], coming_s <= horizon_s
        found[f"skill_{horizon_s:g}s"] = brier_skill(said, true)
        found[f"ece_{horizon_s:g}s"] = expected_calibration_error(said, true)
    return found


@dataclass(frozen=True, slots=True)
class VisibleErrors:
    """Errors of estimated times to visible, and of the best constants for the same true times.

    Examples
    --------
    >>> stated = np.array([[0.5, 1.0, 1.5], [1.0, 2.0, 3.0], [2.0, 3.0, 4.0]])
    >>> errors = visible_errors(stated, np.array([1.1, 2.5, 5.0]))
    >>> errors.count, round(errors.rmse_s, 2), round(errors.coverage, 2), round(errors.constant_rmse_s, 2)
    (3, 1.19, 0.67, 1.61)
    >>> stated[:, [0, 2]] = np.nan
    >>> without = visible_errors(stated, np.array([1.1, 2.5, 5.0]))
    >>> round(without.rmse_s, 2), without.coverage
    (1.19, nan)
    """

    count: int  # Number of stated times that can be checked
    intervals: int  # Number of those with an interval
    rmse_s: float  # RMSE of the best value
    coverage: float  # Share of truths within the stated interval
    width_s: float
    # Error of the constant fitted to the true times themselves: no constant that is chosen in advance is
    # better.
    constant_rmse_s: float


def visible_errors(stated: FloatArray, true_s: FloatArray) -> VisibleErrors:
    """Compare stated times to visible, low, best and high (n, 3), with the true seconds (n,).

    Rows without a best value or without a finite true time are left out. Coverage and width refer to the rows
    with an interval; they are NaN without any, because a method may state a time alone.

    Examples
    --------
    >>> visible_errors(np.full((2, 3), np.nan), np.ones(2)).count
    0
    """
    check_shape("stated", np.shape(stated), (len(true_s), 3))
    known = np.isfinite(stated[:, 1]) & np.isfinite(true_s)
    if not known.any():
        return VisibleErrors(0, 0, *[math.nan] * 4)
    best, true = stated[known, 1], true_s[known]
    bounded = known & np.isfinite(stated).all(axis=1)
    low, high = stated[bounded][:, [0, 2]].T
    inside = (low <= true_s[bounded]) & (true_s[bounded] <= high)
    return VisibleErrors(
        count=true.size,
        intervals=inside.size,
        rmse_s=float(np.sqrt(np.mean((best - true) ** 2))),
        coverage=float(inside.mean()) if inside.size else math.nan,
        width_s=float(np.mean(high - low)) if inside.size else math.nan,
        constant_rmse_s=float(true.std()),
    )


def time_figures(stated: FloatArray, coming_s: FloatArray) -> Figures:
    """Return the errors of stated times for vehicles that come within five seconds; None without any.

    Shapes: stated (n, 3), coming_s (n,).
    """
    comes = coming_s <= LONGEST_S
    errors = visible_errors(stated[comes], coming_s[comes])
    if not errors.count:
        return {"time_rmse_of_constant": None, "time_coverage": None, "time_width_s": None}
    return {
        "time_rmse_of_constant": errors.rmse_s / errors.constant_rmse_s,
        "time_coverage": errors.coverage,
        "time_width_s": errors.width_s,
    }


def warned_before(streams: Sequence[ExaminedStream], before_s: FloatArray) -> FloatArray:
    """Return the share of approaches with an alarm at least `before_s` before T0, shape (times,)."""
    leads = np.array([one.lead_s for one in _table(streams).loud().outcomes])
    return np.array([np.mean(leads > before) if leads.size else np.nan for before in before_s])


def auroc_before(streams: Sequence[ExaminedStream], before_s: FloatArray) -> FloatArray:
    """Return the AUROC of the alarm's score at times before T0 against hazard-free hops, shape (times,)."""
    quiet = [_louder(one.posterior) for one in streams if one.heard.hazard_free]
    if not quiet:
        return np.full(len(before_s), np.nan)
    none = np.concatenate(quiet)
    areas = []
    for before in before_s:
        scores = np.concatenate([*(_scores_at(one, before) for one in streams), none])
        areas.append(auroc(scores, np.arange(scores.size) < scores.size - none.size))
    return np.array(areas, np.float64)  # Without an approach the area is NaN


def _scores_at(stream: ExaminedStream, before_s: float) -> FloatArray:
    time_s, scores = stream.heard.hops.time_s, _louder(stream.posterior)
    entries = [one.entries_s[0] for one in approaches(stream.heard) if not one.quiet]
    at = np.searchsorted(time_s, np.array(entries) - before_s + SLACK_S) - 1
    return np.asarray(scores[at[(at >= 0)]])


# Columns for wrong mountings: only the figures that a mounting may change.
_COST_OF = {
    "AUROC last s": "auroc_last_second",
    "detected": "detected",
    "lead s": "lead_missed_as_0_s",
    "onsets/h": "onsets_per_hour",
    "bearing deg": "bearing_error_deg",
}


_RENDERERS = ("paths", "rays", "mirrors")
_OF_OTHERS = (
    *("approaches", "detected", "advised_last_second", "advised_at_t0", "auroc_last_second"),
    *("onsets_per_hour", "onsets_per_hour_worst_junction", "skill_2s"),
)


def exam_figures(streams: Sequence[ExaminedStream]) -> Figures:
    """Return the figures of an exam, for a table and for JSON.

    Figures of the first renderer have no prefix. For each other renderer, some figures are added with its
    name as a prefix.
    """
    of = {name: [one for one in streams if one.heard.renderer == name] for name in _RENDERERS}
    first = of.pop("paths")
    found = examine(first) | in_view_bearings([one.heard for one in first])
    for name, others in of.items():
        figures = examine(others) if others else {}
        found |= {f"{name}_{key}": figures[key] for key in _OF_OTHERS if others}
    return found


def with_exam(model: Model, figures: Figures) -> Model:
    """Return a model with the exam's results on its card, also for each kind of road user."""
    card = ("approaches", "auroc_1s_before", "both_sides_found", *_COST_OF.values())
    exam = {name: float(value) for name in card if (value := figures.get(name)) is not None}
    kinds = [name.removeprefix("approaches_") for name in figures if name.startswith("approaches_")]
    shares = tuple(
        # A quiet road user has a row of its own.
        KindShare(one if one in QUIET_KINDS else CLASS_OF[one], figures[f"detected_{one}"] or 0.0, int(count))
        for one in kinds
        if (count := figures[f"approaches_{one}"])
    )
    return replace(model, provenance=replace(model.provenance, exam=exam, kinds=shares))


def beside_reference(report: Mapping[str, object], reference: Mapping[str, float]) -> dict[str, object]:
    """Return a report for people: the model's own figures, each followed by that of the 56 microphones.

    Examples
    --------
    >>> told = beside_reference({"approaches": 130, "onsets_per_hour": 25.0}, {"onsets_per_hour": 13.5})
    >>> told["approaches"], told["onsets_per_hour"]
    (130, '25       (56 microphones: 13.5)')
    """
    shown = "{:<8.4g} (56 microphones: {:.3g})"
    own = {name: one for name, one in report.items() if name in reference and isinstance(one, float)}
    return {**report, **{name: shown.format(one, reference[name]) for name, one in own.items()}}


def mounting_lines(mounted: Mapping[str, Figures]) -> list[str]:
    r"""Return a table of the results of each mounting.

    Examples
    --------
    >>> figures = {"detected": 0.85, "bearing_error_deg": 3.14159, "offset_50ms_deg": 1.33}
    >>> print("\n".join(mounting_lines({"as mounted": figures})))
    mounted          | AUROC last s | detected | lead s | onsets/h | bearing deg
    as mounted       |            - |     0.85 |      - |        - |        3.14
    sound and camera 50 ms apart: bearings differ from boxes by 1.3 deg
    """
    lines = exam_lines("mounted", mounted)
    apart = next((one.get("offset_50ms_deg") for one in mounted.values()), None)
    if apart is not None:
        lines.append(f"sound and camera 50 ms apart: bearings differ from boxes by {apart:.2g} deg")
    return lines


def exam_lines(heading: str, every: Mapping[str, Mapping[str, object]]) -> list[str]:
    """Return a table with a row for each of several exams."""
    rows = [
        [f"{name:<16}", *(_cell(figures.get(key), len(title)) for title, key in _COST_OF.items())]
        for name, figures in every.items()
    ]
    return [" | ".join(row) for row in ([f"{heading:<16}", *_COST_OF], *rows)]


def _cell(value: object, width: int) -> str:
    return f"{'-' if value is None else format(value, '.3g'):>{width}}"


NEAR_M = 20.0  # Largest distance; a vehicle farther away is no louder than the street
OFFSET_S = 0.05  # Offset between the clocks of sound and camera


def in_view_bearings(streams: Sequence[HeardStream]) -> dict[str, float | None]:
    """Return the median bearing error of the loudest vehicle in view, and its turn during the offset."""
    errors = np.concatenate([_errors_rad(one) for one in streams])
    turned = np.concatenate([_turn_rates(one) for one in streams]) * OFFSET_S
    return {
        "bearing_error_deg": float(np.degrees(np.median(errors))) if errors.size else None,
        # Angle between box and bearing with this offset of the camera's clock; it follows from the truth
        # alone.
        "offset_50ms_deg": float(np.degrees(np.median(turned))) if turned.size else None,
        "offset_50ms_95_deg": float(np.degrees(np.quantile(turned, 0.95))) if turned.size else None,
    }


def _errors_rad(heard: HeardStream) -> FloatArray:
    """Return the bearing errors for the loudest near vehicle in view, one per hop."""
    rows = heard.rows
    hop, inside = heard.row_hops()
    seen = heard.in_view_within(NEAR_M) & inside
    order = np.flatnonzero(seen)[np.lexsort((rows.loudness_db[seen], hop[seen]))]
    loudest = order[np.diff(hop[order], append=-1) != 0]
    true = np.arctan2(rows.y_m[loudest], rows.x_m[loudest])
    return np.asarray(np.abs(wrap_angle(heard.hops.bearing_rad[hop[loudest]] - true)))


def _turn_rates(heard: HeardStream) -> FloatArray:
    """Return the angular rates of near vehicles in view, rad/s, one per pair of rows."""
    rows = heard.rows
    near = heard.in_view_within(NEAR_M)
    on = (np.diff(rows.vehicle) == 0) & near[1:] & near[:-1]
    return np.asarray(np.abs(wrap_angle(np.diff(np.arctan2(rows.y_m, rows.x_m)))[on]) / ROW_S)


BEFORE_S = np.linspace(0.0, 5.0, 26)


def write_exam_figure(streams: Sequence[ExaminedStream], path: Path) -> None:
    """Draw the share of approaches in alarm and the AUROC against the time before T0, for every site."""
    with figure_file(path, 9.0, 3.6) as figure:
        warned, ranked = figure.subplots(1, 2)

        def draw(some: Sequence[ExaminedStream], **style: object) -> None:
            warned.plot(-BEFORE_S, warned_before(some, BEFORE_S), **style)
            ranked.plot(-BEFORE_S, auroc_before(some, BEFORE_S), **style)

        for site in sorted({one.heard.site for one in streams}):
            here = [one for one in streams if one.heard.site == site]
            onsets = examine(here)["onsets_per_hour"]
            told = site if onsets is None else f"{site}, {onsets:.0f} per hour"
            draw(here, linewidth=1.0, label=told)
        draw(streams, color="black", label="all")
        warned.set(ylim=(0.0, 1.0), xlabel="seconds to T0", ylabel="approaches in alarm by then")
        ranked.set(ylim=(0.5, 1.0), xlabel="seconds to T0", ylabel="AUROC against hazard-free hops")
        legend_beside(ranked, "alarms without vehicles")
