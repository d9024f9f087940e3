"""`worldstate street learn`: from boxes of a camera to a street file for `worldstate run`."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from passing_boxes import CAMERA, EDGE_RAD, LANE_M, passing

from worldstate.adapters.camera.detections import DetectionFilter
from worldstate.cli.main import main
from worldstate.ground.errors import InputFileError, SchemaVersionError
from worldstate.operations.labelling.street_passes import (
    HeardStreet,
    read_street,
    streets_after,
    watched_recording,
    write_street,
)
from worldstate.smoothing.learned_street import LearnedStreet, context_of
from worldstate.state.context import Rates

SPEED = 6.0


@pytest.fixture(scope="module")
def recording():
    starts = [(1.0, 1), (9.0, -1), (17.0, 1)]
    log = passing(starts, SPEED, np.random.default_rng(0))
    return watched_recording(log, CAMERA, DetectionFilter(), 30.0)


@pytest.fixture(scope="module")
def street(recording):
    return list(streets_after(LearnedStreet("Elm Street"), recording))


def test_every_pass_is_counted_and_all_time_is_exposure(street):
    assert [sum(arm.arrivals for arm in one.arms) for one in street] == [1.0, 2.0, 3.0, 3.0]
    assert [arm.exposure_s for arm in street[-1].arms] == pytest.approx([30.0, 30.0])


def test_edges_and_paces_of_the_street_are_learned(street):
    left, right = street[-1].arms
    assert abs(left.edge.mean_rad - EDGE_RAD) < math.radians(1.5)
    assert abs(right.edge.mean_rad - EDGE_RAD) < math.radians(1.5)
    seen = math.exp(left.log_pace.total / left.log_pace.weight)
    assert seen == pytest.approx(SPEED / LANE_M, rel=0.15)


def test_sound_of_two_arms_at_once_is_not_assigned(recording):
    first, *_ = recording.passes
    times = np.arange(0.1, 30.0, 0.1)
    heard = HeardStreet(times, np.zeros((len(times), 12)), np.ones(len(times)), "roof")
    assert len(heard.before(first, recording.passes).weights) == 30
    beside = replace(first, arm="right", t0=replace(first.t0, time_s=first.t0.time_s + 2.0))
    assert heard.before(first, [first, beside]) is None
    assert heard.before(replace(first, t0=replace(first.t0, time_s=99.0)), [first]) is None


@pytest.fixture
def told(street, tmp_path):
    """Return the content of a street file."""
    write_street(tmp_path / "street.json", street[-1])
    return json.loads((tmp_path / "street.json").read_text())


def read_again(told, folder, version="1.3.0"):
    told["schema"]["version"] = version
    (folder / "street.json").write_text(json.dumps(told))
    return read_street(folder / "street.json")


@pytest.mark.parametrize("version", ["1.1.0", "1.2.0"])
def test_rates_and_camera_misses_of_an_older_street_file_are_ignored(street, told, tmp_path, version):
    for arm in told["arms"]:
        arm["reveals"] = arm["departures"] = {"count": 3.0, "exposure_s": 7.0}
    before = read_again(told | {"looks": [3.0] * 18, "missed": [1.0] * 18}, tmp_path, version)
    assert before == street[-1]
    assert context_of(before).rates == Rates()
    with pytest.raises(SchemaVersionError, match=r"2\.0\.0"):
        read_again(told, tmp_path, "2.0.0")


def test_a_street_file_with_wrong_arms_raises_an_error(told, tmp_path):
    told["arms"].reverse()
    with pytest.raises(InputFileError, match="expected the arms"):
        read_again(told, tmp_path)


@pytest.mark.long
def test_the_learn_command_continues_a_street_and_run_uses_it(approach, tmp_path, capsys):
    out, figure = tmp_path / "street.json", tmp_path / "street.png"
    told = ["street", "learn", str(approach.folder), "--out", str(out)]
    assert main([*told, "--site", "here", "--figure", str(figure), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["n_passes"] == sum(arm["arrivals"] for arm in found["arms"].values())
    assert figure.stat().st_size > 0
    first = read_street(out)
    # Sound was read with the shipped model; one pass is too few to learn the sides.
    assert sum(first.patterns.weights) > 0.0
    assert found["sides_heard"] is False
    assert main([*told, "--known", str(out), "--days", "1"]) == 0
    again = read_street(out)
    assert again.site == "here"
    # The weight decays with a time constant of 30 days.
    assert again.arms[0].exposure_s == pytest.approx(first.arms[0].exposure_s * (1.0 + math.exp(-1 / 30)))
    states = tmp_path / "states.jsonl"
    assert main(["run", str(approach.folder), "--context", str(out), "--out", str(states)]) == 0
    context = json.loads(states.read_text().splitlines()[-1])["context"]
    assert context["site"] == "here"
