"""Printing a summary: a table for people, one JSON object for machines."""

import json
from collections.abc import Mapping


def print_summary(summary: Mapping[str, object], *, as_json: bool) -> None:
    """Print `summary` on standard output; None shows as a dash in the table, as null in JSON.

    Examples
    --------
    >>> print_summary({"lead_time_s": 1.75, "t0_s": None}, as_json=False)
    lead_time_s  1.75
    t0_s         -
    """
    if as_json:
        print(json.dumps(summary, allow_nan=False))
        return
    width = max(map(len, summary), default=0)
    for key, value in summary.items():
        print(f"{key:<{width}}  {_readable(value)}")


def _readable(value: object) -> str:
    if value is None or value in ((), []):
        return "-"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, tuple | list):
        return ", ".join(_readable(item) for item in value)
    return str(value)
