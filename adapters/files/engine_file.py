"""The engine's speed over time, from CSV: what its harmonics are cancelled by."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from worldstate.ground.errors import InputFileError
from worldstate.ground.typing import FloatArray

from .csv_rows import number, read_rows

# What a front-end follows, Hz.
LOWEST_HZ, HIGHEST_HZ = 10.0, 1000.0


@dataclass(frozen=True, slots=True, eq=False)
class EngineSpeed:
    """Fundamental of the engine over time, linear in between.

    Examples
    --------
    >>> speed = EngineSpeed(np.array([0.0, 10.0]), np.array([30.0, 60.0]))
    >>> speed.at(5.0), speed.at(11.0)
    (45.0, None)
    """

    time_s: FloatArray  # Increasing, on the clock of the sound
    fundamental_hz: FloatArray

    def at(self, time_s: float) -> float | None:
        """Return the fundamental, Hz; None outside the record, or where the engine stands."""
        if not self.time_s[0] <= time_s <= self.time_s[-1]:
            return None
        found = float(np.interp(time_s, self.time_s, self.fundamental_hz))
        return found if LOWEST_HZ <= found <= HIGHEST_HZ else None


def read_engine(path: str | Path, lines_per_turn: float = 2.0) -> EngineSpeed:
    r"""Read CSV with the columns time_s and rpm; the fundamental is rpm / 60 times the lines of a turn.

    Raises
    ------
    InputFileError
        If columns are missing, a number is none, or the times do not increase.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     _ = (Path(folder) / "rpm.csv").write_text("time_s,rpm\n0,900\n10,1800\n")
    ...     read_engine(Path(folder) / "rpm.csv").fundamental_hz.tolist()
    [30.0, 60.0]
    """
    name = Path(path)
    times_and_rpm = [
        [number(name, line, row, column) for column in ("time_s", "rpm")]
        for line, row in read_rows(name, ("time_s", "rpm"))
    ]
    table = np.array(times_and_rpm, dtype=np.float64).reshape(-1, 2)
    if not len(table) or (np.diff(table[:, 0]) <= 0.0).any():
        raise InputFileError(name, "expected at least one line, and increasing times")
    return EngineSpeed(table[:, 0], table[:, 1] * lines_per_turn / 60.0)
