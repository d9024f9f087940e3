"""A blind junction that can be heard: scene, vehicle, propagation, background, camera, data set."""

from worldstate.adapters.simulation.dataset.dataset import LogRow, write_dataset, write_log, write_recording
from worldstate.adapters.simulation.dataset.plan import DatasetSettings
from worldstate.adapters.simulation.dataset.recording import (
    SimulatedRecording,
    simulate_recording,
    stream_recording,
)
from worldstate.adapters.simulation.scene.ego_motion import EgoMotion
from worldstate.adapters.simulation.scene.junction import MOVING_SITES, SITES, Site, site
from worldstate.adapters.simulation.scene.kinds import KINDS
from worldstate.adapters.simulation.scene.occlusions import OCCLUSIONS, occluded_scene
from worldstate.adapters.simulation.scene.presets import DEFAULT_PRESET, PRESETS, Preset, preset
from worldstate.adapters.simulation.scene.settings import SimulationSettings, VehicleSettings, draw_settings

__all__ = [
    "DEFAULT_PRESET",
    "KINDS",
    "MOVING_SITES",
    "OCCLUSIONS",
    "PRESETS",
    "SITES",
    "DatasetSettings",
    "EgoMotion",
    "LogRow",
    "Preset",
    "SimulatedRecording",
    "SimulationSettings",
    "Site",
    "VehicleSettings",
    "draw_settings",
    "occluded_scene",
    "preset",
    "simulate_recording",
    "site",
    "stream_recording",
    "write_dataset",
    "write_log",
    "write_recording",
]
