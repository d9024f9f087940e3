"""An exam of made-up streams, counted by hand: who is detected, when, on which side, and what alarms cost."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from worldstate.abduction.sequence.sequence_model import GROUPS, SequenceAlarm, SequencePosterior
from worldstate.commissioning.heard_stream import (
    CommissionSettings,
    HeardStream,
    exam_streams,
    learned_streams,
)
from worldstate.commissioning.sequence_training import stream_truth
from worldstate.commissioning.stream_exam import (
    LOUDEST,
    ExaminedStream,
    alarm_elsewhere,
    alarm_for,
    alarm_outcomes,
    approaches,
    auroc_before,
    examine,
    warned_before,
)
from worldstate.ground.errors import InvalidArgumentError
from worldstate.operations.recordings.hop_table import HopTable

Vehicle = tuple[str, str, str, float]  # flow, kind, arm, T0
FREE = GROUPS.index("none")
SOON = GROUPS.index("coming_1s")


def heard(vehicles: list[Vehicle], duration_s: float = 60.0, site: str = "SB1") -> HeardStream:
    """Return a stream in which every vehicle is heard for eight seconds before its T0 and three after it."""
    rows = []
    for number, (_, _, arm, entry_s) in enumerate(vehicles):
        for time_s in np.round(np.arange(max(entry_s - 8.0, 0.0), entry_s + 3.0, 0.1), 1):
            side = 1.0 if arm == "left" else -1.0
            seen = bool(entry_s < time_s < entry_s + 1.5)
            rows.append((number, time_s, 6.0, side * (entry_s - time_s), seen, 60.0))
    flow, kind, arm, entry_s = zip(*vehicles, strict=True) if vehicles else ((), (), (), ())
    told = {
        "vehicle": np.arange(len(vehicles)),
        "flow": np.array(flow, np.str_),
        "kind": np.array(kind, np.str_),
        "arm": np.array(arm, np.str_),
        "entry_s": np.array(entry_s, np.float64),
        "hazard": np.ones(len(vehicles), bool),
    }
    names = ("vehicle", "time_s", "x_m", "y_m", "in_view", "loudness_db")
    columns = [np.array(column) for column in zip(*rows, strict=True)] or [np.zeros(0)] * len(names)
    hops = HopTable({"time_s": np.round(np.arange(1.0, duration_s, 0.1), 1)}, about={"site": site})
    return HeardStream(hops, HopTable(told), HopTable(dict(zip(names, columns, strict=True))))


def examined(stream: HeardStream, spans: list[tuple[float, float, int]]) -> ExaminedStream:
    """Return a stream with a posterior that is sure of a side in some spans of time and of nobody else."""
    time_s = stream.hops.time_s
    groups = np.full((len(time_s), 2, len(GROUPS)), 1e-4)
    groups[..., FREE] = 1.0
    for begin, end, side in spans:
        inside = (time_s >= begin - 1e-6) & (time_s <= end + 1e-6)
        groups[inside, side, FREE], groups[inside, side, SOON] = 1e-4, 1.0
    groups /= groups.sum(axis=-1, keepdims=True)
    posterior = SequencePosterior(groups, margin_s=0.0)
    return ExaminedStream(stream, stream_truth(stream), posterior, SequenceAlarm(-0.1, 20.0))


VEHICLES: list[Vehicle] = [
    ("left", "light", "left", 10.0),
    ("right", "heavy", "right", 22.0),
    *(("both", "light", "left", 34.0), ("both", "light", "right", 34.8)),
    *(("queue", "light", "right", 46.0), ("follows", "light", "right", 48.5)),
]


def test_approaches_are_put_together_by_who_came_with_whom() -> None:
    found = approaches(heard([*VEHICLES, ("left", "bicycle", "left", 55.0)]))
    assert [(one.flow, one.entries_s, one.sides, one.quiet) for one in found] == [
        ("single", (10.0,), (0,), False),
        ("single", (22.0,), (1,), False),
        ("both", (34.0, 34.8), (0, 1), False),
        ("queue", (46.0, 48.5), (1, 1), False),
        ("single", (55.0,), (0,), True),
    ]


def test_a_second_vehicle_belongs_to_the_first_however_near_the_next_approach_is() -> None:
    pairs: list[Vehicle] = [
        *(("both", "light", "left", 10.0), ("both", "light", "right", 15.9)),
        *(("both", "light", "right", 16.5), ("both", "light", "left", 22.4)),
        *(("queue", "light", "left", 40.0), ("follows", "light", "left", 46.2)),
    ]
    found = approaches(heard(pairs))
    assert [one.entries_s for one in found] == [(10.0, 15.9), (16.5, 22.4), (40.0, 46.2)]


def test_an_alarm_counts_from_the_horizon_of_the_risk_on_or_from_less() -> None:
    """What a stream's vehicle is announced by seven seconds ahead is not about something else."""
    stream = heard([("left", "light", "left", 20.0)])
    time_s = stream.hops.time_s
    raised = np.column_stack([(time_s > 12.95) & (time_s < 14.5), np.zeros(len(time_s), bool)])
    (early,) = alarm_outcomes(stream, time_s, raised)
    assert early.lead_s == pytest.approx(7.0) and early.onsets == 1
    (late,) = alarm_outcomes(stream, time_s, raised, longest_s=5.0)
    assert (late.lead_s, late.onsets) == (0.0, 0)


def test_an_approach_of_a_drive_counts_however_soon_the_vehicle_comes_out() -> None:
    # Drives last 18 s, and their vehicles come out after six to eight.
    soon: list[Vehicle] = [("left", "car", "left", 6.2)]
    drive, standing = (heard(soon, 18.0, site=name) for name in ("DA1", "SB1"))
    assert examine([examined(drive, [(4.0, 6.0, 0)])])["detected"] == 1.0
    assert examine([examined(standing, [(4.0, 6.0, 0)])])["approaches"] == 0


def test_figures_are_those_counted_by_hand() -> None:
    spans = [
        (8.2, 9.5, 0),  # the first: detected, some two seconds before
        (19.0, 21.0, 0),  # the second: on the wrong side alone
        *((33.0, 33.8, 0), (34.0, 34.6, 1)),  # both sides
        (51.0, 52.0, 0),  # nobody: the queue is missed, and warned of when it is over
    ]
    figures = examine(
        [examined(heard(VEHICLES), spans), examined(heard([]), [(20.0, 20.5, 1), (40.0, 41.0, 0)])]
    )
    assert (figures["approaches"], figures["detected"]) == (4, 0.75)
    assert (figures["detected_single"], figures["detected_both"], figures["detected_queue"]) == (
        1.0,
        1.0,
        0.0,
    )
    assert (figures["other_side_too"], figures["wrong_side_only"], figures["both_sides_found"]) == (
        0.5,
        0.5,
        1.0,
    )
    assert figures["onsets_after"] == 0.25
    hours = 590 * 0.1 / 3600.0
    assert figures["onsets_per_hour"] == pytest.approx(2.0 / hours)
    # The .3 s mean of log-odds passes the threshold two hops in.
    assert figures["lead_s"] == pytest.approx(np.mean([1.7, 2.9, 0.9]), abs=0.11)
    assert (figures["approaches_light"], figures["detected_light"]) == (1, 1.0)
    assert (figures["approaches_heavy"], figures["detected_heavy"]) == (1, 1.0)
    assert figures["lead_heavy_s"] == pytest.approx(2.9, abs=0.11)
    assert figures["lead_missed_as_0_s"] == pytest.approx(0.75 * float(figures["lead_s"] or 0.0))


def test_the_worst_junction_stands_beside_the_mean() -> None:
    good = [examined(heard(VEHICLES[:2]), [(8.0, 9.9, 0), (20.0, 21.9, 1)]), examined(heard([]), [])]
    bad = [
        examined(heard(VEHICLES[:2], site="SA1"), [(8.0, 9.9, 0)]),
        examined(heard([], site="SA1"), [(20.0, 20.5, 1)]),
    ]
    figures = examine([*good, *bad])
    assert (figures["detected"], figures["detected_worst_junction"]) == (0.75, 0.5)
    assert figures["onsets_per_hour_worst_junction"] == pytest.approx(
        2.0 * float(figures["onsets_per_hour"] or 0)
    )
    none = examine(good[:1])
    assert none["onsets_per_hour_worst_junction"] is None and none["detected_worst_junction"] == 1.0


def test_curves_say_who_is_warned_by_then() -> None:
    streams = [examined(heard(VEHICLES[:2]), [(7.0, 9.9, 0), (21.0, 21.9, 1)]), examined(heard([]), [])]
    before_s = np.array([0.0, 0.5, 2.0, 4.0])
    np.testing.assert_array_equal(warned_before(streams, before_s), [1.0, 1.0, 0.5, 0.0])
    np.testing.assert_allclose(auroc_before(streams, before_s), [1.0, 1.0, 0.75, 0.5], atol=0.01)


def _made_up(rng: np.random.Generator, streams: int) -> list[SequencePosterior]:
    """Return hazard-free streams of half a minute, at some junctions louder ones."""
    peaks = rng.uniform(0.05, 0.5, streams)
    return [SequencePosterior(rng.dirichlet(np.full(len(GROUPS), peak), (300, 2)), 0.0) for peak in peaks]


def _onsets_per_hour(alarm: SequenceAlarm, stream: SequencePosterior) -> float:
    raised = alarm.raised(stream).any(axis=1)
    return int((raised & ~np.concatenate([[False], raised[:-1]])).sum()) * 120.0


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(3, 6), st.floats(60.0, 1200.0))
def test_an_alarm_set_at_other_junctions_keeps_the_onsets_it_was_set_for(
    seed: int, junctions: int, rate: float
) -> None:
    # Whatever the streams, over all ways to leave one out, which is what exchangeable junctions are.
    # Two drives each, or a stream in two parts.
    parts = _made_up(np.random.default_rng(seed), 2 * junctions)
    there = list(zip(parts[::2], parts[1::2], strict=True))
    left_out = [(alarm_elsewhere(there[:i] + there[i + 1 :], rate), there[i]) for i in range(junctions)]
    rates = [np.mean([_onsets_per_hour(alarm, one) for one in two]) for alarm, two in left_out]
    onsets = np.minimum(rates, LOUDEST * rate)
    assert np.mean(onsets) <= rate * (1.0 + 1e-9)


def test_one_junction_sets_no_alarm_for_others() -> None:
    with pytest.raises(InvalidArgumentError, match="2 junctions at least, got 1"):
        alarm_elsewhere([_made_up(np.random.default_rng(0), 3)], 20.0)


def test_who_is_missed_throughout_the_last_second_ranks_with_nobody() -> None:
    streams = [examined(heard(VEHICLES[:2]), [(7.5, 9.9, 0)]), examined(heard([]), [])]
    figures = examine(streams)
    assert figures["auroc_last_second"] == pytest.approx(0.75, abs=0.01)
    assert figures["auroc_1s_before"] == pytest.approx(0.75, abs=0.01)
    assert figures["auroc_3s_before"] == pytest.approx(0.5, abs=0.01)
    assert examine(streams[:1])["auroc_last_second"] is None


@given(st.integers(0, 2**32 - 1), st.floats(5.0, 200.0))
def test_an_alarm_keeps_the_onsets_it_was_set_for_on_the_streams_it_was_set_on(
    seed: int, rate: float
) -> None:
    quiet = _made_up(np.random.default_rng(seed), 3)
    alarm = alarm_for(quiet, rate)
    assert np.mean([_onsets_per_hour(alarm, one) for one in quiet]) <= rate


def test_no_two_junctions_of_a_plan_share_their_drivers_and_no_exam_shares_any_with_it() -> None:
    plans = [CommissionSettings(seed=seed, junctions=40) for seed in (1, 2)]
    learned = {one.name: one.seed for plan in plans for one in learned_streams(plan)}
    exams = {one.name: one.seed for plan in plans for one in exam_streams(plan)}
    # Approaches and the hazard-free stream of a junction are different traffic under one seed.
    # Half as many junctions of the second renderer beside them.
    assert len(set(learned.values())) == 2 * (40 + 20) and len(set(exams.values())) == 2 * 5
    assert not set(learned.values()) & set(exams.values())


def test_a_moving_ego_drives_again_and_again_and_no_drive_is_another() -> None:
    chosen = CommissionSettings(moving_ego=True, junctions=3, approach_minutes=1.5, hazard_free_minutes=1.0)
    learned, exam = learned_streams(chosen), exam_streams(chosen)
    assert {one.site.name for one in exam} == {"DA1", "DA2", "DB1", "DB2", "DB3"}
    assert not any(one.ego.stands for one in learned)
    minutes = {
        traffic: sum(one.minutes for one in learned if one.traffic.name == traffic)
        for traffic in ("approaches", "no-hazard")
    }
    assert minutes == {"approaches": pytest.approx(4.5), "no-hazard": pytest.approx(3.0)}
    # A seed is shared by an approach and a hazard-free drive, which are different traffic.
    assert len({one.seed for one in learned}) == 3 * 5
    assert not {one.seed for one in learned} & {one.seed for one in exam}
