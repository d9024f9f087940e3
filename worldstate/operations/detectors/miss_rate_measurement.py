"""Miss rates of a camera's detector, measured by re-detection on degraded frames."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field

import numpy as np

from worldstate.adapters.camera.camera_health import CameraHealth, learn_health
from worldstate.adapters.camera.degradation import FAMILIES, LEVELS, Family, degrade
from worldstate.adapters.camera.detections import DetectionFilter, DetectionFrame, DetectionLog
from worldstate.adapters.camera.detector import Detector, overlaps
from worldstate.adapters.camera.miss_rates import FamilyCounts, MissRates
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.static_boxes import ParkedRule, kept_and_parked
from worldstate.adapters.camera.video import Video
from worldstate.ground.checks import in_range
from worldstate.ground.errors import InputFileError, InvalidArgumentError
from worldstate.ground.typing import BoolArray, FloatArray, ImageArray, IntArray
from worldstate.measurement.sector import Sector

MakeDetector = Callable[[], Detector]

# Sectors that clutter is counted in lie this far apart.
_SECTOR_STEP_RAD = np.radians(5.0)
# Clean frames that the scale of health is learned from, spread over the videos.
_HEALTH_FRAMES = 10


@dataclass(frozen=True, slots=True)
class AbsenceSettings:
    """How misses are counted.

    Parameters
    ----------
    bins_deg : tuple of float
        Inner edges of the bins of azimuth off the optical axis; they run from 0 to the edge of the view.
    families : tuple of str
        What is staged.
    min_overlap : float
        IoU from which on a reference box counts as found.
    half_width_rad : float
        Half the width of a query sector, in which clutter is counted.
    warm_up : int
        First frames of each video that count for nothing: motion detectors learn the background in them.
    repeats : float
        Frames that say the same: at ten a second and a look every 0.3 s, three.
    moving_only : bool
        Leave parked reference boxes out: they are no co-evidence, and no motion detector sees them.
    keep : DetectionFilter
        Which reference boxes count.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range.

    Examples
    --------
    >>> AbsenceSettings().min_overlap
    0.3
    """

    bins_deg: tuple[float, ...] = (10.0, 20.0, 30.0)
    families: tuple[Family, ...] = FAMILIES
    min_overlap: float = 0.3
    half_width_rad: float = float(np.radians(10.0))
    warm_up: int = 10
    repeats: float = 3.0
    moving_only: bool = True
    keep: DetectionFilter = field(
        default_factory=lambda: DetectionFilter(frozenset({"car", "motorcycle", "truck", "bus"}), 0.5, 40.0)
    )

    def __post_init__(self) -> None:
        if not self.families or not set(self.families) <= set(FAMILIES):
            raise InvalidArgumentError(f"families: expected some of {', '.join(FAMILIES)}")
        in_range("min_overlap", self.min_overlap, 0.0, 1.0, open_low=True)
        in_range("half_width_rad", self.half_width_rad, 0.0, np.pi / 2, open_low=True)
        in_range("warm_up", self.warm_up, 0, 100_000)
        in_range("repeats", self.repeats, 1.0, 1000.0)

    def edges_deg(self, camera: PinholeCamera) -> tuple[float, ...]:
        """Return the bin edges of a camera; the last one lies a degree outside its view."""
        edge = float(np.degrees(np.abs(camera.off_axis(camera.view_rad)).max())) + 1.0
        return (0.0, *(deg for deg in self.bins_deg if 0.0 < deg < edge - 2.0), edge)


@dataclass(frozen=True, slots=True)
class LabelledVideo:
    """A video with what is known to be in it."""

    video: Video  # Clean frames
    reference: DetectionLog  # What is there, one entry a frame
    camera: PinholeCamera  # That took it


def measure_absence(
    scenes: Sequence[LabelledVideo],
    make_detector: MakeDetector,
    rng: np.random.Generator,
    settings: AbsenceSettings | None = None,
    *,
    provenance: dict[str, str] | None = None,
    on_frame: Callable[[], None] = lambda: None,
) -> MissRates:
    r"""Count how often reference boxes are found again on degraded frames.

    A reference box is found where a detection has :math:`IoU \ge 0.3` with it. A detection that has this with
    no reference box, and whose middle lies in none, is false; a query sector without a reference object that
    a false one reaches into counts as clutter.

    Parameters
    ----------
    scenes : sequence of LabelledVideo
        Videos of one camera.
    make_detector : callable
        Makes a detector; it may have a state, so each video at each level gets a new one.
    rng : numpy.random.Generator
        Draws the staged noise.
    settings : AbsenceSettings, optional
        How it is counted.
    provenance : dict of str, optional
        Written into the file.
    on_frame : callable
        Called after each frame of each video, all levels of all families done.

    Returns
    -------
    MissRates
        Counts for each family, azimuth bin and level.

    Raises
    ------
    InvalidArgumentError
        If there is no scene.
    InputFileError
        If no reference object is ever in view.

    Examples
    --------
    Twenty images with a white box on black, and a detector that finds whatever is bright:

    >>> from types import SimpleNamespace
    >>> image = np.zeros((120, 160, 3), np.uint8)
    >>> image[40:90, 60:110] = 255
    >>> box = DetectionFrame(np.array([[60.0, 40.0, 110.0, 90.0]]), np.array([0.9]), ("car",))
    >>> nothing = DetectionFrame(np.empty((0, 4)), np.empty(0), ())
    >>> class Bright:
    ...     def detect(self, frame): return box if frame[40:90, 60:110].mean() > 100 else nothing
    >>> video = SimpleNamespace(frames=lambda: iter([image] * 20), n_frames=20, frame_rate_hz=10.0)
    >>> truth = DetectionLog.at_rate([box] * 20, 10.0)
    >>> scene = LabelledVideo(video, truth, PinholeCamera(width_px=160, height_px=120))
    >>> settings = AbsenceSettings(families=("darkness",), moving_only=False)
    >>> rates = measure_absence([scene], Bright, np.random.default_rng(0), settings)
    >>> rates.families["darkness"].misses[0]
    (0.0, 0.0, 10.0, 10.0, 10.0)
    """
    chosen = settings or AbsenceSettings()
    if not scenes:
        raise InvalidArgumentError("scenes: expected at least one video")
    tally = AbsenceTally(scenes[0].camera, chosen)
    for scene in scenes:
        looks = [_Look(tally, make_detector(), "all", 0)]
        for family in chosen.families:
            looks += [_Look(tally, make_detector(), family, level) for level in range(1, len(LEVELS))]
        for number, frame in enumerate(scene.video.frames()):
            for look in looks:
                look.take(scene, number, frame, rng)
            on_frame()
    if not tally.looks:
        raise InputFileError(scenes[0].reference.source, "expected moving objects in view, found none")
    return MissRates(
        azimuth_deg=tally.edges_deg,
        families=tally.counts(),
        provenance=provenance or {},
        health=_health(scenes, rng),
        repeats=chosen.repeats,
    )


class AbsenceTally:
    """Counts of looks and misses, family by family, of what a detector found on staged frames."""

    def __init__(self, camera: PinholeCamera, settings: AbsenceSettings | None = None) -> None:
        self._camera, self._settings = camera, settings or AbsenceSettings()
        self.edges_deg = self._settings.edges_deg(camera)
        self._clean, *tallies = (
            _Tally(self.edges_deg, self._settings) for _ in (0, *self._settings.families)
        )
        self._tallies = dict(zip(self._settings.families, tallies, strict=True))

    @property
    def looks(self) -> float:
        """Reference objects on clean frames."""
        return float(self._clean.looks[:, 0].sum())

    def count(
        self, reference: DetectionLog, number: int, found: DetectionFrame, family: Family, level: int
    ) -> None:
        """Count what was found in a frame at a level; level 0 is the clean frame of every family."""
        tally = self._tallies[family] if level else self._clean
        tally.count(self._camera, reference, number, found, level)

    def counts(self) -> dict[str, FamilyCounts]:
        """Return the counts so far by family."""
        return {family: tally.counts(self._clean) for family, tally in self._tallies.items()}


class _Tally:
    """Counts of one family, level by level."""

    def __init__(self, edges_deg: Sequence[float], settings: AbsenceSettings) -> None:
        self._edges_deg = np.array(edges_deg)
        self._settings = settings
        shape = (len(edges_deg) - 1, len(LEVELS))
        self.looks, self.misses = np.zeros(shape), np.zeros(shape)
        self.sectors, self.clutter = np.zeros(len(LEVELS)), np.zeros(len(LEVELS))

    def counts(self, clean: "_Tally") -> FamilyCounts:
        """Return the counts, those of the clean frames in the first column."""
        for mine, theirs in zip(self._all(), clean._all(), strict=True):
            mine[..., 0] = theirs[..., 0]
        return FamilyCounts(_rows(self.looks), _rows(self.misses), tuple(self.sectors), tuple(self.clutter))

    def _all(self) -> tuple[FloatArray, ...]:
        return self.looks, self.misses, self.sectors, self.clutter

    def count(
        self, camera: PinholeCamera, reference: DetectionLog, number: int, found: DetectionFrame, level: int
    ) -> None:
        """Count what was found in a frame at a level."""
        if not self._settings.warm_up <= number < len(reference):
            return
        there = reference.frames[number]
        boxes = there.boxes_px[_counted(reference, number, self._settings)]
        hit = overlaps(boxes, found.boxes_px) >= self._settings.min_overlap
        middles = (boxes[:, 0] + boxes[:, 2]) / 2.0
        off_axis_deg = np.degrees(np.abs(camera.off_axis(camera.azimuth(middles))))
        bins = np.clip(
            np.searchsorted(self._edges_deg, off_axis_deg, side="right") - 1, 0, len(self.looks) - 1
        )
        np.add.at(self.looks[:, level], bins, 1.0)
        np.add.at(self.misses[:, level], bins, ~hit.any(axis=1))
        false = ~(overlaps(found.boxes_px, there.boxes_px) >= self._settings.min_overlap).any(axis=1)
        false &= ~_inside(found.boxes_px, there.boxes_px)
        self._count_clutter(camera, there.boxes_px, found.boxes_px[false], level)

    def _count_clutter(
        self, camera: PinholeCamera, there_px: FloatArray, false_px: FloatArray, level: int
    ) -> None:
        """Count the sectors without a reference object, and those of them that a false detection touches."""
        objects, false = _azimuths(camera, there_px), _azimuths(camera, false_px)
        right, left = camera.view_rad
        half = self._settings.half_width_rad
        for centre in np.arange(right + half, left - half + 1e-9, _SECTOR_STEP_RAD):
            sector = Sector(float(centre), half)
            if not any(sector.touches(azimuth, width) for azimuth, width in objects):
                self.sectors[level] += 1.0
                self.clutter[level] += any(sector.touches(azimuth, width) for azimuth, width in false)


@dataclass(frozen=True, slots=True)
class _Look:
    """One detector on the frames of a video at one level of one family."""

    tally: AbsenceTally
    detector: Detector
    family: Family
    level: int

    def take(self, scene: LabelledVideo, number: int, frame: ImageArray, rng: np.random.Generator) -> None:
        """Degrade a frame, look at it and count."""
        found = self.detector.detect(degrade(frame, self.family, LEVELS[self.level], rng))
        self.tally.count(scene.reference, number, found, self.family, self.level)


def _counted(reference: DetectionLog, number: int, settings: AbsenceSettings) -> IntArray:
    kept, still = kept_and_parked(reference, number, settings.keep, ParkedRule())
    return kept[~still] if settings.moving_only else kept


def _inside(boxes_px: FloatArray, others_px: FloatArray) -> BoolArray:
    """Whether the middle of each box lies in some other one, shape (n,)."""
    middles = (boxes_px[:, None, :2] + boxes_px[:, None, 2:]) / 2.0
    held = (middles >= others_px[None, :, :2]) & (middles <= others_px[None, :, 2:])
    return np.asarray(np.any(np.all(held, axis=2), axis=1))


def _azimuths(camera: PinholeCamera, boxes_px: FloatArray) -> Collection[tuple[float, float]]:
    seen = [camera.sighting(box, "", 1.0) for box in boxes_px]
    return [(sighting.azimuth_rad, sighting.width_rad) for sighting in seen]


def _health(scenes: Sequence[LabelledVideo], rng: np.random.Generator) -> CameraHealth | None:
    """Learn from frames spread over the videos; None where none of them shows anything sharp."""
    frames = []
    for scene in scenes[:_HEALTH_FRAMES]:
        wanted = max(_HEALTH_FRAMES // len(scenes), 1)
        step = max(len(scene.reference) // (wanted + 1), 1)
        for number, frame in enumerate(scene.video.frames()):
            if number and number % step == 0 and number // step <= wanted:
                frames.append(frame)
    try:
        return learn_health(frames, rng)
    except InvalidArgumentError:
        return None


def reference_by(detector: Detector, video: Video) -> DetectionLog:
    """Return what a detector reports on clean frames: the reference where there is no other."""
    # Its miss rate on clean frames is then zero by definition: only the degraded ones tell anything.
    found = [detector.detect(frame) for frame in video.frames()]
    return DetectionLog.at_rate(found, video.frame_rate_hz, source=str(video.path))


def _rows(values: FloatArray) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in values.tolist())
