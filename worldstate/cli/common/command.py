"""A program of commands: it imports only the module of the called command, and runs it."""

import argparse
import ast
import logging
import os
import signal
import sys
import textwrap
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, field
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import NoReturn

from worldstate.ground.checks import in_range
from worldstate.ground.errors import InputFileError, InvalidArgumentError, WorldstateError
from worldstate.ground.extras import check_extra
from worldstate.ground.version import __version__

from .output import CommandResult, print_result, printable, say

_WIDTH = 80  # of the overview, characters
# No system has longer paths, and Python reads no number with more than 4,300 digits.
_LONGEST_WORD = 4096
_HELP = "help", "-h", "--help"


@dataclass(frozen=True, slots=True)
class Program:
    """A program and its commands.

    The docstring of a command's module is "`PROGRAM [GROUP] NAME`: summary.", the description, and examples
    as the last paragraph. The module has `run`, and optionally `add_options`, and `NEEDS` with its optional
    modules.
    """

    name: str
    description: str
    epilog: str
    commands: Mapping[str, str]  # From the words of a command to its module
    groups: Mapping[str, str] = field(default_factory=dict)
    hidden: tuple[str, ...] = ()  # Left out of the overview
    # From removed options to their successors
    former_options: Mapping[str, str] = field(default_factory=dict)

    def called(self, words: Sequence[str]) -> str | None:
        """Return the words of the called command, None without one."""
        return next((name for n in (2, 1) if (name := " ".join(words[:n])) in self.commands), None)

    def members(self, group: str) -> list[str]:
        """Return the commands of a group that are not hidden; for "" those that belong to no group."""
        split = (words.rpartition(" ") for words in self.commands if words not in self.hidden)
        return [name for home, _, name in split if home == group]

    def parser(self, called: str) -> "CommandParser":
        """Return the parser of one command, the only one whose module is imported."""
        return CommandParser(f"{self.name} {called}", import_module(self.commands[called]))

    def overview(self, group: str | None = None) -> str:
        """Return the commands, or those of a group, in one line each."""
        if group is not None:
            return f"usage: {self.name} {group} COMMAND ...\n\n{self._listed(group)}"
        lists = [self._listed(home) for home in ("", *self.groups)]
        usage = f"usage: {self.name} COMMAND ..., {self.name} COMMAND --help, {self.name} --version"
        return "\n".join([usage, "", self.description, "", *lists, "", self.epilog])

    def _listed(self, group: str) -> str:
        lines = [f"{group}: {self.groups[group]}"] if group else ["commands:"]
        for name in self.members(group):
            words = f"{group} {name}".strip()
            summary, _, _ = _documentation(_docstring(self.commands[words]))
            lines += textwrap.wrap(f"  {words:<16} {summary}", _WIDTH, subsequent_indent=" " * 19)
        return "\n".join(lines)


class CommandParser(argparse.ArgumentParser):
    """Parser of one command, with --json."""

    def __init__(self, program: str, module: ModuleType) -> None:
        _, told, examples = _documentation(module.__doc__ or "")
        form = argparse.RawDescriptionHelpFormatter
        super().__init__(program, description=told, epilog=examples, formatter_class=form, allow_abbrev=False)
        self.add_argument("--json", action="store_true", help="print the result as one JSON object")
        self.set_defaults(run=module.run, needs=getattr(module, "NEEDS", ()))
        getattr(module, "add_options", lambda parser: None)(self)

    def error(self, message: str) -> NoReturn:
        """Refuse a call."""
        super().error(printable(message))


class _Printable(logging.Formatter):
    """Formats log records for a terminal."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        return printable(super().format(record))


class _New(logging.Filter):
    """Drops a repeated line, because a file that is read twice causes the same warnings twice."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether a line differs from the line before."""
        before, self._last = getattr(self, "_last", None), record.getMessage()
        return self._last != before


def _docstring(module: str) -> str:
    """Return the docstring of a module without an import, which can take more than a second."""
    found = find_spec(module)
    if found is None or found.origin is None:
        return ""
    return ast.get_docstring(ast.parse(Path(found.origin).read_text(encoding="utf-8"))) or ""


def _documentation(docstring: str) -> tuple[str, str, str]:
    """Return the summary of a command, its description, and its examples in the last paragraph."""
    head, _, rest = docstring.partition("\n\n")
    description, _, examples = f"\n\n{rest.strip()}".rpartition("\n\n")
    examples = examples.replace("Examples\n--------", "examples:")
    return head.partition("`: ")[2].removesuffix("."), description.strip(), examples


def add_choice(parser: argparse.ArgumentParser, option: str, help_text: str, *choices: str) -> None:
    """Declare an option with several choices; the first one is the default."""
    told = f"{help_text} (default: {choices[0]})".strip()
    parser.add_argument(option, choices=choices, default=choices[0], help=told)


def check_beside(arguments: argparse.Namespace, **other_of: str) -> None:
    """Refuse an option without the other option that it requires.

    Examples
    --------
    >>> check_beside(argparse.Namespace(sample_rate=None, array=None), sample_rate="array")
    """
    given = vars(arguments)
    for one, other in other_of.items():
        # 0 counts as a given value, for example as the number of a camera.
        if given[one] not in (None, []) and (given[other] is None or given[other] is False):
            option, beside = (f"--{name.replace('_', '-')}" for name in (one, other))
            raise InvalidArgumentError(f"{option}: expected {beside} with it")


def run_program(
    program: Program,
    words: Sequence[str],
    *,
    current: Callable[[Sequence[str]], Sequence[str]] = tuple,
    prepare: Callable[[CommandParser], None] = lambda parser: None,
) -> int:
    """Run one command; return its exit code: 0, or 2 and one line on standard error for bad input.

    `current` replaces former words of a call; `prepare` adds options to the parser of every command.
    """
    if logging.lastResort is not None:  # Prints warnings if the program has set up no logging
        logging.lastResort.setFormatter(_Printable())
        logging.lastResort.filters[:] = [_New()]
    try:
        # SIGTERM raises an exception, so that unfinished files are removed; exit code 143.
        with _handled((signal.SIGTERM,), _terminate):
            code = _execute(program, current(words), prepare)
            sys.stdout.flush()
            return code
    except WorldstateError as error:
        return _refused(str(error))
    except BrokenPipeError:
        _discard_unwritable_output()
        return 0
    except OSError as error:
        _discard_unwritable_output()
        return _refused(f"{error.filename or 'input or output'}: {error.strerror or error}")
    except MemoryError:
        return _refused("expected more memory than this machine has left")
    except KeyboardInterrupt:
        return 130


def _discard_unwritable_output() -> None:
    """Drop unwritten output; otherwise the interpreter writes it again at its exit and fails."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _execute(program: Program, words: Sequence[str], prepare: Callable[[CommandParser], None]) -> int:
    """Run the called command and print its result; return its exit code."""
    if any("\0" in word or len(word) > _LONGEST_WORD for word in words):
        raise InvalidArgumentError(f"words: expected at most {_LONGEST_WORD} characters each, no null byte")
    called = program.called(words)
    if called is None:
        return _without_command(program, [*words, ""])
    parser = program.parser(called)
    prepare(parser)
    given = words[len(called.split()) :]
    for option in (word.partition("=")[0] for word in given):
        if option in program.former_options and option not in parser._option_string_actions:
            raise InvalidArgumentError(f"{option}: expected {program.former_options[option]} in its place")
    arguments = parser.parse_args(given)
    # These options have one meaning in all commands.
    in_range("--seed", getattr(arguments, "seed", 0), 0, 2**63)
    in_range("--jobs", getattr(arguments, "jobs", 1), 1, 256)
    check_extra(*arguments.needs)
    _check_paths(arguments)
    result: CommandResult = arguments.run(arguments)
    print_result(result, as_json=arguments.json)
    return result.code


def _check_paths(arguments: argparse.Namespace) -> None:
    """Refuse a pipe or device in place of a file, because it may never begin or end."""
    given = (value if isinstance(value, list) else [value] for value in vars(arguments).values())
    for path in (one for values in given for one in values if isinstance(one, Path)):
        with suppress(OSError):  # The error is raised again when the file is opened
            if path.exists() and not (path.is_file() or path.is_dir()):
                raise InputFileError(path, "expected a file, found a device or pipe")


def _without_command(program: Program, words: Sequence[str]) -> int:
    """Print the version, the overview of the program or of a group; refuse an unknown command."""
    if words[0] == "--version":
        print(program.name, __version__)
        return 0
    asked = [word for word in words if word and word not in _HELP]
    group = asked.pop(0) if asked and asked[0] in program.groups else None
    if not asked:
        print(program.overview(group))
        return 0
    named = program.members(group) if group else [*program.members(""), *program.groups]
    raise InvalidArgumentError(f"{group or 'command'}: expected one of {', '.join(named)}, got {asked[0]}")


@contextmanager
def _handled(
    numbers: Sequence[int], handler: Callable[[int, object], None], *, once: bool = False
) -> Iterator[None]:
    """Handle signals by a function while the block runs; with `once` only the first signal."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in numbers}

    def restore() -> None:
        for number, former in before.items():
            signal.signal(number, former)

    def handle(number: int, frame: object) -> None:
        if once:
            restore()
        handler(number, frame)

    for number in numbers:
        signal.signal(number, handle)
    try:
        yield
    finally:
        restore()


def stopped_by_signals(stop: Callable[[], None]) -> AbstractContextManager[None]:
    """Call `stop` at the first SIGINT or SIGTERM; the second signal has its former effect."""
    return _handled((signal.SIGINT, signal.SIGTERM), lambda number, frame: stop(), once=True)


def _terminate(number: int, frame: object) -> None:
    raise SystemExit(128 + number)


def _refused(problem: str) -> int:
    """Print one line on standard error; return exit code 2."""
    say(" ".join(problem.split()))
    return 2
