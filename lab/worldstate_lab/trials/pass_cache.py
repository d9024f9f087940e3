"""From recordings to trials: passes over the sound, with results cached by the content of their inputs.

The work is distributed over processes of this machine; results do not depend on their number.
"""

import hashlib
import json
import warnings
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

from worldstate.adapters.camera.video import VIDEO_NAME
from worldstate.adapters.datasets.ovad import AUDIO_NAME, DETECTION_NAMES, TRUTH_NAME, named_array
from worldstate.adapters.files.file_io import write_text
from worldstate.adapters.files.model_file import read_model
from worldstate.frontend.array.steering import one_blas_thread
from worldstate.ground.errors import InputFileError, WorldstateError
from worldstate.ground.parallel import in_processes
from worldstate.ground.serialisation import encode
from worldstate.operations.recordings.hop_table import HopTable, load_named, save_named

from .listening import (
    VERSION,
    chain_tables,
    filtered_decisions,
    front_end_tables,
    model_refusal,
    unfiltered_decisions,
    with_scores,
)
from .trial import Take, Trial


def origin_of(made_of: object) -> str:
    """Return a hash of 32 characters of JSON-compatible values.

    Examples
    --------
    >>> origin_of({"seed": 1}) == origin_of({"seed": 1}), origin_of({"seed": 1}) == origin_of({"seed": 2})
    (True, False)
    """
    # 128 bits: two of a million files have the same hash with a probability of 1e-27.
    return hashlib.sha256(json.dumps(made_of, sort_keys=True).encode()).hexdigest()[:32]


# Files that a pass reads. Other files in the folder, such as notes, do not change its fingerprint.
RECORDING_NAMES = (AUDIO_NAME, *DETECTION_NAMES, VIDEO_NAME, TRUTH_NAME)


def fingerprint(place: Path, memo: Path) -> str:
    """Return a hash of 32 characters of a recording's content, a folder in OVAD's layout or one file.

    Hashes of files by path, size, change time and inode are stored in the folder `memo`.

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
    """Return the hash of each file by name; unchanged files are not read again."""
    # With one file for all recordings, entries would be lost if two processes wrote it at once.
    path = memo / f"{origin_of(str(owner.absolute()))}.json"
    known = _known(path)
    stamps = {file: _stamp(file) for file in files}
    found = {stamp: known.get(stamp) or content_hash(file) for file, stamp in stamps.items()}
    if found != known:
        memo.mkdir(parents=True, exist_ok=True)
        write_text(path, json.dumps(found))
    return {file.name: found[stamp] for file, stamp in stamps.items()}


def _known(path: Path) -> dict[str, str]:
    # A damaged memo file only means that the sound files are read again.
    try:
        read = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return {}
    return read if isinstance(read, dict) else {}


def _stamp(path: Path) -> str:
    # Taken before the file is read: if the file changes in the meantime, its stamp differs and it is read
    # again. Copying may set the modification time, but not the change time of the inode.
    state = path.stat()
    return f"{path.name} {state.st_size} {state.st_mtime_ns} {state.st_ctime_ns} {state.st_ino}"


def content_hash(path: Path) -> str:
    """Return a hash of 32 characters of a file's content."""
    # In blocks of 256 KiB, because files have up to 11 GB.
    with path.open("rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()


@dataclass(frozen=True, slots=True)
class PassCache:
    """Cache of the tables of each pass over a recording, in files below `folder`; it can be pickled.

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
        """Return the result of `make` for this `key`, the JSON-compatible inputs of the tables."""
        path = self.folder / pass_name / f"{origin_of(key)}.npz"
        sealed = path.with_suffix(".sum")
        # Both files must exist: a run may have been killed after it wrote the first.
        if path.is_file() and sealed.is_file():
            try:
                if sealed.read_bytes() != _seal(path).encode():
                    # The tables may be readable but not those written under this name.
                    raise InputFileError(path, f"expected the content recorded in {sealed.name}")
                return load_named(path, "tables of a pass")
            except InputFileError as error:
                warnings.warn(f"{error}; computed again", stacklevel=2)
        path.parent.mkdir(parents=True, exist_ok=True)
        save_named(path, make())
        write_text(sealed, _seal(path))
        # A new file is read back, because JSON converts tuples in `about` to lists, and a resumed run must
        # give the same values as an uninterrupted one.
        return load_named(path, "tables of a pass")


def _seal(path: Path) -> str:
    return f"{path.stem} {content_hash(path)}\n"


Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class Failed:
    """Result for a recording that could not be read."""

    name: str  # Name of the recording
    problem: str  # Text of the error


def attempted(
    work: Callable[[Item], Result], items: Sequence[Item], jobs: int, name: Callable[[Item], str] = str
) -> Generator[Result | Failed, None, None]:
    """Yield ``work(item)`` in the order of the items; if one fails, it is reported and the others continue.

    `work` is sent to other processes with the items: paths and settings, never sound. Programming errors,
    which would affect every recording, are raised.

    Examples
    --------
    >>> from worldstate.adapters import read_model
    >>> list(attempted(read_model, ["missing.json"], jobs=1))
    [Failed(name='missing.json', problem='missing.json: ...')]
    """
    named = [(name(item), item) for item in items]
    return in_processes(partial(_attempt, work), named, jobs)


def _attempt(work: Callable[[Item], Result], named: tuple[str, Item]) -> Result | Failed:
    """Do the work on one BLAS thread in every process: sums over two threads differ in the last bit."""
    name, item = named
    try:
        with one_blas_thread():
            return work(item)
    except (WorldstateError, OSError) as error:
        return Failed(name, str(error))


ALPHA = 0.02
# Results that need a model for this sound: decisions of whole chains, and scores by hop.
CHAIN_NAMES = ("shipped", "adapted", "filtered")
SCORES = ("shipped", "grounded", "rateless")


@dataclass(frozen=True, slots=True)
class Hearer:
    """Processes recordings with the given settings and caches the results."""

    folder: Path
    model: Path | None = None  # Model file of the chains; by default the shipped one

    def __call__(self, take: Take) -> Trial:
        """Process one recording, or read the cached results for the same content."""
        mark = fingerprint(take.path, self.folder / "fingerprints")
        # A moving ego has its own shipped model, which its chains use.
        model = read_model(self.model, moving_ego=take.moving)
        array = named_array(take.path)
        about = [VERSION, take.name, take.label, take.t0_s, take.site, mark]
        about.append("" if array is None else content_hash(array))
        cache = PassCache(self.folder)
        heard = cache.tables("front_end", about, partial(front_end_tables, take))
        hops = heard["hops"].replace(about={**heard["hops"].about, "fingerprint": mark})
        refused = model_refusal(take, model)
        if refused is not None:
            unasked = (*CHAIN_NAMES, *SCORES)
            told = {**hops.about, "refused": dict.fromkeys(unasked, refused)}
            return Trial(hops.replace(about=told), heard["boxes"], heard["truth"])
        # Results of the chains depend on the model too, and the shipped one may change with a release.
        signed = [*about, origin_of(encode(model))]
        said = {
            chain: cache.tables(chain, signed, partial(chain_tables, take, chain, self.model))
            for chain in ("plain", "adapted")
        }
        policy = model.policies.for_alpha(ALPHA)
        chains = {
            "shipped": unfiltered_decisions(said["plain"], policy),
            "adapted": unfiltered_decisions(said["adapted"], policy),
            "filtered": filtered_decisions(said["adapted"]),
        }
        hops = with_scores(hops, said["plain"]["stream"], model)
        return Trial(hops, heard["boxes"], heard["truth"], chains)


def trials_and_failures(heard: Iterable[Trial | Failed]) -> tuple[list[Trial], list[Failed]]:
    """Return the trials in the order of the recordings, and the failed recordings."""
    every = list(heard)
    return [one for one in every if isinstance(one, Trial)], [one for one in every if isinstance(one, Failed)]
