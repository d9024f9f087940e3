"""`worldstate-lab streams`: performance of the whole world-state on simulated streams, by vehicle.

Streams kept by `worldstate model make` pass through the filter hop by hop, with boxes of a camera drawn from
their truth. The output has for every junction and for all: announced approaches and their lead (from eight
seconds before T0 on, and from five), onsets per hour without an approach, detection of both vehicles of a
pair, kept identities, advisories after the pass, errors of times and bearings, and the performance of a sound
level meter. For the second vehicle from the other side, and for a follower, it has by the gap to the first:
the probability to come within three seconds if it adds a decibel to the sound or less, and the result of its
entity. It also has the added level, the trade between announcing both sides of a pair and the other side of a
single vehicle, and onsets per hour by kind of hazard-free traffic. "worst" is over junctions with at least
eight cases. With --days, days are drawn from the streams with their own rate of false onsets, the budgeted
rate and more: how often the watch reports a broken budget, and after how many hours.

--curve MODEL writes the model with the curve from budget to threshold of hazard-free streams, without a
camera, and prints some of its points. --promise prints for budgets and shares the promise of the model's
curve and the result of these hazard-free streams, by renderer. Neither follows vehicles.

The streams must have other seeds and, for a fair figure, other junctions than the model's training.

Examples
--------
  worldstate-lab streams streams/*-2001-*.npz --model my_model.json
  worldstate-lab streams streams/SA1-*.npz --model my_model.json --camera none --json
  worldstate-lab streams streams/*-2001-*.npz --days 1000 --jobs 2
  worldstate-lab streams quiet/*-81*.npz --curve my_model.json --budget 25 --jobs 2
  worldstate-lab streams quiet/*-83*.npz --model my_model.json --promise --jobs 2
"""

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np

from worldstate.abduction.sequence.sequence_model import SequenceModel
from worldstate.adapters.files.model_file import Model, read_model, save_model
from worldstate.cli.common.output import CommandResult
from worldstate.cli.common.progress import track
from worldstate.commissioning.alarm_curve import measured_curve, raised_at
from worldstate.commissioning.commission import levels_of, parts_of, with_curve
from worldstate.commissioning.heard_stream import HeardStream
from worldstate.ground.checks import in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.parallel import in_processes
from worldstate.ground.typing import FloatArray
from worldstate.ground.values import SECONDS_PER_HOUR
from worldstate.operations.metrics.approach_table import ApproachTable, Figures
from worldstate.operations.recordings.hop_table import HOP_S
from worldstate.simulation.scene.junction import standing_name
from worldstate_lab.passes.budget_days import budget_days
from worldstate_lab.passes.followed_stream import PassedStream, passed_stream
from worldstate_lab.passes.pass_outcomes import (
    hearing_allows,
    onsets_by_traffic,
    pass_figures,
    second_figures,
    sides_by_risk,
)
from worldstate_lab.report.table import figure_lines


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("streams", type=Path, nargs="+", metavar="NPZ", help="processed streams")
    add("--model", type=Path, metavar="JSON", help="model with a sequence (default: the shipped one)")
    cameras = "boxes of all vehicles, of cars above 100 px, none, or none from every T0 on"
    add("--camera", choices=("all", "cars", "none", "dies"), default="all", help=cameras)
    add(
        "--sides", action=argparse.BooleanOptionalAction, default=True,
        help="learn the sound of each arm from vehicles that come into view (default: on)",
    )  # fmt: skip
    add("--curve", type=Path, metavar="MODEL", help="write the model with the alarm curve of these streams")
    add("--budget", type=float, metavar="N", help="its budget, onsets per hour (default: the model's)")
    add("--promise", action="store_true", help="test the curve of the model on these streams")
    add("--days", type=int, default=0, metavar="N", help="days of each kind, drawn from the streams")
    add("--seed", type=int, default=0, help="seed of camera misses and days (default: %(default)s)")
    add("--jobs", type=int, default=1, help="processes (default: 1)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return its result."""
    model, days = read_model(arguments.model), in_range("--days", arguments.days, 0, 100_000)
    if arguments.promise or arguments.curve is not None:
        return _curve(arguments, model)
    given = {"camera": arguments.camera, "seed": arguments.seed, "learns": arguments.sides}
    follow = partial(passed_stream, model=model, **given)
    streams: dict[str, list[PassedStream]] = {}
    passed = in_processes(follow, arguments.streams, arguments.jobs)
    for one in track(passed, "following", len(arguments.streams)):
        streams.setdefault(one.heard.site, []).append(one)
    every = [one for some in streams.values() for one in some]
    figures = {site: _figures(streams[site]) for site in sorted(streams)}
    columns = figures | {"worst": worst_of(figures), "all": _figures(every)}
    added, sides, quiet = hearing_allows(every), sides_by_risk(every), onsets_by_traffic(every)
    report = {**given, "junctions": columns, "second_adds_db": added, "sides_by_risk": sides}
    report["hazard_free"] = quiet
    lines = ["dB that a second vehicle adds, by time before its own T0", *figure_lines(added, ".1f"), ""]
    lines += [*figure_lines(columns, ".3f"), "", "sides announced by risk", *figure_lines(sides, ".3f")]
    lines += ["", "without hazards", *figure_lines(quiet, ".3f")]
    alarm = parts_of(model)[1].alarm
    if days and alarm is not None:
        rng = np.random.default_rng(arguments.seed)
        found = dict(track(budget_days(every, alarm.onsets_per_hour, int(days), rng), "drawing days"))
        report["budget_days"] = found
        lines += ["", f"budget, {days:g} days each", *figure_lines(found, ".3f")]
    return CommandResult(report, table={}, lines=lines)


BUDGETS, ALPHAS = (6.0, 12.0, 30.0), (0.01, 0.02, 0.05)


def _curve(arguments: argparse.Namespace, model: Model) -> CommandResult:
    """Write the curve of the streams, or compare them with that of the model."""
    levels: dict[str, list[FloatArray]] = {}
    found = in_processes(partial(_site_levels, model), arguments.streams, arguments.jobs)
    for site, one in track(found, "following", len(arguments.streams)):
        levels.setdefault(site, []).append(one)
    if arguments.curve is not None:
        alarm = parts_of(model)[1].alarm
        budget = arguments.budget or (25.0 if alarm is None else alarm.onsets_per_hour)
        model = with_curve(model, measured_curve(levels), in_range("--budget", budget, 0.1, 3600.0))
        save_model(arguments.curve, model)
    rows = promised_and_found(parts_of(model)[1], levels)
    hours = sum(len(one) for some in levels.values() for one in some) * HOP_S / SECONDS_PER_HOUR
    report = {"hours": hours, "junctions": len(levels), "rows": rows}
    return CommandResult(report, table={}, lines=[f"{hours:.2f} hours", *figure_lines(rows, ".4f")])


def _site_levels(model: Model, path: Path) -> tuple[str, FloatArray]:
    heard = HeardStream.load(path)
    if not heard.hazard_free:
        raise InvalidArgumentError(f"{path}: expected a stream without hazards")
    return heard.site, levels_of(model, heard)


def promised_and_found(
    sequence: SequenceModel, levels: Mapping[str, Sequence[FloatArray]]
) -> dict[str, Figures]:
    """Return the promises of the curve at some budgets and shares, and the results of each renderer.

    The first letter of a place's name is its renderer. A rate has its exact Poisson interval.
    """
    rows, groups = dict[str, Figures](), {standing_name(name)[0] for name in levels}
    asked = [("budget", one) for one in BUDGETS] + [("alpha", one) for one in ALPHAS]
    for name, value in asked:
        try:
            alarm = sequence.asking(**{name: value}).alarm
        except InvalidArgumentError:
            continue  # A short curve does not support all of them
        assert alarm is not None
        row: Figures = {"threshold_nats": alarm.threshold_nats}
        row |= {} if alarm.promise is None else asdict(alarm.promise)
        for group in sorted(groups):
            here = [streams for site, streams in levels.items() if standing_name(site)[0] == group]
            some = [one for streams in here for one in streams]
            false = ApproachTable([], [raised_at(one, alarm.threshold_nats) for one in some]).false_alarms()
            names = ("onsets_per_hour", "onsets_low", "onsets_high", "hazard_free_share")
            row |= {f"{group}: {figure}": false[figure] for figure in names}
        rows[f"{name} {value:g}"] = row
    return rows


def _figures(streams: Sequence[PassedStream]) -> Figures:
    return pass_figures(streams) | second_figures(streams)


FEWEST_CASES = 8
# By the end of a figure's name: the key of its number of cases, and whether the minimum or the maximum is
# worst.
_WORST: Mapping[str, tuple[str, Callable[[Iterable[float]], float]]] = {
    **dict.fromkeys(("detected", "detected_5s", "meter_detected"), ("approaches", min)),
    **dict.fromkeys(("skill_1s", "skill_2s", "skill_3s", "kept_after_t0"), ("approaches", min)),
    **dict.fromkeys(("ece_1s", "ece_2s", "ece_3s", "onsets_per_hour"), ("approaches", max)),
    **{"identity_kept": ("identity_judged", min), "took_hidden_identity": ("seen_ahead", max)},
    **{"other_side_too": ("singles", max), "both_sides_found": ("both", min)},
    **{"both_near_found": ("both_near", min), "skill": ("hops of 1 dB", min), "ECE": ("approaches", max)},
    **{
        "said masked": ("approaches", min),
        "identity kept": ("stated apart", min),
        "merged": ("stated apart", max),
    },
}


def worst_of(junctions: Mapping[str, Figures]) -> Figures:
    """Return the worst figure over junctions with at least eight cases, None if it is not defined."""
    return {name: _worst(junctions.values(), name) for name in next(iter(junctions.values()))}


def _worst(junctions: Iterable[Figures], name: str) -> float | None:
    group, colon, figure = name.rpartition(": ")
    if figure not in _WORST:
        return None
    cases, worst = _WORST[figure]
    known = [
        value
        for one in junctions
        if (one[f"{group}{colon}{cases}"] or 0) >= FEWEST_CASES and (value := one[name]) is not None
    ]
    return worst(known) if known else None
