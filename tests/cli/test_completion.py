"""The script of `worldstate completion`, as a real bash runs it."""

import shutil
import subprocess

import pytest

from worldstate.cli.completion import bash_script
from worldstate.cli.main import PROGRAM, main

BASH = shutil.which("bash")
ASK = """
COMP_WORDS=({words}); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1))
_worldstate; printf '%s\\n' "${{COMPREPLY[@]}}"
"""


@pytest.fixture(scope="module")
def script():
    return bash_script(PROGRAM)


def complete(script: str, *words: str) -> list[str]:
    asked = script + ASK.format(words=" ".join(f"'{word}'" for word in words))
    answer = subprocess.run([BASH, "--norc", "-c", asked], capture_output=True, text=True, timeout=20)
    assert answer.stderr == ""
    return answer.stdout.split()


@pytest.mark.skipif(BASH is None, reason="there is no bash here")
@pytest.mark.parametrize(
    ("words", "found"),
    [
        (["worldstate", "l"], ["live", "log"]),
        (["worldstate", "array", "b"], ["bounds", "bearings"]),
        (["worldstate", "sim", "make", "--traffic", "b"], ["busy", "bicycle-only"]),
        (["worldstate", "array", "check", "some.wav", "--dur"], ["--duration", "--duration-error"]),
        (["worldstate", "run", "a.wav", "--uncal"], ["--uncalibrated"]),
        (["worldstate", "run", "--array-axes", "b"], ["base_link"]),
        (["worldstate", "completion", ""], ["bash"]),
        (["worldstate", "live", "--uncalibrated", "--save-s"], ["--save-state"]),
        # Left to the completion of files.
        (["worldstate", "run", "some"], []),
        (["worldstate", "run", "--array", "mi"], []),
    ],
)
def test_bash_completes(script, words, found):
    assert complete(script, *words) == found


@pytest.mark.skipif(BASH is None, reason="there is no bash here")
def test_every_command_is_completed(script):
    first = set(complete(script, "worldstate", ""))
    assert first == {name.split()[0] for name in PROGRAM.commands} | {"--help", "--version"}
    for group in PROGRAM.groups:
        assert complete(script, "worldstate", group, "") == PROGRAM.members(group)


def test_it_is_printed_alone_so_that_a_shell_can_read_it(script, capsys):
    assert main(["completion", "bash"]) == 0
    assert capsys.readouterr().out == script + "\n"
