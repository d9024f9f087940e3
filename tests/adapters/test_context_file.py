"""Context files: edges by trigonometry, errors with the key, and the context in the snapshot."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from worldstate.abduction.sequence.sequence_model import COMING_S
from worldstate.adapters.files.context_file import read_context
from worldstate.belief.hidden_bearing import hidden_bearing
from worldstate.belief.site_geometry import SideGeometry
from worldstate.core.filter import WorldFilter
from worldstate.ground.errors import InputFileError, InvalidArgumentError
from worldstate.state.context import Context, Occluder, corner_at

LEFT = {"direction": "left", "corner_m": [5.0, 3.0], "crossing_m": 9.0, "speed_mps": 6.0}
RIGHT = {"direction": "right", "corner_m": [4.0, -2.5], "crossing_m": 12.0, "corner_std_m": 0.1}


def written(folder: Path, **keys: object) -> Path:
    path = folder / "context.json"
    path.write_text(json.dumps(keys))
    return path


def side_of(one: Occluder) -> SideGeometry:
    measures = one.edge_azimuth_rad, one.hidden_azimuth_rad, one.hidden_std_rad, one.edge_std_rad, one.pace_hz
    return SideGeometry(one.direction, *measures)


LENGTHS = st.floats(2.0, 9.0), st.floats(1.5, 8.0), st.floats(1.0, 15.0), st.floats(1.0, 15.0)


@given(*LENGTHS, st.integers(0, 8))
def test_the_hidden_azimuth_follows_the_plan(x_m, y_m, beyond_m, speed_mps, group) -> None:
    """Oracle: the position on the lane at a given time before the line of sight is crossed."""
    crossing_m = x_m + beyond_m
    coming = np.zeros(len(COMING_S))
    coming[group] = 1.0
    remaining_s = 0.5 * (COMING_S[group] + (0.0, *COMING_S)[group])
    seen_at_m = crossing_m * y_m / x_m
    azimuth_rad = math.atan2(seen_at_m + speed_mps * remaining_s, crossing_m)
    for sign, direction in ((1.0, "left"), (-1.0, "right")):
        corner = corner_at(direction, (x_m, sign * y_m), crossing_m, speed_mps=speed_mps)
        said_rad, std_rad = hidden_bearing(coming, side_of(corner))
        assert math.copysign(1.0, said_rad) == sign
        if azimuth_rad < math.radians(75.0):
            assert abs(said_rad) == pytest.approx(azimuth_rad, abs=0.02)
        assert std_rad >= corner.edge_std_rad


def test_a_context_file_replaces_defaults(tmp_path: Path) -> None:
    more_often = {**rates(), "arrival_hz": 0.01}
    context = read_context(written(tmp_path, arms=[RIGHT, LEFT], site="Elm Street", rates=more_often))
    assert context.directions == ("left", "right") and context.site == "Elm Street"
    assert context.rates.arrival_hz == 0.01 and context.view_half_angle_rad == Context().view_half_angle_rad
    assert [one.assumed for one in context.occluders] == [False, False]
    assert [one.assumed for one in read_context(written(tmp_path)).occluders] == [True, True]
    # The snapshot has it, and a checkpoint keeps it.
    world = WorldFilter(context)
    said = json.loads(world.state.to_json())["context"]
    assert [one["assumed"] for one in said["occluders"]] == [False, False]
    assert WorldFilter.from_dict(world.to_dict()).context == context


def test_an_arm_may_be_an_open_road(tmp_path: Path) -> None:
    context = read_context(written(tmp_path, arms=[{"direction": "right", "open": True}, LEFT]))
    assert [(one.direction, one.hides) for one in context.occluders] == [("left", True), ("right", False)]
    assert context.occluders[1].edge_azimuth_rad < 0.0 and not context.occluders[1].assumed


def rates() -> dict[str, float]:
    return {name: getattr(Context().rates, name) for name in Context().rates.__dataclass_fields__}


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"arm": [LEFT, RIGHT]}, "expected keys among"),
        ({"arms": [LEFT, {**RIGHT, "speed": 12.0}]}, r"context.arms\[1\]: expected keys among .*\['speed'\]"),
        ({"rates": {**rates(), "arrivals_hz": 0.01}}, r"context.rates: expected keys among .*'arrivals_hz'"),
        ({"arms": [{**LEFT, "direction": one} for one in "abcd"]}, "at most 3 approach sides, got 4"),
        ({"arms": [LEFT, LEFT]}, r"context\.arms: expected different directions, got \['left', 'left'\]"),
        ({"view_half_angle_deg": 200.0}, r"context\.view_half_angle_deg: .* number in \[0.0, 180.0\]"),
        ({"arms": [RIGHT, {**LEFT, "corner_m": [5.0, 0.0]}]}, r"context\.arms\[1\]: corner_m"),
        ({"arms": [{**LEFT, "corner_m": [9.5, 3.0]}, RIGHT]}, "nearer than 9"),
        ({"arms": [{**LEFT, "speed_mps": -1.0}, RIGHT]}, "speed_mps"),
        ({"arms": [{"direction": "left"}, RIGHT]}, r"arms\[0\]: expected corner_m and crossing_m, or"),
        ({"ego_speed_mps": "fast"}, "ego_speed_mps"),
    ],
)
def test_a_wrong_context_is_refused_with_its_key(tmp_path: Path, keys: dict[str, object], said: str) -> None:
    with pytest.raises((InputFileError, InvalidArgumentError), match=said):
        WorldFilter(read_context(written(tmp_path, **keys)))
