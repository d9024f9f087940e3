"""`worldstate log view`: write a log as one page for a browser.

Write one HTML file that needs no other file and no network: the street from above, azimuths, the log-odds of
the alarm with its threshold, each term of the evidence, the searched views, and the images and sound of an
MCAP log. The arrow keys step through the snapshots, space plays, home and end go to the ends.

Examples
--------
  worldstate log view out/demo/states.jsonl
  worldstate log view out.mcap --out street.html
  worldstate log view hour.jsonl --between 1200 1500 --out minutes.html
"""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from worldstate import ground
from worldstate.cli.common import output, progress

if TYPE_CHECKING:
    from worldstate.state import WorldState


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("log", type=Path, metavar="LOG", help="log of `worldstate run`, by --out or --export mcap")
    add("--out", type=Path, metavar="HTML", help="page to write (default: LOG with the suffix .html)")
    told = "first and last time, seconds on the clock of the states"
    add("--between", type=float, nargs=2, metavar="S", help=told)


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return its result."""
    from worldstate.adapters.state_log import read_media
    from worldstate.operations.figure_style import PAGE, check_suffix
    from worldstate.operations.viewing.log_page import page_data, write_log_page

    arguments.out = check_suffix(arguments.out or arguments.log.with_suffix(".html"), *PAGE)
    output.check_outputs(arguments, "out")
    chosen = _between(arguments.log, arguments.between or (-9e9, 9e9))
    states = progress.track(chosen, f"reading {arguments.log.name}")
    page = page_data(states, title=arguments.log.name, media=read_media(arguments.log))
    write_log_page(arguments.out, page)
    report = {"states": len(page["states"]), "remarks": page["remarks"], "written": str(arguments.out)}
    return output.CommandResult(report)


def _between(log: Path, span_s: Sequence[float]) -> "Iterator[WorldState]":
    """Yield the snapshots within a span; refuse a span without any."""
    from worldstate.adapters.state_log import read_log

    first_ns, last_ns = map(ground.nanoseconds, span_s)
    stamps_ns, empty = list[int](), True
    for _, state in read_log(log):
        stamps_ns = [*stamps_ns[:1], state.stamp_ns]
        if first_ns <= state.stamp_ns <= last_ns:
            yield state
            empty = False
    if empty:
        its = " to ".join(f"{ground.seconds(stamp_ns):.1f}" for stamp_ns in stamps_ns)
        given = " to ".join(f"{at_s:g}" for at_s in span_s)
        said = f"--between: expected times of its snapshots, {its} s, got {given} s"
        raise ground.InputFileError(log, said)
