"""Labelled one-second windows of recordings, from a list or a data set, and their features."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from worldstate.abduction.signature.window_classes import CLASSES
from worldstate.adapters.audio.sound_file import AudioSource, open_audio
from worldstate.adapters.files.acoustic_domain import domain_of
from worldstate.adapters.files.file_io import check_row, number, read_rows
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.direction.feature import feature_rate_hz, published_feature
from worldstate.frontend.spectra.resampling import Resampler
from worldstate.ground.errors import InputFileError
from worldstate.ground.typing import Float32Array, FloatArray

from .feature_table import FeatureTable, t0_of
from .ovad import AUDIO_NAME, FRAME_RATE_HZ, OvadDataset, Recording

WINDOW_S = 1.0
REQUIRED = ("ID", "Class", "Environment", "Recording ID")
OPTIONAL = ("File", "End", "T0")
MOVING_LATER_S, FRONT_LATER_S = 0.5, 1.5
FRONT = "front"


@dataclass(frozen=True, slots=True)
class LabelledWindow:
    """One line of a list of labels."""

    window_id: str  # As in the feature table
    label: str
    environment: str
    recording: str
    t0_frame: int | None  # Line-of-sight entry, frame number at 10 per second
    path: Path  # Sound file
    end_s: float | None  # End of the window in its file, seconds; None for the end of the file


def read_labels(path: str | Path, dataset: str | Path) -> list[LabelledWindow]:
    """Read the windows of recordings and their labels."""
    # Columns ID, Class, Environment and Recording ID as in the feature table. Optional are File, relative to
    # the data set; End, seconds from the start of the file; and T0. Without File, the paths
    # `<Environment>/<Class>/<ID>/out_multi.wav` and `<ID>.wav` are tried.
    name, root = Path(path), Path(dataset)
    windows = [_labelled(name, root, line, row) for line, row in read_rows(name, REQUIRED, OPTIONAL)]
    if not windows:
        raise InputFileError(name, "expected at least one window below the header")
    return windows


def extract_features(windows: list[LabelledWindow], array: MicrophoneArray) -> Iterator[FloatArray]:
    """Yield the published feature of each window, shape (60,).

    Parameters
    ----------
    windows : list of LabelledWindow
        From `read_labels`.
    array : MicrophoneArray
        Array with microphones in the order of the channels.

    Raises
    ------
    InputFileError
        If a recording is damaged, has another number of channels than the array, or is too short.

    Examples
    --------
    >>> import soundfile
    >>> from tempfile import TemporaryDirectory
    >>> array = MicrophoneArray([[0.0, 0.1, 0.0], [0.0, -0.1, 0.0], [0.1, 0.0, 0.0], [-0.1, 0.0, 0.0]])
    >>> with TemporaryDirectory() as folder:
    ...     name = Path(folder) / "noise.wav"
    ...     soundfile.write(name, np.random.default_rng(0).uniform(-0.1, 0.1, (48_000, 4)), 48_000)
    ...     window = LabelledWindow("0", "none", "SX1", "0", None, name, end_s=1.0)
    ...     [feature.shape for feature in extract_features([window], array)]
    [(60,)]
    """
    for samples, rate_hz in read_windows(windows, array.n_microphones):
        heard_hz = feature_rate_hz(rate_hz)
        if heard_hz != rate_hz:
            resampler = Resampler(array.n_microphones, rate_hz, heard_hz)
            samples = np.concatenate([resampler.push(samples), resampler.flush()])
            heard_hz = resampler.rate_hz
        yield published_feature(samples, array, heard_hz)


def read_windows(
    windows: list[LabelledWindow], channels: int | None = None
) -> Iterator[tuple[Float32Array, int]]:
    """Yield the samples of each window, shape (n, M), and their rate in Hz."""
    for window in windows:
        with open_audio(window.path, channels) as source:
            yield _last_second(source, window), source.sample_rate_hz


def feature_table(
    windows: list[LabelledWindow], features: list[FloatArray], array: MicrophoneArray
) -> FeatureTable:
    """Return windows and their features as a table with the domain of the array.

    Shapes: features (60,).
    """
    columns = zip(*((w.label, w.window_id, w.environment, w.recording) for w in windows), strict=True)
    labels, ids, environments, recordings = (np.array(column) for column in columns)
    t0_frames = tuple(w.t0_frame for w in windows)
    rates = {_rate_hz(path) for path in {w.path for w in windows}}
    domain = domain_of(array, sorted(rates), environments.tolist())
    return FeatureTable(np.array(features), labels, ids, environments, recordings, t0_frames, domain)


def _rate_hz(path: Path) -> int:
    with open_audio(path, strict=False) as source:
        return source.sample_rate_hz


def _last_second(source: AudioSource, window: LabelledWindow) -> Float32Array:
    """Return the last second before the end of the window, shape (n, M)."""
    rate, length = source.sample_rate_hz, round(WINDOW_S * source.sample_rate_hz)
    end = source.frames if window.end_s is None else round(window.end_s * rate)
    if end > source.frames or end < length:
        at = "" if window.end_s is None else f" before {window.end_s:g} s"
        raise InputFileError(source.path, f"expected 1 s of sound{at}, got {source.duration_s:.3g} s")
    return source.span(end - length, length)


def _labelled(name: Path, root: Path, line: int, row: dict[str, str]) -> LabelledWindow:
    filled = [(f"a value of {key}", row[key], row[key]) for key in ("ID", "Environment", "Recording ID")]
    check_row(name, line, (f"a class {CLASSES}", row["Class"], row["Class"] in CLASSES), *filled)
    end_s = number(name, line, row, "End") if row.get("End") else None
    check_row(name, line, ("End > 0 s", end_s, end_s is None or end_s > 0.0))
    origin = row["ID"], row["Class"], row["Environment"], row["Recording ID"]
    return LabelledWindow(*origin, t0_of(name, line, row), _sound_file(name, root, line, row), end_s)


def _sound_file(name: Path, root: Path, line: int, row: dict[str, str]) -> Path:
    folder = f"{row['Environment']}/{row['Class']}/{row['ID']}/{AUDIO_NAME}"
    candidates = [row["File"]] if row.get("File") else [folder, f"{row['ID']}.wav"]
    for candidate in candidates:
        relative = PurePosixPath(candidate)
        outside = relative.is_absolute() or ".." in relative.parts
        check_row(name, line, ("a file inside the data set", candidate, not outside))
        if (root / relative).is_file():
            return root / relative
    raise InputFileError(name, f"line {line}: expected a file {' or '.join(candidates)} in the data set")


def window_ends_s(label: str, t0_s: float, moving_ego: bool) -> dict[str, float]:
    """Return the end of each window of a recording by label.

    Examples
    --------
    >>> window_ends_s("left", 7.0, moving_ego=False), window_ends_s("none", 7.0, moving_ego=True)
    ({'left': 7.0, 'front': 8.5}, {'none': 7.5})
    """
    # The window of the recording's own label ends at T0 for a standing ego and 0.5 s later for a moving one.
    # An approach also has a front window, which ends 1.5 s after that.
    end_s = t0_s + (MOVING_LATER_S if moving_ego else 0.0)
    return {label: end_s} if label == "none" else {label: end_s, FRONT: end_s + FRONT_LATER_S}


def sample_windows(root: str | Path) -> tuple[list[LabelledWindow], int]:
    """List the windows of every recording in ``DataLog.csv``; count those outside their recordings."""
    # Front windows are numbered separately with class number 0, as in the published list.
    windows: list[LabelledWindow] = []
    fronts = left_out = 0
    for order, recording in enumerate(OvadDataset(root).recordings):
        found = _windows(recording, str(order), fronts)
        fronts += sum(window.label == FRONT for window in found)
        with recording.open_audio() as source:
            inside = [w for w in found if w.end_s and WINDOW_S <= w.end_s <= source.duration_s]
        windows += inside
        left_out += len(found) - len(inside)
    return windows, left_out


def _windows(recording: Recording, number: str, fronts: int) -> list[LabelledWindow]:
    label, place, frame = recording.label, recording.environment, recording.logged_frame
    if label is None or place is None or frame is None:
        return []
    ids = {FRONT: f"0{recording.recording_id[1:5]}{fronts:04d}"}
    ends_s = window_ends_s(label, frame / FRAME_RATE_HZ, bool(recording.moving_ego))
    return [
        LabelledWindow(
            *(ids.get(what, recording.recording_id), what, place, number, frame), recording.audio_path, end_s
        )
        for what, end_s in ends_s.items()
    ]
