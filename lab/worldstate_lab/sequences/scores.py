"""Figures of a score per hop, or of an alarm, on real recordings of street corners.

A recording is warned if any hop before T0 is in alarm; its lead is that of the first such hop, even if it is
more than five seconds. An onset is a rising edge, or an alarm at the first hop. A lasting alarm is on at 0.5
s before T0, and its lead counts from its own onset. Thresholds that are swept on the test recordings give a
curve and never a row of a table.

In trials without a hazard, `about` contains `leads_from_s`, the time to which leads refer.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from worldstate.abduction.cueing.risk_map import brier_skill, expected_calibration_error
from worldstate.abduction.sequence.sequence_inputs import SIDES
from worldstate.abduction.sequence.sequence_model import HORIZONS_S, SMOOTHED_HOPS
from worldstate.ground.typing import AnyArray, BoolArray, FloatArray, IndexArray
from worldstate.operations.metrics.approach_table import (
    AFTER_S,
    LONGEST_LEAD_S,
    SLACK_S,
    ApproachTable,
    mean_of,
    poisson_interval,
    rank_wins,
    rising_edges,
    share_interval,
)
from worldstate_lab.evaluation.reduction import hop_of
from worldstate_lab.metrics.intervals import (
    draw_weights,
    middle,
    pooled_draws,
    stratified_draws,
    weighted_areas,
)
from worldstate_lab.trials.trial import Trial

LEADS_S = (0.5, 1.0, 1.5, 2.0, 3.0)
# This long before T0 the vehicle is inaudible: a score above chance comes from the ambience of its recording.
CONTROLS_S = (5.0, 6.0)
# Limits of a curve: onsets, and hazard-free recordings in alarm.
LIMITS = {"onsets": (0, 1, 3, 6), "false_recordings": (0, 1, 2, 3)}
_LEAST_CHANCE = 1e-9  # Lower bound of a probability before its log-odds are computed
LASTS_S = 0.5  # Time before T0 at which a lasting alarm is on
PASSED_S = 2.0  # Time after T0; later advisories concern a vehicle that has passed
WITHIN_S = 2.0  # Horizon of the calibrated chance

Row = dict[str, Any]
Alarms = Sequence[BoolArray]  # One mask per trial, shape (n,)


def hop_before(trial: Trial, lead_s: float) -> IndexArray:
    """Return the hop that ends this long before T0, or before its substitute; empty if there is none.

    Examples
    --------
    >>> from worldstate.operations.recordings.hop_table import HopTable
    >>> trial = Trial(HopTable({"time_s": 1.0 + 0.1 * np.arange(21)}, "a", "left", 3.0))
    >>> hop_before(trial, 0.5).tolist(), hop_before(trial, 3.0).tolist()
    ([15], [])
    """
    from_s = trial.hops.about["leads_from_s"] if trial.hazard_free else trial.t0_s
    at = hop_of(np.array([from_s - lead_s]), trial.hops.time_s)
    return at[at >= 0]


def areas(parts: Sequence[FloatArray], positive: BoolArray, weights: FloatArray) -> FloatArray:
    """Return the AUROC of the scores of recordings, one part each, under each row of weights, shape (D,)."""
    near, calm = ([parts[i] for i in np.flatnonzero(of).tolist()] for of in (positive, ~positive))
    windows = np.array([len(one) for one in parts], np.float64)
    return weighted_areas(rank_wins(near, calm), windows, positive, weights)


def strata(trials: Sequence[Trial]) -> list[tuple[str, str]]:
    """Return label and junction of each trial, the strata of the draws."""
    return [(one.label, one.site) for one in trials]


def leads(
    trials: Sequence[Trial],
    scores: Sequence[FloatArray],
    sides: Sequence[FloatArray] | None,
    rng: np.random.Generator,
) -> dict[str, Row]:
    """Compare the hop of approaches at each lead time with the same hop, and all hops, of hazard-free ones.

    Shapes: scores and sides (n,) per trial; a side score is larger if the right is likelier. Intervals are
    the central 95 % over draws of recordings within each label at each junction.
    """
    draws = draw_weights(stratified_draws(strata(trials), rng), len(trials))
    weights = np.vstack([np.ones(len(trials)), draws])
    return {f"{one:g}": _lead(trials, scores, sides, weights, one) for one in (*LEADS_S, *CONTROLS_S)}


def _lead(
    trials: Sequence[Trial],
    scores: Sequence[FloatArray],
    sides: Sequence[FloatArray] | None,
    weights: FloatArray,
    lead_s: float,
) -> Row:
    hops, free = [hop_before(one, lead_s) for one in trials], np.array([one.hazard_free for one in trials])
    sites = np.array([one.site for one in trials])
    chosen = [score[hop] for score, hop in zip(scores, hops, strict=True)]
    every = [score if one.hazard_free else at for one, score, at in zip(trials, scores, chosen, strict=True)]
    there = np.array([hop.size for hop in hops])
    by_site = {site: areas(chosen, ~free, weights * (sites == site)) for site in np.unique(sites).tolist()}
    whole = {"auroc": areas(chosen, ~free, weights), "auroc_all_hops": areas(every, ~free, weights)}
    found = with_intervals(whole)
    found["auroc_by_junction"] = {site: float(values[0]) for site, values in by_site.items()}
    found["auroc_by_junction_interval"] = {site: middle(values[1:]) for site, values in by_site.items()}
    if sides is not None:
        parts = [sides[i][hops[i]] for i in np.flatnonzero(~free).tolist()]
        right = np.array([one.label == "right" for one in trials])[~free]
        found |= with_intervals({"side_auroc": areas(parts, right, weights[:, ~free])})
    return found | {"approaches": int(there[~free].sum()), "hazard_free": int(there[free].sum())}


def with_intervals(figures: Mapping[str, FloatArray]) -> Row:
    """Return the first value of every figure with the central interval of the draws after it."""
    found: Row = {}
    for name, values in figures.items():
        found |= {name: float(values[0]), f"{name}_interval": middle(values[1:])}
    return found


def first_lead_s(trial: Trial, alarm: BoolArray) -> float:
    """Return the time from the first alarm hop to T0; 0 if there is no alarm."""
    lead_s = trial.t0_s - trial.hops.time_s
    return float(lead_s.max(initial=0.0, where=alarm & (lead_s > SLACK_S)))


def lasting_lead_s(trial: Trial, alarm: BoolArray) -> float:
    """Return the time to T0 from the onset of the alarm that is on at `LASTS_S` before T0; 0 if none is."""
    onsets, times_s = rising_edges(alarm), trial.hops.time_s
    began = [onsets[onsets <= hop][-1] for hop in hop_before(trial, LASTS_S) if alarm[hop]]
    return float(trial.t0_s - times_s[began[0]]) if began else 0.0


def alarm_row(trials: Sequence[Trial], passes: Sequence[Alarms], rng: np.random.Generator) -> Row:
    """Return detections and false alarms of an alarm, mean over passes such as seeds.

    `advisory_share` is the share of hazard-free hops in alarm, `after_pass_share` that of hops from
    `PASSED_S` to `AFTER_S` after T0, and `interval` the exact interval of the onsets per hour.

    Examples
    --------
    >>> from worldstate.operations.recordings.hop_table import HopTable
    >>> hops = HopTable({"time_s": 1.0 + 0.1 * np.arange(40)}, "a", "left", 3.0, {"site": "SA1"})
    >>> trials = [Trial(hops), Trial(hops.replace(label="none"))]
    >>> alarm = hops.time_s > 2.05
    >>> found = alarm_row(trials, [[alarm, alarm]], np.random.default_rng(0))
    >>> found["text"], round(found["lead_s"], 2), round(found["lasting_lead_s"], 2), found["after_pass_share"]
    ('1 of 1 at 1 false onset', 0.9, 0.9, None)
    """
    near = [i for i, one in enumerate(trials) if not one.hazard_free]
    approaches, calm = [trials[i] for i in near], [i for i, one in enumerate(trials) if one.hazard_free]
    first, lasting = (
        np.array([[of(trials[i], alarms[i]) for i in near] for alarms in passes])
        for of in (first_lead_s, lasting_lead_s)
    )
    tables = [ApproachTable([], [alarms[i] for i in calm]) for alarms in passes]
    found = _warned(first, lasting) | _false_alarms(tables)
    passed = [alarms[i][_passed(trials[i])] for alarms in passes for i in near]
    found["after_pass_share"] = mean_of(np.concatenate(passed))
    drawn = first.mean(axis=0)[stratified_draws(strata(approaches), rng)].mean(axis=1)
    found["lead_s_missed_0_interval"] = middle(drawn)
    onsets = f"{found['onsets']:g} false onset{'s' * (found['onsets'] != 1)}"
    return {"text": f"{found['count']:g} of {len(near)} at {onsets}"} | found


def _passed(trial: Trial) -> BoolArray:
    after_s = trial.hops.time_s - trial.t0_s
    return np.asarray((after_s > PASSED_S - SLACK_S) & (after_s < AFTER_S + SLACK_S))


def _warned(first: FloatArray, lasting: FloatArray) -> Row:
    """Return the part of a row on approaches; shapes (passes, approaches)."""
    warned, stand = first > 0.0, lasting > 0.0
    count, n = float(warned.sum(axis=1).mean()), first.shape[1]
    return {
        "warned": mean_of(warned.ravel()),
        "warned_interval": share_interval(round(count), n),
        "count": count,
        "lead_s": mean_of(first[warned]),
        "lead_s_missed_0": mean_of(first.ravel()),
        "lasting": mean_of(stand.ravel()),
        "lasting_count": float(stand.sum(axis=1).mean()),
        "lasting_lead_s": mean_of(lasting.ravel()),
        "leads_beyond_5_s": np.sort(first[0][first[0] > LONGEST_LEAD_S + SLACK_S]).round(1).tolist(),
    }


def _false_alarms(tables: Sequence[ApproachTable]) -> Row:
    """Return the part of a row on hazard-free time, from one table per pass."""
    onsets, hours = float(np.mean([one.onsets for one in tables])), tables[0].hours
    calm = [one for table in tables for one in table.hazard_free]
    return {
        "onsets": onsets,
        "alarms_per_hour": onsets / hours,
        # All passes cover the same hours, so their mean count is treated as one count.
        "interval": poisson_interval(round(onsets), hours),
        "false_recordings": sum(bool(one.any()) for one in calm) / len(tables),
        "advisory_share": mean_of(np.concatenate(calm)),
    }


def curve(
    trials: Sequence[Trial], scores: Sequence[FloatArray], limited: str, rng: np.random.Generator
) -> dict[str, Row]:
    """Return, for each limit of one of `LIMITS`, the row of the best threshold with at most that many.

    The best threshold has the most warned recordings and, among equals, the longest mean lead.
    """
    swept, rows = sweep(trials, scores), {}
    order = np.lexsort((swept["level"], swept["lead_s"], swept["warned"]))
    for n in LIMITS[limited]:
        level = float(swept["level"][order[swept[limited][order] <= n][-1]])
        alarms = [score >= level for score in scores]
        rows[f"{n}"] = alarm_row(trials, [alarms], rng) | {"threshold": level}
    return rows


def sweep(trials: Sequence[Trial], scores: Sequence[FloatArray]) -> Mapping[str, FloatArray]:
    """Return onsets, false and warned recordings, and summed lead by threshold, shape (levels,) each."""
    levels = np.append(np.unique(np.concatenate(scores)), np.inf)
    found = {name: np.zeros(len(levels)) for name in ("onsets", "false_recordings", "warned", "lead_s")}
    for trial, score in zip(trials, scores, strict=True):
        alarm = score >= levels[:, None]
        if trial.hazard_free:
            found["onsets"] += (alarm & ~np.pad(alarm, ((0, 0), (1, 0)))[:, :-1]).sum(axis=1)
            found["false_recordings"] += alarm.any(axis=1)
        else:
            lead_s = np.maximum(trial.t0_s - trial.hops.time_s, 0.0)
            # Rounded to milliseconds, so that equal leads give equal sums in any order of summation.
            first = np.where(alarm & (lead_s > SLACK_S), lead_s, 0.0).max(axis=1).round(3)
            found["warned"] += first > 0.0
            found["lead_s"] += first
    return found | {"level": levels}


def calibration(trials: Sequence[Trial], rng: np.random.Generator) -> Row:
    """Return calibration and skill of the chances that a vehicle comes into view within `WITHIN_S` on a side.

    Both sides are used, at hops before T0 of approaches and at all hops of hazard-free recordings.
    """
    parts = [_chances(one) for one in trials]
    if not sum(map(len, parts)):
        return {"ece": None, "brier_skill": None, "base_rate": None, "hops": 0}
    every = np.concatenate(parts)
    drawn = [_calibrated(one) for one in pooled_draws(parts, strata(trials), rng)]
    found: Row = _calibrated(every) | {
        "base_rate": float(every[:, 1].mean()),
        "hops": len(every) // len(SIDES),
    }
    spread = {f"{name}_interval": middle(np.array([one[name] for one in drawn], float)) for name in drawn[0]}
    return found | spread


def log_odds(chance: FloatArray) -> FloatArray:
    """Return the log-odds of probabilities of any shape; those near zero and one are bounded."""
    bounded = np.clip(chance, _LEAST_CHANCE, 1.0 - _LEAST_CHANCE)
    return np.asarray(np.log(bounded) - np.log1p(-bounded))


def smoothed(values: FloatArray) -> FloatArray:
    """Return the mean of the last three hops, same shape."""
    recent = np.arange(len(values))[:, None] + np.arange(1 - SMOOTHED_HOPS, 1)
    return np.asarray(values[np.maximum(recent, 0)].mean(axis=1))


def _calibrated(pairs: AnyArray) -> dict[str, float | None]:
    """Return the calibration figures of pairs of predicted chance and outcome, shape (n, 2)."""
    said, true = pairs[:, 0], pairs[:, 1]
    return {"ece": expected_calibration_error(said, true), "brier_skill": brier_skill(said, true)}


def _chances(trial: Trial) -> FloatArray:
    """Return the predicted chance and the outcome of each side, shape (2 n, 2)."""
    said = trial.hops.within[:, :, HORIZONS_S.index(WITHIN_S)]
    coming_s = (trial.t0_s - trial.hops.time_s)[:, None] + np.zeros(len(SIDES))
    own = np.array([side == trial.label for side in SIDES])
    true = own & (coming_s <= WITHIN_S + SLACK_S)
    scored = np.isfinite(said) & (trial.hazard_free | (coming_s > SLACK_S))
    return np.stack([said[scored], true[scored]], axis=-1)
