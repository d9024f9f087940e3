"""`worldstate-lab kinds`: how well kinds of road users are told by their sound.

Let vehicles of every kind pass alone at drawn junctions, hear them with one microphone, and tell their class
(car, van, truck, tram, motorcycle, bicycle) at junctions that were not learned from. Hops in which a vehicle
lies more than 6 dB below the ambience are of the class *unknown*. Figures are of the hops from 3 s before to
1.5 s after line of sight, kinds as frequent as in a town.

With --streams such hops of streams are judged, as they come, where one vehicle is heard alone; streams are to
be of other junctions than the drawn ones.
"""

import argparse
from pathlib import Path

from worldstate.cli.common.output import CommandResult, write_report

EXAMPLE = """\
examples:
  worldstate-lab kinds --junctions 16 --passes 2 --jobs 2 --report road_users.json"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("--junctions", type=int, default=16, metavar="N", help="drawn ones (default: %(default)s)")
    add(
        "--passes",
        type=int,
        default=2,
        metavar="N",
        help="of each kind at each of them (default: %(default)s)",
    )
    add("--streams", type=Path, nargs="+", default=[], metavar="NPZ", help="that were listened to")
    add("--seed", type=int, default=0, help="who drives how (default: %(default)s)")
    add("--jobs", type=int, default=1, help="processes (default: 1)")
    add("--report", type=Path, metavar="JSON", help="write what was found")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return what it found."""
    from dataclasses import asdict

    import numpy as np

    from worldstate.cli.common.outputs import check_outputs
    from worldstate.cli.common.progress import progress_bar
    from worldstate.commissioning.heard_stream import HeardStream
    from worldstate.commissioning.plan import CommissionSettings, learned_streams
    from worldstate.commissioning.road_user_training import road_user_rows
    from worldstate.frontend.array.microphone_array import ovad_array
    from worldstate.ground.checks import in_range
    from worldstate_lab.streets.road_user_exam import road_user_exam, stream_exam

    check_outputs(arguments, "report")
    in_range("--passes", arguments.passes, 1, 100)
    plan = learned_streams(CommissionSettings(junctions=arguments.junctions))
    sites = list(dict.fromkeys(one.site.name for one in plan))
    rng = np.random.default_rng(arguments.seed)
    rate_hz = plan[0].sample_rate_hz
    # One microphone is heard: that of another array would hear the same, and no level is read.
    passes, jobs = arguments.passes, arguments.jobs
    with progress_bar("rendering", passes * len(sites)) as bar:
        rows = road_user_rows(
            ovad_array(), sites, rate_hz, rng, passes=passes, jobs=jobs, on_pass=bar.advance
        )
    streams = [HeardStream.load(path) for path in arguments.streams]
    found = stream_exam(rows, streams) if streams else road_user_exam(rows)
    report = {name: np.asarray(one).tolist() for name, one in asdict(found).items()}
    if arguments.report is not None:
        write_report(arguments.report, report)
    summary = {name: round(getattr(found, name), 3) for name in ("log_loss", "prior_log_loss", "worst_site")}
    named = zip(found.classes, found.shares, found.hops, found.recall, found.recall_of_equals, strict=True)
    lines = ["", f"{'class':12}{'share':>7}{'hops':>7}{'recall':>8}{'of equals':>11}  mean probabilities"]
    for number, (name, share, hops, recall, equals) in enumerate(named):
        shares = "".join(f"{one:7.2f}" for one in found.confusion[number])
        lines.append(f"{name:12}{share:7.3f}{hops:7.0f}{recall:8.2f}{equals:11.2f}  {shares}")
    return CommandResult(report, table=summary, lines=lines)
