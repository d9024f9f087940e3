"""The command line as a user meets it."""

import inspect
import json
import re
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import soundfile
from scripted_states import scripted_states, write_states
from worldstate_lab.cli.main import PROGRAM as LABORATORY

import worldstate
from worldstate.adapters.files import array_file
from worldstate.adapters.files.model_file import DataSource, KindShare, RealFigure, read_model, save_model
from worldstate.adapters.ros.message_types import typestore
from worldstate.cli.common import progress
from worldstate.cli.completion import shell_script
from worldstate.cli.main import FORMER, FORMER_OPTIONS, PROGRAM, main
from worldstate.ground.errors import InputFileError
from worldstate.state import snapshot_schema


@pytest.fixture
def refusal(capsys):
    """Return a function that runs a command, which must fail with one line, and returns the line."""

    def line_of(words):
        assert main(words) == 2
        captured = capsys.readouterr()
        (line,) = captured.err.strip().splitlines()
        assert captured.out == ""
        return line

    return line_of


def help_of(words: str, capsys) -> str:
    with pytest.raises(SystemExit) as stop:
        main(words.split())
    assert stop.value.code == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("command", PROGRAM.commands)
def test_the_help_of_every_command_has_an_example(command, capsys):
    text = help_of(f"{command} --help", capsys)
    assert "example" in text
    assert f"worldstate {command}" in text
    assert "--json" in text
    assert help_of(f"help {command}", capsys) == text


def test_the_overview_of_all_commands_fits_on_one_screen(capsys):
    assert main(["--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 50
    assert max(map(len, lines)) <= 80
    shown = {line[:18].strip() for line in lines if line.startswith("  ")} - {""}
    assert shown == {*PROGRAM.commands} - {"completion"}


def test_run_has_at_most_twenty_options():
    assert len({one for one in PROGRAM.parser("run")._option_string_actions if one.startswith("--")}) <= 20


@pytest.mark.parametrize(
    "words", [[], ["help"], ["--help"], ["array"], ["help", "array"], ["array", "--help"]]
)
def test_a_program_or_group_without_a_command_prints_its_help(words, capsys):
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert "array bounds" in printed and printed.startswith("usage: worldstate")


@pytest.mark.parametrize("option", FORMER_OPTIONS)
def test_a_removed_option_gives_an_error_with_its_successor(option, refusal):
    line = refusal(["run", "some.wav", f"{option}=1"])
    successor = re.findall(r"--[a-z-]+|pcm:", FORMER_OPTIONS[option])
    assert FORMER_OPTIONS[option] in line and successor
    known = PROGRAM.parser("run")._option_string_actions
    assert all(one in known or one == "pcm:" for one in successor)


@pytest.fixture
def own(tmp_path, monkeypatch):
    """Go to a folder with a second of four channels, and the positions of four microphones."""
    monkeypatch.chdir(tmp_path)
    soundfile.write("own.wav", np.random.default_rng(0).normal(0, 0.1, (50_000, 4)), 48000)
    Path("mics.csv").write_text("0,0.2,0\n0,0.05,0\n0.05,-0.1,0\n0,-0.25,0\n")
    return tmp_path


OTHER_ARRAY = "not the array of the model", "4 microphones", "--uncalibrated"


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("run own.wav", ("expected --array", "4 channels", "uma-8", "array bearings", "model make")),
        ("run own.wav --array mics.csv --model uma-8", OTHER_ARRAY),
        ("run nothing.wav --out s.jsonl", ("nothing.wav",)),
        ("run own.wav --array uma-8 --out s.jsonl", ("own.wav", "7", "4")),
        ("nothing", ("expected one of",)),
        ("array nothing", ("expected one of",)),
    ],
)
def test_a_wrong_call_is_answered_in_one_line(line, said, own, refusal):
    printed = refusal(line.split())
    assert all(words in printed for words in said)
    assert {path.name for path in own.iterdir()} == {"own.wav", "mics.csv"}


@pytest.mark.parametrize(
    ("line", "package", "extra"),
    [
        ("run own.wav --figure f.png", "matplotlib", "plot"),
        ("run own.wav --export mcap=f.mcap", "mcap", "mcap"),
        ("log replay states.mcap", "mcap", "mcap"),
        ("log replay states.jsonl --export rerun=f.rrd", "rerun", "rerun"),
        ("log replay states.jsonl --export osi=f.osi", "osi3", "osi"),
        ("log replay states.jsonl --export rosbag=f", "rosbags", "ros"),
        ("run states.mcap", "rosbags", "ros"),
    ],
)
def test_the_extra_of_a_missing_package_is_named(line, package, extra, own, refusal, monkeypatch):
    for name in ("states.jsonl", "states.mcap"):
        write_states(Path(name), scripted_states())
    before = sorted(own.iterdir())
    typestore.cache_clear()
    monkeypatch.setitem(sys.modules, package, None)
    assert f"worldstate[{extra}]" in refusal(line.split())
    assert sorted(own.iterdir()) == before


def test_progress_is_a_line_without_a_terminal(monkeypatch, capsys):
    monkeypatch.setattr(progress, "EVERY_S", 0.01)
    monkeypatch.setitem(sys.modules, "rich", None)
    with progress.progress_bar("working", 4) as bar:
        bar.advance()
        time.sleep(0.2)
        bar.go_on("cleaning up", 1.0)
        time.sleep(0.2)
    told = capsys.readouterr().err
    assert "worldstate: working: 25 % after 0 s, some 0 s left" in told
    assert "worldstate: working: cleaning up: 50 % after 0 s" in told


@pytest.mark.parametrize("former", FORMER)
def test_a_former_command_is_refused_with_its_successor(former, refusal):
    assert f"`{FORMER[former]}`" in refusal([former, "--json"])
    program, *words = FORMER[former].split()
    programs = {"worldstate": PROGRAM, "worldstate-lab": LABORATORY}
    assert " ".join(words) in programs[program].commands


@pytest.mark.parametrize("own", [False, True])
def test_a_card_has_its_sources_and_the_gap_of_others_only_without_own_recordings(own, tmp_path, capsys):
    gap = RealFigure("AUROC", 0.98, 0.75, 0.63, 0.87, "a car", 2, 45, "a command")
    rows = (gap, replace(gap, simulated=0.97, real=0.82, microphones=7, own=True)) if own else (gap,)
    kinds = (KindShare("bicycle", 0.0, 12), KindShare("car", 0.777, 49))
    made = read_model()
    sources = DataSource("some windows", "coefficients"), DataSource("some clips", "thresholds", "CC0")
    provenance = replace(made.provenance, real=rows, kinds=kinds, exam={"detected": 0.5}, sources=sources)
    save_model(tmp_path / "m.json.gz", replace(made, provenance=provenance))
    assert main(["model", "show", str(tmp_path / "m.json.gz")]) == 0
    card = capsys.readouterr().out
    (said,) = re.findall(r"real_figure \d+ +(.*)", card)
    alone = (
        "AUROC: 0.97 in simulation was 0.82 [0.63, 0.87] in 45 real recordings with 7 microphones of a car"
    )
    without = "no real recording of such an array and motion; AUROC: 0.98 in simulation was 0.75 [0.63, 0.87]"
    assert said.startswith(alone if own else without)
    assert re.search(r"source 1 +some windows: coefficients; licence: none stated\n", card)
    assert re.search(r"source 2 +some clips: thresholds; licence: CC0\n", card)
    assert re.search(r"kind 1 +bicycle: 0\.00 of 12 simulated approaches", card)
    assert re.search(r"kind 2 +car: 0\.78 of 49 ", card)
    assert re.search(r"simulated_exam +detected 0\.5\n", card)


@pytest.mark.parametrize("word", ["array", "model"])
def test_lists_contain_all_boards_and_shipped_models(word, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(array_file, "MODELS", tmp_path)
    save_model(tmp_path / "uma-8.json.gz", read_model())
    assert main([word, "list", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    if word == "array":
        assert list(told) == list(array_file.named_arrays())
        assert [name for name, row in told.items() if row["model"]] == ["uma-8"]
        assert told["respeaker-4"]["microphones"] == 4
        # Neighbours on a ring of four: its radius times the root of two.
        assert told["respeaker-4"]["spacing_mm"] == pytest.approx(40.5 * 2**0.5, abs=0.05)
    else:
        assert list(told) == ["standing", "moving", "uma-8"]
        assert [row["ego_motion"] for row in told.values()] == ["standing", "moving", "standing"]
        for name in told:  # Each listed name is accepted
            assert main(["model", "show", name, "--json"]) == 0
        assert json.loads(capsys.readouterr().out.splitlines()[0])["ego_motion"] == "standing"
    assert main([word, "list"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == len(told)


@pytest.fixture(scope="module")
def ring_of_seven(tmp_path_factory):
    sound = tmp_path_factory.mktemp("ring") / "ring.wav"
    soundfile.write(sound, np.random.default_rng(0).uniform(-0.01, 0.01, (20_000, 7)), 16_000)
    return sound


def test_python_and_the_command_give_the_same_states(ring_of_seven, tmp_path):
    log = tmp_path / "states.jsonl"
    assert main(["run", str(ring_of_seven), "--array", "xmos", "--out", str(log)]) == 0
    states = worldstate.run(str(ring_of_seven), array="xmos")
    assert [one.to_json() for one in states] == log.read_text().splitlines()
    assert states == worldstate.read(log) == [*worldstate.listen(ring_of_seven, "xmos")]


@pytest.mark.parametrize("verb", [worldstate.run, worldstate.listen])
@pytest.mark.parametrize(
    ("array", "said"),
    [
        (None, "7 channels: a file, or one of respeaker-4.*xmos"),
        ("respeaker-4", "expected 4 channels.*got 7"),
    ],
)
def test_an_array_that_does_not_fit_is_refused_at_the_call(verb, array, said, ring_of_seven):
    with pytest.raises(InputFileError, match=said):
        verb(ring_of_seven, array)


@pytest.mark.parametrize("verb", [worldstate.run, worldstate.listen])
def test_a_verb_shows_the_arguments_that_the_command_has(verb):
    taken = {name.replace("_s", "").replace("_", "-") for name in inspect.signature(verb).parameters}
    options = {one.strip("-") for one in PROGRAM.parser("run")._option_string_actions}
    own = {"h", "help", "json", "out", "export", "figure", "save-state", "topic"}
    assert options - own <= taken | {"start"} and "topics" in taken


@pytest.mark.long
def test_run_writes_one_snapshot_per_hop(approach, tmp_path, capsys):
    states = tmp_path / "states.jsonl"
    outputs = ["--out", str(states), "--figure", str(tmp_path / "t.png"), "--json"]
    assert main(["run", str(approach.folder), *outputs]) == 0
    summary = json.loads(capsys.readouterr().out)
    snapshots = [json.loads(line) for line in states.read_text().splitlines()]
    assert len(snapshots) == summary["hops"]
    assert np.allclose(np.diff([snapshot["stamp_ns"] for snapshot in snapshots]), 1e8, atol=3e4)
    validator = jsonschema.Draft202012Validator(snapshot_schema())
    assert [error.message for one in snapshots for error in validator.iter_errors(one)] == []
    onset_s = next(one["stamp_ns"] for one in snapshots if any(cue["advisory"] for cue in one["cues"])) / 1e9
    assert main(["explain", str(states), "--time", f"{onset_s:.1f}"]) == 0
    assert f"since {onset_s:.2f} s" in capsys.readouterr().out
    assert (tmp_path / "t.png").read_bytes()[:4] == b"\x89PNG"


def test_the_help_names_every_exit_code(capsys):
    main(["--help"])
    text = capsys.readouterr().out.partition("exit codes:")[2].replace("\n", " ")
    root = Path(__file__).resolve().parents[2]
    page = (root / "docs" / "reference" / "commands.md").read_text(encoding="utf-8")
    for code in ("0", "1", "2", "130", "143"):
        assert f" {code} " in text
        assert re.search(rf"^\|.*\b{code}\b.*\|", page, flags=re.MULTILINE)


BASH = shutil.which("bash")
ASK = """
COMP_WORDS=({words}); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1))
_shtab_worldstate; printf '%s\\n' "${{COMPREPLY[@]}}"
"""


@pytest.fixture(scope="module")
def script():
    pytest.importorskip("shtab")
    return shell_script(PROGRAM, "bash")


@pytest.mark.skipif(BASH is None, reason="there is no bash here")
@pytest.mark.parametrize(
    ("words", "found"),
    [
        (["worldstate", "l"], ["live", "log"]),
        (["worldstate", "array", "b"], ["bounds", "bearings"]),
        (["worldstate", "sim", "make", "--traffic", "b"], ["busy", "bicycle-only"]),
        (["worldstate", "run", "a.wav", "--uncal"], ["--uncalibrated"]),
        (["worldstate", "completion", ""], ["bash", "zsh", "tcsh"]),
        (["worldstate", "live", "--uncalibrated", "--save-s"], ["--save-state"]),
        (["worldstate", "run", "--array", "pyproj"], ["pyproject.toml"]),
    ],
)
def test_bash_completes(script, words, found, request):
    asked = script + ASK.format(words=" ".join(f"'{word}'" for word in words))
    command, root = [BASH, "--norc", "-c", asked], request.config.rootpath
    answer = subprocess.run(command, capture_output=True, text=True, timeout=20, cwd=root, check=False)
    assert sorted(answer.stdout.split()) == sorted(found)


def test_the_completion_script_is_printed_alone(script, capsys):
    assert main(["completion", "bash"]) == 0
    assert capsys.readouterr().out == script + "\n"
