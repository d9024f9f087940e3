"""Evaluation of a board of four microphones: artificial recordings with lost buffers, and the real ones."""

import json
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import soundfile
from worldstate_lab.cli.corner.four import BUFFER, BoardRecording, aligned, lost_buffers, read_board
from worldstate_lab.cli.main import main

from worldstate.frontend.array.microphone_array import ovad_array

RATE = 8_000
REAL = Path(os.environ.get("FOUR_MICROPHONES", Path(__file__).parents[3] / "shared" / "four-microphones"))
MODEL = os.environ.get("FOUR_MODEL", "")


def late(sound: np.ndarray, by: Sequence[int]) -> np.ndarray:
    """Return one sound in channels that lost this many samples at the start, (n, channels)."""
    length = len(sound) - max(by)
    return np.stack([sound[start : start + length] for start in by], axis=1)


def test_lost_buffers_are_found_and_restored() -> None:
    sound = np.random.default_rng(0).standard_normal(3 * RATE)
    # A board has delays of a few samples.
    recorded = late(sound, [2, 0, BUFFER + 1, 2 * BUFFER])
    assert lost_buffers(recorded, RATE) == (0, 0, 1, 2)
    whole = aligned(recorded, (0, 0, 1, 2))
    assert lost_buffers(whole, RATE) == (0, 0, 0, 0)
    np.testing.assert_array_equal(whole, late(sound, [2, 0, 1, 0])[2 * BUFFER :][: len(whole)])
    np.testing.assert_array_equal(aligned(recorded, (0, 0, 0, 0)), recorded)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two recordings for the shipped model, one with a lost buffer, and one that is not scored."""
    rng, n = np.random.default_rng(1), ovad_array().n_microphones
    kinds = (("OA", "left", "car"), ("IA", "right", "man"), ("IA", "right", "cart"))
    rows = ["file,site,side,kind,seconds"]
    for at, (site, side, kind) in enumerate(kinds):
        sound = 0.02 * rng.standard_normal(int((5.4, 2.4, 2.4)[at] * RATE) + BUFFER)
        lost = np.where(np.arange(n) == 3, 0 if at else BUFFER, 0)
        soundfile.write(tmp_path / f"{at}.wav", late(sound, lost.tolist()), RATE)
        rows.append(f"{at}.wav,{site},{side},{kind},3")
    (tmp_path / "truth.csv").write_text("\n".join(rows) + "\n")
    return tmp_path


def test_every_recording_is_counted_once(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = str(Path(__file__).parents[2] / "worldstate" / "data" / "default_model.json")
    assert main(["four", str(folder), "--model", model, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["recordings"], found["lost_buffers"], found["listed"]) == (3, 1, ["2.wav"])
    assert {kind: one["count"] for kind, one in found["by_kind"].items()} == {"car": 1, "man": 1}
    assert {kind: one["hazard_of"] for kind, one in found["by_kind"].items()} == {"car": 1, "man": 0}
    assert found["side"]["of"] == found["hazard"]["pairs"] == 1
    # With a single side there is no balanced accuracy.
    assert found["side"]["balanced"] is None
    assert found["persons"]["recordings"] == 1
    # A buffer of 0.13 s is one and a half hops.
    assert found["as_recorded"]["by_kind"]["car"]["hops"] - found["by_kind"]["car"]["hops"] in (1, 2)


def test_a_folder_without_recordings_is_rejected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "truth.csv").write_text("file,site,side,kind\n")
    assert main(["four", str(tmp_path), "--model", "any.json"]) == 2
    assert "expected recordings" in capsys.readouterr().err


@pytest.mark.skipif(not REAL.exists(), reason="the recordings are beside the repository only")
def test_the_real_folder_is_read() -> None:
    recordings = read_board(REAL)
    assert all(isinstance(one, BoardRecording) and one.path.exists() for one in recordings)
    assert {one.side for one in recordings if one.drives_outdoors} == {"left", "right"}


@pytest.mark.long
@pytest.mark.skipif(not (REAL.exists() and MODEL), reason="FOUR_MODEL names no model of the board")
def test_the_exam_of_the_real_board(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["four", str(REAL), "--model", MODEL, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["side"]["of"] == sum(one.drives_outdoors for one in read_board(REAL))
    assert found["as_recorded"]["side"]["of"] == found["side"]["of"]
    assert found["hazard"]["pairs"] > 0
