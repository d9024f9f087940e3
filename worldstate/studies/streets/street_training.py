"""Train a classifier on windows of the simulated junctions, as the paper's was on its own.

The paper's classifier is trained on other recordings of the very sites that it is tested at. A classifier
trained on the real sites is at the simulated ones in the leave-one-junction-out case instead.
"""

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np

from worldstate.abduction.signature.signature_io import AnySignature
from worldstate.adapters.datasets.feature_table import FeatureTable, read_features, write_features
from worldstate.adapters.simulation.scene.junction import SITES
from worldstate.adapters.simulation.scene.presets import Preset
from worldstate.operations.training.methods import method_of
from worldstate.operations.training.training import TrainingMethod, fit_signature
from worldstate.studies.origin import origin_of

from .simulated_streets import VERSION
from .simulated_windows import LAYOUT, simulated_windows

# 170 windows of each class of left and right together, front and none: the released set has 170, 170 and 158
# once its 42 + 42 and 41 test windows are taken away.
PER_APPROACH = 17
N_RECORDINGS = 4 * PER_APPROACH * len(SITES)


def train_on_simulation(
    folder: Path,
    levels: Preset,
    seed: int,
    *,
    method: TrainingMethod = "baseline",
    jobs: int = 1,
    per_approach: int = PER_APPROACH,
    progress: Callable[[], None] = lambda: None,
) -> AnySignature:
    """Simulate training windows at the same sites and fit a classifier to them."""
    origin = origin_of([VERSION, LAYOUT, asdict(levels), seed, per_approach])
    path = folder / f"training-{origin}.csv"
    if path.is_file():
        table = read_features(path)
    else:
        table = _simulate(levels, seed, jobs, per_approach, progress)
        write_features(path, table)
    return fit_signature(method_of(method).prepare(table), method, np.random.default_rng(seed))


def _simulate(
    levels: Preset, seed: int, jobs: int, per_approach: int, progress: Callable[[], None]
) -> FeatureTable:
    apart = int(np.random.SeedSequence((seed, 1)).generate_state(1)[0])
    return simulated_windows(per_approach, apart, jobs=jobs, levels=levels, progress=progress)
