"""An array without a model: bearings and sound tracks, but no side, class or risk."""

import json
import math
from pathlib import Path

import numpy as np
import pyroomacoustics as pra
import pytest
import soundfile
from hypothesis import given, settings
from hypothesis import strategies as st
from made_up_sound import plane_wave
from street_measurements import hop

from worldstate import Listener, ListenSettings, MicrophoneArray, WorldFilter, WorldState
from worldstate.adapters import read_checkpoint, save_checkpoint
from worldstate.belief.sound_tracks import MOST_SOUNDS
from worldstate.belief.street_model import StreetModel
from worldstate.cli.main import main
from worldstate.frontend.settings import default_span_deg
from worldstate.ground import NotUsable, wrap_angle
from worldstate.measurement import Bearing
from worldstate.simulation.emitters.syntheses import voice

RATE = 16_000
ANGLES = 2.0 * np.pi * np.arange(5) / 5
RING = 0.045 * np.column_stack([np.cos(ANGLES), np.sin(ANGLES), 0.0 * ANGLES])
SOLID = 0.05 * np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
LINE = np.column_stack([np.zeros(4), 0.06 * np.arange(4), np.zeros(4)])
ARRAYS = {"ring": RING, "tetrahedron": SOLID, "line": LINE}


def talker(positions: np.ndarray, azimuth_rad: float, seed: int, seconds: int = 4) -> np.ndarray:
    """Return a voice in a room of 0.3 to 0.5 s of reverberation, 1.2 m from the microphones."""
    rng = np.random.default_rng(seed)
    size = rng.uniform([4.0, 4.0, 2.4], [7.0, 6.0, 3.2])
    absorption, order = pra.inverse_sabine(rng.uniform(0.3, 0.5), size)
    box = pra.ShoeBox(size, fs=RATE, materials=pra.Material(absorption), max_order=min(order, 15))
    middle = 0.5 * size + rng.uniform(-0.3, 0.3, 3)
    box.add_microphone_array((positions + middle).T)
    towards = np.array([math.cos(azimuth_rad), math.sin(azimuth_rad), 0.1])
    box.add_source(middle + 1.2 * towards, signal=voice(seconds * RATE, RATE, rng))
    box.simulate()
    sound = box.mic_array.signals.T[: seconds * RATE]
    noise = 1e-3 * rng.standard_normal(sound.shape)
    return (0.3 * sound / np.abs(sound).max() + noise).astype(np.float32)


def states_nothing(state: WorldState) -> bool:
    """Return whether a snapshot has no side, class, risk and advisory, as JSON and as an object."""
    told = json.loads(state.to_json())
    values = [one[key] for key in SILENT_OF_ENTITY for one in told["entities"]]
    values += [one[key] for key in SILENT_OF_CUE for one in told["cues"]]
    unusable = all(not cue.usable and cue.why_not for cue in state.cues)
    silent = state.risk is None and not state.calibrated and not any(values)
    return silent and unusable and bool(state.no_model)


SILENT_OF_ENTITY = "status", "hidden_probability", "classification", "direction", "sides"
SILENT_OF_CUE = (
    *("direction", "risk", "confidence", "statistic", "log_lambda", "hypotheses", "advisory", "alpha"),
    *("within", "time_to_visible_s", "evidence", "held", "horizon_s"),
)


@pytest.mark.parametrize("name", ARRAYS)
@pytest.mark.parametrize("seed", range(3))
def test_speech_in_a_room_gives_bearings_only(name: str, seed: int) -> None:
    array = MicrophoneArray(ARRAYS[name])
    azimuth_rad = float(np.random.default_rng(seed).uniform(-math.pi, math.pi))
    states = Listener(array, RATE).push(talker(array.positions_m, azimuth_rad, seed))
    assert len(states) == 30 and all(map(states_nothing, states))
    sounds = [one for state in states for one in state.entities]
    assert len(sounds) >= 15
    if name == "line":  # Its bearings are ahead, and poor near its axis
        assert all(one.bearing is None or abs(one.bearing.azimuth_rad) <= math.pi / 2.0 for one in states)
    else:
        off = [abs(wrap_angle(one.azimuth_rad - azimuth_rad)) for one in sounds]
        assert np.median(off) < math.radians(12.0) and len({one.id for one in sounds}) <= 2
    for state in states:
        assert {one.entity_id for one in state.cues} <= {entity.id for entity in state.entities}


def test_commands_print_bearings_and_the_missing_model(tmp_path, capsys, refused) -> None:
    sound, mics, log = tmp_path / "some.wav", tmp_path / "mics.csv", tmp_path / "states.jsonl"
    soundfile.write(sound, talker(RING, 2.5, 0), RATE)
    mics.write_text("".join(f"{x},{y},{z}\n" for x, y, z in RING.tolist()))
    words = [str(sound), "--array", str(mics)]
    assert main(["run", *words, "--out", str(log)]) == 0
    out = capsys.readouterr().out
    for said in ("(no model 31)", "\nsounds                   1\n", "distinguishes all azimuths"):
        assert said in out
    states = [WorldState.from_json(line) for line in log.read_text().splitlines()]
    reason = "no model was made for this array of 5 microphones"
    assert all(map(states_nothing, states)) and {one.no_model for one in states} == {NotUsable(reason)}
    told = [one.kind for state in states for one in state.events]
    assert told.count("born") - told.count("died") == len(states[-1].entities)
    assert main(["explain", str(log), "--time", "3"]) == 0
    assert "side unknown: advisory none" in capsys.readouterr().out
    for asked in (["--budget", "5"], ["--alpha", "0.02"]):
        assert "expected a model for the array" in refused(["run", *words, *asked])


def test_blocks_and_checkpoints_change_nothing(tmp_path: Path) -> None:
    array, sound = MicrophoneArray(RING), talker(RING, -1.0, 1)
    whole = Listener(array, RATE).push(sound)
    parts = Listener(array, RATE)
    first = [state for block in np.split(sound, range(777, 40_000, 777)) for state in parts.push(block)]
    assert first == whole
    save_checkpoint(tmp_path / "now.json", parts.checkpoint())
    assert read_checkpoint(tmp_path / "now.json").world.state == whole[-1] and whole[-1].entities
    order = [3, 0, 4, 1, 2]
    mixed = Listener(MicrophoneArray(RING[order]), RATE).push(sound[:, order])
    for one, other in zip(whole, mixed, strict=True):
        azimuths = [[entity.azimuth_rad for entity in state.entities] for state in (one, other)]
        np.testing.assert_allclose(*azimuths, atol=1e-3)


def followed(azimuths_rad: list[float | None], at_edge: bool = False) -> list[WorldState]:
    world, states = WorldFilter(no_model=NotUsable("no model")), []
    for number, azimuth_rad in enumerate(azimuths_rad, start=1):
        bearing = NotUsable("-") if azimuth_rad is None else Bearing(azimuth_rad, 0.1, 2.0, at_edge)
        world = world.predict_to(number * 10**8).update(hop(number, bearing=bearing))
        states.append(world.state)
    return states


bearings = st.lists(st.none() | st.floats(-math.pi, math.pi), max_size=40)


@settings(max_examples=40, deadline=None)
@given(bearings, st.floats(-math.pi, math.pi))
def test_rotated_bearings_rotate_the_tracks(azimuths: list[float | None], turn: float) -> None:
    turned = [None if one is None else wrap_angle(one + turn) for one in azimuths]
    for one, other in zip(followed(azimuths), followed(turned), strict=True):
        assert len(one.entities) == len(other.entities) <= MOST_SOUNDS
        for a, b in zip(one.entities, other.entities, strict=True):
            assert abs(wrap_angle(a.azimuth_rad + turn - b.azimuth_rad)) < 1e-6
            assert math.isclose(a.existence_probability, b.existence_probability, rel_tol=1e-6)
        assert states_nothing(one) and WorldState.from_json(one.to_json()) == one


@settings(max_examples=10, deadline=None)
@given(st.floats(-math.pi, math.pi))
def test_a_sound_track_fades_in_silence(azimuth_rad: float) -> None:
    """In silence existence decays with the mean life of unseen entities, then the track ends."""
    states = followed([azimuth_rad] * 15 + [None] * 80)
    chances = [one.entities[0].existence_probability for one in states[3:15]]
    (entity,) = states[14].entities
    assert abs(wrap_angle(entity.azimuth_rad - azimuth_rad)) < 1e-6 and chances[-1] > 0.9
    assert chances == sorted(chances)
    faded = states[34].entities[0].existence_probability
    assert math.isclose(faded, chances[-1] * math.exp(-2.0 / StreetModel().unseen_s), rel_tol=1e-9)
    assert not states[-1].entities and states[-1].risk is None


def test_sound_elsewhere_ends_a_track_and_an_edge_starts_none() -> None:
    silent, moved = followed([0.5] * 15 + [None] * 40), followed([0.5] * 15 + [-2.0] * 40)
    for (entity,), near in ((silent[-1].entities, True), (moved[-1].entities, False)):
        assert (abs(wrap_angle(entity.azimuth_rad - 0.5)) < 0.3) is near
    edges = followed([math.pi / 2.0] * 15, at_edge=True)
    assert not any(state.entities for state in edges)
    assert edges[-1].bearing is not None and edges[-1].bearing.at_edge


@pytest.mark.parametrize("azimuth_deg", [-170.0, -120.0, -60.0, 0.0, 100.0, 150.0])
def test_a_ring_searches_all_directions_or_a_stated_span(azimuth_deg: float) -> None:
    array = MicrophoneArray(RING)
    sound = plane_wave(array, RATE, math.radians(azimuth_deg), 2.0)
    (last,) = Listener(array, RATE).push(sound)[-1:]
    assert last.bearing is not None and not last.bearing.at_edge
    assert abs(wrap_angle(last.bearing.azimuth_rad - math.radians(azimuth_deg))) < math.radians(3.0)
    ahead = Listener(array, RATE, settings=ListenSettings(azimuth_span_deg=120)).push(sound)[-1]
    assert ahead.bearing is None or ahead.bearing.at_edge is (abs(azimuth_deg) >= 60.0)
    if abs(azimuth_deg) >= 60.0 and ahead.bearing is not None:
        assert math.isclose(ahead.bearing.std_rad, math.radians(120.0) / math.sqrt(12.0), rel_tol=1e-6)
        assert not ahead.entities


@given(st.floats(-math.pi, math.pi), st.lists(st.floats(-0.2, 0.2), min_size=3, max_size=8, unique=True))
def test_a_vertical_plane_searches_ahead(turn: float, along: list[float]) -> None:
    """A level direction and its mirror image in the plane have equal delays."""
    heights = np.linspace(0.0, 0.3, len(along))
    apart = np.array(along) + np.linspace(0.0, 0.1, len(along))
    positions = np.column_stack([apart * math.cos(turn), apart * math.sin(turn), heights])
    array = MicrophoneArray(positions)
    assert default_span_deg(array, RATE) == 180.0
    mirror = array.delays_s(0.7 + turn) - array.delays_s(-0.7 + turn)
    assert np.ptp(mirror) < 1e-12
