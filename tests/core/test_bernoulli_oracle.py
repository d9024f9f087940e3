"""Existence of a target that a radar finds half the time, and that goes: Stone Soup's particles and ours."""

from datetime import datetime, timedelta

import numpy as np
import pytest

from worldstate import FilterSettings, WorldFilter
from worldstate.measurement import Position, PositionScan, SearchedSector, Sector

# A detection raises the odds to .5 / .3 + .5 = 2.2 times, a miss halves them: existence stays off 0 and 1.
STEP_S, STEPS, GONE, FOUND, CLUTTER, STD_M = 0.5, 60, 40, 0.5, 0.3, 0.5
# Ours counts that something was found, not how near: to Stone Soup every place says as much as any other.
VAGUE_M = 300.0
SPEED_MPS = (0.4, -0.2)
EPOCH = datetime(2000, 1, 1)


def scripted(rng):
    """Return the place at which the radar finds the target at every step, None where it does not."""
    place = np.array([20.0, 3.0]) + np.outer(STEP_S * np.arange(STEPS), SPEED_MPS)
    found = (rng.random(STEPS) < FOUND) & (np.arange(STEPS) < GONE)
    found[0] = True
    noisy = place + rng.normal(0.0, STD_M, place.shape)
    return [tuple(z) if there else None for z, there in zip(noisy.tolist(), found.tolist(), strict=True)]


def ours(places):
    """Return the existence that the filter publishes after every scan."""
    radar = SearchedSector(Sector(0.0, 1.2), range_m=1e3, detection_probability=FOUND, clutter_rate=CLUTTER)
    # Gone means gone: below the usual .05 an entity would be dropped while Stone Soup's still counts down.
    world, exists = WorldFilter(settings=FilterSettings(delete_existence=1e-3)), []
    noise = tuple(map(tuple, np.diag([STD_M**2] * 4).tolist()))
    for step, place in enumerate(places):
        stated = () if place is None else (Position(place, noise, SPEED_MPS),)
        world = world.update(PositionScan("radar", round(1e9 * STEP_S * (step + 1)), stated, radar))
        exists.append(sum(one.existence_probability for one in world.state.entities))
    return np.array(exists)


def stone_soup(places, start, corrected):
    """Return the existence of its Bernoulli particle filter, which begins at `start` after the first scan."""
    from scipy.special import logsumexp
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
    from stonesoup.predictor.particle import BernoulliParticlePredictor
    from stonesoup.resampler.particle import SystematicResampler
    from stonesoup.types.array import StateVectors
    from stonesoup.types.detection import Detection, MissedDetection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.multihypothesis import MultipleHypothesis
    from stonesoup.types.state import BernoulliParticleState
    from stonesoup.updater.particle import BernoulliParticleUpdater

    class Counting(BernoulliParticleUpdater):
        """Counts empty scans, at which the stock one leaves the existence as it is."""

        def update(self, hypotheses, **given):
            after, before = super().update(hypotheses, **given), hypotheses.single_hypotheses[0].prediction
            if not any(hypotheses):
                missed = np.exp(logsumexp(self.get_log_detection_probability(before) + before.log_weight))
                r = float(before.existence_probability)
                after.existence_probability = r * (1.0 - missed) / (1.0 - r * missed)
            return after

    class Births:
        """A handful of particles where the target is not: nobody is born."""

        def sample(self, detections, **_):
            far = StateVectors(np.tile([[500.0], [0.0], [500.0], [0.0]], 5))
            return BernoulliParticleState(far, weight=np.full(5, 0.2))

    rng, number = np.random.default_rng(3), 200
    (x, y), spread = places[0], (STD_M, 0.1, STD_M, 0.1)
    cloud = np.array([[x], [0.0], [y], [0.0]]) + rng.normal(size=(4, number)) * np.array(spread)[:, None]
    weight = np.full(number, 1.0 / number)
    target = BernoulliParticleState(
        StateVectors(cloud), weight=weight, existence_probability=start, timestamp=EPOCH
    )
    model = LinearGaussian(4, (0, 2), np.diag([VAGUE_M**2] * 2))
    motion = CombinedLinearGaussianTransitionModel(
        [ConstantVelocity(0.01, seed=1), ConstantVelocity(0.01, seed=2)]
    )
    predictor = BernoulliParticlePredictor(
        motion, birth_probability=1e-9, survival_probability=1.0 - 1e-9, birth_sampler=Births()
    )
    updater = (Counting if corrected else BernoulliParticleUpdater)(
        measurement_model=model,
        resampler=SystematicResampler(),
        clutter_rate=1,
        clutter_distribution=CLUTTER / (2.0 * np.pi * VAGUE_M**2),
        detection_probability=FOUND,
        nsurv_particles=number,
    )
    exists = [start]
    for step, place in enumerate(places[1:], 1):
        now = EPOCH + timedelta(seconds=STEP_S * step)
        predicted = predictor.predict(target, timestamp=now)
        said = MissedDetection(timestamp=now) if place is None else Detection(np.array(place), now)
        target = updater.update(MultipleHypothesis([SingleHypothesis(predicted, said)]))
        exists.append(float(target.existence_probability))
    return np.array(exists)


@pytest.mark.parametrize("seed", [0, 2])
def test_a_target_that_goes_is_forgotten_as_stone_soups_particles_forget_it(seed):
    pytest.importorskip("stonesoup", reason="Stone Soup is the oracle: pip install 'worldstate[oracles]'")
    places = scripted(np.random.default_rng(seed))
    mine = ours(places)
    theirs, stock = (stone_soup(places, mine[0], corrected) for corrected in (True, False))
    np.testing.assert_allclose(mine, theirs, atol=2e-3)
    assert mine[:GONE].max() > 0.95 and mine[GONE + 9] < 0.05
    # Stock, a scan that finds nobody tells it nothing: ten scans later it is as sure as ever.
    assert stock[GONE + 9] > 0.95
