"""Every ablation is a switch of one evaluation and removes only its own part."""

import math

import numpy as np
import pytest
from hop_tables import blank_stream
from scipy.signal import lfilter
from worldstate_lab.evaluation.ablation_rows import (
    AblationSwitches,
    ablation_table,
    evaluate_ablation,
    presence_statistic,
)

from worldstate.abduction.co_evidence import Absent, Present
from worldstate.abduction.evidence import SignatureEvidence, abduce
from worldstate.ground.errors import InvalidArgumentError
from worldstate.operations.recordings.hop_table import ABSENT, PRESENT

PRIOR = (0.25, 0.25, 0.25, 0.25)
BETA = {0.0: 0.05, 0.5: 0.5, 1.0: 0.97}


def recording(rng, number, label, d=0.0):
    """Return a recording audible for 3 s before T0 and then seen by a camera that misses more as d grows.

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
    coin = rng.random(hops)
    seen = sight & (coin >= BETA[d])
    return stream.replace(
        label=label,
        t0_s=t0_s if approach else math.nan,
        log_likelihoods=np.stack([left, left - 1.0, visible, np.zeros(hops)], axis=1),
        answer=np.where(seen, PRESENT, ABSENT),
        miss_rate=np.full(hops, BETA[d]),
        clutter_rate=np.full(hops, 0.01),
        approach=(heard & ~sight) * 1.5 + rng.normal(size=hops),
        seen=seen,
        there=sight,
    )


def corpus(d=0.0, count=60):
    return [
        recording(np.random.default_rng(i), i, ("none", "left", "none", "right")[i % 4], d)
        for i in range(count)
    ]


def test_presence_is_that_of_the_posterior():
    stream = recording(np.random.default_rng(0), 0, "left")
    for i in (0, 50, 100, 140):
        row = stream.log_likelihoods[i]
        answer = (Present if stream.answer[i] == PRESENT else Absent)(0.05, 0.01)
        whole = abduce(np.log(PRIOR), SignatureEvidence(("l", "r"), tuple(row[:2]), row[2], row[3]), answer)
        presence = presence_statistic(stream, PRIOR)[i]
        assert presence == pytest.approx(whole.hidden_total + whole.visible)


def test_the_table_switches_one_thing_at_a_time():
    streams = corpus()
    table = ablation_table(streams, PRIOR, 0, AblationSwitches())
    full = table["full"]
    assert full["detected"] > 0.8
    assert 1.0 < full["lead_time_s"] < 4.0
    assert full["window_rate"] < 0.04
    assert table["raw_risk"]["auroc"] == full["auroc"]
    assert table["raw_risk"]["ece"] > 2 * full["ece"]
    assert (table["raw_risk"]["detected"], table["raw_risk"]["awareness"]) == (
        full["detected"],
        full["awareness"],
    )
    assert table["with_looming"]["approach_weight"] > 0.0
    assert table["with_looming"]["auroc"] > full["auroc"]
    assert table["signature_only"]["vision_only"] == full["vision_only"]
    assert table["signature_only"]["auroc"] != full["auroc"]
    again = ablation_table(streams, PRIOR, 0, AblationSwitches())
    assert again == table


def test_without_answers_the_absence_switch_does_nothing():
    mute = [s.replace(answer=0 * s.answer, miss_rate=1 + 0 * s.miss_rate) for s in corpus(count=20)]
    table = ablation_table(mute, PRIOR, 0, AblationSwitches())
    assert table["signature_only"] == table["full"]


def test_recordings_that_cannot_be_evaluated_are_rejected():
    streams = corpus(count=8)
    with pytest.raises(InvalidArgumentError, match="hazard-free"):
        evaluate_ablation(
            [s for s in streams if not s.hazard_free], PRIOR, np.random.default_rng(0), AblationSwitches()
        )
    with pytest.raises(InvalidArgumentError, match="got 0 approaches"):
        evaluate_ablation(
            [s for s in streams if s.hazard_free], PRIOR, np.random.default_rng(0), AblationSwitches()
        )
