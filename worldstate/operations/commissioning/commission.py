"""From an array to a model: streets simulated and listened to, window and sequence model, alarm, exam."""

import hashlib
import json
from collections.abc import Callable, Generator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from worldstate.abduction.sequence.sequence_inputs import HopEvidence
from worldstate.abduction.sequence.sequence_model import SequenceAlarm, SequenceModel
from worldstate.abduction.signature.ensemble import EnsembleModel
from worldstate.abduction.signature.window_classes import side_ratios
from worldstate.adapters.simulation.stream.settings import StreamSettings
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.parallel import in_processes

from .heard_stream import HeardStream, hear_stream
from .plan import HAZARD_FREE
from .sequence_training import LabelledStream, calibrated_margin_s, train_sequence
from .stream_exam import ExaminedStream, alarm_for
from .stream_labels import stream_truth
from .window_model import posteriors_along

FOLDS = 4
# Of hazard-free to approaching time in use: two hours to 72 minutes, as in the exam.
HAZARD_FREE_SHARE = 120.0 / 192.0

FitWindows = Callable[[Sequence[HeardStream]], EnsembleModel]


def heard_streams(
    plan: Sequence[StreamSettings], array: MicrophoneArray, folder: Path, jobs: int = 1
) -> Generator[HeardStream, None, None]:
    """Yield every stream of a plan, listened to now or, by the same settings and array, before."""
    folder.mkdir(parents=True, exist_ok=True)
    yield from in_processes(partial(_heard, array, folder), plan, jobs)


def _heard(array: MicrophoneArray, folder: Path, settings: StreamSettings) -> HeardStream:
    # Whatever else is heard under the same name, by another array or preset, is another file.
    made_with = json.dumps([asdict(settings), array.positions_m.tolist()], default=str, sort_keys=True)
    digest = hashlib.sha256(made_with.encode()).hexdigest()[:12]
    path = folder / f"{settings.site.name}-{settings.traffic.name}-{settings.seed}-{digest}.npz"
    if not path.is_file():
        hear_stream(settings, array).save(path)
    return HeardStream.load(path)


def stream_evidence(model: EnsembleModel, heard: HeardStream) -> HopEvidence:
    """Return what a window model says along a stream, and what else the front-end heard."""
    hops, posteriors = heard.hops, posteriors_along(model, heard.hops.feature)
    ratios = np.log(posteriors / model.class_prior)
    front, none = (ratios[:, model.classes.index(name)] for name in ("front", "none"))
    return HopEvidence(
        sides=side_ratios(posteriors, model.classes, model.class_prior),
        visible=front - none,
        level=np.log(hops.feature).mean(axis=1, dtype=np.float64),
        loudness=hops.band_log_energy.mean(axis=1, dtype=np.float64),
        prominence=np.log(hops.prominence),
        looming_hz=hops.looming_hz,
        looming_std_hz=hops.looming_std_hz,
        bearing_rad=hops.bearing_rad,
    )


@dataclass(frozen=True, slots=True, eq=False)
class LearnedSequence:
    """A sequence model, its alarm, and what it scored on streams of junctions that it had not learned."""

    model: SequenceModel
    examined: tuple[ExaminedStream, ...]


def learn_sequence(
    streams: Sequence[HeardStream],
    fit_windows: FitWindows,
    onsets_per_hour: float,
    on_step: Callable[[], None] = lambda: None,
) -> LearnedSequence:
    """Train a sequence model on streams, junction by junction out of fold.

    `fit_windows` makes a window model of some of the streams. Evidence of a stream always comes from one that
    did not learn its junction: trained on evidence that is too good, trees trust it too much elsewhere.
    """
    folds = _folds(streams)
    labelled: dict[int, LabelledStream] = {}
    weights = _weights(streams)
    for fold in range(FOLDS):
        windows = fit_windows([one for one, at in zip(streams, folds, strict=True) if at != fold])
        for number, (one, at) in enumerate(zip(streams, folds, strict=True)):
            if at == fold:
                evidence = stream_evidence(windows, one)
                labelled[number] = LabelledStream(evidence, stream_truth(one), weights[number])
        on_step()
    margins, left_out = [], []
    for fold in range(FOLDS):
        inside = [labelled[i] for i, at in enumerate(folds) if at != fold]
        outside = [i for i, at in enumerate(folds) if at == fold]
        model = train_sequence(inside)
        margins.append(calibrated_margin_s(model, [labelled[i] for i in outside]))
        left_out += [(i, model.posterior(labelled[i].evidence)) for i in outside]
        on_step()
    quiet = [posterior for i, posterior in left_out if streams[i].hops.about["traffic"] == HAZARD_FREE]
    alarm, margin_s = alarm_for(quiet, onsets_per_hour), float(np.mean(margins))
    final = replace(train_sequence(list(labelled.values())), margin_s=margin_s, alarm=alarm)
    on_step()
    examined = [
        ExaminedStream(streams[i], labelled[i].truth, replace(posterior, margin_s=margin_s), alarm)
        for i, posterior in sorted(left_out, key=lambda one: one[0])
    ]
    return LearnedSequence(final, tuple(examined))


def _folds(streams: Sequence[HeardStream]) -> list[int]:
    """Deal junctions to folds in turn, so that each holds both types."""
    names = sorted({str(one.hops.about["site"]) for one in streams}, key=lambda name: (name[2:], name))
    return [names.index(str(one.hops.about["site"])) // 2 % FOLDS for one in streams]


def _weights(streams: Sequence[HeardStream]) -> list[float]:
    """Return what a hop of each stream counts, so that hazard-free time has its share of use."""
    free = [one.hops.about["traffic"] == HAZARD_FREE for one in streams]
    hops = [
        sum(len(one.hops) for one, f in zip(streams, free, strict=True) if f == kind)
        for kind in (True, False)
    ]
    of_kind = {True: HAZARD_FREE_SHARE / max(hops[0], 1), False: (1.0 - HAZARD_FREE_SHARE) / max(hops[1], 1)}
    return [of_kind[one] * sum(hops) for one in free]


def examine_model(
    windows: EnsembleModel, sequence: SequenceModel, alarm: SequenceAlarm, streams: Sequence[HeardStream]
) -> list[ExaminedStream]:
    """Hear streams that neither model has learned."""
    return [
        ExaminedStream(one, stream_truth(one), sequence.posterior(stream_evidence(windows, one)), alarm)
        for one in streams
    ]
