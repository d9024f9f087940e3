"""`worldstate completion`: a script that completes commands and options in the shell.

Print a script for bash, zsh or tcsh that completes commands, options, choices and files.

Examples
--------
  source <(worldstate completion bash)
  worldstate completion bash > ~/.local/share/bash-completion/completions/worldstate
"""

import argparse
from pathlib import Path

from worldstate.cli.common.command import Program
from worldstate.cli.common.output import CommandResult
from worldstate.ground.extras import optional

NEEDS = ("shtab",)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    shells = "bash", "zsh", "tcsh"
    parser.add_argument("shell", choices=shells, metavar="SHELL", help=", ".join(shells))


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return the script."""
    from .main import PROGRAM

    script = shell_script(PROGRAM, arguments.shell)
    return CommandResult({"shell": arguments.shell, "script": script}, table={}, lines=[script])


def shell_script(program: Program, shell: str) -> str:
    """Return the script for the commands of a program."""
    shtab = optional("shtab")
    whole = argparse.ArgumentParser(program.name)
    whole.add_argument("--version", action="store_true")
    groups = {"": whole.add_subparsers()}
    # shtab leaves out a command without a help text.
    for group, text in program.groups.items():
        groups[group] = groups[""].add_parser(group, help=text).add_subparsers()
    for words in program.commands:
        command, (group, _, name) = program.parser(words), words.rpartition(" ")
        for option in (one for one in command._actions if one.type is Path):
            option.complete = shtab.FILE  # type: ignore[attr-defined]
        groups[group].add_parser(name, parents=[command], add_help=False, help=name)
    script: str = shtab.complete(whole, shell)
    return script
