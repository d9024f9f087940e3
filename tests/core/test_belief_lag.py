"""Overlapping windows of one source count as one piece of evidence, those of two sources as two."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from worldstate.abduction.co_evidence import Unqueried
from worldstate.abduction.evidence import SignatureEvidence
from worldstate.belief.settings import FilterSettings
from worldstate.belief.street_model import StreetModel
from worldstate.core.filter import WorldFilter
from worldstate.ground.values import NotUsable
from worldstate.measurement.measurement import Heard, Measurement
from worldstate.state import Context, Priors

PRIORS = Priors(0.3, 0.3, 0.4)
NOTHING, UNASKED = NotUsable("-"), Unqueried("-")
# The steps are so short that the dynamics change nothing and only the evidence acts.
MEMORY_NS = 10_000
SETTINGS = FilterSettings(window_s=MEMORY_NS / 1e9, street=StreetModel(window_s=MEMORY_NS / 1e9))
nats = st.floats(-4.0, 4.0)
FLAT = SignatureEvidence(("left", "right"), (0.0, 0.0), 0.0, 0.0)
signatures = st.builds(
    lambda left, right, visible, none: SignatureEvidence(("left", "right"), (left, right), visible, none),
    nats, nats, nats, nats,
)  # fmt: skip
steps_ns = st.integers(0, 3 * MEMORY_NS)
windows = st.lists(st.tuples(st.just(FLAT) | signatures, steps_ns, st.booleans()), min_size=1, max_size=8)


def heard(stamp_ns, signature, source="acoustic", usable=True):
    hears = Heard() if usable else Heard(0.0, "wind")
    return Measurement(stamp_ns, signature, UNASKED, NOTHING, NOTHING, source=source, heard=hears)


def believed(measurements, settings=SETTINGS):
    world = WorldFilter(context=Context(priors=PRIORS), settings=settings)
    for measurement in measurements:
        world = world.update(measurement)
    return np.array([*world.belief.hidden, *world.belief.hypotheses])


def by_hand(weighted):
    """Eq. (6) with likelihoods raised to weights; two hidden vehicles have the mean of both likelihoods.

    Evidence against a visible vehicle also counts against one beside a hidden vehicle.
    """
    chance, seen = 1.0 - np.sqrt(1.0 - PRIORS.hidden), PRIORS.visible / (1.0 - PRIORS.hidden)
    one = chance * (1.0 - chance)
    sides = np.array([one, one, chance**2])
    explanations = np.log([*((1.0 - seen) * sides), *(seen * sides), PRIORS.visible, PRIORS.none])
    for signature, weight in weighted:
        left, right = signature.hidden
        denied = min(signature.visible - signature.none, 0.0)
        hidden = np.array([left, right, np.logaddexp(left, right) - np.log(2.0)])
        hidden -= np.log(1.0 - seen + seen * np.exp(denied))
        explanations += weight * np.array([*hidden, *(hidden + denied), signature.visible, signature.none])
    chances = np.exp(explanations - np.logaddexp.reduce(explanations))
    left, right, both = chances[:3] + chances[3:6]
    return np.array([left + both, right + both, left + right + both, *chances[6:]])


@given(windows)
def test_only_the_new_part_of_a_window_counts(told):
    """Log-likelihoods are averaged over the memory.

    A window without information or of unusable sound does not count.
    """
    stamp_ns, since_ns, measurements, weighted = 10**9, None, [], []
    for signature, step_ns, usable in told:
        stamp_ns += step_ns
        measurements.append(heard(stamp_ns, signature, usable=usable))
        if usable and np.ptp(signature.log_likelihoods):
            new = 1.0 if since_ns is None else -np.expm1(-(stamp_ns - since_ns) / MEMORY_NS)
            weighted = [(one, (1.0 - new) * weight) for one, weight in weighted] + [(signature, new)]
            since_ns = stamp_ns
    assert believed(measurements) == pytest.approx(by_hand(weighted), abs=1e-4)


@given(signatures, st.integers(1, 10))
def test_repeated_windows_count_once(signature, hops):
    got = believed([heard(10**9 + hop * MEMORY_NS // 10, signature) for hop in range(hops)])
    assert got == pytest.approx(by_hand([(signature, 1.0)]), abs=1e-4)
    again = believed([heard(10**9, signature)] * hops)
    assert again == pytest.approx(by_hand([(signature, 1.0)]), abs=1e-4)


@given(signatures, signatures, st.integers(1, 10))
def test_windows_of_another_modality_count_in_full(sound, radar, hops):
    told = [
        heard(10**9 + hop * MEMORY_NS // 20, *one)
        for hop in range(hops)
        for one in ((sound, "acoustic"), (radar, "radar"))
    ]
    assert believed(told) == pytest.approx(by_hand([(sound, 1.0), (radar, 1.0)]), abs=1e-4)


@given(signatures, st.integers(1, 20), st.integers(1, 3 * MEMORY_NS))
def test_consecutive_windows_count_each_if_multiplied_as_likelihoods(signature, hops, step_ns):
    times, settings = (
        1.0 + (hops - 1) * min(step_ns / MEMORY_NS, 1.0),
        replace(SETTINGS, windows="likelihood"),
    )
    got = believed([heard(10**9 + hop * step_ns, signature) for hop in range(hops)], settings)
    assert got == pytest.approx(by_hand([(signature, times)]), abs=1e-4)
