"""The benchmarks of cost and of estimates; the speed is not tested."""

import json

import numpy as np
import pytest
from test_passes import heard, stream
from worldstate_lab.benchmarks.hop_costs import EVIDENCE, FRONT_END, RATE_HZ, vehicle_hops
from worldstate_lab.cli.bench.cost import EVERYTHING, plane_wave, shipped_listener
from worldstate_lab.cli.main import main

from worldstate import Context, WorldFilter
from worldstate.abduction.sequence.sequence_reader import SequenceReading
from worldstate.frontend.approach.looming import Looming
from worldstate.frontend.approach.tone import ToneReading
from worldstate.frontend.array.microphone_array import ovad_array
from worldstate.frontend.stream import FrontEnd
from worldstate.ground.values import NotUsable

FILTER = {f"{name}_{n}" for name in ("update", "state") for n in (1, 20)}
WHOLE = {"everything", "sound_to_state", "published_chain", "listener_hop", "listener_hop_8"}


@pytest.mark.long
@pytest.mark.slow
def test_every_stage_takes_time_and_less_than_the_whole(capsys):
    assert main(["bench", "--rounds", "1", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["blas"]
    median_ms = {name: one["median_ms"] for name, one in report["costs"].items()}
    assert set(median_ms) == {*FRONT_END, *EVIDENCE, *FILTER, *WHOLE}
    assert min(median_ms.values()) > 0.0
    assert sum(median_ms[name] for name in FRONT_END) < 2.0 * median_ms["everything"]
    assert sum(median_ms[name] for name in EVIDENCE) < median_ms["listener_hop"]


def test_every_vehicle_of_the_timed_hops_is_followed():
    for n in (1, 20):
        world = WorldFilter()
        for one in vehicle_hops(n, np.random.default_rng(0))[:10]:
            world = world.update(one)
        assert len(world.state.entities) == n


def test_the_timed_sound_exercises_every_stage():
    """The bench's sound exercises every stage: it has a source, a spectral line and a level."""
    sound = np.tile(plane_wave(np.random.default_rng(0)), (2, 1))[: RATE_HZ * 5 // 2]
    sound += np.random.default_rng(1).standard_normal(sound.shape, dtype=np.float32)
    frame = FrontEnd(ovad_array(), RATE_HZ, EVERYTHING).process(sound)[-1]
    assert np.degrees(frame.bearing_rad).round() == 25.0
    assert isinstance(frame.tone, ToneReading)
    assert abs(frame.tone.frequency_hz - 61.0) < 4.0 * frame.tone.frequency_std_hz
    assert isinstance(frame.looming, Looming)
    assert not isinstance(frame.character, NotUsable)
    # Sound of another array would be refused: no evidence would be timed.
    *_, last = shipped_listener().steps(sound)
    assert isinstance(last.measurement.sequence, SequenceReading)


def test_no_estimate_costs_half_the_cutoff_and_trackers_follow_the_boxes():
    pytest.importorskip("stonesoup", reason="the benchmark's trackers: pip install 'worldstate[oracles]'")
    from worldstate_lab.cli.bench import gospa

    made_up = stream([("left", "left", 8.0)], duration_s=12.0)
    costs, hops = gospa.costs(made_up, heard(made_up), WorldFilter(Context()))
    assert hops.tolist() == pytest.approx([50, 24], abs=1)
    per_hop = {method: cost / hops[:, None] for method, cost in costs.items()}
    # One vehicle without an estimate: 30 degrees per hop for a miss, and no other costs.
    np.testing.assert_allclose(per_hop[gospa.SILENCE], [[0.0, 30.0, 0.0]] * 2, atol=1e-9)
    hidden, visible = per_hop[gospa.WORLD].sum(axis=1)
    assert hidden < 15.0 and visible < 15.0
    for tracker in (gospa.UNHEARING, gospa.OC_SORT, gospa.GM_PHD, gospa.JPDA):
        hidden, visible = per_hop[tracker].sum(axis=1)
        # Without sound, no method detects a vehicle before its first box; with boxes, every method tracks it.
        assert hidden >= 29.0 and visible < 20.0 and per_hop[tracker][1, 0] < 10.0
