"""Prominence gating on bearings that a camera could check: coverage against accuracy, and presence.

As in the paper's section on front-end accuracy: while the vehicle is in view, a bearing is compared with the
moving box that stands nearest to it.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from worldstate.frontend.direction.bearing import GatingCurve, gating_curve
from worldstate.ground.checks import check_shape
from worldstate.ground.typing import FloatArray
from worldstate.ground.values import NotUsable, wrap_angle
from worldstate.operations.figure_style import figure_file

from .hop_table import HopTable

if TYPE_CHECKING:
    from matplotlib.axes import Axes


# The paper's second point: 2.4 degrees at 16 % coverage, after 3.4 degrees on all.
PUBLISHED = ((1.0, 3.4), (0.16, 2.4))
PUBLISHED_COVERAGE = PUBLISHED[1][0]
# A median of fewer bearings is not drawn.
FEWEST = 10


def check_bearings(hops: HopTable, moving_rad: Sequence[Sequence[float]]) -> HopTable:
    """Compare the bearings of a run with the boxes that moved at the time of the bearing.

    `error_rad` is the bearing minus the azimuth of the nearest of them, NaN where none was in view.
    """
    check_shape("moving_rad", (len(moving_rad),), (len(hops),))
    at = [int(np.abs(hops.time_s - moment).argmin()) for moment in hops.time_s - hops.bearing_age_s]
    errors = [_nearest(angle, moving_rad[hop]) for angle, hop in zip(hops.bearing_rad, at, strict=True)]
    return HopTable({"prominence": hops.prominence, "error_rad": np.array(errors, dtype=np.float64)})


def bearing_curve(checks: HopTable) -> GatingCurve | NotUsable:
    """Trade coverage for accuracy, by the bearings that a moving box could check."""
    seen = np.isfinite(checks.error_rad)
    if not seen.any():
        return NotUsable("no bearing with a moving box in view")
    return gating_curve(checks.prominence[seen], checks.error_rad[seen])


def bearing_figures(checks: HopTable) -> dict[str, float | None]:
    """Return counts and medians; None where there is nothing to count."""
    curve, seen = bearing_curve(checks), np.isfinite(checks.error_rad)
    error = threshold = gated = None
    if not isinstance(curve, NotUsable):
        error = float(np.degrees(curve.median_error_rad[0]))
        threshold, gated_rad = curve.at_coverage(PUBLISHED_COVERAGE)
        gated = float(np.degrees(gated_rad))
    return {
        "bearings_in_view": int(seen.sum()),
        "bearing_median_deg": error,
        "bearing_gated_deg": gated,
        "gate_prominence": threshold,
        "prominence_in_view": _median(checks.prominence[seen]),
        "prominence_without": _median(checks.prominence[~seen]),
    }


def write_gating_figure(checks: HopTable, path: Path, title: str = "") -> None:
    """Draw the curve and the prominence with and without a box in view, and write them."""
    with figure_file(path, 8.0, 3.6) as figure:
        left, right = figure.subplots(1, 2)
        draw_gating(left, checks)
        _draw_presence(right, checks)
        figure.suptitle(title)


def draw_gating(axes: "Axes", checks: HopTable) -> None:
    """Draw the median error against the share of bearings kept, the paper's two points beside it."""
    curve = bearing_curve(checks)
    if not isinstance(curve, NotUsable):
        n = int(np.isfinite(checks.error_rad).sum())
        enough = curve.coverage * n >= min(FEWEST, n)
        axes.plot(curve.coverage[enough], np.degrees(curve.median_error_rad[enough]), label=f"{n} bearings")
    axes.plot(*np.transpose(PUBLISHED), "o", color="black", fillstyle="none", label="paper")
    axes.set(xlabel="share kept by prominence", ylabel="median bearing error (deg)", xlim=(1.03, 0.0))
    axes.set_ylim(bottom=0.0)
    axes.legend(fontsize="small")


def _draw_presence(axes: "Axes", checks: HopTable) -> None:
    seen = np.isfinite(checks.error_rad)
    groups = (("moving box in view", seen), ("none in view", ~seen))
    for name, rows in groups:
        if rows.any():
            axes.ecdf(checks.prominence[rows], label=name)
    axes.set(xlabel="prominence (peak over median)", ylabel="share below")
    axes.legend(fontsize="small")


def _nearest(bearing_rad: float, moving_rad: Sequence[float]) -> float:
    """Signed error to the nearest box, NaN without one."""
    errors = [wrap_angle(bearing_rad - azimuth) for azimuth in moving_rad]
    return min(errors, key=abs, default=float("nan"))


def _median(values: FloatArray) -> float | None:
    return float(np.median(values)) if values.size else None
