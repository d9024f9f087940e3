"""The package of docs/examples for ROS 2, run with a stand-in for rclpy.

Messages follow the definitions of rosbags, and published ones are written as CDR, so a field that does not
exist and a value of another type raise an error.
"""

import ast
import json
import re
import sys
from collections import deque
from importlib import import_module
from pathlib import Path
from types import ModuleType, SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
from bag_messages import block, image
from hypothesis import given
from hypothesis import strategies as st
from ruamel.yaml import YAML

import worldstate
from worldstate.adapters.audio.sound_file import open_sound
from worldstate.adapters.camera.detections import read_detections
from worldstate.adapters.ros import bag_writer
from worldstate.adapters.ros.message_types import header, message, typestore

ROOT = Path(__file__).resolve().parents[2]
PACKAGE, MESSAGES = (ROOT / "docs" / "examples" / name for name in ("worldstate_ros", "worldstate_msgs"))
NODE = PACKAGE / "worldstate_ros" / "node.py"
START_NS = 1_700_000_000 * 10**9
LENS = {"width_px": 1936, "height_px": 1216, "horizontal_fov_deg": 68.75, "position_m": [-0.57, -0.03, -0.49]}


class Node:
    """Stand-in for rclpy.node.Node."""

    given = None

    def __init__(self, name):
        self.name, self.declared, self.topics, self.sent, self.said = name, {}, {}, {}, []

    def declare_parameter(self, name, default):
        self.declared[name] = default
        return SimpleNamespace(value=(self.given or {}).get(name, default))

    def create_publisher(self, kind, topic, quality):
        self.sent[topic] = []

        def publish(one):
            assert one.kind == kind.kind
            typestore().serialize_cdr(message(one.kind, one.values), one.kind)
            self.sent[topic].append(one.values)

        return SimpleNamespace(publish=publish)

    def create_subscription(self, kind, topic, callback, quality):
        self.topics[topic] = callback

    def get_logger(self):
        say = lambda text, **_: self.said.append(text)  # noqa: E731
        return SimpleNamespace(warning=say, error=say)


@pytest.fixture
def node_of(monkeypatch):
    """Return a function that makes the node with given parameters."""
    modules = {"rclpy": {"init": None, "spin": None, "try_shutdown": None}, "rclpy.node": {"Node": Node}}
    best = SimpleNamespace(BEST_AVAILABLE="best available")
    modules["rclpy.qos"] = {"QoSProfile": SimpleNamespace, "ReliabilityPolicy": best}
    modules["rosidl_runtime_py"] = {"set_message_fields": lambda one, values: vars(one).update(values=values)}
    for package, names in re.findall(r"^from (\w+_msgs)\.msg import (.+)", NODE.read_text(), re.MULTILINE):
        # `set_message_fields` fills the fields of a message.
        kinds = {one: {"kind": f"{package}/msg/{one}", "values": None} for one in names.split(", ")}
        modules[package], modules[f"{package}.msg"] = {}, {one: type(one, (), kinds[one]) for one in kinds}
    for name, members in modules.items():
        vars(module := ModuleType(name)).update(members)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.syspath_prepend(PACKAGE)
    module = import_module("worldstate_ros.node")
    monkeypatch.setattr(module, "rclpy", SimpleNamespace(**modules["rclpy"]))

    def make(**given):
        monkeypatch.setattr(Node, "given", given)
        return module.WorldStateNode()

    yield make
    for name in [one for one in sys.modules if one.startswith("worldstate_ros")]:
        del sys.modules[name]


def sound_message(samples, stamp_ns, rate_hz, layout="interleaved"):
    data = samples.T if layout == "planar" else samples
    _, kind, _, values = block(data, stamp_ns, layout=layout, channels=samples.shape[1], sample_rate=rate_hz)
    return message(kind, values)


def image_message(frame, stamp_ns):
    _, kind, _, values = image(stamp_ns, 0, *bag_writer._boxes(frame))
    return message(kind, values)


def moved_message(stamp_ns, speed_mps, frame="odom"):
    twist = {"twist": {"twist": {"linear": {"x": speed_mps}}}}
    turn = {"pose": {"pose": {"position": {"x": 3.0, "y": 4.0}, "orientation": {"z": 0.6, "w": 0.8}}}}
    return message("nav_msgs/msg/Odometry", {"header": header(stamp_ns, frame)} | twist | turn)


@pytest.fixture(scope="module")
def heard(approach):
    """Return 5 s of the demo's sound in blocks of 0.1 s with stamps, rate and images."""
    with open_sound(approach.audio_path, strict=False) as audio:
        rate_hz, blocks = audio.sample_rate_hz, list(audio.blocks(audio.sample_rate_hz // 10))[:50]
    found, at = read_detections(approach.detections_path), np.cumsum([0, *map(len, blocks)])
    stamps_ns = [START_NS + round(1e9 * first / rate_hz) for first in at[:-1].tolist()]
    images = [one for one in zip(found.stamps_ns.tolist(), found.frames, strict=True) if one[0] < 5 * 10**9]
    return blocks, stamps_ns, rate_hz, images


@pytest.fixture
def parameters(approach, tmp_path):
    (tmp_path / "camera.json").write_text(json.dumps(LENS))
    return {"array": str(approach.array_path), "camera": str(tmp_path / "camera.json"), "wait_s": 0.2}


@pytest.mark.long
@pytest.mark.parametrize("layout", ["interleaved", "planar"])
def test_states_of_the_node_equal_those_of_the_library(node_of, parameters, heard, layout):
    blocks, stamps_ns, rate_hz, images = heard
    node, late_ns = node_of(**parameters), 150_000_000
    coming = [(ns + len(part) * 10**9 // rate_hz, "audio", sound_message(part, ns, rate_hz, layout))
              for part, ns in zip(blocks, stamps_ns, strict=True)]  # fmt: skip
    seen = [(START_NS + ns, one) for ns, one in images]
    coming += [(ns + late_ns, "detections", image_message(one, ns)) for ns, one in seen]
    for _, topic, one in sorted(coming, key=lambda one: one[0]):
        node.topics[topic](one)
    camera = Path(parameters["camera"])
    listener = worldstate.Listener(parameters["array"], rate_hz, start_s=1e-9 * START_NS, camera=camera)
    states = []
    for part, first_ns in zip(blocks, stamps_ns, strict=True):
        for ns, frame in seen:
            if first_ns <= ns < first_ns + 10**8:
                listener.look(ns, frame)
        states += listener.push(part)
    sent = [worldstate.WorldState.from_json(one["data"]) for one in node.sent["~/snapshot"]]
    assert len(states) - len(sent) in (2, 3)  # for the last blocks the node still waits for boxes
    for got, state in zip(sent, states, strict=False):
        assert got.stamp_ns == state.stamp_ns
        assert [cue.risk for cue in got.cues] == pytest.approx([cue.risk for cue in state.cues], abs=1e-6)
        assert [cue.advisory is None for cue in got.cues] == [cue.advisory is None for cue in state.cues]
        assert (got.delivery, got.budget) == (state.delivery, state.budget)
        # Rounding of message lengths changes the time of a look by nanoseconds.
        looks_ns = [one.stamp_ns for one in state.searched]
        assert [one.stamp_ns for one in got.searched] == pytest.approx(looks_ns, abs=1000, rel=0)
    assert node.sent["~/advisories"] == [bag_writer.risk_advisories(one) for one in sent]
    assert len(node.sent["~/markers"]) == len(sent)
    assert any(one["raised"] for told in node.sent["~/advisories"] for one in told["advisories"])
    assert (node.sent["~/objects"], node.said) == ([], [])


def states_of(node):
    return [json.loads(one["data"]) for one in node.sent["~/snapshot"]]


def give(node, heard, numbers):
    """Send blocks of sound by their numbers."""
    blocks, stamps_ns, rate_hz, _ = heard
    for k in numbers:
        node.topics["audio"](sound_message(blocks[k], stamps_ns[k], rate_hz))


@pytest.mark.long
def test_lost_messages_become_silence(node_of, parameters, heard):
    stamps_ns, node = heard[1], node_of(**parameters | {"wait_s": 0.0})
    give(node, heard, [k for k in range(len(stamps_ns)) if not 14 <= k < 28])
    assert len(node.said) == 1
    assert node.said[0].startswith("audio: 1.4")
    states = states_of(node)
    assert 0 <= stamps_ns[-1] + 10**8 - states[-1]["stamp_ns"] < 1.5 * 10**8
    assert any(one["reason"] == "lost samples" for state in states for one in state["heard"])


@pytest.mark.long
def test_a_repeated_bag_restarts_the_run(node_of, parameters, heard):
    node = node_of(**parameters | {"wait_s": 0.0})
    give(node, heard, [*range(35), *range(35)])
    stamps = [one["stamp_ns"] for one in states_of(node)]
    assert len(stamps) % 2 == 0
    assert stamps[: len(stamps) // 2] == stamps[len(stamps) // 2 :]
    assert node.said == ["audio: stamps went back or the rate changed; the states start again"]


@pytest.mark.long
def test_objects_need_a_pose_in_the_map(node_of, parameters, heard):
    node = node_of(**parameters | {"wait_s": 0.0, "moving": True})
    for k, ns in enumerate(heard[1][:20]):
        node.topics["odometry"](moved_message(ns, 2.0, "map" if k >= 14 else "odom"))
        give(node, heard, [k])
    states = states_of(node)
    localised = [one for one in states if one["ego"] is not None and one["ego"]["localised"]]
    assert 0 < len(node.sent["~/objects"]) == len(localised) < len(states)
    assert states[-1]["ego"]["speed_mps"] == pytest.approx(2.0)
    assert states[-1]["ego"]["yaw_rad"] == pytest.approx(2.0 * np.arcsin(0.6), abs=0.05)
    assert node.sent["~/objects"][0]["header"]["frame_id"] == "map"


@pytest.mark.long
def test_unreadable_messages_are_counted(node_of, parameters, heard):
    blocks, stamps_ns, rate_hz, images = heard
    node = node_of(**parameters | {"wait_s": 0.0})
    node.topics["detections"](image_message(images[0][1], START_NS))  # before the first sound
    give(node, heard, range(11))
    wrong = sound_message(blocks[11], stamps_ns[11], rate_hz)
    for wrong.channels in (7, 0):
        node.topics["audio"](wrong)
    nan = sound_message(blocks[11], stamps_ns[11], rate_hz)
    nan.data[5] = np.nan
    node.topics["audio"](nan)
    outside = worldstate.DetectionFrame(np.array([[9e4, 1.0, 9.1e4, 400.0]]), np.array([0.9]), ("car",))
    node.topics["detections"](image_message(outside, stamps_ns[11]))
    give(node, heard, [12])
    assert states_of(node)[-1]["delivery"]["refused"] >= 3
    assert {text.split(":")[0] for text in node.said} == {"audio", "detections"}


def test_a_node_without_an_array_names_the_parameter(node_of, capsys):
    with pytest.raises(worldstate.WorldstateError, match="array: expected a board's name or a file"):
        node_of()


LENGTH_NS = 10**8


def clock():
    """Return the class, without the messages that its module needs."""
    of, body = {"deque": deque}, ast.parse(NODE.read_text()).body
    kept = [one for one in body if isinstance(one, ast.Assign) or getattr(one, "name", "") == "SampleClock"]
    exec(compile(ast.Module(kept, []), str(NODE), "exec"), of)
    return of["SampleClock"]


SampleClock = clock()


@given(st.lists(st.integers(0, 9 * 10**8), min_size=40, max_size=120), st.integers(0, 40))
def test_losses_are_found_and_jitter_is_none(delays_ns, lost):
    # One message in five is punctual, as with a fast transport.
    delays_ns = [0 if k % 5 == 0 else delay for k, delay in enumerate(delays_ns)]
    made, counted = SampleClock(0), 0
    for k, delay_ns in enumerate(delays_ns):
        sent = k if k < 20 else k + lost
        counted += made.moved_by(sent * LENGTH_NS + delay_ns, LENGTH_NS)
        if k < 20:
            assert counted == 0
    assert counted == lost * LENGTH_NS
    assert made.next_ns == (len(delays_ns) + lost) * LENGTH_NS


@given(st.floats(-4e-4, 4e-4), st.integers(0, 10**8))
def test_clock_drift_stays_within_1_5_messages(drift, first_ns):
    made = SampleClock(first_ns)
    for k in range(8000):  # a quarter of an hour
        stamp_ns = first_ns + round(k * LENGTH_NS * (1.0 + drift))
        made.moved_by(stamp_ns, LENGTH_NS)
        assert abs(made.next_ns - LENGTH_NS - stamp_ns) <= 1.5 * LENGTH_NS
        assert abs(made.time_ns(stamp_ns) - (made.next_ns - LENGTH_NS)) <= 0.01 * LENGTH_NS


def test_the_package_declares_its_imports_and_files():
    texts = [file.read_text() for file in PACKAGE.rglob("*.py")]
    imported = {name for text in texts for name in re.findall(r"^(?:from|import) (\w+)", text, re.MULTILINE)}
    manifest = ElementTree.parse(PACKAGE / "package.xml").getroot()
    stated = {one.text for one in manifest if one.tag in ("depend", "exec_depend")}
    usual = {*sys.stdlib_module_names, "setuptools", "worldstate", "numpy"}
    assert imported - usual == stated - {"python3-numpy"}
    given = {}
    setup = (PACKAGE / "setup.py").read_text().replace("from setuptools import setup", "")
    exec(setup, {"setup": lambda **parts: given.update(parts)})
    assert given["version"] == manifest.findtext("version") == worldstate.__version__
    assert all((PACKAGE / name).is_file() for _, names in given["data_files"] for name in names)
    assert given["entry_points"]["console_scripts"] == ["listener = worldstate_ros.node:main"]


def test_documented_parameters_and_defaults_are_those_of_the_node(node_of):
    text = (PACKAGE / "config" / "worldstate.yaml").read_text()
    stated = YAML(typ="safe").load(text)["/**/worldstate"]["ros__parameters"]
    assert node_of(array="x.csv").declared == stated
    assert text.count("    # ") >= len(stated)


def test_topics_of_the_launch_file_are_those_of_the_node():
    launch = ast.parse((PACKAGE / "launch" / "worldstate.launch.py").read_text())
    (topics,) = (ast.literal_eval(one.value) for one in launch.body if isinstance(one, ast.Assign))
    assert all(f'"{name}"' in NODE.read_text() for name in topics)
    assert topics["~/objects"] == bag_writer.OBJECTS_TOPIC


def test_message_definitions_equal_those_of_the_library():
    links = sorted((MESSAGES / "msg").iterdir())
    assert [one.resolve() for one in links] == [ROOT / "worldstate" / "data" / one.name for one in links]
    built = re.findall(r"msg/\w+\.msg", (MESSAGES / "CMakeLists.txt").read_text())
    assert sorted(built) == [f"msg/{one.name}" for one in links]
    assert "not been run in ROS 2 yet" in (PACKAGE / "README.md").read_text()
