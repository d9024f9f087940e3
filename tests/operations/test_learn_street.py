"""`worldstate street learn`: boxes of a camera in, a street that `run` takes out."""

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


def test_every_pass_is_a_lesson_and_all_time_is_exposure(street):
    assert [sum(arm.arrivals for arm in one.arms) for one in street] == [1.0, 2.0, 3.0, 3.0]
    assert [arm.exposure_s for arm in street[-1].arms] == pytest.approx([30.0, 30.0])


def test_edges_and_paces_are_those_of_the_street(street):
    left, right = street[-1].arms
    assert abs(left.edge.mean_rad - EDGE_RAD) < math.radians(1.5)
    assert abs(right.edge.mean_rad - EDGE_RAD) < math.radians(1.5)
    seen = math.exp(left.log_pace.total / left.log_pace.weight)
    assert seen == pytest.approx(SPEED / LANE_M, rel=0.15)


def test_sound_belongs_to_a_pass_unless_the_other_arm_is_heard_too(recording):
    first, *_ = recording.passes
    times = np.arange(0.1, 30.0, 0.1)
    heard = HeardStreet(times, np.zeros((len(times), 12)), np.ones(len(times)), "roof")
    assert len(heard.before(first, recording.passes).weights) == 30
    beside = replace(first, arm="right", t0=replace(first.t0, time_s=first.t0.time_s + 2.0))
    assert heard.before(first, [first, beside]) is None
    assert heard.before(replace(first, t0=replace(first.t0, time_s=99.0)), [first]) is None


def test_a_street_with_rates_of_the_version_before_is_read_with_a_note(street, tmp_path):
    write_street(tmp_path / "street.json", street[-1])
    told = json.loads((tmp_path / "street.json").read_text())
    told["schema"]["version"] = "1.1.0"
    for arm in told["arms"]:
        arm["reveals"] = arm["departures"] = {"count": 3.0, "exposure_s": 7.0}
    (tmp_path / "street.json").write_text(json.dumps(told))
    with pytest.warns(UserWarning, match="reveal and departure"):
        before = read_street(tmp_path / "street.json")
    assert before == street[-1]
    assert context_of(before).rates == Rates()
    told["schema"]["version"] = "2.0.0"
    (tmp_path / "street.json").write_text(json.dumps(told))
    with pytest.raises(SchemaVersionError, match=r"2\.0\.0"):
        read_street(tmp_path / "street.json")


def test_a_street_reads_back_as_it_was_written(street, tmp_path):
    write_street(tmp_path / "street.json", street[-1])
    assert read_street(tmp_path / "street.json") == street[-1]


@pytest.mark.parametrize(
    "text", ["{}", '{"schema": {"name": "worldstate.WorldState", "version": "1.0.0"}}', "["]
)
def test_what_is_no_street_is_refused_by_name(text, tmp_path):
    (tmp_path / "street.json").write_text(text)
    with pytest.raises(InputFileError, match=r"street\.json"):
        read_street(tmp_path / "street.json")


def test_a_street_of_other_arms_is_refused(street, tmp_path):
    write_street(tmp_path / "street.json", street[-1])
    told = json.loads((tmp_path / "street.json").read_text())
    told["arms"].reverse()
    (tmp_path / "street.json").write_text(json.dumps(told))
    with pytest.raises(InputFileError, match="expected the arms"):
        read_street(tmp_path / "street.json")


def test_a_street_with_misses_of_the_camera_is_read_without_them(street, tmp_path):
    write_street(tmp_path / "street.json", street[-1])
    told = json.loads((tmp_path / "street.json").read_text())
    told["schema"]["version"] = "1.2.0"
    told |= {"looks": [3.0] * 18, "missed": [1.0] * 18}
    (tmp_path / "street.json").write_text(json.dumps(told))
    assert read_street(tmp_path / "street.json") == street[-1]


@pytest.mark.long
def test_the_command_learns_goes_on_and_run_takes_it(approach, tmp_path, capsys):
    out, figure = tmp_path / "street.json", tmp_path / "street.png"
    told = ["street", "learn", str(approach.folder), "--out", str(out)]
    assert main([*told, "--site", "here", "--figure", str(figure), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["n_passes"] == sum(arm["arrivals"] for arm in found["arms"].values())
    assert figure.stat().st_size > 0
    first = read_street(out)
    # It listened, with the model that ships; a single pass tells no side.
    assert sum(first.patterns.weights) > 0.0
    assert found["sides_heard"] is False
    assert main([*told, "--known", str(out), "--days", "1"]) == 0
    again = read_street(out)
    assert again.site == "here"
    # A day takes a thirtieth of the weight.
    assert again.arms[0].exposure_s == pytest.approx(first.arms[0].exposure_s * (1.0 + math.exp(-1 / 30)))
    states = tmp_path / "states.jsonl"
    assert main(["run", str(approach.folder), "--context", str(out), "--out", str(states)]) == 0
    context = json.loads(states.read_text().splitlines()[-1])["context"]
    assert context["site"] == "here"


def test_boxes_are_of_one_recording(approach, capsys):
    inputs = [str(approach.folder)] * 2
    assert main(["street", "learn", *inputs, "--detections", "a.json", "--out", "b.json"]) == 2
    assert "--detections" in capsys.readouterr().err
