"""The folder of a simulated recording or stream: what it may replace, and the container of its sound."""

from pathlib import Path

from worldstate.adapters.datasets.ovad_layout import TRUTH_NAME
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
