"""Input and output of every method: trials and decisions.

`TakeList` has the recordings of an evaluation, for test and for training.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from worldstate.adapters.camera.video import VIDEO_NAME
from worldstate.adapters.datasets.feature_table import read_ids
from worldstate.adapters.datasets.ovad import (
    AUDIO_NAME,
    DETECTION_NAMES,
    LOG_NAME,
    TRUTH_NAME,
    OvadDataset,
    Recording,
)
from worldstate.ground.errors import InputFileError
from worldstate.ground.typing import BoolArray, FloatArray, IntArray
from worldstate.operations.recordings.hop_table import HopTable

LEFT, RIGHT, NO_SIDE = 1, -1, 0
# Columns of the tables of a trial and of decisions.
BOX_COLUMNS = ("frame", "time_s", "box_px", "score", "class_name", "azimuth_rad", "moving")
TRUTH_COLUMNS = ("time_s", "vehicle", "azimuth_rad", "in_view")
TRACK_COLUMNS = ("time_s", "track", "azimuth_rad")
# One value per hop each, in the order of `Decisions`.
DECISION_COLUMNS = ("time_s", "alarm", "side", "bearing_rad", "score", "risk", "visible_s")


@dataclass(frozen=True, slots=True, eq=False)
class Decisions:
    """Decisions of one method on one recording, hop by hop.

    Parameters
    ----------
    time_s : ndarray, shape (n,)
        End of each decision window, seconds from the start of the recording.
    alarm : ndarray of bool, shape (n,)
        Whether an advisory is on.
    side : ndarray of int, shape (n,)
        1 left, -1 right, 0 if the method gives none.
    bearing_rad : ndarray, shape (n,)
        Left positive; NaN if the method gives none.
    score, risk : ndarray, shape (n,)
        The thresholded statistic, and the calibrated probability; NaN if the method has none.
    visible_s : ndarray, shape (n, 3)
        Predicted time to visible: lower bound, best value and upper bound; NaN if there is none.
    tracks : HopTable
        One row per hop and track: `time_s`, `track` (a number, its identity), `azimuth_rad`.
    threshold : ndarray, shape (1,) or (0,)
        Threshold of the score, if the method has one.

    Examples
    --------
    >>> said = Decisions.of(np.array([1.0, 1.1]), alarm=np.array([False, True]))
    >>> said.side.tolist(), said.visible_s.shape, len(said.tracks)
    ([0, 0], (2, 3), 0)
    """

    time_s: FloatArray
    alarm: BoolArray
    side: IntArray
    bearing_rad: FloatArray
    score: FloatArray
    risk: FloatArray
    visible_s: FloatArray
    tracks: HopTable
    threshold: FloatArray = field(default_factory=lambda: np.empty(0))

    @classmethod
    def of(cls, time_s: FloatArray, alarm: BoolArray, **stated: Any) -> "Decisions":
        """Return the decisions of a method that gives only some of the columns."""
        n = len(time_s)
        unknown = dict.fromkeys(("bearing_rad", "score", "risk"), np.full(n, np.nan))
        columns = {"side": np.zeros(n, np.int64), "visible_s": np.full((n, 3), np.nan), **unknown}
        given = {"time_s": time_s, "alarm": np.asarray(alarm, bool), **columns, **stated}
        return cls(**{"tracks": HopTable.of_rows(TRACK_COLUMNS, ()), **given})


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """One recording in the form that every method receives.

    Parameters
    ----------
    hops : HopTable
        Values of the front-end, one row per decision of 0.1 s: `time_s`, `features` (n, 60), `srp_rad`,
        `prominence`, `log_slope_hz` of looming, the camera's `answer`, `miss_rate` and `clutter_rate`, and
        the reference `reference_rad` of a moving box in view. Name, label and T0 are the recording's.
        `about` contains its `site`, whether the ego moves, and `refused`: by chain or score, why its model
        does not fit this sound.
    boxes : HopTable
        Detections of the camera, one row per box: `frame`, `time_s`, `box_px` (n, 4) as x1, y1, x2, y2,
        `score`, `class_name`, `azimuth_rad` of its centre, `moving`; no rows if there is no camera.
    truth : HopTable
        True positions of the vehicles, one row per camera frame and vehicle: `time_s`, `vehicle`,
        `azimuth_rad`, `in_view`. In a real recording these are the moving boxes, all in view.
    chains : mapping of str to Decisions
        Decisions of the whole library, by variant; see `listening.CHAINS`.

    Examples
    --------
    >>> hops = HopTable({"time_s": np.array([1.0, 1.1])}, "a", "left", 1.1, {"site": "SA1", "moving": False})
    >>> trial = Trial(hops)
    >>> trial.name, trial.site, trial.hazard_free, trial.t0_s
    ('a', 'SA1', False, 1.1)
    """

    hops: HopTable
    boxes: HopTable = field(default_factory=lambda: HopTable.of_rows(BOX_COLUMNS, ()))
    truth: HopTable = field(default_factory=lambda: HopTable.of_rows(TRUTH_COLUMNS, ()))
    chains: Mapping[str, Decisions] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name of the recording."""
        return self.hops.name

    @property
    def label(self) -> str:
        """Side from which the vehicle comes, or "none"."""
        return self.hops.label

    @property
    def hazard_free(self) -> bool:
        """Whether the recording contains no approach."""
        return self.hops.hazard_free

    @property
    def t0_s(self) -> float:
        """Line-of-sight entry, seconds; NaN if there is none."""
        return self.hops.t0_s

    @property
    def refused(self) -> Mapping[str, str]:
        """For each missing chain or score, the reason why its model does not fit this sound."""
        return dict(self.hops.about.get("refused", {}))

    @property
    def site(self) -> str:
        """Junction with the ego's motion, such as "SA1"."""
        return str(self.hops.about["site"])


# A method after its fit to the calibration recordings: maps a trial to decisions.
Decide = Callable[[Trial], Decisions]


class Method(Protocol):
    """One row of Table I: fitted to the calibration recordings, then applied to the others.

    Examples
    --------
    >>> class Never:
    ...     name = "never"
    ...     def fit(self, calibration, rng):
    ...         return lambda trial: Decisions.of(trial.hops.time_s, np.zeros(len(trial.hops), bool))
    >>> method: Method = Never()
    >>> decide = method.fit([], np.random.default_rng(0))
    >>> decide(Trial(HopTable({"time_s": np.array([1.0])}))).alarm
    array([False])
    """

    @property
    def name(self) -> str:
        """Name in the report."""
        ...

    def fit(self, calibration: Sequence[Trial], rng: np.random.Generator, /) -> Decide:
        """Set thresholds and maps on the calibration recordings, which are never test recordings."""
        ...


# The official lists of test recordings, beside the log or in the folder of their release.
STATIC_LIST, DYNAMIC_LIST = "timeHorizonStaticTestset.csv", "timeHorizonDynamicTestset.csv"
LIST_FOLDERS = ("", "config")
# Maximum number of missing files that an error message lists.
NAMED = 12


@dataclass(frozen=True, slots=True)
class Take:
    """One recording to be processed.

    Examples
    --------
    >>> Take(Path("SA1/none/1_00_0002"), "1_00_0002", "SA1").hazard_free
    True
    """

    path: Path  # Recording folder in OVAD's layout
    name: str  # Unique in an evaluation
    site: str  # Such as "SA1"
    label: str = "none"  # Side from which a vehicle comes
    t0_s: float | None = None  # Line-of-sight entry, seconds
    moving: bool = False  # Whether the ego moves

    @classmethod
    def of(cls, one: Recording) -> "Take":
        """Return the take of a recording in a data set."""
        label, site = one.label or "none", one.environment or "?"
        return cls(one.path, one.recording_id, site, label, one.t0_s, bool(one.moving_ego))

    @property
    def hazard_free(self) -> bool:
        """Whether the recording contains no approach."""
        return self.label == "none"

    @property
    def filmed(self) -> bool:
        """Whether there is a video beside the sound."""
        return (self.path / VIDEO_NAME).is_file()


@dataclass(frozen=True, slots=True)
class TakeList:
    """The recordings of an evaluation."""

    root: Path
    static: tuple[Take, ...]  # Test recordings of a standing ego
    dynamic: tuple[Take, ...]  # Test recordings of a moving ego
    training: tuple[Take, ...]  # Other recordings of the data set, which are not tested
    official: bool  # Whether the test recordings are those of the official lists

    @property
    def simulated(self) -> bool:
        """Whether the recordings are simulated."""
        return any((take.path / TRUTH_NAME).is_file() for take in (*self.static, *self.dynamic))

    @property
    def origin(self) -> str:
        """Description of the data, for the first line of the report."""
        kind = "SIMULATED streets" if self.simulated else "Recordings given"
        split = ", official test recordings" if self.official else ""
        return f"{kind}, folder {self.root.name}{split}"


def find_takes(root: Path, *, static_ids: Path | None = None, dynamic_ids: Path | None = None) -> TakeList:
    """Find the recordings of a data set in OVAD's layout; raise an error if any data are missing.

    Test recordings are those in the given lists, otherwise those in the official lists if the folder contains
    them, otherwise all.
    """
    if not (root / LOG_NAME).is_file():
        raise InputFileError(root, f"expected a data set in OVAD's layout, with {LOG_NAME}; {_found(root)}")
    recordings = OvadDataset(root).recordings
    lists = {False: static_ids or _list(root, STATIC_LIST), True: dynamic_ids or _list(root, DYNAMIC_LIST)}
    wanted = {moving: None if path is None else read_ids(path) for moving, path in lists.items()}
    official = any(ids is not None for ids in wanted.values())
    tested: dict[bool, list[Recording]] = {False: [], True: []}
    others: list[Recording] = []
    for recording in recordings:
        ids = wanted[bool(recording.moving_ego)]
        # With one list only, the recordings of the other kind are test recordings too.
        inside = ids is None or recording.recording_id in ids
        (tested[bool(recording.moving_ego)] if inside else others).append(recording)
    listed = {recording.recording_id for recording in recordings}
    unknown = sorted(set().union(*(ids or () for ids in wanted.values())) - listed)
    problems = [f"{name}: in the list of test recordings, not in {LOG_NAME}" for name in unknown]
    problems += _missing(tested[False] + tested[True])
    if problems:
        more = f"\n  and {len(problems) - NAMED} more" if len(problems) > NAMED else ""
        shown = "".join(f"\n  {problem}" for problem in problems[:NAMED])
        raise InputFileError(root, f"{len(problems)} required items are missing:{shown}{more}")
    takes = {moving: tuple(map(Take.of, found)) for moving, found in tested.items()}
    return TakeList(root, takes[False], takes[True], tuple(map(Take.of, others)), official)


def _list(root: Path, name: str) -> Path | None:
    return next((root / folder / name for folder in LIST_FOLDERS if (root / folder / name).is_file()), None)


def _found(root: Path) -> str:
    if not root.is_dir():
        return "there is no such folder"
    names = sorted(path.name for path in root.iterdir())[:NAMED]
    return f"found {', '.join(names) or 'nothing'} in it"


def _missing(recordings: Iterable[Recording]) -> list[str]:
    """Return the missing data that an evaluation of these recordings needs."""
    problems = []
    for recording in recordings:
        where = f"{recording.environment}/{recording.label}/{recording.recording_id}"
        if not recording.path.is_dir():
            problems.append(f"{where}: no such folder")
            continue
        if not recording.audio_path.is_file():
            problems.append(f"{where}/{AUDIO_NAME}")
        # Detections of a moving ego cannot be used: with a moving camera every box moves.
        if not recording.moving_ego and recording.detections_path is None:
            problems.append(f"{where}/{DETECTION_NAMES[0]}")
        if recording.label != "none" and recording.t0_s is None:
            problems.append(f"{where}: no T0 in {LOG_NAME}")
    return problems
