"""What passes over recordings gave, kept by the content of what they were made of.

The same work over recordings is done on processes of this machine; what comes out does not depend on how
many.
"""

import hashlib
import json
import warnings
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

from worldstate.adapters.camera.video import VIDEO_NAME
from worldstate.adapters.datasets.ovad import AUDIO_NAME, DETECTION_NAMES, TRUTH_NAME
from worldstate.adapters.files.file_io import write_text
from worldstate.frontend.array.steering import one_blas_thread
from worldstate.ground.errors import InputFileError, WorldstateError
from worldstate.operations.recordings.hop_table import HopTable, load_named, save_named
from worldstate.simulation.parallel import in_processes


def origin_of(made_of: object) -> str:
    """Return 32 characters that change whenever anything of JSON-able values does.

    Examples
    --------
    >>> origin_of({"seed": 1}) == origin_of({"seed": 1}), origin_of({"seed": 1}) == origin_of({"seed": 2})
    (True, False)
    """
    # 128 bits: two of a million files get the same name with a probability of 1e-27.
    return hashlib.sha256(json.dumps(made_of, sort_keys=True).encode()).hexdigest()[:32]


# What a pass reads of a recording. Other files in its folder, such as notes of its owner, change nothing.
RECORDING_NAMES = (AUDIO_NAME, *DETECTION_NAMES, VIDEO_NAME, TRUTH_NAME)


def fingerprint(place: Path, memo: Path) -> str:
    """Name the content of a recording, a folder in OVAD's layout or one file, in 32 characters.

    Hashes of files by path, size and time of change are kept in the folder `memo`.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     memo, recording = Path(folder) / "memo", Path(folder) / "1_00_0002"
    ...     recording.mkdir()
    ...     _ = (recording / "out_multi.wav").write_bytes(b"sound")
    ...     before = fingerprint(recording, memo)
    ...     _ = (recording / "out_multi.wav").write_bytes(b"other")
    ...     len(before), fingerprint(recording, memo) == before
    (32, False)
    """
    named = [place / name for name in RECORDING_NAMES] if place.is_dir() else [place]
    files = [path for path in named if path.is_file()]
    if not files:
        raise InputFileError(place, f"expected a sound file or a recording folder with {AUDIO_NAME}")
    return origin_of(_hashes(memo, place, files))


def _hashes(memo: Path, owner: Path, files: list[Path]) -> dict[str, str]:
    """Return the hash of each file by name; those that did not change are not read again."""
    # One file for all recordings would lose entries where two processes write it at once.
    path = memo / f"{origin_of(str(owner.absolute()))}.json"
    known = _known(path)
    stamps = {file: _stamp(file) for file in files}
    found = {stamp: known.get(stamp) or content_hash(file) for file, stamp in stamps.items()}
    if found != known:
        memo.mkdir(parents=True, exist_ok=True)
        write_text(path, json.dumps(found))
    return {file.name: found[stamp] for file, stamp in stamps.items()}


def _known(path: Path) -> dict[str, str]:
    # A damaged memory costs one more reading of the files, nothing else.
    try:
        read = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return {}
    return read if isinstance(read, dict) else {}


def _stamp(path: Path) -> str:
    # Taken before the file is read: one that changes meanwhile has another stamp, and is read again.
    state = path.stat()
    return f"{path.name} {state.st_size} {state.st_mtime_ns}"


def content_hash(path: Path) -> str:
    """Name the content of a file in 32 characters."""
    # In blocks of 256 KiB: 11 GB of sound never sit in memory.
    with path.open("rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()


@dataclass(frozen=True, slots=True)
class PassCache:
    """Tables by name of each pass over a recording, in files below `folder`; may be sent to other processes.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     cache = PassCache(Path(folder))
    ...     for _ in range(2):
    ...         made = cache.tables("sound", ["a", 1], lambda: print("made") or {"hops": HopTable({})})
    made
    """

    folder: Path

    def tables(
        self, pass_name: str, key: object, make: Callable[[], Mapping[str, HopTable]]
    ) -> Mapping[str, HopTable]:
        """Return what `make` gave for this `key`, anything ready for JSON that the tables depend on."""
        path = self.folder / pass_name / f"{origin_of(key)}.npz"
        if path.is_file():
            try:
                return load_named(path, "tables of a pass")
            except InputFileError as error:
                warnings.warn(f"{error}; made again", stacklevel=2)
        path.parent.mkdir(parents=True, exist_ok=True)
        save_named(path, make())
        # As read, also where just made: JSON makes lists of tuples in `about`, and an interrupted run that
        # goes on shall give what an uninterrupted one does.
        return load_named(path, "tables of a pass")


Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class Failed:
    """What stands in the place of the result of a recording that could not be read."""

    name: str  # Of the recording
    problem: str  # Text of the error


def attempted(
    work: Callable[[Item], Result], items: Sequence[Item], jobs: int, name: Callable[[Item], str] = str
) -> Generator[Result | Failed, None, None]:
    """Yield ``work(item)`` in the order of the items; one that fails is reported and the others go on.

    `work` is sent to other processes with the items: paths and settings, never sound. Errors of programs,
    which would meet every recording, are raised.

    Examples
    --------
    >>> from worldstate.adapters import read_model
    >>> list(attempted(read_model, ["missing.json"], jobs=1))
    [Failed(name='missing.json', problem='missing.json: ...')]
    """
    named = [(name(item), item) for item in items]
    return in_processes(partial(_attempt, work), named, jobs)


def _attempt(work: Callable[[Item], Result], named: tuple[str, Item]) -> Result | Failed:
    """Do the work on one BLAS thread, here as on every worker: sums of two threads differ in the last bit."""
    name, item = named
    try:
        with one_blas_thread():
            return work(item)
    except (WorldstateError, OSError) as error:
        return Failed(name, str(error))
