"""False alarms at equal detection: what two ways to warn cost where their thresholds detect as much."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.abduction.cueing.cueing_policy import sustained_alarm
from worldstate.abduction.sequence.sequence_model import held
from worldstate.ground.typing import BoolArray, FloatArray, IndexArray
from worldstate.operations.metrics.approach_table import SECONDS_PER_HOUR
from worldstate.operations.recordings.hop_table import HOP_S
from worldstate_lab.methods.acoustic_rules import SUSTAIN_CHOICES
from worldstate_lab.metrics.intervals import draw_weights, middle, ratio
from worldstate_lab.trials.trial import Decisions, Trial

from .reduction import alarm_counts

BASELINE, OURS = "published, sustained", "world-state advisory"
DETECTED = (0.8, 0.85, 0.9, 0.95)
# Shares of the hazard-free scores above a threshold, where few alarms are left each of them by itself; and
# of the scores before T0, beside the highest one of each approach, above which it is missed.
_CALM_SHARES, _NEAR_SHARES = np.geomspace(1e-5, 0.5, 60), np.linspace(0.0, 1.0, 30)
_COUNTS = ("approaches", "detected", "free_hops", "free_onsets")
# From a score and a threshold to the alarm of a recording.
Rule = Callable[[FloatArray, float], BoolArray]


@dataclass(frozen=True, slots=True, eq=False)
class OperatingCurve:
    """What the alarms of every threshold count on every recording, shape (thresholds, R) each."""

    counts: Mapping[str, FloatArray]

    def alarms_per_hour(self, detected: float, weights: FloatArray) -> FloatArray:
        """Return the least false alarms an hour of a threshold that detects so much, shape (D,).

        Recording r counts weights[d, r] times; infinite where no threshold detects so much.
        """
        sums = {name: weights @ count.T for name, count in self.counts.items()}
        share = ratio(sums["detected"], sums["approaches"])
        rate = ratio(sums["free_onsets"], sums["free_hops"] * HOP_S / SECONDS_PER_HOUR)
        return np.asarray(np.where(share >= detected - 1e-9, rate, np.inf).min(axis=1))


@dataclass(frozen=True, slots=True)
class EqualDetection:
    """Two ways to warn where both detect so much."""

    detected: float
    ours: float  # False alarms an hour; infinite where no threshold detects so much
    baseline: float
    ratio: float  # Of ours to the baseline's, with the middle 95 % over draws of recordings
    low: float
    high: float


def operating_curve(
    trials: Sequence[Trial], said: Sequence[Decisions], rules: Iterable[Rule]
) -> OperatingCurve:
    """Return the curve of some rules over all thresholds of their score."""
    levels = _levels(trials, said)
    rows = [
        [_counted(trial, one, rule(one.score, level)) for trial, one in zip(trials, said, strict=True)]
        for rule in rules
        for level in levels
    ]
    return OperatingCurve({name: np.array([[one[name] for one in row] for row in rows]) for name in _COUNTS})


def _levels(trials: Sequence[Trial], said: Sequence[Decisions]) -> list[float]:
    """Return thresholds from where half of the hazard-free hops are above to where none is."""
    pairs = list(zip(trials, said, strict=True))
    calm = np.concatenate([one.score for trial, one in pairs if trial.hazard_free])
    near = [one.score[trial.hops.before_sight()] for trial, one in pairs if not trial.hazard_free]
    found = [np.quantile(calm, 1.0 - _CALM_SHARES, method="higher"), [np.nextafter(calm.max(), np.inf)]]
    found += [[one.max() for one in near if one.size]]
    found += [np.quantile(np.concatenate(near), 1.0 - _NEAR_SHARES, method="higher")]
    return [float(level) for level in np.unique(np.concatenate(found))]


def equal_detection(
    trials: Sequence[Trial], decisions: Mapping[str, Sequence[Sequence[Decisions]]], draws: IndexArray
) -> list[EqualDetection]:
    """Compare the world-state's alarm with the sustained baseline, each at its best threshold, as detected.

    The baseline's sustained hops are chosen with its threshold. Nothing where either was not scored.
    """
    if BASELINE not in decisions or OURS not in decisions:
        return []
    sustained = [_sustained(hops) for hops in SUSTAIN_CHOICES]
    baseline = operating_curve(trials, decisions[BASELINE][0], sustained)
    ours = operating_curve(trials, decisions[OURS][0], [_held])
    weights = np.vstack([np.ones(len(trials)), draw_weights(draws, len(trials))])
    return [_compared(share, ours, baseline, weights) for share in DETECTED]


def _compared(
    detected: float, ours: OperatingCurve, baseline: OperatingCurve, weights: FloatArray
) -> EqualDetection:
    a, b = (curve.alarms_per_hour(detected, weights) for curve in (ours, baseline))
    # On a draw without alarms, or that one of them cannot detect so much of, there is nothing to compare.
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = a / b
    shares[1:][np.isinf(shares[1:])] = np.nan
    return EqualDetection(detected, float(a[0]), float(b[0]), float(shares[0]), *middle(shares[1:]))


def _counted(trial: Trial, said: Decisions, alarm: BoolArray) -> dict[str, float]:
    found = alarm_counts(trial, Decisions.of(said.time_s, alarm))
    return {name: found.get(name, 0.0) for name in _COUNTS}


def _held(score: FloatArray, threshold: float) -> BoolArray:
    """Return the alarm of a sequence: its score is a mean over .3 s already, and it stays for a second."""
    return held(score >= threshold)


def _sustained(hops: int) -> Rule:
    return lambda score, threshold: sustained_alarm(score >= threshold, hops)
