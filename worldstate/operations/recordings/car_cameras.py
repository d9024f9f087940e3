"""Several cameras of a vehicle in what is listened to: each with what its own detector reported."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from worldstate.adapters.camera.detection_formats import read_any_detections
from worldstate.adapters.camera.detections import DetectionLog
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.several_cameras import SeveralCameras
from worldstate.adapters.camera.vision_query import VisionQuery
from worldstate.adapters.listen import Source
from worldstate.adapters.vehicle.car_file import CarSensors
from worldstate.ground.errors import InvalidArgumentError


def with_cameras(source: Source, car: CarSensors, detections: Mapping[str, Path | DetectionLog]) -> Source:
    """Return what is listened to with several cameras of a car, which are asked together.

    Parameters
    ----------
    source : Source
        From `open_source`; its miss rates and boxes that count are those of every camera.
    car : CarSensors
        Where the cameras are, and how their clocks differ.
    detections : mapping of str to path or DetectionLog
        What was detected in the images of each, by its name in the car's file, on its own clock.

    Raises
    ------
    InvalidArgumentError
        Without a camera, or if the car has none of such a name.
    InputFileError
        If a file is missing or damaged, or its boxes are not of images of this size.
    """
    channels = {}
    for name, reported in detections.items():
        camera = car.camera(name)
        if camera is None:
            raise InvalidArgumentError(f"camera: expected a car with cameras, it has none of the name {name}")
        channels[name] = _channel(source, camera, reported)
    return replace(source, co_evidence=SeveralCameras(channels))


def _channel(source: Source, camera: PinholeCamera, reported: Path | DetectionLog) -> VisionQuery:
    if isinstance(reported, Path):
        reported = read_any_detections(reported, size_px=(camera.width_px, camera.height_px))
    log = reported.shifted(camera.stamp_offset_s)
    return replace(source, camera=camera, detections=log).camera_channel()
