"""`worldstate log upgrade`: convert a log of an earlier version.

Convert snapshots of schema 3.x to schema 4.2.0, in which every cue states whether it is usable, as far as the
log holds the reasons. Commands and `WorldState.from_json` convert a log as they read it; programs in other
languages need the file. An MCAP file of `--export` keeps its images and sound; a bag becomes JSON lines,
because its other topics follow from the snapshots.

Examples
--------
  worldstate log upgrade states.jsonl states_4.jsonl
  worldstate log upgrade out.mcap out_4.mcap
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from worldstate.cli.common import output, progress
from worldstate.ground import InputFileError


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("log", type=Path, metavar="IN", help="log of an earlier version")
    add("out", type=Path, metavar="OUT", help="log to write: JSON lines, or MCAP for an MCAP log")


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return its result."""
    from worldstate.adapters.export.log_messages import SNAPSHOT_TOPIC, mcap_file
    from worldstate.adapters.files.file_io import line_writer
    from worldstate.adapters.state_log import is_own_mcap, read_log, upgraded_messages

    output.check_outputs(arguments, "out")
    is_mcap, states = is_own_mcap(arguments.log), 0
    if is_mcap != (arguments.out.suffix.lower() == ".mcap"):
        raise InputFileError(arguments.out, "expected a name ending in .mcap exactly if IN is an MCAP file")
    records: Iterator[Any] = upgraded_messages(arguments.log) if is_mcap else read_log(arguments.log)
    with (mcap_file if is_mcap else line_writer)(arguments.out) as write:
        for record in progress.track(records, f"reading {arguments.log.name}"):
            write(record if is_mcap else record[0])
            states += not is_mcap or record.topic == SNAPSHOT_TOPIC
    return output.CommandResult({"states": states, "written": str(arguments.out)})
