"""Raw sound on disk, for those who ask for it."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import soundfile

from worldstate.adapters.files.atomic import atomic_path
from worldstate.ground.errors import InputFileError
from worldstate.ground.typing import Float32Array

# 24 bits are what converters of such arrays give. WAV ends at 4 GiB, nine minutes of 56 channels; RF64 does
# not, and whoever reads the one reads the other.
_FORMAT, _SUBTYPE = "RF64", "PCM_24"


@contextmanager
def kept_sound(
    path: Path | None, sample_rate_hz: int, channels: int
) -> Iterator[Callable[[Float32Array], None] | None]:
    """Lend a function that writes blocks to a file, which takes its name at the end; None without a path."""
    if path is None:
        yield None
        return
    if path.suffix.lower() not in (".wav", ".rf64"):
        raise InputFileError(path, "expected a name that ends in .wav or .rf64")
    with (
        atomic_path(path) as temporary,
        soundfile.SoundFile(temporary, "w", sample_rate_hz, channels, _SUBTYPE, format=_FORMAT) as file,
    ):
        yield file.write
