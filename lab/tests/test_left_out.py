"""A renderer left out: none of its streams is in the training, and its row matches loops over known
alarms."""

import json
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_summed_scores import stream
from worldstate_lab.cli import left_out
from worldstate_lab.cli.left_out import learned_without, renderer_figures
from worldstate_lab.cli.main import main

from worldstate.abduction.sequence.sequence_model import GROUPS, HELD_HOPS, HORIZONS_S, SequencePosterior
from worldstate.commissioning import commission
from worldstate.commissioning.commission import own_windows, windows_to_learn
from worldstate.commissioning.heard_stream import CommissionSettings, HeardStream, learned_streams
from worldstate.commissioning.sequence_training import stream_truth
from worldstate.commissioning.stream_exam import ExaminedStream, smoothed_log_odds
from worldstate.frontend.array.microphone_array import ovad_array
from worldstate.operations.recordings.hop_table import HopTable

HAZARDS = (("left", 12.0), ("right", 25.0), ("left", 38.0))
FEW = CommissionSettings(junctions=3)


def made_up(site, traffic, seed, vehicles=HAZARDS, duration_s=46.0):
    """Return a stream of `test_summed_scores` at a site, with vehicles in view for two seconds after T0."""
    one, rng = stream(vehicles, seed, duration_s), np.random.default_rng(seed)
    n, names = len(one.hops), ("vehicle", "time_s", "x_m", "y_m", "in_view", "loudness_db")
    rows = [
        (number, t0_s + 0.1 * i, 8.0, 1.0, i > 0, 60.0)
        for number, (_, t0_s) in enumerate(vehicles)
        for i in range(-50, 20)
    ]
    columns = [
        np.array([row[i] for row in rows], bool if name == "in_view" else float)
        for i, name in enumerate(names)
    ]
    hops = one.hops.replace(
        **{"feature": rng.uniform(0.5, 1.5, (n, 60)), "bearing_std_rad": np.full(n, 0.1)},
        **{"heard": np.ones(n), "unheard": np.full(n, ""), "excess_db": np.zeros(n)},
        about={"site": site, "traffic": traffic},
    )
    told = one.vehicles.replace(flow=one.vehicles.arm, kind=np.array(["light"] * len(vehicles), np.str_))
    return HeardStream(hops, told, HopTable(dict(zip(names, columns, strict=True))))


def streets(seed):
    """Return a short stream of each kind in the plan."""
    return [
        made_up(one.site.name, one.traffic.name, [seed, i], *(((), 20.0) if one.traffic.hazard_free else ()))
        for i, one in enumerate(learned_streams(FEW))
    ]


@pytest.fixture
def quick(monkeypatch):
    """Two folds, noise for open-field windows, and an alarm from the sequence alone: no filter runs."""
    rng = np.random.default_rng(9)
    monkeypatch.setattr(commission, "FOLDS", 2)
    monkeypatch.setattr(commission, "open_field_features", lambda *given: rng.uniform(0.5, 1.5, (12, 60)))
    levels = lambda model, found: smoothed_log_odds(model.posterior(found))  # noqa: E731
    monkeypatch.setattr(commission, "_quiet_levels", lambda calm: levels(calm[2], calm[3]))
    monkeypatch.setattr(left_out, "stream_states", lambda heard, windows, model, found: levels(model, found))
    monkeypatch.setattr(left_out, "alarm_levels", lambda found: found)


@pytest.mark.long
def test_training_does_not_depend_on_the_left_out_streams(quick, renderer="rays"):
    every, others = streets(1), streets(2)
    own, rng = own_windows(ovad_array(), FEW, None), np.random.default_rng(FEW.seed)
    _, fit = windows_to_learn(ovad_array(), FEW, *own, rng)

    def learned(changed):
        mixed = [other if changed(one) else one for one, other in zip(every, others, strict=True)]
        windows, sequence = learned_without(renderer, mixed, fit, FEW)
        return windows.posteriors(*heard), sequence.trees.value, sequence.alarm.threshold_nats

    rng = np.random.default_rng(3)
    heard = np.log(rng.uniform(0.5, 1.5, (20, 60))), rng.normal(size=(20, 180))
    as_they_are = learned(lambda one: False)
    np.testing.assert_equal(learned(lambda one: one.renderer == renderer), as_they_are)
    inside = next(one for one in every if one.renderer != renderer)
    with pytest.raises(AssertionError):
        np.testing.assert_equal(learned(lambda one: one is inside), as_they_are)


@pytest.mark.long
def test_the_command_has_a_row_for_each_renderer(quick, monkeypatch, tmp_path):
    monkeypatch.setattr(left_out, "heard_streams", lambda plan, *rest: iter(streets(1)))
    results = tmp_path / "results.json"
    assert main(["left-out", "--streams", str(tmp_path), "--junctions", "3", "--results", str(results)]) == 0
    ((key, kept),) = json.loads(results.read_text()).items()
    assert key.startswith("left-out") and list(kept["figures"]["left_out"]) == ["mirrors", "paths", "rays"]
    for found in kept["figures"]["left_out"].values():
        assert found["approaches"] == 2 * FEW.junctions * len(HAZARDS) and found["onsets_per_hour"] <= 30.0


def alarms(levels, threshold):
    """Return by a loop whether each side is in alarm: at the threshold, and for one second after."""
    on = np.zeros(levels.shape, bool)
    for side in (0, 1):
        for i in range(len(levels)):
            on[i, side] = any(levels[max(i - HELD_HOPS, 0) : i + 1, side] >= threshold)
    return on


def onsets(on):
    either = [False, *on.any(axis=1).tolist()]
    return sum(now and not was for was, now in pairwise(either))


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([60.0, 150.0, 400.0]))
def test_a_row_is_counted_as_loops_count_it(seed, budget):
    rng, judged = np.random.default_rng(seed), []
    plan = [("SA101", "town", HAZARDS), ("SB101", "town", HAZARDS), ("SA101", "no-hazard", ())]
    for site, traffic, vehicles in [*plan, ("SB101", "no-hazard-varied", ()), ("SB101", "misleading", ())]:
        heard = made_up(site, traffic, seed, vehicles, 46.0 if vehicles else 25.0)
        n = len(heard.hops)
        levels = np.round(rng.normal(size=(n, 2)).cumsum(axis=0), 3)
        groups = rng.dirichlet(np.ones(len(GROUPS)), (n, 2))
        read = ExaminedStream(
            heard, stream_truth(heard), SequencePosterior(groups, 0.0), np.zeros((n, 2), bool)
        )
        judged.append((read, levels))
    learned_nats = float(rng.normal())
    row = renderer_figures(judged, budget, learned_nats)

    def rate(threshold, some):
        hours = sum(len(levels) for _, levels in some) / 36_000.0
        return sum(onsets(alarms(levels, threshold)) for _, levels in some) / hours

    calm = judged[2:4]
    assert row["onsets_per_hour"] == pytest.approx(rate(row["threshold_nats"], calm))
    assert row["onsets_per_hour"] <= budget
    # It is no higher than the budget requires: a threshold exceeded by 3 % more hops has more onsets.
    highest = np.sort(np.concatenate([levels.max(axis=1) for _, levels in calm]))[::-1]
    reached = int((highest >= row["threshold_nats"]).sum())
    lower = highest[reached : int(1.03 * reached) + 2]
    assert reached > 0.29 * len(highest) or max(rate(one, calm) for one in lower) > budget
    assert row["misleading_onsets_per_hour"] == pytest.approx(rate(row["threshold_nats"], judged[4:]))
    assert row["learned_alarm_onsets_per_hour"] == pytest.approx(rate(learned_nats, calm))

    detected, last_second, at_t0, right, no_wall, leads = [], [], [], [], [], []
    for read, levels in judged[:2]:
        on, time_s = alarms(levels, row["threshold_nats"]), read.heard.hops.time_s
        for arm, t0_s in HAZARDS:
            before = np.flatnonzero((time_s > t0_s - 8.0) & (time_s < t0_s - 0.001))
            first = next((i for i in before if on[i].any()), None)
            detected.append(first is not None)
            no_wall += [first is not None] if read.heard.site == "SB101" else []
            last_second.append(on[before[time_s[before] > t0_s - 1.0]].any())
            at_t0.append(on[before[-1]].any())
            if first is not None:
                own = {"left": 0, "right": 1}[arm]
                right.append(
                    on[first, own] and not (on[first].all() and levels[first, 1 - own] > levels[first, own])
                )
                leads.append(t0_s - time_s[first])
    assert row["approaches"] == len(detected) and row["detected"] == np.mean(detected)
    assert (row["advised_last_second"], row["advised_at_t0"]) == (np.mean(last_second), np.mean(at_t0))
    assert (row["no_wall_approaches"], row["no_wall_detected"]) == (len(no_wall), np.mean(no_wall))
    assert row["side_approaches"] == len(right)
    assert row["side_right"] == (np.mean(right) if right else None)
    assert row["lead_s"] == (pytest.approx(np.mean(leads)) if leads else None)
    for horizon_s in (1.0, 2.0, 3.0):
        chances = np.concatenate(
            [one.posterior.within()[..., HORIZONS_S.index(horizon_s)].ravel() for one, _ in judged]
        )
        comes = np.concatenate([(one.truth.coming_s <= horizon_s).ravel() for one, _ in judged])
        skill = 1.0 - np.mean((chances - comes) ** 2) / np.var(comes)
        assert row[f"skill_{horizon_s:g}s"] == pytest.approx(skill)
