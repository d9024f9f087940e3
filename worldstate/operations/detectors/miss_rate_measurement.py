"""Miss rates of a camera's detector, measured on degraded frames with reference boxes, and their figure."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from worldstate.abduction.co_evidence import Sector
from worldstate.adapters.camera.box_linking import overlaps
from worldstate.adapters.camera.camera_health import (
    FAMILIES,
    LEVELS,
    CameraHealth,
    Family,
    degrade,
    learn_health,
)
from worldstate.adapters.camera.detections import (
    DetectionFilter,
    DetectionFrame,
    DetectionLog,
    Detector,
    kept_and_parked,
)
from worldstate.adapters.camera.miss_rates import FamilyCounts, MissRates, as_tuples
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.video import VIDEO_NAME, Video
from worldstate.adapters.datasets.ovad import LOG_NAME, OvadDataset, Recording
from worldstate.ground import InputFileError, InvalidArgumentError
from worldstate.ground.typing import BoolArray, FloatArray, IntArray
from worldstate.operations.figure_style import SEARCHED, figure_file, legend_beside

MakeDetector = Callable[[], Detector]

# Inner edges of the azimuth bins off the optical axis, which extend from 0 to the edge of the view.
_BINS_DEG = (10.0, 20.0, 30.0)
# Smallest IoU at which a reference box counts as found.
MIN_OVERLAP = 0.3
# Half the width of a query sector for clutter, and distance between the sectors.
_HALF_WIDTH_RAD, _SECTOR_STEP_RAD = float(np.radians(10.0)), np.radians(5.0)
_REFERENCE = DetectionFilter(frozenset({"car", "motorcycle", "truck", "bus"}), 0.5, 40.0)
# Number of clean frames for the health scale, spread over the videos.
_HEALTH_FRAMES = 10
# Initial frames of each video that are ignored, because motion detectors learn the background in them.
_WARM_UP = 10
# Frames per independent look: ten frames per second, and one independent look every 0.3 s.
REPEATS = 3.0


@dataclass(frozen=True, slots=True)
class AbsenceSettings:
    """Settings of the measurement.

    Parameters
    ----------
    families : tuple of str
        Degradations that are simulated.
    keep : DetectionFilter
        Filter of the reference boxes. Parked objects are excluded, because they are no co-evidence, and
        motion detectors do not find them.

    Raises
    ------
    InvalidArgumentError
        If a family is unknown.

    Examples
    --------
    >>> AbsenceSettings().edges_deg(PinholeCamera.ovad())[:4]
    (0.0, 10.0, 20.0, 30.0)
    """

    families: tuple[Family, ...] = FAMILIES
    keep: DetectionFilter = _REFERENCE

    def __post_init__(self) -> None:
        if not self.families or not set(self.families) <= set(FAMILIES):
            raise InvalidArgumentError(f"families: expected some of {', '.join(FAMILIES)}")

    def edges_deg(self, camera: PinholeCamera) -> tuple[float, ...]:
        """Return the bin edges of a camera; the last one is 1 degree outside its view."""
        edge = float(np.degrees(np.abs(camera.off_axis(camera.view_rad)).max())) + 1.0
        return (0.0, *(deg for deg in _BINS_DEG if 0.0 < deg < edge - 2.0), edge)


@dataclass(frozen=True, slots=True)
class LabelledVideo:
    """A video with reference detections."""

    video: Video  # Clean frames
    reference: DetectionLog  # Reference objects, one entry per frame
    camera: PinholeCamera  # Camera of the video


def measure_absence(
    scenes: Sequence[LabelledVideo],
    make_detector: MakeDetector,
    rng: np.random.Generator,
    settings: AbsenceSettings | None = None,
    *,
    provenance: dict[str, str] | None = None,
    on_frame: Callable[[], None] = lambda: None,
) -> MissRates:
    r"""Measure the miss rate of reference boxes on degraded frames.

    A reference box is found if a detection has :math:`IoU \ge 0.3` with it. A detection is false if it has a
    smaller IoU with all reference boxes and its middle is in none of them. A query sector without a reference
    object has clutter if a false detection overlaps it.

    Parameters
    ----------
    scenes : sequence of LabelledVideo
        Videos of one camera.
    make_detector : callable
        Creates a detector. Detectors may have a state, so each video gets a new one at each level.
    rng : numpy.random.Generator
        Generates the simulated noise.
    settings : AbsenceSettings, optional
        Settings of the measurement.
    provenance : dict of str, optional
        Metadata for the file.
    on_frame : callable
        Called after each frame of each video, when all levels of all families are done.

    Returns
    -------
    MissRates
        Looks and misses per family, azimuth bin and level.

    Raises
    ------
    InvalidArgumentError
        If there are no scenes.
    InputFileError
        If no reference object is ever in view.

    Examples
    --------
    Twenty images of a white box that moves on black, and a detector that finds bright regions:

    >>> from types import SimpleNamespace
    >>> images = np.zeros((20, 120, 160, 3), np.uint8)
    >>> lefts = 46 + np.arange(20)
    >>> for image, left in zip(images, lefts): image[40:90, left : left + 50] = 255
    >>> corners = np.column_stack([lefts, [40] * 20, lefts + 50, [90] * 20]).astype(float)
    >>> boxes = [DetectionFrame(one[None], np.array([0.9]), ("car",)) for one in corners]
    >>> nothing = DetectionFrame(np.empty((0, 4)), np.empty(0), ())
    >>> class Bright:
    ...     def detect(self, frame):
    ...         row = frame[65, :, 0]
    ...         return boxes[row.argmax() - 46] if row.max() > 100 else nothing
    >>> video = SimpleNamespace(frames=lambda: iter(images), n_frames=20, frame_rate_hz=10.0)
    >>> truth = DetectionLog.at_rate(boxes, 10.0)
    >>> scene = LabelledVideo(video, truth, PinholeCamera.ovad(width_px=160, height_px=120))
    >>> settings = AbsenceSettings(families=("darkness",))
    >>> rates = measure_absence([scene], Bright, np.random.default_rng(0), settings)
    >>> rates.families["darkness"].misses[0]
    (0.0, 0.0, 10.0, 10.0, 10.0)
    """
    chosen = settings or AbsenceSettings()
    if not scenes:
        raise InvalidArgumentError("scenes: expected at least one video")
    tally = AbsenceTally(scenes[0].camera, chosen)
    for scene in scenes:
        staged = [(family, level) for family in chosen.families for level in range(1, len(LEVELS))]
        looks = [(make_detector(), *one) for one in (("all", 0), *staged)]
        for number, frame in enumerate(scene.video.frames()):
            for detector, family, level in looks:
                found = detector.detect(degrade(frame, family, LEVELS[level], rng))
                tally.count(scene.reference, number, found, family, level)
            on_frame()
    if not tally.looks:
        raise InputFileError(scenes[0].reference.source, "expected moving objects in view, found none")
    return MissRates(tally.edges_deg, tally.counts(), provenance or {}, _health(scenes, rng), REPEATS)


class AbsenceTally:
    """Sums of looks and misses per family, from detections on degraded frames."""

    def __init__(self, camera: PinholeCamera, settings: AbsenceSettings) -> None:
        self._camera, self._settings = camera, settings
        self.edges_deg = settings.edges_deg(camera)
        by_level = len(settings.families), len(LEVELS)
        by_bin = len(settings.families), len(self.edges_deg) - 1, len(LEVELS)
        self._looks, self._misses = np.zeros(by_bin), np.zeros(by_bin)
        self._sectors, self._clutter = np.zeros(by_level), np.zeros(by_level)

    @property
    def looks(self) -> float:
        """Number of reference objects on clean frames."""
        return float(self._looks[0, :, 0].sum())

    def count(
        self, reference: DetectionLog, number: int, found: DetectionFrame, family: Family, level: int
    ) -> None:
        """Add the detections in a frame at a level; level 0 is the clean frame of every family."""
        if not _WARM_UP <= number < len(reference):
            return
        families = slice(None) if level == 0 else self._settings.families.index(family)
        there = reference.frames[number]
        kept, still = kept_and_parked(reference, number, self._settings.keep)
        boxes = there.boxes_px[kept[~still]]
        hit = overlaps(boxes, found.boxes_px) >= MIN_OVERLAP
        bins = self._bins(boxes)
        n_bins = len(self.edges_deg) - 1
        self._looks[families, :, level] += np.bincount(bins, minlength=n_bins)
        self._misses[families, :, level] += np.bincount(bins, ~hit.any(axis=1), n_bins)
        false = ~(overlaps(found.boxes_px, there.boxes_px) >= MIN_OVERLAP).any(axis=1)
        false &= ~_inside(found.boxes_px, there.boxes_px)
        touched = self._empty_sectors(there.boxes_px, found.boxes_px[false])
        self._sectors[families, level] += len(touched)
        self._clutter[families, level] += sum(touched)

    def counts(self) -> dict[str, FamilyCounts]:
        """Return the sums so far per family."""
        every = zip(self._looks, self._misses, self._sectors, self._clutter, strict=True)
        return {
            family: FamilyCounts(*map(as_tuples, counted))
            for family, counted in zip(self._settings.families, every, strict=True)
        }

    def _bins(self, boxes_px: FloatArray) -> IntArray:
        """Return the azimuth bin, off the optical axis, of the middle of each box, shape (n,)."""
        azimuths = self._camera.azimuth((boxes_px[:, 0] + boxes_px[:, 2]) / 2.0)
        off_axis_deg = np.degrees(np.abs(self._camera.off_axis(azimuths)))
        found = np.searchsorted(self.edges_deg, off_axis_deg, side="right") - 1
        return np.asarray(np.clip(found, 0, len(self.edges_deg) - 2))

    def _empty_sectors(self, there_px: FloatArray, false_px: FloatArray) -> list[bool]:
        """Return for every sector without a reference object whether a false detection overlaps it."""
        half, (right, left) = _HALF_WIDTH_RAD, self._camera.view_rad
        centres = np.arange(right + half, left - half + 1e-9, _SECTOR_STEP_RAD)
        sectors = [Sector(float(centre), half) for centre in centres]
        return [self._touched(one, false_px) for one in sectors if not self._touched(one, there_px)]

    def _touched(self, sector: Sector, boxes_px: FloatArray) -> bool:
        seen = (self._camera.sighting(box, "", 1.0) for box in boxes_px)
        return any(sector.touches(one.azimuth_rad, one.width_rad) for one in seen)


def _inside(boxes_px: FloatArray, others_px: FloatArray) -> BoolArray:
    """Return whether the middle of each box is in any of the other boxes, shape (n,)."""
    middles = (boxes_px[:, None, :2] + boxes_px[:, None, 2:]) / 2.0
    held = (middles >= others_px[None, :, :2]) & (middles <= others_px[None, :, 2:])
    return np.asarray(np.any(np.all(held, axis=2), axis=1))


def _health(scenes: Sequence[LabelledVideo], rng: np.random.Generator) -> CameraHealth | None:
    """Learn the health scale from frames spread over the videos; None if no frame is sharp enough."""
    frames = []
    for scene in scenes[:_HEALTH_FRAMES]:
        wanted = max(_HEALTH_FRAMES // len(scenes), 1)
        step = max(len(scene.reference) // (wanted + 1), 1)
        every = enumerate(scene.video.frames())
        frames += [image for i, image in every if i and i % step == 0 and i // step <= wanted]
    try:
        return learn_health(frames, rng)
    except InvalidArgumentError:
        return None


def reference_by(detector: Detector, video: Video) -> DetectionLog:
    """Return the detections on clean frames, as the reference if there is no other."""
    # The miss rate on clean frames is then zero by definition; only degraded frames are informative.
    found = [detector.detect(frame) for frame in video.frames()]
    return DetectionLog.at_rate(found, video.frame_rate_hz, source=str(video.path))


def find_videos(path: Path) -> list[tuple[Path, Path | None]]:
    """Return videos with the files of their reference boxes, None for a video without one."""
    # In a data set, the recordings with a vehicle and with both files are used.
    if path.is_file():
        return [(path, None)]
    if not path.is_dir():
        raise InputFileError(path, "expected a video, a recording folder or a data set")
    if not (path / LOG_NAME).is_file():
        return [_of_recording(Recording.open(path))]
    approaches = [r for r in OvadDataset(path).recordings if r.label != "none"]
    found = [_of_recording(r) for r in approaches if (r.path / VIDEO_NAME).is_file() and r.detections_path]
    if not found:
        raise InputFileError(path, f"expected recordings of a vehicle with {VIDEO_NAME} and detections")
    return found


def _of_recording(recording: Recording) -> tuple[Path, Path | None]:
    video = recording.path / VIDEO_NAME
    if not video.is_file():
        raise InputFileError(recording.path, f"expected a recording with {VIDEO_NAME}")
    return video, recording.detections_path


def write_absence_figure(rates: MissRates, path: Path) -> None:
    """Draw `rates` as PNG, SVG or PDF, by the suffix of `path`."""
    names = list(rates.families)
    with figure_file(path, 3.0 * len(names) + 1.0, 3.2) as figure:
        panels = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
        for axes, name in zip(panels, names, strict=True):
            counts = rates.families[name]
            beta, (low, high) = counts.miss_rates(rates.repeats), counts.interval(rates.repeats)
            for i, row in enumerate(beta):
                # Bins farther off the axis are paler; all have the colour of looks.
                shade = 1.0 - 0.75 * i / max(len(beta) - 1, 1)
                label = f"{rates.azimuth_deg[i]:.0f}-{rates.azimuth_deg[i + 1]:.0f}°"
                axes.plot(LEVELS, row, marker="os^Dv"[i % 5], color=SEARCHED, alpha=shade, label=label)
                if np.sum(counts.looks[i]):
                    axes.fill_between(LEVELS, low[i], high[i], color=SEARCHED, alpha=0.12 * shade, lw=0)
            axes.plot(LEVELS, counts.clutter_rates, color="grey", linestyle=":", label="clutter")
            axes.set(title=name, xlabel="degradation $d$", ylim=(0.0, 1.0))
        panels[0].set_ylabel(r"miss rate $\beta(\theta, d)$")
        legend_beside(panels[-1], "off the optical axis")
