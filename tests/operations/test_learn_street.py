"""`worldstate street learn`: boxes of a camera in, a street that `run` takes out."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from passing_boxes import CAMERA, EDGE_RAD, LANE_M, LENGTH_M, passing

from worldstate.adapters.camera.detections import DetectionFilter
from worldstate.cli.main import main
from worldstate.ground.errors import InputFileError, SchemaVersionError
from worldstate.ground.values import nanoseconds
from worldstate.operations.labelling.hidden_times import with_hidden_times
from worldstate.operations.labelling.street_file import read_street, write_street
from worldstate.operations.labelling.street_passes import looks_at, streets_after, watched_recording
from worldstate.operations.labelling.street_sound import HeardStreet
from worldstate.smoothing.learned_street import LearnedStreet
from worldstate.smoothing.street_context import context_of
from worldstate.state import Entity
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


def test_images_without_a_box_between_boxes_are_misses(recording):
    found, missed = looks_at(recording.tracks[0], recording.image_s)
    assert len(found) + len(missed) >= 10
    # One in ten is left out by the camera.
    assert 0 < len(missed) < 0.4 * len(found)


def test_times_in_view_are_those_of_the_boxes_and_times_in_hiding_of_nobody(recording, street):
    """A front crosses from the edge to the other end of the image, its tail a length later."""
    before_m = LANE_M * math.tan(EDGE_RAD)
    beyond_m = LANE_M * math.tan(CAMERA.half_angle_rad) + LENGTH_M
    arms = street[-1].arms
    assert sum(arm.departures.count for arm in arms) == 3.0
    mean_s = sum(arm.departures.exposure_s for arm in arms) / 3.0
    assert mean_s == pytest.approx((before_m + beyond_m) / SPEED, abs=0.4)
    assert all(arm.reveals.count == 0.0 for arm in arms)
    # Where the recording ends meanwhile, the last one's time is known, and not what ended it.
    cut = replace(recording, duration_s=float(recording.tracks[-1].time_s[-1]) + 0.1)
    *_, last = streets_after(LearnedStreet(), cut)
    assert sum(arm.departures.count for arm in last.arms) == 2.0


def test_who_was_heard_before_was_hidden_since_the_filter_believed_it(recording):
    first, second = sorted(recording.passes, key=lambda one: one.t0.time_s)[:2]
    times_s = np.arange(0.0, second.t0.time_s + 1.0, 0.1)
    onset_s = first.t0.time_s - 2.0
    passes = with_hidden_times(recording.passes, ((at_s, _hidden(at_s, onset_s)) for at_s in times_s))
    told = {one.t0.time_s: one.heard_s for one in passes}
    assert told[first.t0.time_s] == pytest.approx(onset_s)
    assert told[second.t0.time_s] is None
    *_, street = streets_after(LearnedStreet(), replace(recording, passes=passes))
    assert street.arms[0].reveals.count == 1.0
    assert street.arms[0].reveals.exposure_s == pytest.approx(2.0)


def _hidden(at_s: float, since_s: float) -> tuple[Entity, ...]:
    """Somebody hidden on the left for the two seconds after a time."""
    there = Entity(
        "id", "hidden", 0.9, 0.9, 0.8, azimuth_std_rad=0.3, created_ns=nanoseconds(since_s),
        updated_ns=nanoseconds(at_s), direction="left",
    )  # fmt: skip
    return (there,) if since_s <= at_s <= since_s + 2.0 else ()


def test_a_street_of_the_version_before_is_read_without_rates(street, tmp_path):
    write_street(tmp_path / "street.json", street[-1])
    told = json.loads((tmp_path / "street.json").read_text())
    told["schema"]["version"] = "1.0.0"
    for arm in told["arms"]:
        del arm["reveals"], arm["departures"]
    (tmp_path / "street.json").write_text(json.dumps(told))
    before = read_street(tmp_path / "street.json")
    assert before.arms[0].edge == street[-1].arms[0].edge
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


def test_a_street_with_other_bins_is_refused(street, tmp_path):
    write_street(tmp_path / "street.json", street[-1])
    told = json.loads((tmp_path / "street.json").read_text()) | {"looks": [1.0]}
    (tmp_path / "street.json").write_text(json.dumps(told))
    with pytest.raises(InputFileError, match="18 bins"):
        read_street(tmp_path / "street.json")


def test_the_command_learns_goes_on_and_run_takes_it(approach, tmp_path, capsys):
    out, figure = tmp_path / "street.json", tmp_path / "street.png"
    told = ["learn-street", str(approach.folder), "--out", str(out)]
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
    assert main(["run", str(approach.folder), "--street", str(out), "--out", str(states)]) == 0
    context = json.loads(states.read_text().splitlines()[-1])["context"]
    assert context["site"] == "here"
    capsys.readouterr()
    assert main([*told, "--states", str(states)]) == 0
    assert "departure ." in capsys.readouterr().out.replace("0.", ".")
    assert [arm.arrivals for arm in read_street(out).arms] == [arm.arrivals for arm in first.arms]


def test_snapshots_are_of_one_recording(approach, capsys):
    inputs = [str(approach.folder)] * 2
    assert main(["learn-street", *inputs, "--states", "a.jsonl", "--out", "b.json"]) == 2
    assert "--states" in capsys.readouterr().err


def test_a_place_is_said_once(approach, capsys):
    assert main(["run", str(approach.folder), "--street", "a.json", "--context", "b.json"]) == 2
    assert "--street" in capsys.readouterr().err
