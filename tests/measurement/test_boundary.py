"""Inputs of a filter are checked in their constructor."""

import json
import math
import re
from dataclasses import fields, replace

import numpy as np
import pytest
from street_measurements import hop

from worldstate.abduction.co_evidence import Absent
from worldstate.abduction.evidence import SideEvidence, SignatureEvidence
from worldstate.core.filter import WorldFilter
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.values import wrap_angle
from worldstate.measurement import (
    Approach,
    Bearing,
    CameraLook,
    Heard,
    Look,
    Measurement,
    Odometry,
    Position,
    PositionScan,
    SearchedSector,
    Sector,
    Sighting,
)
from worldstate.measurement.odometry import EgoPose
from worldstate.state import Context, Occluder, Rates, WorldState, blind_corner
from worldstate.state.context import corner_at

CAR = Sighting(0.1, 0.02, "car", 0.9)


def measured(number, hidden=(4.0, 0.0), **changes):
    whole = {"answer": Absent(0.04), "bearing": Bearing(0.3, 0.1), "approach": Approach(0.2, 0.1)}
    return replace(hop(number, (*hidden, 2.0, 0.0), CAR, **whole), **changes)


CAMERA = Look("camera", 10**8, Absent(0.04), (-0.5, 0.5))
RADAR = SearchedSector(Sector(0.0, 1.0), 50.0, 0.8)
THERE = Position((10.0, 3.0), ((1.0, 0.0), (0.0, 1.0)), existence_probability=0.9, classes=(("car", 1.0),))
CORNER = corner_at("left", (5.0, 3.0), 9.0)
BUILT = [
    CAR,
    Bearing(0.3, 0.1),
    Approach(0.2, 0.1),
    Heard(0.7, "lost samples"),
    CAMERA,
    CameraLook(CAMERA, (CAR,)),
    measured(1, look=CAMERA, further=(CameraLook(replace(CAMERA, sensor="left"), (CAR,)),)),
    SignatureEvidence(("left", "right"), (1.0, 0.0), 0.0, 0.0),
    THERE,
    RADAR,
    PositionScan("radar", 10**8, (THERE,), RADAR),
    EgoPose((1.0, 2.0)),
    Odometry("wheels", 10**8, 5.0, pose=EgoPose((0.0, 0.0))),
    CORNER,
    Rates(),
    Context(ego_speed_mps=5.0, degradation=0.1),
]
WRONG = [
    *(None, object(), "text", 5, -1.0, 1e300, math.nan, math.inf, 10**400, 2**63, -(2**63), True),
    *((), [], (None,), ("text", 0.5), (math.nan, 0.0), ((1.0, 2.0), 3.0), {}, np.zeros(2), CAR, RADAR),
]


@pytest.mark.parametrize("whole", BUILT, ids=lambda one: type(one).__name__)
def test_a_wrong_field_is_refused_with_its_name(whole):
    refused = 0
    for name in (field.name for field in fields(whole)):
        for wrong in WRONG:
            try:
                built = replace(whole, **{name: wrong})
            except InvalidArgumentError as error:
                # With a valid velocity the covariance has the wrong size.
                text = str(error).replace("covariance:", f"{name}:")
                assert re.match(rf"{name}\b.*: expected .*, got .", text, re.DOTALL), (name, wrong, error)
                refused += 1
            else:
                if isinstance(built, Measurement | PositionScan | Odometry):
                    sound(built)
                if isinstance(built, Occluder | Rates | Context):
                    drives_past(built)
    assert refused > 10 * len(fields(whole))


def sound(built):
    """Check that state and checkpoint of a filter with this measurement can be read back."""
    try:
        world = WorldFilter().update(built).update(measured(1))
    except InvalidArgumentError as error:  # Other directions than the context
        assert "directions" in str(error)
        return
    world.state.to_json()
    copy = WorldFilter.from_dict(json.loads(json.dumps(world.to_dict(), allow_nan=False)))
    assert copy.state == world.state


def drives_past(built):
    """Check that the states of this context can be read back wherever the ego vehicle is."""
    if isinstance(built, Occluder):
        built = Context(occluders=(built, blind_corner("right", -1)))
    world = WorldFilter(Context(rates=built) if isinstance(built, Rates) else built)
    for at, x_m in enumerate((-1e3, 0.0, 4.9, 8.95, 9.0, 9.05, 1e3)):
        world = world.update(Odometry("wheels", (at + 1) * 10**8, 5.0, pose=EgoPose((x_m, 0.0))))
        assert WorldState.from_json(world.state.to_json()) == world.state


def test_contexts_are_checked_and_accept_numpy_numbers():
    with pytest.raises(InvalidArgumentError, match="crossing_m: expected the lane beyond the corner"):
        replace(CORNER, crossing_m=4.0)
    with pytest.raises(InvalidArgumentError, match="degradation: expected a number in"):
        Context(degradation=7.0)
    single = Context(ego_speed_mps=np.float32(5.0), occluders=(replace(CORNER, pace_hz=np.float32(0.5)),))
    assert single.occluders[0] == CORNER
    assert WorldState.from_json(WorldState(0, 0, context=single).to_json()).context == single


def test_class_probabilities_sum_to_at_most_one():
    with pytest.raises(InvalidArgumentError, match=r"classes: .* sum to at most one, got 1\.8"):
        replace(THERE, classes=(("car", 0.9), ("truck", 0.9)))
    assert replace(THERE, classes=(("van", 0.6), ("car", 0.4))).classes == (("car", 0.4), ("van", 0.6))


def test_the_largest_stamp_gives_a_readable_state():
    last_ns = 2**63 - 3600 * 10**9
    for world in (WorldFilter().update(measured(1, stamp_ns=last_ns)), WorldFilter().predict_to(last_ns)):
        assert WorldState.from_json(world.state.to_json()) == world.state
        assert WorldFilter.from_dict(world.to_dict()).state == world.state
    with pytest.raises(InvalidArgumentError, match="stamp_ns"):
        WorldFilter(start_ns=last_ns).predict(1.0)


def test_lists_integers_and_numpy_numbers_are_accepted():
    sides = SideEvidence(("left", "right"), (np.float32(1.0), 0), np.float32(0.5), 0, np.float32(2.0))
    plain_sides = SideEvidence(("left", "right"), (1.0, 0.0), 0.5, 0.0, 2.0)
    told = SignatureEvidence(["left", "right"], [4, np.float32(0)], np.int64(2), 0, sides)
    usual = SignatureEvidence(("left", "right"), (4.0, 0.0), 2.0, 0.0, plain_sides)
    numbers = {"signature": told, "co_evidence": Absent(np.float64(0.04))}
    boxes = (CAR,), (replace(CAR, score=np.float64(0.9)),)
    plain, other = WorldFilter(), WorldFilter()
    for at in range(1, 30):
        mine, its = boxes if at > 20 else ((), ())
        plain = plain.update(measured(at, signature=usual, sightings=mine))
        other = other.update(measured(at, stamp_ns=np.int64(at * 10**8), sightings=its, **numbers))
    assert other.state.to_json() == plain.state.to_json()
    assert json.dumps(other.to_dict()) == json.dumps(plain.to_dict())
    with pytest.raises(InvalidArgumentError, match="direct: expected a finite number, got nan"):
        replace(sides, direct=math.nan)


@pytest.mark.parametrize("turns", range(-3, 4))
def test_angles_near_pi_are_wrapped(turns):
    half = (2 * turns + 1) * math.pi
    for angle in (half, math.nextafter(half, -math.inf), math.nextafter(half, math.inf)):
        both = np.array([wrap_angle(angle), wrap_angle(np.array([angle]))[0]])
        assert (-math.pi < both).all() and (both <= math.pi).all()
        np.testing.assert_allclose(np.exp(1j * both), np.exp(1j * angle), atol=1e-14)
