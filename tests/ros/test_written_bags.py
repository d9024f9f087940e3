"""Written bags of ROS 2: states and recordings, read by other programs."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
from bag_messages import read_bag
from scipy.spatial.transform import Rotation
from scripted_states import scripted_states, write_states

from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.export.other_stacks import autoware_objects
from worldstate.adapters.export.scene import scene_update
from worldstate.adapters.ros.bag_writer import state_bag
from worldstate.cli.main import main

START_NS = 1_700_000_000 * 10**9
STATES = [replace(state, stamp_ns=state.stamp_ns + START_NS) for state in scripted_states()]


@pytest.fixture(scope="module", params=["mcap", "sqlite3"])
def written(request, tmp_path_factory):
    """Write states as a bag in each storage."""
    path = tmp_path_factory.mktemp("bag") / "states"
    with state_bag(path, 7.0, request.param) as write:
        for state in STATES:
            write(state)
    return path


@pytest.fixture(scope="module")
def bag_of_approach(approach, tmp_path_factory):
    path = tmp_path_factory.mktemp("approach") / "street"
    assert main(["sim", "to-bag", str(approach.folder), str(path), "--start", "1700000000"]) == 0
    return path


def storage_of(path: Path) -> Path:
    (storage,) = (file for file in path.iterdir() if file.suffix != ".yaml")
    return storage


def read_by_others(path: Path, ending: str = "") -> list[tuple[str, int, object]]:
    """Return topic, time and message of a bag by Foxglove's MCAP reader or the SQLite reader of rosbags."""
    if (storage := storage_of(path)).suffix == ".mcap":
        from mcap.reader import make_reader
        from mcap_ros2.decoder import DecoderFactory

        with storage.open("rb") as file:
            found = make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
            every = [(channel.topic, said.log_time, message) for _, channel, said, message in found]
    else:
        from rosbags.highlevel import AnyReader

        with AnyReader([path]) as bag:
            every = [(c.topic, time, bag.deserialize(data, c.msgtype)) for c, time, data in bag.messages()]
    return [one for one in every if one[0].endswith(ending)]


def test_other_readers_find_the_values_of_the_states(written):
    for topic in ("/worldstate/advisories", "/perception/object_recognition/objects", "/worldstate/markers"):
        assert [time for _, time, _ in read_by_others(written, topic)] == [one.stamp_ns for one in STATES]
    advisories = [message for _, _, message in read_by_others(written, "advisories")]
    for message, state in zip(advisories, STATES, strict=True):
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == state.stamp_ns
        assert message.header.frame_id == "base_link"
        for told, cue in zip(message.advisories, state.cues, strict=True):
            assert (told.direction, told.risk, told.azimuth) == (cue.direction, cue.risk, cue.azimuth_rad)
            assert (told.raised, told.usable) == (cue.advisory is not None, cue.usable)
            assert list(told.why_not) == list(cue.why_not)
            within = {float(after): share for after, share in (cue.within or {}).items()}
            assert dict(zip(told.horizon, told.within, strict=True)) == within
            assert list(told.alpha) == ([] if cue.alpha is None else [cue.alpha]), "unknown is empty, not 0"
    assert any(one.raised for message in advisories for one in message.advisories)


def test_objects_in_the_bag_are_those_of_autoware(written):
    for (_, _, message), state in zip(read_by_others(written, "objects"), STATES, strict=True):
        for one, said in zip(message.objects, autoware_objects(state, 7.0)["objects"], strict=True):
            assert bytes(one.object_id.uuid) == bytes(said["object_id"]["uuid"])
            assert one.existence_probability == pytest.approx(said["existence_probability"], rel=1e-6)
            at = said["kinematics"]["initial_pose_with_covariance"]
            pose = one.kinematics.initial_pose_with_covariance
            assert pose.pose.position.y == at["pose"]["position"]["y"]
            assert list(pose.covariance) == at["covariance"]
            assert len(one.kinematics.predicted_paths[0].path) == 7


def test_markers_replace_those_of_the_last_scene(written):
    for _, _, message in read_by_others(written, "markers"):
        first, *drawn = message.markers
        assert first.action == 3, "all earlier markers are deleted"
        assert len({(one.ns, one.id) for one in drawn}) == len(drawn), "RViz would draw one of two"
        assert all(max(one.scale.x, one.scale.y, one.scale.z) > 0.0 and one.color.a > 0.0 for one in drawn)
    scene = scene_update(STATES[-1]).entities
    assert {one.ns for one in drawn} == {item.id for item in scene}
    corners = sum(len(one.points) for one in drawn if one.type == 11)
    assert corners == sum(len(area.points) for item in scene for area in item.triangles)


def test_replay_of_folder_and_file_gives_the_written_states(written, bag_of_approach, tmp_path, refused):
    for log in (written, storage_of(written)):
        assert main(["log", "replay", str(log), "--out", str(tmp_path / "states.jsonl")]) == 0
        assert (tmp_path / "states.jsonl").read_text().splitlines() == [state.to_json() for state in STATES]
    assert "expected snapshots, got none" in refused(["log", "replay", str(bag_of_approach)])


def test_the_bag_of_a_recording_has_the_frames_of_array_and_camera(bag_of_approach):
    """The chain of frames ends at `base_link`; rotations of SciPy are the oracle."""
    ((_, stamp_ns, told),) = read_by_others(bag_of_approach, "/tf_static")
    read = read_by_others(bag_of_approach)
    assert stamp_ns == min(time for _, time, _ in read), "before all messages in these frames"
    found = {one.child_frame_id: one for one in told.transforms}
    assert {one.header.frame_id for one in told.transforms} == {"base_link"}
    frames = {message.header.frame_id for name, _, message in read if name.endswith(("audio", "detections"))}
    assert frames == set(found)
    ((_, _, array),) = read_by_others(bag_of_approach, "array")
    middle = np.mean([[one.x, one.y, one.z] for one in array.positions], axis=0)
    at, seen = (found[name].transform for name in ("microphones", "camera"))
    assert [at.translation.x, at.translation.y, at.translation.z] == pytest.approx(middle)
    assert at.rotation.w == 1.0
    camera = PinholeCamera.ovad()
    assert (seen.translation.x, seen.translation.y, seen.translation.z) == camera.position_m
    turn = Rotation.from_quat([seen.rotation.x, seen.rotation.y, seen.rotation.z, seen.rotation.w])
    up = camera.pitch_rad
    assert turn.apply([1.0, 0.0, 0.0]) == pytest.approx([math.cos(up), 0.0, math.sin(up)])
    assert turn.apply([0.0, 1.0, 0.0]) == pytest.approx([0.0, 1.0, 0.0])
    # 1 is TRANSIENT_LOCAL; otherwise a player sends the one message only to existing subscribers.
    assert (bag_of_approach / "metadata.yaml").read_text().count("durability: 1") == 1


@pytest.mark.long
def test_a_recording_and_its_bag_give_the_same_states(approach, bag_of_approach, tmp_path):
    out, again, replayed, bag = (tmp_path / name for name in ("a.jsonl", "b.jsonl", "d.jsonl", "c"))
    assert main(["run", str(approach.folder), "--out", str(out)]) == 0
    assert main(["run", str(bag_of_approach), "--out", str(again), "--export", f"rosbag={bag}"]) == 0
    of_folder, of_bag = ([json.loads(line) for line in path.open()] for path in (out, again))
    assert len(of_folder) == len(of_bag) > 50
    for one, other in zip(of_folder, of_bag, strict=True):
        assert other["stamp_ns"] - one["stamp_ns"] == START_NS
        assert other["context"]["ego_speed_mps"] == 0.0, "the odometry of a standing ego"
        for cue, as_before in zip(one["cues"], other["cues"], strict=True):
            assert (cue["advisory"] is None) == (as_before["advisory"] is None)
            # Seconds since 1970 have a resolution of 240 ns. A belief changes by at most 1 per second, and
            # the learned traffic, which is published in steps, may take its next step.
            assert cue["risk"] == pytest.approx(as_before["risk"], abs=1e-4)
        assert [one["status"] for one in one["entities"]] == [one["status"] for one in other["entities"]]
    # The bag has no pose in the map, so there are no objects for a planner.
    assert len(read_by_others(bag)) == 3 * len(of_bag)
    assert main(["log", "replay", str(bag), "--out", str(replayed)]) == 0
    assert replayed.read_bytes() == again.read_bytes()


def test_other_commands_use_the_array_of_a_bag(bag_of_approach, tmp_path, capsys):
    assert main(["array", "bearings", str(bag_of_approach), "--out", str(tmp_path / "b.csv"), "--json"]) == 0
    assert "56 microphones" in capsys.readouterr().out
    assert len((tmp_path / "b.csv").read_text().splitlines()) > 50


def test_the_camera_of_a_bag_labels_its_street(approach, bag_of_approach, tmp_path, capsys):
    found = []
    for path in (approach.folder, bag_of_approach):
        assert main(["street", "label", str(path), "--out", str(tmp_path / "labels"), "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["n_passes"] == 1
        found += json.loads((tmp_path / "labels").read_text())["openlabel"]["objects"].values()
    one, other = found
    assert (one["name"], one["type"]) == (other["name"], other["type"])
    t0_s, t0_of_bag_s = (label["object_data"]["num"][0]["val"] for label in found)
    assert t0_of_bag_s - t0_s == pytest.approx(1_700_000_000, abs=1e-3)
    windows = ["--out", str(tmp_path / "c"), "--windows", str(tmp_path / "labels.csv")]
    assert main(["street", "label", str(bag_of_approach), *windows]) == 2
    assert "--windows: expected none for a bag" in capsys.readouterr().err


def test_the_bag_of_a_drive_has_its_speed(tmp_path, capsys):
    folder = tmp_path / "DA1" / "left" / "1_00_0001"
    folder.mkdir(parents=True)
    soundfile.write(folder / "out_multi.wav", np.random.default_rng(0).uniform(-0.1, 0.1, (8000, 56)), 8000)
    bag = [str(folder), str(tmp_path / "unknown")]
    assert main(["sim", "to-bag", *bag, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["odometry"] is False, "OVAD states that it moves, but no speed"
    assert read_bag(tmp_path / "unknown").ego is None
    (folder / "truth.json").write_text(json.dumps({"ego": {"speed_mps": [4.0] * 5 + [2.0] * 6}}))
    assert main(["sim", "to-bag", str(folder), str(tmp_path / "driven"), "--start", "3"]) == 0
    told = [(one.stamp_ns, one.speed_mps) for one in read_bag(tmp_path / "driven").ego.told]
    assert told == [(3_000_000_000 + k * 100_000_000, 4.0 if k < 5 else 2.0) for k in range(11)]


@pytest.fixture
def states(tmp_path):
    return write_states(tmp_path / "states.jsonl", STATES)


def test_a_log_of_snapshots_is_no_bag(states, tmp_path, capsys, refused):
    assert main(["log", "replay", str(states), "--export", f"mcap={tmp_path / 'out.mcap'}"]) == 0
    capsys.readouterr()
    assert "`worldstate log replay` reads" in refused(["run", str(tmp_path / "out.mcap")])


def test_a_run_that_fails_leaves_no_bag(tmp_path):
    with pytest.raises(RuntimeError), state_bag(tmp_path / "out") as write:
        write(STATES[0])
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


@pytest.mark.long
def test_the_program_of_the_page_runs(bag_of_approach, tmp_path, monkeypatch):
    page = Path(__file__).resolve().parents[2] / "docs" / "reference" / "ros.md"
    (program,) = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    (tmp_path / "street_bag").symlink_to(bag_of_approach)
    monkeypatch.chdir(tmp_path)
    exec(compile(program, str(page), "exec"), {})
    assert len(read_by_others(tmp_path / "states_bag")) > 150
