"""Context files in JSON: corners and lanes of a junction, speeds there, and arrival rates."""

import logging
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from worldstate.ground.checks import in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.state.context import Context, Occluder, Priors, Rates, corner_at, open_side

from .file_io import read_record, refused_as_file

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _Arm:
    """One approach side: the position of its corner and of the lane behind it, or an open road."""

    direction: str
    corner_m: tuple[float, float] | None = None
    crossing_m: float | None = None
    speed_mps: float | None = None
    corner_std_m: float | None = None
    open: bool | None = None

    def occluder(self, side: int) -> Occluder:
        if self.open:
            return open_side(self.direction, side)
        if self.corner_m is None or self.crossing_m is None:
            wanted = 'corner_m and crossing_m, or "open": true'
            raise InvalidArgumentError(f"context.arms: expected {wanted} for {self.direction}")
        given = {"speed_mps": self.speed_mps, "corner_std_m": self.corner_std_m}
        known = {name: value for name, value in given.items() if value is not None}
        return corner_at(self.direction, self.corner_m, self.crossing_m, **known)


@dataclass(frozen=True, slots=True)
class _ContextFile:
    """Fields of a context file."""

    arms: tuple[_Arm, ...] | None = None
    rates: Rates | None = None
    priors: Priors | None = None
    ego_speed_mps: float | None = None
    site: str | None = None
    view_half_angle_deg: float | None = None

    def context(self) -> Context:
        usual = Context()
        # The usual order left, right is that of a signature model's directions.
        order = {direction: place for place, direction in enumerate(usual.directions)}
        known = usual.occluders
        if self.arms is not None:
            names = [arm.direction for arm in self.arms]
            if not len({*names}) == len(names) > 0:
                raise InvalidArgumentError(f"context.arms: expected different directions, got {names}")
            known = tuple(self._occluders(order))
        if (half_deg := self.view_half_angle_deg) is not None:
            in_range("context.view_half_angle_deg", half_deg, 0.0, 180.0)
        return Context(
            rates=self.rates or usual.rates,
            occluders=tuple(sorted(known, key=lambda one: order.get(one.direction, len(order)))),
            priors=self.priors,
            ego_speed_mps=self.ego_speed_mps,
            site=self.site,
            view_half_angle_rad=usual.view_half_angle_rad if half_deg is None else math.radians(half_deg),
        )

    def _occluders(self, order: Mapping[str, int]) -> Iterator[Occluder]:
        for number, arm in enumerate(self.arms or ()):
            try:
                yield arm.occluder(-1 if order.get(arm.direction) else 1)
            except InvalidArgumentError as error:
                said = str(error).removeprefix("context.arms: ")
                raise InvalidArgumentError(f"context.arms[{number}]: {said}") from error


def read_context(path: str | Path) -> Context:
    """Read a context from JSON; missing values are those of `Context()`.

    ``{"arms": [{"direction": "left", "corner_m": [5.0, 3.2], "crossing_m": 9.0}, ...]}`` gives the corner
    that hides an arm (x ahead, y to the left of the ego, metres) and the distance ahead to the lane of
    vehicles from there. ``"speed_mps"`` of these vehicles and ``"corner_std_m"`` are optional. An arm with
    ``"open": true`` instead is not occluded. Optional in addition to the arms are ``"rates"`` and
    ``"priors"`` with the fields of `Rates` and `Priors`, ``"ego_speed_mps"``, ``"site"`` and
    ``"view_half_angle_deg"``.

    Raises
    ------
    InputFileError
        If the file is missing, too large or not JSON, has an unknown key, or a number is missing or out of
        range.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> right = '{"direction": "right", "corner_m": [5.0, -4.0], "crossing_m": 9.0}'
    >>> left = '{"direction": "left", "corner_m": [5.0, 3.0], "crossing_m": 12.0, "speed_mps": 8.0}'
    >>> with TemporaryDirectory() as folder:
    ...     name = Path(folder) / "elm_street.json"
    ...     _ = name.write_text(f'{{"arms": [{right}, {left}]}}')
    ...     context = read_context(name)
    >>> [(one.direction, round(math.degrees(one.edge_azimuth_rad)), one.assumed) for one in context.occluders]
    [('left', 31, False), ('right', -39, False)]
    """
    with refused_as_file(path):
        record = read_record(_ContextFile, path, "context", by_hand=True)
        if record == _ContextFile():
            _LOG.warning("%s: it is empty, so a usual blind junction is assumed", path)
        return record.context()
