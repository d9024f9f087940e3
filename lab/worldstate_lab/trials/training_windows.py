"""The windows that the published classifier is trained on; none of them is of a tested recording."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from worldstate.adapters.datasets.array_choice import choose_array
from worldstate.adapters.datasets.feature_extraction import LabelledWindow, extract_features, feature_table
from worldstate.adapters.datasets.feature_table import FeatureTable, read_features, write_features
from worldstate.adapters.datasets.sample_windows import sample_windows
from worldstate.adapters.files.acoustic_domain import check_array, ovad_domain
from worldstate.adapters.files.model_file import save_model
from worldstate.ground.errors import OutOfDomainError
from worldstate.operations.training.training import TrainingSettings, train_model
from worldstate.simulation.scene.junction import SITES
from worldstate.simulation.scene.presets import DEFAULT_PRESET, preset
from worldstate_lab.origin import origin_of
from worldstate_lab.streets.simulated_windows import LAYOUT, simulated_windows

from .takes import TakeList

# Changes whenever the same windows would give another model.
VERSION = 2
# 170 windows of each class of left and right together, front and none at the five standing sites: the
# released set has 170, 170 and 158 once its 42 + 42 and 41 test windows are taken away.
PER_APPROACH = 17


def windows_from_table(path: Path, takes: TakeList) -> tuple[FeatureTable, str]:
    """Read a table of windows and leave out those of the tested recordings; say what was left out.

    Raises
    ------
    OutOfDomainError
        If the windows are of another array than the recordings.
    """
    table = read_features(path)
    domain = table.domain or ovad_domain(table.environments.tolist())
    try:
        check_array(
            domain, choose_array(takes.root), "Extract windows of these recordings (extract-features)"
        )
    except OutOfDomainError as error:
        raise OutOfDomainError(f"{path}: windows of another array; {error}") from error
    tested = {take.name for take in (*takes.static, *takes.dynamic)}
    kept = table.without(tested) if set(table.ids.tolist()) & tested else table
    left_out = len(table) - len(kept)
    return kept, f"{len(kept)} windows of {path.name}, {left_out} of tested recordings left out"


def windows_from_recordings(takes: TakeList, folder: Path) -> tuple[FeatureTable, str] | None:
    """Extract the windows of the recordings that are not tested; None where there are none."""
    names = {take.name for take in takes.training}
    if not names:
        return None
    found = [window for window in sample_windows(takes.root)[0] if _recording_id(window) in names]
    path = folder / f"windows-{origin_of([str(takes.root.absolute()), sorted(names)])}.csv"
    if not path.is_file():
        array = choose_array(takes.root)
        write_features(path, feature_table(found, list(extract_features(found, array)), array))
    table = read_features(path)
    return table, f"{len(table)} windows of {len(names)} recordings that are not tested"


def windows_from_simulation(
    folder: Path,
    seed: int,
    *,
    per_approach: int = PER_APPROACH,
    sites: Sequence[str] = SITES,
    jobs: int = 1,
    progress: Callable[[], None] = lambda: None,
) -> tuple[FeatureTable, str]:
    """Simulate windows at the junctions of the tested recordings, from a seed of their own."""
    levels = preset(DEFAULT_PRESET)
    origin = origin_of([LAYOUT, asdict(levels), seed, per_approach, list(sites)])
    path = folder / f"windows-{origin}.csv"
    if not path.is_file():
        # Apart from the seeds that recordings are made with: no window is one of a tested recording.
        apart = int(np.random.SeedSequence((seed, 1)).generate_state(1)[0])
        write_features(
            path,
            simulated_windows(per_approach, apart, sites=sites, jobs=jobs, levels=levels, progress=progress),
        )
    # Rendered at a quarter of the rate, with the bins of the full one: the feature is that of OVAD's array.
    table = replace(read_features(path), domain=ovad_domain(sites))
    return table, f"{len(table)} simulated windows of the same junctions, other recordings"


def model_from_windows(windows: FeatureTable, folder: Path, seed: int) -> Path:
    """Train this library's model on the windows of a standing ego, and return its file.

    The paper's sweep over camera states listens with a classifier that knows the junctions; the model that
    ships has heard other ones.
    """
    table = windows.group("static")
    marks: list[object] = [VERSION, seed, sorted(table.recording_keys.tolist()), float(table.features.sum())]
    path = folder / f"trained-{origin_of(marks)[:8]}.json"
    if not path.is_file():
        settings = TrainingSettings(seed=seed, repeats=1)
        save_model(path, train_model(table, settings, dataset="training windows", group="static"))
    return path


def _recording_id(window: LabelledWindow) -> str:
    """Return the folder name of the recording that a window was cut from."""
    return window.path.parent.name
