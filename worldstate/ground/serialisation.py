"""One reader and one writer for frozen dataclasses, derived from their fields and type hints."""

import itertools
import json
import math
import re
import sys
import types
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cache
from operator import attrgetter
from typing import Annotated, Any, Literal, TypeAlias, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from .errors import InvalidArgumentError, SchemaVersionError

T = TypeVar("T")
Hint: TypeAlias = Any
Write: TypeAlias = Callable[[Any], Any]
Read: TypeAlias = Callable[[Any], Any]
# The writer and the reader of a type.
Plan: TypeAlias = tuple[Write, Read]

MOST_CHARACTERS = 64 << 20
_HALF = re.compile("[\ud800-\udfff]")
# An empty list has two characters but takes 80 bytes when decoded, so memory is limited by the number of
# values.
MOST_VALUES = 4_000_000
MOST_ITEMS = 1_000_000
_WORD = 1 << 63  # Larger than all integers of 64 bits


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """JSON layout of a class beyond its fields, in a class variable ``LAYOUT``.

    Parameters
    ----------
    schema, version : str
        Name and semantic version in the object; none if empty.
    constants : mapping of str to object
        Keys with one value each, written first and required on reading. A ``kind`` distinguishes the members
        of a union.
    order : str
        Keys in the order in which they are written, if it is not that of the fields.

    Examples
    --------
    >>> from typing import ClassVar
    >>> @dataclass(frozen=True)
    ... class Gain:
    ...     LAYOUT: ClassVar = Layout("example.Gain", "1.0.0")
    ...     gain_db: float
    >>> encode(Gain(3.0))
    {'schema': {'name': 'example.Gain', 'version': '1.0.0'}, 'gain_db': 3.0}
    """

    schema: str = ""
    version: str = ""
    constants: Mapping[str, object] = field(default_factory=dict)
    order: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Check:
    """An annotation: a value must meet this condition after reading.

    Examples
    --------
    >>> decode(Annotated[float, Check("a number above 0", lambda x: x > 0)], -1.0, "gain")
    Traceback (most recent call last):
        ...
    worldstate...InvalidArgumentError: gain: expected a number above 0, got -1.0
    """

    expected: str
    holds: Callable[[Any], object]
    schema: Mapping[str, object] = field(default_factory=dict)  # The same condition in JSON Schema


@dataclass(frozen=True, slots=True, eq=False)
class Keys:
    """An annotation: a fixed tuple is written as an object with these keys.

    Examples
    --------
    >>> decode(Annotated[tuple[str, float], Keys(("label", "score"))], {"label": "car", "score": 1}, "box")
    ('car', 1.0)
    """

    names: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Via:
    """An annotation: a value is written as one of another type.

    Examples
    --------
    >>> decode(Annotated[frozenset[str], Via(tuple[str, ...], sorted, frozenset)], ["a"], "names")
    frozenset({'a'})
    """

    hint: Hint
    write: Write
    read: Read


_WITHIN_ONE = Check("a number in [0, 1]", lambda value: 0.0 <= value <= 1.0, {"minimum": 0, "maximum": 1})
Probability: TypeAlias = Annotated[float, _WITHIN_ONE]
Count: TypeAlias = Annotated[int, Check("a count", lambda value: value >= 0, {"minimum": 0})]

# Metadata of a field: files of an earlier minor version do not contain it, and its default is used.
ADDED = {"added": True}
# Metadata of a field: the keys of its dataclass are written among those of the outer one. A field with the
# metadata "key" is written under that key instead of its own name.
FLAT = {"flat": True}


class _RefusedError(Exception):
    """Problem with a value, and its place, which is completed as the error is passed outwards."""

    def __init__(self, problem: str, *, schema: bool = False) -> None:
        super().__init__(problem)
        self.problem, self.schema, self.place = problem, schema, ""

    def at(self, step: str) -> "_RefusedError":
        self.place = step + self.place
        return self


def encode(value: object) -> dict[str, Any]:
    """Return a dataclass as JSON-compatible values.

    Examples
    --------
    >>> from worldstate.ground.values import NotUsable
    >>> encode(NotUsable("no peak"))
    {'reason': 'no peak'}
    """
    cls: Hint = type(value)
    record: dict[str, Any] = _plan(cls)[0](value)
    return record


def decode(hint: type[T], data: object, where: str) -> T:
    """Return the value of type `hint` from the output of `encode`; unknown keys are ignored.

    Raises
    ------
    InvalidArgumentError
        If a value is missing, not finite, of the wrong type or out of range; the message contains its place.
    SchemaVersionError
        On another schema or another major version.

    Examples
    --------
    >>> from worldstate.ground.values import NotUsable
    >>> decode(tuple[NotUsable, ...], [{"reason": 1}], "looks")
    Traceback (most recent call last):
        ...
    worldstate...InvalidArgumentError: looks[0].reason: expected text, got 1
    """
    kind: Hint = hint
    try:
        value: T = _plan(kind)[1](data)
    except _RefusedError as error:
        place = where + error.place
        if error.schema:
            raise SchemaVersionError(place, error.problem) from error
        raise InvalidArgumentError(f"{place}: {error.problem}") from error
    except RecursionError as error:
        raise InvalidArgumentError(f"{where}: expected less deeply nested lists") from error
    return value


def decode_json(text: str, where: str) -> object:
    """Decode strict JSON: no NaN, no infinity, no half of a surrogate pair, limited size and depth.

    Examples
    --------
    >>> decode_json('{"a": 1}', "snapshot")
    {'a': 1}
    """
    if len(text) > MOST_CHARACTERS:
        raise InvalidArgumentError(f"{where}: expected at most {MOST_CHARACTERS} characters, got {len(text)}")
    values = sum(map(text.count, "[{:,"))
    if values > MOST_VALUES:
        raise InvalidArgumentError(f"{where}: expected at most {MOST_VALUES} values, got {values}")
    with _refused_as_json(where):
        value: object = json.loads(text, parse_constant=_refuse_constant)
        _check_characters(value, text)
    return value


def decode_items(text: str, at: int, take: Callable[[object], object], where: str) -> int:
    """Decode a list inside a JSON text item by item, for any number of items.

    Parameters
    ----------
    text : str
        The text; other parts of it are not decoded.
    at : int
        Position of the list's opening bracket.
    take : callable
        Called with each item.
    where : str
        Name of the list in messages.

    Returns
    -------
    int
        The position after the list.

    Examples
    --------
    >>> found = []
    >>> decode_items('{"a": [1, {"b": 2}], "c": 3}', 6, found.append, "a"), found
    (19, [1, {'b': 2}])
    """
    at, number = _behind_blanks(text, at + 1), 0
    while text[at : at + 1] != "]":
        with _refused_as_json(f"{where} {number}"):
            if number and text[at : at + 1] != ",":
                raise ValueError("Expecting ',' delimiter")
            at = _behind_blanks(text, at + bool(number))
            value, end = _item(text, at)
        take(value)
        at, number = _behind_blanks(text, at + end), number + 1
    return at + 1


def _item(text: str, at: int) -> tuple[object, int]:
    """Return the value at a position and its length; of a long text only a part is decoded."""
    for size in _WINDOWS:
        window = text[at : at + size]
        try:
            value, end = _DECODER.raw_decode(window)
            break
        except ValueError:
            if size == _WINDOWS[-1]:
                raise
    _check_characters(value, window[:end])
    return value, end


def _behind_blanks(text: str, at: int) -> int:
    while text[at : at + 1] in _BLANKS:
        at += 1
    return at


def _check_characters(value: object, text: str) -> None:
    """Raise an error for half a surrogate pair, which has no bytes and could not be printed or written."""
    shown = json.dumps(value, ensure_ascii=False) if "\\u" in text else text
    if not shown.isascii() and _HALF.search(shown):
        raise ValueError("half a surrogate pair is not a character")


@contextmanager
def _refused_as_json(where: str) -> Iterator[None]:
    try:
        yield
    except (ValueError, RecursionError) as error:
        raise InvalidArgumentError(f"{where}: expected JSON, got text that is not JSON ({error})") from error


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not a JSON number")


_BLANKS, _DECODER = (" ", "\t", "\n", "\r"), json.JSONDecoder(parse_constant=_refuse_constant)
# Characters decoded per list item: most are short, an image of 1,000 boxes is not
_WINDOWS = 1 << 11, 1 << 15, 1 << 22


@cache
def _plan(hint: Hint) -> Plan:
    """Compile the writer and the reader of a type, once: snapshots are written ten times per second."""
    origin: Any = get_origin(hint)
    args = get_args(hint)
    if origin is Annotated:
        return _annotated(args[0], args[1:])
    if hint in _SCALARS:
        return _as_is, _SCALARS[hint]
    if is_dataclass(hint):
        return _record(hint)
    if origin is Literal:
        return _as_is, _checked(_text, Check(f"one of {', '.join(args)}", args.__contains__))
    if origin in (Union, types.UnionType):
        return _union(args)
    if origin is tuple:
        return _sequence(args[0]) if args[-1] is Ellipsis else _fixed(args)
    if origin is np.ndarray:
        return np.ndarray.tolist, _array(get_args(args[1])[0])
    if origin is NDArray:  # From numpy 2.5 with Python 3.12 on: a named type that get_origin does not resolve
        return np.ndarray.tolist, _array(args[0])
    if origin in (dict, Mapping):
        return _mapping(args[1])
    raise TypeError(f"{hint} cannot be written as JSON")


def _annotated(hint: Hint, notes: tuple[object, ...]) -> Plan:
    if isinstance(notes[0], Via):
        note, (write, read) = notes[0], _plan(notes[0].hint)
        return lambda value: write(note.write(value)), _then(read, note.read)
    if isinstance(notes[0], Keys):
        return _keyed(notes[0].names, get_args(hint))
    write, read = _plan(hint)
    return write, _checked(read, notes[0]) if isinstance(notes[0], Check) else read


def _as_is(value: Any) -> Any:
    return value


def _then(read: Read, make: Callable[[Any], Any]) -> Read:
    """Return a reader that converts the result of another reader and keeps its error messages."""

    def made(data: object) -> Any:
        value = read(data)
        try:
            return make(value)
        except (ValueError, OverflowError) as error:
            raise _RefusedError(str(error)) from error

    return made


def _checked(read: Read, check: Check) -> Read:
    def checked(data: object) -> Any:
        value = read(data)
        if not check.holds(value):
            raise _refused(check.expected, data)
        return value

    return checked


def _keyed(names: tuple[str, ...], hints: tuple[Hint, ...]) -> Plan:
    plans = dict(zip(names, map(_plan, hints), strict=True))

    def write(parts: Any) -> dict[str, Any]:
        return {name: plan[0](part) for (name, plan), part in zip(plans.items(), parts, strict=True)}

    def read(data: object) -> tuple[Any, ...]:
        entries = _object(data)
        return tuple(_entry(entries, name, plan[1]) for name, plan in plans.items())

    return write, read


def _record(cls: Any) -> Plan:
    layout: Layout = getattr(cls, "LAYOUT", Layout())
    hints = get_type_hints(cls, include_extras=True)
    order = layout.order.split()
    given = [member for member in fields(cls) if member.init]
    members = sorted(given, key=lambda f: order.index(f.name) if f.name in order else len(order))
    plans = {member.name: _plan(hints[member.name]) for member in members}
    flat = {member.name: plans.pop(member.name) for member in members if member.metadata.get("flat")}
    added = {member.name for member in members if member.metadata.get("added")}
    keys = {member.name: member.metadata.get("key", member.name) for member in members}
    write = _writer(layout, {name: write for name, (write, _) in plans.items()}, flat, keys)

    def read(data: object) -> dict[str, Any]:
        entries = _object(data)
        if layout.schema:
            _check_schema(entries.get("schema"), layout)
        for key, constant in layout.constants.items():
            if entries.get(key) != constant:
                raise _refused(f"{constant}", entries.get(key)).at(f".{key}")
        values = {name: read_flat(data) for name, (_, read_flat) in flat.items()}
        try:
            for name, (_, read_value) in plans.items():
                entry = entries.get(keys[name])
                if entry is not None or name not in added:
                    values[name] = read_value(entry)
        except _RefusedError as error:
            raise error.at(f".{keys[name]}") from error.__cause__
        return values

    return write, _then(read, lambda values: cls(**values))


def _writer(
    layout: Layout, writers: dict[str, Write], flat: dict[str, Plan], keys: Mapping[str, str]
) -> Write:
    """Return the writer of a dataclass; fields without conversion come first, for speed."""
    stamp = {"schema": {"name": layout.schema, "version": layout.version}} if layout.schema else {}
    constants, names = {**stamp, **layout.constants}, (*writers, *flat)
    changed = [(keys[name], write) for name, write in writers.items() if write is not _as_is]
    # All in one call. A name is repeated, because a single name would give no tuple.
    written, values_of = [keys[name] for name in names], attrgetter(*names, *names[:1]) if names else None

    def write(value: Any) -> dict[str, Any]:
        record = constants | (dict(zip(written, values_of(value), strict=False)) if values_of else {})
        for key, write_value in changed:
            if record[key] is not None:
                record[key] = write_value(record[key])
        for name, (write_flat, _) in flat.items():
            record |= write_flat(record.pop(name))
        return record

    return write


def _check_schema(stamp: object, layout: Layout) -> None:
    """Accept the given schema in any version with the same major number."""
    name, version = (stamp.get("name"), stamp.get("version")) if isinstance(stamp, dict) else (None, None)
    major = layout.version.split(".")[0]
    if name != layout.schema or not isinstance(version, str) or version.split(".")[0] != major:
        got = f"{name} {version}"[:80] if isinstance(stamp, dict) else _shown(stamp)
        found, advice = str(version).split(".")[0], ""
        if name == layout.schema and found.isdecimal() and len(found) < 10:
            advice = ": written by an earlier worldstate; write it again with this version or use that one"
            if int(found) > int(major):
                advice = ": written by a later worldstate; install that version to read it"
        raise _RefusedError(f"expected schema {layout.schema} {major}.x, got {got}{advice}", schema=True)


def _union(hints: tuple[Hint, ...]) -> Plan:
    """Return the plan of an optional value, or of dataclasses that differ by their kind."""
    some = tuple(hint for hint in hints if hint is not type(None))
    if len(some) < len(hints):
        write, read = _plan(some[0]) if len(some) == 1 else _union(some)
        return _maybe(write), _maybe(read)
    kinds = {_kind(hint): _plan(hint) for hint in hints}

    def write_one(value: Any) -> dict[str, Any]:
        kind = _kind(type(value))
        record: dict[str, Any] = kinds[kind][0](value)
        return record if kind is None else {"kind": kind} | record

    def read_one(data: object) -> Any:
        kind = _object(data).get("kind")
        if not isinstance(kind, str | None) or kind not in kinds:
            raise _refused(f"one of {', '.join(map(str, kinds))}", kind).at(".kind")
        return kinds[kind][1](data)

    return write_one, read_one


def _maybe(change: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return change if change is _as_is else lambda value: None if value is None else change(value)


def _kind(cls: Any) -> str | None:
    """Return the kind of a union's member: its name, unless its layout gives another one."""
    kind: str | None = cls.LAYOUT.constants.get("kind") if hasattr(cls, "LAYOUT") else cls.__name__
    return kind


def _sequence(hint: Hint) -> Plan:
    write, read = _plan(hint)

    def read_all(data: object) -> tuple[Any, ...]:
        items = _items(data)
        if read is _text and set(map(type, items)) == {str}:
            return tuple(items)
        return tuple(_entry(items, i, read) for i in range(len(items)))

    return (list if write is _as_is else lambda values: [write(value) for value in values]), read_all


def _fixed(hints: tuple[Hint, ...]) -> Plan:
    plans = [_plan(hint) for hint in hints]

    def write(values: Any) -> list[Any]:
        return [plan[0](value) for value, plan in zip(values, plans, strict=True)]

    def read(data: object) -> tuple[Any, ...]:
        if len(_items(data)) != len(plans):
            raise _RefusedError(f"expected {len(plans)} items, got {len(_items(data))}")
        return tuple(_entry(data, i, plan[1]) for i, plan in enumerate(plans))

    return list if all(plan[0] is _as_is for plan in plans) else write, read


def _mapping(hint: Hint) -> Plan:
    write, read = _plan(hint)
    return (
        lambda entries: {key: write(value) for key, value in entries.items()},
        lambda data: {key: _entry(data, key, read) for key in _object(data)},
    )


def _array(scalar: type) -> Read:
    """Return a reader that converts nested lists of numbers into an array of one dtype."""
    leaf = _whole if issubclass(scalar, np.integer) else _finite

    def nested(data: object) -> Any:
        if not isinstance(data, list | tuple):
            return leaf(data)
        items = _items(data)
        # The shipped model has 640,000 numbers and an image up to 4,000: checking each number alone would
        # take most of the time.
        rows = {list, tuple} >= set(map(type, items)) > set() and max(map(len, items)) <= MOST_ITEMS
        numbers = list(itertools.chain.from_iterable(items)) if rows else items
        kinds = set(map(type, numbers))
        plain = kinds == {int} or (leaf is _finite and {int, float} >= kinds > set())
        if plain and min(numbers) > -_WORD and max(numbers) < _WORD and all(map(math.isfinite, numbers)):
            return items
        return [_entry(items, i, nested) for i in range(len(items))]

    def read(data: object) -> np.ndarray:
        values = nested(_items(data))
        try:
            return np.array(values, dtype=scalar)
        except ValueError as error:
            raise _RefusedError("expected rows of one length") from error

    return read


def _entry(entries: Any, key: Any, read: Read) -> Any:
    """Read an entry of an object, None if it is missing, or an item of a list."""
    of_object = isinstance(entries, dict)
    try:
        return read(entries.get(key) if of_object else entries[key])
    except _RefusedError as error:
        raise error.at(f".{key}" if of_object else f"[{key}]") from error.__cause__


def _object(data: object) -> dict[str, Any]:
    if not isinstance(data, dict) or len(data) > MOST_ITEMS:
        raise _refused("an object", data)
    return data


def _items(data: object) -> Any:
    if not isinstance(data, list | tuple) or len(data) > MOST_ITEMS:
        raise _refused(f"a list of at most {MOST_ITEMS} items", data)
    return data


def _finite(data: object) -> float:
    is_number = isinstance(data, int | float) and not isinstance(data, bool)
    if is_number and abs(data) <= sys.float_info.max:  # type: ignore[arg-type]
        return float(data)  # type: ignore[arg-type]
    raise _refused("a finite number", data)


def _whole(data: object) -> int:
    if isinstance(data, int) and not isinstance(data, bool) and abs(data) < _WORD:
        return data
    raise _refused("a whole number of 64 bits", data)


_text = _checked(_as_is, Check("text", lambda value: isinstance(value, str)))
_flag = _checked(_as_is, Check("true or false", lambda value: isinstance(value, bool)))
_SCALARS: dict[Hint, Read] = {float: _finite, int: _whole, str: _text, bool: _flag, object: _as_is}


def _refused(expected: str, data: object) -> _RefusedError:
    return _RefusedError(f"expected {expected}, got {_shown(data)}")


def _shown(data: object) -> str:
    if isinstance(data, int) and abs(data) >= _WORD:
        return "a larger one"
    text = repr(data) if data is None or isinstance(data, str | int | float) else type(data).__name__
    return text if len(text) <= 40 else text[:37] + "..."
