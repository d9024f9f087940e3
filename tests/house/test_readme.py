"""README.md: its program runs as printed, its size is limited, and its commands and links exist."""

import re
import sys
from pathlib import Path

import pytest
from worldstate_lab.cli.main import PROGRAM as LABORATORY

import worldstate
from worldstate.cli.main import PROGRAM

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
# Addresses outside the project are those of the paper's references.
ADDRESSES = {"https://doi.org/10.1109/LRA.2021.3062254"}


def block(language: str) -> str:
    return re.search(rf"```{language}\n(.*?)```", README, flags=re.DOTALL).group(1)


def test_first_program_prints_what_readme_shows(approach, tmp_path, monkeypatch, capsys):
    demo = tmp_path / "out" / "demo"
    demo.mkdir(parents=True)
    (demo / "recording").symlink_to(approach.folder.parents[2])
    monkeypatch.chdir(tmp_path)
    exec(compile(block("python"), "README.md", "exec"), {})
    assert capsys.readouterr().out == block("text")


def test_readme_is_short():
    results = re.search(r"\n## Results\n(.*?)\n## ", README, flags=re.DOTALL).group(1)
    assert len(README.splitlines()) <= 110
    assert len(block("python").splitlines()) <= 8
    assert len(re.findall(r"\d+(?:\.\d+)?", results)) <= 18
    assert len(re.findall(r"^\| .* \[.*, .*\] \| \[.*\]\(.*\) \|$", results, flags=re.MULTILINE)) == 6


def test_moving_picture_is_small():
    (picture,) = re.findall(r"!\[[^]]+\]\(([^)]+)\)", README)
    assert (ROOT / picture).stat().st_size < 2_000_000


def test_every_outside_address_is_on_the_list():
    files = [*PAGES, *(ROOT / "docs" / "templates").rglob("*.in")]
    code = re.compile(r"^```.*?^```|`[^`\n]*`", flags=re.DOTALL | re.MULTILINE)
    found = {
        (path.name, address)
        for path in (*files, ROOT / "pyproject.toml", ROOT / "CITATION.cff")
        for address in re.findall(r"https?://[^\s)\"'>\]]+", code.sub("", path.read_text("utf-8")))
    }
    assert [one for one in found if one[1] not in ADDRESSES] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_inside_the_project_leads_to_a_file(page):
    text = re.sub(r"^```.*?^```", "", page.read_text("utf-8"), flags=re.DOTALL | re.MULTILINE)
    links = re.findall(r"\]\(([^)\s]+)\)", text)
    paths = [link.partition("#")[0] for link in links if not re.match(r"https?:|#", link)]
    built = re.compile(r"api/")
    assert [path for path in paths if not built.search(path) and not (page.parent / path).exists()] == []


def test_every_picture_has_a_description_and_a_caption():
    missing = []
    for page in PAGES:
        lines = page.read_text("utf-8").splitlines()
        for at, line in enumerate(lines):
            if line.startswith("!["):
                caption = next((after for after in lines[at + 1 :] if after), "")
                if len(line.partition("](")[0]) <= 20 or not caption.startswith("*"):
                    missing.append(f"{page.name}: {line}")
    assert missing == []


def test_page_of_model_cards_matches_the_models():
    sys.path.append(str(ROOT / "docs" / "_ext"))
    import model_cards

    assert model_cards.PAGE.read_text("utf-8") == model_cards.page()


def test_version_is_the_same_everywhere():
    cited = re.search(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text("utf-8"), flags=re.MULTILINE)
    assert cited.group(1) == worldstate.__version__


def test_tables_of_commands_are_complete():
    page = (ROOT / "docs" / "reference" / "commands.md").read_text(encoding="utf-8")
    section = page.partition("\n## ")[0]
    for name, program in (("worldstate", PROGRAM), ("worldstate-lab", LABORATORY)):
        rows = re.findall(rf"^\| `{name} ([^`]+)`", section, flags=re.MULTILINE)
        shown = {program.called(words.split()) for words in rows}
        # One row describes all benches.
        assert shown - {"bench"} == {*program.commands} - {*program.hidden, *BENCHES}


BENCHES = {words for words in LABORATORY.commands if words.startswith("bench")}
