"""The tutorials run, each ends in its figure, and their pages show the script that runs."""

import re
import runpy
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "tutorials"
SCRIPTS = sorted(FOLDER.glob("[0-9]*.py"))
LONGEST = 60
# What each prints where it says what it is for, small and in full.
SAYS = {
    "01_first_result": r"SA1, from the left.*advisory left.*\n.*no vehicle comes; advisory none",
    "02_own_array": r"line of 8 across: cannot tell cone",
    "03_own_detector": r"30 degrees: misses 0\.[1-9]",
    "04_commission": r"fit for use: False.*onsets_per_hour=20\.0",
    "05_several_road_users": r"handed_over[\s\S]*2 identities",
    "06_moving_ego": r"chances over time: {'0.5': 0\.",
    "07_another_modality": r"light: .* 0 with a time\nradio: (\d+) states, \1 with a time",
    "08_embed": r"as if in order: True; snapshots read back: True\n.*repeated=[1-9].*too_late=0",
    "09_planner": r"none: phantom [1-9].*\n.*none: chance 0\.0 s slowed",
}


def run(script, out, size, monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))
    monkeypatch.setattr(sys, "argv", [script.name, "--out", str(out), "--size", size])
    runpy.run_path(str(script), run_name="__main__")
    assert (out / f"{script.stem}.png").stat().st_size > 10_000


def test_there_are_nine():
    assert [script.stem for script in SCRIPTS] == list(SAYS)


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_a_tutorial_runs_small(script, tmp_path, monkeypatch, capsys):
    run(script, tmp_path, "small", monkeypatch)
    assert re.search(SAYS[script.stem], capsys.readouterr().out)


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_a_tutorial_runs_in_full(script, tmp_path, monkeypatch, capsys):
    run(script, tmp_path, "full", monkeypatch)
    assert re.search(SAYS[script.stem], capsys.readouterr().out)


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_its_page_shows_the_script_and_its_figure(script):
    page = script.with_suffix(".md").read_text(encoding="utf-8")
    assert len(script.read_text(encoding="utf-8").splitlines()) <= LONGEST
    assert f"```{{literalinclude}} {script.name}" in page
    assert f"(figures/{script.stem}.png)" in page
    assert 15_000 <= (FOLDER / "figures" / f"{script.stem}.png").stat().st_size <= 80_000
    assert f"python docs/tutorials/{script.name}" in page
