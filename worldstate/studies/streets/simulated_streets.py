"""Simulate the recordings of the twin one by one, on any number of processes, and remember those done."""

import hashlib
import json
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

from .front_end_run import run_front_end
from .recording_features import TwinRecording, load_twin, save_twin

# What is heard of a recording depends on this code: a change of it is another number.
VERSION = 5


@dataclass(frozen=True, slots=True)
class TwinSettings:
    """What the twin is made of."""

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
        return hashlib.sha256(json.dumps(made_of, sort_keys=True).encode()).hexdigest()[:32]


def listen_twins(
    folder: Path, plans: Sequence[Plan], settings: TwinSettings, jobs: int = 1
) -> Iterator[TwinRecording]:
    """Yield the recordings of the twin in the order of the plans; those in `folder` are not made again."""
    work = partial(_recall_or_listen, folder, settings)
    yield from in_processes(work, plans, jobs)


def _recall_or_listen(folder: Path, settings: TwinSettings, plan: Plan) -> TwinRecording:
    path, origin = folder / f"{plan.number:04d}.npz", settings.origin(plan)
    kept = load_twin(path, origin)
    if kept is None:
        kept = listen_twin(plan, settings)
        save_twin(path, kept, origin)
    return kept


def listen_twin(plan: Plan, settings: TwinSettings) -> TwinRecording:
    """Simulate one recording, the same that `simulate` writes for this plan and preset, and listen to it."""
    rng = np.random.default_rng(plan.seed)
    drawn = draw_settings(plan.environment, plan.approach, rng, settings.duration_s)
    recording = simulate_recording(replace(drawn, preset=settings.preset), rng)
    if settings.keep is not None:
        write_recording(settings.keep, recording, plan.number)
    return run_front_end(recording, name=f"{plan.number:04d}")
