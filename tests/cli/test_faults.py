"""Faults of files, disks and users: one line, exit code 2 and no files lost or left."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
from scripted_states import scripted_states

from worldstate.adapters import OvadDataset
from worldstate.adapters.files.file_io import write_text
from worldstate.cli.common import progress
from worldstate.cli.main import main
from worldstate.ground import extras
from worldstate.simulation.dataset.dataset import LogRow, write_log
from worldstate.state import Classification, SensorHealth

COMMAND = (sys.executable, "-m", "worldstate.cli.main")
RECORDING = "set/SA1/left/1_00_0000"


def tree(root: Path) -> dict[str, object]:
    """Return every name below `root` with its content."""
    return {str(path.relative_to(root)): content(path) for path in sorted(root.rglob("*"))}


def content(path: Path) -> object:
    if path.is_symlink():
        return path.readlink()
    return path.read_bytes() if path.is_file() else path.stat().st_mode


def refusal(words: list[str], root: Path, capsys) -> str:
    """Run a command that must fail with one line and no change of files, and return the line."""
    before = tree(root)
    assert main(words) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    lines = captured.err.strip().splitlines()
    assert len(lines) == 1, captured.err
    assert lines[0].startswith("worldstate: ")
    assert tree(root) == before
    return lines[0]


@pytest.fixture
def files(tmp_path, monkeypatch) -> Path:
    """Write inputs that no command can read, so errors come before any reading."""
    monkeypatch.chdir(tmp_path)
    for name in ("a.wav", "m.json", "t.csv", "ids.csv", "mics.xml", "v.mp4", f"{RECORDING}/out_multi.wav"):
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_bytes(b"precious")
    for name in ("folder.png", "folder", "taken/timeline.png"):
        Path(name).mkdir(parents=True)
    Path("link.wav").symlink_to("a.wav")
    Path("loop").symlink_to("loop")
    camera = {"name": "front", "width_px": 640, "height_px": 480, "horizontal_fov_deg": 90}
    camera |= {"position_m": [0, 0, 0], "detections": "boxes.json"}
    Path("car.json").write_text(json.dumps({"cameras": [camera]}))
    Path("boxes.json").touch()
    os.mkfifo("pipe")
    return tmp_path


@pytest.mark.parametrize(
    ("line", "named"),
    [
        ("run a.wav --out a.wav", "a.wav: expected another file"),
        ("run a.wav --out link.wav", "link.wav: expected another file"),
        (f"run {RECORDING} --out {RECORDING}/out_multi.wav", "expected another file"),
        ("run a.wav --array mics.xml --out mics.xml", "mics.xml"),
        ("run a.wav --out folder", "found a folder"),
        ("run a.wav --out pipe", "found a device or pipe"),
        ("run a.wav --out loop", "found a device or pipe"),
        ("run a.wav --out /dev/null", "found a device or pipe"),
        ("run a.wav --out missing/s.jsonl", "existing folder"),
        ("run a.wav --out a.wav/s.jsonl", "existing folder"),
        ("run a.wav --figure f.xyz", "f.xyz: expected a figure name"),
        ("run a.wav --figure folder.png", "found a folder"),
        ("array bearings a.wav --out a.wav", "a.wav: expected another file"),
        ("array check a.wav --figure a.wav", "expected a figure name"),
        ("model threshold a.wav m.json --out m.json", "m.json"),
        ("model threshold a.wav --out m2.json --save-streams m2.json", "save_streams"),
        (f"model threshold set --out {RECORDING}/out_multi.wav", "expected another file"),
        ("model fit t.csv --exclude ids.csv --out ids.csv", "ids.csv"),
        ("model features set --labels t.csv --out t.csv", "t.csv"),
        ("model detector v.mp4 --out v.mp4", "v.mp4"),
        ("model detector v.mp4 --out b.json --figure b.bmp", "b.bmp"),
        ("demo --out a.wav/demo", "a.wav"),
        ("demo --out taken", "taken/timeline.png: expected a file"),
        ("sim make --out a.wav", "a.wav"),
        # Boxes belong to one recording.
        ("array align a.wav link.wav --car car.json", "expected one recording with --detections or --car"),
        ("array align a.wav link.wav --detections boxes.json", "expected one recording with --detections"),
        ("street learn a.wav link.wav --car car.json --out s.json", "expected one recording with"),
        ("street learn a.wav link.wav --detections boxes.json --out s.json", "expected one recording with"),
        # Options without effect
        ("demo --out new --seed -1", "--seed: expected"),
        ("model fit t.csv --seed -1 --out m2.json", "--seed: expected"),
        ("model make --jobs 0 --out m2.json", "--jobs: expected"),
        ("model make --no-exam --figure f.png --out m2.json", "--figure: expected --exam with it"),
        ("model make --array xmos --array uma-8 --figure f.png --out m2", "--figure: expected one --array"),
        ("model make --array xmos --array xmos --out m2", "--array: expected each name once"),
        ("model make --exclude ids.csv --out m2.json", "--exclude: expected --labelled with it"),
        ("model make --source mine --out m2.json", "--source: expected --labelled with it"),
        ("model fit t.csv --sample-rate 16000 --out m2.json", "--sample-rate: expected --array with it"),
        ("sim make --out new --site SB1", "--site: expected --minutes with it"),
        ("sim make --out new --traffic busy", "--traffic: expected --minutes with it"),
        ("sim make --out new --video-width 320", "--video-width: expected --video with it"),
        ("sim make --out new --minutes 1 --kind tram", "--minutes: expected without --kind"),
        ("sim make --out new --minutes 1 --duration 5", "--minutes: expected without --duration"),
        ("sim make --out new --minutes 1 --scene merge --static 2", "without --static, --scene"),
        ("log plot m.json --animate a.gif --recording a.wav", "--recording: expected --out with it"),
        ("log plot m.json --out o.png --time 3", "--time: expected --birds-eye with it"),
        ("live --detector knn", "--detector: expected --camera-device with it"),
        ("live --detector knn --camera-device 0", "--array: expected the positions of the microphones"),
        ("sim make --out new --bandwidth 17000", "bandwidth_hz: expected a number in [700.0, 16000.0]"),
        ("sim make --out new --minutes 1 --bandwidth 17000", "--bandwidth: expected a number in [700.0, 16"),
        ("run a.wav --images 5", "--images: expected images, a key of COCO results in --detections in its"),
        ("log replay m.json --export mcap=b --export mcap=b", "b: expected another file"),
    ],
)
def test_bad_outputs_and_options_without_effect_raise_an_error_before_the_work(line, named, files, capsys):
    assert named in refusal(line.split(), files, capsys)


def test_reference_boxes_need_one_video(tmp_path, capsys):
    rows = [LogRow(f"1_00_000{number}", "SA1", "left", 5) for number in (0, 1)]
    for row in rows:
        (tmp_path / row.folder).mkdir(parents=True)
        for name in ("out_multi.wav", "ueye_stereo_vid.mp4", "camera_baseline_results.json"):
            (tmp_path / row.folder / name).write_text("{}")
    write_log(tmp_path, rows)
    words = ["model", "detector", str(tmp_path), "--reference", str(tmp_path / rows[0].folder)]
    said = refusal([*words, "--out", str(tmp_path / "b.json")], tmp_path, capsys)
    assert "--reference: expected one video with it, got 2" in said


@pytest.mark.parametrize(
    ("line", "extra"),
    [("sim make --out new --minutes 1", "matplotlib"), ("sim make --out new --static 1 --video", "cv2")],
)
def test_missing_packages_are_named_before_the_work(line, extra, files, capsys, monkeypatch):
    real = extras.find_spec
    monkeypatch.setattr(extras, "find_spec", lambda name: None if name == extra else real(name))
    assert "pip install" in refusal(line.split(), files, capsys)


def test_an_output_keeps_the_link_and_the_permissions_of_the_file_that_it_replaces(tmp_path):
    (tmp_path / "real").mkdir()
    link, private = tmp_path / "link.json", tmp_path / "real/model.json"
    link.symlink_to("real/model.json")
    write_text(link, "old")
    private.chmod(0o600)
    write_text(link, "new")
    assert link.is_symlink()
    assert private.read_text() == "new"
    assert private.stat().st_mode & 0o777 == 0o600


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may write everywhere")
def test_missing_permission_is_reported_before_the_work(files, capsys):
    Path("folder").chmod(0o500)
    assert "permission" in refusal(["run", "a.wav", "--out", "folder/s.jsonl"], files, capsys)
    Path("m.json").chmod(0o400)
    assert "permission" in refusal(["run", "a.wav", "--out", "m.json"], files, capsys)


@pytest.mark.parametrize("suffix", [".raw", ".au", ".ogg", ".mp3", ".wav", ".npz", ""])
@pytest.mark.parametrize("command", ["run", "array check", "model threshold"])
def test_bytes_that_are_no_sound_give_one_line(command, suffix, tmp_path, capsys):
    sound = tmp_path / f"f{suffix}"
    sound.write_bytes(np.random.default_rng(1).bytes(5000))
    out = ["--out", str(tmp_path / "m.json")] if command == "model threshold" else []
    assert str(sound) in refusal([*command.split(), str(sound), *out], tmp_path, capsys)


def test_a_full_standard_output_gives_one_line():
    for unbuffered in ("", "1"):  # The interpreter itself writes the buffer last.
        with Path("/dev/full").open("w") as full:
            done = subprocess.run(
                [*COMMAND, "array", "bounds"],
                stdout=full,
                stderr=subprocess.PIPE,
                text=True,
                check=False,
                env=os.environ | {"PYTHONUNBUFFERED": unbuffered},
            )
        assert done.returncode == 2 and len(done.stderr.strip().splitlines()) == 1, done.stderr
        assert "No space left" in done.stderr


def test_a_closed_pipe_is_no_error():
    line = " ".join([*COMMAND, "array", "bounds", "--json"])
    done = subprocess.run(
        ["bash", "-c", f"{line} | true; exit ${{PIPESTATUS[0]}}"], capture_output=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, b"")


def interrupted(words: list[str], begun, number: int) -> int:
    """Start a command, signal it (all its processes, as a terminal does on Ctrl-C) once `begun`."""
    # A signal that a shell ignores in the background (`nohup`) is inherited; Ctrl-C of a terminal is not.
    running = subprocess.Popen(
        [*COMMAND, *words],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    deadline = time.monotonic() + 60.0
    while not begun() and running.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    if number == signal.SIGINT:
        os.killpg(running.pid, number)
    else:
        running.send_signal(number)
    try:
        _, said = running.communicate(timeout=60.0)
    finally:
        # Kill a command that continues, because it would slow down all other tests.
        if running.poll() is None:
            os.killpg(running.pid, signal.SIGKILL)
    assert "Traceback" not in said
    return running.returncode


CODES = [(signal.SIGINT, 130), (signal.SIGTERM, 143)]
LATE = """
import os, signal, sys
from worldstate.ground.parallel import deferred_signals
def end(number, frame): raise SystemExit(128 + number)
for number in (signal.SIGINT, signal.SIGTERM): signal.signal(number, end)
with deferred_signals():
    os.kill(os.getpid(), int(sys.argv[1]))
    print("written", flush=True)
print("not reached")
"""


@pytest.mark.parametrize(("number", "code"), CODES)
def test_a_signal_waits_for_files_that_belong_together(number, code):
    command = [sys.executable, "-c", LATE, str(int(number))]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (code, "written\n"), done.stderr


@pytest.mark.long
@pytest.mark.parametrize(("number", "code"), CODES)
def test_an_interrupted_simulation_lists_its_recordings(number, code, tmp_path):
    words = ["sim", "make", "--out", str(tmp_path), "--static", "400", "--duration", "0.5", "--jobs", "2"]
    words += ["--bandwidth", "2000"]
    assert interrupted(words, (tmp_path / "DataLog.csv").exists, number) == code
    listed = {recording.path for recording in OvadDataset(tmp_path).recordings}
    assert listed == {path.parent for path in tmp_path.rglob("truth.json")}
    assert listed
    assert not list(tmp_path.rglob(".*"))


@pytest.mark.long
@pytest.mark.parametrize(("number", "code"), CODES)
def test_an_interrupted_run_leaves_nothing(number, code, tmp_path):
    sound = tmp_path / "long.wav"
    soundfile.write(sound, np.random.default_rng(1).normal(0, 0.1, (10 * 47_998, 56)), 47_998, "PCM_16")
    words = ["run", str(sound), "--out", str(tmp_path / "states.jsonl")]
    assert interrupted(words, lambda: list(tmp_path.glob(".states-*")), number) == code
    assert list(tmp_path.iterdir()) == [sound]


def test_a_second_simulation_keeps_the_recordings_of_the_log(tmp_path):
    write_log(tmp_path, [LogRow("3_01_0007", "SA2", "right", 70)])
    (tmp_path / "SA2/right/3_01_0007").mkdir(parents=True)
    words = ["sim", "make", "--out", str(tmp_path), "--duration", "0.5", "--static", "1"]
    assert main([*words, "--bandwidth", "2000"]) == 0
    listed = [recording.recording_id for recording in OvadDataset(tmp_path).recordings]
    assert listed == ["3_01_0007", "1_00_0000"]


@contextmanager
def within(seconds: int):
    """Raise TimeoutError if the block takes longer."""

    def end(number: int, frame: object) -> None:
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, end)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


BARE = "--array mics.csv --uncalibrated"
PIPES = {
    f"run pipe {BARE}": None,
    "run real.wav --uncalibrated --array pipe": None,
    **{f"run real.wav {BARE} --{name} pipe": None for name in ("model", "detections", "resume", "car")},
    f"run real.wav {BARE} --camera /dev/zero": None,
    **dict.fromkeys(("run bag.mcap", "run bag", "log replay bag.mcap", "log replay bag", "explain pipe")),
    f"run real.wav {BARE} --out o\0.jsonl": None,
    "array check real.wav --array mics.csv --figure f\0.png": None,
    "demo --out d\0": None,
    "live --play real.wav --array mics.csv --allow h\0st": None,
    f"live --play real.wav {BARE} --key pipe --odometry 127.0.0.1:0": None,
    "array file": {"array": {"file": "pipe"}},
    "array name": {"array": {"file": "mics\0.csv"}},
    "model file": {"array": {"file": "mics.csv"}, "model": "pipe"},
    "model name": {"array": {"file": "mics.csv"}, "model": "m\0.json"},
    "odometry file": {"array": {"file": "mics.csv"}, "odometry": "pipe"},
    "odometry name": {"array": {"file": "mics.csv"}, "odometry": "o\0.csv"},
}


@pytest.fixture
def real(street, files) -> Path:
    shutil.copy(street / "street.wav", "real.wav")
    shutil.copy(street / "mics.csv", "mics.csv")
    return files


@pytest.mark.parametrize("line", PIPES)
def test_pipes_devices_and_nul_names_raise_an_error_at_once(line, real, capsys):
    os.mkfifo("bag.mcap")
    Path("bag").mkdir()
    os.mkfifo("bag/bag.db3")
    information = {"version": 5, "storage_identifier": "sqlite3", "relative_file_paths": ["bag.db3"]}
    Path("bag/metadata.yaml").write_text(json.dumps({"rosbag2_bagfile_information": information}))
    if (car := PIPES[line]) is not None:
        Path("car.json").write_text(json.dumps(car))
        line = "run real.wav --car car.json --uncalibrated"
    with within(20):
        said = refusal(line.split(), real, capsys)
    assert "device or pipe" in said or "null byte" in said


HOSTS = "", "\udcff", "h" * 300, "..", "h" * 64 + ".org"
PORTS = "9" * 5, "9" * 4000, "9" * 5000, "-1", "x"


@pytest.mark.parametrize("option", ["--detections", "--odometry", "--export=odas", "--allow"])
def test_wrong_addresses_raise_an_error(option, real, capsys):
    live, port = f"live --play real.wav {BARE}".split(), "" if option == "--allow" else ":9000"
    given = [f"{host}{port}" for host in (HOSTS[1:] if option == "--allow" else HOSTS)]
    for one in [*given, *(f"127.0.0.1:{port}" for port in PORTS)] if port else given:
        assert main([*live, f"{option}={one}"]) == 2
        *notices, last = capsys.readouterr().err.splitlines()
        assert last.startswith("worldstate: ")
        assert notices == [] or option == "--odometry"


@pytest.mark.skipif(sys.platform in ("win32", "darwin"), reason="names are UTF-8 there")
@pytest.mark.parametrize("words", [["run", "--uncalibrated"], ["array", "check"]])
def test_a_sound_file_whose_name_is_no_text_is_read(words, real, capsys):
    shutil.copy("real.wav", name := os.fsdecode(b"caf\xe9.wav"))
    assert main([*words, name, "--array", "mics.csv"]) < 2
    assert "Traceback" not in capsys.readouterr().err


ODD = "\x1b[2J\x1b]0;mine\x07\x9b\u202e"


@pytest.mark.parametrize(
    "words",
    [
        ["run", f"{ODD}.wav"],
        ["run", "a.wav", "--array", ODD],
        ["run", "a.wav", f"--{ODD}"],
        [f"{ODD}"],
        ["explain", f"{ODD}.jsonl"],
        ["log", "replay", "log.jsonl"],
        ["explain", "log.jsonl"],
        ["live", "--play", "a.wav", "--allow", ODD],
    ],
)
def test_no_control_character_reaches_a_terminal(words, files, capsys):
    state = max(scripted_states(), key=lambda one: len(one.entities))
    entities = tuple(replace(one, classification=(Classification(ODD, 1.0),)) for one in state.entities)
    cues = tuple(replace(one, direction=f"left{ODD}") for one in state.cues)
    sensors = (SensorHealth(ODD, "impaired", state.stamp_ns, f"reason {ODD}"),)
    log = replace(state, entities=entities, cues=cues, sensors=sensors)
    Path("log.jsonl").write_text(log.to_json() + "\n")
    with suppress(SystemExit):
        main(words)
    printed = "".join(capsys.readouterr())
    assert printed
    assert [one for one in printed if not (one.isprintable() or one == "\n")] == []


LOGS = """import logging; from worldstate.cli.main import main; main(['--version'])
logging.getLogger('worldstate').warning('%s', chr(27) + '[2J')"""


def test_log_messages_are_escaped_for_a_terminal():
    done = subprocess.run([sys.executable, "-c", LOGS], capture_output=True, text=True, check=True)
    assert done.stderr == "\\x1b[2J\n"


def test_a_bar_and_a_view_show_names_as_they_are(monkeypatch, capsys):
    monkeypatch.setattr(progress, "can_draw", lambda: True)
    with progress.progress_bar(f"[/red] {ODD}", 10) as bar:
        bar.advance()
    assert "[2J" not in capsys.readouterr().err.replace("\\x1b[2J", "")


# Well-formed inputs of `run` without effect.
LENS = {"width_px": 1936, "height_px": 1216, "horizontal_fov_deg": 68.75, "position_m": [-0.57, 0, -0.49]}
FRONT = {"name": "front", **LENS}
EMPTY = {"boxes": [], "scores": [], "classes_str": []}
ASKED = {"detections_per_frame": [EMPTY] * 30}
TRUCK = {"boxes": [[10.0, 200.0, 400.0, 600.0]], "scores": [0.4], "classes_str": ["truck"]}
NOTHING = {"detections_per_frame": []}


def odometry(*times_s):
    return "time_s,speed_mps\n" + "".join(f"{time_s},0\n" for time_s in times_s)


CAMERAS = (
    {**FRONT, "detections": "asked.json"},
    {**FRONT, "name": "rear", "yaw_deg": 180, "detections": "nothing.json"},
)
# An option with its file, the content of the file, and the printed line.
SILENT = [
    ("--detections d.json", NOTHING, "searched no image"),
    ("--detections d.json", {"images": [{"id": 0}], "annotations": []}, "1 of 1 stamps"),
    ("--detections d.txt", "", "searched no image"),
    ("--detections d.json", {"detections_per_frame": [TRUCK] + [EMPTY] * 29}, "none of its boxes has"),
    ("--camera c.json", LENS, "--camera without --detections"),
    ("--car car.json", {"cameras": [FRONT]}, "cameras of --car without"),
    ("--car car.json", {}, "no array, camera, model, odometry or measurements"),
    ("--car car.json", {"name": "mine"}, "no array, camera"),
    ("--car car.json", {"cameras": CAMERAS}, "rear: the detector searched no image"),
    ("--context x.json", {}, "it is empty"),
    ("--odometry o.csv", odometry(), "at least one line"),
    ("--odometry o.csv", odometry(*range(0, 3000, 100)), "in another unit"),
    ("--resume state.json", None, "all of this sound was used before"),
]


@pytest.fixture(scope="module")
def heard(tmp_path_factory):
    """Return a folder with 3 s of noise, boxes, and the belief after them."""
    folder = tmp_path_factory.mktemp("heard")
    noise = np.random.default_rng(0).uniform(-0.01, 0.01, (144_000, 1))
    sound = noise + np.random.default_rng(1).uniform(-0.002, 0.002, (len(noise), 56))
    soundfile.write(folder / "a.wav", sound, 48_000)
    (folder / "asked.json").write_text(json.dumps(ASKED))
    (folder / "nothing.json").write_text(json.dumps(NOTHING))
    assert main(["run", str(folder / "a.wav"), "--save-state", str(folder / "state.json")]) == 0
    return folder


@pytest.mark.parametrize(("words", "content", "told"), SILENT)
def test_an_input_without_effect_gives_a_line(heard, words, content, told, monkeypatch, capsys, caplog):
    monkeypatch.chdir(heard)
    if content is not None:
        Path(words.split()[-1]).write_text(content if isinstance(content, str) else json.dumps(content))
    code = main(["run", "a.wav", *words.split()])
    said = capsys.readouterr().err + caplog.text
    assert code in (0, 2) and told in said, said


USED = "--detections asked.json", "--car asked_car.json", "--odometry steady.csv"


@pytest.mark.parametrize("words", ["", *USED, "--resume state.json --start 3"])
def test_an_input_with_an_effect_gives_no_line(heard, words, monkeypatch, capsys, caplog):
    monkeypatch.chdir(heard)
    Path("asked_car.json").write_text(json.dumps({"cameras": [{**FRONT, "detections": "asked.json"}]}))
    Path("steady.csv").write_text(odometry(*np.arange(0.0, 3.0, 0.1)))
    assert main(["run", "a.wav", *words.split()]) == 0
    assert [one.message for one in caplog.records if "no array is named" not in one.message] == []
    assert capsys.readouterr().err == ""
