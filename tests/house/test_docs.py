"""The documentation follows the code: every exported name has an example, every command and path exists."""

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
import reference  # noqa: E402

PAGES = [*sorted((ROOT / "docs").rglob("*.md")), *(ROOT / name for name in ("README.md", "CONTRIBUTING.md"))]
HOMES = reference.homes(reference.exports())


def examples(value: object) -> list[doctest.Example]:
    return doctest.DocTestParser().get_examples(value.__doc__ or "")


@pytest.mark.parametrize("name", sorted(HOMES))
def test_every_exported_name_has_an_example_that_runs(name):
    value = getattr(importlib.import_module(HOMES[name]), name)
    if reference.kind(value) == "data":
        pytest.skip("the reference evaluates it")
    assert any(not example.options.get(doctest.SKIP) for example in examples(value))
    assert not re.search(r"\w -{4,}", value.__doc__), "a heading that a re-wrapped paragraph swallowed"


def test_all_names_together_can_be_learned():
    assert len(worldstate.__all__) <= 25
    assert sum(map(len, reference.exports().values())) <= 250


@pytest.mark.parametrize("name", worldstate._FORMER)
def test_a_name_that_has_moved_warns_and_names_its_package(name):
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
    # What is left speaks of people: children who call, engineers who build.
    counted = [f"{path.name}: {word}" for path in texts for word in words.findall(path.read_text("utf-8"))]
    assert len(counted) <= 20, counted


# Words that pages and messages use in a sense of ours.
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
    """Prose within 140 characters, but tables and commands are as long as they are; links with a text."""
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


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
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
    texts = figures.pages()
    assert [path.name for path, text in texts.items() if path.read_text("utf-8") != text] == []
    assert [page.name for page in PAGES if re.search(r"<!--|\{\{", page.read_text("utf-8"))] == []


def test_figures_of_the_readme_are_taken_by_name():
    template = (figures.TEMPLATES / "README.md.in").read_text(encoding="utf-8")
    assert len(figures.FIGURE.findall(template)) >= 9
