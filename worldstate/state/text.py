"""The text of a state, of at most three lines, for a prompt or a notebook."""

import math
from collections.abc import Iterable, Sequence
from textwrap import shorten

from worldstate.ground.values import NotUsable
from worldstate.measurement.measurement import Bearing

from .cue import RiskCue
from .entity import Entity

MOST_LINES, MOST_CHARACTERS = 3, 240
# A vehicle in view is printed if it more likely exists than not.
_LIKELY = 0.5


def state_text(time_s: float, lines: Iterable[str]) -> str:
    """Return a state as `print` shows it: at most three lines and 240 characters.

    Examples
    --------
    >>> state_text(1.5, ["no measurement yet"])
    '1.5 s  no measurement yet'
    """
    at = f"{time_s:.1f} s  "
    whole = at + f"\n{' ' * len(at)}".join(list(lines)[:MOST_LINES])
    return whole if len(whole) <= MOST_CHARACTERS else whole[: MOST_CHARACTERS - 3] + "..."


def state_lines(
    measured: bool,
    cues: Sequence[RiskCue],
    entities: Sequence[Entity],
    bearing: Bearing | None,
    no_model: NotUsable | None,
) -> list[str]:
    """Return a line for each advisory, or one for the risks, and one for a vehicle in view.

    Examples
    --------
    >>> state_lines(True, (), (), None, NotUsable("no model was made for this array"))
    ['no sound with a direction; no risk: no model was made for this array']
    """
    sides = [cue for cue in cues if cue.direction]
    if no_model is not None:
        sound = (
            "no sound with a direction" if bearing is None else f"sound from {towards(bearing.azimuth_rad)}"
        )
        lines = [f"{sound}; no risk: {shorten(plain(no_model.reason), 100)}"]
    elif not sides:
        lines = ["no risk can be stated" if measured else "no measurement yet"]
    else:
        hidden = {one.id: one for one in entities if one.status == "hidden"}
        advised = [_advised(cue, hidden.get(cue.entity_id or "")) for cue in sides if cue.advisory]
        lines = advised or [_quiet(sides)]
    in_view = [one for one in entities if one.moving and one.status in ("visible", "emerged")]
    likeliest = max(in_view, key=lambda one: one.existence_probability, default=None)
    if likeliest is not None and likeliest.existence_probability >= _LIKELY:
        lines.append(f"in view: {_kind(likeliest)} at {towards(likeliest.azimuth_rad)}")
    return lines


def _advised(cue: RiskCue, entity: Entity | None) -> str:
    # A vehicle of unknown side has an azimuth for each side.
    parts = () if entity is None else entity.on_each_side()
    here = next((part for part in parts if part.direction == cue.direction), entity)
    place = f"hidden {_kind(entity)} at {towards((here or cue).azimuth_rad)}"
    risk = "unknown" if cue.risk is None else f"{cue.risk:.2f}"
    times = cue.time_to_visible_s and "{1:.1f} s ({0:.1f} to {2:.1f})".format(*cue.time_to_visible_s)
    when = f"in view in {times}" if times else ""
    words = filter(None, (f"ADVISORY{_unless_usable([cue])}", f"risk {risk}", place, when))
    return f"{plain(cue.direction)}: {', '.join(words)}"


def _quiet(sides: Sequence[RiskCue]) -> str:
    risks = ", ".join(f"{cue.risk:.2f} {plain(cue.direction)}" for cue in sides if cue.risk is not None)
    return f"no advisory{_unless_usable(sides)}, risk {risks or 'unknown'}"


def _unless_usable(cues: Sequence[RiskCue]) -> str:
    reasons = dict.fromkeys(reason for cue in cues for reason in cue.why_not)
    return f" (not usable: {', '.join(reasons)})" if reasons else ""


def _kind(entity: Entity | None) -> str:
    known = () if entity is None else entity.classification or ()
    likeliest = max(known, key=lambda one: one.probability, default=None)
    return "vehicle" if likeliest is None or likeliest.label == "unknown" else plain(likeliest.label)


def towards(azimuth_rad: float) -> str:
    """Return an azimuth in words.

    Examples
    --------
    >>> towards(-0.84), towards(0.0)
    ('48 degrees right', 'straight ahead')
    """
    degrees = round(math.degrees(azimuth_rad))
    return f"{abs(degrees)} degrees {'left' if degrees > 0 else 'right'}" if degrees else "straight ahead"


def plain(name: str | None) -> str:
    r"""Return a name without characters that break a line or control a terminal.

    Examples
    --------
    >>> plain("a\tb\x1b")
    'a b'
    """
    return " ".join("".join(one if one.isprintable() else " " for one in name or "").split())
