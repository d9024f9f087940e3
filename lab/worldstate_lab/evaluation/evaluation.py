"""The complete evaluation: front-end on all recordings once, then every protocol, then all scores."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from operator import attrgetter
from typing import Any

import numpy as np

from worldstate.adapters.datasets.ovad import Recording
from worldstate.adapters.files.model_file import read_model
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import IndexArray
from worldstate_lab.degradation.degradation_study import (
    DegradationSettings,
    DegradationStudy,
    SweepItem,
    Tables,
    degradation_study,
)
from worldstate_lab.metrics.intervals import DRAWS, stratified_draws
from worldstate_lab.trials.classification import Classifiers
from worldstate_lab.trials.listening import model_refusal
from worldstate_lab.trials.pass_cache import (
    Failed,
    Hearer,
    PassCache,
    attempted,
    fingerprint,
    trials_and_failures,
)
from worldstate_lab.trials.trial import TakeList, Trial

from .front_end_study import FrontEndStudy, front_end_study
from .protocols import PROTOCOLS, ProtocolRun, methods_for, refused_methods, run_protocol
from .scores import EqualDetection, Score, equal_detection

# Yields the items of a step, of which there are so many, and reports progress.
Progress = Callable[[Iterable[Any], str, int], Iterator[Any]]


@dataclass(frozen=True, slots=True)
class EvaluationSettings:
    """Options of an evaluation."""

    seeds: tuple[int, ...] = (1,)  # Seeds of the folds, which are drawn again for each seed
    draws: int = DRAWS  # Resamples of the recordings, from which intervals are computed
    degradation: DegradationSettings | None = None  # Sweep over camera degradations; None: no sweep


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """Results of every protocol for which there are enough data."""

    takes: TakeList
    trials: tuple[Trial, ...]
    failed: tuple[Failed, ...]  # Recordings that could not be processed
    lacking: Mapping[str, str]  # Required data and what was found, by protocol that was not run
    runs: Mapping[str, ProtocolRun]
    scores: Mapping[str, Mapping[str, Score]]  # Scores by protocol and method
    draws: Mapping[str, IndexArray]  # Resamples of the recordings by protocol, the same for every method
    front_end: FrontEndStudy | None  # Study with a standing ego, whose camera is a reference
    degradation: DegradationStudy | None  # Ablation (c), on the recordings with video
    settings: EvaluationSettings
    # By protocol and method that is not scored: why its model does not fit the sound of a recording.
    refused: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    # By protocol with folds over recordings.
    equal: Mapping[str, Sequence[EqualDetection]] = field(default_factory=dict)


def lacking_data(takes: TakeList, failed: Sequence[Failed] = ()) -> dict[str, str]:
    """Return, for each protocol that cannot be run, what it lacks; raise an error if none can be run."""
    every = (*takes.static, *takes.dynamic)
    lacking = {one.name: what for one in PROTOCOLS if (what := one.lacks(every)) is not None}
    if len(lacking) == len(PROTOCOLS):
        told = "; ".join(f"{name} {what}" for name, what in lacking.items())
        unheard = "".join(f"; not processed: {one.name}: {one.problem}" for one in failed)
        raise InvalidArgumentError(f"{takes.root}: no protocol can be run: {told}{unheard}")
    return lacking


def evaluate(
    takes: TakeList,
    hearing: Hearer,
    classifiers: Classifiers,
    jobs: int,
    track: Progress,
    settings: EvaluationSettings,
) -> Evaluation:
    """Process all recordings, run every protocol for which they suffice and score every method."""
    lacking_data(takes)
    every = (*takes.static, *takes.dynamic)
    work = attempted(hearing, every, jobs, attrgetter("name"))
    trials, failed = trials_and_failures(track(work, "listening", len(every)))
    left = _left(takes, trials)
    # Checked again on the remaining recordings: in a small data set one broken recording may be too many.
    lacking = lacking_data(left, failed)
    own = {
        one: [trial for trial in trials if bool(trial.hops.about["moving"]) == one.moving]
        for one in PROTOCOLS
        if one.name not in lacking
    }
    runs = {
        one.name: run_protocol(one, some, methods_for(some), classifiers, settings.seeds)
        for one, some in track(own.items(), "fitting and deciding", len(own))
    }
    scores = {name: _scored(run, track) for name, run in runs.items()}
    rng = np.random.default_rng(settings.seeds[0])
    drawn = {
        name: stratified_draws([(t.label, t.site) for t in run.trials], rng, settings.draws)
        for name, run in runs.items()
    }
    standing = [trial for trial in trials if not trial.hops.about["moving"]]
    filmed = any(np.isfinite(trial.hops.reference_rad).any() for trial in standing)
    front_end = front_end_study(standing, rng, settings.draws) if filmed else None
    equal = {
        name: equal_detection(run.trials, run.decisions, drawn[name])
        for name, run in runs.items()
        if not run.protocol.by_junction
    }
    sweep = None
    # Broken videos may leave too few recordings for a sweep; the other figures are kept in that case.
    if settings.degradation is not None:
        try:
            sweep = _degradation(left, hearing, jobs, track, settings.degradation)
        except InvalidArgumentError as error:
            lacking["degradation sweep"] = str(error)
    refused = {one.name: refused_methods(some) for one, some in own.items()}
    of = takes, tuple(trials), tuple(failed), lacking
    return Evaluation(*of, runs, scores, drawn, front_end, sweep, settings, refused, equal)


def _scored(run: ProtocolRun, track: Progress) -> dict[str, Score]:
    every = track(run.decisions.items(), "scoring", len(run.decisions))
    return {method: Score.of(run.trials, passes) for method, passes in every}


def _left(takes: TakeList, trials: Sequence[Trial]) -> TakeList:
    """Return the recordings that were processed and are scored."""
    names = {trial.name for trial in trials}
    kept = [tuple(one for one in some if one.name in names) for some in (takes.static, takes.dynamic)]
    return replace(takes, static=kept[0], dynamic=kept[1])


def whole_sweep(takes: TakeList, settings: DegradationSettings) -> DegradationSettings:
    """Return the settings of a sweep over all recordings with video instead of an evenly spaced choice."""
    calm = [take.hazard_free for take in takes.static if take.filmed]
    return replace(settings, approaches=calm.count(False), hazard_free=calm.count(True))


def _degradation(
    takes: TakeList, hearing: Hearer, jobs: int, track: Progress, settings: DegradationSettings
) -> DegradationStudy:
    """Run the sweep on recordings processed like all others; detections are cached."""
    model, filmed = read_model(settings.model), [take for take in takes.static if take.filmed]
    for take in filmed:
        if (refusal := model_refusal(take, model)) is not None:
            raise InvalidArgumentError(f"needs a model for this sound; {refusal}")

    def over(work: Callable[[SweepItem], Tables], items: Sequence[SweepItem]) -> Iterator[Tables | str]:
        done = track(attempted(work, items, jobs), "degrading the camera", len(items))
        return (one.problem if isinstance(one, Failed) else one for one in done)

    named = partial(fingerprint, memo=hearing.folder / "fingerprints")
    recordings = [Recording.open(take.path) for take in filmed]
    keep = PassCache(hearing.folder).tables
    return degradation_study(recordings, settings, over=over, keep=keep, fingerprint=named)
