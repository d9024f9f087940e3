"""Arguments that evidence, models and policies refuse, one row for each."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from worldstate.abduction.co_evidence import Absent, MissRateTable, default_miss_rates, isotonic_grid
from worldstate.abduction.cueing.cueing_policy import CueingPolicy
from worldstate.abduction.cueing.risk_map import IsotonicMap, PlattMap
from worldstate.abduction.cueing.thresholds import neyman_pearson_threshold
from worldstate.abduction.evidence import SignatureEvidence, abduce, statistic
from worldstate.abduction.grounding.grounded_likelihood import (
    Coupling,
    Descriptor,
    GroundedObservation,
    Observable,
    car,
    engine_line,
    ground,
)
from worldstate.abduction.road_users import DomainGuard
from worldstate.abduction.sequence.sequence_inputs import INPUTS
from worldstate.abduction.sequence.sequence_model import BoostedTrees
from worldstate.abduction.sequence.street_sides import SidePatterns
from worldstate.abduction.signature.ensemble_training import SiteEnsembleClassifier
from worldstate.abduction.signature.site_estimate import SiteEstimate
from worldstate.abduction.signature.window_classes import CLASSES, checked_classes
from worldstate.adapters.files.model_file import read_model
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.serialisation import decode

ONE = SignatureEvidence(("left",), (0.0,), 0.0, 0.0)
TWO = SignatureEvidence(("left", "right"), (0.0, 0.0), 0.0, 0.0)
QUARTERS = (0.25, 0.25, 0.25, 0.25)
STUMP = {
    **{"split": [[0, 0, 0]], "threshold": [[0.5, 0.0, 0.0]], "yes": [[1, 1, 2]], "no": [[2, 1, 2]]},
    **{"value": [[0.0, -1.0, 1.0]], "tree_class": [0], "baseline": [0.0, 0.0]},
}


def misses(beta, azimuths=(0, 30), levels=(0, 1)):
    return lambda: MissRateTable(azimuths, levels, beta)


def policy(**changes):
    return lambda: replace(CueingPolicy(0.78, 3, 0.02, QUARTERS, PlattMap(-1.0, 0.0)), **changes)


def threshold(recordings, alpha=0.1, hops=1):
    return lambda: neyman_pearson_threshold(recordings, alpha, hops)


def trees(**changes):
    return lambda: BoostedTrees(**(STUMP | changes))


def signature(**changes):
    return lambda: replace(read_model().signature, **changes)


def window(features):
    return lambda: read_model().signature.predict_proba(features)


def fitted(width, labels):
    rng = np.random.default_rng(0)
    return lambda: SiteEnsembleClassifier().fit(rng.random((8, width)), np.array(labels))


REFUSALS: dict[str, tuple[Callable[[], object], str]] = {
    "miss rate that falls with degradation": (misses(((0.2, 0.1), (0.3, 0.4))), "beta"),
    "miss rate that falls with azimuth": (misses(((0.2, 0.3), (0.1, 0.4))), "beta"),
    "miss rate above one": (misses(((0.2, 1.3), (0.3, 1.4))), "beta"),
    "miss rates without a row for each azimuth": (misses(((0.2, 0.3),)), "beta"),
    "miss rate that is no number": (misses(((0.2, np.nan), (0.3, 0.4))), "beta"),
    "azimuths that do not begin at zero": (misses(((0.2, 0.3), (0.3, 0.4)), (5, 30)), "azimuth_deg"),
    "azimuths that fall": (misses(((0.2, 0.3), (0.3, 0.4)), (30, 0)), "azimuth_deg"),
    "degradations above one": (misses(((0.2, 0.3), (0.3, 0.4)), (0, 30), (0, 2)), "degradation"),
    "degradation outside of the table": (lambda: default_miss_rates()(0.0, 1.2), "degradation"),
    "grid with a weight of zero": (lambda: isotonic_grid([[0.5]], [[0.0]]), "weights"),
    "grid with a negative weight": (lambda: isotonic_grid([[0.5]], [[-1.0]]), "weights"),
    "grid with more weights than values": (lambda: isotonic_grid([[0.5]], [[1.0, 1.0]]), "weights"),
    "threshold without recordings": (threshold([]), ""),
    "threshold of an empty recording": (threshold([[]]), ""),
    "threshold of a score that is no number": (threshold([[0.5, np.nan]]), ""),
    "threshold for a budget of one": (threshold([[0.5]], 1.0), "alpha"),
    "threshold for a negative budget": (threshold([[0.5]], -0.1), "alpha"),
    "threshold for no hops": (threshold([[0.5]], 0.1, 0), "hops"),
    "policy that is sustained for no hops": (policy(sustain_hops=0), "sustain_hops"),
    "policy with a budget of one": (policy(alpha=1.0), "alpha"),
    "policy with a prior of two classes": (policy(reference_prior=(0.5, 0.5)), "reference_prior"),
    "policy with a prior that sums to 1.5": (policy(reference_prior=(0.5, 0.5, 0.5)), "reference_prior"),
    "policy with a miss rate above one": (policy(miss_rate=2.0), "miss_rate"),
    "risk map that falls": (lambda: PlattMap(1.0, 0.0), "slope"),
    "risk map with statistics that fall": (lambda: IsotonicMap((0.5, 0.1), (0.0, 1.0)), "do not fall"),
    "risk map with a risk above one": (lambda: IsotonicMap((0.1, 0.5), (0.0, 1.5)), "risks"),
    "prior of two explanations for four": (lambda: abduce([0.0, 0.0], TWO, Absent(0.1)), "log_prior"),
    "prior that is no number": (lambda: abduce([0.0, 0.0, np.nan, 0.0], TWO, Absent(0.1)), "log_prior"),
    "infinite prior": (lambda: abduce([0.0, 0.0, np.inf, 0.0], TWO, Absent(0.1)), "log_prior"),
    "prior that excludes everything": (lambda: abduce([-np.inf] * 4, TWO, Absent(0.1)), "log_prior"),
    "observation that nothing explains": (
        lambda: abduce([-np.inf, 0.0, -np.inf], ONE, Absent(0.0)),
        "co-evidence",
    ),
    "negative prior of a statistic": (lambda: statistic(ONE, Absent(0.0), (0.5, -0.1, 0.6)), "negative"),
    "no descriptors": (lambda: ground(ONE, GroundedObservation(), []), "descriptors"),
    "one descriptor twice": (lambda: ground(ONE, GroundedObservation(), [car(), car()]), "descriptors"),
    "observable with a negative spread": (lambda: Observable(1.0, -1.0), "std"),
    "coupling with one speed twice": (lambda: Coupling("x", (1.0, 1.0), ((0.0, 1.0),), 1.0), "rising"),
    "descriptor with one observable twice": (
        lambda: Descriptor("car", (), 1.0, 8.0, 1.0, (engine_line(), engine_line())),
        "each observable once",
    ),
    "guard with one bias for three classes": (
        lambda: DomainGuard(("x",), ("speech",), ("siren",), np.zeros((3, 1)), np.zeros(1), 1.0, 1.0),
        "biases",
    ),
    "tree with a cycle": (trees(yes=[[1, 0, 2]]), "yes"),
    "tree with one leaf as both answers": (trees(no=[[2, 2, 2]]), "leaf"),
    "tree with two ways to a node": (trees(no=[[1, 1, 2]]), "one way to every node"),
    "tree that splits by an unknown input": (trees(split=[[900, 0, 0]]), "split"),
    "tree of an unknown class": (trees(tree_class=[3]), "tree_class"),
    "sequence model with other inputs": (
        lambda: replace(read_model().sequence, inputs=INPUTS[1:]),
        "inputs: expected the first",
    ),
    "side patterns with one sector": (lambda: SidePatterns(sums=((0.0,), (0.0,))), "12 sectors"),
    "site estimate of a negative duration": (
        lambda: decode(SiteEstimate, {"level": [0.0], "heard_s": -1.0}, "file"),
        "heard_s",
    ),
    "site estimate of 30 features beside a model of 60": (
        lambda: SiteEstimate.start(30).reference(read_model().signature),
        "60",
    ),
    "ensemble of too many experts": (signature(experts=read_model().signature.experts * 20), "experts"),
    "ensemble with a short reference": (signature(home=read_model().signature.home[:-6]), "home"),
    "expert of an unknown view": (lambda: replace(read_model().signature.experts[0], view="colour"), "view"),
    "window of 59 features": (window(np.zeros((3, 59))), "X"),
    "window without a row": (window(np.zeros(60)), "X"),
    "window that is no number": (window(np.full((1, 60), np.nan)), "X"),
    "window with two references": (window(np.zeros((1, 180))), "X"),
    "training without references": (fitted(61, (*CLASSES, *CLASSES)), "reference"),
    "training without a class": (fitted(240, ("left", "front", "right", "left") * 2), "classes"),
    "window classes without front and none": (lambda: checked_classes(("left", "right")), "classes"),
    "window classes in another order": (lambda: checked_classes((*CLASSES, "direct", "both")), "classes"),
    "unknown window class": (lambda: checked_classes((*CLASSES, "tram")), "classes"),
}


@pytest.mark.parametrize(("call", "words"), REFUSALS.values(), ids=REFUSALS)
def test_refuses(call, words):
    with pytest.raises(InvalidArgumentError, match=words):
        call()
