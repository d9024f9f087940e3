"""One evaluation on one or several processes: the same tables, even after interruptions."""

import os
import subprocess
import sys
import time
import tracemalloc
from pathlib import Path

import pytest
from attempt_work import Levels, write_sounds
from worldstate_lab.trials.pass_cache import Failed, attempted


def plain(outcome):
    """Return the content of an outcome, bit for bit."""
    if isinstance(outcome, Failed):
        return outcome
    return outcome.name, {name: column.tobytes() for name, column in outcome.columns.items()}


@pytest.mark.long
def test_any_number_of_processes_gives_the_same_and_reports_the_broken_recording(tmp_path):
    paths = write_sounds(tmp_path / "sounds", 6)
    paths[2].write_bytes(b"no sound")
    paths[4].unlink()
    found = {}
    for name, jobs in (("one", 1), ("two", 2)):
        # A separate cache, so that no result of the previous run is reused.
        work = Levels(tmp_path / name / "cache")
        work.folder.mkdir(parents=True)
        found[name] = [plain(one) for one in attempted(work, paths, jobs, name=lambda path: path.stem)]
        assert sorted((tmp_path / name / "log").read_text().split()) == [f"{i}.wav" for i in (0, 1, 2, 3, 5)]
    assert found["one"] == found["two"]
    failed = [one for one in found["one"] if isinstance(one, Failed)]
    assert [one.name for one in failed] == ["2", "4"]
    assert f"{paths[2]}: expected a sound file" in failed[0].problem
    assert str(paths[4]) in failed[1].problem


@pytest.mark.long
@pytest.mark.parametrize("jobs", [1, 2])
def test_a_programming_error_is_not_a_broken_recording(jobs):
    with pytest.raises(TypeError, match="has no len"):
        list(attempted(len, [[0], 1, [2]], jobs))


RUN = """
import sys
from pathlib import Path
from attempt_work import Levels
from worldstate_lab.trials.pass_cache import attempted
folder, pause_s = Path(sys.argv[1]), float(sys.argv[2])
paths = sorted((folder / "sounds").iterdir())
for one in attempted(Levels(folder / "cache", pause_s), paths, 2):
    print(one.name, one.level.tobytes().hex(), one.gram.tobytes().hex(), flush=True)
"""


def start(folder, pause_s):
    command = [sys.executable, "-c", RUN, str(folder), str(pause_s)]
    paths = os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])
    environment = os.environ | {"PYTHONPATH": paths}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, env=environment, start_new_session=True, **pipes)


@pytest.mark.long
def test_an_interrupted_run_resumes_with_the_same_result(tmp_path):
    write_sounds(tmp_path / "sounds", 8, seconds=1)
    (tmp_path / "cache").mkdir()
    run = start(tmp_path, 0.4)
    for _ in range(3):
        run.stdout.readline()
    asked = time.monotonic()
    run.kill()
    # The pipe closes when the last process of the run, workers included, has ended.
    run.communicate(timeout=20.0)
    assert run.returncode != 0
    assert time.monotonic() - asked < 10.0
    assert not list(tmp_path.rglob(".*"))
    kept = len(list((tmp_path / "cache" / "levels").glob("*.sum")))
    assert 3 <= kept < 8

    (tmp_path / "log").unlink()
    said, problem = start(tmp_path, 0.0).communicate(timeout=60.0)
    assert problem == ""
    assert len((tmp_path / "log").read_text().split()) == 8 - kept
    (fresh := tmp_path / "fresh" / "cache").mkdir(parents=True)
    whole = attempted(Levels(fresh), sorted((tmp_path / "sounds").iterdir()), 1)
    told = [(one.name, one.level.tobytes().hex(), one.gram.tobytes().hex()) for one in whole]
    assert said.splitlines() == [" ".join(one) for one in told]


def test_memory_does_not_grow_with_the_number_of_recordings(tmp_path):
    paths = write_sounds(tmp_path / "sounds", 24)

    def peak(n):
        work = Levels(tmp_path / str(n) / "cache")
        work.folder.mkdir(parents=True)
        tracemalloc.start()
        try:
            kept = list(attempted(work, paths[:n], 1))
            return len(kept), tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    peak(1)  # One-time imports and caches are excluded
    (few, small), (many, large) = peak(2), peak(24)
    assert (few, many) == (2, 24)
    # The samples of 22 more recordings would need 45 MB; their tables need 5 kB each.
    assert small > 2 << 20
    assert large - small < 1 << 20
