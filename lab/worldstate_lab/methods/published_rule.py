"""The published acoustic classifier as a row of Table I, with its rule at once and sustained."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.abduction.cueing.cueing_policy import sustained_alarm
from worldstate_lab.trials.classification import SIDE_COLUMNS, posteriors
from worldstate_lab.trials.trial import Decide, Decisions, Trial

from .sustained_rule import argmax_is_side, best_sustain, likelier_side


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
