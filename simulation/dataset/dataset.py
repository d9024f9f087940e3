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
from worldstate.adapters.datasets.ovad import (
    ARRAY_NAME,
    AUDIO_NAME,
    COLUMNS,
    DETECTION_NAMES,
    FRAME_RATE_HZ,
    LOG_NAME,
    TRUTH_NAME,
    OvadDataset,
)
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

from .recording import SimulatedRecording, put_in_place, refuse_foreign, simulate_recording, sound_writer

# The running number in an ID has four digits.
MAX_RECORDINGS = 10_000
JUNCTION, ALL = "junction", "all"
# Below, nothing is left of the band that bearings and features are taken from; above, it stays as it is.
BANDWIDTHS_HZ = (700.0, 16_000.0)
APPROACH_SIDES = ("left", "right")


@dataclass(frozen=True, slots=True)
class Plan:
    """What the recording number `number` of a data set is, before anything is drawn."""

    number: int
    environment: str
    approach: str
    seed: np.random.SeedSequence
    kind: str = "light"


@dataclass(frozen=True, slots=True)
class DatasetSettings:
    """How a data set is made up.

    Parameters
    ----------
    n_static, n_dynamic : int
        Recordings with a standing ego and with one that drives up to the corner; in either group every other
        one is hazard-free.
    seed : int
        Of the whole data set.
    scene : str
        "junction", or one of `PLACES`, where the ego only stands and a vehicle comes from the sides that the
        place has; "all" for the junctions and every place in turn.
    kind : str
        What drives there, one of `KINDS`.
    duration_s : float
        Length of every recording, 0.5 to 60 s.
    video : bool
        Write what the camera sees, too; sound, detections and truth are the same with and without. Only for
        a standing ego at a junction.
    video_width_px : int
        Width of its images, 64 to 1936, OVAD's; the height follows. Boxes are those of the full size.
    bandwidth_hz : float, optional
        Render up to here only, 700 to 16,000 Hz, at the rate `rate_for`; the full rate if not given.
    sounds : tuple of str
        What else sounds in every recording, of `SOUNDS`; a vehicle's signal is its own where there is one.
    preset : str
        Name of the levels of everything that is not geometry.
    sounds_folder : str
        Recordings, a folder a kind of sound, that take the place of synthesis; none where empty.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range, a word unknown or a combination not to be had.

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
    video_width_px: int = PinholeCamera.ovad().width_px
    preset: str = DEFAULT_PRESET
    sounds: tuple[str, ...] = ()
    bandwidth_hz: float | None = None
    sounds_folder: str = ""

    def __post_init__(self) -> None:
        check_ranges(self, n_static=(0, MAX_RECORDINGS), n_dynamic=(0, MAX_RECORDINGS))
        in_range("n_static + n_dynamic", self.n_static + self.n_dynamic, 1, MAX_RECORDINGS)
        widest_px = PinholeCamera.ovad().width_px
        check_ranges(self, seed=(0, 2**63), duration_s=(0.5, 60.0), video_width_px=(64, widest_px))
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
        """Return the camera of the video: OVAD's, with images of the width that is wanted."""
        whole = PinholeCamera.ovad()
        # An even height: the codec takes no other.
        height_px = 2 * round(0.5 * whole.height_px * self.video_width_px / whole.width_px)
        return PinholeCamera.ovad(width_px=self.video_width_px, height_px=height_px)

    def plans(self) -> list[Plan]:
        """Return what every recording is: site after site, the standing ego first.

        Examples
        --------
        >>> [(p.environment, p.approach) for p in DatasetSettings(n_static=1, n_dynamic=2).plans()]
        [('SA1', 'left'), ('DA1', 'left'), ('DA1', 'none')]
        """
        children = np.random.SeedSequence(self.seed).spawn(self.n_static + self.n_dynamic)
        groups = (range(self.n_static), self._sites()), (range(self.n_dynamic), MOVING_SITES)
        wanted = [_site_and_approach(i, names) for group, names in groups for i in group]
        return [
            Plan(number, *what, child, self.kind)
            for number, (what, child) in enumerate(zip(wanted, children, strict=True))
        ]

    def _sites(self) -> tuple[str, ...]:
        if self.scene == JUNCTION:
            return SITES
        names = PLACES if self.scene == ALL else (self.scene,)
        return (*(SITES if self.scene == ALL else ()), *(place(name).site.name for name in names))


def _site_and_approach(number: int, names: tuple[str, ...]) -> tuple[str, str]:
    """Return site after site with an approach each, and the same without."""
    pair = number // 2
    name = names[pair % len(names)]
    if number % 2:
        return name, "none"
    known = place_of(name)
    sides = APPROACH_SIDES if known is None else known.approaches
    # An even number of sites would otherwise give each the same side for ever.
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
        """Where the recording lies below the root.

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

    The same settings give the same bytes, whatever the number of jobs: every recording has a seed of its own.
    Interrupted, it leaves the recordings that were finished in their order, and the log that lists them.

    Parameters
    ----------
    root : str or Path
        Folder to write to; made if it is not there. Simulated recordings of the same name are replaced,
        and others that its log lists stay listed.
    settings : DatasetSettings, optional
        What to write; four recordings of junctions if not given.
    array : MicrophoneArray, optional
        What listens; the data set names it in `array.xml`. Default `ovad_array`.
    jobs : int
        Processes, 1 to 256.
    progress : callable, optional
        Called with every recording in order, once it is finished or found to be there.
    go_on : bool
        Leave recordings that the log lists and that are of these settings: what was interrupted is finished.

    Returns
    -------
    list of LogRow
        The lines of `DataLog.csv`, of what was simulated by this call.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range.
    InputFileError
        If something that was not simulated stands where a recording would go, or recordings of another array.
    MissingExtraError
        If video is wanted and OpenCV is not installed.

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
    if (folder / ARRAY_NAME).exists():
        _name_array(folder / ARRAY_NAME, listening)
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
                    _name_array(folder / ARRAY_NAME, listening)
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
    """Write one recording below `root`, whole or not at all, and the array of the data set beside it.

    Parameters
    ----------
    root : str or Path
        Existing folder of the data set.
    recording : SimulatedRecording
        What to write; site and approach are in its truth.
    number : int
        Running number in the ID, 0..9999.
    frames : iterable of ndarray, optional
        What the camera sees, from `camera_frames`; no video where not given.

    Returns
    -------
    LogRow
        Its line in `DataLog.csv`; ``root / row.folder`` is where it lies.

    Raises
    ------
    InputFileError
        If something that was not simulated stands there, or the data set is of another array.

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
    target = Path(root) / row.folder
    refuse_foreign(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    _name_array(Path(root) / ARRAY_NAME, recording.array)
    with TemporaryDirectory(prefix=".simulated-", dir=target.parent) as folder:
        temporary = Path(folder) / target.name
        temporary.mkdir()
        samples, channels = recording.audio.shape
        with sound_writer(temporary / AUDIO_NAME, samples, channels, recording.sample_rate_hz) as file:
            file.write(recording.audio)
        if recording.detections:
            write_json(temporary / DETECTION_NAMES[0], to_json(list(recording.detections)))
        write_json(temporary / TRUTH_NAME, recording.truth)
        if frames is not None:
            write_video(temporary / VIDEO_NAME, frames)
        put_in_place(target, temporary)
    return row


def write_log(root: str | Path, rows: Sequence[LogRow]) -> None:
    """Write `DataLog.csv`, which lists the recordings of a data set."""
    listed = ([row.recording_id, row.environment, row.approach, row.t0_frame] for row in rows)
    write_rows(Path(root) / LOG_NAME, COLUMNS, listed, newline="\n")


def _drawn(
    wanted: DatasetSettings, array: MicrophoneArray, plan: Plan
) -> tuple[SimulationSettings, np.random.Generator]:
    """Return what a recording is, and the generator that goes on to simulate it."""
    rng = np.random.default_rng(plan.seed)
    levels = replace(preset(wanted.preset), sounds_folder=wanted.sounds_folder)
    settings = draw_settings(plan.environment, plan.approach, rng, wanted.duration_s, plan.kind, levels)
    if wanted.bandwidth_hz is not None:
        settings = replace(settings, sample_rate_hz=rate_for(wanted.bandwidth_hz))
    if wanted.sounds:
        settings = with_sounds(settings, wanted.sounds, array.n_microphones, rng.spawn(1)[0])
    return settings, rng


def _simulate_one(
    root: Path, wanted: DatasetSettings, array: MicrophoneArray, item: tuple[Plan, Path | None]
) -> LogRow | None:
    """Write a recording below `root`; None if it is of these settings where it is kept."""
    plan, kept = item
    settings, rng = _drawn(wanted, array, plan)
    if kept is not None:
        truth = read_json(kept / TRUTH_NAME, "a truth file")
        if isinstance(truth, dict) and truth.get("settings") == json.loads(json.dumps(asdict(settings))):
            return None
    recording = simulate_recording(settings, rng, array)
    # A generator of its own: what is drawn for the picture changes nothing else.
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
    """Return what the log of an existing data set lists and is there."""
    if not (root / LOG_NAME).exists():
        return {}
    found = [recording for recording in OvadDataset(root).recordings if recording.path.is_dir()]
    rows = [LogRow(r.recording_id, str(r.environment), str(r.label), r.logged_frame or 0) for r in found]
    return {row.folder: row for row in rows}


CODEC = "mp4v"
SENSOR_NOISE = 1.5  # grey levels
# Ten standard deviations of a parked car's box, less than a moving one passes in a frame.
STILL_PX = 4.0
STEP_M = 0.01


def camera_frames(
    settings: SimulationSettings,
    recording: SimulatedRecording,
    rng: np.random.Generator,
    camera: PinholeCamera | None = None,
) -> Iterator[ImageArray]:
    """Yield what the camera sees, ten frames a second.

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
    # The street is the site's own; buildings hide the vehicle until its front passes the line of sight past
    # their corner, which is the recording's T0. Light is even and the camera stands still, so that all that
    # changes is the vehicle, its shadow and the sensor's noise.
    view = View(camera or PinholeCamera.ovad())
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
    """Write frames of one size as MPEG-4, whole or not at all.

    Shapes: frames (height, width, 3).
    """
    cv2 = optional("cv2")
    waiting = iter(frames)
    first = next(waiting, None)
    if first is None:
        raise InvalidArgumentError("frames: expected at least one")
    with atomic_path(path) as temporary:
        code = cv2.VideoWriter_fourcc(*CODEC)
        writer = cv2.VideoWriter(str(temporary), code, FRAME_RATE_HZ, (first.shape[1], first.shape[0]))
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
    """Read back from its boxes where the parked car stands along the street; None where there is none."""
    boxes = np.array([frame[0].box_px for frame in detections if frame])
    still = boxes[(np.abs(boxes - boxes[:1]) < STILL_PX).all(axis=1)] if len(boxes) else boxes
    if not len(still):
        return None
    camera, faces = PinholeCamera.ovad(), parked_lane_m(site) + WIDTH_M * np.array([-0.5, 0.5])
    right, left = site.sights_m(faces, camera.position_m[:2])
    middles = np.arange(right[0], left[0], STEP_M)
    ends = np.clip(middles[:, None, None] + LENGTH_M * np.array([[-0.5], [0.5]]), right, left)
    wanted = np.median(still, axis=0)[[0, 2]]
    missed = np.abs(_columns_px(camera, faces, ends) - wanted).sum(axis=1)
    return float(middles[missed.argmin()])


def _columns_px(camera: PinholeCamera, ahead_m: FloatArray, ends_m: FloatArray) -> FloatArray:
    """First and last column of cuboids whose faces (2,) end at (n, 2, 2) (right, left), shape (n, 2)."""
    # At the camera's own height, where the pitch shortens the depth and nothing else.
    slope = (ends_m - camera.position_m[1]) / ((ahead_m - camera.position_m[0]) * np.cos(camera.pitch_rad))
    focal = 0.5 * camera.width_px / np.tan(camera.half_angle_rad)
    columns = np.clip(0.5 * camera.width_px - focal * slope, 0.0, camera.width_px - 1.0).reshape(-1, 4)
    return np.stack([columns.min(axis=1), columns.max(axis=1)], axis=1)


def _taken(image: Float32Array, rng: np.random.Generator) -> ImageArray:
    """Add the sensor's noise, alike in all colours, and round; red, green, blue become blue, green, red."""
    noise = rng.standard_normal(image.shape[:2], dtype=np.float32)
    noise *= SENSOR_NOISE
    taken = image[:, :, ::-1] + noise[:, :, None]
    np.rint(taken, out=taken)
    return np.clip(taken, 0.0, 255.0, out=taken).astype(np.uint8)
