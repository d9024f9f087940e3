"""Programs of the tutorials, examples and pages of version 0.3, shortened, still run.

Each program uses names, arguments and attributes that version 0.3 documented. Former names give one
`DeprecationWarning`.
"""

import math
import re
import runpy
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from worldstate import (
    Absent,
    AcousticAdapter,
    Approach,
    Bearing,
    FilterSettings,
    Measurement,
    NotUsable,
    Present,
    Sighting,
    SignatureEvidence,
    Unqueried,
    WorldFilter,
    WorldState,
    nanoseconds,
    uncalibrated_policy,
)
from worldstate.adapters import Checkpoint, read_checkpoint, save_checkpoint
from worldstate.belief.street_model import StreetModel
from worldstate.measurement import Position, PositionScan

EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "examples"
UNKNOWN, NOT_ASKED = NotUsable("not measured by light"), Unqueried("no camera")
NOISE = tuple(map(tuple, np.diag([2.25, 2.25, 0.25, 0.25]).tolist()))


def headlights() -> Iterator[Measurement]:
    """Yield hops of tutorials 5 and 7: a wall is brighter by 3 +- 1 with a hidden vehicle on the left."""
    for hop, brighter in enumerate((0.1, -0.4, 1.2, 2.6, 3.3, 2.9, 3.4, 2.7, 3.1, 2.8, 0.3, -0.2), 1):
        hidden, other = -0.5 * (brighter - 3.0) ** 2, -0.5 * brighter**2
        light = SignatureEvidence(("left", "right"), hidden=(hidden, other), visible=other, none=other)
        yield Measurement(hop * 100_000_000, light, NOT_ASKED, UNKNOWN, UNKNOWN)


def settings_by_their_former_names(folder: Path) -> Iterator[str]:
    """Set the thresholds of the filter as in the former docstring of `FilterSettings`."""
    settings = FilterSettings(1.0, 0.4, birth_probability=0.3, death_probability=0.2, delete_existence=0.1)
    now = FilterSettings(street=StreetModel(look_s=0.4, birth=0.3, death=0.2))
    former, today = WorldFilter(settings=settings), WorldFilter(settings=now)
    for one in headlights():
        former, today = former.update(one), today.update(one)
        yield f"{len(former.state.entities)} entities, as by the street model: {former.state == today.state}"


def tutorial_another_modality(folder: Path) -> Iterator[str]:
    """Print risks from light alone, then a vehicle whose position is in a message."""
    world = WorldFilter()
    for one in headlights():
        world = world.update(one)
        state = WorldState.from_json(world.state.to_json())
        heard = all(one.share >= 0.0 for one in state.heard or ())
        yield f"{state.calibrated}, {state.no_sequence}, {heard}"
        for cue in state.cues:
            raised, none = cue.advisory is not None, cue.hypotheses.none
            yield f"risk {cue.direction} {cue.risk:.2f}, {raised}, {cue.within}, {none:.2f}"
    car = Position((10.0, 12.0), NOISE, (0.0, -6.0), existence_probability=0.9)
    world = world.update(PositionScan("v2x", 1_300_000_000, (car,)))
    there = world.predict_to(1_400_000_000).state.entities
    (found,) = (one for one in there if one.position_m and (one.status, one.direction) == ("hidden", "left"))
    yield f"exists with {found.existence_probability:.2f}, in view in {found.time_to_visible_s[1]:.1f} s"


def tutorial_embed(folder: Path) -> Iterator[str]:
    """Deliver measurements late and twice, and continue from a checkpoint."""
    in_order, world = WorldFilter(), WorldFilter()
    for one in headlights():
        in_order = in_order.update(one)
    arrivals = [one for pair in zip(*[iter(headlights())] * 2, strict=True) for one in (*pair[::-1], pair[0])]
    for number, one in enumerate(arrivals):
        world = world.update(one)
        if number == len(arrivals) // 2:
            save_checkpoint(folder / "checkpoint.json", Checkpoint(world))
            world = read_checkpoint(folder / "checkpoint.json").world
    same = world.state.entities == in_order.state.entities and world.state.cues == in_order.state.cues
    delivery = world.state.delivery
    yield f"last state as if in order: {same}; replayed {delivery.replayed}, repeated {delivery.repeated}"


def example_v2x_beacon(folder: Path) -> Iterator[str]:
    """Compare the power of messages with the distance in them, with a camera and a threshold."""
    world = WorldFilter(policy=replace(uncalibrated_policy(), gamma=0.7))
    for hop in range(1, 61):
        y_m = 7.0 + 8.0 * (4.0 - hop / 10.0)
        azimuth, range_m, seen = math.atan2(y_m, 10.0), math.hypot(10.0, y_m), hop >= 40
        behind, open_air = (-0.5 * ((mean - 17.0 * (not seen)) / 5.0) ** 2 for mean in (17.0, 0.0))
        sides = (behind - 0.5 * ((azimuth - at) / 0.35) ** 2 for at in (0.96, -0.96))
        evidence = SignatureEvidence(("left", "right"), tuple(sides), open_air - 10.0 * (not seen), none=-2.3)
        measurement = Measurement(
            stamp_ns=nanoseconds(hop / 10.0),
            signature=evidence,
            co_evidence=Present(0.04, 0.01) if seen else Absent(0.04, 0.01),
            bearing=Bearing(azimuth, math.atan2(2.0, range_m)),
            approach=Approach(8.0 * y_m / range_m**2, 1.0 / range_m),
            sightings=(Sighting(azimuth, 0.03, "car", 0.9, 0.1),) if seen else (),
            source="v2x",
        )
        world = world.predict_to(measurement.stamp_ns).update(measurement)
        entities = ", ".join(f"{e.status} {e.id[:8]}" for e in world.state.entities)
        yield f"risk {world.state.risk:.2f} {entities or '-'}"


def example_own_loop(folder: Path) -> Iterator[str]:
    """Use an array, a model and a detector of one's own, and the default settings of the filter."""
    own = runpy.run_path(str(EXAMPLES / "own_loop.py"))
    array, camera, rng = own["my_array"](), own["LiveCamera"](own["BrightBlocks"]()), np.random.default_rng(1)
    adapter = AcousticAdapter(array, own["RATE_HZ"], own["PatternSignature"](), vision=camera)
    world = WorldFilter()
    for hop in range(60):
        camera.look(own["image"]((hop + 1) / 10))
        for measurement in adapter.measure(own["sound"](array, hop / 10, rng)):
            world = world.update(measurement)
            entities = ", ".join(f"{e.status} {e.id[:8]}" for e in world.state.entities)
            yield f"risk {world.state.risk:.2f} {entities or '-'}"


HIDDEN_THEN_VISIBLE = r"(?s).*risk [\d.]+ hidden (\w{8})\n.*risk [\d.]+ visible \1\n?.*"
# Pattern of the output of each program.
PRINTED: dict[Callable[[Path], Iterator[str]], str] = {
    settings_by_their_former_names: r"(\d entities, as by the street model: True\n){12}",
    tutorial_another_modality: r"(False, None, True\n(risk (left|right) 0\.\d\d, (True|False), None, "
    r"0\.\d\d\n){2}){12}exists with 0\.\d\d, in view in \d\.\d s\n",
    tutorial_embed: r"last state as if in order: True; replayed \d+, repeated 6\n",
    example_v2x_beacon: HIDDEN_THEN_VISIBLE,
    example_own_loop: HIDDEN_THEN_VISIBLE,
}
WARNED = {settings_by_their_former_names: r"give birth, death, look_s to StreetModel"}


@pytest.mark.parametrize("program", PRINTED, ids=lambda one: one.__name__)
def test_a_program_of_0_3_runs_with_a_warning_for_renamed_parameters(program, tmp_path) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        printed = "\n".join(program(tmp_path)) + "\n"
    assert re.fullmatch(PRINTED[program], printed), printed
    warned = [str(one.message) for one in caught if one.category is DeprecationWarning]
    asked = WARNED.get(program)
    assert len(warned) == (asked is not None) and all(re.match(str(asked), one) for one in warned), warned
