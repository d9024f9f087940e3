"""Snapshots: a written one is read back, order has no meaning, and errors of damage name the field."""

import copy
import html
import json
import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from functools import cache, reduce
from importlib.resources import files
from operator import attrgetter
from pathlib import Path
from types import UnionType
from typing import Literal, Union, get_args, get_origin, get_type_hints

import jsonschema
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from snapshot_laws import broken_laws
from watched_street import START_NS, false_alarms, heard

from worldstate import Sighting, WorldFilter, to_dataframe
from worldstate.abduction.co_evidence import Absent, Present, Unqueried
from worldstate.abduction.cueing.cueing_policy import uncalibrated_policy
from worldstate.abduction.road_users import Familiar, Foreign
from worldstate.abduction.sequence.sequence_reader import TOO_FEW
from worldstate.adapters.export import dataframe
from worldstate.ground import LEAST_HEARD, NotUsable
from worldstate.ground.errors import InvalidArgumentError, SchemaVersionError, WorldstateError
from worldstate.ground.serialisation import Count, Probability
from worldstate.measurement import Bearing, Heard
from worldstate.state import (
    Advisory,
    Budget,
    Classification,
    Context,
    Entity,
    Event,
    EvidenceTerms,
    Hearing,
    Occluder,
    Priors,
    Rates,
    Relation,
    RiskCue,
    SearchedView,
    SensorHealth,
    SideShare,
    Tally,
    WorldState,
    snapshot_schema,
)
from worldstate.state.cue import WhyNot
from worldstate.state.sensor import MASKED
from worldstate.state.world_state import judged

sys.path.append(str(Path(__file__).resolve().parents[2] / "docs" / "_ext"))
import json_schema

SCHEMA = json.loads(files("worldstate").joinpath("data/snapshot.schema.json").read_text(encoding="utf-8"))
VALIDATOR = jsonschema.Draft202012Validator(SCHEMA)
unit, name, stamp = st.floats(0.0, 1.0), st.text(max_size=12), st.integers(-(2**62), 2**62)
azimuth, number = st.floats(-math.pi, math.pi), st.floats(allow_nan=False, allow_infinity=False)
VALUES = {
    float: number, int: stamp, str: name, bool: st.booleans(), type(None): st.none(),
    Probability: unit, Count: st.integers(0, 2**40),
}  # fmt: skip
REASONS = get_args(WhyNot)


@cache
def values(hint):
    """Return the values of a type, as its annotations describe them."""
    kind, args = get_origin(hint), get_args(hint)
    if hint in VALUES:
        return VALUES[hint]
    if kind is Literal:
        return st.sampled_from(args)
    if kind in (Union, UnionType):
        return st.one_of(*map(values, args))
    if kind is tuple and args[-1] is not Ellipsis:
        return st.tuples(*map(values, args))
    if kind is tuple:
        return st.lists(values(args[0]), max_size=3).map(tuple)
    if kind is Mapping:
        return st.dictionaries(name, values(args[1]), max_size=2)
    return built(hint)


def built(kind, **special):
    """Return a dataclass with values of its fields' types."""
    hints = get_type_hints(kind, include_extras=True)
    of_fields = {one.name: values(hints[one.name]) for one in fields(kind) if one.init}
    angles = {key: azimuth for key in of_fields if key == "azimuth_rad"}
    return st.builds(kind, **of_fields | angles | special)


def unlike(kind, *keys):
    """Return up to three values that differ in these fields."""
    return st.lists(values(kind), max_size=3, unique_by=attrgetter(*keys)).map(tuple)


chances = st.tuples(unit, unit).map(lambda two: (two[0], two[1] * (1.0 - two[0])))
VALUES[Priors] = chances.map(lambda two: Priors(*two, max(1.0 - sum(two), 0.0)))
VALUES[Rates] = st.builds(Rates, *[st.floats(0, 10)] * 6)
VALUES[Bearing] = st.builds(Bearing, azimuth, st.floats(0.01, 3.0))
VALUES[Occluder] = st.builds(Occluder, name, name, azimuth, azimuth, st.floats(0.01, 3.0))
names = attrgetter("id"), attrgetter("direction")
occluders = st.lists(values(Occluder), min_size=1, max_size=3, unique_by=names)
VALUES[Context] = built(
    Context, occluders=occluders.map(tuple), ego_speed_mps=st.none() | st.floats(-100, 100),
    view_half_angle_rad=st.floats(0, 3), hidden_by_side=st.none(),
)  # fmt: skip
reasons = st.lists(st.sampled_from(REASONS), unique=True).map(tuple)
VALUES[RiskCue] = st.tuples(built(RiskCue, usable=st.just(False), why_not=st.just(("masked",))), reasons).map(
    lambda pair: replace(pair[0], usable=not pair[1], why_not=pair[1])
)
states = built(
    WorldState, entities=unlike(Entity, "id"), relations=unlike(Relation, "src", "dst", "kind"),
    cues=unlike(RiskCue, "direction", "azimuth_rad"), seq=st.integers(0, 2**40), no_model=st.none(),
    no_sequence=st.sampled_from([None, TOO_FEW, NotUsable("the model has none")]),
)  # fmt: skip


@given(states)
def test_a_written_state_is_read_back(state):
    assert WorldState.from_json(state.to_json()) == state
    assert WorldState.from_dict(state.to_dict()) == state


@given(states)
@settings(max_examples=20)
def test_a_written_state_obeys_the_shipped_schema(state):
    VALIDATOR.validate(json.loads(state.to_json()))


def test_the_shipped_schema_is_that_of_the_types():
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    for name, kind in json_schema.SHIPPED.items():
        shipped = files("worldstate").joinpath(f"data/{name}.schema.json").read_text(encoding="utf-8")
        assert json_schema.json_schema(kind) == json.loads(shipped), "make schema"
    assert json_schema.json_schema(WorldState) == snapshot_schema()


@given(states, st.randoms())
def test_order_has_no_meaning(state, random):
    parts = {key: list(getattr(state, key)) for key in ("entities", "relations", "cues")}
    for part in parts.values():
        random.shuffle(part)
    parts = {key: tuple(part) for key, part in parts.items()}
    shuffled = replace(state, **parts)
    assert shuffled == state
    assert shuffled.to_json() == state.to_json()


@given(states)
def test_a_printed_state_has_three_lines_and_every_advisory_fits_or_is_cut(state):
    printed = str(state)
    assert len(printed) <= 240
    assert len(printed.splitlines()) <= 3
    assert printed == repr(state)
    assert html.unescape(state._repr_html_()) == f"<pre>{printed}</pre>"
    advised = [cue for cue in state.cues if cue.direction and cue.advisory]
    assert ("ADVISORY" in printed) == bool(advised and state.no_model is None)


def test_a_printed_state_reads_as_a_sentence():
    advised = RiskCue(
        "right", math.radians(-48), 0.3, 0.87, 0.9, 0.9, 3.0, None, Advisory(5_000_000_000, 6_500_000_000),
        entity_id="car", time_to_visible_s=(0.9, 1.8, 3.2), within={"3": 0.73}, usable=True, why_not=(),
    )  # fmt: skip
    other = replace(advised, direction="left", azimuth_rad=0.8, risk=0.04, advisory=None, entity_id=None)
    car = Entity(
        "car", "hidden", 0.9, 0.87, math.radians(-48), 0.3, 0, 0, (Classification("car", 0.8),)
    )  # fmt: skip
    state = WorldState(5_500_000_000, 45, entities=(car,), cues=(advised, other))
    line = "5.5 s  right: ADVISORY, risk 0.87, hidden car at 48 degrees right, in view in 1.8 s (0.9 to 3.2)"
    assert str(state) == line
    # The azimuth is that of the side of the advisory.
    sides = SideShare("left", 0.4, math.radians(52), 0.3), SideShare("right", 0.6, math.radians(-48), 0.3)
    left = replace(advised, direction="left", azimuth_rad=math.radians(52))
    either = replace(state, entities=(replace(car, sides=sides),), cues=(left,))
    assert "left: ADVISORY, risk 0.87, hidden car at 52 degrees left" in str(either)
    unheard = replace(advised, usable=False, why_not=("unheard",))
    assert "ADVISORY (not usable: unheard), risk" in str(replace(state, cues=(unheard, other)))
    quiet = replace(state, cues=(replace(advised, advisory=None, risk=0.12), other))
    assert str(quiet) == "5.5 s  no advisory, risk 0.04 left, 0.12 right"
    seen = replace(quiet, entities=(replace(car, status="visible", azimuth_rad=math.radians(12)),))
    assert str(seen).splitlines()[1] == "       in view: car at 12 degrees left"
    bearing = Bearing(math.radians(-48), 0.1, 2.0)
    reason = NotUsable("no model was made for this array of 4 microphones")
    without = WorldState(5_500_000_000, 45, bearing=bearing, no_model=reason)
    assert str(without) == f"5.5 s  sound from 48 degrees right; no risk: {reason.reason}"


@given(states, st.booleans())
def test_sides_are_found_by_name_and_an_advisory_begins_in_one_state(state, begins):
    begun_ns = [cue.advisory.since_ns for cue in state.cues if cue.advisory and begins]
    state = replace(state, stamp_ns=begun_ns[0] if begun_ns else state.stamp_ns)
    for one in (state, copy.deepcopy(state), WorldState.from_json(state.to_json())):
        for cue in one.cues:
            assert cue.direction is None or one.cues[cue.direction].direction == cue.direction
            assert cue.began == (cue.advisory is not None and cue.advisory.since_ns == state.stamp_ns)
            assert math.radians(cue.azimuth_deg) == pytest.approx(cue.azimuth_rad)
    assert state.cues[:] == tuple(state.cues)
    assert (state.left, state.right) == (None, None) or {"left", "right"} & {c.direction for c in state.cues}
    with pytest.raises(InvalidArgumentError, match="cues: expected one of"):
        state.cues["a side of another street"]


class Table:
    """The only part of pandas that is used."""

    @staticmethod
    def DataFrame(rows, columns):  # noqa: N802
        return [dict(zip(columns, row, strict=True)) for row in rows]


@given(st.lists(states, max_size=3))
@settings(max_examples=20)
def test_a_table_has_a_row_for_every_side_of_every_state(these):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dataframe, "optional", {"pandas": Table}.__getitem__)
        rows = to_dataframe(iter(these))
    expected = [(state.time_s, side) for state in these for side in (sides_of(state) or [None])]
    assert [(row["time_s"], row["side"]) for row in rows] == expected
    told = [cue for state in these for cue in state.cues if cue.direction]
    assert [row["risk"] for row in rows if row["side"]] == [cue.risk for cue in told]
    assert sum(bool(row["began"]) for row in rows) == sum(cue.began for cue in told)


def sides_of(state):
    return [cue.direction for cue in state.cues if cue.direction]


def full_state():
    entity = Entity("a", "hidden", 0.9, 0.8, 0.9, 0.3, 1, 2, (Classification("vehicle", 1.0),))
    sensor = SensorHealth("acoustic", "impaired", 2, "sounds like speech")
    advisory = Advisory(1, 3, (sensor,))
    cue = RiskCue("left", 0.9, 0.3, 0.7, 0.9, 0.95, 2.0, Priors(0.7, 0.2, 0.1), advisory, 0.02, "a", 2.5)
    cue = replace(cue, evidence=EvidenceTerms("hidden", {"prior": 0.1}, 0.1, 2.0))
    edge = Relation("a", "corner_left", "occluded_by", 0.9, 2)
    context = Context(priors=Priors(0.2, 0.3, 0.5))
    view = SearchedView("camera", 2, False, 0.1, 0.01, (-1, 1))
    told = {"sensors": (sensor,), "searched": (view,), "events": (Event(2, "born", "a"),)}
    return WorldState(2, 1, (entity,), (edge,), context, (cue,), **told)


def places(value, path=()):
    """All paths into a decoded JSON value."""
    yield path
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        yield from places(item, (*path, key))


def replaced(value, path, new):
    if not path:
        return new
    value = copy.copy(value)
    value[path[0]] = replaced(value[path[0]], path[1:], new)
    return value


junk = st.sampled_from([None, True, -1, 0.5, 1e308, 10**400, "", "x", [], [1], {}, {"a": 1}, [[]], 2**70])


@settings(max_examples=300)
@given(st.data())
def test_damage_is_accepted_or_refused_by_a_typed_error(data):
    value = full_state().to_dict()
    path = data.draw(st.sampled_from(list(places(value))))
    try:
        WorldState.from_dict(replaced(value, path, data.draw(junk))).to_json()
    except WorldstateError as error:
        assert "snapshot" in str(error) or "expected" in str(error)


@pytest.mark.parametrize(
    ("path", "new", "words"),
    [
        (("entities", 0, "azimuth_rad"), "left", r"snapshot\.entities\[0\]\.azimuth_rad: expected a finite"),
        (("entities", 0, "existence_probability"), 1.2, "existence_probability: expected a number in"),
        (("sensors", 0, "condition"), None, r"sensors\[0\].condition: expected text"),
        (("context", "rates", "arrival_hz"), -1.0, "arrival_hz: expected a number in"),
    ],
)
def test_errors_of_damage_name_the_field(path, new, words):
    damaged = replaced(full_state().to_dict(), path, new)
    with pytest.raises(InvalidArgumentError, match=words):
        WorldState.from_dict(damaged)
    # The schema contains the types, but not the checks of a context's constructor.
    assert VALIDATOR.is_valid(damaged) == (path[0] == "context")


def test_unknown_keys_are_ignored_and_minor_versions_read():
    value = full_state().to_dict()
    value |= {"mood": "fine", "schema": {"name": "worldstate.Snapshot", "version": "4.9.3"}}
    value["entities"][0]["colour"] = "red"
    assert WorldState.from_dict(value) == full_state()
    VALIDATOR.validate(value)


@pytest.mark.parametrize(
    ("version", "advice"),
    [("2.1.0", "an earlier worldstate.* again"), ("0.9.0", "an earlier"), ("11.0.0", "a later"), ("x", "x$")],
)
def test_another_major_version_is_refused_with_what_to_do(version, advice):
    value = full_state().to_dict() | {"schema": {"name": "worldstate.Snapshot", "version": version}}
    with pytest.raises(SchemaVersionError, match=rf"expected schema worldstate\.Snapshot 4\.x.*{advice}"):
        WorldState.from_dict(value)
    assert not VALIDATOR.is_valid(value)


def test_a_state_with_nan_is_not_written():
    entity = Entity("a", "hidden", 0.9, 0.8, math.nan, 0.3, 1, 2)
    with pytest.raises(InvalidArgumentError, match="finite"):
        WorldState(0, 0, (entity,)).to_json()


STREET = WorldFilter(policy=replace(uncalibrated_policy(), alpha=0.02), start_ns=START_NS)
ABSENT, PRESENT = Absent(0.04, 0.01), Present(0.04, 0.01)
QUIET = heard(1, None, ABSENT)
BOX, LOUD = Sighting(0.3, 0.02, "car", 0.9), Heard(excess_db=20.0)
IN_VIEW = [replace(heard(k, None, PRESENT), sightings=(BOX,), heard=LOUD) for k in range(1, 9)]


@pytest.mark.parametrize(
    ("world", "expected"),
    [
        (STREET.update(QUIET), ()),
        (replace(STREET, policy=uncalibrated_policy()).update(QUIET), ("uncalibrated",)),
        (STREET.update(replace(QUIET, heard=Heard(0.0, "lost samples"))), ("unheard",)),
        (STREET.update(replace(QUIET, domain=Foreign("sounds like speech", 2.0))), ("unknown sound",)),
        (STREET.update(replace(QUIET, sequence=TOO_FEW)), ("too little sound",)),
        (reduce(WorldFilter.update, false_alarms(), STREET), ("budget broken",)),
        (STREET.update(QUIET).predict(2.0), ("unheard", "expired")),
        (reduce(WorldFilter.update, IN_VIEW, STREET), ("masked",)),
    ],
    ids=lambda one: " ".join(one) if isinstance(one, tuple) else "",
)  # fmt: skip
def test_a_cue_with_a_fault_is_not_usable_and_never_absent(world, expected):
    state = world.state
    assert [(cue.direction, cue.why_not, cue.usable) for cue in state.cues] == [
        (side, expected, not expected) for side in ("left", "right")
    ]
    assert broken_laws(state) == []


@pytest.mark.parametrize(
    ("moving", "later_s", "masks"),
    [(True, 0.1, True), (True, 1.9, True), (True, 2.1, False), (False, 0.1, False), (False, 1.9, False)],
)
def test_a_vehicle_masks_until_two_seconds_after_it_was_in_view(moving, later_s, masks):
    seen = [replace(one, sequence=None, sightings=(replace(BOX, moving=moving),)) for one in IN_VIEW]
    dark = replace(QUIET, sequence=None, co_evidence=Unqueried("dark"), heard=LOUD)
    ages_ns = (round(age_s * 1e9) for age_s in (0.5 * later_s, later_s))
    unseen = [replace(dark, stamp_ns=IN_VIEW[-1].stamp_ns + age_ns) for age_ns in ages_ns]
    (hearing,) = reduce(WorldFilter.update, (*seen, *unseen), STREET).state.heard
    assert hearing.reason == (MASKED if masks else None)
    assert (hearing.share < 1.0) == masks


@given(st.dictionaries(name, unit, min_size=1), unit, unit)
def test_the_audible_share_of_each_kind_falls_with_the_usable_share(kinds, one, other):
    """It is at most the share on the model's card; without that share, or with unusable sound, it is None."""

    def stated(share: float) -> Mapping[str, float] | None:
        world = STREET.update(replace(QUIET, heard=Heard(share, "wind", kinds=kinds)))
        assert broken_laws(world.state) == []
        assert WorldState.from_json(world.state.to_json()) == world.state
        return world.state.heard[0].kinds

    assert stated(1.0) == pytest.approx(kinds, abs=5e-4)
    assert STREET.update(replace(QUIET, heard=Heard(one))).state.heard[0].kinds is None
    little, much = map(stated, sorted((one, other)))
    assert [little is None, much is None] == [one < LEAST_HEARD for one in sorted((one, other))]
    if little is not None:
        assert all(little[kind] <= much[kind] <= kinds[kind] + 5e-4 for kind in kinds)
        assert all(little[kind] == pytest.approx(min(one, other) * kinds[kind], abs=5e-4) for kind in kinds)


@pytest.mark.parametrize("kinds", [{"car": 1.01}, {"car": math.nan}, {"car": "0.5"}, 0.5])
def test_wrong_shares_of_kinds_are_refused(kinds):
    with pytest.raises(InvalidArgumentError, match="kinds"):
        Heard(kinds=kinds)


def hears(*pairs: tuple[float, str | None]) -> tuple[Hearing, ...]:
    return tuple(Hearing(f"array {k}", share, 0, reason) for k, (share, reason) in enumerate(pairs))


# Changes that make the cues of a usable snapshot unusable, by the reason that follows.
FAULTS: dict[str, tuple[Callable[[WorldState], WorldState], ...]] = {
    "uncalibrated": (lambda one: replace(one, calibrated=False),),
    "masked": (
        lambda one: replace(one, heard=hears((0.5, MASKED))),
        lambda one: replace(one, heard=hears((0.5, MASKED), (0.1, "wind"))),
    ),
    "unheard": (
        lambda one: replace(one, heard=()),
        lambda one: replace(one, heard=hears((0.0, "lost samples"), (0.1, "wind"))),
    ),
    "unknown sound": (lambda one: replace(one, domain=Foreign("sounds like speech", 2.0)),),
    "too little sound": (lambda one: replace(one, no_sequence=TOO_FEW),),
    "budget broken": (
        lambda one: replace(one, budget=Budget("broken", "more false onsets", {}, 25.0, Tally())),
    ),
    "expired": (lambda one: replace(one, stamp_ns=one.valid_until_ns + 1),),
}


@given(states, st.sets(st.sampled_from(REASONS)), st.integers(0, 1))
def test_a_cue_is_usable_unless_a_reason_applies_and_all_that_apply_are_given(state, wrong, variant):
    # Two usable snapshots: in the second one the budget is in doubt and one of two arrays is masked.
    fine = replace(
        state, calibrated=True, heard=hears((0.3, MASKED), (0.9, "wind")) if variant else None,
        domain=Familiar(-2.0) if variant else None, valid_until_ns=state.stamp_ns if variant else None,
        no_sequence=NotUsable("the model has none") if variant else None,
        budget=Budget("in doubt", None, {}, 25.0, Tally()) if variant else None,
    )  # fmt: skip
    told = judged(fine)
    # A side that no source distinguishes has no evidence, so its cue is uncalibrated.
    alone = [() if cue.evidence else ("uncalibrated",) for cue in state.cues]
    assert told.calibrated and [cue.why_not for cue in told.cues] == alone
    faulty = replace(fine, valid_until_ns=fine.stamp_ns)
    for reason, changes in FAULTS.items():  # An unheard side is not masked, and its change comes later
        faulty = changes[variant % len(changes)](faulty) if reason in wrong else faulty
    told = judged(faulty)
    expected = tuple(one for one in REASONS if one in wrong - ({"masked"} if "unheard" in wrong else set()))
    assert [cue.why_not for cue in told.cues] == [expected or one for one in alone]
    assert told.calibrated == wrong.isdisjoint({"uncalibrated", "unheard", "budget broken"})


@pytest.mark.parametrize(("usable", "why_not"), [(True, ["masked"]), (False, []), (True, ["rain"])])
def test_a_cue_that_contradicts_its_reasons_is_refused(usable, why_not):
    value = full_state().to_dict()
    value["cues"][0] |= {"usable": usable, "why_not": why_not}
    with pytest.raises(InvalidArgumentError, match=r"snapshot\.cues\[0\].*expected"):
        WorldState.from_dict(value)
