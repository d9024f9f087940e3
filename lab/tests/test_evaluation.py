"""Protocols and methods of the evaluation: known results, and no training on test recordings."""

import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import soundfile
from hypothesis import given, settings
from hypothesis import strategies as st
from made_up_trials import made_up
from worldstate_lab.evaluation.evaluation import lacking_data
from worldstate_lab.evaluation.front_end_study import front_end_study
from worldstate_lab.evaluation.protocols import (
    FIXED,
    PROTOCOLS,
    RETRAINED,
    STATIC,
    ProtocolRun,
    methods_for,
    refused_methods,
    run_protocol,
)
from worldstate_lab.evaluation.scores import Score
from worldstate_lab.methods.acoustic_rules import CalibratedCue, PublishedRule
from worldstate_lab.trials import pass_cache
from worldstate_lab.trials.classification import (
    Classifiers,
    classified,
    junction_of,
    posteriors,
    windows_from_table,
)
from worldstate_lab.trials.listening import pass_time_s
from worldstate_lab.trials.pass_cache import Failed, Hearer
from worldstate_lab.trials.trial import Decisions, Take, TakeList, Trial

from worldstate.abduction.signature.site_estimate import SiteSignature
from worldstate.adapters.datasets.feature_table import FeatureTable, write_features
from worldstate.adapters.files.array_file import write_array_xml
from worldstate.adapters.files.model_file import read_model
from worldstate.frontend.array.microphone_array import MicrophoneArray, ovad_array
from worldstate.ground.errors import InvalidArgumentError, OutOfDomainError
from worldstate.operations.recordings.hop_table import ABSENT, HopTable

HOPS = 91
T0_S, PASS_S = 7.0, 8.0
OURS = ("shipped model", "+ site adaptation", "world-state advisory")
PUBLISHED, SUSTAINED = PublishedRule("published"), PublishedRule("sustained", sustained=True)


def told(trial: Trial, hazard: np.ndarray) -> Trial:
    """Return a trial with these probabilities of a vehicle on the left from the published classifier."""
    rest = np.full_like(hazard, 1e-9)
    said = np.log(np.stack([hazard, rest, rest, 1.0 - hazard], axis=1))
    about = {**trial.hops.about, "prior": {"published": [0.25] * 4}}
    return replace(trial, hops=trial.hops.replace(published=said, about=about))


def calm(number: int, rng: np.random.Generator, *, false_alarms: tuple[int, ...] = ()) -> Trial:
    """Return a hazard-free recording with loud windows at the given hops."""
    hazard = rng.uniform(0.05, 0.3, HOPS)
    hazard[list(false_alarms)] = 0.9
    trial = made_up(f"calm{number:02d}", hops=HOPS, site=f"SA{number % 2}", moving=False)
    columns = {
        "answer": np.zeros(HOPS, np.int64),
        "miss_rate": np.ones(HOPS),
        "clutter_rate": np.zeros(HOPS),
        "approach": np.full(HOPS, np.nan),
        "bearing_rad": np.zeros(HOPS),
        "log_slope_hz": rng.normal(0.0, 0.2, HOPS),
        "prominence": np.ones(HOPS),
        "features": 0.1 * rng.lognormal(0.0, 0.2, (HOPS, 60)),
    }
    return told(replace(trial, hops=trial.hops.replace(**columns)), hazard)


def approach(number: int, rng: np.random.Generator, *, lead_s: float) -> Trial:
    """Return an approach audible from `lead_s` before T0 and in view after it, with constant speed."""
    base = calm(number, rng)
    time_s = base.hops.time_s
    late, seen = time_s >= T0_S - lead_s - 1e-6, time_s > T0_S + 1e-6
    left_s = PASS_S - time_s
    about = {**base.hops.about, "pass_s": PASS_S, "doppler": "" if number == 0 else "no stable line"}
    hops = base.hops.replace(
        name=f"left{number:02d}",
        label="left",
        t0_s=T0_S,
        about=about,
        features=np.where(late[:, None], 2.0, 1.0) * base.hops.features,
        prominence=np.where(seen, 1.6, 1.2),
        log_slope_hz=np.where(left_s > 0.3, 2.0 / np.maximum(left_s, 0.3), np.nan),
        reference_rad=np.where(seen, 0.2, np.nan),
        srp_rad=np.where(seen, 0.2 + np.radians(3.0), np.nan),
        music_rad=np.where(seen, 0.2 - np.radians(7.0), np.nan),
    )
    return told(replace(base, hops=hops), np.where(late, 0.95, np.exp(base.hops.published[:, 0])))


@pytest.fixture(scope="module")
def streets() -> list[Trial]:
    rng = np.random.default_rng(3)
    heard = [approach(i, rng, lead_s=2.0) for i in range(10)]
    return heard + [calm(i, rng, false_alarms=(20, 50) if i < 5 else ()) for i in range(10)]


def asked(method, trials: Sequence[Trial]) -> Sequence[Decisions]:
    """Return the decisions of a method on every trial, fitted to the other folds."""
    (said,) = run_protocol(STATIC, trials, [method], None, (0,)).decisions[method.name]
    return said


def figures(method, trials: Sequence[Trial]) -> dict[str, float]:
    return Score.of(trials, [asked(method, trials)]).figures()


def test_rules_on_posteriors_with_known_results(streets):
    at_once, held = figures(PUBLISHED, streets), figures(SUSTAINED, streets)
    assert at_once["detection"] == held["detection"] == 1.0
    assert at_once["lead_s"] == pytest.approx(2.0)
    assert at_once["false_alarms_per_hour"] == pytest.approx(10 / (10 * HOPS * 0.1 / 3600.0))
    # Single windows do not last, so every k works and the smallest is chosen; it costs one hop of lead time.
    assert held["lead_s"] == pytest.approx(1.9)
    assert held["false_alarms_per_hour"] == 0.0
    proposed = figures(CalibratedCue("proposed", 0.02), streets)
    assert proposed["ece"] < proposed["ece_raw"]


def test_a_recording_sets_nothing_that_is_applied_to_it(streets):
    """One loud hazard-free recording raises the thresholds of the others, but not its own."""
    loud = told(streets[10], np.full(HOPS, 0.99))
    said = asked(CalibratedCue("proposed", 0.0), [*streets[:10], loud, *streets[11:]])
    assert said[10].alarm.any()
    assert not any(one.alarm.any() for one in said[11:])


STREETS = st.lists(
    st.tuples(st.sampled_from(["SA1", "SA2", "SB1", "SB2"]), st.sampled_from(["left", "right", "none"])),
    min_size=4,
    max_size=30,
)


@settings(max_examples=40)
@given(kinds=STREETS, seed=st.integers(0, 99))
def test_calibration_recordings_are_not_tested(kinds, seed):
    """Every recording is tested once; a left-out junction occurs in no calibration set."""
    trials = [made_up(f"r{i}", label, hops=3, site=site) for i, (site, label) in enumerate(kinds)]
    every = [Take(Path(t.name), t.name, t.site, t.label, None if t.hazard_free else 5.0) for t in trials]
    for protocol in (STATIC, FIXED, RETRAINED):
        if protocol.lacks(every) is not None:
            continue
        parts = list(protocol.parts(trials, np.random.default_rng(seed)))
        tested = [i for _, some in parts for i in some]
        assert len(tested) == len(set(tested))
        for calibration, some in parts:
            assert not set(calibration) & set(some)
            if protocol.by_junction:
                assert len({junction_of(trials[i].site) for i in some}) == 1
                assert not {trials[i].site for i in calibration} & {trials[i].site for i in some}
        if not protocol.by_junction:
            assert sorted(tested) == list(range(len(trials)))


@pytest.mark.parametrize("protocol", PROTOCOLS, ids=lambda one: one.name)
def test_a_protocol_lists_missing_data(protocol):
    kinds = product(("SA1", "SB1"), ("left", "none"))
    enough = [Take(Path(site), site, site, label, 5.0, protocol.moving) for site, label in kinds]
    assert protocol.lacks(enough) is None
    assert "2 approaches with a T0, found 1" in (protocol.lacks(enough[1:]) or "")
    assert "found 0" in (protocol.lacks([replace(one, moving=not protocol.moving) for one in enough]) or "")


def test_figures_of_few_recordings_come_with_a_caution(streets):
    run = ProtocolRun(STATIC, (*streets[:10] * 2, *streets[10:]), {}, (1,), "all")
    assert run.cautions == ("10 hazard-free recordings: figures from fewer than 20 cannot be read",)


def test_another_classifier_is_applied_to_the_cached_features(streets):
    """Eq. (6) with the shipped classifier, hop by hop, from the cached features and camera answers."""
    signature = read_model().signature
    features = np.random.default_rng(2).uniform(0.05, 0.4, (HOPS, 60))
    asked_of = {"answer": np.full(HOPS, ABSENT), "miss_rate": np.full(HOPS, 0.3)}
    trial = replace(streets[0], hops=streets[0].hops.replace(features=features, **asked_of))
    judged = classified(trial, "ensemble", signature)
    site = SiteSignature(signature)
    joint = np.exp([site.evidence(one).log_likelihoods for one in features]) * signature.reference_prior
    assert np.allclose(posteriors(judged, "ensemble"), joint / joint.sum(axis=1, keepdims=True))
    cue = CalibratedCue("with absence", 0.05, absence=True, evidence="ensemble")
    others = [classified(one, "ensemble", signature) for one in (streets[1], streets[10])]
    joint[:, 2] *= 0.3
    score = cue.fit(others, np.random.default_rng(0))(judged).score
    assert np.allclose(score, joint[:, :2].sum(axis=1) / joint.sum(axis=1))


def table_of(trials: Sequence[Trial]) -> FeatureTable:
    """Return a table with one window of each recording."""
    rows = ((t.hops.features[0], t.label, t.name, t.site) for t in trials)
    features, labels, names, sites = map(np.array, zip(*rows, strict=True))
    return FeatureTable(features, labels, names, sites, names, (None,) * len(names))


def test_windows_of_a_test_recording_are_left_out_or_rejected(streets, tmp_path):
    write_features(tmp_path / "windows.csv", table_of(streets))
    tested = tuple(Take(tmp_path / t.name, t.name, t.site, t.label, T0_S) for t in streets[3:12])
    kept, said = windows_from_table(tmp_path / "windows.csv", TakeList(tmp_path, tested, (), (), False))
    assert set(kept.ids.tolist()) == {t.name for t in (*streets[:3], *streets[12:])}
    assert "9 of test recordings left out" in said
    with pytest.raises(InvalidArgumentError, match="left03"):
        Classifiers(table_of(streets)).classify("all", streets[:3], streets[3:4], 1)
    write_array_xml(tmp_path / "array.xml", MicrophoneArray(ovad_array().positions_m[::7], "ring"))
    with pytest.raises(OutOfDomainError, match=r"windows of another array.*extract-features"):
        windows_from_table(tmp_path / "windows.csv", TakeList(tmp_path, (), (), (), False))


def test_another_model_of_a_moving_ego_processes_its_drives_again(tmp_path, monkeypatch):
    noise = 0.01 * np.random.default_rng(0).standard_normal((60_000, 56))
    soundfile.write(tmp_path / "quiet.wav", noise, 48_000, subtype="FLOAT")
    write_array_xml(tmp_path / "array.xml", ovad_array())
    take, cache = Take(tmp_path / "quiet.wav", "quiet", "quiet", moving=True), tmp_path / "cache"
    Hearer(cache)(take)
    before = read_model(moving_ego=True)
    another = replace(before, provenance=replace(before.provenance, dataset="another"))
    shipped = {False: read_model(), True: another}
    monkeypatch.setattr(pass_cache, "read_model", lambda path, *, moving_ego=False: shipped[moving_ego])
    Hearer(cache)(take)
    assert len(list((cache / "plain").glob("*.npz"))) == 2


@pytest.mark.parametrize(
    ("microphones", "rate_hz", "why"), [(8, 48_000, "not the array of the model"), (56, 5_500, "got 5500 Hz")]
)
def test_a_model_is_not_scored_on_sound_outside_its_domain(microphones, rate_hz, why, tmp_path):
    array = MicrophoneArray(ovad_array().positions_m[:microphones], "roof")
    noise = 0.01 * np.random.default_rng(0).standard_normal((rate_hz * 5 // 4, microphones))
    soundfile.write(tmp_path / "quiet.wav", noise, rate_hz, subtype="FLOAT")
    write_array_xml(tmp_path / "array.xml", array)
    trial = Hearer(tmp_path / "cache")(Take(tmp_path / "quiet.wav", "quiet", "quiet"))
    assert dict(trial.chains) == {} and not {"shipped", "grounded"} & set(trial.hops.columns)
    assert np.isfinite(trial.hops.features).all()
    refused, rows = refused_methods([trial]), {method.name for method in methods_for([trial])}
    assert {*OURS, "shipped scores .02", "grounded .02"} <= set(refused)
    assert all(why in said and "--uncalibrated" not in said for said in refused.values())
    assert {"Vision-only", "published", "proposed .02", "ensemble .02"} <= rows
    assert not rows & set(refused)


def test_unreadable_recordings_are_listed_if_too_few_remain():
    takes = tuple(Take(Path(kind), kind, "SA1", kind, 5.0) for kind in ("left", "none"))
    with pytest.raises(InvalidArgumentError, match=r"found 1 .*; not processed: right: cut short"):
        lacking_data(TakeList(Path("streets"), takes, (), (), False), [Failed("right", "cut short")])


@pytest.mark.parametrize("last_s", [4.5, 3.2])
def test_the_pass_is_extrapolated_with_constant_speed(last_s):
    """The vehicle crosses the axis at 4 s with 6 m/s at 8 m; the images end after it, or before."""
    time_s = np.arange(1.0, last_s, 0.1)
    azimuth = np.arctan2(6.0 * (4.0 - time_s), 8.0)
    truth = HopTable({"time_s": time_s, "vehicle": np.zeros(len(time_s), int), "azimuth_rad": azimuth})
    assert pass_time_s(truth) == pytest.approx(4.0, abs=1e-3)
    assert pass_time_s(truth.replace(time_s=4.0 - time_s)) is None or last_s > 4.0


def test_front_end_figures_of_streets_with_known_results(streets):
    study = front_end_study(streets, np.random.default_rng(0), draws=40)
    found = study.figures
    assert [found[f"bearing_{of}_deg"] for of in ("srp", "gated")] == pytest.approx([3.0, 3.0])
    assert found["bearing_music_deg"] == pytest.approx(7.0)
    assert found["prominence_in_view"] == pytest.approx(1.6)
    assert found["prominence_in_silence"] == pytest.approx(1.0)
    assert found["looming_correlation"] == pytest.approx(1.0)
    assert found["looming_auroc"] > 0.95
    assert found["doppler_usable"] == 1.0
    assert study.frames == 10 * int((streets[0].hops.time_s > T0_S + 1e-6).sum())
    low, high = study.intervals["looming_auroc"]
    assert low <= found["looming_auroc"] <= high


def test_the_method_of_the_documentation_is_added_by_one_line(streets):
    page = Path(__file__).resolve().parents[2] / "docs" / "evidence" / "evaluation.md"
    (program,) = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    names: dict[str, type] = {}
    exec(compile(program, str(page), "exec"), names)
    found = figures(names["Prominent"](), streets)
    # Approaches have a high score throughout here, streets without a vehicle never do.
    assert (found["detection"], found["false_alarms_per_hour"]) == (0.0, 0.0)
    assert found["early_onsets_per_approach"] == 1.0
