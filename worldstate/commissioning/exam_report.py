"""All figures of an exam, as a table beside those of OVAD's array, for wrong mountings, and as curves."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from worldstate.ground.typing import FloatArray
from worldstate.ground.values import wrap_angle
from worldstate.operations.figure_style import figure_file, legend_beside
from worldstate.operations.metrics.approach_table import Figures

from .heard_stream import HeardStream
from .sequence_training import ROW_S
from .stream_exam import ExaminedStream, auroc_before, examine, warned_before

# What OVAD's 56 microphones reach with the model that ships, in 395 loud approaches and six hours without
# hazards (seeds 1 to 3 of the exam; docs/commission.md). Its window model knows real windows of these
# junctions.
REFERENCE: Mapping[str, float] = {
    "detected": 0.924,
    "lead_s": 2.2,
    "lead_missed_as_0_s": 2.03,
    "other_side_too": 0.39,
    "both_sides_found": 0.83,
    "auroc_last_second": 0.989,
    "auroc_1s_before": 0.98,
    "auroc_2s_before": 0.97,
    "auroc_3s_before": 0.92,
    "onsets_per_hour": 19.0,
    "bearing_error_deg": 5.8,
}
# Of wrong mountings only what they may cost, by heading.
_COST_OF = {
    "AUROC last s": "auroc_last_second",
    "detected": "detected",
    "lead s": "lead_missed_as_0_s",
    "onsets/h": "onsets_per_hour",
    "bearing deg": "bearing_error_deg",
}


def exam_figures(streams: Sequence[ExaminedStream]) -> Figures:
    """Return all that an exam tells of some streams, ready for a table and for JSON."""
    return examine(streams) | in_view_bearings([one.heard for one in streams])


def beside_reference(report: Mapping[str, object]) -> dict[str, object]:
    """Return a report for people, with the figures of the 56 microphones behind those that have one.

    Examples
    --------
    >>> told = beside_reference({"approaches": 130, "onsets_per_hour": 25.0})
    >>> told["approaches"], told["onsets_per_hour"].split()[0]
    (130, '25')
    """
    return {
        name: f"{value:<8.4g} (56 microphones: {REFERENCE[name]:g})"
        if isinstance(value, float) and name in REFERENCE
        else value
        for name, value in report.items()
    }


def mounting_lines(mounted: Mapping[str, Figures]) -> list[str]:
    r"""Return a table of what each mounting reaches.

    Examples
    --------
    >>> figures = {"detected": 0.85, "bearing_error_deg": 3.14159, "offset_50ms_deg": 1.33}
    >>> print("\n".join(mounting_lines({"as mounted": figures})))
    mounted          | AUROC last s | detected | lead s | onsets/h | bearing deg
    as mounted       |            - |     0.85 |      - |        - |        3.14
    sound and camera 50 ms apart: a bearing lies 1.3 deg beside its box
    """
    rows = [
        [f"{name:<16}", *(_cell(figures.get(key), len(title)) for title, key in _COST_OF.items())]
        for name, figures in mounted.items()
    ]
    lines = [" | ".join(row) for row in ([f"{'mounted':<16}", *_COST_OF], *rows)]
    apart = next((one.get("offset_50ms_deg") for one in mounted.values()), None)
    if apart is not None:
        lines.append(f"sound and camera 50 ms apart: a bearing lies {apart:.2g} deg beside its box")
    return lines


def _cell(value: float | None, width: int) -> str:
    return f"{'-' if value is None else format(value, '.3g'):>{width}}"


NEAR_M = 20.0  # Farther away a vehicle in view is no louder than the street
OFFSET_S = 0.05  # Between the clocks of sound and camera


def in_view_bearings(streams: Sequence[HeardStream]) -> dict[str, float | None]:
    """Return the median error of bearings of the loudest vehicle in view, and its turn in the offset."""
    errors = np.concatenate([_errors_rad(one) for one in streams])
    turned = np.concatenate([_turn_rates(one) for one in streams]) * OFFSET_S
    return {
        "bearing_error_deg": float(np.degrees(np.median(errors))) if errors.size else None,
        # What a box lies beside its bearing where the camera is so much earlier or later: truth alone.
        "offset_50ms_deg": float(np.degrees(np.median(turned))) if turned.size else None,
        "offset_50ms_95_deg": float(np.degrees(np.quantile(turned, 0.95))) if turned.size else None,
    }


def _errors_rad(heard: HeardStream) -> FloatArray:
    """Return how far bearings are from the loudest vehicle in view near by, one a hop."""
    rows, time_s = heard.rows, heard.hops.time_s
    hop = np.round((rows.time_s - time_s[0]) / ROW_S).astype(np.intp)
    seen = rows.in_view & (np.hypot(rows.x_m, rows.y_m) <= NEAR_M) & (hop >= 0) & (hop < len(time_s))
    order = np.flatnonzero(seen)[np.lexsort((rows.loudness_db[seen], hop[seen]))]
    loudest = order[np.diff(hop[order], append=-1) != 0]
    true = np.arctan2(rows.y_m[loudest], rows.x_m[loudest])
    return np.asarray(np.abs(wrap_angle(heard.hops.bearing_rad[hop[loudest]] - true)))


def _turn_rates(heard: HeardStream) -> FloatArray:
    """Return how fast vehicles in view near by turn round the array, rad/s, one a row and next."""
    rows = heard.rows
    near = rows.in_view & (np.hypot(rows.x_m, rows.y_m) <= NEAR_M)
    on = (np.diff(rows.vehicle) == 0) & near[1:] & near[:-1]
    return np.asarray(np.abs(wrap_angle(np.diff(np.arctan2(rows.y_m, rows.x_m)))[on]) / ROW_S)


BEFORE_S = np.linspace(0.0, 5.0, 26)


def write_exam_figure(streams: Sequence[ExaminedStream], path: Path) -> None:
    """Draw the share of approaches in alarm and the AUROC against the time before T0, site by site."""
    sites = sorted({one.heard.site for one in streams})
    with figure_file(path, 9.0, 3.6) as figure:
        warned, ranked = figure.subplots(1, 2)
        for site in sites:
            here = [one for one in streams if one.heard.site == site]
            onsets = examine(here)["onsets_per_hour"]
            told = site if onsets is None else f"{site}, {onsets:.0f} an hour"
            warned.plot(-BEFORE_S, warned_before(here, BEFORE_S), linewidth=1.0, label=told)
            ranked.plot(-BEFORE_S, auroc_before(here, BEFORE_S), linewidth=1.0, label=told)
        warned.plot(-BEFORE_S, warned_before(streams, BEFORE_S), color="black", label="all")
        ranked.plot(-BEFORE_S, auroc_before(streams, BEFORE_S), color="black", label="all")
        warned.set(ylim=(0.0, 1.0), xlabel="seconds to T0", ylabel="approaches in alarm by then")
        ranked.set(ylim=(0.5, 1.0), xlabel="seconds to T0", ylabel="AUROC against hazard-free hops")
        legend_beside(ranked, "alarms where nobody comes")
