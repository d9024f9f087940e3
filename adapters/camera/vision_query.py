"""Camera detections as co-evidence: present, absent or unqueried in a sector."""

import itertools
import logging
import math
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from worldstate.abduction import Absent, MissRateTable, Present, Unqueried
from worldstate.abduction.co_evidence import CoEvidence, Sector, default_miss_rates
from worldstate.core.memory import MOST_BOXES
from worldstate.ground import InputFileError, InvalidArgumentError, NotUsable
from worldstate.ground.typing import BoolArray, FloatArray, IntArray
from worldstate.ground.values import nanoseconds, seconds, wrap_angle
from worldstate.measurement.measurement import Bearing, CameraLook, Look, Side, Sighting

from .class_names import class_name, may_be
from .detections import BORDER_PX, PARKED_S, DetectionFilter, DetectionFrame, DetectionLog, kept_and_parked
from .pinhole import PinholeCamera

SENSOR = "camera"
# Number of points for the mean miss rate over the part of the sector in view. The table is piecewise linear
# over tens of degrees, so more points do not change the mean.
SAMPLES = 8
# Trackers and boxes of whole objects may reach beyond an image. The boxes belong to images of another size if
# more than the first share of them is outside, or if half of them reach beyond the image and at least one of
# these by more than the second share of the width.
_MOST_OUTSIDE, _FAR_BEYOND, _FEW_BOXES = 0.1, 0.01, 4
_FEW_PX = 2.0
_LOG = logging.getLogger(__name__)
# Used if a box of an expected class may be there but is rejected by the filter.
_UNREAD = Unqueried("a box there does not count, by its class, score or size")
NONE_COUNTS = "none of its boxes has counted yet, by class, score or size"
# An approaching vehicle is too small for some seconds, so the warning for a live camera is delayed.
_WARNED_AFTER_NS = nanoseconds(10.0)
# Images kept of a live camera. The test for parked boxes uses the last second, and more than 60 images per
# second do not improve a decision every 0.1 s, so faster images are skipped.
REMEMBERED = 64
LEAST_APART_NS = nanoseconds(PARKED_S / (REMEMBERED - 1))
# Half the width of the sector around a bearing, and the default probability of a false detection of a moving
# object in it.
_HALF_WIDTH_RAD, _CLUTTER_RATE = math.radians(10.0), 0.01
MAX_IMAGE_AGE_S = 0.15  # Largest age of an image that is used: 1.5 times OVAD's period
# Log of a live camera before its first image.
NO_LOOKS = DetectionLog((), np.empty(0, dtype=np.int64), "the camera")
# Ahead only: the front-end's default grid ends at 90 deg, and so do the views of the cameras.
WHOLE_SIDES: dict[Side | None, Sector] = {
    "left": Sector(math.pi / 4, math.pi / 4),
    "right": Sector(-math.pi / 4, math.pi / 4),
    None: Sector(0.0, math.pi / 2),
}


class VisionQuery:
    r"""The camera as a co-evidence channel.

    The result for a sector and the classes predicted by the signature is

    - `Unqueried` if there are no detections, no frame at that time, or no part of the sector is in view;
    - `Present` if a moving box of an expected class overlaps the sector;
    - `Unqueried` if the filter rejects a moving box there that may be of an expected class;
    - `Absent` otherwise.

    Its miss rate is the expectation over the sector and the mean over the expected classes C. The rate is 1
    outside the field of view and for classes that the filter rejects:

    .. math:: \beta = \frac{1}{|S|} \int_S \frac{1}{|C|} \sum_{c \in C} \beta_c(\theta, d)\, d\theta

    with theta the angle off the optical axis. The latest image up to the stamp is used.

    Parameters
    ----------
    camera : PinholeCamera
        Camera that took the images.
    detections : DetectionLog or None
        None if there are none, as for all OVAD recordings with a moving ego: every result is `Unqueried`.
    miss_rate : MissRateTable, optional
        beta_c(theta, d); by default the values of the paper.
    degradation : float or callable
        d in [0, 1], or a function from the stamp to d.
    keep : DetectionFilter, optional
        Classes, scores and sizes of the boxes that are used.
    line_of_sight : Sector, optional
        Directions in line of sight, known from the occluders of the context; by default all. A visible source
        is in line of sight; sound from behind an occluder comes from a hidden source or from its reflection
        by a wall. Therefore this sector is searched.
    clutter : callable, optional
        Measured probability of a false detection in the sector as a function of d; by default 0.01.

    Raises
    ------
    InputFileError
        If more than a tenth of the boxes is outside the image, which means that they come from another
        camera.

    Attributes
    ----------
    beyond, outside : int
        Number of a live camera's boxes that reached beyond the image, and of those outside, which were
        dropped.

    Examples
    --------
    >>> from worldstate.adapters.camera.detections import DetectionFrame
    >>> empty = DetectionFrame(np.empty((0, 4)), np.empty(0), ())
    >>> query = VisionQuery(PinholeCamera.ovad(), DetectionLog.at_rate([empty] * 30, frame_rate_hz=10.0))
    >>> answer = query.ask(nanoseconds(1.0), Bearing(0.0, 0.05))
    >>> type(answer).__name__, round(answer.miss_rate, 2)
    ('Absent', 0.06)
    >>> query.ask(nanoseconds(1.0), Bearing(1.0, 0.05))
    Unqueried(reason='sector outside the field of view')
    """

    def __init__(
        self,
        camera: PinholeCamera,
        detections: DetectionLog | None,
        miss_rate: MissRateTable | None = None,
        degradation: float | Callable[[int], float] = 0.0,
        keep: DetectionFilter | None = None,
        line_of_sight: Sector | None = None,
        clutter: Callable[[float], float] | None = None,
    ) -> None:
        self.camera = camera
        self.miss_rate = miss_rate or default_miss_rates()
        self.keep = replace(keep or DetectionFilter(), image_height_px=camera.height_px)
        self._degradation = degradation if callable(degradation) else lambda stamp_ns: degradation
        self.view = Sector.between(*camera.view_rad)
        self._line_of_sight = line_of_sight
        self._clutter = clutter or (lambda d: _CLUTTER_RATE)
        self._asked = detections is not None
        self.beyond = self.outside = 0
        log = within_images(camera, NO_LOOKS if detections is None else detections)
        # Stamps of the first image with a box, with a box that passes the filter, and with a class other than
        # car.
        self._first_ns: dict[str, int] = {}
        self._noted: dict[str, Callable[[DetectionFrame], object]] = {
            "box": len,
            "counted": lambda frame: len(frame) and len(frame.select(self.keep)),
            "other": lambda frame: {*map(class_name, frame.labels)} - {"car"},
        }
        self._note(log)
        self._take(replace(log, frames=tuple(_most_likely(frame, self.keep) for frame in log.frames)))
        self._warned = False
        self._warn(sys.maxsize - 1)

    def _take(self, log: DetectionLog) -> None:
        self.detections = log
        self._last: tuple[int, tuple[Sighting, ...], tuple[Sighting, ...]] = (-1, (), ())

    def _note(self, log: DetectionLog) -> None:
        for name, holds in self._noted.items():
            if name not in self._first_ns:
                stamped = zip(log.stamps_ns.tolist(), log.frames, strict=True)
                self._first_ns |= next(({name: ns} for ns, frame in stamped if holds(frame)), {})

    def _warn(self, stamp_ns: int) -> None:
        """Warn once if no box of a camera passes the filter for some time after the first box."""
        due = stamp_ns - self._first_ns.get("box", stamp_ns) >= _WARNED_AFTER_NS
        if due and not self._warned and self._fault(stamp_ns):
            self._warned, log = True, self.detections
            names = sorted({name for frame in log.frames for name in frame.labels})
            _LOG.warning("%s: %s; classes: %.200s", log.source, NONE_COUNTS, ", ".join(names))

    def go_on(self, before: "VisionQuery") -> None:
        """Take over the last images and the labels of another query of the same camera."""
        self._asked, self._first_ns = before._asked, dict(before._first_ns)
        self._take(before.detections)

    def see(self, stamp_ns: int, frame: DetectionFrame) -> None:
        """Store the detections of an image of a live camera; an image within 16 ms of another is skipped.

        Parameters
        ----------
        stamp_ns : int
            Time of the image by the camera's clock, nanoseconds.
        frame : DetectionFrame
            All of its boxes; boxes that reach beyond the image are cut at its border.

        Raises
        ------
        InputFileError
            If all boxes are outside the image, which means that they come from another camera.

        Examples
        --------
        >>> from worldstate.adapters.camera.detections import DetectionFrame
        >>> query = VisionQuery(PinholeCamera.ovad(), None)
        >>> query.see(nanoseconds(0.9), DetectionFrame(np.empty((0, 4)), np.empty(0), ()))
        >>> type(query.ask(nanoseconds(1.0), Bearing(0.0, 0.05))).__name__
        'Absent'
        """
        before, taken_ns = self.detections, self.taken_ns(stamp_ns)
        found, beyond = frame.cut(_size_px(self.camera))
        if beyond and not len(found):
            raise InputFileError(before.source, _other_size(self.camera, frame))
        _check_pixels(before.source, found.boxes_px)
        self.beyond, self.outside = self.beyond + beyond, self.outside + len(frame) - len(found)
        # A late image is inserted at its time, so an image with a stamp in the future does not block others.
        at = int(np.searchsorted(before.stamps_ns, taken_ns))
        if (np.abs(before.stamps_ns[max(at - 1, 0) : at + 1] - taken_ns) < LEAST_APART_NS).any():
            return
        self._asked = True
        self._note(DetectionLog((found,), np.array([taken_ns])))
        frames = (*before.frames[:at], _most_likely(found, self.keep), *before.frames[at:])[-REMEMBERED:]
        stamps_ns = np.insert(before.stamps_ns, at, taken_ns)[-REMEMBERED:]
        self._take(DetectionLog(frames, stamps_ns, before.source))
        self._warn(taken_ns)

    def taken_ns(self, stamp_ns: int) -> int:
        """Convert a stamp of the camera's clock to the clock of the sound."""
        return stamp_ns + nanoseconds(self.camera.stamp_offset_s)

    def ask(
        self,
        stamp_ns: int,
        bearing: Bearing | NotUsable,
        expected_labels: Collection[str] | None = None,
        side: Side | None = None,
    ) -> CoEvidence:
        """Search a sector of the image at `stamp_ns`.

        Parameters
        ----------
        stamp_ns : int
            Time on the clock of the stream, nanoseconds.
        bearing : Bearing or NotUsable
            Centre of the sector, unless `side` is given; without either, everything ahead is searched.
        expected_labels : collection of str, optional
            Classes predicted by the signature. All classes of the filter are used if not given, or as long as
            the detector has labelled every box as a car.
        side : {"left", "right"}, optional
            Search this whole side, 0 to 90 deg, for a source whose bearing is coarse.

        Examples
        --------
        >>> nothing = VisionQuery(PinholeCamera.ovad(), detections=None)
        >>> nothing.ask(0, Bearing(0.0, 0.05))
        Unqueried(reason='no detections file')
        """
        if not self._asked:
            return Unqueried("no detections file")
        if self._frame(stamp_ns) is None:
            return Unqueried(f"no frame at {seconds(stamp_ns):.3f} s")
        labels = self._asked_for(expected_labels, stamp_ns)
        if not any(label in self.keep.labels for label in labels):
            return Unqueried("the signature predicts no class that a camera would see")
        sector = self.sector(bearing, side)
        d = self._degradation(stamp_ns)
        beta = self._expected_miss_rate(sector, d, labels)
        if beta is None:
            return Unqueried("sector outside the field of view")
        clutter = self._clutter(d)
        moving = (one for one in self.sightings(stamp_ns) if one.moving and one.label in labels)
        if any(sector.touches(one.azimuth_rad, one.width_rad) for one in moving):
            return Present(beta, clutter)
        unread = self._unread(stamp_ns, labels)
        # If no box has passed the filter yet, the boxes may be of images of another size, so their azimuths
        # are unknown.
        if any(self._fault(stamp_ns) or sector.touches(one.azimuth_rad, one.width_rad) for one in unread):
            return _UNREAD
        return Absent(beta, clutter)

    def sightings(self, stamp_ns: int) -> tuple[Sighting, ...]:
        """Return the boxes that the filter keeps in the image at `stamp_ns`, including parked ones.

        Parameters
        ----------
        stamp_ns : int
            Time on the clock of the stream, nanoseconds.

        Returns
        -------
        tuple of Sighting
            Empty if there is no image at that time.

        Examples
        --------
        >>> VisionQuery(PinholeCamera.ovad(), detections=None).sightings(0)
        ()
        """
        return self._read(stamp_ns)[1]

    def last_look(self, stamp_ns: int) -> Look | None:
        """Return the result for the whole image at `stamp_ns`: whether a moving object is in view.

        Parameters
        ----------
        stamp_ns : int
            Time on the clock of the stream, nanoseconds.

        Returns
        -------
        Look or None
            The result with the time of the image; None without an image.

        Examples
        --------
        >>> VisionQuery(PinholeCamera.ovad(), detections=None).last_look(0) is None
        True
        """
        frame = self._frame(stamp_ns)
        if frame is None:
            return None
        beta = self.miss_rate_over(self.view, stamp_ns, None)
        moving = any(sighting.moving for sighting in self.sightings(stamp_ns))
        answer: CoEvidence = (Present if moving else Absent)(beta, self._clutter(self._degradation(stamp_ns)))
        taken_ns = int(self.detections.stamps_ns[frame])
        # The result is for the whole view: a rejected box makes it unqueried, not absent.
        if self._unread(stamp_ns, self.keep.labels):
            answer = _UNREAD
        return Look(SENSOR, taken_ns, answer, fault=self._fault(taken_ns))

    def _frame(self, stamp_ns: int) -> int | None:
        return self.detections.latest(stamp_ns, nanoseconds(MAX_IMAGE_AGE_S))

    def _fault(self, stamp_ns: int) -> str | None:
        """Return the fault of a camera before the first of its boxes passes the filter."""
        first, counted = (self._first_ns.get(name, sys.maxsize) for name in ("box", "counted"))
        return NONE_COUNTS if first <= stamp_ns < counted else None

    def _unread(self, stamp_ns: int, labels: Collection[str]) -> list[Sighting]:
        """Return the moving boxes that the filter rejects and that may be of one of these classes."""
        return [one for one in self._read(stamp_ns)[2] if may_be(one.label, labels)]

    def _read(self, stamp_ns: int) -> tuple[int, tuple[Sighting, ...], tuple[Sighting, ...]]:
        """Return the number of the image at a time, the kept boxes and the moving rejected boxes."""
        frame = self._frame(stamp_ns)
        if frame is None:
            return -1, (), ()
        if frame != self._last[0]:
            kept, still = kept_and_parked(self.detections, frame, self.keep)
            others = self.detections.left_out(frame, self.keep)
            moving = np.zeros(len(others), dtype=bool)
            self._last = frame, self._sightings(frame, kept, still), self._sightings(frame, others, moving)
        return self._last

    def _sightings(self, number: int, places: IntArray, still: BoolArray) -> tuple[Sighting, ...]:
        frame = self.detections.frames[number]
        rows = zip(frame.boxes_px[places], places, frame.scores[places].tolist(), still.tolist(), strict=True)
        return tuple(
            self.camera.sighting(box_px, class_name(frame.labels[i]), score, moving=not stood)
            for box_px, i, score, stood in rows
        )

    def miss_rate_over(self, sector: Sector, stamp_ns: int, labels: Collection[str] | None) -> float:
        """Return the expected miss rate in a sector; 1 if no part of it is in view."""
        asked = self._asked_for(labels, stamp_ns)
        beta = self._expected_miss_rate(sector, self._degradation(stamp_ns), asked)
        return 1.0 if beta is None else beta

    def _asked_for(self, expected: Collection[str] | None, stamp_ns: int) -> Collection[str]:
        # Background subtraction always labels boxes as cars: a search for a truck would find none.
        calls_all_cars = stamp_ns < self._first_ns.get("other", sys.maxsize)
        if expected is None or (expected and calls_all_cars):
            return self.keep.labels
        return expected

    def sector(self, bearing: Bearing | NotUsable, side: Side | None) -> Sector:
        """Return the sector in which a visible source would explain the sound."""
        if side is not None or isinstance(bearing, NotUsable):
            sector = WHOLE_SIDES[side]
        else:
            sector = Sector(bearing.azimuth_rad, _HALF_WIDTH_RAD)
        if self._line_of_sight is None:
            return sector
        return sector.overlap(self._line_of_sight) or self._line_of_sight

    def _expected_miss_rate(self, sector: Sector, d: float, labels: Collection[str]) -> float | None:
        """Return beta over the sector; None if no part of it is in view."""
        in_view = sector.overlap(self.view)
        if in_view is None:
            return None
        angles = self.camera.off_axis(in_view.midpoints(SAMPLES))
        kept = self.keep.labels
        betas = [self.miss_rate.over(angles, d, one).mean() if one in kept else 1.0 for one in labels]
        seen = float(np.mean(betas))
        share = in_view.half_width_rad / sector.half_width_rad
        return share * seen + (1.0 - share)


def _most_likely(frame: DetectionFrame, keep: DetectionFilter) -> DetectionFrame:
    """Return an image with at most `MOST_BOXES` boxes: those that the filter keeps first, then by score.

    The test for parked boxes compares all pairs within a second: 1,000 boxes per image took 1 s per hop.
    """
    if len(frame) <= MOST_BOXES:
        return frame
    others = np.ones(len(frame), dtype=bool)
    others[frame.select(keep)] = False
    likeliest = np.sort(np.lexsort((-frame.scores, others))[:MOST_BOXES])
    labels = tuple(frame.labels[number] for number in likeliest)
    return replace(frame, boxes_px=frame.boxes_px[likeliest], scores=frame.scores[likeliest], labels=labels)


def within_images(camera: PinholeCamera, log: DetectionLog) -> DetectionLog:
    """Return a log with its boxes cut at the image border; boxes outside are dropped with a warning.

    An image of which all boxes are outside is removed.
    """
    boxes_px = np.concatenate([np.empty((0, 4)), *(frame.boxes_px for frame in log.frames)])
    by_px = np.abs(boxes_px - np.clip(boxes_px, 0.0, np.tile(_size_px(camera), 2))).max(axis=1, initial=0.0)
    _check_pixels(log.source, boxes_px)
    if not (beyond := int((by_px > BORDER_PX).sum())):
        return log
    parts = [frame.cut(_size_px(camera)) for frame in log.frames]
    boxes, outside = len(boxes_px), len(boxes_px) - sum(len(frame) for frame, _ in parts)
    far = by_px.max() > _FAR_BEYOND * camera.width_px
    if (far and 2 * beyond > boxes >= _FEW_BOXES) or outside > max(_MOST_OUTSIDE * boxes, 1.0):
        number = next(i for i, (_, count) in enumerate(parts) if count)
        raise InputFileError(log.source, f"frame {number}: {_other_size(camera, log.frames[number])}")
    told = "%s: %d boxes reach beyond the image and are cut at its border; %d of them, outside, are left out"
    _LOG.warning(told, log.source, beyond, outside)
    kept = [i for i, (frame, count) in enumerate(parts) if len(frame) or not count]
    return replace(log, frames=tuple(parts[i][0] for i in kept), stamps_ns=log.stamps_ns[kept])


def _check_pixels(source: str, boxes_px: FloatArray) -> None:
    """Refuse boxes that are all within the first two pixels: they are given as fractions of the image."""
    if 0.0 < boxes_px.max(initial=0.0) <= _FEW_PX:  # detectors reach a little beyond 1
        problem = "expected boxes in pixels, got fractions of the image (0 to 1)"
        raise InputFileError(source, f"{problem}: multiply them by its width and height")


def _size_px(camera: PinholeCamera) -> tuple[int, int]:
    return camera.width_px, camera.height_px


def _other_size(camera: PinholeCamera, frame: DetectionFrame) -> str:
    """Return the error message for boxes beyond the images of a camera."""
    corners = frame.boxes_px.reshape(-1, 2)
    x, y = corners[np.maximum(corners - _size_px(camera), -corners).max(axis=1).argmax()]
    image = f"the camera's {camera.width_px} x {camera.height_px} px"
    return f"expected boxes within {image}, got a corner at ({x:g}, {y:g})"


_NARROWEST_RAD = 1e-9  # Narrower parts of a sector are rounding errors


class SeveralCameras:
    r"""The cameras of a vehicle, combined.

    The sector of a sound is cut at the borders of the views. If the part P has the share s(P) of the sector
    and is in view of the cameras c(P), all of them miss a vehicle with the probability

    .. math:: \beta = \sum_P s(P) \prod_{i \in c(P)} \beta_i(P)

    which contributes s(P) for a part in view of no camera. Given the position of the vehicle, misses of the
    cameras are taken as independent. A common cause such as rain must be in each camera's miss rate, by its
    degradation.

    Parameters
    ----------
    cameras : mapping of str to VisionQuery
        Cameras by name.

    Raises
    ------
    InvalidArgumentError
        If there is no camera.

    Examples
    --------
    >>> import numpy as np
    >>> from worldstate.adapters.camera.detections import DetectionFrame, DetectionLog
    >>> from worldstate.adapters.camera.pinhole import PinholeCamera
    >>> empty = DetectionFrame(np.empty((0, 4)), np.empty(0), ())
    >>> log = DetectionLog.at_rate([empty] * 30, frame_rate_hz=10.0)
    >>> front = VisionQuery(PinholeCamera.ovad(), log)
    >>> again = SeveralCameras({"front": front, "spare": VisionQuery(PinholeCamera.ovad(), log)})
    >>> heard = Bearing(0.0, 0.05)
    >>> [round(one.ask(10**9, heard).miss_rate, 4) for one in (front, again)]
    [0.0589, 0.0035]
    """

    def __init__(self, cameras: Mapping[str, VisionQuery]) -> None:
        if not cameras:
            raise InvalidArgumentError("cameras: expected at least one, got none")
        self.cameras = dict(cameras)

    def ask(
        self,
        stamp_ns: int,
        bearing: Bearing | NotUsable,
        expected_labels: Collection[str] | None = None,
        side: Side | None = None,
    ) -> CoEvidence:
        """Return the combined result of all cameras for a sector; parameters as in `VisionQuery.ask`."""
        every = list(self.cameras.values())
        said = [(one, one.ask(stamp_ns, bearing, expected_labels, side)) for one in every]
        told = [(one, answer) for one, answer in said if not isinstance(answer, Unqueried)]
        if len(told) < 2:
            # With only one camera in view, its result is returned unchanged.
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
        """Return the look of every camera with an image at this time, over the camera's own view."""
        return tuple(
            CameraLook(replace(look, sensor=name, sector_rad=one.camera.view_rad), one.sightings(stamp_ns))
            for name, one in self.cameras.items()
            if (look := one.last_look(stamp_ns)) is not None
        )

    def sightings(self, stamp_ns: int) -> tuple[Sighting, ...]:
        """Return the boxes of the first camera with an image; `looks` returns those of all."""
        return next((one.sightings for one in self.looks(stamp_ns)), ())

    def last_look(self, stamp_ns: int) -> Look | None:
        """Return the look of the first camera with an image; None without one."""
        return next((one.look for one in self.looks(stamp_ns)), None)


def _parts(sector: Sector, views: Sequence[Sector]) -> list[tuple[float, Sector]]:
    """Cut a sector at the borders of all views; return the parts with their shares."""
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
