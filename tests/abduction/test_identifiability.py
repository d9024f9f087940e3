"""Bounds in closed form, estimates against exact values, laws of information."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import stats
from sklearn.feature_selection import mutual_info_classif
from sklearn.linear_model import LogisticRegression

from worldstate.abduction.identifiability.fisher_information import (
    at_least,
    claimed_covariance,
    combined_information,
    common_cause_information,
    gaussian_information,
)
from worldstate.abduction.identifiability.information import (
    conditional_information,
    entropy_bits,
    fano_bound,
    fuse,
    information_from_posteriors,
    mutual_information_bits,
    nearest_neighbour_information_bits,
    sharp_fano_bound,
)
from worldstate.frontend.array.microphone_array import MicrophoneArray, roof_array_56
from worldstate.ground.errors import InvalidArgumentError
from worldstate.studies.paper.identifiability import reach_of_array, reach_on_data


def binary_entropy(p):
    return entropy_bits([p, 1.0 - p])


joints = st.tuples(st.integers(2, 5), st.integers(2, 5)).flatmap(
    lambda shape: arrays(float, shape, elements=st.floats(0.001, 1.0)).map(lambda p: p / p.sum())
)
channels = st.integers(2, 5).flatmap(
    lambda n: arrays(float, (5, n), elements=st.floats(0.001, 1.0)).map(
        lambda c: c / c.sum(axis=1, keepdims=True)
    )
)
vectors = arrays(float, (3, 2), elements=st.floats(-3.0, 3.0))
factors = arrays(float, (3, 3), elements=st.floats(-2.0, 2.0)).map(lambda a: a @ a.T + 0.2 * np.eye(3))
effects = arrays(float, 3, elements=st.floats(-3.0, 3.0))


@given(st.floats(0.001, 0.499))
def test_the_binary_symmetric_channel(flip):
    joint = 0.5 * np.array([[1 - flip, flip], [flip, 1 - flip]])
    information = mutual_information_bits(joint)
    assert information == pytest.approx(1.0 - binary_entropy(flip), abs=1e-9)
    # Fano is attained by the symmetric channel: its best detector errs with the flip probability.
    assert sharp_fano_bound(1.0, information, 2) == pytest.approx(flip, abs=1e-6)


@given(st.integers(2, 12), st.floats(0.01, 0.99))
def test_fano_is_attained_by_the_symmetric_channel_of_any_size(k, share):
    error = share * (k - 1) / k
    joint = np.full((k, k), error / (k - 1)) / k
    np.fill_diagonal(joint, (1 - error) / k)
    information = mutual_information_bits(joint)
    assert sharp_fano_bound(math.log2(k), information, k) == pytest.approx(error, abs=1e-6)
    assert fano_bound(math.log2(k), information, k) <= error + 1e-9


@given(joints)
def test_no_detector_errs_less_than_fano_says(joint):
    entropy, information = entropy_bits(joint.sum(axis=1)), mutual_information_bits(joint)
    best = 1.0 - joint.max(axis=0).sum()
    sharp = sharp_fano_bound(entropy, information, len(joint))
    assert fano_bound(entropy, information, len(joint)) <= sharp + 1e-9
    assert sharp <= best + 1e-6


@given(joints, channels)
def test_processing_the_data_adds_no_information(joint, channel):
    coarser = joint @ channel[: joint.shape[1]]
    assert mutual_information_bits(coarser) <= mutual_information_bits(joint) + 1e-9
    assert mutual_information_bits(joint) <= entropy_bits(joint.sum(axis=1)) + 1e-9


def gaussian_sample(n, distance, seed=0):
    rng = np.random.default_rng(seed)
    z = rng.integers(0, 2, n)
    return rng.normal(size=n) + distance * z, z


def gaussian_information_bits(distance):
    """Exact I of two unit Gaussians at a distance, equally likely, by quadrature."""
    x = np.linspace(-8.0, 8.0 + distance, 20_001)
    p0, p1 = stats.norm.pdf(x), stats.norm.pdf(x - distance)
    mixed = (p0 + p1) / 2
    entropy_of_mixture = -np.trapezoid(mixed * np.log2(np.maximum(mixed, 1e-300)), x)
    return entropy_of_mixture - 0.5 * math.log2(2 * math.pi * math.e)


def exact_posteriors(x, distance):
    odds = 1 / (1 + np.exp(-(distance * x - distance**2 / 2)))
    return np.stack([1 - odds, odds], axis=1)


@pytest.mark.parametrize("distance", [0.5, 1.5, 3.0])
def test_estimates_agree_with_the_exact_value_of_two_gaussians(distance):
    x, z = gaussian_sample(20_000, distance)
    exact = gaussian_information_bits(distance)
    found = information_from_posteriors(exact_posteriors(x, distance), z)
    assert found.lower == pytest.approx(exact, abs=0.02)
    assert found.plug_in == pytest.approx(exact, abs=0.02)
    near = nearest_neighbour_information_bits(x[:, None], z)
    assert near == pytest.approx(exact, abs=0.03)
    assert near == pytest.approx(mutual_info_classif(x[:, None], z)[0] / math.log(2), abs=0.02)


@pytest.mark.parametrize("sharpness", [0.3, 3.0])
def test_a_classifier_that_is_wrongly_sure_keeps_the_bound_below_and_fools_the_plug_in(sharpness):
    x, z = gaussian_sample(20_000, 1.5)
    q = exact_posteriors(x, 1.5) ** sharpness
    found = information_from_posteriors(q / q.sum(axis=1, keepdims=True), z)
    exact = gaussian_information_bits(1.5)
    assert found.lower < exact - 0.03
    assert (found.plug_in > exact) == (sharpness > 1)


def test_independent_windows_carry_no_information():
    rng = np.random.default_rng(0)
    x, z = rng.normal(size=(3000, 2)), rng.integers(0, 3, 3000)
    assert nearest_neighbour_information_bits(x, z) < 0.03
    flat = information_from_posteriors(np.full((3000, 3), 1 / 3), z)
    assert flat.lower == pytest.approx(0.0, abs=0.01)


def test_the_vision_unique_part_is_the_chain_rule():
    """I(z; ac, vis) = I(z; ac) + I(z; vis | ac) with channels that are independent given the state."""
    rng, n = np.random.default_rng(1), 40_000
    z = rng.integers(0, 2, n)
    acoustic, visual = (exact_posteriors(rng.normal(size=n) + d * z, d) for d in (1.0, 2.0))
    both = fuse(acoustic, visual, [0.5, 0.5])
    unique = conditional_information(acoustic, both, z)
    exact = gaussian_information_bits(math.hypot(1.0, 2.0)) - gaussian_information_bits(1.0)
    assert unique == pytest.approx(exact, abs=0.015)
    gained = information_from_posteriors(both, z).lower - information_from_posteriors(acoustic, z).lower
    assert unique == pytest.approx(gained, abs=1e-6)


def test_with_rain_on_both_the_channels_say_less_than_each_for_itself_would():
    """(A1) fails: a hidden weather bit flips both answers together. Exact, from the joint table."""

    def joint(common):
        table = np.zeros((2, 4))
        for z in (0, 1):
            for a in (0, 1):
                for v in (0, 1):
                    fine = 0.9 if a == z else 0.1, 0.9 if v == z else 0.1
                    rain = 0.5, 0.5
                    if common:
                        p = 0.7 * fine[0] * fine[1] + 0.3 * rain[0] * rain[1]
                    else:
                        p = math.prod(0.7 * f + 0.3 * r for f, r in zip(fine, rain, strict=True))
                    table[z, 2 * a + v] = 0.5 * p
        return table

    assert mutual_information_bits(joint(True)) < mutual_information_bits(joint(False)) - 0.005


@given(st.lists(factors, min_size=1, max_size=4))
def test_more_modalities_never_inform_less(parts):
    total = combined_information(parts)
    for part in parts:
        assert at_least(total, part)
        assert at_least(np.linalg.inv(part), np.linalg.inv(total))


@given(vectors, vectors, factors, factors, effects, effects)
@settings(deadline=None)
def test_a_common_cause_is_never_counted_for_nothing(h1, h2, r1, r2, g1, g2):
    """The joint information is at least each alone; what the naive sum claims is another matter."""
    joint = common_cause_information([h1, h2], [r1, r2], [g1, g2])
    for h, r, g in ((h1, r1, g1), (h2, r2, g2)):
        assert at_least(joint, gaussian_information(h, r + np.outer(g, g)))
    apart = common_cause_information([h1, h2], [r1, r2], [g1, 0 * g2])
    alone = [gaussian_information(h1, r1 + np.outer(g1, g1)), gaussian_information(h2, r2)]
    assert apart == pytest.approx(combined_information(alone), rel=1e-6, abs=1e-6)


@given(st.floats(0.1, 3.0), st.floats(0.1, 3.0), st.floats(0.1, 2.0), st.floats(0.1, 2.0))
def test_rain_that_moves_both_alike_makes_additivity_optimistic(r1, r2, g1, g2):
    slopes, noise, effect = [[[1.0]], [[1.0]]], [[[r1]], [[r2]]], [[g1], [g2]]
    alone = [gaussian_information([[1.0]], [[r + g * g]]) for r, g in ((r1, g1), (r2, g2))]
    claimed, true = claimed_covariance(slopes, noise, effect)
    assert claimed == pytest.approx(np.linalg.inv(combined_information(alone)))
    assert true > claimed
    joint = common_cause_information(slopes, noise, effect)
    assert np.linalg.inv(joint) <= true + 1e-9
    # The closed form of two correlated readings of one number.
    s1, s2, c = r1 + g1**2, r2 + g2**2, g1 * g2
    assert joint[0, 0] == pytest.approx((s1 + s2 - 2 * c) / (s1 * s2 - c * c))


def test_rain_of_equal_strength_costs_what_theory_says():
    joint = common_cause_information([[[1.0]]] * 2, [[[1.0]]] * 2, [[1.0], [1.0]])
    assert joint == pytest.approx(np.array([[2 / 3]]))
    against = common_cause_information([[[1.0]]] * 2, [[[1.0]]] * 2, [[1.0], [-1.0]])
    assert against == pytest.approx(np.array([[2.0]]))


def test_fused_estimates_have_the_covariance_that_is_claimed_only_without_a_common_cause():
    rng, g = np.random.default_rng(0), 0.8
    w, own = rng.normal(size=200_000), rng.normal(size=(2, 200_000))
    claimed, true = claimed_covariance([[[1.0]]] * 2, [[[1.0]]] * 2, [[g]] * 2)
    assert np.var((own + g * w).mean(axis=0)) == pytest.approx(true[0, 0], rel=0.02)
    independent = own + g * rng.normal(size=(2, 200_000))
    assert np.var(independent.mean(axis=0)) == pytest.approx(claimed[0, 0], rel=0.02)


def test_the_endfire_corollary_on_a_line_across_the_vehicle():
    line = MicrophoneArray(np.stack([np.zeros(8), np.linspace(-0.5, 0.5, 8), np.zeros(8)], axis=1))
    azimuths = np.radians([0.0, 30.0, 60.0, 80.0])
    found = reach_of_array(line, azimuths, [500.0, 1000.0], [0.1, 0.1], 40)
    assert found.endfire == pytest.approx(np.cos(azimuths) ** 2, abs=1e-9)
    assert (found.std_rad / found.std_rad[0]) == pytest.approx(1 / np.cos(azimuths), rel=1e-6)
    endfire = reach_of_array(line, [math.pi / 2], [500.0], [0.1], 40, vision_std_rad=0.05)
    assert endfire.std_rad[0] > 1e3 or math.isinf(endfire.std_rad[0])
    assert endfire.with_vision_rad[0] == pytest.approx(0.05, rel=1e-6)


def test_with_a_camera_the_bound_is_the_sum_and_never_worse():
    azimuths = np.radians(np.arange(-80.0, 81.0, 20.0))
    found = reach_of_array(roof_array_56(), azimuths, [500.0], [0.01], 10, vision_std_rad=0.02)
    assert found.with_vision_rad**-2 == pytest.approx(found.std_rad**-2 + 0.02**-2)
    assert (found.with_vision_rad <= np.minimum(found.std_rad, 0.02)).all()


def test_what_could_any_detector_reach_on_data():
    x, z = gaussian_sample(3000, 1.0, seed=4)
    q = LogisticRegression().fit(x[:1000, None], z[:1000]).predict_proba(x[1000:, None])
    found = reach_on_data(q, z[1000:], np.random.default_rng(0), features=x[1000:, None])
    exact = gaussian_information_bits(1.0)
    bayes = stats.norm.cdf(-0.5)
    assert found.information_lower <= exact + 0.02
    assert exact <= found.information_high
    assert found.fano <= found.sharp_fano <= bayes <= found.error + 0.02
    assert found.sharp_fano > 0.5 * bayes
    assert found.to_dict()["windows"] == 2000
    bare = reach_on_data(q, z[1000:], np.random.default_rng(0), groups=np.arange(2000) // 4)
    assert bare.to_dict()["information_neighbours"] is None


@pytest.mark.parametrize(
    "call",
    [
        lambda: entropy_bits([0.5, 0.6]),
        lambda: mutual_information_bits([[1.0, -0.5], [0.25, 0.25]]),
        lambda: fano_bound(3.0, 0.1, 4),
        lambda: sharp_fano_bound(1.0, math.nan, 2),
        lambda: information_from_posteriors([[0.5, 0.5]], [2]),
        lambda: information_from_posteriors([[0.5, 0.4]], [0]),
        lambda: information_from_posteriors([[0.5, 0.5]], [0.5]),
        lambda: nearest_neighbour_information_bits([[0.0], [1.0]], [0, 1]),
        lambda: fuse([[0.5, 0.5]], [[0.5, 0.5]], [0.0, 1.0]),
        lambda: combined_information([]),
        lambda: combined_information([[[1.0, 2.0], [0.0, 1.0]]]),
        lambda: combined_information([[[-1.0]]]),
        lambda: gaussian_information([[1.0]], [[0.0]]),
        lambda: claimed_covariance([[[0.0]]], [[[1.0]]], [[0.0]]),
        lambda: reach_of_array(roof_array_56(), [0.0], [500.0], [0.1], 1, vision_std_rad=-1.0),
    ],
)
def test_what_cannot_be_is_refused(call):
    with pytest.raises(InvalidArgumentError):
        call()
