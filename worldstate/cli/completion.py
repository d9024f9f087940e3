"""`worldstate completion`: a script that completes commands and options in the shell.

Print a script for bash that completes commands, options and the words that an option takes; everything else
completes as files do.

Examples
--------
  source <(worldstate completion bash)
  worldstate completion bash > ~/.local/share/bash-completion/completions/worldstate
"""

import argparse
from collections.abc import Iterator
from importlib.resources import files

from worldstate.cli.common.command import Program
from worldstate.cli.common.output import CommandResult


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("shell", choices=("bash",), metavar="SHELL", help="bash")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return the script."""
    from .main import PROGRAM

    script = bash_script(PROGRAM)
    return CommandResult({"shell": arguments.shell, "script": script}, table={}, lines=[script])


def bash_script(program: Program) -> str:
    """Return the script for the commands of a program."""
    parsers = {name: program.parser(name) for name in program.commands}
    words = {
        "groups": "|".join(program.groups),
        "commands": " ".join([*program.members(""), *program.groups, *program.hidden]),
        "members": _cases({group: program.members(group) for group in program.groups}),
        "choices": "\n".join(line for name, one in parsers.items() for line in _choices(name, one)),
        "options": _cases({name: _options(one) for name, one in parsers.items()}),
    }
    # Written once: to ask the command at every key would take a third of a second each time.
    script = (files("worldstate") / "data" / "completion.bash").read_text("utf-8").rstrip("\n")
    for place, filled in words.items():
        script = script.replace(f"@{place}@", filled)
    return script


def _cases(words: dict[str, list[str]]) -> str:
    return "\n".join(f'        "{name}") words="{" ".join(some)}" ;;' for name, some in words.items())


def _options(command: argparse.ArgumentParser) -> list[str]:
    # argparse has no public way to the options that it was given.
    return [option for one in command._actions for option in one.option_strings]


def _choices(name: str, command: argparse.ArgumentParser) -> Iterator[str]:
    """Yield a case for every option of a command that takes one of several words, and for the first word."""
    for one in command._actions:
        if one.choices is None or not all(isinstance(word, str) for word in one.choices):
            continue
        words = " ".join(one.choices)
        for before in one.option_strings or [name.split()[-1]]:
            yield f'        "{name} {before}") words="{words}" ;;'
