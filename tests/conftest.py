"""Fixtures that cost seconds, made once a session."""

from dataclasses import dataclass
from pathlib import Path

import pytest

from worldstate.adapters.array_xml import write_array_xml
from worldstate.adapters.ovad import Recording
from worldstate.adapters.ovad_layout import DETECTION_NAMES
from worldstate.cli.demo import simulate_approach
from worldstate.frontend.array import roof_array_56


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
    write_array_xml(root / "mics.xml", roof_array_56())
    return Approach(simulate_approach(root / "recording", seed=1), root / "mics.xml")
