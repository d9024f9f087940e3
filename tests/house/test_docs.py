"""The documentation follows the code: names have examples, commands and paths exist."""

import doctest
import importlib
import re
import sys
from functools import cache
from pathlib import Path

import pytest
from worldstate_lab.cli.main import PROGRAM as LABORATORY

import worldstate
from worldstate.cli.main import PROGRAM, current_words

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "docs" / "_ext"))
import figures  # noqa: E402
import model_cards  # noqa: E402
import reference  # noqa: E402

PAGES = [*sorted((ROOT / "docs").rglob("*.md")), *ROOT.glob("*.md")]
HOMES = reference.homes(reference.exports())
README = (ROOT / "README.md").read_text(encoding="utf-8")
# Addresses outside the project are those of the paper's references.
ADDRESSES = {"https://doi.org/10.1109/LRA.2021.3062254"}


def examples(value: object) -> list[doctest.Example]:
    return doctest.DocTestParser().get_examples(value.__doc__ or "")


@pytest.mark.parametrize("name", sorted(HOMES))
def test_every_exported_name_has_an_example_that_runs(name):
    value = getattr(importlib.import_module(HOMES[name]), name)
    if reference.kind(value) == "data":
        pytest.skip("the reference evaluates it")
    assert any(not example.options.get(doctest.SKIP) for example in examples(value))
    assert not re.search(r"\w -{4,}", value.__doc__), "a heading that a re-wrapped paragraph swallowed"


def test_the_number_of_exported_names_is_limited():
    assert len(worldstate.__all__) <= 25
    assert sum(map(len, reference.exports().values())) <= 250


@pytest.mark.parametrize("name", worldstate._FORMER)
def test_a_moved_name_gives_a_warning_with_its_package(name):
    told = rf"^worldstate\.{name} is worldstate\.\w+\.{name}$"
    with pytest.warns(DeprecationWarning, match=told) as caught:
        value = getattr(worldstate, name)
    assert caught[0].filename == __file__
    package = str(caught[0].message).split(" is ")[1].rpartition(".")[0]
    assert getattr(importlib.import_module(package), name) is value
    assert name in importlib.import_module(package).__all__


def test_a_vehicle_is_not_who():
    folders = ("abduction", "adapters", "frontend", "simulation", "worldstate", "lab/worldstate_lab", "docs")
    texts = [path for name in folders for path in (ROOT / name).rglob("*") if path.suffix in (".py", ".md")]
    words = re.compile(r"\b(who|whoever|whom|somebody|nobody|anybody)\b", re.IGNORECASE)
    # The remaining ones are about people: children who call, engineers who build.
    counted = [f"{path.name}: {word}" for path in texts for word in words.findall(path.read_text("utf-8"))]
    assert len(counted) <= 20, counted


# Words that have a special meaning in pages and messages.
OURS = """absence, advisory, arm, block, budget, chance, co-evidence, context, cue, domain, ego,
ensemble, entity, explanation, feature, frame, guard, hand-over, heard, hop, image, lead time, look,
looming, masked, miss rate, onset, pass, phantom, preset, prominence, reference, risk, scan, sequence,
sighting, signature, simulation, site, snapshot, stream, T0, time to visible, uncalibrated, unqueried,
window"""


def test_every_term_of_ours_is_in_the_glossary():
    page = (ROOT / "docs" / "reference" / "glossary.md").read_text(encoding="utf-8")
    entries = re.split(r", |\n", "\n".join(re.findall(r"^(.+)\n: ", page, flags=re.M)))
    assert set(re.split(r",\s", OURS)) - set(entries) == set()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_page_can_be_read_as_text(page):
    """Lines of prose have at most 140 characters, and links have a text; tables may be longer."""
    text = page.read_text(encoding="utf-8")
    lines = (line for line in text.splitlines() if not line.startswith(("|", "    ")))
    assert [line for line in lines if len(line) > 140] == []
    assert "[](" not in text


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_objects_that_a_page_links_are_exported(page):
    for target in re.findall(r"\{py:obj\}`([\w.]+)`", page.read_text(encoding="utf-8")):
        name, *member = target.split(".")
        assert name in HOMES, target
        value = getattr(importlib.import_module(HOMES[name]), name)
        assert all(hasattr(value, one) for one in member), target


PROGRAMS = {one.name: one for one in (PROGRAM, LABORATORY)}
CALL = r"(?:`|^    |^\$ |&& )(worldstate(?:-lab)?) ([a-z][^`\n&]*)"


@cache
def options_of(program: str, called: str) -> set[str]:
    return {*PROGRAMS[program].parser(called)._option_string_actions, "--results"}


# The changelog has the commands of former versions.
TODAY = [page for page in PAGES if page.stem != "CHANGELOG"]


@pytest.mark.parametrize("page", TODAY, ids=lambda page: page.name)
def test_commands_of_a_page_exist_with_their_options(page):
    for program, words in re.findall(CALL, page.read_text(encoding="utf-8"), flags=re.MULTILINE):
        said = current_words(words.split("#")[0].split()) if program == "worldstate" else words.split()
        called = PROGRAMS[program].called(said)
        assert called is not None, words
        options = {word.partition("=")[0] for word in said if word.startswith("--")}
        assert options <= options_of(program, called), words


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_that_a_page_names_exist(page):
    files = r"`((?:frontend|abduction|adapters|worldstate|docs|tests)/[\w/.-]+)`"
    named = re.findall(files, page.read_text(encoding="utf-8"))
    assert [name for name in named if not (ROOT / name).exists()] == []


def test_pages_are_those_that_make_figures_writes():
    assert [path.name for path, text in figures.pages().items() if path.read_text("utf-8") != text] == []
    assert [page.name for page in PAGES if re.search(r"<!--|\{\{", page.read_text("utf-8"))] == []


def test_figures_of_the_readme_are_taken_by_name():
    template = (figures.TEMPLATES / "README.md.in").read_text(encoding="utf-8")
    assert len(figures.FIGURE.findall(template)) >= 9


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
    assert [path for path in paths if "api/" not in path and not (page.parent / path).exists()] == []


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
    assert model_cards.PAGE.read_text("utf-8") == model_cards.page()


def test_version_is_the_same_everywhere():
    cited = re.search(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text("utf-8"), flags=re.MULTILINE)
    assert cited.group(1) == worldstate.__version__


def test_tables_of_commands_are_complete():
    page = (ROOT / "docs" / "reference" / "commands.md").read_text(encoding="utf-8")
    section = page.partition("\n## ")[0]
    benches = {words for words in LABORATORY.commands if words.startswith("bench")}
    for name, program in PROGRAMS.items():
        rows = re.findall(rf"^\| `{name} ([^`]+)`", section, flags=re.MULTILINE)
        shown = {program.called(words.split()) for words in rows}
        # One row describes all benches.
        assert shown - {"bench"} == {*program.commands} - {*program.hidden, *benches}
