"""The folder of a simulated recording or stream: what it may replace, and how its files are written."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import soundfile

from worldstate.adapters.datasets.ovad import TRUTH_NAME
from worldstate.ground.errors import InputFileError

WAV_LIMIT_BYTES = (1 << 32) - (1 << 16)  # a WAV counts its bytes in 32 bits; beyond it is RF64
SAMPLE_BYTES = 3


def sound_format(samples: int, channels: int) -> str:
    """Return the container that holds so many samples of 24 bits.

    Examples
    --------
    >>> sound_format(480_000, 56), sound_format(172_800_000, 56)
    ('WAV', 'RF64')
    """
    return "RF64" if SAMPLE_BYTES * samples * channels > WAV_LIMIT_BYTES else "WAV"


@contextmanager
def sound_writer(
    path: Path, samples: int, channels: int, sample_rate_hz: float
) -> Iterator[soundfile.SoundFile]:
    """Open a file for so many samples of 24 bits, which are written at once or block by block."""
    kind = sound_format(samples, channels)
    try:
        with soundfile.SoundFile(path, "w", round(sample_rate_hz), channels, "PCM_24", format=kind) as file:
            yield file
    except soundfile.SoundFileError as error:
        raise InputFileError(
            path, f"expected to write {samples} samples, the disk may be full: {error}"
        ) from error


def write_json(path: Path, value: dict[str, Any]) -> None:
    """Write an object, whose numbers are all finite, on one line."""
    path.write_text(json.dumps(value, allow_nan=False) + "\n", encoding="utf-8")


def refuse_foreign(target: Path) -> None:
    """Refuse to replace a folder that holds no simulated truth."""
    if target.exists() and not (target / TRUTH_NAME).is_file():
        raise InputFileError(target, "expected a free name or a simulated recording, found something else")


def put_in_place(target: Path, finished: Path) -> None:
    """Put a finished folder in the place of an old one, which goes with the parent of the new one."""
    target.parent.mkdir(parents=True, exist_ok=True)
    if target.exists():
        target.replace(finished.with_suffix(".old"))
    finished.replace(target)
