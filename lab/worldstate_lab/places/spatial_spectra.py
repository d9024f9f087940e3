"""Tables of spatial spectra: one row a hop, with the place of the vehicle where it is known.

Columns: ``time_s``, ``x_m`` (along the crossing street, right positive; may be empty) and ``srp_0`` to
``srp_179``, the steered response on `numpy.linspace(-90, 90, 180)` degrees, right positive.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from worldstate.adapters.files.csv_rows import number, read_rows
from worldstate.ground.errors import InputFileError
from worldstate.ground.typing import FloatArray

N_AZIMUTHS = 180
AZIMUTHS_RAD = np.radians(np.linspace(90.0, -90.0, N_AZIMUTHS))  # Of the columns, left positive
_COLUMNS = tuple(f"srp_{i}" for i in range(N_AZIMUTHS))


@dataclass(frozen=True, slots=True, eq=False)
class SpectrumTable:
    """One recording.

    Examples
    --------
    >>> SpectrumTable(np.zeros(2), np.full(2, np.nan), np.zeros((2, N_AZIMUTHS))).has_places
    False
    """

    time_s: FloatArray  # shape (T,)
    along_m: FloatArray  # shape (T,): Left positive; NaN where it is unknown
    spectra: FloatArray  # shape (T, N_AZIMUTHS)

    @property
    def has_places(self) -> bool:
        """Whether the place is known in any row."""
        return bool(np.isfinite(self.along_m).any())


def read_spectra(path: Path) -> SpectrumTable:
    r"""Read one recording; `InputFileError` where a column is missing or a number is none.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     table = Path(folder) / "pass.csv"
    ...     _ = table.write_text(f"time_s,x_m,{','.join(_COLUMNS)}\n0,2.5{',0.1' * N_AZIMUTHS}\n")
    ...     read_spectra(table).along_m
    array([-2.5])
    """
    rows = list(read_rows(path, ("time_s", "x_m", *_COLUMNS)))
    if not rows:
        raise InputFileError(path, "expected at least one row")
    return SpectrumTable(
        np.array([number(path, line, row, "time_s") for line, row in rows]),
        np.array([-number(path, line, row, "x_m") if row["x_m"] else np.nan for line, row in rows]),
        np.array([[number(path, line, row, name) for name in _COLUMNS] for line, row in rows]),
    )
