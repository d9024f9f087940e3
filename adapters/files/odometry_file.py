"""Odometry of a drive: read from CSV, or taken out of a bag."""

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from worldstate.ground.errors import InputFileError, InvalidArgumentError
from worldstate.ground.values import nanoseconds
from worldstate.measurement.odometry import EgoPose, Odometry

from .csv_rows import number, read_rows

# Odometry of a standing vehicle scatters by some centimetres a second.
STANDING_MPS = 0.2
_POSE = ("x_m", "y_m", "yaw_rad")


@dataclass(frozen=True, slots=True)
class OdometryLog:
    """What odometry told, at increasing stamps on the clock of the sound.

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

    @property
    def moves(self) -> bool:
        """Whether the vehicle moves at any time."""
        return max(abs(one.speed_mps) for one in self.told) > STANDING_MPS


def read_odometry(path: Path | str) -> OdometryLog:
    r"""Read CSV: time_s, speed_mps; optional yaw_rate_rad_s, and x_m, y_m, yaw_rad in the map.

    Raises
    ------
    InputFileError
        If columns are missing, a number is none or out of range, or the times do not increase.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     _ = (Path(folder) / "ego.csv").write_text("time_s,speed_mps,yaw_rate_rad_s\n0,5,0.1\n0.1,5.2,0\n")
    ...     read_odometry(Path(folder) / "ego.csv").told[0].yaw_rate_rad_s
    0.1
    """
    name = Path(path)
    rows = read_rows(name, ("time_s", "speed_mps"), ("yaw_rate_rad_s", *_POSE))
    told = []
    for line, row in rows:
        known = {column: number(name, line, row, column) for column in row}
        try:
            told.append(_odometry(known))
        except InvalidArgumentError as error:
            raise InputFileError(name, f"line {line}: {error}") from error
    try:
        return OdometryLog(tuple(told))
    except InvalidArgumentError as error:
        raise InputFileError(name, str(error)) from error


def _odometry(row: dict[str, float]) -> Odometry:
    pose = None
    if any(column in row for column in _POSE):
        if missing := [column for column in _POSE if column not in row]:
            raise InvalidArgumentError(f"expected {', '.join(missing)} beside the rest of the pose")
        pose = EgoPose((row["x_m"], row["y_m"]), row["yaw_rad"])
    stamp_ns, turning = nanoseconds(row["time_s"]), row.get("yaw_rate_rad_s", 0.0)
    return Odometry("odometry", stamp_ns, row["speed_mps"], turning, pose=pose)
