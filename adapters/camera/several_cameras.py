"""Several cameras as one co-evidence channel: each searches its own view."""

import itertools
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

from worldstate.abduction.co_evidence import Absent, CoEvidence, Present, Unqueried
from worldstate.ground import InvalidArgumentError, NotUsable, wrap_angle
from worldstate.measurement.measurement import Bearing, CameraLook, Look, Side, Sighting
from worldstate.measurement.sector import Sector

from .vision_query import VisionQuery

_NARROWEST_RAD = 1e-9  # Of a part of a sector: thinner ones are rounding


class SeveralCameras:
    r"""The cameras of a vehicle, asked together.

    The sector of a sound is cut where a view begins or ends. Of a part P that the cameras c(P) see, and that
    is s(P) of the sector, all of them miss a vehicle with

    .. math:: \beta = \sum_P s(P) \prod_{i \in c(P)} \beta_i(P)

    which is s(P) where none looks. Given where the vehicle is, cameras are taken to miss it independently:
    what blinds all at once, as rain does, has to stand in the miss rate of each, through its degradation.

    Parameters
    ----------
    cameras : mapping of str to VisionQuery
        By name.

    Raises
    ------
    InvalidArgumentError
        Without a camera.

    Examples
    --------
    >>> import numpy as np
    >>> from worldstate.adapters.camera.detections import DetectionFrame, DetectionLog
    >>> from worldstate.adapters.camera.pinhole import PinholeCamera
    >>> empty = DetectionFrame(np.empty((0, 4)), np.empty(0), ())
    >>> log = DetectionLog.at_rate([empty] * 30, frame_rate_hz=10.0)
    >>> front = VisionQuery(PinholeCamera(), log)
    >>> again = SeveralCameras({"front": front, "spare": VisionQuery(PinholeCamera(), log)})
    >>> heard = Bearing(0.0, 0.05)
    >>> [round(one.ask(10**9, heard).miss_rate, 4) for one in (front, again)]
    [0.0589, 0.0035]
    """

    def __init__(self, cameras: Mapping[str, VisionQuery]) -> None:
        if not cameras:
            raise InvalidArgumentError("cameras: expected one at least, got none")
        self.cameras = dict(cameras)

    def ask(
        self,
        stamp_ns: int,
        bearing: Bearing | NotUsable,
        expected_labels: Collection[str] | None = None,
        side: Side | None = None,
    ) -> CoEvidence:
        """Return what all cameras together say of a sector; parameters are those of `VisionQuery.ask`."""
        every = list(self.cameras.values())
        said = [(one, one.ask(stamp_ns, bearing, expected_labels, side)) for one in every]
        told = [(one, answer) for one, answer in said if not isinstance(answer, Unqueried)]
        if len(told) < 2:
            # The answer of the only camera that sees any of it stands as it is.
            return (told or said)[0][1]
        sector, asked = every[0].sector(bearing, side), [one for one, _ in told]
        labels = expected_labels
        miss = sum(
            share * math.prod(one.miss_rate_over(part, stamp_ns, labels) for one in asked)
            for share, part in _parts(sector, [one.view for one in asked])
        )
        clutter = 1.0 - math.prod(1.0 - answer.clutter_rate for _, answer in told)
        found = any(isinstance(answer, Present) for _, answer in told)
        return (Present if found else Absent)(min(miss, 1.0), clutter)

    def looks(self, stamp_ns: int) -> tuple[CameraLook, ...]:
        """Return the image of every camera that has one at this instant, searched in its own view."""
        return tuple(
            CameraLook(replace(look, sensor=name, sector_rad=one.camera.view_rad), one.sightings(stamp_ns))
            for name, one in self.cameras.items()
            if (look := one.last_look(stamp_ns)) is not None
        )

    def sightings(self, stamp_ns: int) -> tuple[Sighting, ...]:
        """Return the boxes of the first camera that has an image; `looks` has those of all."""
        return next((one.sightings for one in self.looks(stamp_ns)), ())

    def last_look(self, stamp_ns: int) -> Look | None:
        """Return the look of the first camera that has an image, None without one."""
        return next((one.look for one in self.looks(stamp_ns)), None)


def _parts(sector: Sector, views: Sequence[Sector]) -> list[tuple[float, Sector]]:
    """Return the parts of a sector between which no view begins or ends, with the share of each."""
    half = sector.half_width_rad
    ends = {-half, half}
    for view in views:
        both = sector.overlap(view)
        if both is not None:
            middle = wrap_angle(both.centre_rad - sector.centre_rad)
            ends |= {middle - both.half_width_rad, middle + both.half_width_rad}
    cuts = sorted(ends)
    return [
        ((b - a) / (2.0 * half), Sector(wrap_angle(sector.centre_rad + 0.5 * (a + b)), 0.5 * (b - a)))
        for a, b in itertools.pairwise(cuts)
        if b - a > _NARROWEST_RAD
    ]
