"""Mapping of class names of detectors and data sets to the road users of the library."""

import json
import re
from collections.abc import Collection, Mapping
from functools import lru_cache
from importlib.resources import files

_TABLE = json.loads((files("worldstate") / "data" / "class_names.json").read_text("utf-8"))
# The 80 names of COCO: YOLO numbers them from 0; COCO from 1, with ten numbers unused.
YOLO_NAMES: tuple[str, ...] = tuple(_TABLE["coco"])
COCO_CATEGORIES = dict(zip(sorted({*range(1, 91)} - {*_TABLE["numbers_left_out"]}), YOLO_NAMES, strict=True))
ROAD_USERS = frozenset(_TABLE["classes"])
_MOTOR_VEHICLES = ROAD_USERS - {"person", "bicycle"}
# Ultralytics' numbers may replace names. Only those of motor vehicles are read: in another data set 0 or 1
# may be a car, and an unknown class must not become an absence.
_NUMBERED = {str(i): name for i, name in enumerate(YOLO_NAMES) if name in _MOTOR_VEHICLES}
_KNOWN: Mapping[str, str] = (
    {name: name for name in (*YOLO_NAMES, *_TABLE["no_vehicle"])}
    | {other: name for name, others in _TABLE["classes"].items() for other in others}
    | _NUMBERED
)


@lru_cache(maxsize=1024)
def class_name(label: str) -> str:
    """Return the library's class of a name; an unknown name is returned in lower case.

    Examples
    --------
    >>> [class_name(one) for one in ("Car", "LargeVehicle", "vehicle.bus.rigid", "7.0", "Milk-Float")]
    ['car', 'truck', 'bus', 'truck', 'milk float']
    """
    spelt = label.removesuffix(".0"), re.sub(r"(?<=[a-z])(?=[A-Z])", " ", label)
    name, parted = (" ".join(re.split(r"[\W_]+", one.casefold())).strip() for one in spelt)
    return next((_KNOWN[one] for one in (name, parted, name.removesuffix("s")) if one in _KNOWN), name)


def may_be(name: str, asked: Collection[str]) -> bool:
    """Return whether a box of a class may show one of the given classes.

    Detectors confuse motor vehicles (one van is a car, another a truck), so any motor vehicle may be any
    other. An unknown class may be anything; a person or a traffic light is never a car.

    Examples
    --------
    >>> [may_be(one, {"car"}) for one in ("truck", "milk float", "person", "traffic light")]
    [True, True, False, False]
    """
    if name in asked or name not in _KNOWN:
        return True
    return name in _MOTOR_VEHICLES and any(one in _MOTOR_VEHICLES or one not in _KNOWN for one in asked)
