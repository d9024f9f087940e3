"""The layout of the project: packages, and the imports between them."""

import re
import shutil
import subprocess
import sys
import tomllib
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest

import worldstate

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
SIBLINGS = ["abduction", "adapters", "frontend", "simulation"]


def printed_by(*words: str) -> str:
    """Return the output of Python with these arguments."""
    return subprocess.run([sys.executable, *words], capture_output=True, text=True, check=True).stdout


def packages_in_tree() -> set[str]:
    homes = {"worldstate": ROOT / "worldstate"} | {f"worldstate.{name}": ROOT / name for name in SIBLINGS}
    found = set()
    for package, folder in homes.items():
        for init in folder.rglob("__init__.py"):
            if not any(parent.is_symlink() for parent in init.parents if parent != ROOT):
                found.add(".".join([package, *init.parent.relative_to(folder).parts]))
    return found


def test_every_package_of_the_tree_is_shipped():
    data = {"worldstate.data", "worldstate.data.models"}
    assert set(PROJECT["tool"]["setuptools"]["packages"]) == packages_in_tree() | data


@pytest.mark.parametrize("name", SIBLINGS)
def test_siblings_are_reached_through_links(name):
    link = ROOT / "worldstate" / name
    assert link.is_symlink()
    assert link.resolve() == ROOT / name


def test_layers_hold():
    command = [str(Path(sys.executable).parent / "lint-imports"), "--no-cache"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_laboratory_is_of_the_same_version():
    lab = tomllib.loads((ROOT / "lab" / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert lab["version"] == worldstate.__version__
    assert lab["dependencies"] == ["worldstate[all]"]


def modules_of_the_product() -> str:
    paths = (path for name in (*SIBLINGS, "worldstate") for path in (ROOT / name).rglob("*.py"))
    return "\n".join(path.read_text(encoding="utf-8") for path in paths)


@pytest.mark.parametrize(
    "package", ["filterpy", "gtsam", "networkx", "numpy", "scipy", "sklearn", "soundfile"]
)
def test_the_product_imports_its_main_packages(package):
    said = rf"(^\s*(import|from) {package}\b|optional\(\"{package}\b)"
    assert re.search(said, modules_of_the_product(), flags=re.MULTILINE)


OPTIONAL = {
    "sklearn": ("worldstate.operations.train_model(None, None, dataset='', group='static')", "train"),
    "matplotlib": ("worldstate.operations.write_state_figure([], pathlib.Path('a.png'))", "plot"),
    "networkx": ("worldstate.WorldState(0, 0).graph()", "graph"),
}


@pytest.mark.long
@pytest.mark.parametrize("package", OPTIONAL)
def test_a_missing_package_is_named_with_its_extra_before_any_work(package):
    call, extra = OPTIONAL[package]
    script = (
        f"import pathlib, sys; sys.modules['{package}'] = None; import worldstate, worldstate.operations\n"
        f"try: {call}\nexcept worldstate.ground.MissingExtraError as error: print(error)"
    )
    assert f"pip install 'worldstate[{extra}]'" in printed_by("-c", script)


HEAVY = {"scipy.stats", "scipy.signal", "sklearn", "filterpy", "gtsam", "matplotlib", "cv2", "networkx"}


@pytest.mark.long
@pytest.mark.parametrize(
    "statement",
    [
        "import worldstate",
        "import worldstate; worldstate.WorldFilter",
        "import worldstate; worldstate.WorldFilter().predict(0.1).state",
        "import worldstate.cli.main",
        "import worldstate.adapters.listener",
        "import worldstate.simulation.dataset.dataset",
    ],
)
def test_import_stays_light(statement):
    script = f"import sys; {statement}; print(*sorted({HEAVY!r} & set(sys.modules)))"
    assert printed_by("-c", script).split() == []


HEARD = """
import numpy as np
from worldstate import Listener
from worldstate.frontend import ovad_array
assert len(Listener(ovad_array(), 48_000).push(np.random.default_rng(0).normal(0.0, 0.01, (57_600, 56)))) == 3
"""


@pytest.mark.long
def test_a_stream_is_processed_without_the_slow_parts_of_scipy():
    parts = "stats", "signal", "fft", "ndimage", "special", "optimize", "linalg"
    slow = {f"scipy.{part}" for part in parts}
    script = f"{HEARD}\nimport sys; print(*sorted({slow!r} & set(sys.modules)))"
    assert printed_by("-c", script).split() == []


def exporting_packages():
    found = [import_module(name) for name in sorted(packages_in_tree())]
    return {package.__name__: package for package in found if hasattr(package, "__all__")}


def test_every_exported_name_is_the_one_of_its_home():
    packages = exporting_packages()
    homes = {}
    for name, package in packages.items():
        assert list(package.__all__) == sorted(set(package.__all__)), name
        for exported in package.__all__:
            value = getattr(package, exported)
            # An imported submodule of the same name would replace it.
            assert not isinstance(value, ModuleType), f"{name}.{exported}"
            homes.setdefault(exported, value)
            assert value is homes[exported], f"{name}.{exported} is another thing elsewhere"
            home = sys.modules[getattr(value, "__module__", None) or name]
            assert getattr(home, exported, value) is value
    assert sum(len(package.__all__) for package in packages.values()) <= 250
    # Thirty names, and `hear` for a corpus.
    assert 20 <= len(packages["worldstate"].__all__) <= 31


def test_everything_can_be_imported_at_once():
    names = {}
    exec("from worldstate import *", names)
    assert set(exporting_packages()["worldstate"].__all__) <= set(names)


CONSOLE = str(Path(sys.executable).parent / "worldstate")


@pytest.mark.parametrize("command", [[sys.executable, "-m", "worldstate"], [CONSOLE]])
def test_it_runs_as_a_module_and_as_a_command_and_names_its_version(command):
    done = subprocess.run([*command, "--version"], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["worldstate", worldstate.__version__]


# A stand-in for pip-audit, which accepts a list without versions and skips unknown ones without --strict.
AUDITOR = """#!/bin/sh
mkdir -p out/audit/bin && cp "$0" out/audit/bin/pip && cp "$0" out/audit/bin/pip-audit
case "$0 $*" in *pip-audit*--strict*-r*locked.txt*) touch audited ;; esac
"""


@pytest.mark.parametrize(("locked", "audited"), [("", False), ("# none\n", False), ("a==1\n", True)])
def test_an_audit_of_nothing_fails(locked, audited, tmp_path):
    shutil.copy(ROOT / "Makefile", tmp_path)
    (tmp_path / "locked.txt").write_text(locked)
    (tmp_path / "auditor").write_text(AUDITOR)
    (tmp_path / "auditor").chmod(0o755)
    audit = ["make", "audit", "PYTHON=./auditor"]
    done = subprocess.run(audit, cwd=tmp_path, capture_output=True, check=False)
    assert (done.returncode == 0) is audited
    assert (tmp_path / "audited").exists() is audited


def test_the_lock_holds_every_requirement():
    def plain(requirement: str) -> str:
        return re.sub(r"[-_.]+", "-", re.match(r"[\w.-]+", requirement)[0]).lower()

    locked = {plain(line) for line in (ROOT / "locked.txt").read_text("utf-8").splitlines() if "==" in line}
    project = PROJECT["project"]
    optional = {"pandas": [], "peers": [], "rerun": []}
    extras = (project["optional-dependencies"] | optional).values()
    wanted = {plain(one) for group in (project["dependencies"], *extras) for one in group}
    assert wanted - locked == {"worldstate"}
