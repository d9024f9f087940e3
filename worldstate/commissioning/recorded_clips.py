"""Recordings of a user's own, from which guard and road users are learned beside what is simulated."""

import hashlib
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from worldstate.adapters.audio.sound_file import open_audio
from worldstate.adapters.files.file_io import MAX_BYTES, read_bytes, read_rows, refused_as_file
from worldstate.ground.checks import in_range, named, one_of
from worldstate.ground.errors import InputFileError
from worldstate.ground.typing import FloatArray

from .guard_training import CLOSE, FOREIGN, SIGNALS, SoundRows, characters
from .road_user_training import CLASS_OF, CLASSES

LOWEST_RATE_HZ, MEMORY_S, MOST_SECONDS = 8000.0, 2.1, 600.0
# Of every recording, spread over it: as many as a simulated clip has in the mean, so that both count alike.
HOPS_EACH = 25
# A kind may be called as guard and road users call it: it is learned as the first such of the simulator's.
_AS = {name: kind for kind, name in reversed((FOREIGN | SIGNALS | CLASS_OF).items())}
_AS |= {"street": CLOSE, "bus": _AS["truck"]}
_FREE = "Creative Commons 0"  # Whatever is learned from it is free, too


@dataclass(frozen=True, slots=True, eq=False)
class RecordedClips:
    """What was heard of a table of clips."""

    rows: SoundRows  # Kinds are the simulator's, or those of the table that it has not; sites the recordings
    recordings: Mapping[str, int]  # How many of each kind, as the table calls it
    digest: str  # SHA-256 of the table
    licences: tuple[str, ...]  # As the table states them

    @property
    def told(self) -> str:
        """For the provenance of what was learned from them."""
        kinds = ", ".join(f"{kind} {number}" for kind, number in self.recordings.items())
        of = f"{kinds}; {', '.join(self.licences)}; table of SHA-256 {self.digest}"
        owned = "" if self.licences == (_FREE,) else ": these coefficients are not the project's own"
        number = sum(self.recordings.values())
        return f"guard and road users learned from {number} recordings beside the simulation ({of}){owned}"


def read_recorded(folder: Path, table: Path, advance: Callable[[], object] = lambda: None) -> RecordedClips:
    """Hear the clips of a table, whose files lie in a folder; `advance` is called after every line.

    Columns are file, kind and, if it has them, recording (each file is one without), road_user (a class of
    `CLASSES`, empty if it is none) and licence. A kind that neither the simulator nor the guard names is a
    foreign sound of its own; a bus is a truck.

    Raises
    ------
    InputFileError
        If the table or a file cannot be read, or a line names no kind or an unknown road user.
    """
    heard: dict[tuple[str, str], list[FloatArray]] = {}
    licences = dict[str, None]()
    for line, row in read_rows(table, ("file", "kind"), optional=("recording", "road_user", "licence")):
        with refused_as_file(table, f"line {line}: "):
            user = one_of("road_user", row.get("road_user", ""), ("", *CLASSES[:-1]))
            named("kind", row["kind"])
        recording = row.get("recording") or row["file"]
        heard.setdefault((user or row["kind"], recording), []).append(heard_clip(folder / row["file"]))
        licences[row.get("licence") or "licence not stated"] = None
        advance()
    if not heard:
        raise InputFileError(table, "expected at least one clip")
    rows = SoundRows.joined([_rows(*key, np.concatenate(clips)) for key, clips in heard.items()])
    digest = hashlib.sha256(read_bytes(table, "a CSV file", MAX_BYTES)).hexdigest()
    return RecordedClips(rows, Counter(kind for kind, _ in heard), digest, tuple(licences))


def _rows(kind: str, recording: str, measures: FloatArray) -> SoundRows:
    some = np.linspace(0.0, len(measures) - 1.0, HOPS_EACH).round().astype(np.intp)
    return SoundRows(measures[some], *(np.full(HOPS_EACH, one) for one in (_AS.get(kind, kind), recording)))


def heard_clip(path: Path) -> FloatArray:
    """Return the `characters` of the first channel of a file, shape (n, 49).

    A clip shorter than the memory of the numbers is led in by its mirror image.
    """
    with open_audio(path) as source:
        rate = float(source.sample_rate_hz)
        in_range(f"{path}: sample rate", rate, LOWEST_RATE_HZ, 400_000.0)
        in_range(f"{path}: seconds", source.frames / rate, 0.1, MOST_SECONDS)
        sound = np.concatenate([block[:, 0] for block in source.blocks()])
    lead = round(MEMORY_S * rate) if len(sound) < MEMORY_S * rate else 0
    measures, _ = characters(np.pad(sound, (lead, 0), mode="symmetric"), rate)
    if not len(measures):
        raise InputFileError(path, "expected sound that can be measured, got silence")
    return measures
