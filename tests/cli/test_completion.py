"""The script of `worldstate completion`, as a real bash runs it."""

import shutil
import subprocess

import pytest

from worldstate.cli.completion import shell_script
from worldstate.cli.main import PROGRAM, main

pytest.importorskip("shtab")
BASH = shutil.which("bash")
ASK = """
COMP_WORDS=({words}); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1))
_shtab_worldstate; printf '%s\\n' "${{COMPREPLY[@]}}"
"""


@pytest.fixture(scope="module")
def script():
    return shell_script(PROGRAM, "bash")


@pytest.mark.skipif(BASH is None, reason="there is no bash here")
@pytest.mark.parametrize(
    ("words", "found"),
    [
        (["worldstate", "l"], ["live", "log"]),
        (["worldstate", "array", "b"], ["bounds", "bearings"]),
        (["worldstate", "sim", "make", "--traffic", "b"], ["busy", "bicycle-only"]),
        (["worldstate", "run", "a.wav", "--uncal"], ["--uncalibrated"]),
        (["worldstate", "completion", ""], ["bash", "zsh", "tcsh"]),
        (["worldstate", "live", "--uncalibrated", "--save-s"], ["--save-state"]),
        (["worldstate", "run", "--array", "pyproj"], ["pyproject.toml"]),
    ],
)
def test_bash_completes(script, words, found, request):
    asked = script + ASK.format(words=" ".join(f"'{word}'" for word in words))
    command, root = [BASH, "--norc", "-c", asked], request.config.rootpath
    answer = subprocess.run(command, capture_output=True, text=True, timeout=20, cwd=root, check=False)
    assert sorted(answer.stdout.split()) == sorted(found)


def test_it_is_printed_alone_so_that_a_shell_can_read_it(script, capsys):
    assert main(["completion", "bash"]) == 0
    assert capsys.readouterr().out == script + "\n"
