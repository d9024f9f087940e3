"""How well a linear signature separates clips: held-out scores, areas and their intervals."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from worldstate.ground.typing import BoolArray, FloatArray, IndexArray, TextArray
from worldstate.operations.metrics.roc import auroc, auroc_by_group
from worldstate_lab.metrics.intervals import DRAWS, FOLDS, Interval, middle, stratified_draws

from .clip_signatures import ClipSignatures
from .fisher_profile import level_invariant_shape

By = Literal["level", "shape"]
# Fewer recordings of a class on either side tell nothing of the next one.
LEAST = 2


@dataclass(frozen=True, slots=True, eq=False)
class ClipScores:
    """Scores of clips by a model that was trained on none of their recordings; positive means vehicle."""

    score: FloatArray  # shape (n,): Log-odds at equal classes, as the others
    vehicle: BoolArray
    recordings: TextArray
    sites: TextArray

    def select(self, rows: BoolArray | IndexArray) -> "ClipScores":
        """Return these rows."""
        return ClipScores(self.score[rows], self.vehicle[rows], self.recordings[rows], self.sites[rows])

    @property
    def worst_site(self) -> tuple[str, float] | None:
        """Where the area is smallest; None where there are not two places to compare."""
        areas = auroc_by_group(self.score, self.vehicle, self.sites)
        return min(areas.items(), key=lambda one: one[1]) if len(areas) > 1 else None


def enough(table: ClipSignatures) -> bool:
    """Whether both classes come from at least two recordings."""
    return all(len(np.unique(table.recordings[one])) >= LEAST for one in (table.motor, table.background))


def transferred(train: ClipSignatures, test: ClipSignatures, by: By) -> FloatArray:
    """Train on motor vehicles and background of one table; return the scores of another, shape (n,)."""
    # Logistic regression, because a discriminant analysis assumes one covariance of both classes: on the
    # simulated roads vehicles scatter by 4 dB in level and background by 2.5. Balanced, so that zero is the
    # threshold of equal classes.
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    used = train.motor | train.background
    logistic = LogisticRegression(class_weight="balanced", solver="newton-cholesky")
    machine = make_pipeline(StandardScaler(), logistic)
    machine.fit(_features(train.energy[used], by), train.motor[used])
    # The log-odds and not the probability, which saturates at 1 and would tie clips that differ.
    return np.asarray(machine.decision_function(_features(test.energy, by)))


def held_out(
    table: ClipSignatures, by: By, rng: np.random.Generator
) -> tuple[ClipSignatures, FloatArray, str]:
    """Return the clips that were scored, their scores, and by which split."""
    train, test = table.select(table.splits == "train"), table.select(table.splits == "test")
    if enough(train) and enough(test):
        return test, transferred(train, test, by), "official split"
    fold_of = _folds(table, rng)
    score = np.empty(len(table.kinds))
    for fold in np.unique(fold_of):
        kept = fold_of == fold
        score[kept] = transferred(table.select(~kept), table.select(kept), by)
    return table, score, f"{fold_of.max() + 1} folds by recording"


def _folds(table: ClipSignatures, rng: np.random.Generator) -> IndexArray:
    """Deal recordings to folds so that every fold can be learned without, shape (n,) of the clips."""
    names, of_clip = np.unique(table.recordings, return_inverse=True)
    held = [
        (table.motor[of_clip == i].any(), table.background[of_clip == i].any()) for i in range(len(names))
    ]
    # Background alone, both, vehicles alone, neither: recordings of one class are neighbours, so two of them
    # never fall into the same fold.
    place = {(False, True): 0, (True, True): 1, (True, False): 2, (False, False): 3}
    draws = rng.random(len(names))
    order = sorted(range(len(names)), key=lambda i: (place[bool(held[i][0]), bool(held[i][1])], draws[i]))
    fold_of = np.empty(len(names), dtype=np.intp)
    fold_of[order] = np.arange(len(names)) % min(FOLDS, *np.sum(held, axis=0).tolist())
    return fold_of[of_clip]


def scores_of(table: ClipSignatures, score: FloatArray, positive: BoolArray) -> ClipScores:
    """Keep what is to be told from background, and the background."""
    whole = ClipScores(score, positive, table.recordings, table.sites)
    return whole.select(positive | table.background)


def area(scores: ClipScores) -> float:
    """Return the area under the ROC curve, NaN where a class is missing."""
    found = auroc(scores.score, scores.vehicle)
    return float("nan") if found is None else found


def balanced_accuracy(scores: ClipScores) -> float:
    r"""Return the mean hit rate of both classes at the threshold of equal classes, NaN where one is missing.

    .. math:: \tfrac12 \big(P(s^+ > 0) + P(s^- \le 0)\big)
    """
    if scores.vehicle.all() or not scores.vehicle.any():
        return float("nan")
    called = scores.score > 0.0
    return 0.5 * float(called[scores.vehicle].mean() + (~called[~scores.vehicle]).mean())


def interval(figure: Callable[[ClipScores], float], scores: ClipScores, rng: np.random.Generator) -> Interval:
    """Return the middle 95 % of a figure over draws of recordings with replacement."""
    drawn = draw_recordings(scores.recordings, scores.vehicle, rng)
    return middle(np.array([figure(scores.select(some)) for some in drawn]))


def draw_recordings(
    recordings: TextArray, vehicle: BoolArray, rng: np.random.Generator
) -> Iterator[IndexArray]:
    """Yield the rows of draws of recordings with replacement.

    Shapes: recordings, vehicle (n,).
    """
    names, of_clip = np.unique(recordings, return_inverse=True)
    rows = [np.flatnonzero(of_clip == i) for i in range(len(names))]
    # Drawn apart by what they hold, or a draw could be without any background.
    holds = [(bool(vehicle[one].any()), bool(vehicle[one].all())) for one in rows]
    for draw in stratified_draws(holds, rng, DRAWS).tolist():
        yield np.concatenate([rows[i] for i in draw])


def _features(energy: FloatArray, by: By) -> FloatArray:
    return energy if by == "level" else level_invariant_shape(energy)
