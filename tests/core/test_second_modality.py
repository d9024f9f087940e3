"""Examples: V2X beacons use the same abduction and the same filter as sound; detections of Stone Soup."""

import ast
import runpy
from pathlib import Path
from types import SimpleNamespace

import pytest

from worldstate import nanoseconds

EXAMPLE = Path(__file__).resolve().parents[2] / "docs" / "examples" / "v2x_beacon.py"


@pytest.fixture(scope="module")
def v2x():
    return SimpleNamespace(**runpy.run_path(str(EXAMPLE)))


def test_a_beacon_is_hidden_then_visible_with_the_same_id(v2x):
    beacons = v2x.approach_from_left()
    states = list(v2x.run(beacons, v2x.ScriptedCamera(beacons, t0_s=4.0)))
    at = {state.stamp_ns: state for state in states}
    (hidden,) = at[nanoseconds(3.0)].entities
    (seen,) = at[nanoseconds(4.5)].entities
    assert (hidden.status, hidden.direction, seen.status) == ("hidden", "left", "visible")
    assert hidden.id == seen.id
    assert at[nanoseconds(3.0)].risk > 0.9
    # One vehicle in six is followed by another one.
    assert at[nanoseconds(4.5)].risk < 0.2 and at[nanoseconds(5.5)].risk < 0.05
    assert hidden.tta_s == pytest.approx(15.0**2 / 8.0 / 15.0 * (1 + 100 / 225), rel=0.3)
    advisory = [s.stamp_ns for s in states if any(cue.advisory for cue in s.cues)]
    assert advisory
    assert max(advisory) <= nanoseconds(4.3)


@pytest.mark.parametrize("example", ["v2x_beacon.py", "own_loop.py"])
def test_the_examples_import_from_public_packages(example):
    tree = ast.parse((EXAMPLE.parent / example).read_text(encoding="utf-8"))
    imported = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    public = {"worldstate", *(f"worldstate.{one}" for one in ("abduction", "adapters", "measurement"))}
    assert {module for module in imported if module.startswith("worldstate")} <= public


def test_the_beacon_example_runs_as_a_program(v2x, capsys):
    v2x.main()
    out = capsys.readouterr().out
    assert "hidden" in out
    assert "visible" in out


def test_the_example_of_stone_soup_prints_the_output_on_the_page(capsys):
    pytest.importorskip("stonesoup", reason="an example: pip install 'worldstate[oracles]'")
    runpy.run_path(str(EXAMPLE.with_name("stone_soup.py")), run_name="__main__")
    page = (EXAMPLE.parents[1] / "guide" / "from_stone_soup_and_odas.md").read_text(encoding="utf-8")
    assert f"```text\n{capsys.readouterr().out}```" in page
