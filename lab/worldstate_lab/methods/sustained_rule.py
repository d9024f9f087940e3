"""The sustained rule: an alarm where a decision holds for k hops, k set on the calibration folds."""

from collections.abc import Sequence

import numpy as np

from worldstate.abduction.cueing.cueing_policy import sustained_alarm
from worldstate.ground.typing import BoolArray, FloatArray, IntArray
from worldstate.operations.metrics.approach_table import onset_outcome, rising_edges
from worldstate_lab.trials.classification import SIDE_COLUMNS, posteriors
from worldstate_lab.trials.trial import LEFT, RIGHT, Trial

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
