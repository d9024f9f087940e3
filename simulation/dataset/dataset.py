"""Recordings on disk in the OVAD layout: D/<environment>/<class>/<ID> and D/DataLog.csv."""

import csv
import io
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from worldstate.adapters.camera.video import VIDEO_NAME
from worldstate.adapters.datasets.ovad import OvadDataset
from worldstate.adapters.datasets.ovad_layout import (
    ARRAY_NAME,
    AUDIO_NAME,
    COLUMNS,
    DETECTION_NAMES,
    LOG_NAME,
    TRUTH_NAME,
)
from worldstate.adapters.files.array_file import read_array, write_array_xml
from worldstate.adapters.files.atomic import deferred_signals, write_text
from worldstate.adapters.parallel import in_processes
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.array.ovad_array import ovad_array
from worldstate.ground.checks import in_range
from worldstate.ground.errors import InputFileError
from worldstate.ground.typing import ImageArray
from worldstate.simulation.camera.simulated_detector import to_json
from worldstate.simulation.scene.drawn_sounds import with_sounds
from worldstate.simulation.scene.junction import MOVING_SITES, SITES
from worldstate.simulation.scene.places import PLACES, place
from worldstate.simulation.scene.presets import preset
from worldstate.simulation.scene.settings import APPROACHES, draw_settings, rate_for

from .plan import DatasetSettings, Plan
from .recording import SimulatedRecording, simulate_recording
from .recording_folder import put_in_place, refuse_foreign, sound_writer, write_json
from .rendered_video import camera_frames, write_video

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
        Called with every finished recording, in order.

    Returns
    -------
    list of LogRow
        The lines of `DataLog.csv`.

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
    folder, plans = Path(root), wanted.plans()
    folder.mkdir(parents=True, exist_ok=True)
    listed, listening = _listed(folder), ovad_array() if array is None else array
    if (folder / ARRAY_NAME).exists():
        _name_array(folder / ARRAY_NAME, listening)
    for plan in plans:
        refuse_foreign(folder / _log_row(plan.environment, plan.approach, plan.number, 0).folder)
    rows = []
    with TemporaryDirectory(prefix=".simulated-", dir=folder) as unlisted:
        simulate = partial(_simulate_one, Path(unlisted), wanted, listening)
        with closing(in_processes(simulate, plans, jobs)) as simulated:
            for row in simulated:
                rows.append(row)
                listed[row.folder] = row
                _name_array(folder / ARRAY_NAME, listening)
                with deferred_signals():
                    try:
                        put_in_place(folder / row.folder, Path(unlisted) / row.folder)
                    finally:
                        write_log(folder, [one for one in listed.values() if (folder / one.folder).is_dir()])
                if progress is not None:
                    progress(row)
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
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows([row.recording_id, row.environment, row.approach, row.t0_frame] for row in rows)
    write_text(Path(root) / LOG_NAME, text.getvalue())


def _simulate_one(root: Path, wanted: DatasetSettings, array: MicrophoneArray, plan: Plan) -> LogRow:
    rng = np.random.default_rng(plan.seed)
    drawn = draw_settings(plan.environment, plan.approach, rng, wanted.duration_s, plan.kind)
    settings = replace(drawn, preset=preset(wanted.preset))
    if wanted.bandwidth_hz is not None:
        settings = replace(settings, sample_rate_hz=rate_for(wanted.bandwidth_hz))
    if wanted.sounds:
        settings = with_sounds(settings, wanted.sounds, array.n_microphones, rng.spawn(1)[0])
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
        raise InputFileError(
            path, "expected the array of these recordings; another one needs a folder of its own"
        )


def _listed(root: Path) -> dict[Path, LogRow]:
    """Return what the log of an existing data set lists and is there."""
    if not (root / LOG_NAME).exists():
        return {}
    found = [recording for recording in OvadDataset(root).recordings if recording.path.is_dir()]
    rows = [LogRow(r.recording_id, str(r.environment), str(r.label), r.logged_frame or 0) for r in found]
    return {row.folder: row for row in rows}
