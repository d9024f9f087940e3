"""JSON Schema (draft 2020-12) of frozen dataclasses as `encode` writes them; `make schema` ships some."""

import inspect
import json
import re
import types
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias, Union, get_args, get_origin, get_type_hints

from worldstate.adapters.export.scene import CompressedImage, FrameTransform, RawAudio, SceneUpdate
from worldstate.ground.serialisation import Check, Hint, Layout
from worldstate.state import WorldState

Schema: TypeAlias = dict[str, Any]
DIALECT = "https://json-schema.org/draft/2020-12/schema"
_SCALARS: dict[Hint, str] = {float: "number", int: "integer", str: "string", bool: "boolean"}
# An entry of a numpydoc section: names, a colon, and indented lines.
_ENTRY = re.compile(r"^(\w+(?:, \w+)*) : .*\n((?:    .*(?:\n|$))+)", re.MULTILINE)


def json_schema(cls: type) -> Schema:
    """Return the schema of a dataclass, every dataclass within it under ``$defs``.

    Unknown keys are allowed, because readers ignore them, and keys that an earlier minor version lacks are
    optional.

    Examples
    --------
    >>> from worldstate.ground.values import NotUsable
    >>> json_schema(NotUsable)["properties"]["reason"]
    {'type': 'string', 'description': 'Why it cannot be given.'}
    """
    defs: dict[str, Schema] = {}
    _of(cls, defs)
    own = defs.pop(cls.__name__)
    return {"$schema": DIALECT, **own, "$defs": dict(sorted(defs.items()))}


def _of(hint: Hint, defs: dict[str, Schema]) -> Schema:
    origin: Any = get_origin(hint)
    args = get_args(hint)
    if hint in _SCALARS:
        return {"type": _SCALARS[hint]}
    if is_dataclass(hint):
        return _reference(hint, defs)
    if origin is Annotated and isinstance(args[1], Check):
        return {**_of(args[0], defs), **args[1].schema}
    if origin is Literal:
        return {"enum": list(args)}
    if origin in (Union, types.UnionType):
        return {"anyOf": [{"type": "null"} if one is type(None) else _of(one, defs) for one in args]}
    if origin is tuple and args[-1] is Ellipsis:
        return {"type": "array", "items": _of(args[0], defs)}
    if origin is tuple:
        items = [_of(one, defs) for one in args]
        return {"type": "array", "prefixItems": items, "minItems": len(items), "maxItems": len(items)}
    if origin is Mapping:
        return {"type": "object", "additionalProperties": _of(args[1], defs)}
    raise TypeError(f"{hint} has no schema here")


def _reference(cls: Any, defs: dict[str, Schema]) -> Schema:
    if cls.__name__ not in defs:
        defs[cls.__name__] = {}  # A class within itself refers to this entry
        defs[cls.__name__] = _record(cls, defs)
    return {"$ref": f"#/$defs/{cls.__name__}"}


def _record(cls: Any, defs: dict[str, Schema]) -> Schema:
    layout: Layout = getattr(cls, "LAYOUT", Layout())
    hints, said = get_type_hints(cls, include_extras=True), _descriptions(cls)
    properties: dict[str, Schema] = {key: {"const": value} for key, value in layout.constants.items()}
    if layout.schema:
        version = {"type": "string", "pattern": f"^{layout.version.split('.')[0]}\\."}
        stamp = {"name": {"const": layout.schema}, "version": version}
        properties["schema"] = {"type": "object", "properties": stamp, "required": list(stamp)}
    required = list(properties)
    for member in [one for one in fields(cls) if one.init]:
        told = {"description": said[member.name]} if member.name in said else {}
        properties[member.name] = _of(hints[member.name], defs) | told
        required += [] if member.metadata.get("added") else [member.name]
    summary = (inspect.getdoc(cls) or "").split("\n\n")[0]
    return {"type": "object", "description": summary, "properties": properties, "required": required}


def _descriptions(cls: Any) -> dict[str, str]:
    """Return the descriptions of a class's fields from its docstring."""
    entries = _ENTRY.findall(inspect.getdoc(cls) or "")
    return {name: " ".join(text.split()) for names, text in entries for name in names.split(", ")}


# Schemas that ship in `worldstate/data`, by the name of the type in logs.
SHIPPED: dict[str, type] = {
    "snapshot": WorldState,
    "foxglove.SceneUpdate": SceneUpdate,
    "foxglove.CompressedImage": CompressedImage,
    "foxglove.RawAudio": RawAudio,
    "foxglove.FrameTransform": FrameTransform,
}


if __name__ == "__main__":
    for name, kind in SHIPPED.items():
        text = json.dumps(json_schema(kind), indent=1)
        (Path("worldstate/data") / f"{name}.schema.json").write_text(text + "\n", encoding="utf-8")
