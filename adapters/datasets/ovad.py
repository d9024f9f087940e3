"""Data sets in the layout of OVAD: recordings with site, label and line-of-sight entry T0, and their array.

A data set has ``<root>/DataLog.csv`` with the columns ID, Environment, Class and T0, and one folder per
recording, ``<root>/<environment>/<class>/<ID>/``, with ``out_multi.wav`` and, for a standing ego, camera
detections. The ``truth.json`` of a simulated recording contains the true positions of the vehicles.
"""

import logging
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, final, get_args

import numpy as np

from worldstate.adapters.audio.sound_file import AudioSource, open_audio
from worldstate.adapters.camera.detections import DetectionLog, read_detections
from worldstate.adapters.files.array_file import named_arrays, read_array
from worldstate.adapters.files.array_match import array_difference, microphone_order
from worldstate.adapters.files.file_io import check_row, read_json, read_rows
from worldstate.frontend.array.microphone_array import MicrophoneArray, ovad_array
from worldstate.ground.errors import InputFileError, OutOfDomainError
from worldstate.ground.typing import BoolArray, FloatArray

LOG_NAME = "DataLog.csv"
AUDIO_NAME = "out_multi.wav"
ARRAY_NAME = "array.xml"  # Not part of OVAD: the array of a data set, in its root
# The first is the name in the data set's description, the second that in its authors' code.
DETECTION_NAMES = ("camera_baseline_results.json", "camera_baseline_detections.json")
# Exists only for a simulated recording.
TRUTH_NAME = "truth.json"
COLUMNS = ("ID", "Environment", "Class", "T0")
FRAME_RATE_HZ = 10.0

Label = Literal["left", "none", "right"]
LABELS: dict[str, Label] = {label: label for label in get_args(Label)}

MAX_T0_FRAME = 1_000_000
# S or D for a standing or moving ego, then type and number of the junction.
ENVIRONMENT = re.compile(r"[SD][A-Z][0-9]{1,3}", re.ASCII)
T0 = re.compile(r"[0-9]{1,7}", re.ASCII)
IDENTIFIER = re.compile(r"\w[\w.-]{0,99}", re.ASCII)


@final
@dataclass(frozen=True, slots=True)
class Recording:
    """One recording with its labels.

    Parameters
    ----------
    path : Path
        Its folder.
    recording_id : str
        Unique in the data set.
    environment : str or None
        For example ``"SA1"``: standing ego, junction A1. None if there is no log and the folder has no such
        name.
    label : str or None
        Side from which the vehicle comes, or ``"none"``.
    logged_frame : int or None
        T0 in the log, frame number from the start; None if unknown. Recordings without a vehicle also have a
        T0, without an event.

    Examples
    --------
    >>> recording = Recording(Path("SA1/left/1_00_0002"), "1_00_0002", "SA1", "left", 70)
    >>> recording.moving_ego, recording.t0_s
    (False, 7.0)
    """

    path: Path
    recording_id: str
    environment: str | None = None
    label: Label | None = None
    logged_frame: int | None = None

    @classmethod
    def open(cls, path: str | Path) -> "Recording":
        """Open a recording by its folder, with the entry of a log three folders above if there is one.

        Raises
        ------
        InputFileError
            If the folder or its sound is missing, or the log is damaged or contradicts the folder.
        """
        # A recording may be a link to another disk, so links are resolved only if the path contains "..".
        folder = Path(path).resolve() if ".." in Path(path).parts else Path(path).absolute()
        if not (folder / AUDIO_NAME).is_file():
            raise InputFileError(path, f"expected a recording folder with {AUDIO_NAME}")
        log = next((root / LOG_NAME for root in folder.parents[2:3] if (root / LOG_NAME).is_file()), None)
        listed = () if log is None else _read_log(log.parent)
        entry = next((recording for recording in listed if recording.recording_id == folder.name), None)
        if entry is None:
            place = folder.parent.parent.name
            environment = place if ENVIRONMENT.fullmatch(place) else None
            return cls(folder, folder.name, environment, LABELS.get(folder.parent.name))
        if entry.path != folder:
            place = f"{entry.environment}/{entry.label}"
            raise InputFileError(log, f"expected {folder.name} in {place}, as listed, but found it at {path}")
        return entry

    @property
    def audio_path(self) -> Path:
        """The sound file: in OVAD, 56 channels of 24 bit at 47,998 Hz."""
        return self.path / AUDIO_NAME

    @property
    def detections_path(self) -> Path | None:
        """File of camera detections; None without one, as for every moving ego."""
        found = (self.path / name for name in DETECTION_NAMES)
        return next((path for path in found if path.is_file()), None)

    @property
    def moving_ego(self) -> bool | None:
        """Whether the ego vehicle moves; None if unknown."""
        return self.environment.startswith("D") if self.environment else None

    @property
    def t0_frame(self) -> int | None:
        """Frame in which the vehicle enters line of sight; None without a vehicle, or if unknown."""
        return None if self.label == "none" else self.logged_frame

    @property
    def t0_s(self) -> float | None:
        """Line-of-sight entry, seconds from the start of the recording."""
        return None if self.t0_frame is None else self.t0_frame / FRAME_RATE_HZ

    def open_audio(self, expect_channels: int | None = None) -> AudioSource:
        """Open the sound, with the errors of `adapters.audio.sound_file.open_audio`."""
        return open_audio(self.audio_path, expect_channels)

    def read_detections(self) -> DetectionLog | None:
        """Read the camera detections, None without any, with the errors of `read_detections`."""
        path = self.detections_path
        return None if path is None else read_detections(path, FRAME_RATE_HZ)


class OvadDataset:
    r"""All recordings listed in ``DataLog.csv``, in its order.

    Parameters
    ----------
    root : str or Path
        Folder with ``DataLog.csv``.

    Attributes
    ----------
    root : Path
        The given folder.
    recordings : tuple of Recording
        The listed recordings; their files are checked only when they are opened.

    Raises
    ------
    InputFileError
        If the log is missing or damaged: a missing column, a repeated ID, an invalid environment or class, or
        a T0 that is not an integer.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     log = "ID,Environment,Class,T0\n1_00_0002,SA1,left,70\n"
    ...     _ = (Path(folder) / "DataLog.csv").write_text(log)
    ...     [(r.recording_id, r.environment, r.label, r.t0_s) for r in OvadDataset(folder).recordings]
    [('1_00_0002', 'SA1', 'left', 7.0)]
    """

    def __init__(self, root: str | Path) -> None:
        self.root = Path(root)
        self.recordings = _read_log(self.root)

    def __len__(self) -> int:
        return len(self.recordings)


def _read_log(root: Path) -> tuple[Recording, ...]:
    name = root / LOG_NAME
    recordings = tuple(_recording(name, line, row) for line, row in read_rows(name, COLUMNS))
    counts = Counter(recording.recording_id for recording in recordings)
    twice = next((identifier for identifier, count in counts.items() if count > 1), None)
    if twice is not None:
        raise InputFileError(name, f"expected every ID once, got {twice} twice")
    return recordings


def _recording(log: Path, line: int, row: dict[str, str]) -> Recording:
    identifier, environment, side, t0 = (row[column] for column in COLUMNS)
    label = LABELS.get(side)
    number_fits = T0.fullmatch(t0) and int(t0) <= MAX_T0_FRAME
    check_row(
        log,
        line,
        ("an ID such as 1_00_0002", identifier, IDENTIFIER.fullmatch(identifier)),
        ("an Environment such as SA1 or DB3", environment, ENVIRONMENT.fullmatch(environment)),
        ("Class left, none or right", side, label),
        ("T0 as a frame number, an integer", t0, number_fits or (label == "none" and not t0)),
    )
    folder = log.parent / environment / side / identifier
    return Recording(folder, identifier, environment, label, int(t0) if t0 else None)


_LOG = logging.getLogger(__name__)


def choose_array(
    path: Path,
    given: MicrophoneArray | None = None,
    *,
    assumed: MicrophoneArray | None = None,
    trust_given: bool = False,
) -> MicrophoneArray:
    """Return the array of a recording, a data set or a sound file, in the order of the channels.

    `array.xml` beside the sound or in the root of its data set takes precedence. A given array must then have
    the same positions; if their order differs, that of the data set is used. Without `array.xml`, the given
    array is used, then OVAD's for a folder, or the assumed one for a sound file.

    Parameters
    ----------
    path : Path
        Data set, recording folder or sound file.
    given : MicrophoneArray, optional
        Array given by the user.
    assumed : MicrophoneArray, optional
        Array of a sound file without further information, if the number of channels matches; by default
        OVAD's.
    trust_given : bool
        Use the given array regardless of the data set.

    Raises
    ------
    OutOfDomainError
        If the given array is not that of the data set.
    InputFileError
        If the data set's array is damaged, or a sound file has another number of channels than the assumed
        array.
    """
    named = named_array(path)
    if given is not None and (named is None or trust_given):
        return given
    if named is None:
        return ovad_array() if path.is_dir() else _assumed(path, assumed or ovad_array())
    own = read_array(named)
    if given is not None:
        order = microphone_order(own.positions_m, given)
        if order is None:
            difference = array_difference(own.positions_m, given)
            raise OutOfDomainError(f"{given.name}: not the array of {named}: {difference}. Leave --array out")
        if (np.diff(order) != 1).any():
            _LOG.warning("%s: in another order than %s, whose order counts", given.name, named)
    return own


def named_array(path: Path) -> Path | None:
    """Return the array file of a data set, recording or sound file, None without one."""
    folder = path if path.is_dir() else path.parent
    roots = [folder]
    if path.is_dir() or path.name == AUDIO_NAME:
        roots += [root for root in folder.absolute().parents[2:3] if (root / LOG_NAME).is_file()]
    return next((root / ARRAY_NAME for root in roots if (root / ARRAY_NAME).is_file()), None)


def _assumed(path: Path, array: MicrophoneArray) -> MicrophoneArray:
    """Return the array assumed for a sound file, if the number of channels matches."""
    with open_audio(path, strict=False) as audio:
        channels = audio.channels
    if channels != array.n_microphones:
        boards = ", ".join(named_arrays())
        wanted = f"expected --array (array=) for its {channels} channels: a file, or one of {boards}"
        other = f"the default, {array.name}, has {array.n_microphones}; {ARRAY_NAME} beside it works, too"
        ways = "`worldstate model make` makes a model for it, `worldstate array bearings` needs none"
        raise InputFileError(path, f"{wanted}; {other}. With the array {ways}")
    _LOG.warning("%s: no array is named; taken as %s, %d microphones", path, array.name, array.n_microphones)
    return array


@dataclass(frozen=True, slots=True, eq=False)
class TrueTrack:
    """True azimuth, position and line of sight of one vehicle over time."""

    time_s: FloatArray  # shape (n,): Camera frames, seconds from the start of the recording
    azimuth_rad: FloatArray  # shape (n,): Left positive
    in_view: BoolArray  # shape (n,): Line of sight between camera and vehicle
    position_m: FloatArray  # shape (n, 2): Middle of its front, x ahead and y left of the array

    @property
    def visible_s(self) -> tuple[float, float] | None:
        """First and last time in line of sight; None without one."""
        seen = self.time_s[self.in_view]
        return (float(seen[0]), float(seen[-1])) if seen.size else None


def read_true_tracks(folder: Path) -> tuple[TrueTrack, ...]:
    """Read the tracks of all vehicles; empty for a real recording."""
    path = folder / TRUTH_NAME
    if not path.is_file():
        return ()
    try:
        truth: Any = read_json(path, "the truth of a simulated recording")
        return tuple(_track(rows) for rows in (truth["frames"], *truth.get("others", ())) if rows)
    except (ValueError, KeyError, TypeError) as error:
        raise InputFileError(path, f"expected the truth of a simulated recording: {error!r}") from error


def _track(rows: list[dict[str, Any]]) -> TrueTrack:
    columns = [[row[key] for row in rows] for key in ("time_s", "azimuth_rad", "line_of_sight")]
    time_s, azimuth_rad, in_view = np.array(columns, dtype=np.float64)
    return TrueTrack(time_s, azimuth_rad, in_view > 0.5, np.array([row["position_m"] for row in rows]))
