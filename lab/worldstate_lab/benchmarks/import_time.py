"""How long the imports take, each in a fresh interpreter, best of several; wall and CPU time.

python -m worldstate_lab.benchmarks.import_time
"""

import subprocess
import sys

STATEMENTS = (
    "import worldstate",
    "import worldstate; worldstate.WorldFilter",
    "import worldstate; worldstate.WorldFilter().predict(0.1).state",
    "import worldstate; worldstate.AcousticAdapter",
    "import worldstate; worldstate.listen",
    "import worldstate.cli.main",
)
REPEATS = 7


def best_s(statement: str) -> tuple[float, ...]:
    """Return the shortest wall and CPU time of a statement, without the interpreter's start."""
    timed = (
        f"import time; t, c = time.perf_counter(), time.process_time(); {statement}; "
        "print(time.perf_counter() - t, time.process_time() - c)"
    )
    command = [sys.executable, "-c", timed]
    runs = [subprocess.run(command, capture_output=True, text=True, check=True) for _ in range(REPEATS)]
    return tuple(min(float(run.stdout.split()[k]) for run in runs) for k in range(2))


if __name__ == "__main__":
    for statement in STATEMENTS:
        wall_s, cpu_s = best_s(statement)
        print(f"{wall_s:6.3f} s, CPU {cpu_s:6.3f} s  {statement}")
