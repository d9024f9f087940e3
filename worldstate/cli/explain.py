"""`worldstate explain`: list the evidence that raised or holds an advisory.

Explain, for the snapshot nearest to a time, the advisory of each side or its absence: the terms of the
log-odds of the alarm (prior, sequence or window, looks of the camera, a vehicle that has just come into
view), now and when the advisory began; the entity; the sensors; whether the sound was foreign.

Without --time the command lists all advisories and explains the first one, or the highest risk if there is
none.

Examples
--------
  worldstate explain states.jsonl
  worldstate explain states.jsonl --time 5.2
  worldstate explain out/demo/states.jsonl --time 5.2 --side left --json
"""

import argparse
from dataclasses import asdict
from functools import partial
from pathlib import Path

from worldstate import ground
from worldstate.cli.common import output
from worldstate.ground.checks import one_of


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("states", type=Path, metavar="LOG", help="log of `worldstate run`, by --out or --export mcap")
    told = "seconds on the clock of the states (default: the first advisory)"
    add("--time", type=float, metavar="S", help=told)
    add("--side", help="one side only, such as left (default: every side)")


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return its result."""
    from worldstate.adapters.state_log import read_log, read_state_near
    from worldstate.operations.recordings import evidence_report

    listed, told = list[str](), {}
    if arguments.time is None:
        states = (state for _, state in read_log(arguments.states))
        found, stamp_ns = evidence_report.told_advisories(states, arguments.side)
        which = "at the first onset" if found else "none; at the highest risk"
        listed = ["advisories", *(f"  {one.line()}" for one in found), f"  {which}, another by --time", ""]
        told = {"advisories": [asdict(one) for one in found]}
    else:
        stamp_ns = ground.nanoseconds(ground.in_range("--time", arguments.time, -9e9, 9e9))
    state = read_state_near(arguments.states, stamp_ns)
    if arguments.side is not None:
        one_of("--side", arguments.side, [cue.direction for cue in state.cues if cue.direction])
    read = partial(read_state_near, arguments.states, anywhere=True)
    reports = evidence_report.evidence_report(state, read, arguments.side)
    now_s = state.time_s
    written = state.to_dict()
    common = {key: written[key] for key in ("sensors", "searched", "events", "domain", "no_sequence")}
    lines = [line for report in reports.values() for line in report.lines(now_s)]
    sides = {side: one.to_dict() for side, one in reports.items()}
    return output.CommandResult(
        told | {"time_s": now_s, "sides": sides} | common,
        table={},
        lines=[*listed, f"time  {now_s:.2f} s", *lines, *evidence_report.common_lines(state)],
    )
