"""Small input files of every kind, and functions that damage them."""

import io
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import soundfile
from bag_messages import RATE_HZ, bag_of, blocks, sound_of
from hop_tables import blank_stream
from scripted_states import scripted_states, write_states

from worldstate import WorldFilter, WorldState
from worldstate.abduction.signature.site_estimate import SiteEstimate
from worldstate.adapters.camera.miss_rates import FamilyCounts, MissRates, save_miss_rates
from worldstate.adapters.datasets.feature_table import FeatureTable, write_features
from worldstate.adapters.export.log_messages import mcap_file, state_messages
from worldstate.adapters.files.array_file import write_array_xml
from worldstate.adapters.files.checkpoint_file import Checkpoint, save_checkpoint
from worldstate.adapters.files.model_file import read_model, save_model
from worldstate.adapters.ros.bag_writer import state_bag
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.operations.labelling.street_passes import write_street
from worldstate.operations.recordings.hop_table import save_tables
from worldstate.simulation.dataset.dataset import LogRow, write_log
from worldstate.smoothing.learned_street import LearnedStreet

# Replacements of a number, a text or a bracket: too large, of another type, too deep, too long.
WRONG = (
    *("-1", "0", "1e308", "-1e308", "1e-320", "1e999", "NaN", "9223372036854775808", "1" + "0" * 400),
    *("null", "true", '""', '"\\ud800"', '"' + "x" * 100_000 + '"', "[]", "{}", "[[]]", "[" * 3000, ",", ""),
)
TEXT = re.compile(r'"\w*"')
TOKEN = re.compile(r'"(?:[^"\\]|\\.)*"|-?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?|\w+|[\[\]{}:,<>=]')


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Return bytes with some of them changed, removed, repeated or set to zero."""
    at, end = sorted(rng.integers(0, len(data) + 1, 2).tolist())
    kind = rng.integers(4)
    if kind == 0:
        changed = bytearray(data)
        for place in rng.integers(0, len(data), 4):
            changed[place] = rng.integers(256)
        return bytes(changed)
    return (data[:at], data[:end] + data[at:], data[:at] + bytes(end - at) + data[end:])[kind - 1]


def mistyped(data: bytes, rng: np.random.Generator) -> bytes:
    """Return a text with one to three replaced numbers, words or brackets, which often still parses."""
    text = data.decode()
    for _ in range(rng.integers(1, 4)):
        # A model is mostly numbers, so every second replacement is a text; keys stay texts.
        at = int(rng.integers(max(len(text), 1)))
        one = (TEXT if rng.integers(2) else TOKEN).search(text, at) or TOKEN.search(text)
        if one is None:
            break
        named = text[one.end() : one.end() + 1] == ":"
        wrong = '"other"' if named else WRONG[rng.integers(len(WRONG))]
        text = text[: one.start()] + wrong + text[one.end() :]
    return text.encode()


def reshaped(data: bytes, rng: np.random.Generator) -> bytes:
    """Return npz with an array removed or with other numbers, type or shape."""
    with np.load(io.BytesIO(data)) as read:
        arrays = dict(read)
    name = list(arrays)[rng.integers(len(arrays))]
    value = arrays.pop(name)
    others = (value[None], value.ravel()[:1], value.astype("U7"), np.zeros(0), np.full(value.shape, np.nan))
    kind = rng.integers(len(others) + 1)
    if kind < len(others):
        arrays[name] = others[kind]
    written = io.BytesIO()
    np.savez_compressed(written, **arrays)
    return written.getvalue()


def spoilt(name: str, data: bytes, rng: np.random.Generator) -> bytes:
    """Return damaged content of a file of this name."""
    suffix = Path(name).suffix
    other = {".npz": reshaped}.get(suffix, damaged if suffix in BINARY else mistyped)
    return (damaged if rng.integers(3) == 0 else other)(data, rng)


BINARY = ".wav", ".mcap", ".db3", ".onnx"


def write_inputs(folder: Path) -> None:
    """Write one file of every kind."""
    rng = np.random.default_rng(1)
    soundfile.write(folder / "sound.wav", rng.normal(0, 0.1, (9000, 4)), RATE_HZ, "PCM_16")
    _write_arrays(folder)
    _write_street(folder)
    _write_tables(folder, rng)
    _write_boxes(folder)
    _write_logs(folder)


def _write_arrays(folder: Path) -> None:
    array = MicrophoneArray(np.array([[0.0, y, 0.0] for y in (-0.3, -0.1, 0.1, 0.3)]))
    write_array_xml(folder / "array.xml", array)
    (folder / "array.csv").write_text("x,y,z\n0,0.1,0\n0,-0.1,0\n0.1,0,0\n")
    (folder / "array.json").write_text("[[0, 0.1, 0], [0, -0.1, 0], [0.1, 0, 0]]")
    lens = {"width_px": 640, "height_px": 480, "horizontal_fov_deg": 60.0, "position_m": [2.0, 0.1, 1.2]}
    (folder / "camera.json").write_text(json.dumps(lens | {"yaw_deg": 3.0, "stamp_offset_s": 0.1}))
    turned = {"positions_m": array.positions_m.tolist(), "position_m": [1.2, 0.1, 1.6], "yaw_deg": 30.0}
    cameras = [lens | {"name": "front", "labels": ["car"]}, lens | {"name": "left", "yaw_deg": 60.0}]
    car = {"name": "shuttle", "array": turned, "cameras": cameras, "odometry": "odometry.csv"}
    (folder / "car.json").write_text(json.dumps(car))


def _write_street(folder: Path) -> None:
    save_model(folder / "model.json", read_model())
    world = WorldFilter(start_ns=1).predict_to(10**9)
    save_checkpoint(folder / "belief.json", Checkpoint(world, SiteEstimate.start(4)))
    counts = FamilyCounts(((9,) * 5,) * 2, ((0, 1, 3, 6, 9),) * 2, (9,) * 5, (0,) * 5)
    save_miss_rates(folder / "beta.json", MissRates((0.0, 15.0, 37.0), {"noise": counts}, {"detector": "x"}))
    write_street(folder / "street.json", LearnedStreet("Elm Street"))
    left = {"direction": "left", "corner_m": [5.0, 3.2], "crossing_m": 9.0, "speed_mps": 8.0}
    context = {"arms": [left, {"direction": "right", "open": True}], "ego_speed_mps": 0.0, "site": "Elm"}
    (folder / "context.json").write_text(json.dumps(context))
    rows = "".join(f"0.{k},5.{k},0.1,{k},0,0.1\n" for k in range(5))
    (folder / "odometry.csv").write_text("time_s,speed_mps,yaw_rate_rad_s,x_m,y_m,yaw_rad\n" + rows)
    frame = {"time_s": 0.1, "azimuth_rad": 0.3, "line_of_sight": 1, "position_m": [9.0, 3.0]}
    (folder / "truth.json").write_text(json.dumps({"frames": [frame] * 3, "others": [[frame]]}))


def _write_tables(folder: Path, rng: np.random.Generator) -> None:
    save_tables(folder / "streams.npz", [blank_stream("a", 30)])
    labels = np.array(["none", "left", "front", "right"])
    table = FeatureTable(rng.random((4, 60)), labels, labels, np.repeat("SA1", 4), labels, (None, 7, 7, 7))
    write_features(folder / "table.csv", table)
    (folder / "ids.csv").write_text("ID\nnone\n")
    listed = "ID,Class,Environment,Recording ID,File,End\na,left,SA1,r,sound.wav,1.1\n"
    (folder / "labels.csv").write_text(listed)
    write_log(folder, [LogRow("1_00_0002", "SA1", "left", 70)])


def _write_boxes(folder: Path) -> None:
    frame = {"boxes": [[0, 0, 10, 20]], "scores": [0.9], "classes_str": ["car"]}
    (folder / "boxes.json").write_text(json.dumps({"detections_per_frame": [frame, frame]}))
    result = {"image_id": 0, "category_id": 3, "bbox": [1, 2, 3, 4], "score": 0.5}
    (folder / "coco.json").write_text(json.dumps([result]))
    (folder / "mot.txt").write_text("1,-1,1,2,3,4,.5,-1,-1,-1\n3,-1,1,2,3,4,.9,-1,-1,-1\n")
    (folder / "yolo").mkdir()
    (folder / "yolo" / "000000.txt").write_text("2 0.5 0.5 0.1 0.2 0.9\n3 0.4 0.5 0.1 0.2 0.8\n")


def _write_logs(folder: Path) -> None:
    states = [WorldState(stamp_ns, 0) for stamp_ns in (0, 10**8)] + scripted_states()[2:4]
    write_states(folder / "states.jsonl", states)
    with mcap_file(folder / "states.mcap") as write:
        for state in states:
            for message in state_messages(state):
                write(message)
    later = [replace(state, stamp_ns=state.stamp_ns + 10**9) for state in states]
    for storage, suffix in (("mcap", "mcap"), ("sqlite3", "db3")):
        with state_bag(folder / f"log_{suffix}", 7.0, storage) as export:
            for state in later:
                export(state)
        bag_of(folder / f"bag_{suffix}", blocks(sound_of(12 * RATE_HZ // 10)), storage)
