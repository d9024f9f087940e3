"""View of a run in a terminal: bearing, risk of each side, entities and lost sound."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from worldstate.adapters.live.live_listening import LiveStep
from worldstate.state import Entity, RiskCue, WorldState

from .output import printable

# Every second state: ten per second cannot be read, and drawing takes some milliseconds.
_SHOWN_EVERY_NS = 200_000_000
# Characters of the azimuth scale from 90 degrees left to 90 degrees right, one per five degrees.
_SCALE = 37
_BAR = 20
# More cannot be read at a glance.
_MOST_ENTITIES = 6


@contextmanager
def live_view() -> Iterator[Callable[[LiveStep], None]]:
    """Yield a function that shows a hop on standard error."""
    console, last_ns = Console(stderr=True), -_SHOWN_EVERY_NS
    with Live(console=console, auto_refresh=False, transient=True) as screen:

        def show(live: LiveStep) -> None:
            nonlocal last_ns
            stamp_ns = live.step.state.stamp_ns
            if stamp_ns - last_ns >= _SHOWN_EVERY_NS:
                last_ns = stamp_ns
                screen.update(view_of(live), refresh=True)

        yield show


def view_of(live: LiveStep) -> RenderableType:
    """Return one screen."""
    state = live.step.state
    late = f"latency {1e3 * live.latency_s:.0f} ms"
    lost = f"{live.overruns} overruns, {live.lost_s:.2f} s lost"
    head = Text(f"{state.time_s:9.1f} s   {late}   ")
    head.append(lost, style="red" if live.overruns else "green")
    return Group(head, _bearing(state), *map(_cue, state.cues), _entities(state.entities))


def _bearing(state: WorldState) -> Text:
    if state.bearing is None:
        return Text("left  " + "·" * _SCALE + "  right   no bearing", style="dim")
    azimuth, std_deg = state.bearing.azimuth_rad, math.degrees(state.bearing.std_rad)
    # A bearing behind the vehicle is shown at the nearer end.
    place = round((0.5 - max(min(azimuth / math.pi, 0.5), -0.5)) * (_SCALE - 1))
    scale = "·" * place + "●" + "·" * (_SCALE - 1 - place)
    return Text(f"left  {scale}  right   {math.degrees(azimuth):+.0f} ± {std_deg:.0f} deg")


def _cue(cue: RiskCue) -> Text:
    line = Text(printable(f"{cue.direction or '?':<6}"), style="bold")
    if cue.risk is not None:
        filled = round(cue.risk * _BAR)
        line.append("█" * filled + "─" * (_BAR - filled), style="red" if cue.advisory else "yellow")
        line.append(f"  risk {cue.risk:.2f}", style="default")
    if cue.advisory:
        line.append("  ADVISORY", style="bold red")
    line.append("" if cue.usable else f"  not usable: {', '.join(cue.why_not)}", style="bold red")
    return line


def _entities(entities: tuple[Entity, ...]) -> Table:
    table = Table("entity", "status", "exists", "azimuth", "is", box=None, padding=(0, 2, 0, 0))
    likeliest = sorted(entities, key=lambda one: -one.existence_probability)[:_MOST_ENTITIES]
    for one in likeliest:
        classes = one.classification or ()
        label = max(classes, key=lambda said: said.probability).label if classes else ""
        azimuth = f"{math.degrees(one.azimuth_rad):+.0f} ± {math.degrees(one.azimuth_std_rad):.0f} deg"
        cells = one.id[:8], one.status or "heard", f"{one.existence_probability:.2f}", azimuth, label
        table.add_row(*(Text(printable(cell)) for cell in cells))  # rich parses plain strings as markup
    return table
