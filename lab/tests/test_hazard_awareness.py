"""Awareness from known decisions, curves of beta from known counts, and the choice of recordings."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from worldstate_lab.degradation.awareness import hazard_awareness
from worldstate_lab.degradation.beta_curves import beta_curves, counts_of, counts_table
from worldstate_lab.degradation.conditions import CLEAN, FAMILIES, OFF, all_conditions
from worldstate_lab.degradation.degradation_study import sweep_data
from worldstate_lab.metrics.intervals import stratified_draws

from worldstate.adapters.camera.camera_health import LEVELS
from worldstate.adapters.camera.miss_rates import FamilyCounts
from worldstate.adapters.camera.video import VIDEO_NAME
from worldstate.adapters.datasets.ovad import DETECTION_NAMES, Recording
from worldstate.ground.errors import InvalidArgumentError
from worldstate.operations.metrics.approach_table import poisson_interval
from worldstate.operations.recordings.hop_table import ABSENT, PRESENT, UNQUERIED, HopTable

PRIOR = (0.25,) * 4
HOPS, T0_S = 60, 4.0
STATES = {state.name: state for state in all_conditions()}
BETA = dict(zip(LEVELS, (0.05, 0.3, 0.6, 0.9, 1.0), strict=True))
# Factor of the signature's log-likelihoods in rain on the roof.
HEARD = dict(enumerate((1.0, 0.9, 0.6, 0.3, 0.0)))


def beta_of(state):
    return 1.0 if state.family == OFF else BETA[state.camera.degradation]


def staged(number, approach, rng, hearing=3.0):
    """Return a signature that is usually correct, and a camera that misses with probability beta."""
    time_s = 1.0 + 0.1 * np.arange(HOPS)
    hidden, visible = approach & (time_s > 2.0) & (time_s <= T0_S), approach & (time_s > T0_S)
    clear = np.zeros((HOPS, 4))
    clear[:, 3] += 0.5 * hearing * ~(hidden | visible)
    clear[:, 0] += hearing * hidden
    clear[:, 2] += hearing * visible
    noise, luck = rng.normal(0.0, 0.7, (HOPS, 4)), rng.random(HOPS)
    tables = {}
    for name, state in STATES.items():
        off, likelihoods = state.family == OFF, HEARD[state.sound_level] * clear + noise
        found = (luck >= beta_of(state)) & visible & (not off)
        odds = np.logaddexp.reduce(likelihoods[:, :3], axis=1) - likelihoods[:, 3]
        columns = {
            "time_s": time_s, "there": visible, "log_likelihoods": likelihoods, "found": found, "seen": found,
            "answer": np.full(HOPS, UNQUERIED) if off else np.where(found, PRESENT, ABSENT),
            "miss_rate": np.full(HOPS, np.clip(beta_of(state), 0.02, 0.98)),
            "clutter_rate": np.full(HOPS, 0.01), "degradation": np.full(HOPS, state.degradation),
            "presence": 1.0 / (1.0 + np.exp(-odds)),
        }  # fmt: skip
        label, t0_s = ("left", T0_S) if approach else ("none", float("nan"))
        tables[name] = HopTable(columns, f"r{number}", label, t0_s, {"site": f"SA{number % 3}"})
    return tables


def changed(one, **columns):
    """Return the same recording with other columns in every condition."""
    return {state: table.replace(**columns) for state, table in one.items()}


def row_of(found, name):
    return next(one for one in found.rows if one.condition.name == name)


def judged(corpus):
    kinds = [one[CLEAN].hazard_free for one in corpus]
    draws = stratified_draws(kinds, np.random.default_rng(1), draws=200)
    return hazard_awareness(corpus, PRIOR, 3, draws, np.random.default_rng(0))


@pytest.fixture(scope="module")
def corpus():
    rng = np.random.default_rng(5)
    return [staged(i, i % 2 == 0, rng) for i in range(24)]


@pytest.fixture(scope="module")
def found(corpus):
    return judged(corpus)


def test_vision_alone_decreases_as_one_minus_beta_and_awareness_does_not(found):
    assert [row.condition.name for row in found.rows] == list(STATES)
    for row in found.rows:
        assert row.vision.value == pytest.approx(1.0 - beta_of(row.condition), abs=0.06)
        assert row.awareness.value >= row.vision.value
        for figure in (row.vision, row.awareness, row.false_alarms_per_hour, row.false_awareness_per_hour):
            assert figure.low <= figure.value <= figure.high
    blind = row_of(found, "noise 1")
    assert blind.vision == (0.0, 0.0, 0.0)
    assert blind.awareness.value == pytest.approx(row_of(found, OFF).awareness.value)
    assert blind.awareness.value > 0.6
    assert 0.0 < row_of(found, "blur 0.5").awareness.high - row_of(found, "blur 0.5").awareness.low < 0.5


def test_awareness_is_counted_as_it_is_defined(corpus):
    """Compared with loops over the hops, with thresholds that every value, or none, exceeds."""
    for level, heard in ((2.0, False), (-1.0, True)):
        levels = [0.5 if one[OFF].hazard_free else level for one in corpus]
        bent = [changed(one, presence=np.full(HOPS, at)) for one, at in zip(corpus, levels, strict=True)]
        for row in judged(bent).rows[::5]:
            aware = []
            for one in (bent_one[row.condition.name] for bent_one in bent):
                for i, time_s in enumerate(one.time_s):
                    if not one.hazard_free and time_s > one.t0_s + 1e-6 and one.there[i]:
                        aware.append(bool(one.found[i] or not heard))
            assert row.awareness.value == pytest.approx(np.mean(aware))


def test_false_alarms_keep_the_budget_of_the_clean_recording(found, corpus):
    """The statistic falls as absence becomes weaker, and a detector without clutter adds no awareness."""
    clean, hours = row_of(found, CLEAN), found.hazard_free_hours
    dry = [row for row in found.rows if not row.condition.sound_level]
    assert all(row.false_alarms_per_hour.value <= clean.false_alarms_per_hour.value + 1e-9 for row in dry)
    assert hours == pytest.approx(sum(one[CLEAN].hazard_free for one in corpus) * HOPS * 0.1 / 3600.0)
    onsets = round(clean.false_awareness_per_hour.value * hours)
    assert clean.false_awareness_per_hour[1:] == pytest.approx(poisson_interval(onsets, hours))
    assert clean.false_awareness <= 0.06


def test_false_detections_are_false_awareness_and_not_awareness_of_the_vehicle(found, corpus):
    raving = judged([changed(one, seen=np.ones(HOPS, bool)) for one in corpus])
    assert [row.awareness for row in raving.rows] == [row.awareness for row in found.rows]
    assert {row.any_detection for row in raving.rows} == {row.false_awareness for row in raving.rows} == {1.0}


def test_a_common_cause_costs_more_than_each_effect_alone(found):
    """Lens or roof alone cost little, because the other sensor remains; together they cost half."""
    harshest = found.common_cause[-1]
    assert harshest.roof.value > 0.9
    assert harshest.lens.value > 0.6
    assert harshest.rain.value < 0.5
    clean = row_of(found, CLEAN).awareness.value
    assert harshest.additive.value == pytest.approx(harshest.lens.value + harshest.roof.value - clean)
    assert harshest.optimism.value == pytest.approx(harshest.additive.value - harshest.rain.value)
    assert harshest.optimism.low > 0.2
    assert [one.noise_db for one in found.common_cause] == [-20.0, -10.0, 0.0, 10.0]
    assert row_of(found, "rain 1").vision == row_of(found, "lens 1").vision


def test_if_the_sound_alone_is_sufficient_the_effects_add_up(corpus):
    deaf = [changed(one, presence=np.where(one[CLEAN].there, 2.0, 0.5)) for one in corpus]
    assert all(cause.optimism == (0.0, 0.0, 0.0) for cause in judged(deaf).common_cause)


def counts(misses, looks=40):
    """Return the same counts for every family; rows are azimuth bins."""
    misses = tuple(map(tuple, misses))
    there = tuple((looks,) * len(LEVELS) for _ in misses)
    return dict.fromkeys(FAMILIES, FamilyCounts(there, misses, (10,) * 5, (1,) * 5))


RISING = [[2, 8, 20, 30, 40], [4, 10, 22, 32, 40], [6, 12, 24, 34, 40], [8, 14, 26, 36, 40]]


def test_beta_is_misses_over_looks_with_the_spread_over_recordings():
    draws = stratified_draws([0] * 6, np.random.default_rng(0))
    curves = beta_curves([counts(RISING)] * 6, draws)
    assert curves.by_azimuth.value[1] == pytest.approx(np.array(RISING) / 40.0)
    assert curves.overall.value[2] == pytest.approx(np.mean(RISING, axis=0) / 40.0)
    assert curves.overall.low == pytest.approx(curves.overall.high)  # Equal recordings have no spread
    assert curves.falls == ()
    other = [[40 - miss for miss in row] for row in RISING]
    mixed = beta_curves([counts(RISING)] * 3 + [counts(other)] * 3, draws)
    assert mixed.overall.value == pytest.approx(0.5)
    assert (mixed.overall.high - mixed.overall.low)[:, 0].min() > 0.4


def test_a_decrease_of_beta_is_listed_with_its_size():
    bent = [row[:] for row in RISING]
    for row in bent:
        row[3] = row[2] - 10
    draws = stratified_draws([0] * 4, np.random.default_rng(0))
    falls = beta_curves([counts(bent)] * 4, draws).falls
    assert {fall.where for fall in falls} == {f"{family} 0.5 to 0.75" for family in FAMILIES}
    assert all(fall.by == pytest.approx(0.25) and fall.certain for fall in falls)
    sideways = beta_curves([counts(RISING[::-1])] * 4, draws).falls
    assert "clean, 0-10 deg to 10-20 deg" in {fall.where for fall in sideways}
    assert {fall.along for fall in sideways} == {"azimuth"}


@given(st.lists(st.lists(st.integers(0, 40), min_size=5, max_size=5), min_size=4, max_size=4))
def test_counts_are_preserved_in_the_table(misses):
    assert counts_of(counts_table(counts(misses))) == counts(misses)


def recording(root, site, label, number, filmed=True):
    folder = Path(root) / site / label / f"{label}{site}{number}"
    folder.mkdir(parents=True)
    for name in (DETECTION_NAMES[0], VIDEO_NAME)[: 1 + filmed]:
        (folder / name).touch()
    return Recording(folder, folder.name, site, label, 40)


def test_recordings_are_chosen_evenly_and_missing_ones_are_listed(tmp_path):
    sites, sides = ("SA1", "SA2", "SB1", "SB2", "SB3"), ("left", "right", "none")
    whole = [recording(tmp_path, site, side, n) for site in sites for side in sides for n in range(4)]
    moving, dark = recording(tmp_path, "DA1", "left", 0), recording(tmp_path, "SA1", "left", 9, filmed=False)
    chosen, missing = sweep_data([*whole, moving])
    assert missing == [] and len(set(chosen)) == 24
    by_site = [sum(one.environment == site for one in chosen[:12]) for site in sites]
    assert sorted(by_site) == [2, 2, 2, 3, 3]
    assert {one.label for one in chosen[12:]} == {"none"}
    with pytest.raises(InvalidArgumentError) as refused:
        sweep_data([*whole[:2], dark, moving], approaches=3, hazard_free=2)
    assert str(refused.value).split("; ")[1:] == [
        f"1 of 3 approaches with video are missing: no {VIDEO_NAME} or no detections beside leftSA19",
        "2 of 2 hazard-free recordings with video are missing",
    ]
