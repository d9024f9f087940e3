"""Signature separability and its limits: section IX of the paper on the given corpora."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from worldstate.ground.typing import BoolArray, FloatArray, IndexArray, TextArray
from worldstate.operations.metrics.approach_table import auroc
from worldstate_lab.metrics.intervals import FOLDS, Interval, auroc_by_group, middle, pooled_draws

from .clip_signatures import (
    ClipSignatures,
    discriminative_range_hz,
    fisher_profile,
    level_invariant_shape,
    signature_edges_hz,
)

By = Literal["level", "shape"]
# With fewer recordings of a class in training or test, the result does not generalise.
LEAST = 2


@dataclass(frozen=True, slots=True, eq=False)
class ClipScores:
    """Scores of clips from a model trained on none of their recordings; positive means vehicle."""

    score: FloatArray  # shape (n,), like the following fields: Log-odds with equal classes
    vehicle: BoolArray
    recordings: TextArray
    sites: TextArray

    def select(self, rows: BoolArray | IndexArray) -> "ClipScores":
        """Return these rows."""
        return ClipScores(self.score[rows], self.vehicle[rows], self.recordings[rows], self.sites[rows])

    @property
    def worst_site(self) -> tuple[str, float] | None:
        """Site with the smallest area; None if there are fewer than two sites."""
        areas = auroc_by_group(self.score, self.vehicle, self.sites)
        return min(areas.items(), key=lambda one: one[1]) if len(areas) > 1 else None


def enough(table: ClipSignatures) -> bool:
    """Return whether both classes come from at least two recordings."""
    return all(len(np.unique(table.recordings[one])) >= LEAST for one in (table.motor, table.background))


def transferred(train: ClipSignatures, test: ClipSignatures, by: By) -> FloatArray:
    """Train on motor vehicles and background of one table; return the scores of another, shape (n,)."""
    # Logistic regression, because discriminant analysis assumes equal covariances: on the simulated roads the
    # level of vehicles varies by 4 dB and that of the background by 2.5. Balanced, so that zero is the
    # threshold for equal classes.
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    used = train.motor | train.background
    logistic = LogisticRegression(class_weight="balanced", solver="newton-cholesky")
    machine = make_pipeline(StandardScaler(), logistic)
    machine.fit(_features(train.energy[used], by), train.motor[used])
    # Log-odds and not probabilities, which saturate at 1 and would give ties between different clips.
    return np.asarray(machine.decision_function(_features(test.energy, by)))


def held_out(table: ClipSignatures, by: By, rng: np.random.Generator) -> "Scored":
    """Return the scored clips, their scores, and the name of the split."""
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
    """Assign recordings to folds so that training is possible without any one of them, shape (n,)."""
    names, of_clip = np.unique(table.recordings, return_inverse=True)
    held = [
        (table.motor[of_clip == i].any(), table.background[of_clip == i].any()) for i in range(len(names))
    ]
    # The order is background only, both, vehicles only, neither: recordings of one class are adjacent, so two
    # of them are never in the same fold.
    place = {(False, True): 0, (True, True): 1, (True, False): 2, (False, False): 3}
    draws = rng.random(len(names))
    order = sorted(range(len(names)), key=lambda i: (place[bool(held[i][0]), bool(held[i][1])], draws[i]))
    fold_of = np.empty(len(names), dtype=np.intp)
    fold_of[order] = np.arange(len(names)) % min(FOLDS, *np.sum(held, axis=0).tolist())
    return fold_of[of_clip]


def scores_of(table: ClipSignatures, score: FloatArray, positive: BoolArray) -> ClipScores:
    """Keep the positive clips and the background."""
    whole = ClipScores(score, positive, table.recordings, table.sites)
    return whole.select(positive | table.background)


def area(scores: ClipScores) -> float:
    """Return the area under the ROC curve, NaN if a class is missing."""
    found = auroc(scores.score, scores.vehicle)
    return float("nan") if found is None else found


def balanced_accuracy(scores: ClipScores) -> float:
    r"""Return the mean hit rate of both classes at the threshold for equal classes, NaN if one is missing.

    .. math:: \tfrac12 \big(P(s^+ > 0) + P(s^- \le 0)\big)
    """
    if scores.vehicle.all() or not scores.vehicle.any():
        return float("nan")
    called = scores.score > 0.0
    return 0.5 * float(called[scores.vehicle].mean() + (~called[~scores.vehicle]).mean())


def interval(figure: Callable[[ClipScores], float], scores: ClipScores, rng: np.random.Generator) -> Interval:
    """Return the central 95 % of a figure over draws of recordings with replacement."""
    drawn = draw_recordings(scores.recordings, scores.vehicle, rng)
    return middle(np.array([figure(scores.select(some)) for some in drawn]))


def draw_recordings(names: TextArray, vehicle: BoolArray, rng: np.random.Generator) -> Iterator[IndexArray]:
    """Return the rows of draws of recordings with replacement.

    Shapes: names, vehicle (n,).
    """
    every, of_clip = np.unique(names, return_inverse=True)
    rows = [np.flatnonzero(of_clip == i) for i in range(len(every))]
    # Stratified by the classes that a recording contains; otherwise a draw could lack the background.
    holds = [(bool(vehicle[one].any()), bool(vehicle[one].all())) for one in rows]
    return pooled_draws(rows, holds, rng)


def _features(energy: FloatArray, by: By) -> FloatArray:
    return energy if by == "level" else level_invariant_shape(energy)


Corpus = Literal["IDMT-Traffic", "MELAUDIS"]
IDMT: Corpus = "IDMT-Traffic"
MELAUDIS: Corpus = "MELAUDIS"
OPTIONS = {IDMT: "--idmt DIR", MELAUDIS: "--melaudis DIR"}
FIGURES = {"AUROC": area, "balanced accuracy": balanced_accuracy}
BOTH_WAYS = ((IDMT, MELAUDIS), (MELAUDIS, IDMT))
BYS: tuple[By, By] = ("level", "shape")
VEHICLE = "vehicle"
QUIET = ("bicycle", "tram")
# Values of section IX of the paper, which gives one range for the shape without stating which end belongs to
# which microphone.
PAPER = {
    ("level", "studio"): (0.999, 0.999),
    ("level", "mems"): (0.997, 0.997),
    ("shape", "studio"): (0.76, 0.90),
    ("shape", "mems"): (0.76, 0.90),
}
PAPER_RANGE_HZ = (300.0, 1800.0)
TOO_FEW = "needs motor vehicles and background of two recordings each, and such clips"


@dataclass(frozen=True, slots=True)
class SignatureRow:
    """One figure of the study."""

    name: str
    corpus: str
    figure: str  # AUROC, balanced accuracy or Hz
    # None if a corpus is missing or too small: the note contains the command that computes it
    value: float | None
    low: float | None = None  # Ends of the 95 % interval over recordings
    high: float | None = None
    paper: tuple[float, float] | None = None  # Ends of its range, equal if the paper gives one number
    n_clips: int = 0
    note: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class SignatureStudy:
    """All figures, the worst first."""

    rows: tuple[SignatureRow, ...]
    left_out: tuple[str, ...]  # Reasons why clips could not be read


def signature_study(
    roadside: ClipSignatures | None,
    city: ClipSignatures | None,
    rng: np.random.Generator,
    on_row: Callable[[], None] = lambda: None,
) -> SignatureStudy:
    """Compute every row that the corpora allow, and list the commands that compute the others.

    `roadside` has studio and MEMS microphones, `city` has phones; either may be None.
    """
    given: dict[Corpus, ClipSignatures | None] = {IDMT: roadside, MELAUDIS: city}
    tables = {name: one for name, one in given.items() if one is not None}
    rows, scored = [], dict[tuple[str, ...], Scored | None]()
    for question in QUESTIONS:
        # Vehicles and quiet road users of a corpus are scored with the same model.
        key = question.by, question.train, question.test, question.microphone
        if key not in scored:
            scored[key] = _scored(question, tables, rng)
        rows.append(_row(question, tables, scored[key], rng))
        on_row()
    if roadside is not None:
        # The profile compares motor vehicles and background of the studio microphones.
        compared = roadside.motor | roadside.background
        roadside = roadside.select((roadside.microphones == "studio") & compared)
    ranges = [row for by in BYS for row in _range_rows(roadside, by, rng)]
    left_out = tuple(problem for one in tables.values() for problem in one.left_out)
    worst_first = sorted(rows, key=lambda row: (row.value is None, row.value))
    return SignatureStudy((*worst_first, *ranges), left_out)


@dataclass(frozen=True, slots=True)
class _Question:
    """Definition of a row: kind to separate from background, feature, training corpus, test corpus."""

    by: By
    train: Corpus
    test: Corpus
    microphone: str = ""  # All microphones of the corpus if empty
    kind: str = VEHICLE
    figure: str = "AUROC"

    @property
    def name(self) -> str:
        how = f"{self.microphone} microphones" if self.microphone else "trained on the other corpus"
        return f"{self.kind} by {self.by}, {how}"

    @property
    def paper(self) -> tuple[float, float] | None:
        return PAPER.get((self.by, self.microphone)) if self.kind == VEHICLE else None


QUESTIONS = (
    # Training and test use different recordings of one corpus. Quiet road users are tested with a model that
    # was not trained on them.
    *(_Question(by, IDMT, IDMT, microphone) for by in BYS for microphone in ("studio", "mems")),
    *(_Question(by, MELAUDIS, MELAUDIS, "phone", kind) for by in BYS for kind in (VEHICLE, *QUIET)),
    # These rows test on the other corpus. The accuracy shows whether another gain shifts the threshold, which
    # an area cannot show.
    *(_Question(by, *way, figure=figure) for by in BYS for way in BOTH_WAYS for figure in FIGURES),
    *(_Question("shape", IDMT, MELAUDIS, kind=kind) for kind in QUIET),
)


# Clips, their scores, and how the test clips were separated from the training.
Scored = tuple[ClipSignatures, FloatArray, str]


def _row(
    question: _Question,
    tables: Mapping[Corpus, ClipSignatures],
    scored: Scored | None,
    rng: np.random.Generator,
) -> SignatureRow:
    """Return the row of a question; without a value if a corpus is missing or too small."""
    names = list(dict.fromkeys((question.train, question.test)))
    missing = [name for name in names if name not in tables]
    known = [name if missing else tables[name].name for name in names]
    row = SignatureRow(question.name, " -> ".join(known), question.figure, None, paper=question.paper)
    if missing:
        return replace(row, note=command(*names))
    if scored is None:
        return replace(row, note=TOO_FEW)
    (table, score, split), measure = scored, FIGURES[row.figure]
    positive = table.motor if question.kind == VEHICLE else table.kinds == question.kind
    scores = scores_of(table, score, positive)
    value = measure(scores)
    if np.isnan(value):
        return replace(row, note=f"no clip of {question.kind}")
    low, high = interval(measure, scores, rng)
    worst = scores.worst_site if measure is area else None
    note = split + (f"; worst site {worst[0]} {worst[1]:.3f}" if worst else "")
    return replace(row, value=value, low=low, high=high, n_clips=len(scores.score), note=note)


def _scored(
    question: _Question, tables: Mapping[Corpus, ClipSignatures], rng: np.random.Generator
) -> Scored | None:
    """Return the scores of a question's clips, None if a corpus is missing or too small."""
    train, test = tables.get(question.train), tables.get(question.test)
    if train is None or test is None:
        return None
    if question.microphone:
        train = train.select(train.microphones == question.microphone)
    if not enough(train):
        return None
    if question.microphone:
        return held_out(train, question.by, rng)
    return test, transferred(train, test, question.by), f"trained on all of {train.name}"


def _range_rows(table: ClipSignatures | None, by: By, rng: np.random.Generator) -> list[SignatureRow]:
    """Return both ends of the range in which the Fisher ratio is at least half of its maximum."""
    corpus = IDMT if table is None else table.name
    rows = [
        SignatureRow(f"Fisher profile by {by}, {end}", corpus, "Hz", None, paper=(edge, edge))
        for end, edge in zip(("from", "to"), PAPER_RANGE_HZ, strict=True)
    ]
    if table is None or not enough(table):
        return [replace(row, note=command(IDMT) if table is None else TOO_FEW) for row in rows]
    values = _half_range_hz(table, by)
    drawn = draw_recordings(table.recordings, table.motor, rng)
    ends = np.array([_half_range_hz(table.select(one), by) for one in drawn])
    intervals = [middle(column) for column in ends.T]
    return [
        replace(row, value=value, low=low, high=high, n_clips=len(table.kinds), note="studio microphones")
        for row, value, (low, high) in zip(rows, values, intervals, strict=True)
    ]


def _half_range_hz(table: ClipSignatures, by: By) -> tuple[float, float]:
    energy = _features(table.energy, by)
    profile = fisher_profile(energy[table.motor], energy[~table.motor])
    return discriminative_range_hz(profile, signature_edges_hz())


def command(*corpora: Corpus) -> str:
    """Return the command that computes a row."""
    given = (option for name, option in OPTIONS.items() if name in corpora)
    return " ".join(["worldstate-lab corpora", *given])
