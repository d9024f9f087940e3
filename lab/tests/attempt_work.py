"""A small pass over sound files, kept in a cache, for tests that send it to other processes."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import soundfile
from worldstate_lab.trials.pass_cache import PassCache, fingerprint

from worldstate.ground.errors import InputFileError
from worldstate.operations.recordings.hop_table import HopTable


@dataclass(frozen=True, slots=True)
class Levels:
    """Level and Gram matrix of each second of a sound file; every computation of a table adds a line to
    `log`."""

    folder: Path  # Folder of the cache

    def __call__(self, path):
        mark = fingerprint(path, self.folder / "fingerprints")
        tables = PassCache(self.folder).tables("levels", [1, mark], lambda: {"hops": self.make(path)})
        return tables["hops"]

    def make(self, path):
        with (self.folder / "log").open("a") as log:
            log.write(f"{path.name}\n")
        try:
            sound, rate_hz = soundfile.read(path)
        except soundfile.LibsndfileError as error:
            raise InputFileError(path, "expected a sound file") from error
        seconds = sound[: len(sound) // rate_hz * rate_hz].reshape(-1, rate_hz, sound.shape[1])
        # Products of this size are distributed over BLAS threads if more than one may run.
        gram = np.array([second.T @ second for second in seconds])
        return HopTable({"gram": gram, "level": np.sqrt(np.mean(seconds**2, (1, 2)))}, path.name)
