"""Exams of synthetic streams against counts by hand."""

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import watched_street as street
from hop_tables import heard_stream
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from mapie.risk_control.methods import find_best_predict_param, get_r_hat_plus

from worldstate import FilterSettings, Measurement, WorldFilter, WorldState
from worldstate.abduction.co_evidence import Unqueried
from worldstate.abduction.sequence.sequence_model import GROUPS, SequenceAlarm, SequencePosterior
from worldstate.abduction.sequence.sequence_reader import SequenceReading
from worldstate.adapters.files.model_file import read_model
from worldstate.belief.street_model import StreetModel
from worldstate.commissioning import alarm_curve, commission
from worldstate.commissioning.alarm_curve import (
    LOUDEST,
    advised,
    budgets_elsewhere,
    measured_curve,
    raised_at,
)
from worldstate.commissioning.commission import real_figures
from worldstate.commissioning.heard_stream import (
    CommissionSettings,
    HeardStream,
    exam_streams,
    learned_streams,
)
from worldstate.commissioning.road_user_training import CLASS_OF
from worldstate.commissioning.sequence_training import stream_truth
from worldstate.commissioning.stream_exam import (
    ExaminedStream,
    alarm_outcomes,
    approaches,
    auroc_before,
    exam_figures,
    examine,
    in_view_bearings,
    warned_before,
    with_exam,
)
from worldstate.frontend.array.microphone_array import MicrophoneArray, ovad_array
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray
from worldstate.operations.metrics.approach_table import ApproachTable, StreamApproach, hop_outcome

Vehicle = tuple[str, str, str, float]  # flow, kind, arm, T0
FREE = GROUPS.index("none")
SOON = GROUPS.index("coming_1s")


def heard(vehicles: list[Vehicle], duration_s: float = 60.0, site: str = "SB1") -> HeardStream:
    """Return a stream in which each vehicle is audible from 8 s before to 3 s after its T0."""
    rows = []
    for number, (_, _, arm, entry_s) in enumerate(vehicles):
        for time_s in np.round(np.arange(max(entry_s - 8.0, 0.0), entry_s + 3.0, 0.1), 1):
            side = 1.0 if arm == "left" else -1.0
            seen = bool(entry_s < time_s < entry_s + 1.5)
            rows.append((number, time_s, 6.0, side * (entry_s - time_s), seen, 60.0))
    told, hop_s = enumerate(vehicles), np.round(np.arange(1.0, duration_s, 0.1), 1)
    hops = {"time_s": hop_s, "bearing_rad": np.zeros(len(hop_s))}
    return heard_stream([(number, *one, True) for number, one in told], rows, hops, site=site)


def examined(stream: HeardStream, spans: list[tuple[float, float, int]]) -> ExaminedStream:
    """Return a stream with a certain posterior of a side in spans, and its advisories."""
    time_s = stream.hops.time_s
    groups = np.full((len(time_s), 2, len(GROUPS)), 1e-4)
    groups[..., FREE] = 1.0
    for begin, end, side in spans:
        inside = (time_s >= begin - 1e-6) & (time_s <= end + 1e-6)
        groups[inside, side, FREE], groups[inside, side, SOON] = 1e-4, 1.0
    groups /= groups.sum(axis=-1, keepdims=True)
    told = np.stack([raised_at(one, 0.5) for one in groups[..., SOON].T], axis=1)
    return ExaminedStream(stream, stream_truth(stream), SequencePosterior(groups, margin_s=0.0), told)


VEHICLES: list[Vehicle] = [
    ("left", "light", "left", 10.0),
    ("right", "heavy", "right", 22.0),
    *(("both", "light", "left", 34.0), ("both", "light", "right", 34.8)),
    *(("queue", "light", "right", 46.0), ("follows", "light", "right", 48.5)),
]


def test_simultaneous_vehicles_form_one_approach() -> None:
    found = approaches(heard([*VEHICLES, ("left", "bicycle", "left", 55.0)]))
    assert [(one.flow, one.entries_s, one.sides, one.quiet) for one in found] == [
        ("single", (10.0,), (0,), False),
        ("single", (22.0,), (1,), False),
        ("both", (34.0, 34.8), (0, 1), False),
        ("queue", (46.0, 48.5), (1, 1), False),
        ("single", (55.0,), (0,), True),
    ]
    # A second vehicle belongs to its first, and to no other one.
    pairs: list[Vehicle] = [
        *(("both", "light", "left", 10.0), ("both", "light", "right", 15.9)),
        *(("both", "light", "right", 16.5), ("both", "light", "left", 22.4)),
        *(("queue", "light", "left", 40.0), ("follows", "light", "left", 46.2)),
    ]
    entries_s = [one.entries_s for one in approaches(heard(pairs))]
    assert entries_s == [(10.0, 15.9), (16.5, 22.4), (40.0, 46.2)]


@given(st.lists(st.tuples(st.sampled_from(sorted(CLASS_OF)), st.booleans()), min_size=1, max_size=8))
@settings(max_examples=20, deadline=None)
def test_the_card_has_the_recall_of_each_kind(drawn: list[tuple[str, bool]]) -> None:
    """The oracle is a count of vehicles 20 s apart, each with or without an alarm before T0."""
    told = {"light": "car", "medium": "van", "heavy": "truck"}
    every: list[Vehicle] = [("left", kind, "left", 20.0 * (i + 1)) for i, (kind, _) in enumerate(drawn)]
    alarms = [(one[3] - 2.0, one[3], 0) for one, (_, found) in zip(every, drawn, strict=True) if found]
    stream = examined(heard(every, 20.0 * (len(drawn) + 1)), alarms)
    kinds = with_exam(read_model(), examine([stream])).provenance.kinds
    expected = Counter(told.get(kind, kind) for kind, _ in drawn)
    found = Counter(told.get(kind, kind) for kind, alarm in drawn if alarm)
    assert {one.kind: (one.approaches, one.detected) for one in kinds} == {
        kind: (count, found[kind] / count) for kind, count in expected.items()
    }


@given(st.integers(2, 60), st.integers(0, 2**32 - 1), st.booleans())
@settings(max_examples=30, deadline=None)
def test_an_array_has_real_figures_or_the_gap_of_another_array(
    microphones: int, seed: int, moving: bool
) -> None:
    rng = np.random.default_rng(seed)
    known, roof = read_model().provenance.real, ovad_array().positions_m
    shuffled = MicrophoneArray(rng.permutation(roof) + rng.normal(size=3))
    other = MicrophoneArray(rng.uniform(-0.5, 0.5, (microphones, 3)))
    gap = tuple(one for one in known if not one.own)
    assert known != gap != ()
    assert real_figures(shuffled, moving_ego=moving) == (gap if moving else known)
    assert real_figures(other, moving_ego=moving) == gap


def test_an_alarm_counts_within_the_horizon() -> None:
    """An alarm seven seconds before a vehicle is about that vehicle."""
    stream = heard([("left", "light", "left", 20.0)])
    time_s = stream.hops.time_s
    raised = np.column_stack([(time_s > 12.95) & (time_s < 14.5), np.zeros(len(time_s), bool)])
    (early,) = alarm_outcomes(stream, time_s, raised)
    assert early.lead_s == pytest.approx(7.0) and early.onsets == 1
    (late,) = alarm_outcomes(stream, time_s, raised, longest_s=5.0)
    assert (late.lead_s, late.onsets) == (0.0, 0)


@given(seed=st.integers(0, 2**32), t0_s=st.floats(10.0, 20.0), share=st.floats(0.0, 1.0))
def test_an_alarm_at_t0_is_that_of_the_last_hop_before(seed: int, t0_s: float, share: float) -> None:
    """Alarms after T0, or more than a second before it, have no effect, on either side."""
    rng, time_s = np.random.default_rng(seed), np.round(np.arange(1.0, 30.0, 0.1), 1)
    raised = rng.random((len(time_s), 2)) < share * rng.random()
    found = hop_outcome(StreamApproach("single", (t0_s,), (0,)), time_s, raised)
    last = [i for i, at_s in enumerate(time_s) if t0_s - 1.0 < at_s < t0_s - 1e-3]
    assert found.last_second == any(raised[i, 0] or raised[i, 1] for i in last)
    assert found.at_t0 == bool(raised[last[-1]].any())
    assert found.at_t0 <= found.last_second <= found.detected
    shares = ApproachTable([found, replace(found, at_t0=False, last_second=False)], ()).standing()
    assert shares == {"advised_last_second": found.last_second / 2, "advised_at_t0": found.at_t0 / 2}


def test_approaches_of_a_drive_count_at_any_time() -> None:
    # Drives last 18 s, and their vehicles come out after six to eight.
    soon: list[Vehicle] = [("left", "car", "left", 6.2)]
    drive, standing = (heard(soon, 18.0, site=name) for name in ("DA1", "SB1"))
    assert examine([examined(drive, [(4.0, 6.0, 0)])])["detected"] == 1.0
    assert examine([examined(standing, [(4.0, 6.0, 0)])])["approaches"] == 0


def test_figures_equal_counts_by_hand() -> None:
    spans = [
        (8.2, 9.5, 0),  # the first: detected about two seconds before
        (19.0, 21.0, 0),  # the second: on the wrong side only
        *((33.0, 33.8, 0), (34.0, 34.6, 1)),  # both sides
        (51.0, 52.0, 0),  # no vehicle: the queue is missed, and the alarm comes after it
    ]
    calm = examined(heard([]), [(20.0, 20.5, 1), (40.0, 41.0, 0)])
    figures = examine([examined(heard(VEHICLES), spans), calm])
    assert (figures["approaches"], figures["detected"]) == (4, 0.75)
    assert [figures[f"detected_{flow}"] for flow in ("single", "both", "queue")] == [1.0, 1.0, 0.0]
    sides = [figures[name] for name in ("other_side_too", "wrong_side_only", "both_sides_found")]
    assert sides == [0.5, 0.5, 1.0]
    assert figures["onsets_after"] == 0.25
    hours = 590 * 0.1 / 3600.0
    assert figures["onsets_per_hour"] == pytest.approx(2.0 / hours)
    assert figures["lead_s"] == pytest.approx(np.mean([1.7, 2.9, 0.9]), abs=0.11)
    for kind in ("light", "heavy"):
        assert (figures[f"approaches_{kind}"], figures[f"detected_{kind}"]) == (1, 1.0)
    assert figures["lead_heavy_s"] == pytest.approx(2.9, abs=0.11)
    assert figures["lead_missed_as_0_s"] == pytest.approx(0.75 * float(figures["lead_s"] or 0.0))


def test_each_renderer_has_its_own_figures() -> None:
    """An easy renderer must not hide a hard one."""
    streams = [
        examined(heard([("left", "light", "left", 12.0)], 30.0, site), [(8.0, 12.0, 0)] * is_found)
        for site, is_found in (("SB1", True), ("TA911", False), ("MB911", True), ("MA912", False))
    ]
    figures = exam_figures(streams)
    named = [figures[f"{name}detected"] for name in ("", "rays_", "mirrors_")]
    assert named == [1.0, 0.0, 0.5] and figures["approaches"] == 1


def test_the_worst_junction_is_beside_the_mean() -> None:
    good = [examined(heard(VEHICLES[:2]), [(8.0, 9.9, 0), (20.0, 21.9, 1)]), examined(heard([]), [])]
    approaching, quiet = heard(VEHICLES[:2], site="SA1"), heard([], site="SA1")
    figures = examine([*good, examined(approaching, [(8.0, 9.9, 0)]), examined(quiet, [(20.0, 20.5, 1)])])
    assert (figures["detected"], figures["detected_worst_junction"]) == (0.75, 0.5)
    mean = float(figures["onsets_per_hour"] or 0)
    assert figures["onsets_per_hour_worst_junction"] == pytest.approx(2.0 * mean)
    none = examine(good[:1])
    assert none["onsets_per_hour_worst_junction"] is None and none["detected_worst_junction"] == 1.0


def test_curves_have_the_share_warned_by_a_time() -> None:
    streams = [examined(heard(VEHICLES[:2]), [(7.0, 9.9, 0), (21.0, 21.9, 1)]), examined(heard([]), [])]
    before_s = np.array([0.0, 0.5, 2.0, 4.0])
    np.testing.assert_array_equal(warned_before(streams, before_s), [1.0, 1.0, 0.5, 0.0])
    np.testing.assert_allclose(auroc_before(streams, before_s), [1.0, 1.0, 0.75, 0.5], atol=0.01)


def levels(seed: int, junctions: int, streams: int = 2) -> list[tuple[str, FloatArray]]:
    """Return hazard-free streams of half a minute at junctions, some louder or denied."""
    rng, shape = np.random.default_rng(seed), (junctions, streams, 300)
    wander = rng.normal(0.0, 0.5, shape).cumsum(axis=-1) + rng.normal(0.0, 2.0, (junctions, 1, 1))
    denied = np.where(rng.random(shape) < 0.1, -np.inf, wander)
    return [(f"J{junction}", one) for junction, some in enumerate(denied) for one in some]


def counted(streams: list[FloatArray], threshold_nats: float) -> tuple[float, float]:
    """Return onsets per hour and the share of hops in alarm, hop by hop."""
    onsets = alarmed = 0
    for one in streams:
        left = 0
        for level in one.tolist():
            before, left = left, 11 if level >= threshold_nats else max(left - 1, 0)
            left = 0 if level == -np.inf else left
            onsets += left > 0 and before == 0
            alarmed += left > 0
    hops = sum(map(len, streams))
    return onsets / (hops * 0.1 / 3600.0), alarmed / hops


CURVES = settings(max_examples=15, deadline=None)


@CURVES
@given(st.integers(0, 2**32 - 1), st.integers(1, 6))
def test_the_points_of_a_curve_are_counts_and_no_rate_falls(seed: int, junctions: int) -> None:
    quiet = levels(seed, junctions)
    streams, curve = [one for _, one in quiet], measured_curve(quiet)
    direct = np.array([counted(streams, one) for one in curve.threshold_nats.tolist()])
    # Alarms that merge are one onset, so the maximum so far counts.
    assert curve.onsets_per_hour == pytest.approx(np.maximum.accumulate(direct[:, 0]))
    assert curve.alpha == pytest.approx(direct[:, 1])
    for rates in ("onsets", "alpha"):
        value = curve.alpha if rates == "alpha" else curve.onsets_per_hour
        low, high = getattr(curve, f"{rates}_low"), getattr(curve, f"{rates}_high")
        assert (low <= value + 1e-9).all() and (value <= high + 1e-9).all()


@CURVES
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_the_alarm_is_the_lowest_threshold_within_the_budget(seed: int, budget: float, share: float) -> None:
    quiet = levels(seed, 4)
    streams, curve = [one for _, one in quiet], measured_curve(quiet)
    least, most = 3.0 / curve.hours, float(curve.onsets_per_hour[-1])
    assume(most > least)
    asked = least + budget * (most - least)
    alarm = curve.for_budget(asked)
    assert counted(streams, alarm.threshold_nats)[0] <= asked * (1.0 + 1e-9)
    assert (curve.onsets_per_hour[curve.threshold_nats < alarm.threshold_nats] > asked).all()
    assert alarm.promise is not None and alarm.onsets_per_hour == asked and alarm.asked_alpha is None
    known = curve.alpha[curve.onsets_per_hour * curve.hours >= 3.0 - 1e-9]
    asked = float(known[0] + share * (known[-1] - known[0]))
    alarm = curve.for_alpha(asked)
    assert counted(streams, alarm.threshold_nats)[1] <= asked * (1.0 + 1e-9)
    assert (curve.alpha[curve.threshold_nats < alarm.threshold_nats] > asked).all()
    assert alarm.asked_alpha == asked and alarm.promise == curve.for_alpha(alarm.promise.alpha).promise
    for wrong in (0.99 * least, 1.01 * most, -1.0, math.nan):
        with pytest.raises(InvalidArgumentError, match=r"budget: expected .* onsets per hour"):
            curve.for_budget(wrong)
    for wrong in (0.99 * float(known[0]), 1.01 * float(known[-1]), math.nan):
        with pytest.raises(InvalidArgumentError, match=r"alpha: expected .* of the hops"):
            curve.for_alpha(wrong)


@CURVES
@given(st.integers(0, 2**32 - 1), st.integers(3, 7), st.floats(60.0, 1200.0))
def test_budgets_for_other_junctions_hold_on_left_out_ones(seed: int, junctions: int, rate: float) -> None:
    # This holds for any streams, on average over the junctions that are left out.
    quiet, rates = levels(seed, junctions), list[float]()
    there = {name: [levels for junction, levels in quiet if junction == name] for name, _ in quiet}
    for name in there:
        others = [one for one in quiet if one[0] != name]
        alarm = measured_curve(others, elsewhere=True).default(rate)
        rates.append(min(counted(there[name], alarm.threshold_nats)[0], LOUDEST * rate))
    assert np.mean(rates) <= rate * (1.0 + 1e-9)
    curve = measured_curve(quiet, elsewhere=True)
    losses = [[counted(one, level)[0] for level in curve.threshold_nats.tolist()] for one in there.values()]
    assert (np.maximum(curve.onsets_low, curve.onsets_per_hour) <= curve.onsets_high).all()
    # Another implementation of the same bound. Merged alarms are one, so the maximum so far counts.
    worst = np.maximum.accumulate(np.minimum(losses, LOUDEST * rate), axis=1) / (LOUDEST * rate)
    points = np.arange(worst.shape[1], dtype=float)
    _, bound = get_r_hat_plus(worst, points, "crc", None, None, None)
    kept = find_best_predict_param(points, bound, np.array([1.0 / LOUDEST * (1.0 + 1e-9)]))[0]
    assert curve.default(rate).threshold_nats == curve.threshold_nats[int(kept)]


@given(st.integers(0, 2**32 - 1), st.integers(2, 60))
def test_budgets_are_monotone_in_the_onsets(seed: int, junctions: int) -> None:
    rng = np.random.default_rng(seed)
    counts = rng.poisson(0.02, (junctions, 200)).cumsum(axis=1)
    budgets = budgets_elsewhere(counts / rng.uniform(0.01, 0.3, (junctions, 1)))
    assert (np.diff(budgets, prepend=0.0) >= 0.0).all()


OF_A_MODEL = {
    "reading_s": st.floats(0.05, 2.0),
    "reading_gain": st.floats(0.5, 1.5),
    "death": st.floats(0.01, 0.3),
}


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(-2.0, 1.0), st.fixed_dictionaries(OF_A_MODEL))
def test_levels_of_a_stream_reproduce_the_advisories_of_the_filter(
    seed: int, threshold_nats: float, numbers: dict[str, float]
) -> None:
    rng, of_model = np.random.default_rng(seed), replace(StreetModel(), **numbers)
    groups = np.exp(rng.normal(0.0, 0.4, (150, 2, len(GROUPS))).cumsum(axis=0))
    share = np.full(len(GROUPS), 1.0 / len(GROUPS))

    def measured(alarm: SequenceAlarm) -> Iterator[Measurement]:
        for hop, one in enumerate(groups / groups.sum(axis=-1, keepdims=True), 1):
            reading = SequenceReading(one, share, 0.1, alarm)
            yield replace(street.heard(hop, None, Unqueried("no camera")), sequence=reading)

    def states(alarm: SequenceAlarm) -> Iterator[WorldState]:
        world = WorldFilter(settings=FilterSettings(street=of_model))
        for one in measured(alarm):
            world = world.update(one)
            yield world.state

    told = advised(states(SequenceAlarm(threshold_nats, 20.0))).any(axis=1)
    model = replace(read_model(), street=of_model)
    with pytest.MonkeyPatch.context() as patch:  # The filter gets the measurements of `measured`.
        patch.setattr(commission, "stream_evidence", lambda windows, stream: None)
        patch.setattr(
            alarm_curve, "measurements", lambda stream, windows, silent, *_, **__: measured(silent.alarm)
        )
        levels = commission.levels_of(model, heard([]))
    np.testing.assert_array_equal(raised_at(levels, threshold_nats), told)


def test_inconsistent_curves_raise_an_error() -> None:
    good = measured_curve(levels(1, 3))
    onsets = good.onsets_per_hour
    wrong = [("onsets_per_hour", onsets[:-1]), ("onsets_per_hour", onsets[::-1]), ("hours", 0.0)]
    wrong += [("threshold_nats", good.threshold_nats[::-1]), ("alpha_high", good.alpha_high + 1.0)]
    for name, value in wrong:
        with pytest.raises(InvalidArgumentError, match=name):
            replace(good, **{name: value})


def test_two_quiet_junctions_give_a_threshold_without_alarms_and_one_gives_none() -> None:
    quiet = levels(7, 2)
    curve, streams = measured_curve(quiet, elsewhere=True), [one for _, one in quiet]
    assert curve.onsets_per_hour.max() == 0.0
    assert counted(streams, curve.default(20.0).threshold_nats) == (0.0, 0.0)
    with pytest.raises(InvalidArgumentError, match="at least 2 junctions, got 1"):
        measured_curve(levels(0, 1, 3), elsewhere=True)


def test_the_interval_of_a_curve_has_its_stated_coverage() -> None:
    rng, inside = np.random.default_rng(6), list[bool]()
    for _ in range(100):
        # The rates of sixteen junctions are gamma distributed; their deviation is half of their mean.
        often, hops = rng.gamma(4.0, 0.001, 16), [1500] * 12 + [8000] * 4
        streams = [
            np.where(rng.random(n) < p, rng.exponential(1.0, n), -50.0)
            for n, p in zip(hops, often.tolist(), strict=True)
        ]
        curve = measured_curve((str(j), row) for j, row in enumerate(streams[:12]))
        at = int(np.sum(curve.threshold_nats > 0.0)) - 1
        rate, _ = counted(streams[12:], float(curve.threshold_nats[at]))
        inside.append(bool(curve.onsets_low[at] <= rate <= curve.onsets_high[at]))
    assert 0.88 <= np.mean(inside) <= 0.99


def test_a_vehicle_missed_in_the_last_second_ranks_as_empty() -> None:
    streams = [examined(heard(VEHICLES[:2]), [(7.5, 9.9, 0)]), examined(heard([]), [])]
    found = [examine(streams)[f"auroc_{one}"] for one in ("last_second", "1s_before", "3s_before")]
    assert found == pytest.approx([0.75, 0.75, 0.5], abs=0.01)
    assert examine(streams[:1])["auroc_last_second"] is None


def test_junctions_and_exams_share_no_random_draws() -> None:
    plans = [CommissionSettings(seed=seed, junctions=40) for seed in (1, 2)]
    learned, exams = (
        {one.name: one.seed for plan in plans for one in streams(plan)}
        for streams in (learned_streams, exam_streams)
    )
    # Approaches and the hazard-free stream of a junction have different traffic and one seed.
    # The same number of junctions per renderer, each with and without weather.
    assert len(set(learned.values())) == 2 * 2 * 3 * 40 and len(set(exams.values())) == 2 * (5 + 5 + 5)
    assert not set(learned.values()) & set(exams.values())
    assert not {one.split("-")[0] for one in learned} & {one.split("-")[0] for one in exams}


def test_training_varies_the_weather_and_the_exam_does_not() -> None:
    learned, exam = learned_streams(CommissionSettings()), exam_streams(CommissionSettings())
    came = {flow for one in learned for flow, rate in one.traffic.per_hour.items() if rate}
    assert came >= {"left", "both", "queue", "stops", "turns_away", "far", "distant", "leaves", "stands"}
    for renderer in "STM":
        mine = [one for one in learned if one.site.name[0] == renderer]
        varied = [one for one in mine if one.preset != exam[0].preset]
        assert sum(one.minutes for one in varied) == pytest.approx(2 / 3 * sum(one.minutes for one in mine))
        assert np.ptp([one.background_db for one in varied]) > 10.0
        assert all(one.traffic.sounds["wind"] for one in varied)
    assert any(one.rain_db is not None for one in learned)
    assert {one.traffic.name for one in exam} == {"pairs", "no-hazard"}
    assert all(one.drawn_preset == one.preset and one.rain_db is None for one in exam)


def test_drives_of_a_moving_ego_all_differ() -> None:
    chosen = CommissionSettings(moving_ego=True, junctions=3, approach_minutes=1.5, hazard_free_minutes=1.0)
    learned, exam = learned_streams(chosen), exam_streams(chosen)
    assert {one.site.name for one in exam} > {"DA1", "DA2", "DB1", "DB2", "DB3"}
    assert not any(one.ego.stands for one in (*learned, *exam))
    for streams in (learned, exam):
        number = Counter((one.site.renderer, one.traffic.name) for one in streams)
        for traffic in ("approaches", "no-hazard"):
            assert len({number[renderer, traffic] for renderer in ("paths", "rays", "mirrors")}) == 1
    for traffic, minutes in (("approaches", 3 * 4.5), ("no-hazard", 3 * 3.0)):
        drives = [one.minutes for one in learned if one.traffic.name == traffic]
        assert sum(drives) == pytest.approx(minutes)
    # An approach and a hazard-free drive share a seed and have different traffic.
    assert len({one.seed for one in learned}) == 3 * 3 * 5
    assert not {one.seed for one in learned} & {one.seed for one in exam}


def passing(bearing_deg: float) -> HeardStream:
    """Return a stream with a vehicle at 45 degrees, 7 m, for 1 s, and a fainter one at -90 degrees."""
    time_s = np.round(np.arange(1.0, 3.0, 0.1), 1)
    places = ((1, 5.0, 5.0, 70.0), (2, 0.0, -9.0, 60.0))
    rows = [(number, t, x, y, t < 2.0, level) for number, x, y, level in places for t in time_s]
    hops = {"time_s": time_s, "bearing_rad": np.full(len(time_s), np.radians(bearing_deg))}
    return heard_stream([], rows, hops)


def test_bearings_are_compared_with_the_loudest_vehicle_in_view() -> None:
    unseen = passing(48.0)
    assert in_view_bearings([unseen])["bearing_error_deg"] == pytest.approx(3.0)
    two_to_one = [unseen, passing(38.0), passing(38.0)]
    assert in_view_bearings(two_to_one)["bearing_error_deg"] == pytest.approx(7.0)
    nobody = replace(unseen, rows=unseen.rows.replace(in_view=np.zeros(len(unseen.rows), bool)))
    assert in_view_bearings([nobody]) == dict.fromkeys(in_view_bearings([unseen]))


def test_a_clock_offset_equals_the_turn_of_a_vehicle() -> None:
    turning = passing(0.0)
    azimuth = np.radians(30.0) * turning.rows.time_s
    rows = turning.rows.replace(x_m=7.0 * np.cos(azimuth), y_m=7.0 * np.sin(azimuth))
    found = in_view_bearings([replace(turning, rows=rows)])
    assert found["offset_50ms_deg"] == pytest.approx(1.5)
    assert found["offset_50ms_95_deg"] == pytest.approx(1.5)
