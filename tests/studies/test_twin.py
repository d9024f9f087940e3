"""Published figures on simulated recordings: rules on known answers, then four recordings end to end."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hop_tables import blank_recording
from sklearn.metrics import roc_auc_score
from sklearn.metrics import roc_curve as sklearn_roc

from worldstate.abduction.signature.ensemble import EnsembleModel
from worldstate.abduction.signature.site_signature import SiteSignature
from worldstate.adapters.files.model_file import load_model
from worldstate.adapters.simulation import SimulationSettings, preset, simulate_recording, site
from worldstate.adapters.simulation.dataset.plan import plan_static
from worldstate.cli.main import main
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.errors import InputFileError, InvalidArgumentError
from worldstate.ground.serialisation import encode
from worldstate.operations.recordings.hop_stream import ABSENT
from worldstate.operations.recordings.hop_table import load_tables, save_tables
from worldstate.studies.streets.decision_rules import deal, score_rules
from worldstate.studies.streets.figure import roc_curve, write_comparison_figure
from worldstate.studies.streets.front_end_run import pass_time_s
from worldstate.studies.streets.published_figures import figure_intervals, published_figures, rule_figures
from worldstate.studies.streets.recording_features import classified, decisions
from worldstate.studies.streets.report import TARGETS, comparison_report, comparison_table
from worldstate.studies.streets.simulated_streets import StreetSettings
from worldstate.studies.streets.simulated_windows import simulated_windows
from worldstate.studies.streets.street_training import train_on_simulation

PAIR = MicrophoneArray([[0.0, 0.2, 0.0], [0.0, -0.2, 0.1]])
HOPS = 91
T0_S, PASS_S = 7.0, 8.0


def posteriors(hazard):
    """Left carries the hazard, the rest is none."""
    left = np.asarray(hazard, dtype=float)
    return np.stack([left, 0 * left, 0 * left, 1.0 - left], axis=1)


def calm(number, rng, *, false_alarms=()):
    """A hazard-free recording, its single loud windows where told."""
    hazard = rng.uniform(0.05, 0.3, HOPS)
    hazard[list(false_alarms)] = 0.9
    blank = blank_recording(f"{number:04d}", HOPS)
    slope = rng.normal(0.0, 0.2, HOPS)
    about = blank.about | {"site": f"S{number % 5}"}
    return blank.replace(about=about, log_slope_hz=slope, **decisions(posteriors(hazard), hazard))


def approach(number, rng, *, lead_s):
    """Heard from `lead_s` before T0 on, in view after it, the slope as for constant speed."""
    base = calm(number, rng)
    late = base.time_s >= T0_S - lead_s - 1e-6
    hazard = np.where(late, 0.95, base.statistic)
    seen = base.time_s > T0_S + 1e-6
    left_s = PASS_S - base.time_s
    doppler = "" if number == 0 else "no stable line"
    return base.replace(
        label="left",
        t0_s=T0_S,
        about=base.about | {"pass_s": PASS_S, "doppler": doppler},
        **decisions(posteriors(hazard), hazard),
        prominence=np.where(seen, 1.6, 1.2),
        log_slope_hz=np.where(left_s > 0.3, 2.0 / np.maximum(left_s, 0.3), np.nan),
        reference_rad=np.where(seen, 0.2, np.nan),
        srp_rad=np.where(seen, 0.2 + np.radians(3.0), np.nan),
        music_rad=np.where(seen, 0.2 - np.radians(7.0), np.nan),
    )


@pytest.fixture(scope="module")
def streams():
    rng = np.random.default_rng(3)
    heard = [approach(i, rng, lead_s=2.0) for i in range(10)]
    quiet = [calm(i, rng, false_alarms=(20, 50) if i < 5 else ()) for i in range(10)]
    return heard + quiet


def test_figures_of_streams_with_a_known_answer(streams):
    score = score_rules(streams, np.random.default_rng(0))
    found = published_figures(score)
    hours = 10 * HOPS * 0.1 / 3600.0
    assert found["published_detection"] == 1.0
    assert found["published_lead_s"] == pytest.approx(2.0)
    assert found["published_false_alarms_per_hour"] == pytest.approx(10 / hours)
    # Single windows do not sustain, so every k serves and the smallest is taken; it costs one hop of lead.
    assert set(score.sustain_hops) == {2}
    assert found["sustained_lead_s"] == pytest.approx(1.9)
    assert found["sustained_false_alarms_per_hour"] == 0.0
    assert found["bearing_srp_deg"] == pytest.approx(3.0)
    assert found["bearing_music_deg"] == pytest.approx(7.0)
    assert found["prominence_in_view"] == pytest.approx(1.6)
    assert found["prominence_in_silence"] == pytest.approx(1.0)
    assert found["looming_correlation"] == pytest.approx(1.0)
    assert found["looming_auroc"] > 0.95
    assert found["doppler_share"] == pytest.approx(0.1)
    assert found["ece_calibrated"] < found["ece_raw"]


@pytest.mark.parametrize(("name", "horizon_s"), [("all", 99.0), ("2s", 2.0), ("1s", 1.0)])
def test_window_auroc_is_that_of_scikit_learn(streams, name, horizon_s):
    score = score_rules(streams, np.random.default_rng(0))
    values, labels = [], []
    for recording in streams:
        left_s = T0_S - recording.time_s
        used = (
            np.full(HOPS, True) if recording.hazard_free else (left_s > -1e-6) & (left_s < horizon_s + 1e-6)
        )
        values += recording.published_statistic[used].tolist()
        labels += [not recording.hazard_free] * int(used.sum())
    assert published_figures(score)[f"auroc_{name}"] == pytest.approx(roc_auc_score(labels, values))


def test_ours_keeps_its_budget_on_the_other_folds_and_ignores_a_leak(streams):
    """A recording's own windows set nothing that is applied to it: one loud calm recording alarms itself."""
    everywhere = np.full(HOPS, 0.99)
    loud = streams[10].replace(**decisions(posteriors(everywhere), everywhere))
    score = score_rules([*streams[:10], loud, *streams[11:]], np.random.default_rng(0))
    assert score.ours[0.0].false_onsets[10] == 1
    assert score.ours[0.0].false_onsets.sum() == 1


def test_folds_hold_both_kinds_and_every_stratum_is_spread(streams):
    fold_of = deal(streams, np.random.default_rng(1))
    free = np.array([recording.hazard_free for recording in streams])
    for fold in range(5):
        assert (fold_of[free] == fold).sum() == 2
        assert (fold_of[~free] == fold).sum() == 2
    with pytest.raises(InvalidArgumentError, match="two of each kind"):
        deal(streams[9:], np.random.default_rng(1))


def test_intervals_hold_the_value_and_narrow_with_more_recordings(streams):
    rng = np.random.default_rng(5)
    missed = [approach(i, rng, lead_s=-0.2) for i in range(10)]
    few = score_rules([*streams, *missed], np.random.default_rng(0))
    many = score_rules([*streams, *missed] * 4, np.random.default_rng(0))
    widths = []
    for score in (few, many):
        low, high = figure_intervals(score, np.random.default_rng(0), draws=100)["published_detection"]
        assert low <= published_figures(score)["published_detection"] <= high
        widths.append(high - low)
    assert 0.0 < widths[1] < 0.7 * widths[0]


def test_early_onsets_are_no_detections(streams):
    hazard = np.where(np.arange(HOPS) < 3, 0.9, 0.1)
    early = streams[0].replace(**decisions(posteriors(hazard), streams[0].statistic))
    score = score_rules([early, *streams[1:]], np.random.default_rng(0))
    assert rule_figures(score.published, score, np.arange(20))["detection"] == pytest.approx(0.9)


def test_the_camera_alone_warns_of_nothing_that_is_not_in_sight(streams):
    score = score_rules(streams, np.random.default_rng(0))
    everyone = np.arange(len(streams))
    assert rule_figures(score.vision, score, everyone)["detection"] == 0.0
    time_s, t0_s = streams[0].time_s, streams[0].t0_s
    leak = streams[0].replace(reference_rad=np.where(time_s > t0_s - 0.55, 0.1, np.nan))
    score = score_rules([leak, *streams[1:]], np.random.default_rng(0))
    figures = rule_figures(score.vision, score, everyone)
    assert figures["detection"] == pytest.approx(0.1)
    assert figures["lead_s"] == pytest.approx(0.5)


def test_report_has_every_target_and_judges_by_its_rule(streams):
    score = score_rules(streams, np.random.default_rng(0))
    report = comparison_report(
        published_figures(score), figure_intervals(score, np.random.default_rng(0), draws=20)
    )
    assert list(report["figures"]) == list(TARGETS)
    assert report["judged"] == 13
    assert report["agreeing"] + len(report["outside"]) == 13
    assert report["figures"]["bearing_srp_deg"]["agrees"]
    assert not report["figures"]["looming_correlation"]["agrees"]
    assert report["figures"]["auroc_all"]["agrees"] is None
    assert len(comparison_table(report).splitlines()) == len(TARGETS) + 2
    json.dumps(report, allow_nan=False)


def test_roc_curve_is_that_of_scikit_learn():
    rng = np.random.default_rng(0)
    positives, negatives = rng.normal(1.0, 1.0, 40).round(1), rng.normal(0.0, 1.0, 60).round(1)
    labels = np.r_[np.ones(40), np.zeros(60)]
    false, true, _ = sklearn_roc(labels, np.r_[positives, negatives], drop_intermediate=False)
    ours = roc_curve(positives, negatives)
    assert np.allclose(ours[0], false)
    assert np.allclose(ours[1], true)


def test_a_recording_comes_back_as_written_and_damage_is_named(tmp_path, streams):
    path = tmp_path / "0000.npz"
    save_tables(path, [streams[0]], "a")
    (back,) = load_tables(path, "hops", "a")
    for name in ("features", "srp_rad", "log_slope_hz"):
        assert np.array_equal(back.columns[name], streams[0].columns[name], equal_nan=True)
    assert (back.t0_s, back.about["doppler"]) == (T0_S, "")
    assert load_tables(path, "hops", "b") == []
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(InputFileError, match=r"0000\.npz"):
        load_tables(path, "hops", "a")


def test_origin_names_all_that_a_recording_depends_on():
    plans, levels = plan_static(4, 1), preset()
    settings = StreetSettings(levels)
    others = [
        settings.origin(plans[1]),
        settings.origin(plan_static(4, 2)[0]),
        StreetSettings(replace(levels, far_rate=1.0)).origin(plans[0]),
        StreetSettings(levels, duration_s=5.0).origin(plans[0]),
    ]
    assert settings.origin(plan_static(4, 1)[0]) == settings.origin(plans[0])
    assert len({settings.origin(plans[0]), *others}) == 5


def test_another_classifier_judges_what_was_heard(streams):
    """Eq. (6) of the shipped classifier, hop by hop, from the kept features and answers."""
    rng = np.random.default_rng(2)
    signature, _ = load_model()
    features = rng.uniform(0.05, 0.4, (HOPS, 60))
    asked = {"answer": np.full(HOPS, ABSENT), "miss_rate": np.full(HOPS, 0.3)}
    judged = classified(streams[0].replace(features=features, **asked), signature)
    listening = SiteSignature(signature)
    likelihoods = np.exp([listening.evidence(feature).log_likelihoods for feature in features])
    joint = likelihoods * signature.reference_prior
    assert np.allclose(judged.published_statistic, joint[:, :2].sum(axis=1) / joint.sum(axis=1))
    assert np.array_equal(judged.argmax_is_side, joint.argmax(axis=1) < 2)
    joint[:, 2] *= 0.3
    assert np.allclose(judged.statistic, joint[:, :2].sum(axis=1) / joint.sum(axis=1))


def test_training_on_simulation_is_kept_and_apart_from_the_test(tmp_path, monkeypatch):
    made = []

    def simulated(per_approach, seed, **_):
        made.append(seed)
        return simulated_windows(per_approach, seed, sites=("SA1",))

    monkeypatch.setattr("worldstate.studies.streets.street_training.simulated_windows", simulated)
    first, again = (train_on_simulation(tmp_path, preset(), 1, per_approach=1) for _ in range(2))
    assert encode(first) == encode(again)
    assert len(made) == 1
    assert made != [1]
    ensemble = train_on_simulation(tmp_path, preset(), 1, per_approach=1, method="worldstate")
    assert isinstance(ensemble, EnsembleModel)
    assert len(made) == 1
    train_on_simulation(tmp_path, replace(preset(), far_rate=0.0), 1, per_approach=1)
    assert len(made) == 2


@pytest.mark.parametrize(("duration_s", "beyond"), [(6.0, False), (3.2, True)])
def test_pass_time_is_that_of_constant_speed(duration_s, beyond):
    """The front is at the edge of sight at 3 s; the middle crosses y = 0 half a length after it, at 6 m/s."""
    settings = SimulationSettings(
        site("SB1"), "right", duration_s=duration_s, entry_s=3.0, speed_mps=6.0, sample_rate_hz=8_000.0
    )
    recording = simulate_recording(settings, np.random.default_rng(0), PAIR)
    first = recording.truth["frames"][0]
    expected = (-first["position_m"][1] + 2.15) / 6.0
    assert (expected > duration_s) == beyond
    assert pass_time_s(recording) == pytest.approx(expected, abs=1e-3)


def test_four_recordings_end_to_end(tmp_path, capsys):
    """Resumed by another number of jobs with the same figures; half a run does not matter."""
    out = tmp_path / "twin"
    arguments = ["twin", "--static", "4", "--duration", "1.5", "--seed", "2", "--out", str(out), "--json"]
    arguments += ["--model", "default"]
    assert main(arguments) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["recordings"], report["approaches"]) == (4, 2)
    assert set(report["figures"]) == set(TARGETS)
    for row in report["figures"].values():
        assert set(row) == {"label", "value", "low", "high", "published", "judged", "agrees"}
    assert json.loads((out / "twin.json").read_text()) == report
    assert (out / "twin.png").read_bytes()[:4] == b"\x89PNG"
    stamps = {path.name: path.stat().st_mtime_ns for path in (out / "hops").iterdir()}
    (out / "hops" / "0001.npz").unlink()
    assert main([*arguments, "--jobs", "2"]) == 0
    assert json.loads(capsys.readouterr().out) == report
    again = {path.name: path.stat().st_mtime_ns for path in (out / "hops").iterdir()}
    assert [name for name in stamps if stamps[name] != again[name]] == ["0001.npz"]


def test_too_few_recordings_are_refused(tmp_path, capsys):
    assert main(["twin", "--static", "3", "--out", str(tmp_path / "t")]) == 2
    assert "--static" in capsys.readouterr().err


def test_a_folder_that_is_not_there_is_named(streams, tmp_path):
    score = score_rules(streams, np.random.default_rng(0))
    with pytest.raises(InputFileError, match="nowhere"):
        write_comparison_figure(score, tmp_path / "nowhere" / "twin.png")


@pytest.mark.slow
@pytest.mark.parametrize(("group", "sites"), [("static", ("SA1", "SB1")), ("dynamic", ("DA1", "DB1"))])
def test_realism_stands_beside_the_figures(group, sites, tmp_path, capsys, monkeypatch):
    """Simulated windows of one seed against those of another, which take the part of the real ones."""
    from worldstate.adapters.datasets.feature_table import write_features
    from worldstate.cli.studies import twin

    write_features(tmp_path / "real.csv", simulated_windows(8, seed=9, sites=sites))
    monkeypatch.setattr(twin, "WINDOWS", 8)
    monkeypatch.setattr(twin, "REALISM_SEEDS", (1,))
    arguments = ["twin", "--static", "4", "--duration", "1.5", "--out", str(tmp_path / "t"), "--json"]
    arguments += ["--model", "default"]
    assert main([*arguments, "--realism", str(tmp_path / "real.csv"), "--realism-group", group]) == 0
    realism = json.loads(capsys.readouterr().out)["realism"]
    assert set(realism) == {"1"}
    assert set(realism["1"]) == {"medians", "transfers", "c2st"}
    assert realism["1"]["c2st"]["all"] < 0.75
