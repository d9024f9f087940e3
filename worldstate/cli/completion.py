"""`worldstate completion`: a script that completes commands and options in the shell.

Print a script for bash that completes commands, options and the words that an option takes; everything else
completes as files do.
"""

import argparse
from collections.abc import Iterator

from worldstate.cli.common.output import CommandResult

EXAMPLE = """\
examples:
  source <(worldstate completion bash)
  worldstate completion bash > ~/.local/share/bash-completion/completions/worldstate"""

# Written once and not asked of the command at every key: to build the parser takes a third of a second.
_SCRIPT = """\
_worldstate() {{
    local current="${{COMP_WORDS[COMP_CWORD]}}" words=""
    if [ "$COMP_CWORD" -eq 1 ]; then
        words="{commands}"
    else
        case "${{COMP_WORDS[1]}} ${{COMP_WORDS[COMP_CWORD-1]}}" in
{choices}
        *) if [ "${{current:0:1}}" = "-" ]; then
            case "${{COMP_WORDS[1]}}" in
{options}
            esac
        fi ;;
        esac
    fi
    COMPREPLY=($(compgen -W "$words" -- "$current"))
}}
complete -o bashdefault -o default -F _worldstate worldstate"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("shell", choices=("bash",), metavar="SHELL", help="bash")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return the script."""
    from .main import build_parser

    script = bash_script(build_parser())
    return CommandResult({"shell": arguments.shell, "script": script}, table={}, lines=[script])


def bash_script(parser: argparse.ArgumentParser) -> str:
    """Return the script for the commands of a parser."""
    commands = _commands(parser)
    return _SCRIPT.format(
        commands=" ".join([*commands, "--help", "--version"]),
        choices="\n".join(line for name, one in commands.items() for line in _choices(name, one)),
        options="\n".join(
            f'            {name}) words="{_options(one)}" ;;' for name, one in commands.items()
        ),
    )


def _commands(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    # argparse has no public way to what it was told.
    (found,) = (one for one in parser._actions if isinstance(one, argparse._SubParsersAction))
    return dict(found.choices)


def _options(command: argparse.ArgumentParser) -> str:
    return " ".join(option for one in command._actions for option in one.option_strings)


def _choices(name: str, command: argparse.ArgumentParser) -> Iterator[str]:
    """Yield a case for every option of a command that takes one of several words, and for the first word."""
    for one in command._actions:
        if one.choices is None or not all(isinstance(word, str) for word in one.choices):
            continue
        words = " ".join(one.choices)
        for asked in one.option_strings or [name]:
            yield f'        "{name} {asked}") words="{words}" ;;'
