"""The guide, the tutorials and the notebook run, and their output is that of the page.

A `console` block contains commands after `$ ` and their output below them. A `python` block contains a
program, and the `text` block after it contains the output. `...` matches any text. A `code-block` with a
caption is the file of that name. Commands run from top to bottom in a folder with the output of `worldstate
demo`.
"""

import ast
import contextlib
import doctest
import io
import json
import logging
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from stand_ins import stand_in

from worldstate.cli.main import main

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted((ROOT / "docs" / "guide").glob("*.md"))
# The fixture has already run `worldstate demo`, which takes seven seconds of processor time.
PREPARED = ("worldstate demo ",)
# A quick `model make` takes two minutes of processor time, and later commands need its model.
SLOW = "model_for_an_array", "04_commission"
# Substitutes play the recording of the demo as sound card, camera and detector.
LIVE = ("live_in_python",)
FENCE = re.compile(
    r"^```(console|python|text|\{code-block\})(?: \w+\n:caption: (\S+)\n)?\n(.*?)^```$", re.M | re.S
)
COMMAND = re.compile(r"^\$ ((?:.*\\\n)*.*)\n((?:(?!\$ ).*\n)*)", re.M)


def steps(text: str) -> Iterator[tuple[str, str, str]]:
    """Yield the steps of a page: kind, text, and output (of a file its name)."""
    blocks = FENCE.findall(text)
    for (kind, name, body), (after, _, printed) in zip(blocks, [*blocks[1:], ("", "", "")], strict=True):
        if kind == "console":
            yield from (("console", *found) for found in COMMAND.findall(body))
        elif kind == "python":
            yield kind, body, printed if after == "text" else ""
        elif name:
            yield "file", body.removeprefix("\n"), name


@contextlib.contextmanager
def everything_printed() -> Iterator[io.StringIO]:
    """Capture output and logged warnings: a terminal shows both, but pytest hides the warnings."""
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(out):
        logged = logging.StreamHandler(out)
        logged.setLevel(logging.WARNING)
        logging.getLogger().addHandler(logged)
        try:
            yield out
        finally:
            logging.getLogger().removeHandler(logged)


def output_of(kind: str, text: str, printed: str) -> str:
    """Run one step in the current folder; return its output."""
    if kind == "file":
        Path(printed).write_text(text, encoding="utf-8")
        return printed
    words = [] if kind == "python" else shlex.split(text.replace("\\\n", ""), comments=True)
    if words and words[0] != "worldstate":
        words[:1] = [sys.executable] if words[0] == "python" else words[:1]
        return subprocess.run(words, check=True, capture_output=True, text=True).stdout
    with everything_printed() as out:
        if kind == "python":
            exec(compile(text, "program of the page", "exec"), {"__name__": "__main__"})
        # A page may show an error message.
        elif (code := main(words[1:])) and not printed.startswith("worldstate: "):
            raise AssertionError(f"{text} ended with {code}: {out.getvalue()}")
    return out.getvalue()


def without_margins(text: str) -> str:
    # Commands print their progress on a slow machine.
    text = re.sub(r"^worldstate: .* % after \d+ s(, some \d+ s left)?\n", "", text, flags=re.M)
    return "\n".join(line.rstrip() for line in text.strip("\n").splitlines()) + "\n"


def expect_as_printed(step: tuple[str, str, str]) -> None:
    got, printed = without_margins(output_of(*step)), without_margins(step[2])
    alike = printed == got or doctest.OutputChecker().check_output(printed, got, doctest.ELLIPSIS)
    assert alike, f"{step[1]}\nprinted\n{got}\nand the page shows\n{printed}"


@pytest.fixture(scope="session")
def desk(approach, tmp_path_factory) -> Path:
    """Return a folder with the demo's recording and the examples of this repository."""
    folder = tmp_path_factory.mktemp("guide")
    shutil.copytree(approach.folder.parents[2], folder / "out" / "demo" / "recording")
    shutil.copytree(ROOT / "docs" / "examples", folder / "docs" / "examples")
    return folder


def marked(page: Path) -> object:
    return pytest.param(page, id=page.stem, marks=[pytest.mark.slow] * (page.stem in SLOW))


@pytest.mark.long
@pytest.mark.parametrize("page", [marked(page) for page in PAGES if FENCE.search(page.read_text("utf-8"))])
def test_commands_of_a_page_print_its_output(page, desk, tmp_path, monkeypatch):
    shutil.copytree(desk, tmp_path / "desk", copy_function=os.link)
    monkeypatch.chdir(tmp_path / "desk")
    if page.stem in LIVE:
        stand_in(monkeypatch, next(Path("out/demo/recording").glob("S*/*/*")))
    for step in steps(page.read_text(encoding="utf-8")):
        if not step[1].startswith(PREPARED):
            expect_as_printed(step)


@pytest.mark.long
def test_the_demo_prints_the_output_of_the_first_page(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    expect_as_printed(next(steps((ROOT / "docs" / "guide" / "first_program.md").read_text(encoding="utf-8"))))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_is_short_and_has_one_table(page):
    lines = page.read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 120
    assert [line for line in lines if len(line) > 140 and not line.startswith("|")] == []
    assert sum(bool(re.match(r"\|[-| ]+\|$", line)) for line in lines) <= 1
    assert not [line for line in lines if line.startswith("    worldstate ")], "expected a console block"


def test_the_guide_is_short():
    assert sum(len(page.read_text(encoding="utf-8").splitlines()) for page in PAGES) <= 1_720


FOLDER = ROOT / "docs" / "tutorials"
SCRIPTS = sorted(FOLDER.glob("[0-9]*.py"))
FIGURE = "# The figure"
NUMBER = r"\d+(?:\.\d+)?"


def first_lines(script):
    """Return the lines of code before the figure, without docstrings."""
    text = script.read_text(encoding="utf-8").partition(FIGURE)[0]
    docstrings = [one for one in ast.walk(ast.parse(text)) if isinstance(one, ast.Expr)]
    skipped = {one.lineno for one in docstrings if isinstance(one.value, ast.Constant)}
    lines = enumerate(text.splitlines(), start=1)
    return [line for n, line in lines if n not in skipped and line.strip() and line.strip()[0] != "#"]


def test_the_index_lists_all_seven_tutorials():
    assert [script.stem[:2] for script in SCRIPTS] == [f"0{n}" for n in range(1, 8)]
    index = (FOLDER / "index.md").read_text(encoding="utf-8")
    assert [script.stem for script in SCRIPTS if f"({script.stem}.md)" not in index] == []


@pytest.mark.long
@pytest.mark.parametrize("script", [marked(one) for one in SCRIPTS])
def test_a_tutorial_prints_the_output_of_its_page(script, tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(FOLDER))
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(script), run_name="__main__")
    printed = capsys.readouterr().out
    (shown,) = re.findall(r"```text\n(.*?)```", script.with_suffix(".md").read_text(encoding="utf-8"), re.S)
    assert re.sub(NUMBER, "#", printed) == re.sub(NUMBER, "#", shown)
    # Other processors add in another order, so the last digit may differ.
    numbers = [list(map(float, re.findall(NUMBER, text))) for text in (printed, shown)]
    assert numbers[0] == pytest.approx(numbers[1], rel=0.05, abs=0.05)
    assert (tmp_path / "out" / "tutorials" / f"{script.stem}.svg").stat().st_size > 10_000


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_a_page_begins_with_few_lines_and_ends_with_its_figure(script):
    page = script.with_suffix(".md").read_text(encoding="utf-8")
    first = first_lines(script)
    assert len(first) <= 12
    assert any("print(" in line for line in first)
    shown = f'```{{literalinclude}} {script.name}\n:language: python\n:%s: "{FIGURE}"'
    begin, rest = shown % "end-before", shown % "start-at"
    assert page.index(begin) < page.index(f"(figures/{script.stem}.svg)") < page.index(rest)
    assert 10_000 <= (FOLDER / "figures" / f"{script.stem}.svg").stat().st_size <= 80_000


def printed_by(notebook) -> list[str]:
    """Return the printed text of each cell."""
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    return ["".join("".join(part.get("text", "")) for part in cell["outputs"]) for cell in cells]


@pytest.mark.long
def test_the_notebook_prints_its_stored_output():
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    path = FOLDER / "first_sound.ipynb"
    shown = printed_by(json.loads(path.read_text(encoding="utf-8")))
    notebook = nbformat.read(path, as_version=4)
    nbclient.NotebookClient(notebook, timeout=300, kernel_name="python3").execute()
    assert printed_by(notebook) == shown != [""] * len(shown)


def test_the_gallery_has_every_figure_with_a_caption():
    page = (FOLDER / "gallery.md").read_text(encoding="utf-8")
    assert re.findall(r"\(figures/(\w+)\.svg\)\n\n\*Look at ", page) == [script.stem for script in SCRIPTS]
