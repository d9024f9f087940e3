"""A blind junction that can be heard: scene, vehicle, propagation, background, camera, data set."""

from .dataset import LogRow, write_dataset, write_log, write_recording
from .presets import DEFAULT_PRESET, PRESETS, Preset, preset
from .recording import SimulatedRecording, simulate_recording
from .scene import SITES, Site, site
from .settings import SimulationSettings, draw_settings

__all__ = [
    "DEFAULT_PRESET",
    "PRESETS",
    "SITES",
    "LogRow",
    "Preset",
    "SimulatedRecording",
    "SimulationSettings",
    "Site",
    "draw_settings",
    "preset",
    "simulate_recording",
    "site",
    "write_dataset",
    "write_log",
    "write_recording",
]
