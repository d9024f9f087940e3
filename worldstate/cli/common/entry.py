"""Run a command from its words: parser, orderly termination, exit codes."""

import argparse
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module

from worldstate.ground.errors import WorldstateError
from worldstate.ground.extras import check_extra
from worldstate.ground.version import __version__

from .command import add_command
from .output import CommandResult, print_result


def build_parser(
    program: str,
    description: str,
    epilog: str,
    commands: Mapping[str, str],
    groups: Mapping[str, str] | None = None,
) -> argparse.ArgumentParser:
    """Return the parser of a program: `commands` maps the words of each to its module."""
    parser = argparse.ArgumentParser(
        prog=program,
        description=description,
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"{program} {__version__}")
    homes = {"": parser.add_subparsers(title="commands", metavar="COMMAND", required=True)}
    for words, module in commands.items():
        group = words.rpartition(" ")[0]
        if group not in homes:
            told = (groups or {})[group]
            members = homes[""].add_parser(group, help=told, description=f"{told[0].upper()}{told[1:]}.")
            homes[group] = members.add_subparsers(title="commands", metavar="COMMAND", required=True)
        add_command(homes[group], import_module(module))
    return parser


def run_command(parser: Callable[[], argparse.ArgumentParser], words: Sequence[str]) -> int:
    """Run one command; return its exit code: 0, or 2 and one line on standard error for bad input."""
    try:
        with _orderly_termination():
            code = _execute(parser(), words)
            sys.stdout.flush()
            return code
    except WorldstateError as error:
        return refused(str(error))
    except BrokenPipeError:
        # Else the interpreter writes what is left to the closed pipe once more, and complains.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        return refused(f"{error.filename or 'input or output'}: {error.strerror or error}")
    except MemoryError:
        return refused("expected more memory than this machine has left")
    except KeyboardInterrupt:
        return 130


def _execute(parser: argparse.ArgumentParser, words: Sequence[str]) -> int:
    """Run one command and print what it found; return its exit code."""
    arguments = parser.parse_args(words)
    check_extra(*arguments.needs)
    result: CommandResult = arguments.run(arguments)
    print_result(result, as_json=arguments.json)
    return result.code


@contextmanager
def _orderly_termination() -> Iterator[None]:
    """Turn SIGTERM into an exception, so that unfinished files are removed on the way out; exit code 143."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, _terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _terminate(number: int, frame: object) -> None:
    raise SystemExit(128 + number)


def refused(problem: str) -> int:
    """Print one line on standard error; return exit code 2."""
    line = " ".join(problem.split())
    print(f"worldstate: {line}", file=sys.stderr)
    return 2
