"""Shadow operation: onset rates by site, day and state of the sensors, with every advisory taken as false.

Advisories about real vehicles are included, so the rates are upper bounds of the false-alarm rate.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import astuple, dataclass
from html import escape
from importlib.resources import files
from pathlib import Path

from worldstate.adapters.files.file_io import write_text
from worldstate.ground.checks import in_range
from worldstate.ground.values import SECONDS_PER_HOUR
from worldstate.operations.metrics.approach_table import poisson_interval
from worldstate.operations.recordings.hop_table import HOP_S

from .corpus_tables import StateHours

_WHOLE = 1000.0  # Numbers from here on are printed without decimals or exponent
# Largest number of rows in a table of the page; the tables of the corpus contain all.
_MOST_ROWS = 40
_GROUPS: Mapping[str, Callable[[StateHours], str]] = {
    "all": lambda row: "all recordings",
    "site": lambda row: row.site or "no site named",
    "day": lambda row: row.day or "no date",
    "state of the sensors": lambda row: row.sensors or "no sensor",
    "why unheard": lambda row: row.unheard or "heard",
}


@dataclass(frozen=True, slots=True)
class ShadowHours:
    """Hours and onsets of one group of recordings."""

    name: str
    heard_hours: float
    unheard_hours: float
    onsets: int
    onsets_per_hour: float | None  # Onsets per usable hour, with the exact 95 % interval; None without any
    low: float | None
    high: float | None
    more_hours: float | None  # Hours until the interval is below the budget; None if it never is

    def __str__(self) -> str:
        """Return the hours and the rate in one line."""
        rate = "no hour heard"
        if self.onsets_per_hour is not None:
            rate = f"{_cell(self.onsets_per_hour)} onsets/h [{_cell(self.low)}, {_cell(self.high)}]"
        heard, unheard = _cell(self.heard_hours), _cell(self.unheard_hours)
        return f"{self.name}: {heard} h heard, {unheard} h unheard, {rate}"


def shadow_hours(rows: Iterable[StateHours], budget: float | None) -> dict[str, list[ShadowHours]]:
    """Return hours and onsets of all recordings, then by site, day, sensor state and reason if unusable.

    Examples
    --------
    >>> week = [StateHours("a.wav", "elm street", None, "acoustic working", None, 36_000, 1)]
    >>> print(shadow_hours(week, budget=6.0)["site"][0])
    elm street: 1 h heard, 0 h unheard, 1 onsets/h [0.0253, 5.57]
    """
    kept, found = list(rows), {}
    for group, name_of in _GROUPS.items():
        counts: dict[str, list[int]] = {}
        for row in kept:
            count = counts.setdefault(name_of(row), [0, 0, 0])
            count[row.unheard is not None] += row.hops
            count[2] += row.onsets
        found[group] = [_hours(name, count, budget) for name, count in sorted(counts.items())]
    return found


def _hours(name: str, count: list[int], budget: float | None) -> ShadowHours:
    hours, unheard_hours = (hops * HOP_S / SECONDS_PER_HOUR for hops in count[:2])
    onsets = count[2]
    if not hours:
        return ShadowHours(name, 0.0, unheard_hours, onsets, None, None, None, None)
    more = None if budget is None else hours_to_prove(onsets, hours, budget)
    interval = poisson_interval(onsets, hours)
    return ShadowHours(name, hours, unheard_hours, onsets, onsets / hours, *interval, more)


def hours_to_prove(onsets: int, hours: float, budget: float) -> float | None:
    r"""Return after how many more hours the 95 % interval of the rate is below a budget; None if never.

    If onsets continue at the observed rate r, the total time is the least T with

    .. math:: \chi^2_{0.975}(2 r T + 2) / 2T \le b

    Examples
    --------
    >>> round(hours_to_prove(0, hours=1.0, budget=1.0), 2), hours_to_prove(3, hours=1.0, budget=1.0)
    (2.69, None)
    """
    rate = onsets / in_range("hours", hours, 0.0, math.inf, open_low=True)
    low = high = hours
    while poisson_interval(rate * high, high)[1] > budget:
        low, high = high, 2.0 * high
        if rate >= budget or not math.isfinite(high):
            return None
    while high - low > 1e-6 * high:
        middle = 0.5 * (low + high)
        over = poisson_interval(rate * middle, middle)[1] > budget
        low, high = (middle, high) if over else (low, middle)
    return high - hours


_HEADS = "", "h heard", "h unheard", "onsets", "per h", "from", "to", "more h"


def write_shadow_page(path: Path, week: Mapping[str, list[ShadowHours]], title: str) -> None:
    """Write a self-contained HTML page for a browser."""
    tables = []
    for group, rows in week.items():
        heads = "".join(f"<th>{escape(one or group)}</th>" for one in _HEADS)
        cells = (
            "".join(f"<td>{escape(_cell(one))}</td>" for one in astuple(row)) for row in rows[:_MOST_ROWS]
        )
        more = f"<caption>{len(rows) - _MOST_ROWS} more</caption>" * (len(rows) > _MOST_ROWS)
        lines = "".join(f"<tr>{row}</tr>\n" for row in cells)
        tables.append(f"<table>{more}<tr>{heads}</tr>\n{lines}</table>\n")
    template = (files("worldstate") / "data" / "shadow.html").read_text("utf-8")
    write_text(path, template.replace("@title@", escape(title)).replace("@tables@", "".join(tables)))


def _cell(value: object) -> str:
    if not isinstance(value, float):
        return "-" if value is None else str(value)
    return f"{value:.3g}" if value < _WHOLE else f"{value:.0f}"
