"""`worldstate explain`: which evidence raised or holds an advisory.

Say of the snapshot nearest to a time what raised or holds the advisory of each side, or why there is none:
what prior, sequence or window, looks and a vehicle that has just come into view add to the log-odds that
the alarm goes by, then and when the advisory began; the entity; the sensors; whether the sound was foreign.
"""

import argparse
from pathlib import Path

from worldstate.cli.common.output import CommandResult

EXAMPLE = """\
examples:
  worldstate explain states.jsonl --time 5.2
  worldstate explain out/demo/states.jsonl --time 5.2 --side left --json"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("states", type=Path, metavar="JSONL", help="snapshots, as `worldstate run --out` writes them")
    add("--time", type=float, required=True, metavar="S", help="seconds on the states' clock")
    add("--side", help="of this side only, such as left (default: every side)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return what it found."""
    from worldstate.adapters.files.states_file import read_state_near
    from worldstate.ground.checks import in_range
    from worldstate.ground.errors import InvalidArgumentError
    from worldstate.ground.values import nanoseconds, seconds
    from worldstate.operations.recordings.evidence_report import common_lines, evidence_report

    stamp_ns = nanoseconds(in_range("--time", arguments.time, -9e9, 9e9))
    state = read_state_near(arguments.states, stamp_ns)
    sides = [cue.direction for cue in state.cues]
    if arguments.side not in (None, *sides):
        raise InvalidArgumentError(f"--side: expected one of {', '.join(sides)}, got {arguments.side}")
    begun = {cue.direction: cue.advisory.since_ns for cue in state.cues if cue.advisory is not None}
    onsets = {side: read_state_near(arguments.states, since_ns) for side, since_ns in begun.items()}
    reports = evidence_report(state, onsets, arguments.side)
    now_s = seconds(state.stamp_ns)
    told = state.to_dict()
    common = {key: told[key] for key in ("sensors", "searched", "events", "domain", "no_sequence")}
    lines = [line for report in reports.values() for line in report.lines(now_s)]
    return CommandResult(
        {"time_s": now_s, "sides": {side: one.to_dict() for side, one in reports.items()}} | common,
        table={"time": f"{now_s:.2f} s"},
        lines=[*lines, *common_lines(state)],
    )
