"""Learned streets on disk: one JSON file a place."""

import json
from pathlib import Path

from worldstate.adapters.files.atomic import write_text
from worldstate.adapters.files.json_file import read_record
from worldstate.ground.serialisation import encode
from worldstate.smoothing.learned_street import LearnedStreet


def write_street(path: str | Path, street: LearnedStreet) -> None:
    """Write a street to exactly this path, whole or not at all."""
    write_text(path, json.dumps(encode(street), allow_nan=False) + "\n")


def read_street(path: str | Path) -> LearnedStreet:
    """Read what `write_street` wrote.

    Raises
    ------
    InputFileError
        If the file is missing, no JSON, or a value is missing or out of range.
    SchemaVersionError
        If it is of another major version, or no street.
    """
    return read_record(LearnedStreet, path, "learned street")
