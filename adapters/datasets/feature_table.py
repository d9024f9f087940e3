"""Tables of labelled feature windows, as published with OVAD: 60 features and the origin, one row per window.

Columns: ``feat0`` to ``feat59``, ``Class`` (front, left, none, right), ``ID``, ``Environment`` (S.. standing
ego, D.. moving ego), ``T0`` (frame number, may be empty) and ``Recording ID``. Azimuths run from -90 to 90
degrees and increase to the right, as in the published data and in `frontend.direction.feature`.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from worldstate.abduction.signature.published_signature import ModelDomain
from worldstate.abduction.signature.window_classes import CLASSES
from worldstate.adapters.files.file_io import number, read_record, read_rows, write_json, write_rows
from worldstate.ground.errors import InputFileError, InvalidArgumentError
from worldstate.ground.serialisation import encode
from worldstate.ground.typing import BoolArray, FloatArray, TextArray

N_FEATURES = 60
FEATURE_COLUMNS = tuple(f"feat{i}" for i in range(N_FEATURES))
LONGEST_NAME = 100
LABEL_COLUMNS = ("Class", "ID", "Environment", "T0", "Recording ID")

Group = Literal["static", "dynamic", "all"]
_ROWS = ("features", "labels", "ids", "environments", "recordings")
_PREFIX = {"static": "S", "dynamic": "D", "all": ""}


@dataclass(frozen=True, slots=True, eq=False)
class FeatureTable:
    """Windows with their labels, one per row.

    Parameters
    ----------
    features : ndarray, shape (n, 60)
        2 segments x 30 azimuths.
    labels, ids, environments, recordings : ndarray of str, shape (n,)
        Class, window ID, junction and recording of each window. A recording may have a hazard window and a
        front window, so data are split by recording.
    t0_frames : tuple of int or None
        Line-of-sight entry, frame number at 10 per second; None if unknown.
    domain : ModelDomain, optional
        Array, rates and ego motion of the windows; None if the file does not state them.

    Examples
    --------
    >>> words = np.array(["none", "left"])
    >>> where, which = np.array(["SA1", "DB1"]), np.array(["0", "1"])
    >>> table = FeatureTable(np.zeros((2, 60)), words, words, where, which, (None, 70))
    >>> len(table), table.group("dynamic").recording_keys
    (2, array(['DB1/1'], dtype='<U5'))
    """

    features: FloatArray
    labels: TextArray
    ids: TextArray
    environments: TextArray
    recordings: TextArray
    t0_frames: tuple[int | None, ...]
    domain: ModelDomain | None = None

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def recording_keys(self) -> TextArray:
        """Environment and recording of each window, such as ``SA1/34``, the unit of splits and overlaps."""
        return np.char.add(np.char.add(self.environments, "/"), self.recordings)

    @property
    def hazards(self) -> BoolArray:
        """Whether each window is labelled left or right."""
        return np.isin(self.labels, ("left", "right"))

    @property
    def hazard_free(self) -> BoolArray:
        """Whether each window is labelled none."""
        return np.asarray(self.labels == "none")

    def select(self, chosen: BoolArray) -> "FeatureTable":
        """Return the rows for which `chosen` is true."""
        kept = np.flatnonzero(chosen)
        rows: dict[str, Any] = {name: getattr(self, name)[kept] for name in _ROWS}
        return replace(self, t0_frames=tuple(self.t0_frames[i] for i in kept), **rows)

    def group(self, group: Group) -> "FeatureTable":
        """Return the windows of a standing ego (static), of a moving one (dynamic) or all.

        Raises
        ------
        InvalidArgumentError
            If there are none.
        """
        in_group = np.char.startswith(self.environments, _PREFIX[group])
        return self._not_empty(in_group, f"group: expected windows of group {group}")

    def joined(self, other: "FeatureTable") -> "FeatureTable":
        """Return these windows followed by those of another table; the domain is that of this table."""
        both = self, other
        rows: dict[str, Any] = {name: np.concatenate([getattr(one, name) for one in both]) for name in _ROWS}
        return replace(self, t0_frames=self.t0_frames + other.t0_frames, **rows)

    def only(self, ids: Collection[str]) -> "FeatureTable":
        """Return all windows of the recordings with a window of one of these IDs.

        Raises
        ------
        InvalidArgumentError
            If there are none.
        """
        return self._not_empty(self._of_recordings(ids), "ids: expected a listed window")

    def without(self, ids: Collection[str]) -> "FeatureTable":
        """Return all windows of the other recordings.

        Raises
        ------
        InvalidArgumentError
            If none are left.
        """
        return self._not_empty(~self._of_recordings(ids), "ids: expected an unlisted window")

    def _not_empty(self, chosen: BoolArray, expected: str) -> "FeatureTable":
        if not chosen.any():
            raise InvalidArgumentError(f"{expected}, found none")
        return self.select(chosen)

    def _of_recordings(self, ids: Collection[str]) -> BoolArray:
        keys = self.recording_keys
        return np.isin(keys, keys[np.isin(self.ids, list(ids))])


def read_features(path: str | Path) -> FeatureTable:
    """Read a table of windows, and its domain from `FILE.csv.json` if that exists.

    Raises
    ------
    InputFileError
        If the file is missing or too large, a column is missing, or a line lacks 60 finite numbers, a known
        class or an environment that begins with S or D; the message contains file and line.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> words = np.array(["none", "left"])
    >>> table = FeatureTable(np.ones((2, 60)), words, words, np.array(["SA1", "SB1"]), words, (None, 70))
    >>> with TemporaryDirectory() as folder:
    ...     write_features(Path(folder) / "windows.csv", table)
    ...     again = read_features(Path(folder) / "windows.csv")
    >>> again.labels.tolist(), again.t0_frames
    (['none', 'left'], (None, 70))
    """
    rows = read_rows(Path(path), FEATURE_COLUMNS + LABEL_COLUMNS)
    windows = [_window(path, line, row) for line, row in rows]
    if not windows:
        raise InputFileError(path, "expected at least one window below the header")
    features, labels, t0_frames = zip(*windows, strict=True)
    classes, ids, environments, recordings = (np.array(column) for column in zip(*labels, strict=True))
    domain = Path(f"{path}.json")
    made_with = read_record(ModelDomain, domain, "domain") if domain.is_file() else None
    return FeatureTable(np.array(features), classes, ids, environments, recordings, t0_frames, made_with)


def write_features(path: str | Path, table: FeatureTable) -> None:
    """Write a table of windows, atomically; `read_features` returns exactly the same values.

    The domain is written to `FILE.csv.json`, so that other tools can read the columns unchanged.

    Raises
    ------
    InputFileError
        If the folder is missing.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> words = np.array(["none", "left"])
    >>> table = FeatureTable(np.ones((2, 60)), words, words, np.array(["SA1", "SB1"]), words, (None, 70))
    >>> with TemporaryDirectory() as folder:
    ...     write_features(Path(folder) / "windows.csv", table)
    ...     again = read_features(Path(folder) / "windows.csv")
    >>> again.labels.tolist(), again.t0_frames
    (['none', 'left'], (None, 70))
    """
    names = (table.labels, table.ids, table.environments, table.t0_frames, table.recordings)
    rows = ([*feature, *labels] for feature, *labels in zip(table.features.tolist(), *names, strict=True))
    write_rows(path, FEATURE_COLUMNS + LABEL_COLUMNS, rows)
    companion = Path(f"{path}.json")
    companion.unlink(missing_ok=True)
    if table.domain is not None:
        write_json(companion, encode(table.domain))


def read_ids(path: str | Path) -> frozenset[str]:
    """Read a list of window IDs: a CSV file with a column ``ID``."""
    ids = frozenset(row["ID"] for _, row in read_rows(Path(path), ("ID",))) - {""}
    if not ids:
        raise InputFileError(path, "expected at least one ID below the header")
    return ids


def _window(
    path: str | Path, line: int, row: dict[str, str]
) -> tuple[FloatArray, tuple[str, ...], int | None]:
    labels = tuple(row[column] for column in ("Class", "ID", "Environment", "Recording ID"))
    if labels[0] not in CLASSES:
        raise InputFileError(path, f"line {line}: expected a class {CLASSES}, got {labels[0][:40]!r}")
    if labels[2][:1] not in ("S", "D"):
        raise InputFileError(path, f"line {line}: expected an environment S.. or D.., got {labels[2][:40]!r}")
    if not labels[3]:
        raise InputFileError(path, f"line {line}: expected a Recording ID")
    if max(map(len, labels)) > LONGEST_NAME:
        raise InputFileError(path, f"line {line}: expected names of at most {LONGEST_NAME} characters")
    features = np.array([number(path, line, row, column) for column in FEATURE_COLUMNS])
    return features, labels, t0_of(path, line, row)


def t0_of(path: str | Path, line: int, row: dict[str, str]) -> int | None:
    """Return the frame number T0 of a row, None without one."""
    try:
        return int(row["T0"]) if row.get("T0") else None
    except ValueError as error:
        problem = f"expected T0 as an integer, got {row['T0'][:40]!r}"
        raise InputFileError(path, f"line {line}: {problem}") from error
