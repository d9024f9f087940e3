"""From an array to a model: simulate streets, process their sound, train, set the alarm and examine."""

import hashlib
import json
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import asdict, fields, replace
from functools import lru_cache, partial
from itertools import chain
from pathlib import Path

import numpy as np

from worldstate.abduction.sequence.sequence_inputs import hop_columns, sequence_inputs
from worldstate.abduction.sequence.sequence_model import AlarmCurve, SequenceModel
from worldstate.abduction.signature.ensemble import KINDS, EnsembleModel
from worldstate.abduction.signature.ensemble_training import SimulatedWindows
from worldstate.abduction.signature.published_signature import ModelDomain
from worldstate.abduction.signature.window_classes import CLASSES, side_ratios, visible_ratios
from worldstate.adapters.datasets.feature_table import FeatureTable
from worldstate.adapters.files.acoustic_domain import check_tables, domain_of
from worldstate.adapters.files.array_match import microphone_order
from worldstate.adapters.files.model_file import DataSource, Model, RealFigure, read_model
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.extras import check_extra
from worldstate.ground.parallel import in_processes
from worldstate.ground.typing import FloatArray
from worldstate.ground.values import SECONDS_PER_HOUR
from worldstate.operations.recordings.hop_table import HOP_S
from worldstate.operations.training.training import TrainingSettings, train_model
from worldstate.simulation.stream.settings import StreamSettings

from .alarm_curve import UNREACHED, advised, alarm_levels, check_hours, measured_curve, stream_states
from .guard_training import CHOSEN_FOR_GUARD, CLIPS_EACH, SoundRows, close_rows, train_guard
from .heard_stream import (
    CommissionSettings,
    HeardStream,
    exam_streams,
    hear_recording,
    hear_stream,
    learned_streams,
    mounting_streams,
    mountings,
)
from .recorded_clips import RecordedClips
from .road_user_training import (
    CHOSEN_FOR_ROAD_USERS,
    RoadUserRows,
    fit_road_users,
    road_user_rows,
    with_close,
)
from .sequence_training import (
    MOVING,
    STANDING,
    Growth,
    LabelledStream,
    calibrated_margin_s,
    stream_truth,
    train_sequence,
)
from .simulated_windows import (
    N_OPEN,
    learned_beside,
    open_field_features,
    open_field_windows,
    posteriors_along,
    window_model,
)
from .stream_exam import ExaminedStream

FOLDS = 4
# Time of learning relative to the streams, and its steps: windows and trees of every fold, alarm, window
# model, sounds near by, guard. With 8 microphones it takes two thirds of the time of the streams.
LEARNING_SHARE, LEARNING_STEPS = 0.65, 2 * FOLDS + 4
# This many hours of streams allow all trees; fewer hours allow proportionally fewer, down to a minimum. With
# eight minutes, 20, 60 and 120 rounds have a Brier skill at 3 s of 0.04, -0.12 and -0.13 at a new junction.
HOURS_OF_TREES, LEAST_ROUNDS = 2.0, 20
SOUNDS = 1  # Seed of the generator for sounds
# Road users are recorded by one microphone in the middle, so their sounds are rendered once for all arrays.
MIDDLE = MicrophoneArray(np.array([[0.0, 0.01, 0.0], [0.0, -0.01, 0.0]]))
SIMULATED = "simulated streets"
STREETS = DataSource(SIMULATED, "coefficients", "Apache-2.0: the simulation is a part of this project")
# Data for the thresholds of guard and road users; the thresholds are in `guard_training`.
CHOSEN_ON = (
    DataSource("82 recordings of passing cars and trams", "thresholds"),
    DataSource("195 recordings of buses and trams", "thresholds", "CC0-1.0"),
)
# Share of hazard-free time in use: two hours to 72 minutes of approaches, as in the exam.
HAZARD_FREE_SHARE = 120.0 / 192.0


def learning_minutes(settings: CommissionSettings) -> float:
    """Return the cost of learning, expressed in minutes of streams."""
    return LEARNING_SHARE * sum(one.minutes for one in learned_streams(settings))


WindowsOf = Callable[[Sequence[HeardStream]], tuple[FeatureTable, SimulatedWindows | None]]
FitWindows = Callable[[Sequence[HeardStream]], EnsembleModel]


def heard_streams(
    plan: Sequence[StreamSettings],
    array: MicrophoneArray,
    folder: Path,
    jobs: int = 1,
    beside: Sequence[MicrophoneArray] = (),
) -> Generator[HeardStream, None, None]:
    """Yield every stream of a plan; stored results of the same settings and array are reused.

    A newly rendered stream is also processed and stored for the arrays `beside`; a small array adds a sixth
    of the time that it takes alone.
    """
    folder.mkdir(parents=True, exist_ok=True)
    arrays = [array, *beside]
    for (one,) in in_processes(partial(_heard, arrays, [[one] for one in arrays], folder), plan, jobs):
        yield one


def _heard(
    arrays: Sequence[MicrophoneArray],
    believed: Sequence[Sequence[MicrophoneArray]],
    folder: Path,
    settings: StreamSettings,
) -> list[HeardStream]:
    """Return the streams of the first array, one per version in `believed`; store those of all arrays."""
    paths = [
        [_path(one, other, folder, settings) for other in some]
        for one, some in zip(arrays, believed, strict=True)
    ]
    missing = [number for number, some in enumerate(paths) if not all(path.is_file() for path in some)]
    if missing:
        heard = hear_stream(settings, [arrays[one] for one in missing], [believed[one] for one in missing])
        for one, path in zip(heard, chain.from_iterable(paths[number] for number in missing), strict=True):
            one.save(path)
    return [HeardStream.load(path) for path in paths[0]]


def _path(array: MicrophoneArray, believed: MicrophoneArray, folder: Path, settings: StreamSettings) -> Path:
    # A stream of the same name from another array or preset gets a file of its own.
    places = [array.positions_m.tolist()]
    if believed is not array:
        places.append(believed.positions_m.tolist())
    made_with = json.dumps([asdict(settings), *places], default=str, sort_keys=True)
    return folder / f"{settings.name}-{hashlib.sha256(made_with.encode()).hexdigest()[:12]}.npz"


def stream_evidence(model: EnsembleModel, heard: HeardStream) -> FloatArray:
    """Return the evidence along a stream, from a window model and the front-end."""
    posteriors = posteriors_along(model, heard.hops.feature)
    sides = side_ratios(posteriors, model.classes, model.class_prior)
    names = "feature", "band_log_energy", "prominence", "looming_hz", "looming_std_hz", "bearing_rad"
    own = {name: heard.hops.columns[name] for name in names}
    return hop_columns(sides, visible_ratios(posteriors, model.class_prior), **own)


def learn_sequence(
    streams: Sequence[HeardStream],
    fit_windows: FitWindows,
    onsets_per_hour: float,
    rng: np.random.Generator,
    jobs: int = 1,
    on_step: Callable[[str], None] = lambda stage: None,
) -> SequenceModel:
    """Train a sequence model on streams, with evidence from models without the junction of the stream.

    `fit_windows` trains a window model on some of the streams. The evidence of a stream always comes from a
    model that was not trained on its junction. Otherwise it would be better than at new junctions, and the
    trees would give it too much weight.
    """
    evidence, folds, fitted = dict[int, FloatArray](), _folds(streams), list[EnsembleModel]()
    for outside in folds:
        fitted.append(fit_windows([one for i, one in enumerate(streams) if i not in outside]))
        evidence |= {i: stream_evidence(fitted[-1], streams[i]) for i in outside}
        on_step("windows")
    inputs = list(in_processes(sequence_inputs, [evidence[i] for i in range(len(streams))], jobs))
    truths, weights = list(map(stream_truth, streams)), stream_weights(streams).tolist()
    labelled = list(map(LabelledStream.of, inputs, truths, weights))
    lessons = []
    for outside in folds:
        inside = [one for i, one in enumerate(labelled) if i not in outside]
        lessons.append((inside, int(rng.integers(2**31))))
    sizes, threads = dealt_growth(streams), None if jobs == 1 else 1
    learned = in_processes(partial(_learned, sizes, threads), lessons, jobs)
    margins, calm = list[float](), list[tuple[HeardStream, EnsembleModel, SequenceModel, FloatArray]]()
    for outside, windows, one in zip(folds, fitted, learned, strict=True):
        margins.append(calibrated_margin_s([(one.of_inputs(inputs[i]), truths[i]) for i in outside]))
        silent = replace(one, alarm=UNREACHED)
        calm += [(streams[i], windows, silent, evidence[i]) for i in outside if streams[i].hazard_free]
        on_step("trees")
    quiet = zip([heard.site for heard, *_ in calm], in_processes(_quiet_levels, calm, jobs), strict=True)
    curve, margin_s = measured_curve(quiet, elsewhere=True), float(np.mean(margins))
    on_step("alarm")
    every = [labelled[i] for outside in folds for i in outside]
    final = train_sequence(every, int(rng.integers(2**31)), sizes)
    return replace(final, margin_s=margin_s, alarm=curve.default(onsets_per_hour), curve=curve)


def dealt_growth(streams: Sequence[HeardStream]) -> list[Growth]:
    """Return the sizes of trees for this amount of sound."""
    hours = sum(len(one.hops) for one in streams) * HOP_S / SECONDS_PER_HOUR
    share = min(hours / HOURS_OF_TREES, 1.0)
    sizes = MOVING if streams[0].ego_moves else STANDING
    return [replace(one, rounds=max(round(one.rounds * share), LEAST_ROUNDS)) for one in sizes]


def _quiet_levels(calm: tuple[HeardStream, EnsembleModel, SequenceModel, FloatArray]) -> FloatArray:
    return alarm_levels(stream_states(*calm))


def _learned(
    sizes: Sequence[Growth], threads: int | None, lesson: tuple[list[LabelledStream], int]
) -> SequenceModel:
    streams, seed = lesson
    return train_sequence(streams, seed, sizes, threads)


def _folds(streams: Sequence[HeardStream]) -> list[list[int]]:
    """Return the streams of every fold: junctions in turn, in pairs of both types if there are enough."""
    names = sorted({one.site for one in streams}, key=lambda name: (name[2:], name))
    together = 2 if len(names) >= 2 * FOLDS else 1
    folds = [names.index(one.site) // together % FOLDS for one in streams]
    return [[i for i, at in enumerate(folds) if at == fold] for fold in sorted(set(folds))]


def stream_weights(streams: Sequence[HeardStream]) -> FloatArray:
    """Return the weight of a hop of each stream, such that hazard-free time has the same share as in use."""
    free = np.array([one.hazard_free for one in streams])
    hops = np.array([len(one.hops) for one in streams])
    quiet = HAZARD_FREE_SHARE / max(hops[free].sum(), 1)
    approaching = (1.0 - HAZARD_FREE_SHARE) / max(hops[~free].sum(), 1)
    return np.asarray(np.where(free, quiet, approaching) * hops.sum())


def commission(
    array: MicrophoneArray,
    settings: CommissionSettings,
    folder: Path,
    *,
    table: FeatureTable | None = None,
    source: str = "labelled windows",
    licence: str = "none stated",
    excluded_lists: Sequence[str] = (),
    quiet: Sequence[Path] = (),
    recorded: RecordedClips | None = None,
    beside: Sequence[MicrophoneArray] = (),
    jobs: int = 1,
    on_step: Callable[[str, float], None] = lambda stage, minutes: None,
) -> Model:
    """Train a model for an array on simulated streets, and on labelled windows if there are any.

    Streams are also processed and stored for the arrays `beside`. `on_step` is called with the next stage and
    with the finished work in minutes of streams; learning takes `learning_minutes`.

    The model's card lists every source by use, the labelled windows with their licence, and a comparison of
    simulated exams with real recordings. Recordings without vehicles set the alarm instead of simulated
    hazard-free streets; guard and road users are trained on recorded clips as well. The model contains the
    origin of labelled windows and clips, and the excluded lists of windows.
    """
    check_extra("sklearn")
    streams, rng = list[HeardStream](), np.random.default_rng(settings.seed)
    plan = learned_streams(settings)
    # The user's own data are read and checked before hours of streets are simulated.
    domain, real = own_windows(array, settings, table)
    calm = quiet_streams(quiet, array, settings.onsets_per_hour) if quiet else []
    on_step("streets", 0.0)
    for planned, one in zip(plan, heard_streams(plan, array, folder, jobs, beside), strict=True):
        streams.append(one)
        on_step("streets", planned.minutes)

    def learned(stage: str) -> None:
        on_step(stage, learning_minutes(settings) / LEARNING_STEPS)

    windows_of, fit = windows_to_learn(array, settings, domain, real, rng, jobs)
    sequence = learn_sequence(streams, fit, settings.onsets_per_hour, rng, jobs, learned)
    learned("window model")
    windows, simulated = windows_of(streams)
    model = train_model(
        windows,
        TrainingSettings(seed=settings.seed, repeats=1),
        dataset=SIMULATED if real is None else f"{source}; {SIMULATED}",
        group="dynamic" if settings.moving_ego else "static",
        excluded_lists=(*excluded_lists, *settings.leave_out),
        simulated=simulated,
    )
    # The training of the guard leaves some streets out, so the two streets of `quick` are too few. With
    # recorded clips the guard is trained anyway, with two simulated clips per kind.
    if recorded is not None or not settings.quick:
        learned("sounds near by")
        model = _with_ears(model, array, streams, recorded, settings, jobs, learned)
    named = [STREETS] if real is None else [STREETS, DataSource(source, "coefficients", licence)]
    if recorded is not None:
        named.append(DataSource(recorded.told, "coefficients", "; ".join(recorded.licences)))
    named += CHOSEN_ON if model.guard is not None else ()
    named += [DataSource(path.name, "thresholds") for path in quiet] or [replace(STREETS, use="thresholds")]
    named.append(replace(STREETS, use="exam"))
    gaps = real_figures(array, moving_ego=settings.moving_ego)
    origin = replace(model.provenance, fit_for_use=not settings.quick, sources=tuple(named), real=gaps)
    made = replace(model, provenance=origin, sequence=sequence)
    if not calm:
        return made
    curve = measured_curve((one.site, levels_of(made, one)) for one in calm)
    return with_curve(made, curve, settings.onsets_per_hour)


def real_figures(array: MicrophoneArray, *, moving_ego: bool = False) -> tuple[RealFigure, ...]:
    """Return the exam figures on real recordings for an array, as in the shipped model.

    The roof array with an ego vehicle at rest has its own figures. Other models get those of two microphones.
    """
    known = read_model()
    roof = known.domain is not None and microphone_order(known.domain.positions_m, array) is not None
    own = roof and not moving_ego
    return tuple(one for one in known.provenance.real if own or not one.own)


def _with_ears(
    model: Model,
    array: MicrophoneArray,
    streams: Sequence[HeardStream],
    recorded: RecordedClips | None,
    settings: CommissionSettings,
    jobs: int,
    learned: Callable[[str], None],
) -> Model:
    """Return a model with a guard and a road-user classifier, trained on sounds near by and in streets."""
    rate_hz: float = streams[0].hops.about["sample_rate_hz"]
    sites = tuple(dict.fromkeys(one.site for one in streams))
    close, passes = _sounds(rate_hz, sites, settings.seed, 2 if settings.quick else CLIPS_EACH, jobs)
    about = model.provenance.classifier
    if recorded is not None:
        close, about = SoundRows.joined([close, recorded.rows]), f"{about}; {recorded.told}"
    learned("guard")
    guard = train_guard(array, streams, close, np.random.default_rng(settings.seed), jobs)
    about = f"{about}; {CHOSEN_FOR_GUARD}; {CHOSEN_FOR_ROAD_USERS}"
    provenance = replace(model.provenance, classifier=about)
    road_users = fit_road_users(with_close(passes, close))
    return replace(model, provenance=provenance, guard=guard, road_users=road_users)


@lru_cache(maxsize=1)
def _sounds(
    rate_hz: float, sites: tuple[str, ...], seed: int, clips_each: int, jobs: int
) -> tuple[SoundRows, RoadUserRows]:
    """Render sounds near by and passes of road users, once for all arrays of one call."""
    rng = np.random.default_rng([seed, SOUNDS])
    return close_rows(rate_hz, rng, clips_each, jobs), road_user_rows(MIDDLE, sites, rate_hz, rng, jobs=jobs)


def quiet_streams(quiet: Sequence[Path], array: MicrophoneArray, onsets_per_hour: float) -> list[HeardStream]:
    """Process recordings without vehicles; raise an error if there are too few hours to set an alarm."""
    heard = [hear_recording(path, array) for path in quiet]
    hours = sum(len(one.hops) for one in heard) * HOP_S / SECONDS_PER_HOUR
    check_hours("quiet", hours, onsets_per_hour)
    return heard


def levels_of(model: Model, heard: HeardStream) -> FloatArray:
    """Return the `alarm_levels` of a stream from the complete model, shape (hops, 2)."""
    windows, sequence = parts_of(model)
    evidence, silent = stream_evidence(windows, heard), replace(sequence, alarm=UNREACHED)
    states = stream_states(heard, windows, silent, evidence, model.guard, model.street)
    return alarm_levels(states, model.street)


def with_curve(model: Model, curve: AlarmCurve, onsets_per_hour: float) -> Model:
    """Return a model with a curve and its default budget."""
    _, sequence = parts_of(model)
    return replace(model, sequence=replace(sequence, alarm=curve.default(onsets_per_hour), curve=curve))


def parts_of(model: Model) -> tuple[EnsembleModel, SequenceModel]:
    """Return the window model and the sequence model of a model that `commission` made."""
    if model.sequence is None or not isinstance(model.signature, EnsembleModel):
        raise InvalidArgumentError("model: expected a model with a sequence, as from `commission`")
    return model.signature, model.sequence


def own_windows(
    array: MicrophoneArray, settings: CommissionSettings, table: FeatureTable | None
) -> tuple[ModelDomain, FeatureTable | None]:
    """Return the domain of a model for an array, and the labelled windows for its training."""
    plan = learned_streams(settings)
    domain = domain_of(array, [plan[0].sample_rate_hz], [one.site.name for one in plan])
    domain = replace(domain, fastest_mps=max(one.ego.speed_mps for one in plan) or None)
    return domain, None if table is None else windows_of_array(table, settings, domain)


def windows_to_learn(
    array: MicrophoneArray,
    settings: CommissionSettings,
    domain: ModelDomain,
    real: FeatureTable | None,
    rng: np.random.Generator,
    jobs: int = 1,
) -> tuple[WindowsOf, FitWindows]:
    """Return functions from streams to their training windows and to a window model trained on them.

    The training windows include sources in the open.
    """
    number = N_OPEN // 10 if settings.quick else N_OPEN
    open_field = open_field_windows(open_field_features(array, number, rng, jobs, settings.moving_ego))
    windows_of = partial(table_and_beside, real, open_field, domain)
    # With real windows alone, the model is the same for all streams
    fitted = lru_cache(maxsize=1)(window_model)
    return windows_of, lambda some: fitted(*windows_of(some))


def windows_of_array(table: FeatureTable, settings: CommissionSettings, domain: ModelDomain) -> FeatureTable:
    """Return the windows for training, in the domain of this array; raise an error for another array."""
    kept = table.select(~np.isin(table.environments, settings.leave_out))
    if kept.domain is None:
        return replace(kept, domain=domain)
    check_tables(domain, kept.domain)
    return kept


def table_and_beside(
    real: FeatureTable | None,
    open_field: SimulatedWindows,
    domain: ModelDomain,
    streams: Sequence[HeardStream],
) -> tuple[FeatureTable, SimulatedWindows | None]:
    """Return the windows that a model is trained on, and additional simulated windows, if any."""
    # At left-out real junctions of a moving ego, the AUROC is 0.86 with real windows alone, 0.84 with added
    # windows of drives, and 0.69 with added sources in the open as well.
    if real is not None and domain.ego_motion == "moving":
        return real, None
    learned = learned_beside(streams, open_field)
    if real is not None:
        return real, learned.beside(real.environments)
    # Without real windows, windows of the streams with the usual classes replace them; the others are added.
    own = np.isin(learned.y, CLASSES)
    n_features = learned.X.shape[1] // (1 + len(KINDS))
    numbers = np.arange(len(own)).astype(np.str_)[own]
    columns = learned.X[own, :n_features], learned.y[own], numbers, learned.sites[own], numbers
    table = FeatureTable(*columns, (None,) * len(numbers), domain)
    return table, SimulatedWindows(*(getattr(learned, one.name)[~own] for one in fields(SimulatedWindows)))


def exam_of(
    array: MicrophoneArray,
    model: Model,
    settings: CommissionSettings,
    folder: Path,
    *,
    beside: Sequence[MicrophoneArray] = (),
    jobs: int = 1,
    on_step: Callable[[float], None] = lambda minutes: None,
) -> list[ExaminedStream]:
    """Examine a model on streams of the five named junctions, which it was not trained on."""
    plan, arrays, examined = exam_streams(settings), [array, *beside], list[ExaminedStream]()
    folder.mkdir(parents=True, exist_ok=True)
    hear = partial(_heard_and_examined, model, arrays, folder)
    for planned, one in zip(plan, in_processes(hear, plan, jobs), strict=True):
        examined.append(one)
        on_step(planned.minutes)
    return examined


def _heard_and_examined(
    model: Model, arrays: Sequence[MicrophoneArray], folder: Path, settings: StreamSettings
) -> ExaminedStream:
    (heard,) = _heard(arrays, [[one] for one in arrays], folder, settings)
    return examine_stream(model, heard)


def examine_stream(model: Model, heard: HeardStream) -> ExaminedStream:
    """Examine a model with an alarm on a processed stream."""
    windows, sequence = parts_of(model)
    if sequence.alarm is None:
        raise InvalidArgumentError("model: expected a model with an alarm, as from `commission`")
    evidence = stream_evidence(windows, heard)
    told = advised(stream_states(heard, windows, sequence, evidence, model.guard, model.street))
    return ExaminedStream(heard, stream_truth(heard), sequence.posterior(evidence), told)


def exam_of_mountings(
    array: MicrophoneArray, model: Model, settings: CommissionSettings, folder: Path, jobs: int = 1
) -> Iterator[dict[str, ExaminedStream]]:
    """Examine a model on each stream of a junction, processed with every wrong mounting of its array."""
    mounted = mountings(array, np.random.default_rng(settings.seed))
    hear = partial(_heard, [array], [list(mounted.values())], folder)
    for heard in in_processes(hear, mounting_streams(settings), jobs):
        yield {name: examine_stream(model, one) for name, one in zip(mounted, heard, strict=True)}
