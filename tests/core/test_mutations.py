"""The list of mutations fits the library, and the tests of the core detect 90 % of them."""

import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
from run_mutations import AREAS, MUTATIONS

ROOT = Path(__file__).resolve().parents[2]


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
    program = [sys.executable, str(ROOT / "tests/core/run_mutations.py")]
    done = subprocess.run(program, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-2000:]
