"""A run that continues another one, and the bearing in the snapshot."""

import json

import numpy as np
import pytest
import soundfile

from worldstate.cli.main import main


@pytest.mark.long
@pytest.mark.parametrize("follows", [False, True])
def test_a_resumed_run_equals_a_whole_one(approach, follows, tmp_path):
    sound, rate = soundfile.read(approach.audio_path, dtype="float32")
    sound, half = sound[: 8 * rate], 4 * rate
    # The second part overlaps by the second that fills the windows.
    first = half - rate if follows else 0
    for name, part in (("whole", sound), ("half", sound[:half]), ("rest", sound[first:])):
        soundfile.write(tmp_path / f"{name}.wav", part, rate, subtype="FLOAT")
    given = ["--array", str(approach.array_path)]
    state = str(tmp_path / "state.json")

    def run(name, *options):
        out = tmp_path / "s.jsonl"
        assert main(["run", str(tmp_path / f"{name}.wav"), *given, *options, "--out", str(out)]) == 0
        return [json.loads(line) for line in out.read_text().splitlines()]

    whole = run("whole")
    before = run("half", "--save-state", state)
    after = run("rest", "--resume", state, "--start", str(first / rate))
    assert len(before) + len(after) == len(whole)
    if not follows:
        assert before + after == whole

    def told(snapshot: dict) -> tuple[float, ...]:
        bearing = snapshot["bearing"]
        return snapshot["stamp_ns"], snapshot["cues"][0]["risk"], bearing["azimuth_rad"] if bearing else 9.0

    expected = np.array([told(s) for s in whole])
    stamps, values = np.split(np.array([told(s) for s in before + after]) - expected, [1], axis=1)
    assert np.abs(stamps).max() == 0.0
    # Frames of the transform differ if the file begins elsewhere. Of two nearly equal directions either may
    # be the louder, and trees turn a small difference into a step, which inputs of eight seconds keep for as
    # long (0.89 of the values within 0.1).
    assert (np.abs(values) < (0.1 if follows else 1e-9)).mean() > (0.85 if follows else 1.0 - 1e-9)
    stated = [s["bearing"] for s in whole if s["bearing"]]
    assert len(stated) > len(whole) / 2
    assert set(stated[0]) == {"azimuth_rad", "std_rad", "prominence", "at_edge"}
