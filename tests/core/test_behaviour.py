"""Behaviour that users rely on, through the public interface only, and the examples on the pages."""

import ast
import math
import runpy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from street_measurements import UNASKED, after, car, hop

from worldstate import Absent, Context, Present, SignatureEvidence, WorldFilter, nanoseconds
from worldstate.abduction import log_lambda
from worldstate.measurement import Approach, Bearing, Look

LEFT, RIGHT, FRONT = (6.0, 0.0, 0.0, 0.0), (0.0, 6.0, 0.0, 0.0), (0.0, 0.0, 6.0, 0.0)


def entities(world):
    return {entity.status: entity for entity in world.state.entities}


@pytest.mark.parametrize(("azimuth", "answer"), [(0.5, "unqueried"), (0.2, "absent")])
def test_an_empty_look_does_not_lower_vehicles_outside_its_view(azimuth, answer):
    """A look cannot miss a vehicle outside its view."""
    world = after(hop(10, FRONT, car(azimuth)), world=WorldFilter(Context(view_half_angle_rad=0.35)))
    before = world.state.entities[0].existence_probability
    (entity,) = after(hop(13, FRONT, answer=Absent(0.05)), world=world).state.entities
    assert entity.visibility.answer == answer
    alive = before * math.exp(-0.3 / 10.0)
    assert (entity.existence_probability == pytest.approx(alive)) == (answer == "unqueried")
    assert entity.existence_probability <= alive * (1.0 + 1e-9)


def test_a_look_lowers_existence_in_its_whole_view():
    """The answer about one sector does not limit the look, which covers the whole view."""
    world = after(hop(10, FRONT, car(0.2)))
    asked = hop(13, FRONT, answer=Absent(0.9))
    looked = replace(asked, look=Look("camera", asked.stamp_ns, Absent(0.05)))
    said = [after(one, world=world).state.entities for one in (asked, looked)]
    assert said[0][0].existence_probability > 0.9
    assert said[1][0].existence_probability < 0.6


@pytest.mark.parametrize(("azimuth_rad", "vehicles"), [(0.25, 2), (0.1, 1)])
def test_a_sighting_outside_the_gate_is_another_vehicle(azimuth_rad, vehicles):
    """The gate limits the jump of a vehicle, however uncertain its azimuth is."""
    world = after(hop(10, FRONT, car(-0.2)))
    assert len(after(hop(16, FRONT, car(azimuth_rad)), world=world).state.entities) == vehicles


def test_sound_of_the_wrong_side_gives_way_to_the_sighting():
    world = after(*(hop(at, LEFT) for at in (10, 20, 30)))
    (hidden,) = world.state.entities
    (found,) = after(hop(31, LEFT, car(-0.5)), world=world).state.entities
    assert (found.status, found.id, found.direction) == ("visible", hidden.id, "right")


def test_a_missed_image_does_not_hide_a_vehicle():
    """One missed image is no occlusion, so hidden evidence is another vehicle."""
    first = [hop(10 + at, FRONT, car(-0.5)) for at in range(15)]
    beside = [hop(25 + at, RIGHT, car(-0.5)) for at in range(20)]
    world = after(*first, *beside, hop(45, RIGHT, answer=Absent(0.1)))
    assert set(entities(world)) == {"visible", "hidden"}


def test_a_peak_moves_an_unlikely_entity_less():
    """A doubtful entity is a doubtful source of the peak."""

    def moved(clutter_rate):
        world = after(hop(10, FRONT, car(0.0), answer=Present(0.04, clutter_rate)))
        bearing = Bearing(0.15, 0.05, 1.6)
        (entity,) = after(hop(20, FRONT, bearing=bearing), world=world).state.entities
        (unheard,) = after(hop(20, FRONT), world=world).state.entities
        return entity.azimuth_rad - unheard.azimuth_rad

    assert 0.0 < moved(0.9) < 0.7 * moved(0.01)


@pytest.mark.parametrize("step_s", [1.0, 0.5, 0.1])
def test_an_approach_rate_updates_the_belief_by_data_association(step_s):
    r"""P = w P^+ + (1 - w) P^- + w (1 - w) K^2 nu^2, with w = P(the sound is this entity's) before it.

    An overlapping window has the weight of its new share: R / share.
    """
    world = after(*(hop(at, LEFT, approach=Approach(0.3, 0.3)) for at in (10, 20)))
    (before,) = world.predict_to(round((2.0 + step_s) * 1e9)).state.entities
    (later,) = after(hop(20 + 10 * step_s, LEFT, approach=Approach(0.6, 0.2)), world=world).state.entities
    prior, w = before.inverse_tta_std_hz**2, before.existence_probability
    gain = prior / (prior + 0.2**2 / step_s)
    news = 0.6 - before.inverse_tta_hz
    expected = w * (1 - gain) * prior + (1 - w) * prior + w * (1 - w) * (gain * news) ** 2
    assert later.inverse_tta_hz == pytest.approx(before.inverse_tta_hz + w * gain * news)
    assert later.inverse_tta_std_hz**2 == pytest.approx(expected)


def test_a_hand_over_keeps_the_approach_rate():
    world = after(*(hop(at, LEFT, approach=Approach(0.8, 0.1)) for at in (10, 20, 30)))
    (before,) = world.predict_to(3_100_000_000).state.entities
    seen = entities(after(hop(31, LEFT, car(0.5)), world=world))["visible"]
    assert seen.inverse_tta_hz == pytest.approx(before.inverse_tta_hz)
    assert seen.inverse_tta_std_hz == pytest.approx(before.inverse_tta_std_hz)


def test_the_likelihood_ratio_handles_priors_of_zero():
    """Without prior mass on hidden all directions are equal; without mass elsewhere it is infinite."""
    heard = SignatureEvidence(("left", "right"), (1.0, 3.0), 0.5, -0.5)
    nobody = -np.inf
    even = np.log([0.25, 0.25, 0.25, 0.25])
    unheard = np.array([nobody, nobody, *even[2:]])
    assert log_lambda(unheard, heard, UNASKED) == pytest.approx(log_lambda(even, heard, UNASKED))
    assert log_lambda(np.array([*even[:2], nobody, nobody]), heard, UNASKED) == np.inf
    # No other explanation allows the answer of the camera or has any mass.
    assert log_lambda(np.array([*even[:3], nobody]), heard, Absent(0.0)) == np.inf
    one_sided = np.array([even[0], nobody, *even[2:]])
    other = np.log(np.mean(np.exp([0.5, -0.5])))
    assert log_lambda(one_sided, heard, UNASKED) == pytest.approx(1.0 - other)


def test_a_certain_entity_survives_a_checkpoint():
    """Rounding must not make a probability exceed one, because such a checkpoint raises an error."""
    world, rng = WorldFilter(), np.random.default_rng(0)
    for at in range(1, 300):
        world = world.update(hop(at, (rng.uniform(8, 40), 0.0, 3.0, 0.0)))
        if at % 10 == 9:
            assert WorldFilter.from_dict(world.to_dict()).state == world.state


@pytest.mark.parametrize(("miss_rate", "stays"), [(0.9, True), (0.04, False)])
def test_a_poor_camera_does_not_end_an_entity_by_missing_it(miss_rate, stays):
    world = after(hop(10, FRONT, car(0.1), answer=Present(miss_rate, 0.01)))
    (seen,) = world.state.entities
    missed = (hop(10 + at, FRONT, answer=Absent(miss_rate, 0.01)) for at in range(1, 26))
    world = after(*missed, world=world)
    assert [one.id for one in world.state.entities if one.existence_probability > 0.5] == [seen.id] * stays


@pytest.mark.parametrize(
    ("azimuth", "rate", "answer"), [(0.42, 0.4, "unqueried"), (0.42, -0.4, "absent"), (0.0, 0.4, "absent")]
)
def test_a_vehicle_at_the_edge_becomes_hidden_and_is_not_missed(azimuth, rate, answer):
    """Its box ends at the corner; no further box means that it is occluded."""
    boxes = [car(azimuth + 0.1 * rate * (at - 9), width_rad=0.25) for at in range(10)]
    seen = [hop(10 + at, FRONT, box) for at, box in enumerate(boxes)]
    world = after(*seen, *(hop(at, FRONT, answer=Absent(0.1)) for at in (20, 21)))
    (entity,) = world.state.entities
    assert entity.visibility.answer == answer
    assert entity.status == ("hidden" if answer == "unqueried" else "visible")
    # A new detection makes it visible again.
    again = car(azimuth + 0.3 * rate, width_rad=0.25)
    (entity,) = after(hop(22, FRONT, again), world=world).state.entities
    assert (entity.status, entity.visibility.answer) == ("visible", "visible")


EXAMPLE = Path(__file__).resolve().parents[2] / "docs" / "examples" / "v2x_beacon.py"


@pytest.fixture(scope="module")
def v2x():
    return SimpleNamespace(**runpy.run_path(str(EXAMPLE)))


def test_a_beacon_is_hidden_then_visible_with_the_same_id(v2x):
    beacons = v2x.approach_from_left()
    states = list(v2x.run(beacons, v2x.ScriptedCamera(beacons, t0_s=4.0)))
    at = {state.stamp_ns: state for state in states}
    (hidden,) = at[nanoseconds(3.0)].entities
    (seen,) = at[nanoseconds(4.5)].entities
    assert (hidden.status, hidden.direction, seen.status) == ("hidden", "left", "visible")
    assert hidden.id == seen.id
    assert at[nanoseconds(3.0)].risk > 0.9
    # One vehicle in six is followed by another one.
    assert at[nanoseconds(4.5)].risk < 0.2 and at[nanoseconds(5.5)].risk < 0.05
    assert hidden.tta_s == pytest.approx(15.0**2 / 8.0 / 15.0 * (1 + 100 / 225), rel=0.3)
    advisory = [s.stamp_ns for s in states if any(cue.advisory for cue in s.cues)]
    assert advisory
    assert max(advisory) <= nanoseconds(4.3)


@pytest.mark.parametrize("example", ["v2x_beacon.py", "own_loop.py"])
def test_the_examples_import_from_public_packages(example):
    tree = ast.parse((EXAMPLE.parent / example).read_text(encoding="utf-8"))
    imported = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    public = {"worldstate", *(f"worldstate.{one}" for one in ("abduction", "adapters", "measurement"))}
    assert {module for module in imported if module.startswith("worldstate")} <= public


def test_the_beacon_example_runs_as_a_program(v2x, capsys):
    v2x.main()
    out = capsys.readouterr().out
    assert "hidden" in out
    assert "visible" in out


def test_the_example_of_stone_soup_prints_the_output_on_the_page(capsys):
    pytest.importorskip("stonesoup", reason="an example: pip install 'worldstate[oracles]'")
    runpy.run_path(str(EXAMPLE.with_name("stone_soup.py")), run_name="__main__")
    page = (EXAMPLE.parents[1] / "guide" / "from_stone_soup_and_odas.md").read_text(encoding="utf-8")
    assert f"```text\n{capsys.readouterr().out}```" in page
