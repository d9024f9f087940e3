"""What the camera takes of a simulated recording: frames, and the file that OVAD has beside the sound."""

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from worldstate.adapters.camera.opencv import opencv
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.datasets.ovad_layout import FRAME_RATE_HZ
from worldstate.adapters.files.atomic import atomic_path
from worldstate.ground.errors import InputFileError, InvalidArgumentError
from worldstate.ground.typing import Float32Array, FloatArray, ImageArray
from worldstate.simulation.camera.rays import View
from worldstate.simulation.camera.simulated_detector import Frame
from worldstate.simulation.camera.street_view import paint_street
from worldstate.simulation.camera.vehicle_view import PAINTS, Car, add_car, with_parked_car
from worldstate.simulation.scene.junction import Site
from worldstate.simulation.scene.settings import SimulationSettings
from worldstate.simulation.scene.vehicle import LENGTH_M, WIDTH_M

from .recording import SimulatedRecording

CODEC = "mp4v"
SENSOR_NOISE = 1.5  # grey levels
# Ten standard deviations of a parked car's box, less than a moving one passes in a frame.
STILL_PX = 4.0
STEP_M = 0.01


def camera_frames(
    settings: SimulationSettings,
    recording: SimulatedRecording,
    rng: np.random.Generator,
    camera: PinholeCamera | None = None,
) -> Iterator[ImageArray]:
    """Yield what the camera sees, ten frames a second.

    Examples
    --------
    >>> from worldstate.simulation import simulate_recording, site
    >>> settings = SimulationSettings(site("SA1"), "left", duration_s=0.6, entry_s=0.3, sample_rate_hz=8e3)
    >>> recording = simulate_recording(settings, np.random.default_rng(1))
    >>> small = PinholeCamera(width_px=96, height_px=60)
    >>> frames = list(camera_frames(settings, recording, np.random.default_rng(1), small))
    >>> len(frames), frames[0].shape, frames[0].dtype
    (6, (60, 96, 3), dtype('uint8'))
    """
    # The street is the site's own; buildings hide the vehicle until its front passes the line of sight past
    # their corner, which is the recording's T0. Light is even and the camera stands still, so that all that
    # changes is the vehicle, its shadow and the sensor's noise.
    view = View(camera or PinholeCamera())
    paint, parked_paint = (PAINTS[i] for i in rng.integers(len(PAINTS), size=2))
    street = paint_street(settings.site, view)
    if settings.parked_car:
        middle = parked_middle_m(recording.detections, settings.site)
        if middle is not None:
            lane = parked_lane_m(settings.site)
            street = with_parked_car(street, Car(lane, middle + 0.5 * LENGTH_M, 1, parked_paint))
    still = street.pixels()
    heading = -1 if settings.approach == "left" else 1
    truth = recording.truth["frames"]
    for number in range(len(recording.detections)):
        image = still.copy()
        if truth:
            lane, front = truth[number]["position_m"]
            add_car(street, Car(lane, front, heading, paint), image)
        yield _taken(image, rng)


def write_video(path: str | Path, frames: Iterable[ImageArray], frame_rate_hz: float = FRAME_RATE_HZ) -> None:
    """Write frames of one size as MPEG-4, whole or not at all.

    Shapes: frames (height, width, 3).
    """
    cv2 = opencv()
    waiting = iter(frames)
    first = next(waiting, None)
    if first is None:
        raise InvalidArgumentError("frames: expected at least one")
    with atomic_path(path) as temporary:
        code = cv2.VideoWriter_fourcc(*CODEC)
        writer = cv2.VideoWriter(str(temporary), code, frame_rate_hz, (first.shape[1], first.shape[0]))
        if not writer.isOpened():
            raise InputFileError(path, f"expected to write a video of {first.shape[1]} x {first.shape[0]} px")
        try:
            writer.write(first)
            for frame in waiting:
                writer.write(frame)
        finally:
            writer.release()


def parked_lane_m(site: Site) -> float:
    """Distance ahead of the middle of a car that is parked at the far kerb."""
    return site.far_kerb_m - 0.5 * WIDTH_M


def parked_middle_m(detections: Iterable[Frame], site: Site) -> float | None:
    """Read back from its boxes where the parked car stands along the street; None where there is none."""
    boxes = np.array([frame[0].box_px for frame in detections if frame])
    still = boxes[(np.abs(boxes - boxes[:1]) < STILL_PX).all(axis=1)] if len(boxes) else boxes
    if not len(still):
        return None
    camera, faces = PinholeCamera(), parked_lane_m(site) + WIDTH_M * np.array([-0.5, 0.5])
    right, left = site.sights_m(faces, camera.position_m[:2])
    middles = np.arange(right[0], left[0], STEP_M)
    ends = np.clip(middles[:, None, None] + LENGTH_M * np.array([[-0.5], [0.5]]), right, left)
    wanted = np.median(still, axis=0)[[0, 2]]
    missed = np.abs(_columns_px(camera, faces, ends) - wanted).sum(axis=1)
    return float(middles[missed.argmin()])


def _columns_px(camera: PinholeCamera, ahead_m: FloatArray, ends_m: FloatArray) -> FloatArray:
    """First and last column of cuboids whose faces (2,) end at (n, 2, 2) (right, left), shape (n, 2)."""
    # At the camera's own height, where the pitch shortens the depth and nothing else.
    slope = (ends_m - camera.position_m[1]) / ((ahead_m - camera.position_m[0]) * np.cos(camera.pitch_rad))
    focal = 0.5 * camera.width_px / np.tan(camera.half_angle_rad)
    columns = np.clip(0.5 * camera.width_px - focal * slope, 0.0, camera.width_px - 1.0).reshape(-1, 4)
    return np.stack([columns.min(axis=1), columns.max(axis=1)], axis=1)


def _taken(image: Float32Array, rng: np.random.Generator) -> ImageArray:
    """Add the sensor's noise, alike in all colours, and round; red, green, blue become blue, green, red."""
    noise = rng.standard_normal(image.shape[:2], dtype=np.float32)
    noise *= SENSOR_NOISE
    taken = image[:, :, ::-1] + noise[:, :, None]
    np.rint(taken, out=taken)
    return np.clip(taken, 0.0, 255.0, out=taken).astype(np.uint8)
