"""Odometry of a drive, from CSV."""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

from worldstate.ground import InvalidArgumentError, nanoseconds
from worldstate.ground.checks import check_ranges
from worldstate.ground.serialisation import ADDED
from worldstate.measurement.odometry import FARTHEST_M, EgoPose, Odometry

from .file_io import in_order, number, read_rows, refused_as_file

# Odometry of a standing vehicle drifts by some centimetres per second.
STANDING_MPS = 0.2
_LOG = logging.getLogger(__name__)
# No tyre sustains more lateral acceleration, and no localiser turns that far unless in degrees. If speeds are
# in km/h, the poses are 3.6 times closer together than the speeds imply.
MOST_ACROSS_MPS2, MOST_TURNED_RAD, LEAST_MOVED = 15.0, 25.0, 0.4
# Three hours at 100 Hz with poses.
MAX_BYTES, MAX_ROWS = 128 << 20, 1_080_000


@dataclass(frozen=True, slots=True)
class OdometryLog:
    """Odometry at increasing stamps on the clock of the sound.

    Examples
    --------
    >>> OdometryLog((Odometry("wheels", 0, 2.0), Odometry("wheels", 10**9, 4.0))).moves
    True
    """

    told: tuple[Odometry, ...]

    def __post_init__(self) -> None:
        stamps = [one.stamp_ns for one in self.told]
        if not stamps or any(b <= a for a, b in pairwise(stamps)):
            raise InvalidArgumentError("odometry: expected at least one line, at increasing times")

    @classmethod
    def in_order(cls, told: Sequence[Odometry], source: str) -> "OdometryLog":
        """Sort by stamp and keep the last of equal stamps; log a warning with their numbers."""
        return cls(tuple(told[i] for i in in_order([one.stamp_ns for one in told], source)))

    @property
    def moves(self) -> bool:
        """Whether the vehicle moves at any time."""
        return max(abs(one.speed_mps) for one in self.told) > STANDING_MPS


@dataclass(frozen=True, slots=True)
class OdometryRecord:
    """One line of an odometry file, or one datagram, without its time."""

    speed_mps: float
    yaw_rate_rad_s: float = field(default=0.0, metadata=ADDED)
    x_m: float | None = field(default=None, metadata=ADDED)
    y_m: float | None = field(default=None, metadata=ADDED)
    yaw_rad: float | None = field(default=None, metadata=ADDED)

    def at(self, stamp_ns: int) -> Odometry:
        """Return the record as a measurement at a stamp."""
        return Odometry("odometry", stamp_ns, self.speed_mps, self.yaw_rate_rad_s, pose=self._pose())

    def _pose(self) -> EgoPose | None:
        if self.x_m is None and self.y_m is None and self.yaw_rad is None:
            return None
        if self.x_m is None or self.y_m is None or self.yaw_rad is None:
            raise InvalidArgumentError("odometry: expected x_m, y_m and yaw_rad together")
        check_ranges(self, x_m=(-FARTHEST_M, FARTHEST_M), y_m=(-FARTHEST_M, FARTHEST_M))
        return EgoPose((self.x_m, self.y_m), self.yaw_rad)


def read_odometry(path: Path | str) -> OdometryLog:
    r"""Read a CSV file of odometry with the columns time_s and speed_mps.

    Optional columns are yaw_rate_rad_s, and the pose x_m, y_m, yaw_rad in the map.

    Lines are sorted by time, and the last one of equal times is used. An optional cell may be empty.

    Raises
    ------
    InputFileError
        If columns are missing, or a number is missing or out of range; the message contains the line number.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     _ = (Path(folder) / "ego.csv").write_text("time_s,speed_mps,yaw_rate_rad_s\n0,5,0.1\n0.1,5.2,0\n")
    ...     read_odometry(Path(folder) / "ego.csv").told[0].yaw_rate_rad_s
    0.1
    """
    name, told, turned_rad = Path(path), list[Odometry](), 0.0
    optional = "yaw_rate_rad_s", "x_m", "y_m", "yaw_rad"
    for line, row in read_rows(name, ("time_s", "speed_mps"), optional, MAX_BYTES, MAX_ROWS):
        given = (column for column in row if row[column] or column not in optional)
        known = {column: number(name, line, row, column) for column in given}
        with refused_as_file(name, f"line {line}: "):
            stamp_ns = nanoseconds(known.pop("time_s"))
            turned_rad = max(turned_rad, abs(known.get("yaw_rad", 0.0)))
            told.append(OdometryRecord(**known).at(stamp_ns))
    with refused_as_file(name):
        log = OdometryLog.in_order(told, str(name))
    for column, unit in _other_units(log, turned_rad):
        _LOG.warning("%s: %s has numbers like those in %s; they are read unchanged", name, column, unit)
    return log


def _other_units(log: OdometryLog, turned_rad: float) -> Iterator[tuple[str, str]]:
    """Yield the columns with numbers that no vehicle can have, and their likely unit."""
    speeds = np.array([one.speed_mps for one in log.told])
    rates = np.array([one.yaw_rate_rad_s for one in log.told])
    if turned_rad > MOST_TURNED_RAD:
        yield "yaw_rad", "degrees"
    if np.mean(np.abs(speeds * rates) > MOST_ACROSS_MPS2) > 0.1:
        yield "yaw_rate_rad_s", "degrees"
    at = np.array([(1e-9 * one.stamp_ns, *one.pose.position_m) for one in log.told if one.pose is not None])
    if len(at) == len(speeds) > 1:
        driven_m = float(np.abs(speeds[:-1] * np.diff(at[:, 0])).sum())
        if np.hypot(*np.diff(at[:, 1:], axis=0).T).sum() < LEAST_MOVED * driven_m and log.moves:
            yield "speed_mps", "km/h"
