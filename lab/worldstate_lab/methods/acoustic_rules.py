"""Rows of Table I with decisions from sound: published, sustained and calibrated rules, and whole chains."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.abduction.cueing.cueing_policy import neyman_pearson_threshold, sustained_alarm
from worldstate.abduction.cueing.risk_map import fit_isotonic
from worldstate.ground.typing import BoolArray, FloatArray, IntArray
from worldstate.operations.metrics.approach_table import auroc, onset_outcome, rising_edges
from worldstate.operations.recordings.hop_table import HopTable
from worldstate_lab.metrics.stream_statistic import stream_statistic
from worldstate_lab.trials.classification import SIDE_COLUMNS, posteriors
from worldstate_lab.trials.trial import LEFT, RIGHT, Decide, Decisions, Trial

# Each of the k hops costs 0.1 s of lead time.
SUSTAIN_CHOICES = (2, 3, 4, 5)


def argmax_is_side(trial: Trial, evidence: str) -> BoolArray:
    """Return whether the most probable class is left or right, shape (n,): the published rule."""
    return np.asarray(posteriors(trial, evidence).argmax(axis=1) < SIDE_COLUMNS.stop)


def likelier_side(trial: Trial, evidence: str) -> IntArray:
    """Return the side with the larger posterior at every hop, shape (n,)."""
    left, right = posteriors(trial, evidence)[:, SIDE_COLUMNS].T
    return np.where(left >= right, LEFT, RIGHT)


def onsets_s(trial: Trial, alarm: BoolArray) -> list[float]:
    """Return the times at which an alarm begins, in seconds."""
    return [float(time_s) for time_s in trial.hops.time_s[rising_edges(alarm)]]


def best_sustain(calibration: Sequence[Trial], evidence: str) -> int:
    """Return the k with the largest share of detected approaches minus share of quiet recordings in alarm."""
    named = [(trial, argmax_is_side(trial, evidence)) for trial in calibration]

    def gain(hops: int) -> float:
        found: list[bool] = []
        alarmed: list[bool] = []
        for trial, side_named in named:
            onsets = onsets_s(trial, sustained_alarm(side_named, hops))
            if trial.hazard_free:
                alarmed.append(bool(onsets))
            else:
                found.append(onset_outcome(onsets, trial.t0_s).detected)
        return _share(found) - _share(alarmed)

    # Among equal gains the smallest k is used, which gives the longest lead time.
    return max(SUSTAIN_CHOICES, key=lambda hops: (gain(hops), -hops))


def _share(flags: Sequence[bool]) -> float:
    return sum(flags) / max(len(flags), 1)


def labelled_windows(
    streams: Sequence[HopTable], scores: Sequence[FloatArray]
) -> tuple[FloatArray, BoolArray]:
    """Return score and hazard label of all windows up to T0 and all hazard-free ones, shape (n,) each."""
    pairs = list(zip(streams, scores, strict=True))
    used = [score if one.hazard_free else score[one.before_sight()] for one, score in pairs]
    labels = [np.full(score.size, not one.hazard_free) for one, score in zip(streams, used, strict=True)]
    return np.concatenate(used), np.concatenate(labels)


def best_weight(
    streams: Sequence[HopTable], weights: Sequence[float], statistic: Callable[[HopTable, float], FloatArray]
) -> float:
    """Return the weight of looming with the largest window AUROC, the smallest among equals."""
    if len(weights) == 1:
        return weights[0]

    def area(weight: float) -> float:
        return auroc(*labelled_windows(streams, [statistic(one, weight) for one in streams])) or 0.0

    return max(weights, key=lambda weight: (area(weight), -weight))


@dataclass(frozen=True, slots=True)
class PublishedRule:
    """Alarm if the most probable class is left or right, in one hop or in k consecutive hops."""

    name: str
    sustained: bool = False
    evidence: str = "published"  # Source of the posteriors: see `classification.TRAINED`

    def fit(self, calibration: Sequence[Trial], rng: np.random.Generator, /) -> Decide:
        """Choose k if the rule is sustained; the classifier was trained before."""
        hops = best_sustain(calibration, self.evidence) if self.sustained else 1

        def decide(trial: Trial) -> Decisions:
            alarm = sustained_alarm(argmax_is_side(trial, self.evidence), hops)
            score = posteriors(trial, self.evidence)[:, SIDE_COLUMNS].sum(axis=1)
            return Decisions.of(
                trial.hops.time_s, alarm, side=likelier_side(trial, self.evidence), score=score
            )

        return decide


# Weights of the approach rate in nats per standard deviation; 0 leaves it out.
LOOMING_WEIGHTS = (0.0, 0.1, 0.2, 0.4, 0.8)


@dataclass(frozen=True, slots=True)
class CalibratedCue:
    r"""Eq. (7): alarm if the statistic is above gamma(alpha) for k hops, both set on the calibration folds.

    Without absence the statistic is the paper's, P_left + P_right. With absence, the visible explanation is
    weighted by the miss rate of the queried camera, eq. (6).
    """

    name: str
    alpha: float
    looming: bool = False
    absence: bool = False
    # Source of the log-likelihoods: the "published" classifier, the "ensemble", the "shipped" model, that
    # model "grounded" by bearing and approach rate, or grounded without the rate ("rateless").
    evidence: str = "published"

    def fit(self, calibration: Sequence[Trial], rng: np.random.Generator, /) -> Decide:
        """Set k, the weight of looming, gamma(alpha) and the risk map."""
        hops, streams = best_sustain(calibration, self.evidence), [trial.hops for trial in calibration]
        weight = best_weight(streams, LOOMING_WEIGHTS if self.looming else (0.0,), self._statistic)
        scores = [self._statistic(one, weight) for one in streams]
        calm = [score for one, score in zip(streams, scores, strict=True) if one.hazard_free]
        gamma = neyman_pearson_threshold(calm, self.alpha, hops)
        risk_map = fit_isotonic(*labelled_windows(streams, scores))

        def decide(trial: Trial) -> Decisions:
            score = self._statistic(trial.hops, weight)
            return Decisions.of(
                trial.hops.time_s,
                sustained_alarm(score >= gamma, hops),
                side=likelier_side(trial, self.evidence),
                bearing_rad=trial.hops.bearing_rad,
                score=score,
                risk=risk_map(score),
                threshold=np.array([gamma]),
            )

        return decide

    def _statistic(self, hops: HopTable, weight: float) -> FloatArray:
        stream = hops.replace(log_likelihoods=hops.columns[self.evidence])
        return stream_statistic(stream, hops.about["prior"][self.evidence], self.absence, weight)


@dataclass(frozen=True, slots=True)
class ShippedChain:
    """One variant of the whole chain with the thresholds of its model; nothing is fitted to recordings."""

    name: str
    chain: str

    def fit(self, calibration: Sequence[Trial], rng: np.random.Generator, /) -> Decide:
        """Return the decisions that were made when the recording was processed."""
        return lambda trial: trial.chains[self.chain]
