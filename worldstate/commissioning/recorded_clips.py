"""A user's own recordings, for the training of guard and road users together with simulated sounds."""

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
# Number per recording, spread over it; an average simulated clip has as many, so both have the same weight.
HOPS_EACH = 25
# A kind may be a class name of guard or road users; it then becomes the first simulated kind of that class.
_AS = {name: kind for kind, name in reversed((FOREIGN | SIGNALS | CLASS_OF).items())}
_AS |= {"street": CLOSE, "bus": _AS["truck"]}
_FREE = "Creative Commons 0"  # Coefficients learned from such clips alone are the project's own


@dataclass(frozen=True, slots=True, eq=False)
class RecordedClips:
    """Measures of a table of clips."""

    rows: SoundRows  # Kinds of the simulator, or others from the table; sites are the recordings
    recordings: Mapping[str, int]  # Number of each kind, with its name in the table
    digest: str  # SHA-256 of the table
    licences: tuple[str, ...]  # Licences as stated in the table

    @property
    def told(self) -> str:
        """Description for the provenance of a model trained on the clips."""
        kinds = ", ".join(f"{kind} {number}" for kind, number in self.recordings.items())
        of = f"{kinds}; {', '.join(self.licences)}; table of SHA-256 {self.digest}"
        owned = "" if self.licences == (_FREE,) else ": these coefficients are not the project's own"
        number = sum(self.recordings.values())
        return f"guard and road users learned from {number} recordings beside the simulation ({of}){owned}"


def read_recorded(folder: Path, table: Path, advance: Callable[[], object] = lambda: None) -> RecordedClips:
    """Process the clips of a table with files in a folder; `advance` is called after every line.

    The columns are file and kind, and optionally recording (default: one per file), road_user (a class of
    `CLASSES`, or empty) and licence. A kind that neither the simulator nor the guard has becomes a foreign
    class of its own; a bus is a truck.

    Raises
    ------
    InputFileError
        If the table or a file cannot be read, or a line has no kind or an unknown road user.
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

    A clip that is shorter than the memory of the measures is preceded by its mirror image.
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
