"""Fixtures that take seconds, made once per session."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import soundfile
from hypothesis import settings
from worldstate_lab.cli.main import main as study

from worldstate.adapters.datasets.ovad import DETECTION_NAMES, Recording
from worldstate.adapters.files.array_file import write_array_xml
from worldstate.cli.demo import simulate_approach
from worldstate.cli.main import main
from worldstate.frontend.array.microphone_array import ovad_array

# Two processes share two cores with other work, so the duration of an example is not a property of the code.
# With the usual 100 examples per law the suite took more than five minutes. Every clone draws the same
# examples: with new draws, one run in two met a rare case of one of two hundred laws.
settings.register_profile("shared_machine", deadline=None, max_examples=50, derandomize=True)
# For `make slow`, and for calls with --hypothesis-profile=anew.
settings.register_profile("anew", deadline=None, max_examples=200)
settings.load_profile("shared_machine")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Run the tests that share a fixture in one process; otherwise several processes make it."""
    for item in items:
        group = _shared(item)
        if group is not None and item.get_closest_marker("xdist_group") is None:
            item.add_marker(pytest.mark.xdist_group(group))
        if group == "smoke":
            item.add_marker(pytest.mark.long)


def _shared(item):
    scopes = {name: found[-1].scope for name, found in item._fixtureinfo.name2fixturedefs.items()}
    for name in ("approach", "smoke"):
        # A parametrised argument may have the same name.
        if scopes.get(name) == "session":
            return name
    return item.module.__name__ if {"module", "package"} & set(scopes.values()) else None


@dataclass(frozen=True)
class Approach:
    """One simulated occluded approach on disk."""

    folder: Path
    array_path: Path

    @property
    def audio_path(self) -> Path:
        return Recording.open(self.folder).audio_path

    @property
    def detections_path(self) -> Path:
        return self.folder / DETECTION_NAMES[0]


@pytest.fixture(scope="session")
def approach(tmp_path_factory) -> Approach:
    root = tmp_path_factory.mktemp("approach")
    write_array_xml(root / "mics.xml", ovad_array())
    return Approach(simulate_approach(root / "recording", seed=1), root / "mics.xml")


@pytest.fixture(scope="session")
def street(tmp_path_factory) -> Path:
    """Return a folder with two seconds of noise, the positions of its four microphones, and a camera's
    lens."""
    folder = tmp_path_factory.mktemp("street")
    noise = np.random.default_rng(4).normal(0.0, 0.1, (16_000, 4)).astype(np.float32)
    soundfile.write(folder / "street.wav", noise, 8_000, subtype="PCM_24")
    (folder / "mics.csv").write_text("0,0.1,0\n0,0.02,0.05\n0,-0.04,0\n0,-0.1,0.03\n")
    lens = {"width_px": 640, "height_px": 480, "horizontal_fov_deg": 70, "position_m": [0, 0, 0]}
    (folder / "lens.json").write_text(json.dumps(lens))
    return folder


@pytest.fixture
def refused(capsys):
    """Return a function that runs a command, which must fail, and returns its error."""

    def error_of(words):
        assert main(words) == 2
        return capsys.readouterr().err

    return error_of


@pytest.fixture(scope="session")
def smoke(tmp_path_factory):
    """Return the folder of a smoke evaluation, and its report."""

    out = tmp_path_factory.mktemp("evaluation")
    # One process: five pools would import the library in two processes each.
    assert study(["table", "--smoke", "--jobs", "1", "--out", str(out)]) == 0
    return out, json.loads((out / "evaluation.json").read_text())
