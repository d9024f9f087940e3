"""`worldstate explain` on the snapshots of a short scripted approach, and where it refuses."""

import json
import logging
from pathlib import Path

import numpy as np
import pytest

from worldstate import Measurement, NotUsable, SignatureEvidence, WorldFilter
from worldstate.abduction.co_evidence import Absent
from worldstate.abduction.road_users import Foreign
from worldstate.abduction.sequence.sequence_model import GROUPS, SequenceAlarm
from worldstate.abduction.sequence.sequence_reader import SequenceReading
from worldstate.cli.main import main
from worldstate.measurement import Look

SILENT, FLAT = NotUsable("not scripted"), SignatureEvidence(("left", "right"), (0.0, 0.0), 0.0, 0.0)
SHARE = np.full(len(GROUPS), 1.0 / len(GROUPS))


def heard(coming: float) -> np.ndarray:
    """Return a side on which somebody comes in two seconds with this probability, or is perhaps in view."""
    groups = np.full(len(GROUPS), 0.4 * (1.0 - coming) / (len(GROUPS) - 2))
    groups[GROUPS.index("coming_2s")], groups[GROUPS.index("seen")] = coming, 0.6 * (1.0 - coming)
    return groups


@pytest.fixture(scope="module")
def states(tmp_path_factory) -> Path:
    """Half a second of nothing, half a second of somebody on the left, and speech that takes it away."""
    path = tmp_path_factory.mktemp("explain") / "states.jsonl"
    world, lines = WorldFilter(), []
    for hop in range(1, 16):
        coming = 0.9 if 6 <= hop <= 10 else 0.01
        said = SequenceReading(np.stack([heard(coming), heard(0.01)]), SHARE, 0.2, SequenceAlarm(1.0, 20.0))
        look = Look("camera", hop * 10**8, Absent(0.1, 0.01))
        domain = Foreign("sounds like speech", 1.5) if hop > 10 else None
        hop_ns = hop * 10**8
        world = world.update(
            Measurement(hop_ns, FLAT, look.answer, SILENT, SILENT, (), look, domain, sequence=said)
        )
        lines.append(world.state.to_json())
    path.write_text("\n".join(lines) + "\n")
    return path


RAISED = """\
time  1.00 s
left: advisory raised
  since 0.70 s, valid until 2.00 s, rests on acoustic (working), camera (working)
  log-odds that a vehicle comes into view within 3 s, nats:
    at, s                     0.70          1.00
    prior                    -0.41         -0.41
    sequence                 +2.79         +2.79
    look camera              +0.59         +0.59
    together                 +2.97         +2.97
    mean of .3 s             +1.63         +2.97
  side: 0.70 of what is hidden; risk 0.96
  comes into view: 0.00 in 0.5 s, 0.01 in 1 s, 0.94 in 2 s, 0.95 in 3 s; 1.8 s from now (1.3 to 2.2)
  entity: f8eadf57 hidden at +56 deg (std 7), exists with 0.97, by acoustic; the last look did not find it
uncalibrated: no false-alarm budget stands behind the advisories
sensor acoustic: working
sensor camera: working
look of camera at 1.00 s: nothing from -34 to 34 deg, misses 0.10
"""
HELD = """\
time  1.40 s
left: advisory held
  since 0.70 s, valid until 2.10 s, rests on acoustic (impaired), camera (working)
  log-odds that a vehicle comes into view within 3 s, nats:
    at, s                     0.70          1.40
    prior                    -0.41         -0.41
    sequence                 +2.79         -1.24
    look camera              +0.59         +0.59
    together                 +2.97         -1.05
    mean of .3 s             +1.63         -1.05
  side: 0.50 of what is hidden; risk 0.40
  comes into view: 0.05 in 0.5 s, 0.10 in 1 s, 0.16 in 2 s, 0.26 in 3 s; 2.2 s from now (0.0 to 4.8)
  entity: f8eadf57 hidden at -59 deg (std 9), exists with 0.54, by acoustic; the last look did not find it
uncalibrated: no false-alarm budget stands behind the advisories
sound: sounds like speech: the evidence of this hop counts little
sensor acoustic: impaired (sounds like speech)
sensor camera: working
look of camera at 1.40 s: nothing from -34 to 34 deg, misses 0.10
"""


@pytest.mark.parametrize(("time", "said"), [("1.0", RAISED), ("1.4", HELD)], ids=["raised", "held"])
def test_it_says_what_raised_and_what_holds_an_advisory(time, said, states, capsys):
    assert main(["explain", str(states), "--time", time, "--side", "left"]) == 0
    assert capsys.readouterr().out == said


def test_without_a_time_all_are_listed_and_the_first_is_explained(states, capsys):
    assert main(["explain", str(states)]) == 0
    listed, explained = capsys.readouterr().out.split("\n\n")
    assert listed.splitlines() == [
        "advisories", "  left   0.70 to 1.50 s", "  at the first onset, another by --time",
    ]  # fmt: skip
    assert explained.startswith("time  0.70 s\nleft: advisory raised")
    assert main(["explain", str(states), "--side", "right", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["advisories"] == []
    snapshots = [json.loads(line) for line in states.read_text().splitlines()]
    riskiest = max(snapshots, key=lambda snapshot: snapshot["cues"][1]["risk"])
    assert told["time_s"] == riskiest["stamp_ns"] / 1e9


def test_it_says_why_there_is_none_and_takes_the_nearest_snapshot(states, capsys):
    assert main(["explain", str(states), "--time", "0.58", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["time_s"] == 0.6
    assert {side: one["standing"] for side, one in told["sides"].items()} == {
        "left": "below",
        "right": "below",
    }
    terms = told["sides"]["left"]["cue"]["evidence"]["terms_nats"]
    assert terms["prior"] == pytest.approx(np.log(0.4 / 0.6))  # Six of fifteen groups come within 3 s
    assert terms["sequence"] > 2.0 > 0.0 > told["sides"]["right"]["cue"]["evidence"]["compared_nats"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--time 7.5", "expected a time from 0.1 to 1.5 s, in which it has snapshots, got 7.5 s"),
        ("--time -1", "expected a time from 0.1 to 1.5 s"),
        ("--time 1 --side up", "--side: expected one of left, right, got 'up'"),
        ("--time nan", "--time"),
    ],
)
def test_a_time_outside_and_a_side_that_is_none_are_named(words, said, states, capsys):
    assert main(["explain", str(states), *words.split()]) == 2
    assert said in capsys.readouterr().err


def test_files_of_another_version_and_without_snapshots_say_what_to_do(states, tmp_path, capsys):
    file = tmp_path / "old.jsonl"
    file.write_text(states.read_text().replace('"version":"3.0.0"', '"version":"2.1.0"'))
    assert main(["explain", str(file), "--time", "1"]) == 2
    assert "old.jsonl: expected schema worldstate.Snapshot 3.x, got" in (said := capsys.readouterr().err)
    assert "write it anew" in said
    file.write_text("")
    assert main(["explain", str(file), "--time", "1"]) == 2
    assert "worldstate run --out" in capsys.readouterr().err


def test_a_log_that_begins_anywhere_is_explained_and_replayed(states, tmp_path, capsys):
    """What was rotated, or cut at a line or within one, at its beginning or its end."""
    whole, log = states.read_bytes(), tmp_path / "rotated.jsonl"
    lines = whole.splitlines(keepends=True)
    for first in range(14):
        for extra in (b"", lines[first - 1][-200:] if first else b""):
            log.write_bytes(extra + b"".join(lines[first:]) + lines[0][:100])
            assert main(["explain", str(log), "--json"]) == 0
            told = json.loads(capsys.readouterr().out)
            advised = told["advisories"]
            assert [one["since_ns"] for one in advised] == [700_000_000]
            assert told["time_s"] == pytest.approx(max(0.7, 0.1 * (first + 1)))
            at_onset = told["sides"]["left"]["evidence_at_onset"]
            assert (at_onset is None) == (first > 6)
            assert main(["log", "replay", str(log), "--json"]) == 0
            replayed = json.loads(capsys.readouterr().out)
            assert replayed["states"] == 15 - first and replayed["advisory_onsets_s"] == [0.7]


# What a crash, an editor or a disk leaves between the lines, and how many lines it costs.
DAMAGE = {
    "a byte order mark": (lambda lines: [b"\xef\xbb\xbf" + lines[0], *lines[1:]], 0),
    "blank lines": (lambda lines: [b"\n", *lines[:3], b"\r\n", *lines[3:]], 0),
    "ends of Windows": (lambda lines: [one[:-1] + b"\r\n" for one in lines], 0),
    "no last end": (lambda lines: [*lines[:-1], lines[-1][:-1]], 0),
    "a line cut": (lambda lines: [*lines[:5], lines[5][:300] + b"\n", *lines[6:]], 1),
    "zeros in place of a line": (lambda lines: [*lines[:5], bytes(300) + b"\n", *lines[6:]], 1),
    "zeros at the end": (lambda lines: [*lines[:-1], lines[-1][:50], bytes(4096)], 1),
    "both ends cut": (lambda lines: [lines[0][99:], *lines[1:-1], lines[-1][:99]], 2),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damage_costs_the_lines_that_have_it_and_is_told_once(name, states, tmp_path, capfd, monkeypatch):
    change, cost = DAMAGE[name]
    lines = states.read_bytes().splitlines(keepends=True)
    log = tmp_path / "damaged.jsonl"
    log.write_bytes(b"".join(change(lines)))
    monkeypatch.setattr(logging.getLogger("worldstate.adapters.state_log"), "propagate", False)
    for command in (
        ["explain", str(log)],
        ["log", "replay", str(log), "--out", str(tmp_path / "again.jsonl")],
    ):
        assert main(command) == 0
        told = capfd.readouterr().err.splitlines()
        expected = f"damaged.jsonl: {cost} lines that are cut or damaged are left out"
        assert [one.rpartition("/")[2] for one in told] == [expected] * bool(cost)
    again = (tmp_path / "again.jsonl").read_bytes().splitlines(keepends=True)
    assert len(again) == len(lines) - cost and set(again) <= set(lines)


def test_a_log_in_mcap_is_explained_alike(states, tmp_path, capsys):
    assert main(["log", "replay", str(states), "--export", f"mcap={tmp_path / 'a.mcap'}"]) == 0
    told = []
    (tmp_path / "a.mcap.1").write_bytes((tmp_path / "a.mcap").read_bytes())
    for log in (states, tmp_path / "a.mcap", tmp_path / "a.mcap.1"):
        capsys.readouterr()
        assert main(["explain", str(log), "--time", "1.0"]) == 0
        told.append(capsys.readouterr().out)
    assert told[0] == told[1] == told[2]
