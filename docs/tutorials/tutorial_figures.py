"""Functions that the figures of the tutorials share."""

import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from worldstate import WorldState
from worldstate.operations.figure_style import DECISION, HIDDEN, SIDE_DASHES, TRUTH, figure_file
from worldstate.state import RiskCue


def tutorial_figure(script: str, width_in: float, height_in: float) -> AbstractContextManager[Any]:
    """Return an empty figure that is saved in out/tutorials under the name of the script."""
    path = Path("out/tutorials", Path(script).stem + ".svg")
    path.parent.mkdir(parents=True, exist_ok=True)
    return figure_file(path, width_in, height_in)


def chance(cue: RiskCue) -> float:
    """Return the probability that a vehicle comes into view from this side within three seconds."""
    return math.nan if cue.within is None else cue.within["3"]


def draw_sides(
    axes: Any,
    states: Sequence[WorldState],
    in_view_s: float | None = None,
    read: Callable[[RiskCue], float] = chance,
) -> None:
    """Draw a probability of both sides, shaded during an advisory, and the true time of coming into view."""
    time_s = [state.time_s for state in states]
    for cues, dashes in zip(zip(*(state.cues for state in states), strict=True), SIDE_DASHES, strict=False):
        values, on = [read(cue) for cue in cues], [cue.advisory is not None for cue in cues]
        axes.plot(time_s, values, dashes, color=HIDDEN, label=cues[0].direction)
        axes.fill_between(time_s, values, where=on, color=DECISION, alpha=0.2, linewidth=0.0)
    axes.set(ylim=(0.0, 1.0))
    if in_view_s is not None:
        axes.axvline(in_view_s, color=TRUTH, linestyle=":", label="in view")
