"""Bird's-eye view of a learned street, and of the passes of a recording with their smoothed tracks."""

import math
from collections.abc import Sequence
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from worldstate.adapters.datasets.ovad import TrueTrack
from worldstate.ground.typing import BoolArray
from worldstate.operations.figure_style import HIDDEN, IN_VIEW, SIDE_DASHES, TRUTH, figure_file, legend_beside
from worldstate.smoothing.learned_street import LearnedStreet, context_of, with_pass
from worldstate.smoothing.observations import SmoothedTrack
from worldstate.state.context import Occluder

from .pass_labels import PassLabel
from .street_passes import street_pass

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Bearings have no range, so positions are drawn on a lane at this distance ahead, as at OVAD's junctions.
_LANE_M = 9.0
_BEFORE_S, _APART_M = (1.0, 2.0, 3.0), 1.3  # Rows of the drawing, far enough apart to show all bars
_WIDEST_M, _COLUMNS = 26.0, 2
_EVERY = 5  # Hops between ellipses; half a second apart they can be distinguished
_FARTHEST_M = 40.0
_DASHES = dict(zip(("left", "right"), SIDE_DASHES, strict=False))
_EDGE = "0.35"  # Occluders are no vehicles, so they are grey
_SAME_PASS_S = 2.0  # Difference of T0; closer vehicles are mostly not resolved


def write_street_figure(stages: Sequence[tuple[str, LearnedStreet]], path: Path) -> None:
    """Draw a street at several stages side by side, with the ego at the origin, ahead at the top.

    The edge is filled up to two standard deviations on either side. The dots of a row show the median driver
    1, 2 or 3 s before line of sight; bars show one standard deviation of pace.
    """
    columns = min(len(stages), _COLUMNS)
    rows = math.ceil(len(stages) / columns)
    with figure_file(path, 4.6 * columns, 1.9 * rows) as figure:
        for number, (title, street) in enumerate(stages, start=1):
            axes = figure.add_subplot(rows, columns, number)
            for occluder, arm in zip(context_of(street).occluders, street.arms, strict=True):
                _draw_learned(axes, occluder, arm.pace_spread)
            axes.plot(0.0, 0.0, "k^", markersize=8)
            axes.set(xlim=(_WIDEST_M, -_WIDEST_M), ylim=(-1.0, 15.0), title=title, aspect="equal")
            axes.set(
                xlabel="left, m" if number > len(stages) - columns else "",
                ylabel="ahead, m" if number % columns == 1 % columns else "",
            )


def draw_edge(axes: "Axes", one: Occluder) -> None:
    """Draw the line of sight past an edge, with two standard deviations on either side."""
    low, high = (_aside_m(one.edge_azimuth_rad + k * one.edge_std_rad) for k in (-2.0, 2.0))
    axes.fill([0.0, low, high], [0.0, _LANE_M, _LANE_M], color=_EDGE, alpha=0.25, linewidth=0.0)
    axes.plot([0.0, _aside_m(one.edge_azimuth_rad)], [0.0, _LANE_M], color=_EDGE, label="edge, as learned")


def _draw_learned(axes: "Axes", one: Occluder, pace_spread: float) -> None:
    draw_edge(axes, one)
    for row, time_s in enumerate(_BEFORE_S, start=1):
        ahead_m = _LANE_M + _APART_M * row
        factors = math.exp(-pace_spread), 1.0, math.exp(pace_spread)
        slow, usual, fast = (_place_m(one, factor, time_s) for factor in factors)
        axes.plot([slow, fast], [ahead_m, ahead_m], color=HIDDEN, alpha=0.3, linewidth=4.0)
        axes.plot(usual, ahead_m, "o", color=HIDDEN, markersize=4)


def _aside_m(azimuth_rad: float) -> float:
    return _LANE_M * math.tan(azimuth_rad)


def _place_m(one: Occluder, factor: float, time_s: float) -> float:
    """Return a vehicle's position at a time before line of sight, metres to the left on the drawn lane."""
    slope = math.tan(abs(one.edge_azimuth_rad)) + factor * one.pace_hz * time_s
    return math.copysign(_LANE_M * slope, one.edge_azimuth_rad)


def write_pass_figure(
    passes: Sequence[PassLabel], path: Path, title: str, truth: Sequence[TrueTrack] = ()
) -> None:
    """Draw every pass from above, with the ego at the origin, ahead at the top."""
    with figure_file(path, 8.5, 2.8) as figure:
        axes = figure.add_subplot(title=title)
        draw_passes(axes, passes, truth)
        legend_beside(axes)


def draw_passes(axes: "Axes", passes: Sequence[PassLabel], truth: Sequence[TrueTrack] = ()) -> None:
    """Draw smoothed tracks, the edges learned from these passes, and the true tracks of the same vehicles."""
    street = reduce(with_pass, map(street_pass, passes), LearnedStreet())
    for occluder in context_of(street).occluders:
        # An arm without a pass is unknown.
        if not occluder.assumed:
            draw_edge(axes, occluder)
    for one in passes:
        hidden = one.track.time_s < one.t0.time_s
        draw_track(axes, one.track, hidden, _DASHES[one.arm], f"{one.arm}, smoothed")
        _draw_truth(axes, one, truth)
    axes.plot(0.0, 0.0, "k^", markersize=9)
    span = {"xlim": (_FARTHEST_M, -_FARTHEST_M), "ylim": (-4.0, 25.0)}
    axes.set(**span, xlabel="left, m", ylabel="ahead, m", aspect="equal")


def draw_track(axes: "Axes", track: SmoothedTrack, hidden: BoolArray, dashes: str, label: str) -> None:
    """Draw a track with an ellipse of two deviations every half second, coloured as hidden or in view."""
    from matplotlib.patches import Ellipse

    states = track.states
    # The hidden part includes the first state in view, so that the track is connected.
    unseen = hidden | np.roll(hidden, 1)
    for part, color, shown in ((unseen, HIDDEN, "hidden"), (~hidden, IN_VIEW, "in view")):
        axes.plot(*states[part, 1::-1].T, dashes, color=color, label=f"{label}, {shown}")
    spreads = track.covariance[::_EVERY]
    for place, spread, was_hidden in zip(states[::_EVERY], spreads, hidden[::_EVERY], strict=True):
        color = HIDDEN if was_hidden else IN_VIEW
        lengths, axis = np.linalg.eigh(spread[:2, :2])
        angle = np.degrees(np.arctan2(axis[0, 1], axis[1, 1]))
        # An ellipse of two deviations contains 86 % of a two-dimensional Gaussian.
        sides = 4.0 * np.sqrt(lengths[::-1])
        axes.add_patch(Ellipse((place[1], place[0]), *sides, angle=angle, fill=False, color=color, alpha=0.3))


def _draw_truth(axes: "Axes", one: PassLabel, truth: Sequence[TrueTrack]) -> None:
    seen = [(abs(true.visible_s[0] - one.t0.time_s), i) for i, true in enumerate(truth) if true.visible_s]
    off_s, nearest = min(seen, default=(np.inf, 0))
    if off_s > _SAME_PASS_S:
        return
    true = truth[nearest]
    during = (true.time_s >= one.track.time_s[0]) & (true.time_s <= one.track.time_s[-1])
    axes.plot(*true.position_m[during, ::-1].T, ":", color=TRUTH, linewidth=2.0, label="truth")
