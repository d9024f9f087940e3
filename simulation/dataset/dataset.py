"""Recordings on disk in the OVAD layout: D/<environment>/<class>/<ID> and D/DataLog.csv."""

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.video import VIDEO_NAME
from worldstate.adapters.datasets import ovad
from worldstate.adapters.files.array_file import read_array, write_array_xml
from worldstate.adapters.files.file_io import atomic_path, read_json, write_json, write_rows
from worldstate.frontend.array.microphone_array import MicrophoneArray, ovad_array
from worldstate.ground import InputFileError, InvalidArgumentError, in_range
from worldstate.ground.checks import check_ranges
from worldstate.ground.extras import check_extra, optional
from worldstate.ground.parallel import deferred_signals, in_processes
from worldstate.ground.typing import Float32Array, FloatArray, ImageArray
from worldstate.simulation.camera.simulated_detector import Frame, to_json
from worldstate.simulation.camera.street_view import View, paint_street
from worldstate.simulation.camera.vehicle_view import PAINTS, Car, add_car, with_parked_car
from worldstate.simulation.scene.driving import CAMERA
from worldstate.simulation.scene.junction import MOVING_SITES, PLACES, SITES, Site, place, place_of
from worldstate.simulation.scene.kinds import vehicle_kind
from worldstate.simulation.scene.presets import DEFAULT_PRESET, preset
from worldstate.simulation.scene.settings import (
    APPROACHES,
    MAX_SOUNDS,
    SimulationSettings,
    draw_settings,
    rate_for,
    sound_kind,
    with_sounds,
)
from worldstate.simulation.scene.vehicle import LENGTH_M, WIDTH_M

from .recording import (
    SimulatedRecording,
    finished_folder,
    put_in_place,
    refuse_foreign,
    simulate_recording,
    sound_writer,
)

# The running number in an ID has four digits.
MAX_RECORDINGS = 10_000
JUNCTION, ALL = "junction", "all"
# Below, the band of bearings and features is empty; above, it does not change.
BANDWIDTHS_HZ = (700.0, 16_000.0)
APPROACH_SIDES = ("left", "right")


@dataclass(frozen=True, slots=True)
class Plan:
    """Properties of one recording of a data set, fixed before anything is drawn at random."""

    number: int
    environment: str
    approach: str
    seed: np.random.SeedSequence


@dataclass(frozen=True, slots=True)
class DatasetSettings:
    """Composition of a data set.

    Parameters
    ----------
    n_static, n_dynamic : int
        Number of recordings with a standing ego, and with one that drives up to the corner; half of each are
        hazard-free.
    seed : int
        Seed of the whole data set.
    scene : str
        "junction"; one of `PLACES`, with a standing ego and vehicles from the sides of the place; or "all"
        for the junctions and every place in turn.
    kind : str
        Kind of the vehicles, one of `KINDS`.
    duration_s : float
        Length of every recording, 0.5 to 60 s.
    video : bool
        Whether to write the camera images, too; sound, detections and truth do not depend on it. Only for
        a standing ego at a junction.
    video_width_px : int
        Width of the images, 64 to 1936 (OVAD's); the height follows. Boxes refer to the full size.
    bandwidth_hz : float, optional
        Upper limit of the rendered band, 700 to 16,000 Hz; `rate_for` gives the rate. Full by default.
    sounds : tuple of str
        Further sounds in every recording, from `SOUNDS`; a vehicle's signal is added to the vehicle, if any.
    preset : str
        Name of the preset: levels and spectra of everything except the geometry.
    sounds_folder : str
        Folder of recordings, one folder per kind of sound, that replace synthesis; none if empty.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range, a word is unknown or a combination is impossible.

    Examples
    --------
    >>> DatasetSettings(n_static=6, kind="electric").preset
    'street-6'
    """

    n_static: int = 4
    n_dynamic: int = 0
    seed: int = 1
    scene: str = JUNCTION
    kind: str = "light"
    duration_s: float = 10.0
    video: bool = False
    video_width_px: int = CAMERA.width_px
    preset: str = DEFAULT_PRESET
    sounds: tuple[str, ...] = ()
    bandwidth_hz: float | None = None
    sounds_folder: str = ""

    def __post_init__(self) -> None:
        check_ranges(self, n_static=(0, MAX_RECORDINGS), n_dynamic=(0, MAX_RECORDINGS))
        in_range("n_static + n_dynamic", self.n_static + self.n_dynamic, 1, MAX_RECORDINGS)
        check_ranges(self, seed=(0, 2**63), duration_s=(0.5, 60.0), video_width_px=(64, CAMERA.width_px))
        vehicle_kind(self.kind)
        if self.bandwidth_hz is not None:
            in_range("bandwidth_hz", self.bandwidth_hz, *BANDWIDTHS_HZ)
        in_range("sounds: their number", len(self.sounds), 0, MAX_SOUNDS)
        for name in self.sounds:
            sound_kind(name)
        preset(self.preset)
        if self.scene not in (JUNCTION, ALL):
            place(self.scene)
        if self.n_dynamic and self.scene != JUNCTION:
            problem = f"expected 0 with scene {self.scene!r}, got {self.n_dynamic}"
            raise InvalidArgumentError(f"n_dynamic: {problem}")
        if self.video and (self.n_dynamic or self.scene != JUNCTION):
            raise InvalidArgumentError("video: expected only static recordings of the scene 'junction'")

    def camera(self) -> PinholeCamera:
        """Return the camera of the video: OVAD's, with images of the chosen width."""
        # The codec requires an even height.
        height_px = 2 * round(0.5 * CAMERA.height_px * self.video_width_px / CAMERA.width_px)
        return PinholeCamera.ovad(width_px=self.video_width_px, height_px=height_px)

    def plans(self) -> list[Plan]:
        """Return the plan of every recording: site after site, the standing ego first.

        Examples
        --------
        >>> [(p.environment, p.approach) for p in DatasetSettings(n_static=1, n_dynamic=2).plans()]
        [('SA1', 'left'), ('DA1', 'left'), ('DA1', 'none')]
        """
        children = np.random.SeedSequence(self.seed).spawn(self.n_static + self.n_dynamic)
        groups = (range(self.n_static), self._sites()), (range(self.n_dynamic), MOVING_SITES)
        wanted = [_site_and_approach(i, names) for group, names in groups for i in group]
        both = enumerate(zip(wanted, children, strict=True))
        return [Plan(number, *what, child) for number, (what, child) in both]

    def _sites(self) -> tuple[str, ...]:
        if self.scene == JUNCTION:
            return SITES
        names = PLACES if self.scene == ALL else (self.scene,)
        return (*(SITES if self.scene == ALL else ()), *(place(name).site.name for name in names))


def _site_and_approach(number: int, names: tuple[str, ...]) -> tuple[str, str]:
    """Return the site and the approach of a recording; every other one has no approach."""
    pair = number // 2
    name = names[pair % len(names)]
    if number % 2:
        return name, "none"
    known = place_of(name)
    sides = APPROACH_SIDES if known is None else known.approaches
    # With an even number of sites each site would otherwise always have the same side.
    turn = pair + (pair // len(names) if len(names) % 2 == 0 else 0)
    return name, sides[turn % len(sides)]


# OVAD's location numbers 00 to 09, then the other places.
LOCATIONS = (*SITES, *MOVING_SITES, *(place(name).site.name for name in PLACES))
UNKNOWN_LOCATION = 99


@dataclass(frozen=True, slots=True)
class LogRow:
    """One line of `DataLog.csv`."""

    # `X_LL_NNNN`: class number (1 left, 2 none, 3 right), location number, running number.
    recording_id: str
    environment: str  # Site name
    approach: str  # "left", "none" or "right"
    t0_frame: int  # Camera frame of line-of-sight entry

    @property
    def folder(self) -> Path:
        """Folder of the recording below the root.

        Examples
        --------
        >>> LogRow("1_00_0002", "SA1", "left", 70).folder.as_posix()
        'SA1/left/1_00_0002'
        """
        return Path(self.environment, self.approach, self.recording_id)


def write_dataset(
    root: str | Path,
    settings: DatasetSettings | None = None,
    *,
    array: MicrophoneArray | None = None,
    jobs: int = 1,
    progress: Callable[[LogRow], None] | None = None,
    go_on: bool = False,
) -> list[LogRow]:
    """Simulate a data set.

    The same settings give the same bytes for any number of jobs, because every recording has its own seed.
    After an interrupted call, the recordings that were finished in order and a log of them remain.

    Parameters
    ----------
    root : str or Path
        Output folder; it is created if needed. Simulated recordings of the same name are replaced, and
        others in its log stay listed.
    settings : DatasetSettings, optional
        Settings of the data set; four recordings of junctions by default.
    array : MicrophoneArray, optional
        The array; the data set stores it in `array.xml`. Default `ovad_array`.
    jobs : int
        Processes, 1 to 256.
    progress : callable, optional
        Called with every recording in order, when it is finished or found.
    go_on : bool
        Whether to keep listed recordings of these settings and continue an interrupted call.

    Returns
    -------
    list of LogRow
        The lines of `DataLog.csv` that this call simulated.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range.
    InputFileError
        If a target folder exists and is not simulated, or holds recordings of another array.
    MissingExtraError
        If video is requested and OpenCV is not installed.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> pair = MicrophoneArray([[0.0, 0.1, 0.0], [0.0, -0.1, 0.0]])
    >>> with TemporaryDirectory() as root:
    ...     rows = write_dataset(root, DatasetSettings(n_static=2, duration_s=0.5), array=pair)
    >>> [row.approach for row in rows]
    ['left', 'none']
    """
    in_range("jobs", jobs, 1, 256)
    wanted = settings or DatasetSettings()
    if wanted.video:
        check_extra("cv2")
    folder, plans = Path(root), wanted.plans()
    folder.mkdir(parents=True, exist_ok=True)
    listed, listening = _listed(folder), ovad_array() if array is None else array
    if (folder / ovad.ARRAY_NAME).exists():
        _name_array(folder / ovad.ARRAY_NAME, listening)
    folders = [_log_row(plan.environment, plan.approach, plan.number, 0).folder for plan in plans]
    for at in folders:
        refuse_foreign(folder / at)
    rows, kept = [], [folder / at if go_on and at in listed else None for at in folders]
    with TemporaryDirectory(prefix=".simulated-", dir=folder) as unlisted:
        simulate = partial(_simulate_one, Path(unlisted), wanted, listening)
        with closing(in_processes(simulate, list(zip(plans, kept, strict=True)), jobs)) as simulated:
            for at, row in zip(folders, simulated, strict=True):
                if row is not None:
                    rows.append(row)
                    listed[at] = row
                    _name_array(folder / ovad.ARRAY_NAME, listening)
                    with deferred_signals():
                        try:
                            put_in_place(folder / at, Path(unlisted) / at)
                        finally:
                            write_log(folder, [one for at, one in listed.items() if (folder / at).is_dir()])
                if progress is not None:
                    progress(listed[at])
    return rows


def write_recording(
    root: str | Path,
    recording: SimulatedRecording,
    number: int = 0,
    frames: Iterable[ImageArray] | None = None,
) -> LogRow:
    """Write one recording below `root`, completely or not at all, and the array of the data set beside it.

    Parameters
    ----------
    root : str or Path
        Existing folder of the data set.
    recording : SimulatedRecording
        The recording; its truth has site and approach.
    number : int
        Running number in the ID, 0..9999.
    frames : iterable of ndarray, optional
        Camera images, from `camera_frames`; no video if not given.

    Returns
    -------
    LogRow
        Its line in `DataLog.csv`; ``root / row.folder`` is its folder.

    Raises
    ------
    InputFileError
        If the target folder exists and is not simulated, or the data set has another array.

    Examples
    --------
    >>> import numpy as np
    >>> from tempfile import TemporaryDirectory
    >>> from worldstate.simulation import SimulationSettings, simulate_recording, site
    >>> settings = SimulationSettings(site("SA1"), "none", duration_s=0.5)
    >>> recording = simulate_recording(settings, np.random.default_rng(1))
    >>> with TemporaryDirectory() as root:
    ...     row = write_recording(root, recording)
    ...     row.folder.as_posix(), (Path(root) / row.folder / "out_multi.wav").is_file()
    ('SA1/none/2_00_0000', True)
    """
    in_range("number", number, 0, 9999)
    settings = recording.truth["settings"]
    row = _log_row(settings["site"]["name"], settings["approach"], number, recording.t0_frame)
    with finished_folder(Path(root) / row.folder) as temporary:
        _name_array(Path(root) / ovad.ARRAY_NAME, recording.array)
        samples, channels = recording.audio.shape
        with sound_writer(temporary / ovad.AUDIO_NAME, samples, channels, recording.sample_rate_hz) as file:
            file.write(recording.audio)
        if recording.detections:
            write_json(temporary / ovad.DETECTION_NAMES[0], to_json(list(recording.detections)))
        write_json(temporary / ovad.TRUTH_NAME, recording.truth)
        if frames is not None:
            write_video(temporary / VIDEO_NAME, frames)
    return row


def write_log(root: str | Path, rows: Sequence[LogRow]) -> None:
    """Write `DataLog.csv`, which lists the recordings of a data set."""
    listed = ([row.recording_id, row.environment, row.approach, row.t0_frame] for row in rows)
    write_rows(Path(root) / ovad.LOG_NAME, ovad.COLUMNS, listed, newline="\n")


def _drawn(
    wanted: DatasetSettings, array: MicrophoneArray, plan: Plan
) -> tuple[SimulationSettings, np.random.Generator]:
    """Return the settings of a recording, and the generator that simulates it."""
    rng = np.random.default_rng(plan.seed)
    levels = replace(preset(wanted.preset), sounds_folder=wanted.sounds_folder)
    settings = draw_settings(plan.environment, plan.approach, rng, wanted.duration_s, wanted.kind, levels)
    if wanted.bandwidth_hz is not None:
        settings = replace(settings, sample_rate_hz=rate_for(wanted.bandwidth_hz))
    if wanted.sounds:
        settings = with_sounds(settings, wanted.sounds, array.n_microphones, rng.spawn(1)[0])
    return settings, rng


def _simulate_one(
    root: Path, wanted: DatasetSettings, array: MicrophoneArray, item: tuple[Plan, Path | None]
) -> LogRow | None:
    """Write a recording below `root`; return None if a recording of these settings is kept."""
    plan, kept = item
    settings, rng = _drawn(wanted, array, plan)
    if kept is not None:
        truth = read_json(kept / ovad.TRUTH_NAME, "a truth file")
        if isinstance(truth, dict) and truth.get("settings") == json.loads(json.dumps(asdict(settings))):
            return None
    recording = simulate_recording(settings, rng, array)
    # The images have their own generator, so that the option `video` does not change the rest.
    frames = None
    if wanted.video:
        frames = camera_frames(settings, recording, rng.spawn(1)[0], wanted.camera())
    return write_recording(root, recording, plan.number, frames)


def _log_row(environment: str, approach: str, number: int, t0_frame: int) -> LogRow:
    location = LOCATIONS.index(environment) if environment in LOCATIONS else UNKNOWN_LOCATION
    identity = f"{APPROACHES.index(approach) + 1}_{location:02d}_{number:04d}"
    return LogRow(identity, environment, approach, t0_frame)


def _name_array(path: Path, array: MicrophoneArray) -> None:
    if not path.exists():
        write_array_xml(path, array)
    elif not np.array_equal(read_array(path).positions_m, array.positions_m):
        way_on = "another one needs a folder of its own"
        raise InputFileError(path, f"expected the array of these recordings; {way_on}")


def _listed(root: Path) -> dict[Path, LogRow]:
    """Return the recordings that the log of a data set lists and that exist."""
    if not (root / ovad.LOG_NAME).exists():
        return {}
    found = [recording for recording in ovad.OvadDataset(root).recordings if recording.path.is_dir()]
    rows = [LogRow(r.recording_id, str(r.environment), str(r.label), r.logged_frame or 0) for r in found]
    return {row.folder: row for row in rows}


CODEC = "mp4v"
SENSOR_NOISE = 1.5  # Grey levels
# Ten standard deviations of a parked car's box; a moving vehicle moves further between two images.
STILL_PX = 4.0
STEP_M = 0.01


def camera_frames(
    settings: SimulationSettings,
    recording: SimulatedRecording,
    rng: np.random.Generator,
    camera: PinholeCamera | None = None,
) -> Iterator[ImageArray]:
    """Yield the camera images, ten frames per second.

    Examples
    --------
    >>> from worldstate.simulation import simulate_recording, site
    >>> settings = SimulationSettings(site("SA1"), "left", duration_s=0.6, entry_s=0.3, sample_rate_hz=8e3)
    >>> recording = simulate_recording(settings, np.random.default_rng(1))
    >>> small = PinholeCamera.ovad(width_px=96, height_px=60)
    >>> frames = list(camera_frames(settings, recording, np.random.default_rng(1), small))
    >>> len(frames), frames[0].shape, frames[0].dtype
    (6, (60, 96, 3), dtype('uint8'))
    """
    # The street depends on the site alone. Buildings hide the vehicle until its front crosses the line of
    # sight past their corner, which is the recording's T0. Light and camera do not change, so two images
    # differ only in the vehicle, its shadow and the sensor noise.
    view = View(camera or CAMERA)
    paint, parked_paint = (PAINTS[i] for i in rng.integers(len(PAINTS), size=2))
    street = paint_street(settings.site, view)
    if settings.parked_car:
        middle = parked_middle_m(recording.detections, settings.site)
        if middle is not None:
            lane = parked_lane_m(settings.site)
            street = with_parked_car(street, Car(lane, middle + 0.5 * LENGTH_M, 1, parked_paint))
    still = street.pixels()
    heading = -1 if settings.approach == "left" else 1
    truth = recording.truth["frames"]
    for number in range(len(recording.detections)):
        image = still.copy()
        if truth:
            lane, front = truth[number]["position_m"]
            add_car(street, Car(lane, front, heading, paint), image)
        yield _taken(image, rng)


def write_video(path: str | Path, frames: Iterable[ImageArray]) -> None:
    """Write frames of one size as MPEG-4, completely or not at all.

    Shapes: frames (height, width, 3).
    """
    cv2 = optional("cv2")
    waiting = iter(frames)
    first = next(waiting, None)
    if first is None:
        raise InvalidArgumentError("frames: expected at least one")
    with atomic_path(path) as temporary:
        code = cv2.VideoWriter_fourcc(*CODEC)
        writer = cv2.VideoWriter(str(temporary), code, ovad.FRAME_RATE_HZ, (first.shape[1], first.shape[0]))
        if not writer.isOpened():
            raise InputFileError(path, f"expected to write a video of {first.shape[1]} x {first.shape[0]} px")
        try:
            writer.write(first)
            for frame in waiting:
                writer.write(frame)
        finally:
            writer.release()


def parked_lane_m(site: Site) -> float:
    """Distance ahead of the middle of a car that is parked at the far kerb."""
    return site.far_kerb_m - 0.5 * WIDTH_M


def parked_middle_m(detections: Iterable[Frame], site: Site) -> float | None:
    """Return the position of the parked car along the street from its boxes; None without a car."""
    boxes = np.array([frame[0].box_px for frame in detections if frame])
    still = boxes[(np.abs(boxes - boxes[:1]) < STILL_PX).all(axis=1)] if len(boxes) else boxes
    if not len(still):
        return None
    faces = parked_lane_m(site) + WIDTH_M * np.array([-0.5, 0.5])
    right, left = site.sights_m(faces, CAMERA.position_m[:2])
    middles = np.arange(right[0], left[0], STEP_M)
    ends = np.clip(middles[:, None, None] + LENGTH_M * np.array([[-0.5], [0.5]]), right, left)
    wanted = np.median(still, axis=0)[[0, 2]]
    missed = np.abs(_columns_px(faces, ends) - wanted).sum(axis=1)
    return float(middles[missed.argmin()])


def _columns_px(ahead_m: FloatArray, ends_m: FloatArray) -> FloatArray:
    """Return the first and last column of n cuboids, (n, 2), from two faces (2,) and their ends (n, 2, 2)."""
    # At the height of the camera, its pitch only shortens the depth.
    slope = (ends_m - CAMERA.position_m[1]) / ((ahead_m - CAMERA.position_m[0]) * np.cos(CAMERA.pitch_rad))
    focal = 0.5 * CAMERA.width_px / np.tan(CAMERA.half_angle_rad)
    columns = np.clip(0.5 * CAMERA.width_px - focal * slope, 0.0, CAMERA.width_px - 1.0).reshape(-1, 4)
    return np.stack([columns.min(axis=1), columns.max(axis=1)], axis=1)


def _taken(image: Float32Array, rng: np.random.Generator) -> ImageArray:
    """Add sensor noise, equal in all colours, and round; RGB becomes BGR."""
    noise = rng.standard_normal(image.shape[:2], dtype=np.float32)
    noise *= SENSOR_NOISE
    taken = image[:, :, ::-1] + noise[:, :, None]
    np.rint(taken, out=taken)
    return np.clip(taken, 0.0, 255.0, out=taken).astype(np.uint8)
