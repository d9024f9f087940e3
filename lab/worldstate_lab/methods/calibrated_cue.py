"""The proposed decision layer: statistic, Neyman-Pearson threshold over k hops, isotonic risk."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.abduction.cueing.cueing_policy import sustained_alarm
from worldstate.abduction.cueing.risk_map import fit_isotonic
from worldstate.abduction.cueing.thresholds import neyman_pearson_threshold
from worldstate.ground.typing import FloatArray
from worldstate.operations.metrics.roc import auroc
from worldstate.operations.recordings.stream_statistic import StatisticSwitches, stream_statistic
from worldstate_lab.trials.trial import Decide, Decisions, Trial

from .sustained_rule import best_sustain, labelled_windows, likelier_side

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
