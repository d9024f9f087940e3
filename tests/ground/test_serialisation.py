"""Reading and writing of dataclasses."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from worldstate.ground.errors import InvalidArgumentError, SchemaVersionError, WorldstateError
from worldstate.ground.serialisation import (
    ADDED,
    FLAT,
    Keys,
    Layout,
    Probability,
    decode,
    decode_items,
    decode_json,
    encode,
)
from worldstate.ground.typing import FloatArray, IntArray
from worldstate.ground.values import NotUsable


@dataclass(frozen=True, slots=True)
class Bearing:
    azimuth_rad: float
    score: Probability = 1.0


@dataclass(frozen=True, slots=True)
class Range:
    LAYOUT: ClassVar = Layout(constants={"kind": "range"})

    low_m: float
    high_m: float

    def __post_init__(self):
        if self.low_m > self.high_m:
            raise InvalidArgumentError("low_m: expected at most high_m")


@dataclass(frozen=True, slots=True, eq=False)
class Everything:
    LAYOUT: ClassVar = Layout("test.Everything", "2.1.0", order="name")

    number: float
    count: int
    name: str
    moving: bool
    answer: Literal["yes", "no"]
    looks: tuple[NotUsable | Bearing, ...]
    pair: Annotated[tuple[str, int], Keys(("source", "stamp_ns"))]
    stamps: tuple[int | None, ...]
    vector: tuple[float, float] | None
    matrix: FloatArray
    ids: IntArray
    figures: Mapping[str, tuple[float, ...]]
    span: Range = field(metadata=FLAT)
    gain: float = field(default=2.0, metadata=ADDED)


def everything(**changes):
    values = {
        "number": 0.5,
        "count": 3,
        "name": "a",
        "moving": True,
        "answer": "yes",
        "looks": (Bearing(0.1), NotUsable("dark")),
        "pair": ("camera", 7),
        "stamps": (None, 4),
        "vector": (1.0, 2.0),
        "matrix": np.array([[1.0, 2.0], [3.0, 4.0]]),
        "ids": np.array([1, 2]),
        "figures": {"auroc": (0.9, 0.95)},
        "span": Range(0.0, 1.0),
    }
    return Everything(**(values | changes))


def written(**changes):
    return json.loads(json.dumps(encode(everything()), allow_nan=False)) | changes


def test_every_kind_of_field_reads_back():
    again = decode(Everything, written(), "file")
    assert encode(again) == encode(everything())
    assert again.looks == (Bearing(0.1), NotUsable("dark"))
    assert (again.matrix.dtype, again.ids.dtype) == (np.float64, np.int64)
    assert list(written())[:2] == ["schema", "name"]
    assert written()["pair"] == {"source": "camera", "stamp_ns": 7}
    assert written()["low_m"] == 0.0


def test_unknown_keys_are_ignored_and_later_fields_may_be_missing():
    values = written(mood="fine")
    del values["gain"]
    assert decode(Everything, values, "file").gain == 2.0
    with pytest.raises(
        InvalidArgumentError, match=r"file\.count: expected a whole number of 64 bits, got None"
    ):
        decode(Everything, {key: value for key, value in values.items() if key != "count"}, "file")


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("number", "x", r"file\.number: expected a finite number, got 'x'"),
        ("number", True, r"file\.number: expected a finite number, got True"),
        ("number", math.nan, r"file\.number: expected a finite number, got nan"),
        ("number", 10**400, r"file\.number: expected a finite number, got a larger one"),
        ("count", 1.0, r"file\.count: expected a whole number"),
        ("count", False, r"file\.count: expected a whole number"),
        ("moving", 1, r"file\.moving: expected true or false, got 1"),
        ("answer", "maybe", r"file\.answer: expected one of yes, no"),
        ("looks", [{"kind": "Bearing", "azimuth_rad": 1, "score": 2}], r"\[0\]\.score: expected a number"),
        ("looks", [{"kind": "Ghost"}], r"file\.looks\[0\]\.kind: expected one of NotUsable, Bearing"),
        ("looks", {}, r"file\.looks: expected a list of at most"),
        ("pair", {"source": "camera"}, r"file\.pair\.stamp_ns: expected a whole number"),
        ("vector", [1.0], r"file\.vector: expected 2 items, got 1"),
        ("matrix", [[1.0], [1.0, 2.0]], r"file\.matrix: expected rows of one length"),
        ("matrix", [[1.0, None]], r"file\.matrix\[0\]\[1\]: expected a finite number, got None"),
        ("ids", [1.5], r"file\.ids\[0\]: expected a whole number"),
        ("figures", {"a": ["1"]}, r"file\.figures\.a\[0\]: expected a finite number"),
        ("low_m", 2.0, r"file: low_m: expected at most high_m"),
    ],
)  # fmt: skip
def test_errors_name_the_field(key, value, words):
    with pytest.raises(InvalidArgumentError, match=words):
        decode(Everything, written(**{key: value}), "file")


@pytest.mark.parametrize("version", ["3.0.0", "1.9.0", "21.0.0", "9" * 5000, "x", 2, None])
def test_other_major_versions_raise_an_error_and_minor_ones_are_read(version):
    stamp = {"name": "test.Everything", "version": version}
    with pytest.raises(SchemaVersionError, match=r"expected schema test\.Everything 2\.x"):
        decode(Everything, written(schema=stamp), "file")
    assert decode(Everything, written(schema=stamp | {"version": "2.9.1"}), "file").count == 3


@given(st.floats(allow_nan=False, allow_infinity=False), st.integers(-(2**62), 2**62), st.text())
def test_numbers_and_text_read_back_exactly(number, count, name):
    text = json.dumps(encode(everything(number=number, count=count, name=name)))
    again = decode(Everything, json.loads(text), "file")
    assert (again.number, again.count, again.name) == (number, count, name)


def json_values(*floats, **limits):
    """Return values of JSON with these floats."""
    leaves = st.one_of(st.none(), st.booleans(), st.integers(), st.text(max_size=9), *floats)
    return st.recursive(
        leaves,
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=4),
        **limits,
    )


@given(st.sampled_from(sorted(written())), json_values(st.floats()))
def test_any_content_of_a_field_is_read_or_raises_a_typed_error(key, value):
    try:
        decode(Everything, written(**{key: value}), "file")
    except WorldstateError as error:
        assert str(error).startswith("file")


@given(*2 * [st.text(st.characters(exclude_categories=()), max_size=4)])
def test_json_text_can_be_written_again_or_raises_an_error(key, value):
    """Of any code point, halves of surrogate pairs among them, which JSON escapes as \\ud800."""
    text = json.dumps({key: [value]})
    halves = "|".join((key, value)).encode("utf-16", "surrogatepass")
    try:
        halves.decode("utf-16")
    except UnicodeDecodeError:
        for refused in (text, json.dumps({key: value}, ensure_ascii=False)):
            with pytest.raises(InvalidArgumentError, match=r"^car: expected JSON, got text that is not JSON"):
                decode_json(refused, "car")
    else:
        json.dumps(decode_json(text, "car"), ensure_ascii=False).encode()


FINITE = st.floats(allow_nan=False, allow_infinity=False)
JSON = json_values(FINITE, max_leaves=12)


@given(items=st.lists(JSON, max_size=9), indent=st.sampled_from([None, 0, 2]), long=st.integers(0, 3))
def test_a_list_read_by_items_equals_the_whole_list(items, indent, long):
    items += ["a" * 20_000, list(range(9000)), {"b": [{}] * 3000}][:long]
    found, text = [], "{" + json.dumps("a") + ":" + json.dumps(items, indent=indent) + "}"
    assert decode_items(text, text.index("["), found.append, "items") == len(text) - 1
    assert found == items
    for cut in range(0, len(text) - 1, max(len(text) // 20, 1)):
        with pytest.raises(InvalidArgumentError, match="expected JSON"):
            decode_items(text[:cut], 4, [].append, "items")


@pytest.mark.parametrize("depth", [700, 20_000])
@pytest.mark.parametrize("item", ["[" * 5, '"\\ud800"', "NaN", "{]", "[1 2]", "1,,2", "1 2", "[[0]], x"])
def test_an_item_that_is_no_json_raises_an_error(item, depth):
    text = "[" + item.replace("[" * 5, "[" * depth + "]" * depth + ", x") + "]"
    with pytest.raises(InvalidArgumentError, match=r"^items \d: expected JSON"):
        decode_items(text, 0, [].append, "items")


@pytest.mark.parametrize("depth", [300, 700, 20_000])
def test_nested_lists_raise_an_error_at_any_depth(depth):
    deep = 1.0
    for _ in range(depth):
        deep = [deep]
    with pytest.raises(InvalidArgumentError, match="weights: expected"):
        decode(FloatArray, deep, "weights")


def test_an_escaped_backslash_is_no_surrogate():
    assert decode_json(r'["C:\\ud800", "\ud83d\ude97"]', "car") == ["C:\\ud800", "\N{AUTOMOBILE}"]
