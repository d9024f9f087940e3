"""The benchmark prints all its rows; its speed is not tested."""

import json

import numpy as np
import pytest
from worldstate_lab.benchmarks.hop_costs import EVIDENCE, FRONT_END, RATE_HZ, made_up_adapter
from worldstate_lab.benchmarks.tracker_costs import hops
from worldstate_lab.cli.bench.cost import AGAINST, EVERYTHING, FEATURE_CHAIN, _source, processed, report_lines
from worldstate_lab.cli.main import main

from worldstate import WorldFilter
from worldstate.abduction.road_users import Foreign, WarningSignal
from worldstate.abduction.sequence.sequence_reader import SequenceReading
from worldstate.frontend.approach.looming import Looming
from worldstate.frontend.approach.tone import ToneReading
from worldstate.frontend.array.microphone_array import roof_array_56
from worldstate.frontend.stream import FrontEnd
from worldstate.ground.values import NotUsable

FILTER = {f"{name}_{n}" for name in ("update", "state") for n in (1, 20, 64, 600)}
BATCHES = {"numpy_batch_1", "numpy_batch_20"}
WHOLE = "front_end", "everything", "evidence", "feature_chain", "sound_to_state", "published_chain_8"


@pytest.mark.long
def test_the_files_of_a_hop_are_those_that_it_executes(capsys):
    assert main(["bench", "--files", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["n_files"] == len(report["files"])
    # 5,553 in version 0.3: most of the time of a hop is calls and not arithmetic.
    assert 1000 < report["n_calls"] < 4000
    assert {"worldstate/adapters/listener.py", "worldstate/core/filter.py"} < {*report["files"]}
    assert "worldstate/adapters/source.py" not in report["files"]


@pytest.mark.long
@pytest.mark.slow
def test_keys_and_consistency(capsys):
    assert main(["bench", "--rounds", "1", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["blas"]
    median_ms = {name: one["median_ms"] for name, one in report["costs"].items()}
    assert set(median_ms) == {*FRONT_END, *EVIDENCE, *WHOLE, *AGAINST, *FILTER, *BATCHES}
    parts = sum(median_ms[name] for name in FEATURE_CHAIN)
    assert 0.0 < parts < 3.0 * median_ms["feature_chain"]
    assert median_ms["everything"] > median_ms["feature_chain"]
    for name, ours in AGAINST.items():
        assert report["ratios"][name] == median_ms[name] / median_ms[ours] > 0.0
        assert report["settings"][name]


def test_every_vehicle_of_the_timed_hops_is_followed():
    for n, kept in ((1, 1), (20, 20), (600, 64)):
        world = WorldFilter()
        for one in hops(n, np.random.default_rng(0))[:10]:
            world = world.update(one)
        assert len(world.state.entities) == kept


def test_the_text_lists_kernel_threads_and_comparisons():
    report = {
        "blas": ("openblas 0.3 Any",), "rounds": 5, "load": 0.3, "settings": {"published_chain": "bins 1-15"},
        "costs": {name: {"median_ms": 0.25, "p99_ms": 0.5} for name in ("stft", "published_chain")},
        "ratios": {"published_chain": 40.0},
    }  # fmt: skip
    text = "\n".join(report_lines(report))
    for part in ("openblas 0.3 Any; 1 thread; median of 5", "0.250", "40.0", "published_chain: bins 1-15"):
        assert part in text


def test_the_timed_sound_exercises_every_stage():
    """The bench's sound exercises every stage: it has a source, a spectral line and a level."""
    sound = np.tile(_source(np.random.default_rng(0)), (2, 1))[: RATE_HZ * 5 // 2]
    sound += np.random.default_rng(1).standard_normal(sound.shape, dtype=np.float32)
    frame = FrontEnd(roof_array_56(), RATE_HZ, EVERYTHING).process(sound)[-1]
    assert np.degrees(frame.bearing_rad).round() == 25.0
    assert isinstance(frame.tone, ToneReading)
    assert abs(frame.tone.frequency_hz - 61.0) < 4.0 * frame.tone.frequency_std_hz
    assert isinstance(frame.looming, Looming)
    assert not isinstance(frame.character, NotUsable)


def test_the_timed_evidence_uses_complete_trees_and_a_guard_that_always_runs():
    rng = np.random.default_rng(0)
    # As in a street, most of the sound is common to the microphones.
    hops = [
        rng.standard_normal((4800, 1), dtype=np.float32)
        + 0.5 * rng.standard_normal((4800, 56), dtype=np.float32)
        for _ in range(22)
    ]
    calls, heard = processed(hops, EVERYTHING)
    for call in calls:
        call()
    adapter = made_up_adapter(rng)
    measured = [adapter.interpret(frame) for frame in heard]
    assert isinstance(measured[-1].sequence, SequenceReading)
    assert isinstance(measured[-1].domain, Foreign | WarningSignal)
