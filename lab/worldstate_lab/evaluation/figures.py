"""Every figure of an evaluation: its title with the unit, its decimals, and how it is counted.

They stand in `figures.csv`. A mean of the rates of single recordings would let one of ten seconds weigh as
much as a stream of an hour: a figure is a ratio of sums. Those a recording are the challenge's: each one with
a vehicle in view counts once.
"""

import csv
from dataclasses import dataclass
from importlib.resources import files

import numpy as np

from worldstate.operations.metrics.approach_table import SECONDS_PER_HOUR
from worldstate.operations.recordings.hop_stream import HOP_S

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


def _read() -> dict[str, FigureKind]:
    text = files(__package__).joinpath("figures.csv").read_text(encoding="utf-8")
    return {
        name: FigureKind(title, int(digits), worse, (above, below), _UNITS[unit])
        for name, title, digits, worse, above, below, unit in list(csv.reader(text.splitlines()))[1:]
    }


FIGURES = _read()
