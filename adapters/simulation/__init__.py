"""A blind junction that can be heard: scene, vehicle, propagation, background, camera, data set."""

from .dataset import LogRow, write_dataset, write_log, write_recording
from .ego_motion import EgoMotion
from .kinds import KINDS
from .occlusions import OCCLUSIONS, occluded_scene
from .plan import DatasetSettings
from .presets import DEFAULT_PRESET, PRESETS, Preset, preset
from .recording import SimulatedRecording, simulate_recording, stream_recording
from .scene import MOVING_SITES, SITES, Site, site
from .settings import SimulationSettings, VehicleSettings, draw_settings

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
