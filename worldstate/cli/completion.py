"""`worldstate completion`: a script that completes commands and options in the shell.

Print a script for bash that completes commands, options and the words that an option takes; everything else
completes as files do.
"""

import argparse
from collections.abc import Iterator

from worldstate.cli.common.command import Program
from worldstate.cli.common.output import CommandResult

EXAMPLE = """\
examples:
  source <(worldstate completion bash)
  worldstate completion bash > ~/.local/share/bash-completion/completions/worldstate"""

# Written once: to ask the command at every key would take a third of a second each time.
_SCRIPT = """\
_worldstate() {{
    local current="${{COMP_WORDS[COMP_CWORD]}}" called="${{COMP_WORDS[1]}}" words="" first=2
    case "$called" in
    {groups}) called="$called ${{COMP_WORDS[2]}}"; first=3 ;;
    esac
    if [ "$COMP_CWORD" -eq 1 ]; then
        words="{commands} --help --version"
    elif [ "$COMP_CWORD" -lt "$first" ]; then
        case "${{COMP_WORDS[1]}}" in
{members}
        esac
    else
        case "$called ${{COMP_WORDS[COMP_CWORD-1]}}" in
{choices}
        *) if [ "${{current:0:1}}" = "-" ]; then
            case "$called" in
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
    from .main import PROGRAM

    script = bash_script(PROGRAM)
    return CommandResult({"shell": arguments.shell, "script": script}, table={}, lines=[script])


def bash_script(program: Program) -> str:
    """Return the script for the commands of a program."""
    parsers = {name: program.parser(name) for name in program.commands}
    return _SCRIPT.format(
        groups="|".join(program.groups),
        commands=" ".join([*program.members(""), *program.groups, *program.hidden]),
        members=_cases({group: program.members(group) for group in program.groups}),
        choices="\n".join(line for name, one in parsers.items() for line in _choices(name, one)),
        options=_cases({name: _options(one) for name, one in parsers.items()}),
    )


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
