"""Learning of a site in the running chain: option, checkpoints and effect on mostly empty streets."""

from dataclasses import replace

import numpy as np
import pytest

from worldstate.abduction.co_evidence import Absent
from worldstate.abduction.cueing.thresholds import neyman_pearson_threshold
from worldstate.abduction.evidence import statistic
from worldstate.abduction.signature import site_estimate
from worldstate.abduction.signature.ensemble import site_reference
from worldstate.abduction.signature.ensemble_training import SiteEnsembleClassifier
from worldstate.abduction.signature.site_estimate import SiteEstimate, SiteEstimateSettings, SiteSignature
from worldstate.abduction.signature.window_classes import hazard_statistic
from worldstate.adapters.files.checkpoint_file import Checkpoint
from worldstate.adapters.source import ListenSettings, open_source
from worldstate.ground.errors import InvalidArgumentError

CLASSES = ("front", "left", "none", "right")
AZIMUTH = np.tile(np.linspace(-1, 1, 30), 2)
SHAPES = {"front": 1 + AZIMUTH**2, "none": 0 * AZIMUTH, "left": 0.7 - AZIMUTH, "right": 0.7 + AZIMUTH}


def windows(rng, labels, site=0.0, spread=0.7):
    """Return log-levels of vehicles and a street of level `site`; the louder one dominates."""
    vehicle = np.stack([SHAPES[label] for label in labels])
    return np.logaddexp(site, vehicle) + spread * rng.normal(size=vehicle.shape)


def made_up_sites(rng, n_sites=6, n=80):
    X, y = [], []
    for _ in range(n_sites):
        labels = rng.permutation(np.repeat(CLASSES, n // 4))
        levels = windows(rng, labels, street(rng))
        X.append(np.hstack([np.exp(levels), np.tile(site_reference(levels), (n, 1))]))
        y.append(labels)
    return np.vstack(X), np.concatenate(y)


def street(rng):
    bumps = np.tile(np.interp(np.arange(30), [0, 10, 20, 29], rng.normal(0.0, 0.4, 4)), 2)
    return bumps + rng.normal(0.0, 0.3)


@pytest.fixture(scope="module")
def model():
    return SiteEnsembleClassifier().fit(*made_up_sites(np.random.default_rng(0))).model_


def test_site_adaptation_has_a_switch_and_may_start_from_a_known_site(approach, model):
    settings = (ListenSettings(site_adaptation=flag) for flag in (True, False))
    on, off = (replace(open_source(approach.folder, settings=one), model=model) for one in settings)
    first, second, published, window = on.signature(), on.signature(), object(), np.exp(model.empty)
    assert isinstance(first, SiteSignature) and off.signature() is model
    assert replace(on, model=published).signature() is published
    assert ListenSettings(forgetting_s=7.0).site() == SiteEstimateSettings(7.0)
    unknown = first.evidence(window)
    assert second.estimate.heard_s == 0.0, "every pass over a source starts without a site"

    def known(site):
        return replace(on, before=Checkpoint(on.world(), site)).signature()

    assert known(SiteEstimate(model.empty + AZIMUTH, heard_s=300.0)).evidence(window) != unknown
    with pytest.raises(InvalidArgumentError, match="estimate"):
        known(SiteEstimate.start(59))


def decided(model, gamma, stream):
    """Return decisions on a stream with and without the learned site."""
    signature = SiteSignature(model)
    pairs = [(signature.evidence(window), model.evidence(window)) for window in stream]
    answer, prior = Absent(0.0), model.reference_prior
    return np.array([[statistic(one, answer, prior) >= gamma for one in pair] for pair in pairs])


@pytest.mark.long
@pytest.mark.slow
def test_learning_on_mostly_empty_streets_loses_no_detections(model, monkeypatch):
    monkeypatch.setattr(site_estimate, "HOP_S", 1.0)  # Windows that do not overlap
    rng = np.random.default_rng(100)
    X, y = made_up_sites(rng)
    calm = hazard_statistic(model.predict_proba(X), 0.0)[y == "none"]
    gamma = neyman_pearson_threshold(list(calm[:, None]), 0.02)
    decisions, hazards = [], []
    for site in [np.zeros(60), *(street(rng) for _ in range(4))]:
        labels = np.where(rng.random(300) < 0.95, "none", "left")
        decisions.append(decided(model, gamma, np.exp(windows(rng, labels, site))))
        hazards.append(labels == "left")
    on, off = np.concatenate(decisions).T
    hazard = np.concatenate(hazards)
    assert hazard.sum() > 50
    assert on[hazard].mean() >= off[hazard].mean() - 0.05
    assert on[~hazard].mean() <= off[~hazard].mean() + 0.01
