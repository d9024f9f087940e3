"""`worldstate-lab streams`: performance of the whole world-state on simulated streams, by vehicle.

Streams kept by `worldstate model make` pass through the filter hop by hop, with boxes of a camera drawn from
their truth. The output has for every junction and for all: announced approaches and their lead (from eight
seconds before T0 on), onsets per hour without an approach, detection of both vehicles of a pair, kept
identities, advisories after the pass, errors of times and bearings, and the performance of a sound level
meter. It has two further figures for the second vehicle, from the other side or as a follower, by its gap to
the first: the probability to come within three seconds, if it adds at least a decibel to the sound and if it
adds less, and whether its entity is kept apart. It also has onsets per hour by kind of hazard-free traffic.
"worst" is over junctions with at least eight cases. With --days, days are drawn from the streams with their
own rate of false onsets, the budgeted rate and higher rates; the output then has how often the watch reports
a broken budget, and after how many hours.

The streams must have other seeds and, for a fair figure, other junctions than the model's training.

Examples
--------
  worldstate-lab streams streams/*-2001-*.npz --model my_model.json
  worldstate-lab streams streams/SA1-*.npz --model my_model.json --camera none --json
  worldstate-lab streams streams/*-2001-*.npz --days 1000 --jobs 2
"""

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from worldstate.adapters.files.model_file import read_model
from worldstate.cli.common.output import CommandResult
from worldstate.cli.common.progress import track
from worldstate.commissioning.commission import parts_of
from worldstate.ground.checks import in_range
from worldstate.ground.parallel import in_processes
from worldstate.operations.metrics.approach_table import Figures
from worldstate_lab.passes.budget_days import budget_days
from worldstate_lab.passes.followed_stream import PassedStream, passed_stream
from worldstate_lab.passes.pass_outcomes import onsets_by_traffic, pass_figures, second_figures
from worldstate_lab.report.table import figure_lines


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("streams", type=Path, nargs="+", metavar="NPZ", help="processed streams")
    add("--model", type=Path, metavar="JSON", help="model with a sequence (default: the shipped one)")
    cameras = "boxes of all vehicles, of cars above 100 px, none, or none from every T0 on"
    add("--camera", choices=("all", "cars", "none", "dies"), default="all", help=cameras)
    add("--days", type=int, default=0, metavar="N", help="days of each kind, drawn from the streams")
    add("--seed", type=int, default=0, help="seed of camera misses and days (default: %(default)s)")
    add("--jobs", type=int, default=1, help="processes (default: 1)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return its result."""
    model, days = read_model(arguments.model), in_range("--days", arguments.days, 0, 100_000)
    given = {"camera": arguments.camera, "seed": arguments.seed}
    follow = partial(passed_stream, model=model, **given)
    streams: dict[str, list[PassedStream]] = {}
    passed = in_processes(follow, arguments.streams, arguments.jobs)
    for one in track(passed, "following", len(arguments.streams)):
        streams.setdefault(one.heard.site, []).append(one)
    every = [one for some in streams.values() for one in some]
    figures = {site: _figures(streams[site]) for site in sorted(streams)}
    columns = figures | {"worst": worst_of(figures), "all": _figures(every)}
    quiet = onsets_by_traffic(every)
    report = {**given, "junctions": columns, "hazard_free": quiet}
    lines = [*figure_lines(columns, ".3f"), "", "without hazards", *figure_lines(quiet, ".3f")]
    alarm = parts_of(model)[1].alarm
    if days and alarm is not None:
        rng = np.random.default_rng(arguments.seed)
        found = dict(track(budget_days(every, alarm.onsets_per_hour, int(days), rng), "drawing days"))
        report["budget_days"] = found
        lines += ["", f"budget, {days:g} days each", *figure_lines(found, ".3f")]
    return CommandResult(report, table={}, lines=lines)


def _figures(streams: Sequence[PassedStream]) -> Figures:
    return pass_figures(streams) | second_figures(streams)


FEWEST_CASES = 8
# By the end of a figure's name: the key of its number of cases, and whether the minimum or the maximum is
# worst.
_WORST: Mapping[str, tuple[str, Callable[[Iterable[float]], float]]] = {
    **dict.fromkeys(("detected", "meter_detected"), ("approaches", min)),
    **dict.fromkeys(("skill_1s", "skill_2s", "skill_3s", "kept_after_t0"), ("approaches", min)),
    **dict.fromkeys(("ece_1s", "ece_2s", "ece_3s", "onsets_per_hour"), ("approaches", max)),
    **{"identity_kept": ("identity_judged", min), "took_hidden_identity": ("seen_ahead", max)},
    **{"other_side_too": ("singles", max), "both_sides_found": ("both", min)},
    **{"both_near_found": ("both_near", min), "skill": ("hops of 1 dB", min)},
    **{"said masked": ("approaches", min), "identity kept": ("stated apart", min)},
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
