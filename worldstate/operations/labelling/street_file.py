"""Learned streets on disk: one JSON file a place."""

import json
import warnings
from pathlib import Path
from typing import Any

from worldstate.adapters.files.file_io import read_json, refused_as_file, write_text
from worldstate.ground.serialisation import decode, encode
from worldstate.smoothing.learned_street import LearnedStreet


def write_street(path: str | Path, street: LearnedStreet) -> None:
    """Write a street to exactly this path, whole or not at all."""
    write_text(path, json.dumps(encode(street), allow_nan=False) + "\n")


def read_street(path: str | Path) -> LearnedStreet:
    """Read what `write_street` wrote.

    Files of worldstate 0.2 also hold rates of reveal and departure, which brought nothing: a warning says
    that they are left out.

    Raises
    ------
    InputFileError
        If the file is missing, no JSON, or a value is missing or out of range.
    SchemaVersionError
        If it is of another major version, or no street.
    """
    with refused_as_file(path):
        told: Any = read_json(path, "a learned street file")
        street = decode(LearnedStreet, told, "learned street")
    if any("reveals" in arm for arm in told["arms"]):
        warnings.warn(f"{path}: its rates of reveal and departure are no longer used", stacklevel=2)
    return street
