"""`worldstate-lab scenarios`: performance of the world-state in weather, at stops and for quiet road users.

Each scenario is a traffic with hazards and one without, rendered at every junction for the model's own array
and followed hop by hop without a camera. The output has for each: approaches with an advisory before T0,
those in advisory in the last second before it and in the last hop, onsets per hour without hazards, and the
shares of unusable hops, among those whose second contains a gust and among all others. Quiet road users are
scored in their own scenarios only. Streams in --streams are not rendered again.

Choose junctions and a seed that are not in the model's training.

Examples
--------
  worldstate-lab scenarios --streams exam --jobs 2
  worldstate-lab scenarios gusts rain --streams exam --model my_model.json --minutes 4 --sites SA2 TB912
"""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np

from worldstate.adapters.files.acoustic_domain import array_of
from worldstate.adapters.files.model_file import Model, read_model
from worldstate.cli.common.output import CommandResult
from worldstate.cli.common.progress import track
from worldstate.commissioning.commission import parts_of
from worldstate.commissioning.heard_stream import hear_stream, junction_named
from worldstate.commissioning.stream_exam import approach_table
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.parallel import in_processes
from worldstate.ground.typing import BoolArray
from worldstate.operations.metrics.approach_table import Figures, mean_of
from worldstate.simulation.stream.arrivals import draw_sounds
from worldstate.simulation.stream.settings import StreamSettings, traffic_named
from worldstate.simulation.stream.writing import SOUNDS
from worldstate_lab.passes.followed_stream import PassedStream, passed_stream
from worldstate_lab.report.table import figure_lines

# Traffic with hazards and traffic without.
SCENARIOS: Mapping[str, tuple[str, str]] = {
    "usual": ("pairs", "no-hazard"),
    **{day: (f"pairs-{day}", f"no-hazard-{day}") for day in ("gusts", "rain", "quiet")},
    "stops": ("stops", "no-hazard"),
    **{kind: (f"{kind}-only", "no-hazard") for kind in ("bicycle", "scooter", "electric")},
}
RATE_HZ, WINDOW_S = 6000.0, 1.0  # Sample rate, for sound up to 2 kHz, and the window of a hop
Followed = tuple[PassedStream, BoolArray]  # A stream, and whether the second of each hop contains a gust


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add, sites = parser.add_argument, ["SA2", "SB2", "TA911", "TB912"]
    add("names", nargs="*", metavar="NAME", choices=[[], *SCENARIOS], help="scenarios (default: all)")
    add("--streams", type=Path, required=True, metavar="D", help="folder of the processed streams")
    add("--model", type=Path, metavar="JSON", help="model with a sequence (default: the shipped one)")
    add("--budget", type=float, metavar="N", help="onsets per hour (default: the model's)")
    add("--sites", nargs="+", default=sites, metavar="SITE", help=f"junctions (default: {' '.join(sites)})")
    add("--minutes", type=float, default=10.0, help="length of each stream (default: %(default)g)")
    add("--seed", type=int, default=9100, help="seed of the first junction (default: %(default)s)")
    add("--jobs", type=int, default=1, help="processes (default: 1)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return its result."""
    model, names = read_model(arguments.model), arguments.names or [*SCENARIOS]
    if arguments.budget is not None:
        model = replace(model, sequence=parts_of(model)[1].asking(budget=arguments.budget))
    arguments.streams.mkdir(parents=True, exist_ok=True)
    sites = [(seed, junction_named(site)) for seed, site in enumerate(arguments.sites, arguments.seed)]
    plan = [
        StreamSettings(site, arguments.minutes, seed, traffic_named(name), sample_rate_hz=RATE_HZ)
        for name in dict.fromkeys(chain.from_iterable(SCENARIOS[name] for name in names))
        for seed, site in sites
    ]
    found = in_processes(partial(follow_plan, model=model, folder=arguments.streams), plan, arguments.jobs)
    streams: dict[str, list[Followed]] = {}
    for settings, one in zip(plan, track(found, "following", len(plan)), strict=True):
        streams.setdefault(settings.traffic.name, []).append(one)
    rows = {
        name: scenario_figures([*chain.from_iterable(streams[one] for one in SCENARIOS[name])])
        for name in names
    }
    return CommandResult({"scenarios": rows}, table={}, lines=figure_lines(rows, ".3f"))


def follow_plan(settings: StreamSettings, model: Model, folder: Path) -> Followed:
    """Return a stream with the filter's output, rendered unless it is in the folder."""
    if model.domain is None:
        raise InvalidArgumentError("model: expected one with an array, got one without")
    path, array = folder / f"{settings.name}-{settings.minutes:g}.npz", array_of(model.domain)
    if not path.is_file():
        hear_stream(settings, [array])[0].save(path)
    passed = passed_stream(path, model, "none")
    in_gust = np.zeros(len(passed.followed.time_s), bool)
    for one in draw_sounds(settings, [array.n_microphones], settings.generator(SOUNDS)):
        since_s = passed.followed.time_s - one.start_s - one.sound.start_s
        in_gust |= (one.sound.kind == "wind") & (since_s > 0.0) & (since_s < one.sound.duration_s + WINDOW_S)
    return passed, in_gust


def scenario_figures(streams: Sequence[Followed]) -> Figures:
    """Return the figures of one scenario."""
    table = approach_table([(one.heard, one.followed.advisory) for one, _ in streams])
    counted = table.loud() if table.loud().outcomes else table
    unheard = np.concatenate([one.followed.unheard for one, _ in streams])
    in_gust = np.concatenate([inside for _, inside in streams])
    found = counted.detections() | counted.standing() | table.false_alarms()
    return found | {"unheard_in_gusts": mean_of(unheard[in_gust]), "unheard_else": mean_of(unheard[~in_gust])}
