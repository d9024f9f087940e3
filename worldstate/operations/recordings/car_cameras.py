"""Several cameras of a vehicle in a source, each with the detections of its own detector."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from worldstate.adapters.camera.detections import DetectionFilter, DetectionLog, read_any_detections
from worldstate.adapters.camera.miss_rates import load_miss_rates
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.vision_query import SeveralCameras, VisionQuery
from worldstate.adapters.source import Source
from worldstate.adapters.vehicle.car_file import CameraSetup, CarSensors
from worldstate.ground.errors import InvalidArgumentError


def with_cameras(source: Source, car: CarSensors, detections: Mapping[str, Path | DetectionLog]) -> Source:
    """Return a source with several cameras of a car, whose results are combined.

    Parameters
    ----------
    source : Source
        From `open_source`; its miss rates and box filter are the defaults of every camera.
    car : CarSensors
        Poses, clock offsets and box filters of the cameras.
    detections : mapping of str to path or DetectionLog
        Detections of each camera on its own clock, by its name in the car file.

    Raises
    ------
    InvalidArgumentError
        If no camera is given, or the car has none of that name.
    InputFileError
        If a file is missing or damaged, or its boxes are of images of another size.
    """
    channels = {}
    for name, reported in detections.items():
        camera = car.camera(name)
        if camera is None:
            raise InvalidArgumentError(f"camera: expected a car with cameras, it has none named {name}")
        channels[name] = _channel(source, camera, car.setups[name], reported)
    return replace(source, co_evidence=SeveralCameras(channels))


def _channel(
    source: Source, camera: PinholeCamera, setup: CameraSetup, reported: Path | DetectionLog
) -> VisionQuery:
    if isinstance(reported, Path):
        size_px = (camera.width_px, camera.height_px)
        reported = read_any_detections(reported, setup.image_rate_hz, size_px)
    rates = source.miss_rates if setup.miss_rates is None else load_miss_rates(setup.miss_rates)
    told = setup.boxes != DetectionFilter()
    settings = replace(source.settings, boxes=setup.boxes) if told else source.settings
    log = reported.on_clock(source.start_ns, camera.stamp_offset_s)
    asked = replace(source, camera=camera, detections=log, miss_rates=rates, settings=settings)
    return asked.camera_channel()
