"""Arrays of 2 to 64 microphones: level, bearing and the array file of the data set."""

import json
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import soundfile
from simulated_sound import QUIET, apart_deg, made, srp_spectrum

from worldstate.adapters.files.array_file import read_array
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.simulation import SimulationSettings, place, simulate_recording

FS = 12_000.0
GRID = np.stack(np.meshgrid(*[np.arange(4.0)] * 2), axis=-1).reshape(-1, 2)
ZERO = np.zeros((16, 1))
CUBE = np.stack(np.meshgrid(*[np.arange(2.0)] * 3), axis=-1).reshape(-1, 3)
# In metres; the cube is on a mast.
ARRAYS = {
    "pair": [[0.0, 0.1, 0.0], [0.0, -0.1, 0.0]],
    "line across": np.outer(np.arange(5.0), [0.0, 0.09, 0.0]),
    "line along": np.outer(np.arange(8.0), [0.08, 0.0, 0.0]),
    "upright": 0.1 * np.concatenate([ZERO, GRID], axis=1),
    "lying": 0.1 * np.concatenate([GRID, ZERO], axis=1),
    "cube": 0.2 * CUBE + [0.0, 0.0, 3.0],
    "ball": np.random.default_rng(4).uniform(-0.4, 0.4, (64, 3)),
}
FRONT_AS_BACK, LEFT_AS_RIGHT = ("pair", "line across", "upright"), ("line along",)
AZIMUTHS_DEG = np.arange(-180.0, 180.0, 2.0)
LEVEL = replace(QUIET, ambient_waves=8, vehicle_spread_db=0.0)


@lru_cache
def passing(azimuth_deg: float, name: str) -> np.ndarray:
    """Return the sound of a slow car 15 m away at an azimuth, in the open."""
    x, y = 15.0 * np.cos(np.radians(azimuth_deg)), 15.0 * np.sin(np.radians(azimuth_deg))
    # The axles are behind the front towards the array, so both have the same azimuth.
    way = ((2.0 * x, 2.0 * y), (x, y))
    scene = SimulationSettings(
        place("open-road").site, "left", 0.5, entry_s=0.3, speed_mps=1.0, sample_rate_hz=FS, route_m=way,
        preset=LEVEL,
    )  # fmt: skip
    return simulate_recording(scene, np.random.default_rng(1), MicrophoneArray(ARRAYS[name])).audio


@pytest.mark.parametrize("name", sorted(ARRAYS))
@pytest.mark.parametrize("azimuth_deg", [30.0, -124.0])
def test_bearings_are_right_up_to_the_symmetry_of_the_array(name, azimuth_deg):
    array = MicrophoneArray(ARRAYS[name])
    sound = passing(azimuth_deg, name)
    assert sound.shape == (6000, array.n_microphones)
    power = srp_spectrum(sound.T, array, FS, AZIMUTHS_DEG, (375.0, 1500.0))
    mirrored = 180.0 - azimuth_deg if name in FRONT_AS_BACK else -azimuth_deg
    here, there = (power[apart_deg(AZIMUTHS_DEG, at).argmin()] for at in (azimuth_deg, mirrored))
    found = AZIMUTHS_DEG[power.argmax()]
    if name in (*FRONT_AS_BACK, *LEFT_AS_RIGHT):
        assert min(apart_deg(found, azimuth_deg), apart_deg(found, mirrored)) <= 6.0
        assert there == pytest.approx(here, rel=0.02)
    else:
        assert apart_deg(found, azimuth_deg) <= 4.0
        assert there < 0.9 * here


def test_the_level_does_not_depend_on_the_array():
    levels = [10 * np.log10(np.mean(passing(30.0, name) ** 2)) for name in ARRAYS]
    assert np.ptp(levels) < 0.3


def test_the_data_set_keeps_the_array_with_its_heights(tmp_path, capsys):
    (tmp_path / "cube.json").write_text(json.dumps(np.array(ARRAYS["cube"]).tolist()))
    words = f"--static 1 --duration 0.5 --scene parked-van --array {tmp_path / 'cube.json'}"
    (folder,) = made(capsys, tmp_path / "d", words)["folders"]
    np.testing.assert_array_equal(read_array(tmp_path / "d" / "array.xml").positions_m, ARRAYS["cube"])
    assert soundfile.info(tmp_path / "d" / folder / "out_multi.wav").channels == 8
