"""`worldstate explain` on the snapshots of a short scripted approach, and its errors."""

import json
import logging
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from street_measurements import hop

from worldstate import Absent, WorldFilter, WorldState
from worldstate.abduction import Foreign, uncalibrated_policy
from worldstate.abduction.sequence.sequence_model import GROUPS, AlarmPromise, SequenceAlarm
from worldstate.abduction.sequence.sequence_reader import SequenceReading
from worldstate.cli.main import main
from worldstate.measurement import Heard, Look
from worldstate.operations.recordings.evidence_report import common_lines

SHARE = np.full(len(GROUPS), 1.0 / len(GROUPS))


def heard(coming: float) -> np.ndarray:
    """Return side probabilities with this share of a vehicle in two seconds."""
    groups = np.full(len(GROUPS), 0.4 * (1.0 - coming) / (len(GROUPS) - 2))
    groups[GROUPS.index("coming_2s")], groups[GROUPS.index("seen")] = coming, 0.6 * (1.0 - coming)
    return groups


@pytest.fixture(scope="module")
def states(tmp_path_factory) -> Path:
    """Write 0.5 s of an empty street, 0.5 s of a vehicle on the left and 0.5 s of speech."""
    path = tmp_path_factory.mktemp("explain") / "states.jsonl"
    world, lines = WorldFilter(), []
    for number in range(1, 16):
        coming = 0.9 if 6 <= number <= 10 else 0.01
        said = SequenceReading(np.stack([heard(coming), heard(0.01)]), SHARE, 0.2, SequenceAlarm(1.5, 20.0))
        look = Look("camera", number * 10**8, Absent(0.1, 0.01))
        domain = Foreign("sounds like speech", 1.5) if number > 10 else None
        world = world.update(hop(number, answer=look.answer, look=look, domain=domain, sequence=said))
        lines.append(world.state.to_json())
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture(scope="module")
def log(states: Path) -> list[WorldState]:
    return [WorldState.from_json(line) for line in states.read_text().splitlines()]


@pytest.fixture(scope="module")
def onset(log: list[WorldState]) -> int:
    """Return the number of the first hop with an advisory."""
    return next(hop for hop, state in enumerate(log, 1) if state.cues[0].advisory)


CURVE = (
    "25 onsets per hour requested; the curve predicts 24.7 per hour (9.1 to 53.6 at other junctions) and 0.9%"
)
PROMISE = AlarmPromise(24.7, 9.1, 53.6, 0.0094, 0.0034, 0.0203)


@pytest.mark.parametrize(
    ("alarm", "words"),
    [
        ((20.0,), "20 onsets per hour; the model file has no curve"),
        ((25.0, None, PROMISE), CURVE),
        ((24.7, 0.01, PROMISE), "1.00% of the time without hazards requested; the curve predicts 24.7"),
    ],
)
def test_the_requested_budget_is_printed_beside_that_of_the_curve(alarm, words):
    said = SequenceReading(np.stack([heard(0.1), heard(0.01)]), SHARE, 0.2, SequenceAlarm(1.0, *alarm))
    one = hop(1, answer=Absent(0.1, 0.01), sequence=said)
    state = WorldFilter(policy=replace(uncalibrated_policy(), alpha=0.02)).update(one).state
    assert words in next(one for one in common_lines(state) if one.startswith("budget: "))
    assert {cue.alpha for cue in state.cues} == {None if len(alarm) == 1 else 0.0094}


def test_low_recall_of_bicycles_is_printed() -> None:
    kinds = {"bicycle": 0.0, "car": 0.8}
    one = hop(1, answer=Absent(0.1, 0.01), heard=Heard(0.5, "wind", kinds=kinds))
    lines = list(common_lines(WorldFilter().update(one).state))
    assert "acoustic, detected by kind (simulated exam): bicycle 0.00, car 0.40" in lines


PRINTED = """\
time  {now[time_s]:.2f} s
left: advisory {standing}
  usable: no, uncalibrated: no budget of false alarms was measured for this alarm
{foreign}  since {since_s:.2f} s, valid until {until_s:.2f} s, rests on acoustic ({ear}), camera (working)
  log-odds that a vehicle comes into view within 3 s, nats:
    at, s                     {since_s:.2f}          {now[time_s]:.2f}
    prior                    {onset[prior]:+.2f}         {now[prior]:+.2f}
    sequence                 {onset[sequence]:+.2f}         {now[sequence]:+.2f}
    looks                    {onset[looks]:+.2f}         {now[looks]:+.2f}
    together                 {onset[together]:+.2f}         {now[together]:+.2f}
    mean over 0.3 s          {onset[compared]:+.2f}         {now[compared]:+.2f}
  side: {cue.confidence:.2f} of P(hidden); risk {cue.risk:.2f}
  comes into view: {within}; {interval_s[1]:.1f} s from now ({interval_s[0]:.1f} to {interval_s[2]:.1f})
  entity: {id:.8} hidden at {azimuth_deg:+.0f} deg (std {std_deg:.0f}), exists with {exists:.2f}, \
by acoustic; the last look did not find it
{sound}sensor camera: working
look of camera at {now[time_s]:.2f} s: nothing from -34 to 34 deg, misses 0.10
"""
RAISED = {"standing": "raised", "ear": "working", "foreign": "", "sound": "sensor acoustic: working\n"}
HELD = {
    "standing": "held",
    "ear": "impaired",
    "foreign": "  usable: no, unknown sound: the model was not made for this sound\n",
    "sound": "sound: sounds like speech: the evidence of this hop has little weight\n"
    "sensor acoustic: impaired (sounds like speech)\n",
}


def figures(state: WorldState) -> dict[str, float]:
    """Return the log-odds of the left side, term by term."""
    terms = state.cues[0].evidence
    together = {"together": sum(terms.terms_nats.values()), "compared": terms.compared_nats}
    return {**terms.terms_nats, **together, "time_s": state.stamp_ns / 1e9}


@pytest.mark.parametrize(("hop", "said"), [(10, RAISED), (14, HELD)], ids=["raised", "held"])
def test_explain_prints_the_causes_of_an_advisory(hop, said, states, log, capsys):
    assert main(["explain", str(states), "--time", f"{hop / 10}", "--side", "left"]) == 0
    cue = log[hop - 1].cues[0]
    (entity,) = (one for one in log[hop - 1].entities if one.id == cue.entity_id)
    assert capsys.readouterr().out == PRINTED.format(
        cue=cue,
        onset=figures(next(one for one in log if one.stamp_ns == cue.advisory.since_ns)),
        now=figures(log[hop - 1]),
        since_s=cue.advisory.since_ns / 1e9,
        until_s=cue.advisory.valid_until_ns / 1e9,
        within=", ".join(f"{cue.within[one]:.2f} in {one} s" for one in ("0.5", "1", "2", "3")),
        interval_s=cue.time_to_visible_s,
        id=entity.id,
        azimuth_deg=math.degrees(entity.azimuth_rad),
        std_deg=math.degrees(entity.azimuth_std_rad),
        exists=entity.existence_probability,
        **said,
    )


def test_without_a_time_all_advisories_are_listed(states, log, onset, capsys):
    assert 7 <= onset <= 10  # During the approach, and not in the first hop
    assert main(["explain", str(states)]) == 0
    listed, explained = capsys.readouterr().out.split("\n\n")
    assert listed.splitlines() == [
        "advisories", f"  left   {onset / 10:.2f} to 1.50 s", "  at the first onset, another by --time",
    ]  # fmt: skip
    assert explained.startswith(f"time  {onset / 10:.2f} s\nleft: advisory raised")
    assert main(["explain", str(states), "--side", "right", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["advisories"] == []
    assert told["time_s"] == max(log, key=lambda state: state.cues[1].risk).time_s


def test_explain_prints_why_there_is_no_advisory(states, onset, capsys):
    assert main(["explain", str(states), "--time", f"{onset / 10 - 0.12:.2f}", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["time_s"] == pytest.approx(onset / 10 - 0.1)
    assert {one["standing"] for one in told["sides"].values()} == {"below"} and len(told["sides"]) == 2
    terms = told["sides"]["left"]["cue"]["evidence"]["terms_nats"]
    assert terms["prior"] == pytest.approx(np.log(0.4 / 0.6))  # Six of fifteen groups are within 3 s
    assert terms["sequence"] > 1.0 > 0.0 > told["sides"]["right"]["cue"]["evidence"]["compared_nats"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--time 7.5", "expected a time from 0.1 to 1.5 s, the span of its snapshots, got 7.5 s"),
        ("--time -1", "expected a time from 0.1 to 1.5 s"),
        ("--time 1 --side up", "--side: expected one of left, right, got 'up'"),
        ("--time nan", "--time"),
    ],
)
def test_wrong_times_and_sides_raise_an_error(words, said, states, refused):
    assert said in refused(["explain", str(states), *words.split()])


def test_other_versions_and_empty_logs_raise_an_error(states, tmp_path, capsys, refused):
    file = tmp_path / "old.jsonl"
    file.write_text(states.read_text().replace('"version":"4.2.0"', '"version":"2.1.0"'))
    assert main(["explain", str(file), "--time", "1"]) == 2
    assert "old.jsonl: expected schema worldstate.Snapshot 4.x, got" in (said := capsys.readouterr().err)
    assert "write it again" in said
    file.write_text("")
    assert "worldstate run --out" in refused(["explain", str(file), "--time", "1"])


def test_partial_logs_are_explained_and_replayed(states, onset, tmp_path, capsys):
    """The log is rotated or cut at or within a line at its beginning or end."""
    whole, log = states.read_bytes(), tmp_path / "rotated.jsonl"
    lines = whole.splitlines(keepends=True)
    for first in range(14):
        for extra in (b"", lines[first - 1][-200:] if first else b""):
            log.write_bytes(extra + b"".join(lines[first:]) + lines[0][:100])
            assert main(["explain", str(log), "--json"]) == 0
            told = json.loads(capsys.readouterr().out)
            assert [one["since_ns"] for one in told["advisories"]] == [onset * 10**8]
            assert told["time_s"] == pytest.approx(max(onset, first + 1) / 10)
            assert (told["sides"]["left"]["evidence_at_onset"] is None) == (first >= onset)
            assert main(["log", "replay", str(log), "--json"]) == 0
            replayed = json.loads(capsys.readouterr().out)
            assert replayed["states"] == 15 - first and replayed["advisory_onsets_s"] == [onset / 10]


# Damage between lines by a crash, an editor or a disk, and the number of lost lines.
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
def test_damaged_lines_are_skipped_with_one_notice(name, states, tmp_path, capfd, monkeypatch):
    change, cost = DAMAGE[name]
    lines = states.read_bytes().splitlines(keepends=True)
    log = tmp_path / "damaged.jsonl"
    log.write_bytes(b"".join(change(lines)))
    monkeypatch.setattr(logging.getLogger("worldstate.adapters.state_log"), "propagate", False)
    replay = ["log", "replay", str(log), "--out", str(tmp_path / "again.jsonl")]
    for command in (["explain", str(log)], replay):
        assert main(command) == 0
        told = capfd.readouterr().err.splitlines()
        expected = f"damaged.jsonl: {cost} cut or damaged lines are left out"
        assert [one.rpartition("/")[2] for one in told] == [expected] * bool(cost)
    again = (tmp_path / "again.jsonl").read_bytes().splitlines(keepends=True)
    assert len(again) == len(lines) - cost and set(again) <= set(lines)


def test_an_mcap_log_gives_the_same_explanation(states, tmp_path, capsys):
    assert main(["log", "replay", str(states), "--export", f"mcap={tmp_path / 'a.mcap'}"]) == 0
    told = []
    (tmp_path / "a.mcap.1").write_bytes((tmp_path / "a.mcap").read_bytes())
    for log in (states, tmp_path / "a.mcap", tmp_path / "a.mcap.1"):
        capsys.readouterr()
        assert main(["explain", str(log), "--time", "1.0"]) == 0
        told.append(capsys.readouterr().out)
    assert told[0] == told[1] == told[2]
