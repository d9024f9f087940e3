"""What a command found: tables for people, one JSON object for machines."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from worldstate.adapters.files.atomic import write_text

_SINCE_1970_S = 1e9


@dataclass(frozen=True, slots=True)
class CommandResult:
    """What a command found."""

    report: Mapping[str, object]  # One JSON object
    table: Mapping[str, object] | None = None  # The same for people, where it is not the report itself
    lines: Iterable[str] = ()  # For people, below the table
    code: int = 0  # Exit code


def print_result(result: CommandResult, *, as_json: bool) -> None:
    """Print a result on standard output; None shows as a dash in the table, as null in JSON.

    Examples
    --------
    >>> print_result(CommandResult({"lead_time_s": 1.75, "t0_s": None}), as_json=False)
    lead_time_s  1.75
    t0_s         -
    """
    if as_json:
        print(json.dumps(result.report, allow_nan=False))
        return
    table = result.report if result.table is None else result.table
    width = max(map(len, table), default=0)
    for key, value in table.items():
        print(f"{key:<{width}}  {_readable(value)}")
    for line in result.lines:
        print(line)


def write_report(path: Path, report: Mapping[str, object]) -> None:
    """Write a report as JSON, whole or not at all."""
    write_text(path, json.dumps(report, allow_nan=False, indent=1) + "\n")


def _readable(value: object) -> str:
    if value is None or value in ((), []):
        return "-"
    if isinstance(value, float):
        # Times since 1970 are told to the tenth of a second, as hops come.
        return f"{value:.4g}" if abs(value) < _SINCE_1970_S else f"{value:.1f}"
    if isinstance(value, tuple | list):
        return ", ".join(_readable(item) for item in value)
    return str(value)
