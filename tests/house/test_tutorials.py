"""The tutorials and the notebook run, and their pages show their output and figures."""

import ast
import json
import re
import runpy
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "tutorials"
SCRIPTS = sorted(FOLDER.glob("[0-9]*.py"))
FIGURE = "# The figure"
SLOW = {"04_commission"}  # two minutes of one processor
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
@pytest.mark.parametrize(
    "script",
    [pytest.param(one, id=one.stem, marks=[pytest.mark.slow] * (one.stem in SLOW)) for one in SCRIPTS],
)
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
    captions = re.findall(r"\(figures/(\w+)\.svg\)\n\n\*Look at ", page)
    assert captions == [script.stem for script in SCRIPTS]
