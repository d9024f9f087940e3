"""Effect of the camera, its miss rates and eq. (5) on real recordings, and awareness by camera state."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from worldstate.abduction.cueing.cueing_policy import neyman_pearson_threshold
from worldstate.adapters.acoustic import Grounding
from worldstate.adapters.camera.miss_rates import FamilyCounts, MissRates
from worldstate.ground.parallel import in_processes
from worldstate.ground.typing import BoolArray, FloatArray
from worldstate.operations.metrics.approach_table import (
    ApproachTable,
    Figures,
    mean_of,
    onset_outcome,
    rising_edges,
)
from worldstate.operations.recordings.hop_table import HopTable
from worldstate_lab.evaluation.ablation_rows import AblationSwitches, ablation_table, evaluate_ablation
from worldstate_lab.metrics.intervals import deal_folds, middle, pooled_share, stratified_draws
from worldstate_lab.trials.pass_cache import ALPHA

from .hearing import Chain, heard
from .recordings import CornerRecording

# Miss rate of a fully trusted camera; at a rate of zero the logarithm would be infinite.
_NEVER = 1e-6
_NO_MISS = FamilyCounts(((1e9,) * 5,), ((0.0,) * 5,), (1e3,) * 5, (0.0,) * 5)
TRUSTED = MissRates((0.0, 90.0), {"trusted": _NO_MISS})


def corner_rows(
    chain: Chain,
    recordings: Sequence[CornerRecording],
    measured: MissRates | None,
    degradation: float,
    switches: AblationSwitches,
    seed: int,
    jobs: int = 1,
) -> dict[str, dict[str, Figures]]:
    """Return the ablation rows of the paper's statistic and of the shipped system with one camera."""
    last_s = last_seen_s(recordings, chain)
    made = {
        name: list(in_processes(partial(_stream, one, last_s), recordings, jobs))
        for name, one in variants(chain, measured, degradation).items()
    }
    prior = list(chain.model.signature.reference_prior)
    by_statistic = statistic_rows(made["product"], prior, seed, switches)
    return {
        "statistic": by_statistic,
        "product": {name: product_row(some, np.random.default_rng(seed)) for name, some in made.items()},
    }


def variants(chain: Chain, measured: MissRates | None, degradation: float) -> dict[str, Chain]:
    """Return the system with one change at a time; with measured miss rates it also receives d."""
    grounded = replace(chain.settings, grounding=Grounding())
    found = {"product": chain, "product, vision trusted": replace(chain, miss_rates=TRUSTED)}
    if chain.boxes == "boxes":
        # Without a camera, its degradation has no effect; eq. (5) concerns only the sound.
        found["product, no camera"] = replace(chain, boxes=None)
        found["product, eq. (5)"] = replace(chain, settings=grounded)
    if measured is not None:
        found["product, measured beta"] = replace(chain, miss_rates=measured, degradation=degradation)
    return found


def _stream(chain: Chain, last_s: Mapping[str, float], recording: CornerRecording) -> HopTable:
    """Process a recording; the column `there` marks hops until the vehicle leaves the view (clean boxes)."""
    hops = heard(chain, recording).hops
    there = (hops.time_s > hops.t0_s) & (hops.time_s <= last_s[recording.name])
    return hops.replace(log_likelihoods=hops.shipped, there=there)


def last_seen_s(recordings: Sequence[CornerRecording], chain: Chain) -> dict[str, float]:
    """Return the time of the last clean box of each approach's vehicle, or T0 if there is none."""
    found = {}
    for one in recordings:
        vision = replace(chain, boxes="boxes").source(one).camera_channel()
        stamps = vision.detections.stamps_ns
        seen = [any(box.moving for box in vision.sightings(int(stamp))) for stamp in stamps]
        times_s = stamps[np.array(seen, bool)] * 1e-9
        found[one.name] = float(times_s.max(initial=one.t0_s))
    return found


def statistic_rows(
    streams: Sequence[HopTable], prior: Sequence[float], seed: int, switches: AblationSwitches
) -> dict[str, dict[str, float | None]]:
    """Return the rows of the paper's statistic: each part off, the camera fully trusted, eq. (5) on."""
    changed = {
        "vision_trusted": [one.replace(miss_rate=np.full(len(one), _NEVER)) for one in streams],
        "eq_5": [one.replace(log_likelihoods=one.grounded) for one in streams],
        "eq_5_without_rate": [one.replace(log_likelihoods=one.rateless) for one in streams],
    }
    rows = {
        name: evaluate_ablation(some, prior, np.random.default_rng(seed), switches)
        for name, some in changed.items()
    }
    return {**ablation_table(streams, prior, seed, switches), **rows}


def product_row(streams: Sequence[HopTable], rng: np.random.Generator) -> Figures:
    """Return the figures of the published states of recordings.

    `aware` is the share of the hops from T0 to the last image with the vehicle in which an object is
    detected, or P(hidden) + P(visible) is above the threshold that 2 % of the hazard-free hops exceed (five
    folds). `vision_only` is the share in which an object is detected.
    """
    approaches = [one for one in streams if not one.hazard_free]
    free = [one for one in streams if one.hazard_free]
    alarms = {one.name: np.asarray(one.advised.any(axis=1), bool) for one in streams}
    outcomes = [onset_outcome(one.time_s[rising_edges(alarms[one.name])], one.t0_s) for one in approaches]
    found = ApproachTable(outcomes, [alarms[one.name] for one in free]).figures()
    aware = _aware(streams, rng)
    in_view = [(one, one.after_sight()) for one in approaches]
    hits = np.array([aware[one.name][there].sum() for one, there in in_view])
    draws = stratified_draws([str(one.about["site"]) for one in approaches], rng)
    share, drawn = pooled_share(hits, np.array([there.sum() for _, there in in_view]), draws)
    sites = sorted({str(one.about["site"]) for one in free})
    by_site = {site: [aware[one.name] for one in free if one.about["site"] == site] for site in sites}
    return {
        "warned": sum(one.detected for one in outcomes),
        "approaches": len(approaches),
        "lead_s": found["lead_s"],
        "onsets": sum(len(rising_edges(alarms[one.name])) for one in free),
        "advisory_share": found["hazard_free_share"],
        **{"aware": share, "aware_low": middle(drawn)[0], "aware_high": middle(drawn)[1]},
        "vision_only": mean_of(np.concatenate([one.seen[there] for one, there in in_view])),
        **{f"hazard_free_aware_{site}": mean_of(np.concatenate(some)) for site, some in by_site.items()},
    }


def _aware(streams: Sequence[HopTable], rng: np.random.Generator) -> dict[str, BoolArray]:
    """Return the aware hops of each recording, with thresholds from the other folds."""
    sites = [str(one.about["site"]) for one in streams]
    folds = deal_folds([one.label for one in streams], sites, rng).tolist()
    found = {}
    for fold in set(folds):
        others = [one for one, at in zip(streams, folds, strict=True) if at != fold and one.hazard_free]
        gamma = neyman_pearson_threshold([_presence(one) for one in others], ALPHA)
        for one, at in zip(streams, folds, strict=True):
            if at == fold:
                found[one.name] = np.asarray(one.seen.astype(bool) | (_presence(one) >= gamma))
    return found


def _presence(hops: HopTable) -> FloatArray:
    """Return P(hidden) + P(visible) as published, shape (n,)."""
    return np.asarray(1.0 - hops.hypotheses[:, 2])
