"""Prominence gating on bearings that a camera could check: coverage against accuracy, and presence.

As in the paper's section on front-end accuracy: while the vehicle is in view, a bearing is compared with the
moving box that stands nearest to it.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from worldstate.frontend.direction.gating import GatingCurve, gating_curve
from worldstate.ground.checks import check_shape
from worldstate.ground.typing import BoolArray, FloatArray
from worldstate.ground.values import NotUsable, wrap_angle
from worldstate.operations.figure_style import figure_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes


# The paper's second point: 2.4 degrees at 16 % coverage, after 3.4 degrees on all.
PUBLISHED = ((1.0, 3.4), (0.16, 2.4))
PUBLISHED_COVERAGE = PUBLISHED[1][0]
# A median of fewer bearings is not drawn.
FEWEST = 10


@dataclass(frozen=True, slots=True, eq=False)
class BearingChecks:
    """Bearings with the prominence they were read with, and their errors where a box was there.

    Examples
    --------
    >>> checks = BearingChecks(np.array([1.1, 1.2, 2.0, 3.0]), np.array([np.nan, 0.3, 0.02, 0.01]))
    >>> checks.figures()["bearings_in_view"], checks.curve().coverage.round(2)
    (3, array([1.  , 0.67, 0.33]))
    """

    prominence: FloatArray  # shape (n,): Peak-to-median ratios, >= 1
    # shape (n,): Bearing minus azimuth of the nearest moving box; NaN where none was in view.
    error_rad: FloatArray

    def __post_init__(self) -> None:
        check_shape("error_rad", np.shape(self.error_rad), np.shape(self.prominence))

    @property
    def in_view(self) -> BoolArray:
        """Where a moving box was in view, shape (n,)."""
        return np.isfinite(self.error_rad)

    def curve(self) -> GatingCurve | NotUsable:
        """Trade coverage for accuracy."""
        seen = self.in_view
        if not seen.any():
            return NotUsable("no bearing with a moving box in view")
        return gating_curve(self.prominence[seen], self.error_rad[seen])

    def figures(self) -> dict[str, float | None]:
        """Return counts and medians; None where there is nothing to count."""
        curve = self.curve()
        error = threshold = gated = None
        if not isinstance(curve, NotUsable):
            error = float(np.degrees(curve.median_error_rad[0]))
            threshold, gated_rad = curve.at_coverage(PUBLISHED_COVERAGE)
            gated = float(np.degrees(gated_rad))
        return {
            "bearings_in_view": int(self.in_view.sum()),
            "bearing_median_deg": error,
            "bearing_gated_deg": gated,
            "gate_prominence": threshold,
            "prominence_in_view": _median(self.prominence[self.in_view]),
            "prominence_without": _median(self.prominence[~self.in_view]),
        }


def joined(parts: Iterable[BearingChecks]) -> BearingChecks:
    """Put the bearings of several recordings together.

    Examples
    --------
    >>> part = BearingChecks(np.array([1.5]), np.array([0.1]))
    >>> joined([part, part]).prominence
    array([1.5, 1.5])
    """
    kept = list(parts)
    prominence, error = (np.concatenate([getattr(p, k) for p in kept]) for k in ("prominence", "error_rad"))
    return BearingChecks(prominence, error)


def check_bearings(
    time_s: Sequence[float],
    age_s: Sequence[float],
    bearing_rad: Sequence[float],
    prominence: Sequence[float],
    moving_rad: Sequence[Sequence[float]],
) -> BearingChecks:
    """Compare the bearings of a run with what the camera saw moving when they were heard.

    Examples
    --------
    >>> boxes, heard = [[0.3], [0.2], [0.1, -1.0]], [0.3, 0.31, 0.18]
    >>> check_bearings([0.1, 0.2, 0.3], [0.1] * 3, heard, [1.5, 1.5, 2.0], boxes).error_rad.round(2)
    array([ 0.  ,  0.01, -0.02])
    """
    time, bearing = np.array(time_s, dtype=np.float64), np.array(bearing_rad, dtype=np.float64)
    check_shape("moving_rad", (len(moving_rad),), time.shape)
    heard = time - np.array(age_s, dtype=np.float64)
    at = [int(np.abs(time - moment).argmin()) for moment in heard]
    errors = [_nearest(angle, moving_rad[hop]) for angle, hop in zip(bearing.tolist(), at, strict=True)]
    return BearingChecks(np.array(prominence, dtype=np.float64), np.array(errors, dtype=np.float64))


def write_gating_figure(checks: BearingChecks, path: Path, title: str = "") -> None:
    """Draw the curve and what prominence says of presence, and write both by the ending of `path`."""
    with figure_file(path, 8.0, 3.6) as figure:
        left, right = figure.subplots(1, 2)
        draw_gating(left, checks)
        _draw_presence(right, checks)
        figure.suptitle(title)


def draw_gating(axes: "Axes", checks: BearingChecks) -> None:
    """Draw the median error against the share of bearings kept, the paper's two points beside it."""
    curve = checks.curve()
    if not isinstance(curve, NotUsable):
        n = int(checks.in_view.sum())
        enough = curve.coverage * n >= min(FEWEST, n)
        axes.plot(curve.coverage[enough], np.degrees(curve.median_error_rad[enough]), label=f"{n} bearings")
    axes.plot(*np.transpose(PUBLISHED), "o", color="black", fillstyle="none", label="paper")
    axes.set(xlabel="share kept by prominence", ylabel="median bearing error (deg)", xlim=(1.03, 0.0))
    axes.set_ylim(bottom=0.0)
    axes.legend(fontsize="small")


def _draw_presence(axes: "Axes", checks: BearingChecks) -> None:
    groups = (("moving box in view", checks.in_view), ("none in view", ~checks.in_view))
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
