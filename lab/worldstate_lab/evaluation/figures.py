"""Every figure of an evaluation: its title, its decimals and how it is counted; and what the paper states.

Our figures stand in `figures.csv`. A mean of the rates of single recordings would let one of ten seconds
weigh as much as a stream of an hour: a figure is a ratio of sums. Those a recording are the challenge's: each
one with a vehicle in view counts once. Every number of the paper's sections IV, VII, VIII and IX stands in
`paper_values.csv`, in the order of the paper; the text says .881 where Table I prints .88: both are 37 of 42.
"""

import csv
import math
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np

from worldstate.ground.values import SECONDS_PER_HOUR
from worldstate.operations.recordings.hop_table import HOP_S

_UNITS = {"": 1.0, "per hour": 1.0 / (HOP_S / SECONDS_PER_HOUR), "degrees": float(np.degrees(1.0))}


@dataclass(frozen=True, slots=True)
class FigureKind:
    """What is printed of a figure, and the ratio of sums over recordings that it is, where it is one."""

    title: str
    digits: int  # Decimals that the numbers of recordings at hand can bear
    worse: str  # The worse end, where junctions are compared: low, high or empty
    counts: tuple[str, str]  # See `reduction`; empty where it is no ratio of sums
    unit: float

    @property
    def words(self) -> str:
        """The title without its unit."""
        return self.title.partition(" (")[0]


def _rows(name: str) -> list[dict[str, Any]]:
    text = files(__package__).joinpath(name).read_text(encoding="utf-8")
    return list(csv.DictReader(text.splitlines()))


def _kind(row: dict[str, Any]) -> FigureKind:
    counts = row["above"], row["below"]
    return FigureKind(row["title"], int(row["digits"]), row["worse"], counts, _UNITS[row["unit"]])


FIGURES = {row["figure"]: _kind(row) for row in _rows("figures.csv")}


def titles(figures: Iterable[str]) -> tuple[str, ...]:
    """Return the titles of figures, as heads of columns."""
    return tuple(FIGURES[name].title for name in figures)


# What fills a number, by what it stands on: the positions of the microphones, this machine, OVAD's sound and
# video, the sound of the two roadside corpora; "stated" is said of the data or the setting and is no outcome.
COMMANDS = {
    "array": "worldstate array bounds",
    "machine": "worldstate-lab bench",
    "ovad": "worldstate-lab table OVAD --out DIR",
    "corpora": "worldstate-lab corpora --idmt IDMT --melaudis MELAUDIS --out DIR",
    "stated": "",
}


@dataclass(frozen=True, slots=True)
class PaperValue:
    """One number of the paper: where it stands, what it means, and its interval if the paper gives one."""

    section: str
    basis: str  # One of `COMMANDS`
    group: str  # Name of the protocol, or part of the paper
    row: str  # Method, or condition
    figure: str  # As `Score.figures` names it, where it does
    value: float
    low: float
    high: float
    unit: str

    @property
    def digits(self) -> int:
        """Decimals with which the paper prints it, such as 3 of 0.881 and 2 of 0.70."""
        stated = len(f"{self.value:.10g}".partition(".")[2])
        # A float keeps no trailing zero; shares and areas have two decimals everywhere in the paper.
        return max(stated, 2) if stated and self.unit in ("share", "") else stated


def _stated(row: dict[str, Any]) -> PaperValue:
    numbers = {name: float(row[name] or math.nan) for name in ("value", "low", "high")}
    return PaperValue(**(row | numbers))


PAPER_VALUES = tuple(map(_stated, _rows("paper_values.csv")))
_BY_NAME = {(one.group, one.row, one.figure): one for one in PAPER_VALUES}


def paper_value(group: str, row: str, figure: str) -> PaperValue | None:
    """Return what the paper states there, None where it states nothing.

    Examples
    --------
    >>> paper_value("static", "proposed .02", "lead_s").value
    1.69
    """
    return _BY_NAME.get((group, row, figure))
