"""Recordings for Rerun hold the scene that Foxglove draws, as Rerun's own reader tells."""

import re
import subprocess
import sys

import numpy as np
import pytest
from scripted_states import scripted_states

from worldstate.adapters.export.scene import scene_update
from worldstate.cli.main import main

STATES = scripted_states()


def reader(*words: str) -> str:
    """Return what Rerun's command line says."""
    done = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", *words], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


def test_without_the_package_the_extra_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rerun", None)
    states = tmp_path / "states.jsonl"
    states.write_text("\n".join(state.to_json() for state in STATES) + "\n")
    assert main(["log", "replay", str(states), "--export", f"rerun={tmp_path / 'out.rrd'}"]) == 2
    assert "worldstate[rerun]" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [states]


def test_every_entity_of_the_scene_is_in_the_recording(tmp_path):
    pytest.importorskip("rerun")
    states, out = tmp_path / "states.jsonl", tmp_path / "out.rrd"
    states.write_text("\n".join(state.to_json() for state in STATES) + "\n")
    assert main(["log", "replay", str(states), "--export", f"rerun={out}"]) == 0
    assert "verified without error" in reader("verify", str(out))
    printed = reader("print", str(out))
    paths = set(re.findall(r" - (/worldstate/\S*) - ", printed))
    assert "/worldstate/snapshot" in paths
    for name in {item.id for state in STATES for item in scene_update(state).entities}:
        below = f"/worldstate/scene/{name.replace(' ', '/')}/"
        assert any(path.startswith(below) for path in paths), name
    for kind in ("Mesh3D:triangle_indices", "LineStrips3D:strips", "Points3D:labels", "Clear:is_recursive"):
        assert kind in printed


def test_power_and_images_of_a_run_are_there_too(tmp_path):
    pytest.importorskip("rerun")
    from worldstate.adapters.export.log_messages import image_message, rerun_file, srp_message

    out = tmp_path / "out.rrd"
    with rerun_file(out) as write:
        write(srp_message(STATES[0], np.radians(np.arange(-90.0, 91.0)), np.ones(181)))
        write(image_message(10**9, b"\xff\xd8\xff\xe0 a jpeg"))
    printed = reader("print", str(out))
    assert "/worldstate/srp/srp/lines" in printed
    assert re.search(r"/camera/image - .*EncodedImage:blob", printed)
