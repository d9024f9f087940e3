"""Rows of Table I that decide from sound: published, sustained and calibrated rules, and whole chains."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.abduction.cueing.cueing_policy import sustained_alarm
from worldstate.abduction.cueing.risk_map import fit_isotonic
from worldstate.abduction.cueing.thresholds import neyman_pearson_threshold
from worldstate.ground.typing import BoolArray, FloatArray, IntArray
from worldstate.operations.metrics.approach_table import auroc, onset_outcome, rising_edges
from worldstate_lab.metrics.stream_statistic import StatisticSwitches, stream_statistic
from worldstate_lab.trials.classification import SIDE_COLUMNS, posteriors
from worldstate_lab.trials.trial import LEFT, RIGHT, Decide, Decisions, Trial

# Every hop of k costs a tenth of a second of lead.
SUSTAIN_CHOICES = (2, 3, 4, 5)


def argmax_is_side(trial: Trial, evidence: str) -> BoolArray:
    """Whether the most probable class is left or right, shape (n,): the published rule."""
    return np.asarray(posteriors(trial, evidence).argmax(axis=1) < SIDE_COLUMNS.stop)


def likelier_side(trial: Trial, evidence: str) -> IntArray:
    """Return the side with the larger posterior at every hop, shape (n,)."""
    left, right = posteriors(trial, evidence)[:, SIDE_COLUMNS].T
    return np.where(left >= right, LEFT, RIGHT)


def onsets_s(trial: Trial, alarm: BoolArray) -> list[float]:
    """Return when an alarm begins, seconds."""
    return [float(time_s) for time_s in trial.hops.time_s[rising_edges(alarm)]]


def best_sustain(calibration: Sequence[Trial], evidence: str) -> int:
    """Return the k with the largest share of approaches detected less that of quiet recordings alarmed."""
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

    # Of equals the smallest: it leaves the most lead.
    return max(SUSTAIN_CHOICES, key=lambda hops: (gain(hops), -hops))


def _share(flags: Sequence[bool]) -> float:
    return sum(flags) / max(len(flags), 1)


def labelled_windows(trials: Sequence[Trial], scores: Sequence[FloatArray]) -> tuple[FloatArray, BoolArray]:
    """Return score and hazard label of all windows up to T0 and all hazard-free ones, shape (n,) each."""
    used = [
        score if trial.hazard_free else score[trial.hops.before_sight()]
        for trial, score in zip(trials, scores, strict=True)
    ]
    labels = [np.full(score.size, not trial.hazard_free) for trial, score in zip(trials, used, strict=True)]
    return np.concatenate(used), np.concatenate(labels)


@dataclass(frozen=True, slots=True)
class PublishedRule:
    """Alarm where the most probable class is left or right, at once or over k hops."""

    name: str
    sustained: bool = False
    evidence: str = "published"  # Whose posteriors: see `classification.TRAINED`

    def fit(self, calibration: Sequence[Trial], rng: np.random.Generator, /) -> Decide:
        """Choose k where the rule is sustained; the classifier was trained beforehand."""
        hops = best_sustain(calibration, self.evidence) if self.sustained else 1

        def decide(trial: Trial) -> Decisions:
            alarm = sustained_alarm(argmax_is_side(trial, self.evidence), hops)
            score = posteriors(trial, self.evidence)[:, SIDE_COLUMNS].sum(axis=1)
            return Decisions.of(
                trial.hops.time_s, alarm, side=likelier_side(trial, self.evidence), score=score
            )

        return decide


# Weights of the approach rate in nats a standard deviation; 0 leaves it out.
LOOMING_WEIGHTS = (0.0, 0.1, 0.2, 0.4, 0.8)


@dataclass(frozen=True, slots=True)
class CalibratedCue:
    r"""Eq. (7): alarm where the statistic holds gamma(alpha) for k hops, set on the calibration folds.

    Without absence the statistic is the paper's, P_left + P_right; with it the visible explanation is
    weighed by the miss rate of the camera that was asked, eq. (6).
    """

    name: str
    alpha: float
    looming: bool = False
    absence: bool = False
    # Whose log-likelihoods: of the "published" classifier, the "ensemble", the "shipped" model, that model
    # "grounded" by bearing and approach rate, or grounded without the rate ("rateless").
    evidence: str = "published"

    def fit(self, calibration: Sequence[Trial], rng: np.random.Generator, /) -> Decide:
        """Set k, the weight of looming, gamma(alpha) and the risk map."""
        hops, weight = best_sustain(calibration, self.evidence), self._best_weight(calibration)
        scores = [self._statistic(trial, weight) for trial in calibration]
        calm = [s for trial, s in zip(calibration, scores, strict=True) if trial.hazard_free]
        gamma = neyman_pearson_threshold(calm, self.alpha, hops)
        risk_map = fit_isotonic(*labelled_windows(calibration, scores))

        def decide(trial: Trial) -> Decisions:
            score = self._statistic(trial, weight)
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

    def _statistic(self, trial: Trial, weight: float) -> FloatArray:
        switches = StatisticSwitches(use_absence=self.absence, approach_weight=weight)
        stream = trial.hops.replace(log_likelihoods=trial.hops.columns[self.evidence])
        return stream_statistic(stream, trial.hops.about["prior"][self.evidence], switches)

    def _best_weight(self, calibration: Sequence[Trial]) -> float:
        """Return the weight with the largest window AUROC on the calibration recordings."""
        if not self.looming:
            return 0.0

        def area(weight: float) -> float:
            scores = [self._statistic(trial, weight) for trial in calibration]
            return auroc(*labelled_windows(calibration, scores)) or 0.0

        return max(LOOMING_WEIGHTS, key=lambda weight: (area(weight), -weight))


@dataclass(frozen=True, slots=True)
class ShippedChain:
    """One variant of the whole chain, at its model's thresholds; nothing is set on the recordings."""

    name: str
    chain: str

    def fit(self, calibration: Sequence[Trial], rng: np.random.Generator, /) -> Decide:
        """Return what was said while listening."""
        return lambda trial: trial.chains[self.chain]
