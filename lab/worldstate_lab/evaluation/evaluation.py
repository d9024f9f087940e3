"""The whole evaluation: recordings are heard once, every protocol is run on them, everything is scored."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol as Interface

import numpy as np

from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import IndexArray
from worldstate_lab.degradation.degradation_study import DegradationSettings, DegradationStudy
from worldstate_lab.degradation.stream_sweep import StreamSweep
from worldstate_lab.methods.table_rows import methods_for, refused_methods
from worldstate_lab.metrics.intervals import DRAWS, stratified_draws
from worldstate_lab.trials.classification import Classifiers
from worldstate_lab.trials.engine import Engine, Failed
from worldstate_lab.trials.hearing import Hearing, hear, within_hours
from worldstate_lab.trials.takes import Take, TakeList
from worldstate_lab.trials.trial import Trial

from .camera_failure import camera_failure, lacking_films, staged_streams
from .front_end_study import FrontEndStudy, front_end_study
from .operating_curve import EqualDetection, equal_detection
from .protocols import PROTOCOLS, ProtocolRun, run_protocol
from .scores import Score

# The paper's alpha.
ALPHA = 0.02


class Steps(Interface):
    """Where progress is told to: one call a step begun, and one for each of its parts done."""

    def begin(self, description: str, parts: int) -> None:
        """Begin a step of so many parts."""
        ...

    def advance(self) -> None:
        """Tell that a part is done."""
        ...


@dataclass(frozen=True, slots=True)
class EvaluationSettings:
    """How an evaluation is done."""

    seeds: tuple[int, ...] = (1,)  # Of the folds, which are drawn again for each
    hazard_free_hours: float | None = None  # Of hazard-free time that is scored; all where not given
    draws: int = DRAWS  # Samples of recordings that intervals are read from
    degradation: DegradationSettings | None = None  # Of the camera; not swept where not given
    stage_streams: bool = False  # Whether camera and rain are staged on hazard-free streams as well


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """What was found on every protocol that the data suffice for."""

    takes: TakeList
    trials: tuple[Trial, ...]
    failed: tuple[Failed, ...]  # Recordings that could not be heard
    lacking: Mapping[str, str]  # By protocol that was not run: what it needs and does not find
    runs: Mapping[str, ProtocolRun]
    scores: Mapping[str, Mapping[str, Score]]  # By protocol and method
    draws: Mapping[str, IndexArray]  # Samples of recordings by protocol, the same for every method
    front_end: FrontEndStudy | None  # Of the standing ego, whose camera is a reference
    degradation: DegradationStudy | None  # Ablation (c), on the filmed recordings
    settings: EvaluationSettings
    # By protocol and method that is not scored: why its model was not made for the sound of a recording.
    refused: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    # By protocol that does not leave junctions out.
    equal: Mapping[str, Sequence[EqualDetection]] = field(default_factory=dict)
    staged: StreamSweep | None = None  # Camera and rain on hazard-free streams


def lacking_data(takes: TakeList, failed: Sequence[Failed] = ()) -> dict[str, str]:
    """Say for each protocol that cannot be run what it lacks; refuse where none can."""
    every = (*takes.static, *takes.dynamic)
    lacking = {one.name: what for one in PROTOCOLS if (what := one.lacks(every)) is not None}
    if len(lacking) == len(PROTOCOLS):
        told = "; ".join(f"{name} {what}" for name, what in lacking.items())
        unheard = "".join(f"; not heard: {one.name}: {one.problem}" for one in failed)
        raise InvalidArgumentError(f"{takes.root}: no protocol can be run: {told}{unheard}")
    return lacking


def evaluate(
    takes: TakeList,
    hearing: Hearing,
    classifiers: Classifiers,
    engine: Engine,
    steps: Steps,
    settings: EvaluationSettings,
) -> Evaluation:
    """Hear all recordings, run every protocol that they suffice for and score every method."""
    lacking_data(takes)
    every = (*takes.static, *takes.dynamic)
    steps.begin("listening", len(every))
    heard, failed = hear(every, hearing, engine, steps.advance)
    trials = within_hours(heard, settings.hazard_free_hours)
    left = _left(takes, trials)
    # Again, on what is left: one broken recording of a small data set may be one too many.
    lacking = lacking_data(left, failed)
    chosen = [protocol for protocol in PROTOCOLS if protocol.name not in lacking]
    steps.begin("fitting and deciding", len(chosen))
    runs, refused = {}, {}
    for protocol in chosen:
        own = [trial for trial in trials if bool(trial.hops.about["moving"]) == protocol.moving]
        runs[protocol.name] = run_protocol(protocol, own, methods_for(own), classifiers, settings.seeds)
        refused[protocol.name] = refused_methods(own)
        steps.advance()
    scores = _scored(runs, steps)
    rng = np.random.default_rng(settings.seeds[0])
    drawn = {
        name: stratified_draws([(t.label, t.site) for t in run.trials], rng, settings.draws)
        for name, run in runs.items()
    }
    standing = [trial for trial in trials if not trial.hops.about["moving"]]
    filmed = any(np.isfinite(trial.hops.reference_rad).any() for trial in standing)
    return Evaluation(
        takes,
        tuple(trials),
        tuple(failed),
        lacking,
        runs,
        scores,
        drawn,
        front_end_study(standing, rng, settings.draws) if filmed else None,
        _degradation(left, hearing, engine, steps, settings.degradation, lacking),
        settings,
        refused,
        {
            name: equal_detection(run.trials, run.decisions, drawn[name])
            for name, run in runs.items()
            if not run.protocol.by_junction
        },
        _staged(left, trials, hearing, engine, steps, settings, lacking),
    )


def _scored(runs: Mapping[str, ProtocolRun], steps: Steps) -> dict[str, dict[str, Score]]:
    steps.begin("scoring", sum(len(run.decisions) for run in runs.values()))
    scores: dict[str, dict[str, Score]] = {}
    for name, run in runs.items():
        scores[name] = {}
        for method, passes in run.decisions.items():
            scores[name][method] = Score.of(run.trials, passes)
            steps.advance()
    return scores


def _left(takes: TakeList, trials: Sequence[Trial]) -> TakeList:
    """Return the recordings that were heard and are scored, a stream if any piece of it is."""
    names = {str(trial.hops.about.get("stream", trial.name)) for trial in trials}

    def kept(some: Sequence[Take]) -> tuple[Take, ...]:
        return tuple(take for take in some if take.name in names)

    return replace(takes, static=kept(takes.static), dynamic=kept(takes.dynamic))


def _degradation(
    takes: TakeList,
    hearing: Hearing,
    engine: Engine,
    steps: Steps,
    settings: DegradationSettings | None,
    lacking: dict[str, str],
) -> DegradationStudy | None:
    if settings is None:
        return None
    lacks = lacking_films(takes, settings)
    if lacks is not None:
        lacking["degradation sweep"] = lacks
        return None
    try:
        return camera_failure(takes, hearing.folder, engine, settings, steps.begin, steps.advance)
    except InvalidArgumentError as error:
        # Broken videos may leave it fewer recordings than it needs: no reason to lose all other figures.
        lacking["degradation sweep"] = str(error)
        return None


def _staged(
    takes: TakeList,
    trials: Sequence[Trial],
    hearing: Hearing,
    engine: Engine,
    steps: Steps,
    settings: EvaluationSettings,
    lacking: dict[str, str],
) -> StreamSweep | None:
    if not settings.stage_streams:
        return None
    names = {str(trial.hops.about["stream"]) for trial in trials if "stream" in trial.hops.about}
    streams = [take for take in takes.static if take.name in names]
    try:
        return staged_streams(streams, hearing, engine, settings.seeds[0], steps.begin, steps.advance)
    except InvalidArgumentError as error:
        # All other figures stand by now.
        lacking["staged streams"] = str(error)
        return None
