"""Figures of an evaluation with title, decimals and definition, and the values that the paper states.

Our figures are defined in `figures.csv`. Each is a ratio of sums over recordings, because in a mean of rates
a recording of ten seconds would weigh as much as a stream of one hour. Figures per recording follow the
challenge: each recording with a vehicle in view counts once. `paper_values.csv` lists every number of the
paper's sections IV, VII, VIII and IX in the order of the paper. The text of the paper has 0.881 where Table I
has 0.88; both are 37 of 42.
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
    """How a figure is printed, and the two sums over recordings of which it is the ratio, if it is one."""

    title: str
    digits: int  # Printed decimals, as many as the number of recordings supports
    worse: str  # Which end is worse when junctions are compared: low, high or empty
    # Numerator and denominator, see `reduction`; empty if the figure is not a ratio of sums
    counts: tuple[str, str]
    unit: float


def _rows(name: str) -> list[dict[str, Any]]:
    text = files(__package__).joinpath(name).read_text(encoding="utf-8")
    return list(csv.DictReader(text.splitlines()))


FIGURES = {
    row["figure"]: FigureKind(
        row["title"], int(row["digits"]), row["worse"], (row["above"], row["below"]), _UNITS[row["unit"]]
    )
    for row in _rows("figures.csv")
}


def titles(figures: Iterable[str]) -> tuple[str, ...]:
    """Return the titles of figures, used as column heads."""
    return tuple(FIGURES[name].title for name in figures)


# The command that computes a number, by the data that the number requires: microphone positions, this
# machine, OVAD's sound and video, or the sound of the two roadside corpora. "stated" marks properties of the
# data or settings, which are no results.
COMMANDS = {
    "array": "worldstate array bounds",
    "machine": "worldstate-lab bench",
    "ovad": "worldstate-lab table OVAD --out DIR",
    "corpora": "worldstate-lab corpora --idmt IDMT --melaudis MELAUDIS --out DIR",
    "stated": "",
}


@dataclass(frozen=True, slots=True)
class PaperValue:
    """One number of the paper: its place and meaning, and its interval if the paper gives one."""

    section: str
    basis: str  # A key of `COMMANDS`
    group: str  # Name of the protocol, or of a part of the paper
    row: str  # Name of a method or condition
    figure: str  # Key in `Score.figures`, if it has one
    value: float
    low: float
    high: float
    unit: str

    @property
    def digits(self) -> int:
        """Number of decimals that the paper prints, such as 3 in 0.881 and 2 in 0.70."""
        stated = len(f"{self.value:.10g}".partition(".")[2])
        # A float has no trailing zeros; the paper prints shares and areas with at least two decimals.
        return max(stated, 2) if stated and self.unit in ("share", "") else stated


PAPER_VALUES = tuple(
    PaperValue(**(row | {name: float(row[name] or math.nan) for name in ("value", "low", "high")}))
    for row in _rows("paper_values.csv")
)
_BY_NAME = {(one.group, one.row, one.figure): one for one in PAPER_VALUES}


def paper_value(group: str, row: str, figure: str) -> PaperValue | None:
    """Return the number that the paper states for a figure, or None if it states none.

    Examples
    --------
    >>> paper_value("static", "proposed .02", "lead_s").value
    1.69
    """
    return _BY_NAME.get((group, row, figure))
