"""All figures of an exam, beside those of OVAD's array, and of wrong mountings side by side."""

from collections.abc import Mapping, Sequence

from worldstate.operations.metrics.approach_table import Figures

from .bearing_exam import in_view_bearings
from .stream_exam import ExaminedStream, examine

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
