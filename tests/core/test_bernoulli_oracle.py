"""Existence of a target that leaves or is half hidden, compared with Stone Soup."""

import runpy
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from worldstate import FilterSettings, WorldFilter
from worldstate.abduction.co_evidence import Absent
from worldstate.belief.joint_belief import FIRST_BIN, NONE, STATES, JointBelief
from worldstate.belief.street_model import StreetModel
from worldstate.measurement import Position, PositionScan, SearchedSector, Sector

STEP_S, STEPS, GONE, FOUND, CLUTTER, STD_M = 0.5, 60, 40, 0.5, 0.3, 0.5
LIVES = np.exp(-STEP_S / 10.0)
VAGUE_M = 300.0
SPEED_MPS = (0.4, -0.2)
EPOCH = datetime(2000, 1, 1)


def scripted(rng):
    """Return the position of the target at every step, None if the radar misses it."""
    place = np.array([20.0, 3.0]) + np.outer(STEP_S * np.arange(STEPS), SPEED_MPS)
    found = (rng.random(STEPS) < FOUND) & (np.arange(STEPS) < GONE)
    found[0] = True
    noisy = place + rng.normal(0.0, STD_M, place.shape)
    return [tuple(z) if there else None for z, there in zip(noisy.tolist(), found.tolist(), strict=True)]


def ours(places):
    """Return the existence that the filter publishes after every scan."""
    radar = SearchedSector(Sector(0.0, 1.2), range_m=1e3, detection_probability=FOUND, clutter_rate=CLUTTER)
    # At the usual threshold of 0.05 the entity would be dropped while Stone Soup's still decays.
    world, exists = WorldFilter(settings=FilterSettings(street=StreetModel(death=1e-3))), []
    noise = tuple(map(tuple, np.diag([STD_M**2] * 4).tolist()))
    for step, place in enumerate(places):
        stated = () if place is None else (Position(place, noise, SPEED_MPS),)
        world = world.update(PositionScan("radar", round(1e9 * STEP_S * (step + 1)), stated, radar))
        exists.append(sum(one.existence_probability for one in world.state.entities))
    return np.array(exists)


def stone_soup(places, start):
    """Return the existence of its Bernoulli particle filter, which begins at `start` after the first scan."""
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
        """The updater with empty scans, which the stock one ignores."""

        def update(self, hypotheses, **given):
            after, before = super().update(hypotheses, **given), hypotheses.single_hypotheses[0].prediction
            if not any(hypotheses):
                found = np.exp(self.get_log_detection_probability(before))
                missed, r = before.weight.astype(float) * (1.0 - found), float(before.existence_probability)
                after.existence_probability = r * missed.sum() / (1.0 - r + r * missed.sum())
            return after

    class Births:
        """A few particles far from the target, so that there are no births."""

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
        motion, birth_probability=1e-9, survival_probability=LIVES, birth_sampler=Births()
    )
    updater = Counting(
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
def test_existence_after_a_target_leaves_equals_stone_soups(seed):
    pytest.importorskip("stonesoup", reason="Stone Soup is the oracle: pip install 'worldstate[oracles]'")
    places = scripted(np.random.default_rng(seed))
    mine = ours(places)
    # Compare from the last detection on; other tests cover the association.
    last = max(step for step, place in enumerate(places) if place is not None)
    np.testing.assert_allclose(mine[last:], stone_soup(places[last:], mine[last]), atol=2e-3)
    assert mine[:GONE].max() > 0.95 and mine[GONE + 9] < 0.05


def test_empty_scans_of_a_half_hidden_lane_leave_the_hidden_half():
    """r (1 - pd) / (1 - r pd), with pd the visible share times that of the sensor; the limit is 1/3."""
    law, r, in_view = [], 0.5, 0.5
    for _ in range(10):
        pd = FOUND * in_view
        r, in_view = r * (1.0 - pd) / (1.0 - r * pd), in_view * (1.0 - FOUND) / (1.0 - pd)
        law.append(r)
    # One side: in view, or hidden and two seconds from coming into view, or none; the radar works.
    weights, mine = np.zeros((STATES, 2)), []
    weights[2 * NONE, 1], weights[2 * (FIRST_BIN + 3), 0], weights[2 * NONE, 0] = 0.25, 0.25, 0.5
    belief, street = JointBelief(weights), StreetModel(works=1.0)
    for scan in range(10):
        stamp_ns = round(scan * 1e9 * street.look_s)
        belief = belief.looked("radar", Absent(miss_rate=1.0 - FOUND), stamp_ns, street)
        mine.append(sum(belief.explanations[:2]))
    np.testing.assert_allclose(mine, law, atol=1e-9)
    assert law[-1] == pytest.approx(1.0 / 3.0, abs=1e-3)


def test_the_example_prints_the_output_on_the_page(capsys):
    pytest.importorskip("stonesoup", reason="Stone Soup is the oracle: pip install 'worldstate[oracles]'")
    docs = Path(__file__).resolve().parents[2] / "docs"
    runpy.run_path(str(docs / "examples" / "stone_soup.py"), run_name="__main__")
    page = (docs / "guide" / "from_stone_soup_and_odas.md").read_text(encoding="utf-8")
    assert f"```text\n{capsys.readouterr().out}```" in page
