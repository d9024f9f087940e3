"""Recordings of a corpus, in a folder or listed in a manifest, and a digest of their contents."""

import hashlib
import itertools
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from worldstate.adapters.datasets.ovad import AUDIO_NAME, Recording, named_array
from worldstate.adapters.files.file_io import plain_file, read_rows
from worldstate.adapters.ros.bag_input import METADATA_NAME, STORAGE_SUFFIXES
from worldstate.ground import InputFileError, in_range

CARD_NAME = "corpus.json"  # In the output folder of `hear`
LOG_SUFFIX = ".jsonl"  # Snapshots of `worldstate run` or `live`
_SUFFIXES = {".wav", ".rf64", ".w64", ".flac", LOG_SUFFIX, *STORAGE_SUFFIXES}


@dataclass(frozen=True, slots=True)
class CorpusInput:
    """One recording of a corpus.

    Examples
    --------
    >>> CorpusInput("monday/drive.wav", Path("fleet/monday/drive.wav"), "monday").site
    'monday'
    """

    name: str  # Path relative to the folder, or as in the manifest
    path: Path  # Sound file, recording folder, bag, or a log of snapshots
    site: str  # Place or vehicle by which hours are grouped
    detections: Path | None = None  # Detections of its camera
    odometry: Path | None = None

    @property
    def key(self) -> str:
        """Digest of the name; the names of its files start with it."""
        return hashlib.sha256(self.name.encode()).hexdigest()[:16]

    def digest(self) -> str:
        """Return the SHA-256 of the name, the site and every byte of the files, in hexadecimal.

        Raises
        ------
        InputFileError
            If a file cannot be read.
        """
        # The list of a data set contains the ego's motion, which selects the model.
        moves = Recording.open(self.path).moving_ego if (self.path / AUDIO_NAME).is_file() else None
        found = hashlib.sha256(f"{self.name}\0{self.site}\0{moves}".encode())
        for part in filter(None, (self.path, self.detections, self.odometry, named_array(self.path))):
            for file in sorted(part.rglob("*")) if part.is_dir() else [part]:
                if not file.is_dir():
                    found.update(f"\0{file.name}\0".encode() + file_digest(file))
        return found.hexdigest()


def file_digest(path: Path) -> bytes:
    """Return the SHA-256 of a file."""
    with plain_file(path, "a file to read") as file:
        return hashlib.file_digest(cast(Any, file), "sha256").digest()


def find_corpus(path: Path) -> list[CorpusInput]:
    r"""Return the recordings of a folder or a manifest, sorted by name.

    Recordings in a folder are sound files, bags, recording folders in the layout of OVAD and logs of
    snapshots; the site is the first subfolder. A manifest is a CSV file with the column ``path``, relative to
    its own folder, and optionally ``site``, ``detections`` and ``odometry``.

    Raises
    ------
    InputFileError
        If there is no recording, or a manifest contains one twice.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     _ = Path(folder, "list.csv").write_text("path,site\nb.wav,elm street\na.wav,\n")
    ...     [(one.name, one.site) for one in find_corpus(Path(folder, "list.csv"))]
    [('a.wav', ''), ('b.wav', 'elm street')]
    """
    found = sorted(_below(path) if path.is_dir() else _listed(path), key=lambda one: one.name)
    if not found:
        raise InputFileError(path, "expected sound files, bags, recording folders or logs, got none")
    if twice := next((a.name for a, b in itertools.pairwise(found) if a.name == b.name), None):
        raise InputFileError(path, f"expected every recording once, got {twice} twice")
    return found


def _below(root: Path) -> Iterator[CorpusInput]:
    for path in _recordings_in(root):
        parts = path.relative_to(root).parts or (path.name,)
        yield CorpusInput("/".join(parts), path, parts[0] if len(parts) > 1 else root.resolve().name)


def _recordings_in(folder: Path) -> Iterator[Path]:
    if any((folder / name).is_file() for name in (AUDIO_NAME, METADATA_NAME)):
        yield folder
        return
    with os.scandir(folder) as entries:
        for one in (entry for entry in entries if not entry.name.startswith(".")):
            if one.is_dir(follow_symlinks=False):
                yield from _recordings_in(Path(one.path))
            elif one.is_file() and Path(one.name).suffix.lower() in _SUFFIXES:
                yield Path(one.path)


def _listed(manifest: Path) -> Iterator[CorpusInput]:
    for line, row in read_rows(manifest, ("path",), ("site", "detections", "odometry")):
        if not (name := row["path"]):
            raise InputFileError(manifest, f"line {line}: expected a path")
        beside = (manifest.parent / row[key] if row.get(key) else None for key in ("detections", "odometry"))
        yield CorpusInput(name, manifest.parent / name, row.get("site", ""), *beside)


def share_of(inputs: Iterable[CorpusInput], number: int, of: int) -> list[CorpusInput]:
    """Return the recordings for one of several computers, by the digest of their names.

    Examples
    --------
    >>> inputs = [CorpusInput(f"{i}.wav", Path(f"{i}.wav"), "") for i in range(9)]
    >>> [len(share_of(inputs, number, 2)) for number in (1, 2)]
    [4, 5]
    """
    in_range("shard", number, 1, in_range("shard", of, 1, 1_000_000))
    return [one for one in inputs if int(one.key, 16) % of == number - 1]
