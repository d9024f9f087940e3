"""`worldstate log upgrade`: a log of an earlier version as this one writes it.

Snapshots of schema 3.x become snapshots of schema 4.2.0: every cue states whether it may be acted on, as far
as the log holds why it may not. Commands, and `WorldState.from_json`, upgrade a log while they read it;
programs in other languages need the file. An MCAP file of `--export` becomes one with its images and sound; a
bag, whose other topics follow from its snapshots, becomes JSON lines.

Examples
--------
  worldstate log upgrade states.jsonl states_4.jsonl
  worldstate log upgrade out.mcap out_4.mcap
"""

import argparse
from pathlib import Path

from worldstate.cli.common import output, progress
from worldstate.ground import InputFileError


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("log", type=Path, metavar="IN", help="what an earlier `worldstate run` wrote")
    parser.add_argument("out", type=Path, metavar="OUT", help="the log to write: JSON lines, or MCAP of MCAP")


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return what it found."""
    from worldstate.adapters.export.log_messages import SNAPSHOT_TOPIC, mcap_file
    from worldstate.adapters.files.file_io import line_writer
    from worldstate.adapters.state_log import is_own_mcap, read_log, upgraded_messages

    output.check_outputs(arguments, "out")
    is_mcap, states = is_own_mcap(arguments.log), 0
    if is_mcap != (arguments.out.suffix.lower() == ".mcap"):
        raise InputFileError(arguments.out, "expected a name ending in .mcap exactly if IN is an MCAP file")
    with progress.progress_bar(f"reading {arguments.log.name}", None) as bar:
        if is_mcap:
            with mcap_file(arguments.out) as write_message:
                for message in upgraded_messages(arguments.log):
                    write_message(message)
                    states += message.topic == SNAPSHOT_TOPIC
                    bar.advance(message.topic == SNAPSHOT_TOPIC)
        else:
            with line_writer(arguments.out) as write:
                for line, _ in read_log(arguments.log):
                    write(line)
                    states += 1
                    bar.advance()
    return output.CommandResult({"states": states, "written": str(arguments.out)})
