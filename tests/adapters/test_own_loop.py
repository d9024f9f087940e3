"""The example of a user's loop with an own array, detector and signature model."""

import importlib.util
from pathlib import Path

import pytest

from worldstate.belief.street_model import StreetModel

EXAMPLE = Path(__file__).resolve().parents[2] / "docs" / "examples" / "own_loop.py"


@pytest.fixture(scope="module")
def own_loop():
    spec = importlib.util.spec_from_file_location("own_loop", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_example_hands_over_a_hidden_vehicle(own_loop):
    at = {state.stamp_ns / 1e9: state for state in own_loop.run()}
    assert at[1.4].entities == ()
    (hidden,), (seen,) = at[3.5].entities, at[4.5].entities
    assert (hidden.status, hidden.direction, seen.status) == ("hidden", "left", "visible")
    assert hidden.id == seen.id
    assert at[1.4].risk < 0.1 < 0.8 < at[3.5].risk
    # The remaining risk is the share of vehicles that are followed by another.
    assert at[4.5].risk == pytest.approx(StreetModel().follows, abs=0.05)
    assert [cue.advisory is not None for cue in at[3.5].cues] == [True, False]
    assert seen.azimuth_rad == pytest.approx(own_loop.azimuth_at(4.5), abs=0.03)


def test_the_example_prints_states(own_loop, capsys):
    own_loop.main()
    lines = capsys.readouterr().out.splitlines()
    assert "hidden at +" in lines[4]
    assert "visible at" in lines[-1]
