"""Work in processes: order, errors and end of workers."""

import os
import pickle
import signal
import subprocess
import sys
import time

import pytest

from worldstate.adapters.files.model_file import read_model
from worldstate.ground.errors import InputFileError, MissingExtraError, SchemaVersionError, WorldstateError
from worldstate.ground.parallel import in_processes


@pytest.mark.parametrize("jobs", [1, 3])
def test_results_have_the_order_of_the_items(jobs):
    items = [-3, 1, 0, -2, 5]
    assert list(in_processes(abs, items, jobs)) == [3, 1, 0, 2, 5]


@pytest.mark.parametrize("jobs", [1, 2])
def test_errors_of_the_work_are_raised_unchanged(jobs):
    with pytest.raises(InputFileError, match=r"^missing\.json: ") as caught:
        list(in_processes(read_model, ["missing.json"] * 2, jobs))
    assert caught.value.path == "missing.json"


@pytest.mark.parametrize(
    "error",
    [InputFileError("a.wav", "bad"), SchemaVersionError("a", "old"), MissingExtraError("cv2", "vision")],
)
def test_errors_can_be_pickled(error):
    sent = pickle.loads(pickle.dumps(error))
    assert (type(sent), str(sent), vars(sent)) == (type(error), str(error), vars(error))


def test_the_death_of_a_worker_raises_an_error():
    with pytest.raises(WorldstateError, match="ended before its work was done"):
        list(in_processes(os._exit, [1, 1], 2))


SLEEPERS = """
import time
from worldstate.ground.parallel import in_processes
for _ in in_processes(time.sleep, [0.0, 0.0, 60.0, 60.0], 2): print("one", flush=True)
"""

# Workers without SIGTERM, which may be missed between two pieces of work.
DEAF = """
import signal, time
from functools import partial
from operator import call
from worldstate.ground.parallel import in_processes
items = [partial(signal.signal, signal.SIGTERM, signal.SIG_IGN)] * 2 + [partial(time.sleep, 60.0)] * 2
for _ in in_processes(call, items, 2): print("one", flush=True)
"""


def alive(session):
    """Return the number of running processes of a session."""
    listed = subprocess.run(["ps", "-o", "pid=", "--sid", str(session)], capture_output=True, check=False)
    return len(listed.stdout.split())


@pytest.mark.parametrize(
    ("number", "script"),
    [(signal.SIGTERM, SLEEPERS), (signal.SIGKILL, SLEEPERS), (signal.SIGKILL, DEAF)],
    ids=["SIGTERM", "SIGKILL", "deaf"],
)
def test_workers_end_with_the_process_that_started_them(number, script):
    command = [sys.executable, "-c", script]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, start_new_session=True
    ) as run:
        run.stdout.readline()
        run.stdout.readline()
        assert alive(run.pid) >= 3
        run.send_signal(number)
        assert run.wait(timeout=20.0) != 0
        deadline = time.monotonic() + 20.0
        while alive(run.pid) and time.monotonic() < deadline:
            time.sleep(0.05)
        assert alive(run.pid) == 0
