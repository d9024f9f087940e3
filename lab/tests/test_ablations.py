"""The statistic with switches, the table of ablations on artificial streams, and the command on a corner."""

import json
import math

import numpy as np
import pytest
from hop_tables import blank_stream
from hypothesis import given
from hypothesis import strategies as st
from made_up_corner import write_corner
from scipy.signal import lfilter
from worldstate_lab.cli.main import main
from worldstate_lab.evaluation.ablation_rows import (
    AblationSwitches,
    ablation_table,
    evaluate_ablation,
    presence_statistic,
)
from worldstate_lab.metrics.stream_statistic import stream_statistic
from worldstate_lab.sequences.camera_rows import product_row

from worldstate.abduction.co_evidence import Absent, Present, Unqueried
from worldstate.abduction.evidence import SignatureEvidence, abduce, statistic
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.values import NotUsable
from worldstate.measurement.measurement import Measurement
from worldstate.operations.recordings.hop_table import ABSENT, PRESENT, HopTable, hop_stream, save_tables

EVEN, PRIOR = (0.25, 0.25, 0.25, 0.25), (0.3, 0.3, 0.2, 0.2)
SILENT = NotUsable("-")
answers = st.one_of(
    st.just(Unqueried("-")),
    st.builds(Absent, st.floats(0.01, 1.0), st.floats(0.0, 0.5)),
    st.builds(Present, st.floats(0.0, 0.99), st.floats(0.01, 0.5)),
)
nats = st.floats(-8.0, 8.0)


@given(st.lists(st.tuples(st.tuples(nats, nats, nats, nats), answers), min_size=1, max_size=8))
def test_over_a_stream_statistic_and_presence_are_those_of_every_hop(rows):
    measured = []
    for i, (row, answer) in enumerate(rows):
        signature = SignatureEvidence(("left", "right"), row[:2], row[2], row[3])
        measured.append(Measurement((i + 10) * 10**8, signature, answer, SILENT, SILENT))
    stream = hop_stream(measured, name="x")
    expected = [statistic(m.signature, m.co_evidence, PRIOR) for m in measured]
    assert stream_statistic(stream, PRIOR) == pytest.approx(expected, rel=1e-9)
    alone = [statistic(m.signature, Unqueried("-"), PRIOR) for m in measured]
    assert stream_statistic(stream, PRIOR, use_absence=False) == pytest.approx(alone, rel=1e-9)
    whole = [abduce(np.log(PRIOR), m.signature, m.co_evidence) for m in measured]
    present = [one.hidden_total + one.visible for one in whole]
    assert presence_statistic(stream, PRIOR) == pytest.approx(present)


def test_the_approach_term_shifts_the_log_odds_by_its_weight_and_only_if_usable():
    stream = blank_stream("x", 4).replace(approach=np.array([np.nan, 0.0, 1.5, -9.0]))
    plain, looming = (stream_statistic(stream, PRIOR, approach_weight=w) for w in (0.0, 0.4))
    shift = np.log(looming / (1 - looming)) - np.log(plain / (1 - plain))
    assert shift == pytest.approx([0.0, 0.0, 0.6, -1.2], abs=1e-9)


def recording(rng, number, label):
    """Return a recording audible for 3 s before T0 and then seen by a camera that misses one time in twenty.

    The signature drifts towards visible once the vehicle is in sight. Looming is noise with mean 1 while it
    approaches, and with mean 0 otherwise.
    """
    hops = 141
    stream = blank_stream(f"{label}/{number}", hops)
    drift = lfilter([math.sqrt(1 - 0.8**2)], [1.0, -0.8], rng.normal(size=(3, hops)), axis=1)
    approach, t0_s = label != "none", 9.0
    heard = (stream.time_s > 6.0) & approach
    sight = (stream.time_s > t0_s) & approach
    left = 3.0 * heard * ~sight + drift[0] - 2.0
    visible = 3.5 * sight + drift[1] - 1.5
    seen = sight & (rng.random(hops) >= 0.05)
    return stream.replace(
        label=label,
        t0_s=t0_s if approach else math.nan,
        log_likelihoods=np.stack([left, left - 1.0, visible, np.zeros(hops)], axis=1),
        answer=np.where(seen, PRESENT, ABSENT),
        miss_rate=np.full(hops, 0.05),
        clutter_rate=np.full(hops, 0.01),
        approach=(heard & ~sight) * 1.5 + rng.normal(size=hops),
        seen=seen,
        there=sight,
    )


def corpus(count=60):
    labels = ("none", "left", "none", "right")
    return [recording(np.random.default_rng(i), i, labels[i % 4]) for i in range(count)]


def test_the_table_switches_one_thing_at_a_time():
    table = ablation_table(corpus(), EVEN, 0, AblationSwitches())
    full, raw = table["full"], table["raw_risk"]
    assert full["detected"] > 0.8
    assert 1.0 < full["lead_time_s"] < 4.0
    assert full["window_rate"] < 0.04
    for name in ("auroc", "detected", "awareness"):
        assert raw[name] == full[name]
    assert raw["ece"] > 2 * full["ece"]
    assert table["with_looming"]["approach_weight"] > 0.0
    assert table["with_looming"]["auroc"] > full["auroc"]
    assert table["signature_only"]["vision_only"] == full["vision_only"]
    assert table["signature_only"]["auroc"] != full["auroc"]


@pytest.mark.parametrize(("hazard_free", "problem"), [(False, "hazard-free"), (True, "got 0 approaches")])
def test_recordings_that_cannot_be_evaluated_are_rejected(hazard_free, problem):
    some = [one for one in corpus(count=8) if one.hazard_free == hazard_free]
    with pytest.raises(InvalidArgumentError, match=problem):
        evaluate_ablation(some, EVEN, np.random.default_rng(0), AblationSwitches())


def hops(name, label, t0_s, *, advised, present):
    """Return 20 hops from 1.0 s on with a constant state and nothing in view."""
    time_s = 1.0 + 0.1 * np.arange(20)
    columns = {
        "time_s": time_s,
        "advised": np.repeat([[advised, False]], 20, axis=0),
        "hypotheses": np.repeat([[present, 0.0, 1.0 - present]], 20, axis=0),
        "seen": np.zeros(20, bool),
        "there": time_s > 2.0,
    }
    return HopTable(columns, name, label, t0_s, {"site": "SA1"})


@pytest.mark.parametrize(("quiet", "present", "aware"), [(0.1, 0.9, 1.0), (0.5, 0.5, 0.0)])
def test_a_presence_above_that_of_quiet_streets_counts_as_awareness(quiet, present, aware):
    streams = [hops(f"f{i}", "none", np.nan, advised=False, present=quiet) for i in range(5)]
    streams += [hops(f"a{i}", "left", 2.0, advised=i < 3, present=present) for i in range(5)]
    row = product_row(streams, np.random.default_rng(0))
    assert (row["warned"], row["approaches"], row["onsets"]) == (3, 5, 0)
    assert (row["aware"], row["vision_only"], row["hazard_free_aware_SA1"]) == (aware, 0.0, 0.0)


def test_the_command_prints_the_rows_of_streams(tmp_path, capsys):
    save_tables(tmp_path / "s.npz", corpus(count=24))
    assert main(["ablations", str(tmp_path / "s.npz")]) == 0
    assert "with_looming" in capsys.readouterr().out


@pytest.mark.long
def test_the_command_prints_the_figures_of_each_camera(tmp_path, capsys):
    folder = write_corner(tmp_path / "corner", np.random.default_rng(0), approaches=4, hazard_free=4)
    assert main(["ablations", str(folder), "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["states"]["boxes"]
    assert {"full", "signature_only", "vision_trusted", "eq_5"} <= set(rows["statistic"])
    assert {"product", "product, no camera", "product, vision trusted"} <= set(rows["product"])
    assert rows["product"]["product, no camera"]["vision_only"] == 0.0
