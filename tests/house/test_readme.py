"""The README's first program runs as printed, and its commands are the commands that there are."""

import re
from pathlib import Path

from worldstate_lab.cli.main import PROGRAM as LABORATORY

from worldstate.cli.main import PROGRAM

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def first_program() -> str:
    return re.search(r"```python\n(.*?)```", README, flags=re.DOTALL).group(1)


def test_the_first_program_warns_of_the_recording_that_the_demo_leaves(
    approach, tmp_path, monkeypatch, capsys
):
    demo = tmp_path / "out" / "demo"
    demo.mkdir(parents=True)
    (demo / "recording").symlink_to(approach.folder.parents[2])
    monkeypatch.chdir(tmp_path)
    exec(compile(first_program(), "README.md", "exec"), {})
    assert capsys.readouterr().out == re.search(r"```text\n(.*?)```", README, flags=re.DOTALL).group(1)


def test_the_tables_of_commands_are_complete():
    page = (ROOT / "docs" / "reference" / "commands.md").read_text(encoding="utf-8")
    section = page.partition("\n## ")[0]
    for name, program in (("worldstate", PROGRAM), ("worldstate-lab", LABORATORY)):
        rows = re.findall(rf"^\| `{name} ([^`]+)`", section, flags=re.MULTILINE)
        shown = {program.called(words.split()) for words in rows}
        # A bench stands for all of them.
        assert shown - {"bench"} == {*program.commands} - {*program.hidden, *BENCHES}


BENCHES = {words for words in LABORATORY.commands if words.startswith("bench")}
