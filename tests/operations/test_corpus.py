"""Tables of a corpus: content, independence of workers and kills, repeated runs and shadow hours."""

import json
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter, defaultdict
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scripted_states import scripted_states

from worldstate import ListenSettings, WorldState, hear
from worldstate.adapters import open_source, read_model
from worldstate.adapters.datasets.feature_extraction import read_labels
from worldstate.adapters.ros.bag_writer import bag_writer
from worldstate.adapters.ros.message_types import AUDIO, header
from worldstate.cli.main import main
from worldstate.commissioning.alarm_curve import raised_at
from worldstate.ground import InputFileError, InvalidArgumentError, nanoseconds
from worldstate.ground.errors import OutOfDomainError
from worldstate.operations import run_recording
from worldstate.operations.calibration.cueing_calibration import hop_streams, read_input
from worldstate.operations.corpus.approach_meter import LEFT_OUT, ApproachMeter
from worldstate.operations.corpus.corpus_inputs import CorpusInput, find_corpus
from worldstate.operations.corpus.corpus_run import AFTER_S, BEFORE_S, SAMPLED, kept_seconds
from worldstate.operations.corpus.corpus_tables import TABLES, StateHours, corpus_rows
from worldstate.operations.corpus.shadow import hours_to_prove, shadow_hours, write_shadow_page
from worldstate.operations.metrics.approach_table import rising_edges
from worldstate.operations.recordings.evidence_report import told_advisories
from worldstate.operations.recordings.hop_table import HopTable, hop_stream
from worldstate.operations.recordings.recording_report import RecordingReport, WarningMeter
from worldstate.state import Advisory, Context, RiskCue

pytest.importorskip("pyarrow")


@pytest.fixture(scope="module")
def corpus(street, tmp_path_factory) -> Path:
    """Return a folder with sound of two sites, a log of snapshots and a file that is no sound."""
    folder = tmp_path_factory.mktemp("corpus")
    for name in ("north/a.wav", "north/b.wav", "south/c.wav"):
        (folder / name).parent.mkdir(exist_ok=True)
        shutil.copy(street / "street.wav", folder / name)
    (folder / "south" / "broken.wav").write_text("no sound")
    lines = [state.to_json() for state in scripted_states()]
    (folder / "south" / "log.jsonl").write_text("\n".join([*lines, ""]))
    return folder


@pytest.fixture(scope="module")
def options(street) -> dict[str, object]:
    return {"array": street / "mics.csv", "settings": ListenSettings(uncalibrated=True)}


@pytest.fixture(scope="module")
def heard(corpus, options, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("heard") / "out"
    found = hear(corpus, out, **options)
    assert [one.status for one in found] == ["heard", "heard", "failed", "heard", "heard"]
    assert sum(one.sound_s for one in found) == pytest.approx(0.1 * (3 * 11 + 6))
    return out


def rows(out: Path, table: str) -> list:
    return list(corpus_rows(out, TABLES[table]))


def words_of(corpus: Path, street: Path, out: Path) -> list[str]:
    """Return the words of the command with the options of `heard`."""
    given = ["--array", str(street / "mics.csv"), "--uncalibrated", "--out", str(out)]
    return ["hear", str(corpus), *given]


def contents(out: Path) -> dict[str, bytes]:
    files = (one for one in out.rglob("[!.]*") if one.is_file())
    return {str(one.relative_to(out)): one.read_bytes() for one in files}


def test_an_array_without_a_model_gives_no_scores(street, tmp_path):
    (tmp_path / "in").mkdir()
    shutil.copy(street / "street.wav", tmp_path / "in" / "a.wav")
    (found,) = hear(tmp_path / "in", tmp_path / "out", array=street / "mics.csv", hops=True)
    assert found.status == "heard", found.failure
    hops = rows(tmp_path / "out", "hops")
    assert len(hops) == 11 and {(one.signature, one.risk, one.level_left) for one in hops} == {(None,) * 3}
    assert all(json.loads(one.snapshot)["no_model"] for one in hops)
    assert rows(tmp_path / "out", "approaches") == []
    (recording,) = rows(tmp_path / "out", "recordings")
    assert (recording.hops, recording.heard, recording.usable, recording.onsets) == (11, 0, 0, 0)
    assert {one.unheard for one in rows(tmp_path / "out", "hours")} == {"no model"}
    with pytest.raises(OutOfDomainError, match="another model"):
        read_input(tmp_path / "out")


@pytest.fixture(scope="module")
def demo(approach, tmp_path_factory) -> tuple[Path, RecordingReport, HopTable]:
    """Return the corpus tables of the demo approach, and the report and hop stream of `run`."""
    folder, measured = tmp_path_factory.mktemp("demo"), []
    hear(approach.folder, folder / "heard", hops=True)
    report = run_recording(
        open_source(approach.folder),
        states_path=folder / "states.jsonl",
        on_hop=lambda step: measured.append(step.measurement),
    )
    return folder, report, hop_stream(measured, name="demo")


def test_a_corpus_has_the_advisories_of_run_and_the_seen_vehicle(demo):
    folder, report, _ = demo
    (recording,), approaches = rows(folder / "heard", "recordings"), rows(folder / "heard", "approaches")
    assert (recording.hops, recording.failure) == (report.hops, None)
    assert recording.onsets == len(report.warning.advisory_onsets_s)
    assert {one.time_s for one in approaches} >= {*report.warning.advisory_onsets_s}
    # The van of the demo comes from the right and is detected by the camera.
    (van,) = (one for one in approaches if one.seen)
    assert van.side == "right" and van.label == "car"
    assert van.lead_s == pytest.approx(van.seen_s - van.time_s) and 1.0 < van.lead_s < 5.0


def test_tables_of_hops_and_logs_of_run_are_read_alike(demo, capsys):
    folder, _, _ = demo
    (hops,) = (folder / "heard" / "hops").glob("*.parquet")
    logs = hops, folder / "states.jsonl"
    printed = [(main(["explain", str(log)]), capsys.readouterr().out) for log in logs]
    assert printed[0] == printed[1] and printed[0][0] == 0
    assert main(["log", "replay", str(hops), "--out", str(folder / "again.jsonl")]) == 0
    assert (folder / "again.jsonl").read_text() == (folder / "states.jsonl").read_text()


def test_a_file_that_is_no_table_of_hops_raises_an_error(demo, tmp_path, capsys):
    (tmp_path / "a.parquet").write_text("no table")
    (recording,) = (demo[0] / "heard" / "recordings").glob("*.parquet")
    for log in (tmp_path / "a.parquet", recording):
        assert main(["explain", str(log)]) == 2
        assert "expected a table of hops with snapshots" in capsys.readouterr().err


def test_thresholds_on_hops_equal_those_on_sound(demo, tmp_path, capsys):
    folder, report, stream = demo
    (heard,) = hop_streams(folder / "heard")
    for name, column in stream.columns.items():
        np.testing.assert_array_equal(heard.columns[name], column)
    # At the threshold of the run the curve has the onsets of the filter.
    model = read_model()
    levels = np.nan_to_num(np.column_stack([heard.level_left, heard.level_right]), nan=-np.inf)
    raised = raised_at(levels, model.sequence.alarm.threshold_nats)
    assert rising_edges(raised).size == len(report.warning.advisory_onsets_s)
    words = ["model", "threshold", str(folder / "heard"), "--out", str(tmp_path / "mine.json")]
    assert main(words) == 2
    assert "budget: expected 0.10 hours for 30 onsets per hour, got 0.00" in capsys.readouterr().err
    assert main([*words, "--budget", "1200"]) == 0
    assert read_model(tmp_path / "mine.json").sequence.curve.hours == pytest.approx(report.hops / 36_000)


def test_labels_of_windows_equal_those_of_camera_tracks(demo, approach, tmp_path):
    root = tmp_path / "root"
    shutil.copytree(approach.folder, root / "SB1" / "right" / "demo")
    recording = str(root / "SB1" / "right" / "demo")
    words = ["street", "label", recording, "--environment", "SB1", "--out", str(tmp_path / "labels.json")]
    assert main([*words, "--windows", str(root / "smoothed.csv")]) == 0
    hear(root, tmp_path / "heard")
    assert main(["street", "label", str(tmp_path / "heard"), "--windows", str(root / "heard.csv")]) == 0
    smoothed, heard = (read_labels(root / name, root) for name in ("smoothed.csv", "heard.csv"))
    assert [one.label for one in heard] == [one.label for one in smoothed] == ["right", "front", "none"]
    for one, other in zip(heard, smoothed, strict=True):
        assert one.end_s == pytest.approx(other.end_s, abs=0.3) and one.path == other.path


def test_without_a_camera_no_window_is_labelled_empty(heard, tmp_path):
    words = ["street", "label", str(heard), "--windows", str(tmp_path / "labels.csv")]
    assert main(words) == 0
    assert len((tmp_path / "labels.csv").read_text().splitlines()) == 1
    assert main([*words, "--out", str(tmp_path / "labels.json")]) == 2


def test_thresholds_without_hops_raise_an_error(heard, tmp_path, capsys):
    assert main(["model", "threshold", str(heard), "--out", str(tmp_path / "mine.json")]) == 2
    assert "expected hops of sound: `worldstate hear --hops` writes them" in capsys.readouterr().err


def test_an_unreadable_recording_is_a_row_with_its_error(heard):
    failed = [row for row in rows(heard, "recordings") if row.failure]
    assert [(row.recording, row.site, row.hops) for row in failed] == [("south/broken.wav", "south", 0)]
    assert failed[0].failure.startswith("south/broken.wav: expected WAV")


def test_sound_and_its_bag_give_the_same_rows(street, options, tmp_path):
    pytest.importorskip("rosbags")
    samples, rate_hz = soundfile.read(street / "street.wav", dtype="float32")
    shutil.copy(street / "street.wav", tmp_path / "a.wav")
    form = {"sample_rate": rate_hz, "channels": samples.shape[1], "layout": "interleaved"}
    with bag_writer(tmp_path / "bag") as write:
        for start in range(0, len(samples), rate_hz // 10):
            stamp_ns = 1_764_000_000 * 10**9 + start * (10**9 // rate_hz)
            data = samples[start : start + rate_hz // 10].ravel()
            write("/mics", AUDIO, stamp_ns, {"header": header(stamp_ns), "data": data} | form)
    (storage,) = (tmp_path / "bag").glob("*.mcap")
    shutil.copy(storage, tmp_path / "alone.mcap")
    hear(tmp_path, tmp_path / "heard", hops=True, **options)
    scores = defaultdict(list)
    for row in rows(tmp_path / "heard", "hops"):
        scores[row.recording].append(row.log_likelihoods)
    assert {*scores} == {"a.wav", "alone.mcap", "bag"}
    assert scores["a.wav"] == scores["alone.mcap"] == scores["bag"]
    # Only messages have the time of day.
    days = {row.recording: row.day for row in rows(tmp_path / "heard", "hours")}
    assert days == {"a.wav": None, "alone.mcap": "2025-11-24", "bag": "2025-11-24"}


def test_the_reference_lists_every_column():
    page = (Path(__file__).parents[2] / "docs" / "reference" / "viewer_formats.md").read_text("utf-8")
    told = dict(re.findall(r"^\| `(\w+)`[^|]*\|[^|]*\| (.*) \|$", page, flags=re.M))
    for table, kind in TABLES.items():
        columns = {one.name for one in fields(kind)} - {"recording", "site"}
        assert columns == set(re.findall(r"`(\w+)`", told[table]))


WAYS = {"two processes": {"jobs": 2}, "threads": {"executor": ThreadPoolExecutor(3)}}


@pytest.mark.parametrize("way", WAYS)
def test_tables_do_not_depend_on_the_workers_and_the_folder(way, corpus, options, heard, tmp_path):
    shutil.copytree(corpus, tmp_path / "moved")
    hear(tmp_path / "moved", tmp_path / "out", **options, **WAYS[way])
    assert contents(tmp_path / "out") == contents(heard)


def test_shards_add_up_to_the_whole(corpus, options, heard, tmp_path):
    shares = [hear(corpus, tmp_path, shard=(number, 3), **options) for number in (1, 2, 3)]
    names = sorted(one.recording for share in shares for one in share)
    assert names == [one.name for one in find_corpus(corpus)]
    assert contents(tmp_path) == contents(heard)


def test_a_second_run_reads_only_new_and_changed_files(corpus, options, street, tmp_path):
    shutil.copytree(corpus, tmp_path / "corpus")
    hear(tmp_path / "corpus", tmp_path / "out", **options)
    before = contents(tmp_path / "out")
    again = hear(tmp_path / "corpus", tmp_path / "out", **options)
    assert [one.status for one in again] == ["there"] * 5
    assert contents(tmp_path / "out") == before
    changed = tmp_path / "corpus" / "north" / "a.wav"
    samples, rate_hz = soundfile.read(changed)
    soundfile.write(changed, 0.5 * samples, rate_hz)
    shutil.copy(street / "street.wav", tmp_path / "corpus" / "d.wav")
    third = hear(tmp_path / "corpus", tmp_path / "out", **options)
    assert {one.recording for one in third if one.status == "heard"} == {"north/a.wav", "d.wav"}
    # Nothing else of the changed file remains, so no hour counts twice.
    assert len([row for row in rows(tmp_path / "out", "recordings") if row.recording == "north/a.wav"]) == 1


def test_temporary_failures_are_retried(corpus, options, heard, tmp_path, monkeypatch):
    from worldstate.operations.corpus import corpus_run

    def fails(*given: object) -> None:
        raise OSError("the disk of the network is away")

    with monkeypatch.context() as patched:
        patched.setattr(corpus_run, "listen_steps", fails)
        assert [one.status for one in hear(corpus, tmp_path, **options)].count("failed") == 4
    assert any("the disk of the network" in (row.failure or "") for row in rows(tmp_path, "recordings"))
    assert [one.status for one in hear(corpus, tmp_path, **options)].count("heard") == 3
    assert contents(tmp_path) == contents(heard)


OTHERS = {
    "{'hops': True}": {"hops": True},
    "other options": {"settings": ListenSettings(uncalibrated=True, budget=3.0)},
    "{'model': 'uma-8.json.gz', 'array': 'uma-8'}": {"array": "uma-8"},
}


@pytest.mark.parametrize("named", OTHERS)
def test_a_folder_begun_with_other_options_raises_an_error(named, corpus, options, heard):
    with pytest.raises(InputFileError, match=f"settings of its first run, got {named}: another --out"):
        hear(corpus, heard, **options | OTHERS[named])


def test_a_manifest_has_sites_and_detections(corpus, tmp_path):
    lines = "path,site,detections", "south/c.wav,elm street,", "north/a.wav,,boxes.json", ""
    (corpus / "list.csv").write_text("\n".join(lines))
    first, second = find_corpus(corpus / "list.csv")
    assert (first.name, first.site, first.detections) == ("north/a.wav", "", corpus / "boxes.json")
    assert (second.path, second.site, second.detections) == (corpus / "south/c.wav", "elm street", None)


WRONG = [("file\na.wav\n", "missing path"), ("path\na.wav\na.wav\n", "a.wav twice"), ("path\n", "got none")]


@pytest.mark.parametrize(("text", "problem"), WRONG)
def test_wrong_manifests_raise_an_error(text, problem, tmp_path):
    (tmp_path / "list.csv").write_text(text)
    with pytest.raises(InputFileError, match=problem):
        find_corpus(tmp_path / "list.csv")


def test_wrong_options_raise_an_error(corpus, options, tmp_path):
    with pytest.raises(InvalidArgumentError, match="shard: expected"):
        hear(corpus, tmp_path, shard=(4, 3), **options)
    with pytest.raises(InvalidArgumentError, match="cascade: expected it without hops"):
        hear(corpus, tmp_path, cascade=True, hops=True, **options)


def states_of(raised: list[set[str]]) -> list[WorldState]:
    """Return one state per hop with advisories of the given sides from their onsets."""
    states, since = [], dict[str, int]()
    for hop, sides in enumerate(raised, start=1):
        stamp_ns = nanoseconds(0.1 * hop)
        since = {side: since.get(side, stamp_ns) for side in sides}
        told = {side: Advisory(since_ns, stamp_ns) for side, since_ns in since.items()}
        each = ((side, told.get(side)) for side in ("left", "right"))
        cues = tuple(RiskCue(side, 0.9, 0.3, 0.5, 0.9, 0.9, 1.0, None, one) for side, one in each)
        states.append(WorldState(stamp_ns, hop, context=Context(), cues=cues))
    return states


@given(st.lists(st.sets(st.sampled_from(["left", "right"])), min_size=1, max_size=30))
def test_approaches_and_onsets_equal_those_of_explain_and_run(raised):
    states = states_of(raised)
    meter, warnings = ApproachMeter("a", ""), WarningMeter(None)
    for state in states:
        meter.update(state)
        warnings.update(state)
    told, _ = told_advisories(states)
    found = {(one.side, nanoseconds(one.time_s), nanoseconds(one.end_s)) for one in meter.approaches}
    assert found == {(one.direction, one.since_ns, one.last_ns) for one in told}
    assert meter.recording("").onsets == len(warnings.summary().advisory_onsets_s)
    assert sum(row.hops for row in meter.hours()) == len(states)


def test_an_unannounced_vehicle_is_an_approach():
    *_, in_view, _ = scripted_states()
    meter = ApproachMeter("a", "")
    meter.update(replace(in_view, cues=()))
    (missed,) = meter.approaches
    assert (missed.side, missed.time_s, missed.seen, missed.lead_s) == ("left", None, True, None)


def test_shadow_hours_are_those_of_completed_recordings(corpus, heard, street, tmp_path, capsys):
    out = tmp_path / "out"
    shutil.copytree(heard, out)
    words = words_of(corpus, street, out)
    # A kill leaves tables without the row of the recording.
    killed = next(iter((out / "recordings").glob("*.parquet")))
    (out / "hours" / killed.name).with_stem("f" * 16 + "-left").write_bytes(b"")
    assert main([*words, "--shadow", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    (everything,) = report["hours"]["all"]
    hops = sum(row.hops for row in rows(heard, "recordings"))
    assert everything["heard_hours"] + everything["unheard_hours"] == pytest.approx(hops / 36_000)
    assert {one["name"] for one in report["hours"]["site"]} == {"north", "south"}
    assert "north" in (out / "shadow.html").read_text()


@pytest.fixture(scope="module")
def quiet(street, tmp_path_factory) -> Path:
    """Return a folder with 2 x 30 s of incoherent noise in which a common sound lasts 3 s."""
    folder = tmp_path_factory.mktemp("quiet")
    sound = np.random.default_rng(1).normal(0.0, 0.01, (240_000, 4))
    sound[120_000:144_000] += np.random.default_rng(2).normal(0.0, 0.02, (24_000, 1))
    whole = next(name for name in map("{}.wav".format, range(999)) if sampled(name))
    for name in ("part.wav", whole):
        soundfile.write(folder / name, sound, 8_000, subtype="PCM_24")
    assert not sampled("part.wav")
    return folder


def sampled(name: str) -> bool:
    return int(CorpusInput(name, Path(name), "").key, 16) % SAMPLED == 0


def test_a_cascade_reads_loud_sound_and_its_surroundings(quiet, options, tmp_path):
    part = open_source(quiet / "part.wav", **options)
    assert np.flatnonzero(kept_seconds(part)).tolist() == [*range(15 - BEFORE_S, 18 + AFTER_S)]
    hear(quiet, tmp_path, cascade=True, **options)
    hops = defaultdict(Counter)
    for row in rows(tmp_path, "hours"):
        hops[row.recording][row.unheard] += row.hops
    whole = next(name for name in hops if sampled(name))
    assert hops["part.wav"][LEFT_OUT] == 10 * (30 - 3 - BEFORE_S - AFTER_S)
    assert hops["part.wav"].total() == pytest.approx(hops[whole].total(), abs=10)
    assert LEFT_OUT not in hops[whole]


def test_the_recall_of_a_cascade_is_measured_on_whole_recordings():
    meter, kept = ApproachMeter("a", ""), np.arange(21) == 16
    for state in states_of([{"left"} if hop in (50, 150) else set() for hop in range(200)]):
        meter.update(state)
    meter.cascaded(kept, sampled=True)
    assert [(round(one.time_s, 1), one.kept) for one in meter.approaches] == [(5.1, False), (15.1, True)]


@pytest.mark.long
def test_tables_are_equal_with_two_workers_of_dask(corpus, street, heard, tmp_path):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(2, threads_per_worker=1, dashboard_address=None) as cluster:
        words = words_of(corpus, street, tmp_path)
        assert main([*words, "--scheduler", cluster.scheduler_address]) == 0
        assert contents(tmp_path) == contents(heard)


def test_a_wrong_scheduler_raises_an_error(corpus, tmp_path, capsys, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("worldstate.cli.hear._CONNECT_S", 0.1)
    words = ["hear", str(corpus), "--out", str(tmp_path), "--scheduler", "tcp://127.0.0.1:9"]
    assert main(words) == 2
    assert "--scheduler: expected a Dask scheduler, tcp://127.0.0.1:9: " in capsys.readouterr().err


@pytest.mark.long
def test_tables_are_equal_after_ten_kills(corpus, street, heard, tmp_path):
    words, finished = words_of(corpus, street, tmp_path), 0
    for kill in range(10):
        jobs = ["--jobs", "2"] if kill in (4, 7) else []
        with subprocess.Popen([sys.executable, "-m", "worldstate", *words, *jobs]) as run:
            deadline = time.monotonic() + 60.0
            # Each kill comes later: before the first file, between files, within one.
            while run.poll() is None and time.monotonic() < deadline:
                if len([*tmp_path.glob("*/*.parquet")]) >= kill:
                    run.send_signal(signal.SIGKILL if kill % 2 else signal.SIGTERM)
                    break
                time.sleep(0.002)
        finished += run.returncode == 0
    assert finished < 10
    assert main([*words, "--json"]) == 0
    assert contents(tmp_path) == contents(heard)
    assert json.loads((tmp_path / "corpus.json").read_text())["array"] == "mics.csv"


HOURS = st.builds(
    StateHours,
    recording=st.just("a.wav"),
    site=st.sampled_from(["", "elm street", "oak street"]),
    day=st.sampled_from([None, "2026-11-28", "2026-11-29"]),
    sensors=st.sampled_from(["acoustic working", "acoustic working, camera silent"]),
    unheard=st.sampled_from([None, "wind", "clipped"]),
    hops=st.integers(1, 100_000),
    onsets=st.integers(0, 20),
)


@given(st.lists(HOURS, min_size=1))
def test_all_groupings_have_the_same_hours_and_onsets(rows):
    week = shadow_hours(rows, budget=30.0)
    heard = sum(row.hops for row in rows if row.unheard is None) / 36_000
    for group in week.values():
        assert sum(one.onsets for one in group) == sum(row.onsets for row in rows)
        assert sum(one.heard_hours for one in group) == pytest.approx(heard)
        total = sum(one.heard_hours + one.unheard_hours for one in group)
        assert total == pytest.approx(sum(row.hops for row in rows) / 36_000)
    (everything,) = week["all"]
    if heard:
        n, low = everything.onsets, stats.chi2.ppf(0.025, 2 * everything.onsets)
        assert everything.high == pytest.approx(stats.chi2.ppf(0.975, 2 * n + 2) / 2 / heard)
        assert everything.low == pytest.approx(low / 2 / heard if n else 0.0)


@given(st.integers(0, 50), st.floats(0.1, 1e4), st.floats(0.01, 100.0))
def test_hours_to_prove_a_budget_are_the_fewest(onsets, hours, budget):
    more = hours_to_prove(onsets, hours, budget)
    if onsets >= budget * hours:
        assert more is None
        return
    upper = stats.chi2.ppf(0.975, 2 * onsets / hours * (hours + more) + 2) / 2 / (hours + more)
    assert upper <= budget * (1.0 + 1e-4)
    if more:
        assert upper == pytest.approx(budget, rel=1e-3)


def test_the_shadow_page_escapes_names_and_counts_omitted_rows(tmp_path):
    rows = [StateHours("a", f"<script>{i}", None, "acoustic working", None, 36_000, i) for i in range(50)]
    write_shadow_page(tmp_path / "week.html", shadow_hours(rows, None), "fleet & co")
    page = (tmp_path / "week.html").read_text()
    assert "<script" not in page and "&lt;script&gt;0" in page and "fleet &amp; co" in page
    assert "<caption>10 more</caption>" in page
