"""The results file of the laboratory: every figure by key, with its command, commit and seeds."""

import argparse
import json
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from worldstate.adapters.files.atomic import check_target, write_text
from worldstate.ground.errors import InputFileError

from .table import plain

# Options that say where work is done and what is written, and change no figure.
_NO_FIGURE = ("--results", "--out", "--report", "--predictions", "--jobs", "--scheduler")


def result_key(words: Sequence[str]) -> str:
    """Return a command line by which its figures are found: paths by their names, nothing of where it ran.

    Examples
    --------
    >>> result_key(["windows", "data/features.csv", "--protocol", "lojo", "--jobs", "2", "--json"])
    'windows features.csv --protocol lojo'
    """
    kept, skip = [], False
    for word in words:
        option, _, value = word.partition("=")
        if option in _NO_FIGURE:
            skip = not value
        elif skip or word == "--json":
            skip = False
        else:
            kept.append(word if word.startswith("--") else Path(word).name)
    return " ".join(kept)


def read_results(path: Path) -> dict[str, Any]:
    """Return the results by key; none where there is no file yet."""
    check_target(path)
    try:
        found = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    except ValueError as error:
        raise InputFileError(path, f"expected results of worldstate-lab as JSON ({error})") from error
    if not isinstance(found, dict):
        raise InputFileError(path, "expected results of worldstate-lab by key")
    return found


def keep_results(
    path: Path, words: Sequence[str], arguments: argparse.Namespace, figures: Mapping[str, object]
) -> None:
    """Merge the figures of one command into a results file, under the key of its words."""
    found, key = read_results(path), result_key(words)
    found[key] = {
        "command": f"worldstate-lab {key}",
        "commit": _commit(),
        "seeds": _seeds(arguments),
        "smoke": bool(getattr(arguments, "smoke", False)),
        "figures": plain(figures),
    }
    write_text(path, json.dumps(found, allow_nan=False, indent=1, sort_keys=True) + "\n")


def _seeds(arguments: argparse.Namespace) -> list[int]:
    """Return the seeds of a command: `seeds` is their number or the seeds themselves."""
    seeds = getattr(arguments, "seeds", None)
    if seeds is None:
        return [arguments.seed] if hasattr(arguments, "seed") else []
    return list(range(seeds) if isinstance(seeds, int) else seeds)


def _commit() -> str | None:
    """Return the commit that this code is checked out at, None outside a checkout."""
    words = ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"]
    try:
        return subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None
