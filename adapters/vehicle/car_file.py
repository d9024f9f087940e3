"""Car files: array, cameras with their detections, odometry and model of a vehicle in one file."""

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from worldstate.adapters.camera.detections import OVAD_HEIGHT_PX, DetectionFilter
from worldstate.adapters.camera.pinhole import CameraRecord, PinholeCamera
from worldstate.adapters.files.array_file import checked_array, read_array
from worldstate.adapters.files.file_io import read_json, read_record, refused_as_file, write_json
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground import FloatArray, InputFileError, InvalidArgumentError, finite_array, in_range
from worldstate.ground.checks import one_of
from worldstate.ground.serialisation import ADDED

_LOG = logging.getLogger(__name__)
# No vehicle carries a sensor farther from its origin; a larger number is in millimetres.
MAX_OFFSET_M = 30.0
MOST_TURNS_DEG = 3600.0


@dataclass(frozen=True, slots=True)
class Mounting:
    r"""Pose of a sensor: position, then yaw about z, pitch and roll about the sensor's own axes.

    .. math:: p_{base} = t + R_z(yaw)\, R_y(-pitch)\, R_x(roll)\, p_{sensor}

    Yaw is positive to the left. Pitch is positive upwards, like the elevation of the viewing direction; the
    rotation about y, which points left, is its negative. Roll is positive if it lifts the left side.

    Examples
    --------
    >>> Mounting((1.0, 0.0, 1.5), yaw_deg=90.0).applied([[0.2, 0.0, 0.0]]).round(3).tolist()
    [[1.0, 0.2, 1.5]]
    >>> Mounting(pitch_deg=90.0).applied([[0.2, 0.0, 0.0]]).round(3).tolist()
    [[0.0, 0.0, 0.2]]
    >>> Mounting(roll_deg=90.0).applied([[0.0, 0.2, 0.0]]).round(3).tolist()
    [[0.0, 0.0, 0.2]]
    """

    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0

    def __post_init__(self) -> None:
        for axis, value in zip("xyz", self.position_m, strict=True):
            in_range(f"position_m.{axis}", value, -MAX_OFFSET_M, MAX_OFFSET_M)
        in_range("pitch_deg", self.pitch_deg, -90.0, 90.0)
        for name in ("yaw_deg", "roll_deg"):  # may exceed one turn
            in_range(name, getattr(self, name), -MOST_TURNS_DEG, MOST_TURNS_DEG)

    @property
    def rotation(self) -> FloatArray:
        """Rotation from the sensor's axes to those of `base_link`, shape (3, 3)."""
        # Imported here because most commands read no car file.
        from scipy.spatial.transform import Rotation

        angles_deg = self.yaw_deg, -self.pitch_deg, self.roll_deg
        return np.asarray(Rotation.from_euler("ZYX", angles_deg, degrees=True).as_matrix())

    def applied(self, points_m: ArrayLike) -> FloatArray:
        """Convert points of the sensor, shape (n, 3), to `base_link`."""
        return np.asarray(finite_array("points_m", points_m, (None, 3)) @ self.rotation.T + self.position_m)


MOST_CAMERAS = 32


@dataclass(frozen=True, slots=True)
class CameraSetup:
    """Settings of a camera other than its lens: detections, and which of them are used.

    Parameters
    ----------
    detections : Path, optional
        Detections in its images, in a format of `read_any_detections`.
    image_rate_hz : float, optional
        Images per second, if they have no stamps; by default 10.
    miss_rates : Path, optional
        Miss rates of its detector, in the format of `load_miss_rates`.
    boxes : DetectionFilter
        Filter of the boxes.
    labels : tuple of str
        Classes of its detector if that is an ONNX model.
    """

    detections: Path | None = None
    image_rate_hz: float | None = None
    miss_rates: Path | None = None
    boxes: DetectionFilter = field(default_factory=DetectionFilter)
    labels: tuple[str, ...] = ("car",)


@dataclass(frozen=True, slots=True)
class CarSensors:
    """Sensors of a vehicle in the axes of `base_link`, with the origin at the array.

    Sound gives no range, so azimuths are those at the array. Positions that the file gives relative to
    another origin, such as the rear axle, are converted.

    Parameters
    ----------
    array : MicrophoneArray or None
        The array as mounted; None if the file has none.
    cameras : mapping of str to PinholeCamera
        Cameras by name in the order of the file, with positions relative to the array.
    setups : mapping of str to CameraSetup
        Further settings of each camera.
    model, odometry : Path, optional
        Model file and motion of the vehicle.
    measurements : mapping of str to Path
        Recordings of other sensors, such as a radar, by the name of the part that reads them.
    crossing_m : float
        Distance ahead, in metres, to the lane in which a vehicle detected only by sound is placed for other
        stacks.
    """

    array: MicrophoneArray | None
    cameras: Mapping[str, PinholeCamera] = field(default_factory=dict)
    setups: Mapping[str, CameraSetup] = field(default_factory=dict)
    model: Path | None = None
    odometry: Path | None = None
    measurements: Mapping[str, Path] = field(default_factory=dict)
    crossing_m: float = 9.0

    def camera(self, name: str) -> PinholeCamera:
        """Return a camera by its name.

        Raises
        ------
        InvalidArgumentError
            If no camera has this name.
        """
        return self.cameras[one_of("camera", name, self.cameras)]


def read_car(path: str | Path) -> CarSensors:
    """Read the sensors of a vehicle from JSON.

    ``{"array": {"file": "mics.csv", "position_m": [1.2, 0, 1.6], "pitch_deg": -5}, "cameras": [{"name":
    "front", "width_px": 1280, "height_px": 720, "horizontal_fov_deg": 90, "position_m": [1.9, 0, 1.3]}]}``.
    The array has a ``"file"`` in a format of `read_array`, or ``"positions_m"``. It is mounted at
    ``"position_m"`` with ``"yaw_deg"``, ``"pitch_deg"`` and ``"roll_deg"`` (`Mounting`). Each camera has the
    keys of `read_camera`, a ``"name"`` and the keys of `CameraSetup`: ``"detections"``, ``"image_rate_hz"``,
    ``"miss_rates"``, ``"classes"``, ``"min_score"``, ``"min_box_px"`` and ``"labels"``. ``"model"``,
    ``"odometry"``, ``"measurements": {NAME: FILE}`` and ``"crossing_m"`` are those of `CarSensors`. Every key
    is optional; paths are relative to the folder of the car file.

    Raises
    ------
    InputFileError
        If a file is missing, too large or not JSON, has an unknown key, or a value is missing or out of
        range; the message contains the key.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> array = '{"positions_m": [[0.2, 0, 0], [0, 0.1, 0]], "position_m": [1.2, 0, 1.6], "yaw_deg": 90}'
    >>> with TemporaryDirectory() as folder:
    ...     name = Path(folder) / "car.json"
    ...     _ = name.write_text(f'{{"array": {array}}}')
    ...     read_car(name).array.positions_m.round(3).tolist()
    [[1.2, 0.2, 1.6], [1.1, 0.0, 1.6]]
    """
    with refused_as_file(path):
        record = read_record(_CarFile, path, "car", by_hand=True)
        if record == _CarFile(name=record.name):
            _LOG.warning("%s: no array, camera, model, odometry or measurements in it", path)
        return record.car(Path(path))


def write_aligned(
    path: str | Path, out: str | Path, camera: str | None, offset_s: float, yaw_deg: float
) -> None:
    """Write a copy of a car file with an alignment added to one camera, by default the first.

    Raises
    ------
    InputFileError
        If the car file cannot be read, or has a relative path to its array and the copy is in another folder.
    InvalidArgumentError
        If no camera has this name.
    """
    car = read_car(path)
    if not car.cameras:
        raise InputFileError(path, "expected a camera to align, but there is none")
    named = next(iter(car.cameras)) if camera is None else one_of("camera", camera, car.cameras)
    document: Any = read_json(path, "a car file")
    here, there = Path(path).absolute().parent, Path(out).absolute().parent
    file = (document.get("array") or {}).get("file")
    if file is not None and here != there and not Path(file).is_absolute():
        raise InputFileError(out, f"expected a file in {here}, where {file} is")
    one = next(each for each in document["cameras"] if each["name"] == named)
    one["stamp_offset_s"] = round((one.get("stamp_offset_s") or 0.0) + offset_s, 4)
    one["yaw_deg"] = round((one.get("yaw_deg") or 0.0) + yaw_deg, 3)
    write_json(out, document, indent=1)


def read_camera_setup(path: str | Path) -> tuple[PinholeCamera, CameraSetup]:
    """Read a camera from JSON as `read_camera` does, with the further keys of a car file.

    Raises
    ------
    InputFileError
        As for `read_camera`.
    """
    with refused_as_file(path):
        record = read_record(CameraRecord, path, "camera", by_hand=True)
        return record.camera(), _setup(record, Path(path).parent)


@dataclass(frozen=True, slots=True)
class _ArrayRecord:
    """Fields of the array in a car file."""

    file: str | None = None
    positions_m: tuple[tuple[float, float, float], ...] | None = None
    position_m: tuple[float, float, float] = field(default=(0.0, 0.0, 0.0), metadata=ADDED)
    yaw_deg: float = field(default=0.0, metadata=ADDED)
    pitch_deg: float = field(default=0.0, metadata=ADDED)
    roll_deg: float = field(default=0.0, metadata=ADDED)

    def array(self, path: Path) -> MicrophoneArray:
        if (self.file is None) == (self.positions_m is None):
            raise InvalidArgumentError("car.array: expected either file or positions_m")
        file = self.file
        read = None if file is None else read_array(path.parent / file)
        own, channels = (self.positions_m or (), ()) if read is None else (read.positions_m, read.channels)
        with _placed_at("car.array"):
            mounting = Mounting(self.position_m, self.yaw_deg, self.pitch_deg, self.roll_deg)
        return checked_array(path, mounting.applied(own).tolist(), "base_link", channels)


@dataclass(frozen=True, slots=True)
class _CarFile:
    """Fields of a car file."""

    array: _ArrayRecord | None = None
    cameras: tuple[CameraRecord, ...] = field(default=(), metadata=ADDED)
    name: str | None = None
    model: str | None = None
    odometry: str | None = None
    measurements: Mapping[str, str] = field(default_factory=dict, metadata=ADDED)
    crossing_m: float = field(default=9.0, metadata=ADDED)

    def car(self, path: Path) -> CarSensors:
        if len(self.cameras) > MOST_CAMERAS:
            got = len(self.cameras)
            raise InvalidArgumentError(f"car.cameras: expected at most {MOST_CAMERAS}, got {got}")
        folder = path.parent
        array, cameras, setups = None if self.array is None else self.array.array(path), {}, {}
        for number, record in enumerate(self.cameras):
            where = f"car.cameras[{number}]"
            if not record.name or record.name in cameras:
                raise InvalidArgumentError(f"{where}.name: expected a unique name, got {record.name!r}")
            with _placed_at(where):
                origin_m = (0.0, 0.0, 0.0) if self.array is None else self.array.position_m
                cameras[record.name] = _relative(record, origin_m)
                setups[record.name] = _setup(record, folder)
        model, odometry = (_beside(folder, file) for file in (self.model, self.odometry))
        measured = {name: folder / file for name, file in self.measurements.items()}
        crossing_m = in_range("car.crossing_m", self.crossing_m, 1.0, 100.0)
        return CarSensors(array, cameras, setups, model, odometry, measured, crossing_m)


def _beside(folder: Path, file: str | None) -> Path | None:
    return None if file is None else folder / file


def _setup(record: CameraRecord, folder: Path) -> CameraSetup:
    """Return the further settings of a camera, with its files in a folder."""
    detections, rates = (_beside(folder, file) for file in (record.detections, record.miss_rates))
    boxes = DetectionFilter(frozenset(record.classes), record.min_score)
    if record.min_box_px is not None:
        # Converted from the camera's images to those of OVAD, to which the filter refers.
        boxes = replace(boxes, min_height_px=record.min_box_px * OVAD_HEIGHT_PX / record.height_px)
    return CameraSetup(detections, record.image_rate_hz, rates, boxes, record.labels)


def _relative(record: CameraRecord, array_m: tuple[float, float, float]) -> PinholeCamera:
    if record.position_m is None:
        return record.camera()  # raises the error
    there = Mounting(record.position_m).position_m
    x, y, z = (one - origin for one, origin in zip(there, array_m, strict=True))
    return replace(record, position_m=(x, y, z)).camera()


@contextmanager
def _placed_at(where: str) -> Iterator[None]:
    """Add the part of the file to the message of an error."""
    try:
        yield
    except InvalidArgumentError as error:
        raise InvalidArgumentError(f"{where}: {str(error).removeprefix('camera: ')}") from error
