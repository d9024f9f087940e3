"""The recordings of an evaluation: which are tested, which are learned from, and what is missing."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

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
from worldstate.simulation.stream.truth import stream_hazards

# The official lists of test recordings, beside the log or in the folder that they are released in.
STATIC_LIST, DYNAMIC_LIST = "timeHorizonStaticTestset.csv", "timeHorizonDynamicTestset.csv"
LIST_FOLDERS = ("", "config")
# So many missing files are named; of the others the number is said.
NAMED = 12


@dataclass(frozen=True, slots=True)
class Take:
    """One recording to be heard.

    Examples
    --------
    >>> Take(Path("quiet.wav"), "quiet", "stream").hazard_free
    True
    """

    path: Path  # Recording folder in OVAD's layout, or a sound file
    name: str  # Unique in an evaluation
    site: str  # Such as "SA1"; for a stream the name of its file
    label: str = "none"  # Side that a vehicle comes from
    t0_s: float | None = None  # Line-of-sight entry, seconds
    moving: bool = False  # Whether the ego moves

    @classmethod
    def of(cls, recording: Recording) -> "Take":
        """Return a recording of a data set."""
        label, site = recording.label or "none", recording.environment or "?"
        return cls(
            recording.path, recording.recording_id, site, label, recording.t0_s, bool(recording.moving_ego)
        )

    @property
    def hazard_free(self) -> bool:
        """Whether nothing approaches."""
        return self.label == "none"

    @property
    def filmed(self) -> bool:
        """Whether a video lies beside the sound."""
        return (self.path / VIDEO_NAME).is_file()


@dataclass(frozen=True, slots=True)
class TakeList:
    """What an evaluation runs on."""

    root: Path
    static: tuple[Take, ...]  # Test recordings of a standing ego, streams included
    dynamic: tuple[Take, ...]  # Of a moving one
    training: tuple[Take, ...]  # Other recordings of the data set: nothing is tested on them
    official: bool  # Whether the test recordings are those of the official lists

    @property
    def simulated(self) -> bool:
        """Whether the recordings are simulated ones."""
        return any((take.path / TRUTH_NAME).is_file() for take in (*self.static, *self.dynamic))

    @property
    def origin(self) -> str:
        """What was evaluated, for the first line of the report."""
        kind = "SIMULATED streets" if self.simulated else "Recordings given"
        split = ", official test recordings" if self.official else ""
        return f"{kind}, folder {self.root.name}{split}"


def find_takes(
    root: Path,
    *,
    static_ids: Path | None = None,
    dynamic_ids: Path | None = None,
    hazard_free: Sequence[Path] = (),
) -> TakeList:
    """Find the recordings of a data set in OVAD's layout, and refuse one of which anything is missing.

    The tested ones are those of the lists given, else of the official lists where they lie in the folder,
    else all. `hazard_free` adds recordings, data sets or sound files of any length without a vehicle.
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
        # With one list only, the recordings of the other kind are tested as well.
        inside = ids is None or recording.recording_id in ids
        (tested[bool(recording.moving_ego)] if inside else others).append(recording)
    listed = {recording.recording_id for recording in recordings}
    unknown = sorted(set().union(*(ids or () for ids in wanted.values())) - listed)
    problems = [f"{name}: in the list of test recordings, not in {LOG_NAME}" for name in unknown]
    problems += _missing(tested[False] + tested[True])
    if problems:
        more = f"\n  and {len(problems) - NAMED} more" if len(problems) > NAMED else ""
        shown = "".join(f"\n  {problem}" for problem in problems[:NAMED])
        raise InputFileError(root, f"{len(problems)} things are missing:{shown}{more}")
    streams = [take for path in hazard_free for take in _hazard_free(path)]
    takes = {moving: tuple(map(Take.of, found)) for moving, found in tested.items()}
    return TakeList(root, (*takes[False], *streams), takes[True], tuple(map(Take.of, others)), official)


def _list(root: Path, name: str) -> Path | None:
    return next((root / folder / name for folder in LIST_FOLDERS if (root / folder / name).is_file()), None)


def _found(root: Path) -> str:
    if not root.is_dir():
        return "there is no such folder"
    names = sorted(path.name for path in root.iterdir())[:NAMED]
    return f"found {', '.join(names) or 'nothing'} in it"


def _missing(recordings: Iterable[Recording]) -> list[str]:
    """Name what an evaluation of these recordings needs and does not find."""
    problems = []
    for recording in recordings:
        where = f"{recording.environment}/{recording.label}/{recording.recording_id}"
        if not recording.path.is_dir():
            problems.append(f"{where}: no such folder")
            continue
        if not recording.audio_path.is_file():
            problems.append(f"{where}/{AUDIO_NAME}")
        # A moving ego's detections are of no use: from a moving camera every box moves.
        if not recording.moving_ego and recording.detections_path is None:
            problems.append(f"{where}/{DETECTION_NAMES[0]}")
        if recording.label != "none" and recording.t0_s is None:
            problems.append(f"{where}: no T0 in {LOG_NAME}")
    return problems


def _hazard_free(path: Path) -> list[Take]:
    if path.is_dir() and (path / LOG_NAME).is_file():
        return [Take.of(one) for one in OvadDataset(path).recordings if one.label == "none"]
    if path.is_dir():
        one = Recording.open(path)
        if one.label is None:
            return [_hazard_free_stream(path)]
        if one.label != "none":
            raise InputFileError(path, f"expected a hazard-free recording, got one labelled {one.label}")
        return [Take.of(one)]
    if not path.is_file():
        raise InputFileError(path, "expected a sound file, a recording or a data set without a vehicle")
    return [Take(path, path.stem, path.stem)]


def _hazard_free_stream(path: Path) -> Take:
    """Take a stream without a label; the truth of a simulated one is looked up."""
    hazards = stream_hazards(path)
    if hazards:
        raise InputFileError(
            path, f"expected a hazard-free stream, got {hazards} vehicles that come out of a hidden arm"
        )
    return Take(path, path.name, path.name)
