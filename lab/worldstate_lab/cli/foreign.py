"""`worldstate-lab foreign`: whether sounds that a model was not made for are told from streets.

Train a domain guard on streams that were listened to and on simulated sounds at their sites, and judge with
it what it never heard: every kind of sound by a guard that was trained without that kind, every family of
kinds by one without that family, every street by one without that site. The threshold is set on the other
sites: at most .025 of the hops of each of hidden, in view and empty are flagged there.

Speech, music, bells, tools, tones, birds, steps and rain are foreign; siren, horn, reversing beeper and bell
of a bicycle are warning signals, which come from vehicles. A hop counts where the sound is as loud as the
ambience or louder, from 250 to 2600 Hz over one second.
"""

import argparse
from pathlib import Path

from worldstate.cli.common.output import CommandResult, write_report
from worldstate.cli.common.outputs import output_folder
from worldstate.cli.common.progress import progress_bar

NAMES = ("foreign_sounds.json", "foreign_sounds.txt")
SITES = 3  # At least: one that is judged and two others that set its threshold

EXAMPLE = """\
examples:
  worldstate-lab foreign SA1-busy-1.npz SB1-busy-1.npz SB2-busy-1.npz --out foreign"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    heard = f"simulated streams that were listened to, of {SITES} sites or more"
    add("streams", type=Path, nargs="+", metavar="NPZ", help=heard)
    add("--sounds", type=int, default=2, metavar="N", help="of each kind at each site (default: %(default)s)")
    add("--seed", type=int, default=0, help="what sounds where (default: %(default)s)")
    add("--out", type=Path, metavar="DIR", help=f"write {', '.join(NAMES)}")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return what it found."""
    from dataclasses import asdict

    import numpy as np

    from worldstate.adapters.files.atomic import write_text
    from worldstate.commissioning.guard_training import guard_rows
    from worldstate.commissioning.heard_stream import HeardStream
    from worldstate.frontend.array.microphone_array import ovad_array
    from worldstate.ground.checks import in_range
    from worldstate.ground.errors import InvalidArgumentError
    from worldstate_lab.streets.guard_exam import GUARDS, guard_exam

    in_range("--sounds", arguments.sounds, 1, 100)
    if arguments.out is not None:
        output_folder(arguments.out, *NAMES)
    streams = [HeardStream.load(path) for path in arguments.streams]
    sites = sorted({str(stream.hops.about["site"]) for stream in streams})
    if len(sites) < SITES:
        raise InvalidArgumentError(f"NPZ: expected streams of {SITES} sites or more, got {', '.join(sites)}")
    # One microphone is heard: of which array it is the middle makes no difference that a level would not.
    rows = guard_rows(ovad_array(), streams, np.random.default_rng(arguments.seed), arguments.sounds)
    with progress_bar("training guards", GUARDS) as bar:
        found = guard_exam(rows, bar.advance)
    lines = [f"{'kind':14}{'guard without':16}{'hops':>7}{'foreign':>9}{'signal':>8}{'worst site':>12}"]
    lines += [
        f"{one.kind:14}{one.without:16}{one.hops:7d}{one.foreign:9.3f}{one.signal:8.3f}{one.worst_site:12.3f}"
        for one in found
    ]
    report = {"sites": sites, "seed": arguments.seed, "rows": [asdict(one) for one in found]}
    if arguments.out is not None:
        write_report(arguments.out / NAMES[0], report)
        write_text(arguments.out / NAMES[1], "\n".join(lines) + "\n")
    return CommandResult(report, table={}, lines=lines)
