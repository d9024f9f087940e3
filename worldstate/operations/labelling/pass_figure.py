"""Bird's-eye of the passes of a recording: smoothed tracks with ellipses, edges as learned, and the truth."""

from collections.abc import Sequence
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from worldstate.ground.typing import BoolArray
from worldstate.operations.figure_style import BLUE, GREEN, ORANGE, figure_file, legend_beside
from worldstate.operations.recordings.true_track import TrueTrack
from worldstate.smoothing.learned_street import LearnedStreet, context_of, with_pass
from worldstate.smoothing.smoothed_track import SmoothedTrack

from .pass_labels import PassLabel
from .street_figure import draw_edge
from .street_passes import street_pass

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_EVERY = 5  # Half a second apart, they can still be told from one another
_FARTHEST_M = 40.0
_COLOURS = {"left": BLUE, "right": ORANGE}
_SAME_PASS_S = 2.0  # Of T0: who comes within it of another is mostly not seen apart


def write_pass_figure(
    passes: Sequence[PassLabel], path: Path, title: str, truth: Sequence[TrueTrack] = ()
) -> None:
    """Draw every pass seen from above, the ego at the origin and looking up; hidden parts are dashed."""
    with figure_file(path, 8.5, 3.4) as figure:
        axes = figure.add_subplot(title=title)
        draw_passes(axes, passes, truth)
        legend_beside(axes)


def draw_passes(axes: "Axes", passes: Sequence[PassLabel], truth: Sequence[TrueTrack] = ()) -> None:
    """Draw smoothed tracks, the edges that these passes tell, and the true tracks of the same vehicles."""
    street = reduce(with_pass, map(street_pass, passes), LearnedStreet())
    for occluder in context_of(street).occluders:
        # Of an arm that nobody came out of, nothing is known.
        if not occluder.assumed:
            draw_edge(axes, occluder, "0.5")
    for one in passes:
        draw_track(
            axes, one.track, one.track.time_s < one.t0.time_s, _COLOURS[one.arm], f"{one.arm}, smoothed"
        )
        _draw_truth(axes, one, truth)
    axes.plot(0.0, 0.0, "k^", markersize=9)
    span = {"xlim": (_FARTHEST_M, -_FARTHEST_M), "ylim": (-4.0, 25.0)}
    axes.set(**span, xlabel="left, m", ylabel="ahead, m", aspect="equal")


def draw_track(axes: "Axes", track: SmoothedTrack, hidden: BoolArray, color: str, label: str) -> None:
    """Draw a track with an ellipse of two deviations every half second; hidden parts are dashed."""
    from matplotlib.patches import Ellipse

    states = track.states
    # The first state in view ends the hidden part, too: it is one vehicle.
    for part, style in ((hidden | np.roll(hidden, 1), "--"), (~hidden, "-")):
        axes.plot(*states[part, 1::-1].T, style, color=color, label=label)
    for place, spread in zip(states[::_EVERY], track.covariance[::_EVERY], strict=True):
        lengths, axis = np.linalg.eigh(spread[:2, :2])
        angle = np.degrees(np.arctan2(axis[0, 1], axis[1, 1]))
        # Four deviations from end to end hold .86 of a Gaussian of two dimensions.
        sides = 4.0 * np.sqrt(lengths[::-1])
        axes.add_patch(Ellipse((place[1], place[0]), *sides, angle=angle, fill=False, color=color, alpha=0.3))


def _draw_truth(axes: "Axes", one: PassLabel, truth: Sequence[TrueTrack]) -> None:
    seen = [(abs(true.visible_s[0] - one.t0.time_s), i) for i, true in enumerate(truth) if true.visible_s]
    off_s, nearest = min(seen, default=(np.inf, 0))
    if off_s > _SAME_PASS_S:
        return
    true = truth[nearest]
    during = (true.time_s >= one.track.time_s[0]) & (true.time_s <= one.track.time_s[-1])
    axes.plot(*true.position_m[during, ::-1].T, ":", color=GREEN, linewidth=2.0, label="truth")
