"""`worldstate-lab left-out`: performance of a model in streets of a renderer outside its training.

The streams are those of `worldstate model make`; streams in the folder --streams are not rendered again. Each
renderer is left out once: a window and a sequence model are trained on the streams of the other two, as in
`model make`, and evaluated on all streams of the one that is left out.

Figures are compared at equal onsets: the threshold is the lowest with at most 30 onsets per hour (a moving
ego: 40) in the left-out renderer's own hazard-free streams, without misleading traffic. The output has for
each renderer: approaches detected and their lead; approaches in advisory in the last second before T0 and in
the last hop; onsets per hour; Brier skill of the probabilities at 1, 2 and 3 s; the share of detected
approaches whose first advisory has the side of the first vehicle (both sides at once excluded); and
detections without a wall opposite. "learned alarm" is the threshold that the streams of the other two
renderers set, which a user would have.

Examples
--------
  worldstate-lab left-out --streams streams --jobs 2
  worldstate-lab left-out --streams streams --array uma-8 --moving-ego --junctions 4 --results left_out.json
"""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from worldstate.abduction.sequence.sequence_model import SequenceModel
from worldstate.abduction.signature.ensemble import EnsembleModel
from worldstate.cli.common.inputs import add_array_options, given_array
from worldstate.cli.common.output import CommandResult
from worldstate.cli.common.progress import progress_bar
from worldstate.commissioning.alarm_curve import (
    UNREACHED,
    alarm_levels,
    measured_curve,
    raised_at,
    stream_states,
)
from worldstate.commissioning.commission import (
    FOLDS,
    FitWindows,
    heard_streams,
    learn_sequence,
    own_windows,
    stream_evidence,
    windows_to_learn,
)
from worldstate.commissioning.heard_stream import (
    CommissionSettings,
    HeardStream,
    junction_named,
    learned_streams,
)
from worldstate.commissioning.sequence_training import stream_truth
from worldstate.commissioning.stream_exam import ExaminedStream, alarm_outcomes, examine
from worldstate.frontend.array.microphone_array import ovad_array
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.parallel import in_processes
from worldstate.ground.typing import FloatArray
from worldstate.operations.metrics.approach_table import ApproachTable, Figures, caution, mean_of
from worldstate_lab.report.table import figure_lines

NEEDS = ("sklearn",)
MINUTES = 7.2  # Minutes with approaches per junction
ONSETS = {False: 30.0, True: 40.0}  # Per hour, by whether the ego moves
# Windows and trees of every fold, the alarm, the window model, and the start of the evaluation.
STEPS = 2 * FOLDS + 3
MISLEADING = "misleading"  # Prefix of the names of such traffic
OF_EXAM = (
    *("approaches", "detected", "detected_low", "detected_high", "lead_s", "lead_missed_as_0_s"),
    *("advised_last_second", "advised_at_t0", "skill_1s", "skill_2s", "skill_3s"),
)
OF_ALARM = ("hazard_free_hours", "onsets_per_hour", "onsets_low", "onsets_high")
# A stream with the output of a model, and the levels of its alarm (n, 2): see `alarm_levels`.
Judged = tuple[ExaminedStream, FloatArray]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add_array_options(parser, "OVAD's")
    add("--streams", type=Path, required=True, metavar="D", help="folder of the processed streams")
    add("--moving-ego", action="store_true", help="the ego drives up to the corner instead of standing")
    add("--junctions", type=int, default=12, metavar="N", help="number per renderer (default: %(default)s)")
    add("--seed", type=int, default=1, help="seed of streams and trees (default: %(default)s)")
    add("--jobs", type=int, default=1, help="processes (default: 1)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return its result."""
    moves: bool = arguments.moving_ego
    settings = CommissionSettings(
        junctions=arguments.junctions,
        approach_minutes=MINUTES,
        hazard_free_minutes=MINUTES / 1.2,
        onsets_per_hour=ONSETS[moves],
        seed=arguments.seed,
        moving_ego=moves,
    )
    array = given_array(arguments) or ovad_array()
    plan, streams = learned_streams(settings), list[HeardStream]()
    if not any(one.traffic.hazard_free and not one.traffic.name.startswith(MISLEADING) for one in plan):
        raise InvalidArgumentError("--junctions: expected 3 or more to set the threshold")
    rng, own = np.random.default_rng(settings.seed), own_windows(array, settings, None)
    _, fit = windows_to_learn(array, settings, *own, rng, arguments.jobs)
    with progress_bar("listening", sum(one.minutes for one in plan)) as bar:
        heard = heard_streams(plan, array, arguments.streams, arguments.jobs)
        for planned, one in zip(plan, heard, strict=True):
            streams.append(one)
            bar.advance(planned.minutes)
    renderers = dict.fromkeys(one.renderer for one in streams)
    rows = {name: left_out_row(name, streams, fit, settings, arguments.jobs) for name in renderers}
    few = {name: caution(int(row["approaches"] or 0), "approaches") for name, row in rows.items()}
    lines = [f"{name}: {told}" for name, told in few.items() if told is not None]
    return CommandResult({"left_out": rows}, table={}, lines=[*figure_lines(rows, ".3f"), *lines])


def left_out_row(
    renderer: str, streams: Sequence[HeardStream], fit: FitWindows, settings: CommissionSettings, jobs: int
) -> Figures:
    """Return the row of a renderer that is left out of the training."""
    left, judged = [one for one in streams if one.renderer == renderer], list[Judged]()
    with progress_bar(f"without {renderer}", STEPS + len(left)) as bar:
        step = partial(bar.go_on, amount=1.0)
        windows, sequence = learned_without(renderer, streams, fit, settings, jobs, step)
        step("judging")
        for one in in_processes(partial(judge, windows, sequence), left, jobs):
            judged.append(one)
            bar.advance()
    assert sequence.alarm is not None  # `learn_sequence` sets one
    return renderer_figures(judged, settings.onsets_per_hour, sequence.alarm.threshold_nats)


def learned_without(
    renderer: str,
    streams: Sequence[HeardStream],
    fit: FitWindows,
    settings: CommissionSettings,
    jobs: int = 1,
    on_step: Callable[[str], None] = lambda stage: None,
) -> tuple[EnsembleModel, SequenceModel]:
    """Return a window and a sequence model that were trained without a renderer."""
    others = [one for one in streams if one.renderer != renderer]
    # Each renderer has its own generator, so that its row does not depend on the renderers before it.
    rng = np.random.default_rng(settings.seed)
    sequence = learn_sequence(others, fit, settings.onsets_per_hour, rng, jobs, on_step)
    on_step("window model")
    return fit(others), sequence


def judge(windows: EnsembleModel, sequence: SequenceModel, heard: HeardStream) -> Judged:
    """Return the output of models for a stream, without advisories, and the levels of its alarm."""
    evidence = stream_evidence(windows, heard)
    levels = alarm_levels(stream_states(heard, windows, replace(sequence, alarm=UNREACHED), evidence))
    none = np.zeros(levels.shape, bool)
    return ExaminedStream(heard, stream_truth(heard), sequence.posterior(evidence), none), levels


def renderer_figures(judged: Sequence[Judged], onsets_per_hour: float, learned_nats: float) -> Figures:
    """Return the row of a renderer: at a number of onsets per hour, and at the threshold of the others."""
    calm = [(one.heard, levels) for one, levels in judged if one.heard.hazard_free]
    quiet = ((heard.site, levels) for heard, levels in calm if not _misleads(heard))
    threshold_nats = measured_curve(quiet).default(onsets_per_hour).threshold_nats
    streams, learned = (_advised(judged, nats) for nats in (threshold_nats, learned_nats))
    found, false = examine(streams), _false_alarms(streams)
    sides = [
        right for one, (_, levels) in zip(streams, judged, strict=True) for right in sides_right(one, levels)
    ]
    without_wall = examine([one for one in streams if junction_named(one.heard.site).opposite_wall_m is None])
    return {
        "threshold_nats": threshold_nats,
        **{name: found[name] for name in OF_EXAM},
        **{name: false[name] for name in OF_ALARM},
        "misleading_onsets_per_hour": _false_alarms(streams, misleading=True)["onsets_per_hour"],
        **{"side_approaches": len(sides), "side_right": mean_of(sides)},
        **{f"no_wall_{name}": without_wall[name] for name in ("approaches", "detected")},
        "learned_alarm_detected": examine(learned)["detected"],
        "learned_alarm_onsets_per_hour": _false_alarms(learned)["onsets_per_hour"],
    }


def sides_right(one: ExaminedStream, levels: FloatArray) -> list[bool]:
    """Return for each approach from one side whether the first advisory has that side.

    If both sides have one at that hop, the side with the higher level is used.
    """
    found = []
    for told in alarm_outcomes(one.heard, one.heard.hops.time_s, one.advised):
        if not told.detected or told.approach.flow == "both" or told.approach.quiet:
            continue
        hop = np.abs(one.heard.hops.time_s - told.approach.entries_s[0] + told.lead_s).argmin()
        own = told.approach.sides[0]
        found.append(
            bool(one.advised[hop, own])
            and not (one.advised[hop, 1 - own] and levels[hop, 1 - own] > levels[hop, own])
        )
    return found


def _misleads(heard: HeardStream) -> bool:
    return str(heard.hops.about["traffic"]).startswith(MISLEADING)


def _advised(judged: Sequence[Judged], threshold_nats: float) -> list[ExaminedStream]:
    """Return the streams with the advisories of a threshold."""
    return [
        replace(one, advised=np.stack([raised_at(side, threshold_nats) for side in levels.T], axis=1))
        for one, levels in judged
    ]


def _false_alarms(streams: Sequence[ExaminedStream], *, misleading: bool = False) -> Figures:
    quiet = [one for one in streams if one.heard.hazard_free and _misleads(one.heard) == misleading]
    return ApproachTable([], [one.advised for one in quiet]).false_alarms()
