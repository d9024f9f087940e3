"""How the ego vehicle moves, told by a program of one's own while it drives."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.serialisation import ADDED, decode
from worldstate.measurement.odometry import EgoPose, Odometry

from .datagram_socket import DatagramSocket


@dataclass(frozen=True, slots=True)
class _Told:
    """One datagram: the columns of an odometry file but for the time."""

    speed_mps: float
    yaw_rate_rad_s: float = field(default=0.0, metadata=ADDED)
    x_m: float | None = field(default=None, metadata=ADDED)
    y_m: float | None = field(default=None, metadata=ADDED)
    yaw_rad: float | None = field(default=None, metadata=ADDED)

    def at(self, stamp_ns: int) -> Odometry:
        """Return it as a measurement."""
        return Odometry("odometry", stamp_ns, self.speed_mps, self.yaw_rate_rad_s, pose=self.pose())

    def pose(self) -> EgoPose | None:
        """Return the pose, None where none is told."""
        if self.x_m is None and self.y_m is None and self.yaw_rad is None:
            return None
        if self.x_m is None or self.y_m is None or self.yaw_rad is None:
            raise InvalidArgumentError("datagram: expected x_m, y_m and yaw_rad together")
        return EgoPose((self.x_m, self.y_m), self.yaw_rad)


class OdometrySocket(DatagramSocket[_Told]):
    """Odometry that arrives as UDP datagrams, which `Source.told` takes.

    ``{"speed_mps": 5.0, "yaw_rate_rad_s": 0.1, "age_s": 0.01}``, with a localiser "x_m", "y_m" and "yaw_rad"
    in the map, too. The last one holds until the next. What is up to two seconds late the filter puts where
    it belongs.
    """

    def __init__(self, address: str, stamp_ns: Callable[[float], int]) -> None:
        super().__init__(address, stamp_ns, _checked, "--odometry")
        self._ahead: list[Odometry] = []  # Captured after the last hop, whose sound takes a while to be heard

    def until(self, stamp_ns: int) -> Iterator[Odometry]:
        """Yield what was captured up to a time and has not been yielded before."""
        told = sorted([*self._ahead, *(one.at(at_ns) for at_ns, one in self())], key=lambda one: one.stamp_ns)
        self._ahead = [one for one in told if one.stamp_ns > stamp_ns]
        yield from (one for one in told if one.stamp_ns <= stamp_ns)


def _checked(record: object) -> _Told:
    told = decode(_Told, record, "datagram")
    told.at(0)
    return told
