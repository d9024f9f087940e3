"""Typed access to decoded JSON: every refusal says where, what came and what was expected."""

import json
import math
from collections.abc import Callable
from typing import Any, TypeVar

from .errors import InvalidArgumentError, SchemaVersionError

T = TypeVar("T")

MOST_CHARACTERS = 64_000_000
MOST_ITEMS = 100_000


class Record:
    """A decoded JSON object with the place that it stands in, for messages.

    Examples
    --------
    >>> Record({"risk": 0.5, "other": 1}, "cue").number("risk")
    0.5
    """

    # Unknown keys are ignored; a key that is not there reads as null.

    __slots__ = ("_value", "where")

    def __init__(self, value: object, where: str) -> None:
        if not isinstance(value, dict):
            raise InvalidArgumentError(f"{where}: expected an object, got {_shown(value)}")
        self._value: dict[str, Any] = value
        self.where = where

    @property
    def raw(self) -> dict[str, Any]:
        """The decoded object itself."""
        return self._value

    def maybe(self, key: str, read: Callable[[str], T]) -> T | None:
        """Return ``read(key)``, or None for null."""
        return None if self._value.get(key) is None else read(key)

    def text(self, key: str) -> str:
        """Return a string."""
        value = self._value.get(key)
        if not isinstance(value, str):
            raise self._refusal(key, "text", value)
        return value

    def flag(self, key: str) -> bool:
        """Return a boolean."""
        value = self._value.get(key)
        if not isinstance(value, bool):
            raise self._refusal(key, "true or false", value)
        return value

    def integer(self, key: str) -> int:
        """Return a whole number that fits 64 bits."""
        value = self._value.get(key)
        if not isinstance(value, int) or isinstance(value, bool) or abs(value) >= 1 << 63:
            raise self._refusal(key, "a whole number of 64 bits", value)
        return value

    def number(self, key: str) -> float:
        """Return a finite number."""
        return self._finite(key, self._value.get(key))

    def probability(self, key: str) -> float:
        """Return a number in [0, 1]."""
        value = self.number(key)
        if not 0.0 <= value <= 1.0:
            raise self._refusal(key, "a number in [0, 1]", value)
        return value

    def one_of(self, key: str, allowed: tuple[str, ...]) -> str:
        """Return a string out of a closed set."""
        value = self.text(key)
        if value not in allowed:
            raise self._refusal(key, f"one of {', '.join(allowed)}", value)
        return value

    def record(self, key: str) -> "Record":
        """Return an object."""
        return Record(self._value.get(key), f"{self.where}.{key}")

    def records(self, key: str) -> "list[Record]":
        """Return a list of objects."""
        return [Record(item, f"{self.where}.{key}[{i}]") for i, item in enumerate(self._items(key))]

    def texts(self, key: str) -> tuple[str, ...]:
        """Return a list of strings."""
        items = self._items(key)
        if not all(isinstance(item, str) for item in items):
            raise self._refusal(key, "a list of text", items)
        return tuple(items)

    def numbers(self, key: str) -> tuple[float, ...]:
        """Return a list of finite numbers."""
        return tuple(self._finite(key, item) for item in self._items(key))

    def vector(self, key: str) -> tuple[float, float, float]:
        """Return three finite numbers."""
        items = self.numbers(key)
        if len(items) != 3:
            raise self._refusal(key, "three numbers", items)
        return items[0], items[1], items[2]

    def integers(self, key: str) -> tuple[int, ...]:
        """Return a list of whole numbers."""
        items = self._items(key)
        if not all(isinstance(item, int) and not isinstance(item, bool) for item in items):
            raise self._refusal(key, "a list of whole numbers", items)
        return tuple(items)

    def _items(self, key: str) -> list[Any]:
        value = self._value.get(key)
        if not isinstance(value, list) or len(value) > MOST_ITEMS:
            raise self._refusal(key, f"a list of at most {MOST_ITEMS} items", value)
        return value

    def _finite(self, key: str, value: object) -> float:
        if isinstance(value, int | float) and not isinstance(value, bool):
            try:
                number = float(value)
            except OverflowError:
                number = math.inf
            if math.isfinite(number):
                return number
        raise self._refusal(key, "a finite number", value)

    def _refusal(self, key: str, expected: str, value: object) -> InvalidArgumentError:
        return InvalidArgumentError(f"{self.where}.{key}: expected {expected}, got {_shown(value)}")


def decode_json(text: str, where: str) -> object:
    """Decode strict JSON: no NaN, no infinity, bounded size and depth.

    Examples
    --------
    >>> decode_json('{"a": 1}', "snapshot")
    {'a': 1}
    """
    if len(text) > MOST_CHARACTERS:
        raise InvalidArgumentError(f"{where}: expected at most {MOST_CHARACTERS} characters, got {len(text)}")
    try:
        return json.loads(text, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise InvalidArgumentError(f"{where}: expected JSON, got a text that is none ({error})") from error


def check_schema(record: Record, name: str, version: str) -> None:
    """Accept the named schema in any version of the same major number.

    Examples
    --------
    >>> check_schema(Record({"schema": {"name": "n", "version": "1.7.0"}}, "file"), "n", "1.0.0")
    """
    schema = record.record("schema")
    got_name, got_version = schema.text("name"), schema.text("version")
    if got_name != name or got_version.split(".")[0] != version.split(".")[0]:
        expected = f"{name} {version.split('.')[0]}.x"
        got = f"{got_name} {got_version}"[:80]
        raise SchemaVersionError(record.where, f"expected schema {expected}, got {got}")


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is no JSON number")


def _shown(value: object) -> str:
    if isinstance(value, int) and abs(value) >= 1 << 63:
        return "a larger one"
    scalar = value is None or isinstance(value, str | int | float)
    text = repr(value) if scalar else type(value).__name__
    return text if len(text) <= 40 else text[:37] + "..."
