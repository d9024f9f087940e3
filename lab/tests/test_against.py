"""Comparison of two evaluations from their saved scores."""

import json
from dataclasses import replace

import numpy as np
import pytest
from made_up_trials import alarmed, made_up, random_study
from numpy.testing import assert_equal
from worldstate_lab.evaluation.against import compare, load_scores, save_scores
from worldstate_lab.evaluation.scores import Score, paired
from worldstate_lab.metrics.intervals import stratified_draws
from worldstate_lab.trials.trial import Trial

from worldstate.ground.errors import InputFileError, InvalidArgumentError, SchemaVersionError

KEY = ("static folds", "proposed (alpha = .02)")


def study(seed, seeds=2):
    trials, passes = random_study(np.random.default_rng(seed), seeds=seeds)
    return trials, passes, Score.of(trials, passes)


def evaluated(folder, score, key=KEY):
    folder.mkdir(exist_ok=True)
    save_scores(folder, {key[0]: {key[1]: score}})
    return folder


@pytest.mark.parametrize("silent", [False, True])
def test_a_file_gives_the_figures_and_draws_of_the_run(tmp_path, silent):
    trials, _, score = study(1)
    if silent:
        score = Score.of(trials, [[alarmed(one, []) for one in trials]])
    ((key, saved),) = load_scores(evaluated(tmp_path / "a", score)).items()
    draws = stratified_draws(score.draw_strata, np.random.default_rng(0), 30)
    # To the last bit: nothing is rounded when saved.
    assert_equal(saved.draws(draws), score.draws(draws))
    assert_equal(saved.intervals(draws), score.intervals(draws))
    assert saved.recordings == score.recordings
    assert key == KEY


def test_a_comparison_is_the_paired_one_on_the_shared_recordings(tmp_path):
    trials, passes, ours = study(2)
    _, others, _ = study(3)
    # The other evaluation lacks two recordings, has one replaced, and has another order.
    changed = trials[4].hops.about | {"fingerprint": "other"}
    heard = [
        *trials[:4],
        Trial(trials[4].hops.replace(about=changed), trials[4].boxes, trials[4].truth),
        *trials[7:],
    ]
    order = [*range(4), 4, *range(7, 15)][::-1]
    place = {name: i for i, name in enumerate(one.name for one in trials)}
    heard = sorted(heard, key=lambda one: order.index(place[one.name]))
    other = Score.of(heard, [[answers[place[one.name]] for one in heard] for answers in others])
    (said,) = compare(
        evaluated(tmp_path / "a", ours), evaluated(tmp_path / "b", other), np.random.default_rng(5), draws=60
    )
    assert (said.protocol, said.method) == KEY
    assert said.shared == 12
    rows = [i for i in range(15) if i not in (4, 5, 6)]
    few = [trials[i] for i in rows]
    a, b = (Score.of(few, [[answers[i] for i in rows] for answers in some]) for some in (passes, others))
    expected = paired(a, b, stratified_draws(a.draw_strata, np.random.default_rng(5), 60))
    for name, values in expected.items():
        np.testing.assert_allclose(said.differences[name], values, rtol=1e-9, atol=1e-9, err_msg=name)


def test_a_better_method_shows_and_an_equal_one_does_not(tmp_path):
    trials = [made_up(f"r{i:02d}", "left" if i < 20 else "none") for i in range(40)]

    def detecting(hits):
        """Return decisions with an alarm two seconds before T0 in the first recordings."""
        return Score.of(
            trials, [[alarmed(one, [(3.0, 4.0)] if i < hits else []) for i, one in enumerate(trials)]]
        )

    better, worse = evaluated(tmp_path / "a", detecting(18)), evaluated(tmp_path / "b", detecting(8))
    (said,) = compare(better, worse, np.random.default_rng(0), draws=200)
    value, low, high = said.differences["detection"]
    assert value == pytest.approx(0.5)
    assert 0.2 < low < value < high < 0.8
    assert said.differences["false_alarms_per_hour"] == (0.0, 0.0, 0.0)
    (same,) = compare(better, better, np.random.default_rng(0), draws=20)
    assert same.differences["detection"] == (0.0, 0.0, 0.0)


def test_incomparable_evaluations_are_rejected_with_the_difference(tmp_path):
    trials, passes, score = study(4, seeds=1)
    ours = evaluated(tmp_path / "ours", score)
    rng = np.random.default_rng(0)
    moving = evaluated(tmp_path / "moving", score, key=("dynamic", "sustained"))
    with pytest.raises(
        InvalidArgumentError, match=r"ours has static folds / proposed .*has dynamic / sustained"
    ):
        compare(ours, moving, rng)
    renamed = [replace(one, hops=one.hops.replace(name=f"new-{one.name}")) for one in trials]
    strangers = evaluated(tmp_path / "strangers", Score.of(renamed, passes))
    with pytest.raises(InvalidArgumentError, match=r"S0/r000, .* and 12 more and the other S0/new-r000"):
        compare(ours, strangers, rng)
    other = [
        replace(one, hops=one.hops.replace(about=one.hops.about | {"fingerprint": "x"})) for one in trials
    ]
    edited = evaluated(tmp_path / "edited", Score.of(other, passes))
    with pytest.raises(InvalidArgumentError, match=r"S0/r000, .* and 12 more differ in their content"):
        compare(ours, edited, rng)


def test_a_protocol_without_shared_recordings_does_not_affect_another(tmp_path):
    trials, passes, score = study(5, seeds=1)
    renamed = [replace(one, hops=one.hops.replace(name=f"new-{one.name}")) for one in trials]
    for name, second in [("a", score), ("b", Score.of(renamed, passes))]:
        (tmp_path / name).mkdir()
        save_scores(tmp_path / name, {KEY[0]: {KEY[1]: score}, "dynamic": {"rule": second}})
    first, second = compare(tmp_path / "a", tmp_path / "b", np.random.default_rng(0), draws=5)
    assert (first.shared, second.shared) == (15, 0)
    assert all(np.isnan(second.differences["detection"]))


def test_unsuitable_folders_and_files_are_rejected(tmp_path):
    _, _, score = study(6, seeds=1)
    with pytest.raises(InputFileError, match="expected a finished evaluation"):
        load_scores(tmp_path)
    folder = evaluated(tmp_path / "a", score)
    # A second evaluation removes the scores of the first.
    evaluated(folder, score, key=("dynamic", "rule"))
    assert list(load_scores(folder)) == [("dynamic", "rule")]
    path = folder / "scores.npz"
    with np.load(path) as arrays:
        values = dict(arrays)
    head = json.loads(str(values.pop(""))) | {"version": 99}
    np.savez(path, **values, **{"": np.array(json.dumps(head))})
    with pytest.raises(SchemaVersionError, match="expected scores of version 2, got 99"):
        load_scores(folder)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InputFileError, match=path.name):
        load_scores(folder)
