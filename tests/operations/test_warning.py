"""Onsets, lead time and hand-over of a stream of states."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from worldstate.adapters.datasets.ovad import TrueTrack
from worldstate.ground.values import nanoseconds
from worldstate.operations.metrics.approach_table import onset_outcome, rising_edges
from worldstate.operations.recordings.hop_table import HopTable
from worldstate.operations.recordings.recording_report import WarningMeter, announcement
from worldstate.state import Advisory, Context, Entity, RiskCue, WorldState


def state(time_s: float, since_s: float | None, entity_id: str = "a", *entities: Entity) -> WorldState:
    told = None if since_s is None else Advisory(nanoseconds(since_s), nanoseconds(since_s + 1.0))
    cue = RiskCue("left", 0.9, 0.3, 0.5, 0.9, 0.9, 1.0, None, told, entity_id=entity_id)
    return WorldState(nanoseconds(time_s), 0, entities=entities, context=Context(), cues=(cue,))


def summary(t0_s: float | None, onsets: dict[float, str], *entities: Entity, hazard_free: bool = False):
    meter = WarningMeter(t0_s, hazard_free)
    for hop in range(100):
        time_s = hop / 10
        since_s = next((start for start in onsets if start <= time_s < start + 0.3), None)
        meter.update(state(time_s, since_s, onsets.get(since_s, "-"), *entities))
    return meter.summary()


def test_lead_time_counts_from_the_first_onset_within_five_seconds():
    got = summary(8.0, {1.0: "early", 5.5: "heard", 7.0: "again"})
    assert (got.lead_time_s, got.first_advisory_s, got.hidden_entity_id) == (2.5, 5.5, "again")
    assert (got.false_advisories_before, got.advisories_after_t0) == (1, 0)


def test_an_advisory_after_line_of_sight_has_no_lead_time():
    got = summary(4.0, {6.0: "late"})
    assert (got.lead_time_s, got.first_advisory_s, got.advisories_after_t0) == (None, 6.0, 1)


@pytest.mark.parametrize(("hazard_free", "false"), [(True, 2), (False, None)])
def test_only_onsets_of_a_hazard_free_recording_are_false(hazard_free, false):
    got = summary(None, {2.0: "a", 5.0: "b"}, hazard_free=hazard_free)
    assert (got.lead_time_s, got.advisories_after_t0) == (None, None)
    assert (got.false_advisories_before, got.advisory_onsets_s) == (false, (2.0, 5.0))


def test_parked_cars_are_not_handed_over():
    def seen(name: str, moving: bool) -> Entity:
        return Entity(name, "visible", 0.9, 0.0, 0.1, 0.02, created_ns=0, updated_ns=0, moving=moving)

    assert summary(5.0, {}, seen("parked", False), seen("coming", True)).visible_entity_id == "coming"
    assert summary(5.0, {}, seen("parked", False)).visible_entity_id is None


def track(side: str, first_s: float, last_s: float) -> TrueTrack:
    time_s = np.arange(100) / 10
    azimuth_rad = np.full(100, 0.5 if side == "left" else -0.5)
    in_view = (time_s > first_s - 0.05) & (time_s < last_s + 0.05)
    return TrueTrack(time_s, azimuth_rad, in_view, np.zeros((100, 2)))


LEFT = track("left", 6.0, 8.0)


@pytest.mark.parametrize(
    ("onsets_s", "truth", "told"),
    [
        ([3.2], [LEFT], "a van from the left was announced 2.8 s before it came into sight"),
        ([0.5], [LEFT], "a van from the left was announced more than 5 s before it came into sight"),
        ([6.4], [LEFT], "a van from the left was announced 0.4 s after it came into sight"),
        ([9.0], [LEFT], "a van from the left was not announced"),
        ([], [LEFT], "a van from the left was not announced"),
        ([3.2], [track("right", 6.0, 8.0)], "a van from the right was not announced"),
        ([], [], "no vehicle came into sight, and none was announced"),
        ([3.2], [], "no vehicle came into sight, although one was announced"),
        ([3.2], [track("left", 0.0, 8.0)], "no vehicle came into sight, although one was announced"),
        (
            [1.0, 3.5],
            [track("left", 5.0, 6.0), track("left", 2.0, 3.0)],
            "a van from the left was announced 1.0 s before it came into sight; "
            "a van from the left was announced 1.5 s before it came into sight",
        ),
    ],
)
def test_the_announcement_states_the_lead_time_of_each_vehicle(onsets_s, truth, told):
    hops = [hop / 10 for hop in range(100)]
    since_s = [next((at for at in onsets_s if at <= time_s < at + 0.3), None) for time_s in hops]
    states = map(state, hops, since_s)
    assert announcement(states, truth, "a van") == told


@given(st.lists(st.booleans(), max_size=50))
def test_every_onset_is_a_change_from_quiet_to_alarm(alarm):
    by_hand = [t for t, on in enumerate(alarm) if on and (t == 0 or not alarm[t - 1])]
    assert rising_edges(alarm).tolist() == by_hand


def test_an_onset_at_line_of_sight_is_no_warning():
    # At 47,998 Hz the hop of T0 = 7 s ends at sample 335,986, 6.3 us before T0.
    at_t0_s = round(7.0 * 47_998) / 47_998 - 6.3e-6
    assert not onset_outcome([at_t0_s], 7.0).detected
    assert onset_outcome([at_t0_s - 0.1], 7.0).detected
    table = HopTable({"time_s": np.array([7.0 + 9e-6, 7.1])}, label="left", t0_s=7.0)
    assert table.before_sight().tolist() == [True, False]
