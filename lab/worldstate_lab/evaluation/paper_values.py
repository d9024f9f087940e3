"""Every number that the paper states in its sections IV, VII, VIII and IX, and what it takes to fill it.

The numbers stand in `paper_values.csv`, in the order of the paper. The text says .881 where Table I prints
.88; both are 37 of 42.
"""

import csv
import math
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

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


_NUMBERS = ("value", "low", "high")


def _read() -> tuple[PaperValue, ...]:
    text = files(__package__).joinpath("paper_values.csv").read_text(encoding="utf-8")
    rows: list[dict[str, Any]] = list(csv.DictReader(text.splitlines()))
    numbers = ({name: float(row[name] or math.nan) for name in _NUMBERS} for row in rows)
    return tuple(PaperValue(**(row | known)) for row, known in zip(rows, numbers, strict=True))


PAPER_VALUES = _read()
_BY_NAME = {(one.group, one.row, one.figure): one for one in PAPER_VALUES}


def paper_value(group: str, row: str, figure: str) -> PaperValue | None:
    """Return what the paper states there, None where it states nothing.

    Examples
    --------
    >>> paper_value("static", "proposed .02", "lead_s").value
    1.69
    """
    return _BY_NAME.get((group, row, figure))
