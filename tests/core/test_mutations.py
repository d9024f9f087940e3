"""The tests of the core detect 90 % of the mutations of the library in `mutations.json`.

A mutation is a plausible error of sign, factor or order: its area, file, old text (which occurs once), new
text and the test most likely to fail. As a program, this file applies every mutation to a copy of the library
and prints the test that fails. The listed test runs first; if it passes, all others of the core run. Each
run is a forked process, because importing the external packages takes longer than most tests.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[2]
EXPECTED, EXAMPLE = 0.9, "Example: python tests/core/test_mutations.py --area belief --only 5"
_SCIPY = ("scipy.linalg", "scipy.optimize", "scipy.stats", "scipy.signal")
_ELSEWHERE = (*_SCIPY, "hypothesis", "jsonschema", "pytest")


class Mutation(NamedTuple):
    """One line of `mutations.json`."""

    area: str
    file: str
    old: str
    new: str
    test: str

    @property
    def name(self) -> str:
        return f"{self.file}: {self.old} -> {self.new}"


MUTATIONS = [Mutation(*row) for row in json.loads(Path(__file__).with_name("mutations.json").read_text())]
Stages = list[tuple[str, ...]]
AREAS = ("belief", "association", "alarm", "hearing")


def copied(root: Path) -> None:
    """Copy the tracked top-level files and folders, links as links."""
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in {line.split("/")[0] for line in listed.splitlines()}:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, root / name, symlinks=True)
        else:
            shutil.copy2(ROOT / name, root / name)


def noticed_by(root: Path, tests: tuple[str, ...], limit_s: float) -> str | None:
    """Return the first failing test or a timeout; None if all pass."""
    out = root / "out.txt"
    child = os.fork()
    if child == 0:
        with out.open("w") as file:
            os.dup2(file.fileno(), 1), os.dup2(file.fileno(), 2)
        os.chdir(root)
        os.environ["PYTHONPATH"] = f"{root}:{root / 'lab'}"
        sys.path[:0] = [str(root), str(root / "lab")]
        plain = ("-q", "-x", "--tb=no", "-rfE", "-p", "no:xdist", "-p", "no:cacheprovider")
        os._exit(import_module("pytest").main([*plain, *tests]))
    ends_s = time.monotonic() + limit_s
    while (done := os.waitpid(child, os.WNOHANG))[0] == 0:
        if time.monotonic() > ends_s:
            os.kill(child, 9)
            os.waitpid(child, 0)
            return f"no end within {limit_s:.0f} s"
        time.sleep(0.1)
    if done[1] == 0:
        return None
    lines, code = out.read_text().splitlines(), os.waitstatus_to_exitcode(done[1])
    if code in (4, 5):
        raise SystemExit(f"no such test: {tests}")
    first = (line.split(" - ")[0] for line in lines if line.startswith(("FAILED", "ERROR")))
    return next(first, f"pytest ended with {code}")


def mutated(root: Path, one: Mutation, stages: Stages, limit_s: float) -> str | None:
    """Return the test that detects a mutation, or None."""
    path = root / one.file
    stat, text = path.stat(), path.read_text()
    assert text.count(one.old) == 1, one.name
    path.write_text(text.replace(one.old, one.new))
    noticed = next(filter(None, (noticed_by(root, tests, limit_s) for tests in stages)), None)
    path.write_text(text)
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))  # The compiled file is valid again
    return noticed


def main() -> bool:
    """Run the campaign, print one line per mutation, and return whether enough were detected."""
    parser = argparse.ArgumentParser(description=__doc__, epilog=EXAMPLE)
    parser.add_argument("--area", choices=AREAS, help="area of the mutations; default: all")
    parser.add_argument("--match", default="", metavar="TEXT", help="only mutations with this text in a name")
    parser.add_argument("--only", type=int, metavar="N", help="only the first N")
    parser.add_argument("--quick", action="store_true", help="run only the listed test of each")
    parser.add_argument("--limit", type=float, default=600.0, metavar="S", help="seconds per run; 600")
    told = parser.parse_args()
    for name in _ELSEWHERE:
        import_module(name)
    noticed, every, start_s = Counter[str](), Counter[str](), time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        copied(root)
        noticed_by(root, ("--collect-only", "tests/core"), told.limit)  # Compile all files first
        sys.dont_write_bytecode = True
        last_s = time.monotonic()
        of_area = [one for one in MUTATIONS if told.area in (None, one.area) and told.match in one.name]
        # This file would fail on every mutated copy.
        rest = [] if told.quick else [("tests/core", "--ignore=tests/core/test_mutations.py")]
        for one in of_area[: told.only]:
            by = mutated(root, one, [(one.test,), *rest], told.limit)
            every[one.area] += 1
            noticed[one.area] += by is not None
            took_s, last_s = time.monotonic() - last_s, time.monotonic()
            print(f"{every.total()} {one.area} {took_s:.0f} s: {one.name}: {by or 'SURVIVED'}", flush=True)
    for area, number in every.items():
        print(f"{area}: {noticed[area]} of {number}, {noticed[area] / number:.0%}")
    print(f"{time.monotonic() - start_s:.0f} s")
    return all(noticed[area] >= EXPECTED * number for area, number in every.items())


def test_the_old_text_of_every_mutation_occurs_once() -> None:
    wrong = [one.name for one in MUTATIONS if (ROOT / one.file).read_text().count(one.old) != 1]
    wrong += [one.name for one in MUTATIONS if one.old == one.new or not _exists(one.test)]
    assert wrong == []
    areas = Counter(one.area for one in MUTATIONS)
    assert set(areas) == set(AREAS) and min(areas.values()) >= 15
    assert len(set(MUTATIONS)) == len(MUTATIONS)


def _exists(test: str) -> bool:
    file, _, name = test.partition("::")
    return (ROOT / file).is_file() and (not name or f"def {name}(" in (ROOT / file).read_text())


@pytest.mark.slow
def test_90_per_cent_of_mutations_are_detected() -> None:
    done = subprocess.run([sys.executable, __file__], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-2000:]


if __name__ == "__main__":
    sys.exit(0 if main() else 1)
