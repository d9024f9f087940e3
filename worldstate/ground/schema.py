"""What is written down carries a name and a version; what is read back is checked, number by number."""

import sys
from collections.abc import Mapping
from typing import Any

from .errors import InputFileError, InvalidArgumentError, SchemaVersionError

MOST_ITEMS = 100_000


def schema_stamp(name: str, version: str) -> dict[str, Any]:
    """Return the entry that names schema and version.

    Examples
    --------
    >>> schema_stamp("worldstate.MissRateTable", "1.0.0")
    {'schema': {'name': 'worldstate.MissRateTable', 'version': '1.0.0'}}
    """
    return {"schema": {"name": name, "version": version}}


def check_schema(data: object, name: str, version: str, source: object) -> Mapping[str, Any]:
    """Return `data` as a mapping if it says that it is of this schema and major version.

    Examples
    --------
    >>> list(check_schema(schema_stamp("a.B", "1.7.0"), "a.B", "1.0.0", "b.json"))
    ['schema']
    """
    stamp = data.get("schema") if isinstance(data, Mapping) else None
    if not isinstance(data, Mapping) or not isinstance(stamp, Mapping) or stamp.get("name") != name:
        raise InputFileError(source, f"expected a JSON object of schema {name}")
    found, major = stamp.get("version"), version.split(".")[0]
    if not isinstance(found, str) or found.count(".") != 2:
        raise InputFileError(source, f"expected a schema version such as {version}")
    if found.split(".")[0] != major:
        raise SchemaVersionError(source, f"expected schema {name} {major}.x, got {found[:40]}")
    return data


def read_number(value: object, name: str) -> float:
    """Return a finite number; text and booleans are none.

    Examples
    --------
    >>> read_number(3, "slope")
    3.0
    """
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if is_number and abs(value) <= sys.float_info.max:  # type: ignore[arg-type]
        return float(value)  # type: ignore[arg-type]
    raise InvalidArgumentError(f"{name}: expected a finite number, got {type(value).__name__}")


def read_numbers(value: object, name: str) -> tuple[float, ...]:
    """Return a list of finite numbers.

    Examples
    --------
    >>> read_numbers([1, 2.5], "risks")
    (1.0, 2.5)
    """
    return tuple(read_number(item, name) for item in _items(value, name))


def read_rows(value: object, name: str) -> tuple[tuple[float, ...], ...]:
    """Return a list of lists of finite numbers.

    Examples
    --------
    >>> read_rows([[1], [2]], "beta")
    ((1.0,), (2.0,))
    """
    return tuple(read_numbers(row, name) for row in _items(value, name))


def _items(value: object, name: str) -> list[object]:
    if not isinstance(value, list | tuple) or len(value) > MOST_ITEMS:
        raise InvalidArgumentError(f"{name}: expected a list of at most {MOST_ITEMS} items")
    return list(value)
