"""Simulate recordings on any number of processes, and keep what the front-end made of those done."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from worldstate.adapters.simulation.dataset.dataset import write_recording
from worldstate.adapters.simulation.dataset.plan import Plan
from worldstate.adapters.simulation.dataset.recording import simulate_recording
from worldstate.adapters.simulation.scene.presets import Preset
from worldstate.adapters.simulation.scene.settings import draw_settings
from worldstate.ground.parallel import in_processes
from worldstate.operations.recordings.hop_table import HopTable, load_tables, save_tables
from worldstate.studies.origin import origin_of

from .front_end_run import run_front_end

# The kept hops depend on the code that made them: a change of it is another number.
VERSION = 5


@dataclass(frozen=True, slots=True)
class StreetSettings:
    """How the streets are simulated."""

    preset: Preset  # Levels of the simulation, the rate of distant vehicles among them
    duration_s: float = 10.0  # Length of each recording
    keep: Path | None = None  # Folder of a data set that the recordings are written to as well

    def origin(self, plan: Plan) -> str:
        """Name everything that a recording depends on, in a few characters."""
        made_of: dict[str, object] = {
            "version": VERSION,
            "preset": asdict(self.preset),
            "duration_s": self.duration_s,
            "plan": [plan.number, plan.environment, plan.approach, plan.seed.entropy, plan.seed.spawn_key],
        }
        if self.keep is not None:
            made_of["keep"] = str(self.keep)
        return origin_of(made_of)


def simulated_hops(
    folder: Path, plans: Sequence[Plan], settings: StreetSettings, jobs: int = 1
) -> Iterator[HopTable]:
    """Yield the recordings in the order of the plans; those in `folder` are not made again."""
    work = partial(_kept_or_simulated, folder, settings)
    yield from in_processes(work, plans, jobs)


def _kept_or_simulated(folder: Path, settings: StreetSettings, plan: Plan) -> HopTable:
    path, origin = folder / f"{plan.number:04d}.npz", settings.origin(plan)
    kept = load_tables(path, "simulated hops", origin) if path.is_file() else []
    if kept:
        return kept[0]
    made = simulate_hops(plan, settings)
    save_tables(path, [made], origin)
    return made


def simulate_hops(plan: Plan, settings: StreetSettings) -> HopTable:
    """Simulate the recording that `simulate` writes for this plan and preset, and run the front-end."""
    rng = np.random.default_rng(plan.seed)
    drawn = draw_settings(plan.environment, plan.approach, rng, settings.duration_s)
    recording = simulate_recording(replace(drawn, preset=settings.preset), rng)
    if settings.keep is not None:
        write_recording(settings.keep, recording, plan.number)
    return run_front_end(recording, name=f"{plan.number:04d}")
