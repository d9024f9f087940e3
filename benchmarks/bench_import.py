"""How long the imports take, each in a fresh interpreter, best of several; the issue allows .25 s.

python benchmarks/bench_import.py
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


def best_s(statement: str) -> float:
    """Return the shortest time of a statement, without the interpreter's start."""
    timed = f"import time; t = time.perf_counter(); {statement}; print(time.perf_counter() - t)"
    command = [sys.executable, "-c", timed]
    runs = [subprocess.run(command, capture_output=True, text=True, check=True) for _ in range(REPEATS)]
    return min(float(run.stdout) for run in runs)


if __name__ == "__main__":
    for statement in STATEMENTS:
        print(f"{best_s(statement):6.3f} s  {statement}")
