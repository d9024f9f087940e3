"""`worldstate array check` lists all faults; `run` raises an error for silent channels or leaves them out."""

import json
from pathlib import Path

import numpy as np
import pytest
import soundfile
from plane_waves import array_check

from worldstate.adapters.files.array_file import write_array_xml
from worldstate.cli.main import main
from worldstate.frontend.array.microphone_array import roof_array_56
from worldstate.frontend.health.channel_health import Fault
from worldstate.operations.recordings.channel_report import (
    ChannelVerdict,
    RecordingHealth,
    write_array_figure,
)
from worldstate.simulation import draw_settings, simulate_recording

RATE = 47_998
ROOF = roof_array_56()


@pytest.fixture(scope="module")
def street() -> np.ndarray:
    rng = np.random.default_rng(11)
    return simulate_recording(draw_settings("SA1", "left", rng, duration_s=2.5), rng, ROOF).audio


def test_array_check_lists_exactly_the_dead_channels(street, tmp_path, capsys):
    dead = np.sort(np.random.default_rng(0).choice(56, 20, replace=False))
    spoilt = street.copy()
    spoilt[:, dead] = 0.0
    assert array_check(tmp_path, ROOF, spoilt, RATE, "--json", "--figure", str(tmp_path / "array.png")) == 1
    report = json.loads(capsys.readouterr().out)
    assert not report["healthy"]
    assert [(one["channel"], one["fault"]) for one in report["faults"]] == [(d + 1, "dead") for d in dead]
    assert report["masked_microphones"] == (dead + 1).tolist()
    assert (tmp_path / "array.png").read_bytes().startswith(b"\x89PNG")


def test_array_check_prints_a_remedy_per_fault(street, tmp_path, capsys):
    spoilt = street.copy()
    spoilt[:, [3, 40]] = street[:, [40, 3]]
    spoilt[:, 12] *= -1
    spoilt[:, 20] = street[:, 20].clip(-street.std(), street.std())
    spoilt[:, 30] += 3 * street.std()
    spoilt[:, 50] = street.std() * np.random.default_rng(5).standard_normal(len(street))
    spoilt = np.delete(spoilt, np.arange(50_000, 52_000), axis=0)
    assert array_check(tmp_path, ROOF, spoilt, RATE) == 1
    lines = capsys.readouterr().out.splitlines()
    table = {int(line.split()[0]): line for line in lines if line.strip()[:1].isdigit() and "%" in line}
    assert sorted(table) == [4, 13, 21, 31, 41, 51]
    for channel, words in {4: "channel 41", 41: "channel 4:", 13: "polarity", 21: "gain", 31: "mean"}.items():
        assert words in table[channel]
    assert any(line.startswith("1 dropout (splice at sample ") for line in lines)
    assert lines[-1].startswith("not healthy: swapped 4, 41;")


@pytest.mark.long
@pytest.mark.parametrize("fault", Fault)
def test_a_microphone_with_any_fault_is_drawn(fault: Fault, tmp_path: Path) -> None:
    health = RecordingHealth((ChannelVerdict(3, fault, 1.0, 1.0, 1.0),), (), 0, 0.5)
    write_array_figure(roof_array_56(), health, tmp_path / "array.svg")
    assert f"<!-- {fault.value} -->" in (tmp_path / "array.svg").read_text()


def test_a_recording_is_healthy_unless_its_sample_rate_is_wrong(street, tmp_path, capsys):
    length = len(street) / RATE
    assert array_check(tmp_path, ROOF, street, RATE, "--duration", str(length + 0.005)) == 0
    printed = capsys.readouterr().out
    lines = printed.splitlines()
    assert "sample rate by the other clock" in printed and "front-back ambiguous" in lines[1]
    assert lines[-1] == "healthy" and not any(line.startswith("channel") for line in lines)
    assert array_check(tmp_path, ROOF, street, RATE, "--duration", str(1.05 * length)) == 1
    assert "the header is wrong" in capsys.readouterr().out


def test_bad_input_gives_one_line(street, tmp_path, capsys):
    assert main(["array", "check", "nothing.wav"]) == 2
    assert "nothing.wav: no such file" in capsys.readouterr().err
    assert array_check(tmp_path, ROOF, street[:, :55], RATE) == 2
    assert "expected 56 channels" in capsys.readouterr().err
    mostly = street.copy()
    mostly[:, :29] = 0.0
    assert array_check(tmp_path, ROOF, mostly, RATE) == 2
    assert "at least half of 56 channels" in capsys.readouterr().err


@pytest.mark.parametrize("silent", [[], [6, 9]])
def test_run_leaves_silent_channels_out_with_a_warning(street, silent, tmp_path, capsys, caplog):
    spoilt, path = street.copy(), tmp_path / "some.wav"
    spoilt[:, silent] = 0.0
    soundfile.write(path, spoilt, RATE, subtype="PCM_24")
    write_array_xml(tmp_path / "mics.xml", ROOF)
    assert main(["run", str(path), "--array", str(tmp_path / "mics.xml"), "--uncalibrated", "--json"]) == 0
    assert ("channel 7, 10 is silent" in caplog.text) == bool(silent)
    assert json.loads(capsys.readouterr().out)["masked_microphones"] == [one + 1 for one in silent]
