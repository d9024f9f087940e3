"""The layout itself: what is packaged, and who may import whom."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def packages_in_tree() -> set[str]:
    homes = {"worldstate": ROOT / "worldstate"} | {
        f"worldstate.{name}": ROOT / name for name in ("abduction", "adapters", "frontend")
    }
    found = set()
    for package, folder in homes.items():
        for init in folder.rglob("__init__.py"):
            if not any(parent.is_symlink() for parent in init.parents if parent != ROOT):
                found.add(".".join([package, *init.parent.relative_to(folder).parts]))
    return found


def test_every_package_of_the_tree_is_shipped():
    assert set(PROJECT["tool"]["setuptools"]["packages"]) == packages_in_tree()


@pytest.mark.parametrize("name", ["abduction", "adapters", "frontend"])
def test_siblings_are_reached_through_links(name):
    link = ROOT / "worldstate" / name
    assert link.is_symlink()
    assert link.resolve() == ROOT / name


def test_layers_hold():
    command = [str(Path(sys.executable).parent / "lint-imports"), "--no-cache"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("module", ["worldstate", "worldstate.cli.main"])
def test_import_stays_light(module):
    heavy = {"matplotlib.pyplot", "gtsam", "sklearn", "cv2"}
    script = f"import sys, {module}; print(*sorted({heavy!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
