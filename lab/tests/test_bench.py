"""The benchmark prints what it promises; how fast is for people to read, not for tests to assert."""

import json

import numpy as np
from worldstate_lab.benchmarks.hop_costs import EVIDENCE, FRONT_END, GOAL, RATE_HZ, made_up_adapter
from worldstate_lab.cli.bench.cost import EVERYTHING, _source, processed, report_lines
from worldstate_lab.cli.main import main

from worldstate.abduction.sequence.sequence_reader import SequenceReading
from worldstate.abduction.signature.domain_guard import Foreign, WarningSignal
from worldstate.frontend.approach.looming import Looming
from worldstate.frontend.approach.tone import ToneReading
from worldstate.frontend.array.microphone_array import roof_array_56
from worldstate.frontend.stream import FrontEnd
from worldstate.ground.values import NotUsable

WHOLE = "front_end", "everything", "evidence"
COMPARED = (
    *("published_chain", "published_chain_per_call", "pyroomacoustics_srp", "pyroomacoustics_music"),
    *("scikit_learn_trees", "scikit_learn_classifier"),
)


def test_keys_and_consistency(capsys):
    assert main(["bench", "--rounds", "1", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["threads"] == 1
    assert report["blas"]
    assert set(report["stages"]) >= {*FRONT_END, *EVIDENCE, *WHOLE}
    parts = sum(report["stages"][name]["median_ms"] for name in GOAL)
    assert 0.0 < parts < 3.0 * report["total_ms"]
    assert report["stages"]["everything"]["median_ms"] > report["total_ms"]
    for name in COMPARED:
        assert report["ratios"][name] > 0.0
        assert report["peers"][name] > 0.0
        assert report["settings"][name]


def test_text_names_kernel_threads_and_what_is_compared():
    report = {
        "blas": ("openblas 0.3 Any",), "threads": 1, "rounds": 5, "load": 0.3,
        "settings": {"published_chain": "bins 1-15"}, "stages": {"stft": {"median_ms": 0.25, "p99_ms": 0.5}},
        "total_ms": 1.0, "p99_ms": 2.0,
        "peers": {"published_chain": 40.0}, "ratios": {"published_chain": 40.0},
    }  # fmt: skip
    text = "\n".join(report_lines(report))
    for part in ("openblas 0.3 Any; 1 thread; median of 5", "0.250", "40.0", "published_chain: bins 1-15"):
        assert part in text


def test_everything_that_is_timed_is_there():
    """The bench's sound makes every stage do its work: a source, a line, a level."""
    sound = np.tile(_source(np.random.default_rng(0)), (2, 1))[: RATE_HZ * 5 // 2]
    sound += np.random.default_rng(1).standard_normal(sound.shape, dtype=np.float32)
    frame = FrontEnd(roof_array_56(), RATE_HZ, EVERYTHING).process(sound)[-1]
    assert np.degrees(frame.bearing_rad).round() == 25.0
    assert isinstance(frame.tone, ToneReading)
    assert abs(frame.tone.frequency_hz - 61.0) < 4.0 * frame.tone.frequency_std_hz
    assert isinstance(frame.looming, Looming)
    assert not isinstance(frame.character, NotUsable)


def test_the_evidence_that_is_timed_is_read_from_whole_trees_and_a_guard_that_looks_closely():
    rng = np.random.default_rng(0)
    hops = [rng.standard_normal((4800, 56), dtype=np.float32) for _ in range(22)]
    calls, heard = processed(hops, EVERYTHING)
    for call in calls:
        call()
    adapter = made_up_adapter(rng)
    measured = [adapter.interpret(frame) for frame in heard]
    assert isinstance(measured[-1].sequence, SequenceReading)
    assert isinstance(measured[-1].domain, Foreign | WarningSignal)
