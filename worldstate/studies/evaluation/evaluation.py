"""The whole evaluation: recordings are heard once, every protocol is run on them, everything is scored."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol as Interface

import numpy as np

from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import IndexArray
from worldstate.operations.metrics.recording_draws import DRAWS, stratified_draws
from worldstate.studies.degradation.degradation_study import DegradationSettings, DegradationStudy
from worldstate.studies.methods.table_rows import methods_for
from worldstate.studies.paper.ablations import AblationRow, AblationSwitches, ablation_table
from worldstate.studies.trials.classification import Classifiers
from worldstate.studies.trials.engine import Engine, Failed
from worldstate.studies.trials.hearing import Hearing, hear, within_hours
from worldstate.studies.trials.takes import TakeList
from worldstate.studies.trials.trial import Trial

from .camera_failure import camera_failure, lacking_films
from .front_end_study import FrontEndStudy, front_end_study
from .protocol_run import ProtocolRun, run_protocol
from .protocols import PROTOCOLS, STATIC
from .scores import Score

# The paper's alpha; the ablations are told at it.
ALPHA = 0.02
SUSTAIN_HOPS = 3


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
    ablations: Mapping[str, AblationRow]
    degradation: DegradationStudy | None  # Ablation (c), on the filmed recordings
    settings: EvaluationSettings


def lacking_data(takes: TakeList) -> dict[str, str]:
    """Say for each protocol that cannot be run what it lacks; refuse where none can."""
    every = (*takes.static, *takes.dynamic)
    lacking = {one.name: what for one in PROTOCOLS if (what := one.lacks(every)) is not None}
    if len(lacking) == len(PROTOCOLS):
        told = "; ".join(f"{name} {what}" for name, what in lacking.items())
        raise InvalidArgumentError(f"{takes.root}: no protocol can be run: {told}")
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
    lacking = lacking_data(takes)
    every = (*takes.static, *takes.dynamic)
    steps.begin("listening", len(every))
    heard, failed = hear(every, hearing, engine, steps.advance)
    trials = within_hours(heard, settings.hazard_free_hours)
    chosen = [protocol for protocol in PROTOCOLS if protocol.name not in lacking]
    steps.begin("fitting and deciding", len(chosen))
    runs = {}
    for protocol in chosen:
        own = [trial for trial in trials if bool(trial.hops.about["moving"]) == protocol.moving]
        runs[protocol.name] = run_protocol(protocol, own, methods_for(own), classifiers, settings.seeds)
        steps.advance()
    steps.begin("scoring", sum(len(run.decisions) for run in runs.values()))
    scores: dict[str, dict[str, Score]] = {}
    for name, run in runs.items():
        scores[name] = {}
        for method, passes in run.decisions.items():
            scores[name][method] = Score.of(run.trials, passes)
            steps.advance()
    rng = np.random.default_rng(settings.seeds[0])
    standing = [trial for trial in trials if not trial.hops.about["moving"]]
    filmed = any(np.isfinite(trial.hops.reference_rad).any() for trial in standing)
    return Evaluation(
        takes,
        tuple(trials),
        tuple(failed),
        lacking,
        runs,
        scores,
        {
            name: stratified_draws([(t.label, t.site) for t in run.trials], rng, settings.draws)
            for name, run in runs.items()
        },
        front_end_study(standing, rng, settings.draws) if filmed else None,
        _ablations(standing, classifiers, settings.seeds[0]) if STATIC.name in runs else {},
        _degradation(takes, hearing, engine, steps, settings.degradation, lacking),
        settings,
    )


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
    return camera_failure(takes, hearing.folder, engine, settings, steps.begin, steps.advance)


def _ablations(trials: Sequence[Trial], classifiers: Classifiers, seed: int) -> dict[str, AblationRow]:
    """Remove absence, calibration and looming one at a time, with the published scores if there are any."""
    scores = "shipped"
    if classifiers.windows is not None:
        scores, trials = "published", classifiers.classify(trials, "all", (), trials, seed)
    streams = [
        # A vehicle is in view where the camera's own detections say so: nothing else is known of it.
        trial.hops.replace(log_likelihoods=trial.hops.columns[scores], there=trial.hops.seen)
        for trial in trials
    ]
    switches = AblationSwitches(alpha=ALPHA, sustain_hops=SUSTAIN_HOPS)
    return ablation_table(streams, trials[0].hops.about["prior"][scores], seed, switches)
