"""Pinhole camera: conversion between image columns and azimuth in `base_link`."""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike

from worldstate.adapters.files.file_io import read_record, refused_as_file
from worldstate.ground import BoolArray, FloatArray, InvalidArgumentError, finite_array, in_range, wrap_angle
from worldstate.ground.serialisation import ADDED, Check, Probability
from worldstate.measurement.measurement import Sighting

# Largest offset in 64-bit nanoseconds, and largest yaw before wrapping.
MOST_OFFSET_S, MOST_TURNS_RAD = 9e9, 1e6
NOMINAL_RANGE_M = 10.0


@dataclass(frozen=True, slots=True)
class PinholeCamera:
    r"""A camera without distortion at `position_m` in `base_link` that looks along `yaw_rad`.

    For an object on the horizon in column u of an image W pixels wide, taken with pitch p (up positive),

    .. math:: \tan a = \frac{\cos p \tan h \,(2 u_0 - 2u) / W + \sin p \sin r}{\cos r}

    is the azimuth a off the optical axis, left positive, with half angle of view h, the axis in column u_0
    and roll r. The camera is not at the origin of `base_link`, so the azimuth there depends on the range. It
    is computed at `nominal_range_m` from the camera; the error at other ranges is part of the standard
    deviation of a sighting. For OVAD's offset the shift is 1.5 to 1.8 deg at 30 deg and 10 m. The height
    changes only the elevation, which is not used.

    Parameters
    ----------
    width_px, height_px : int
        Size of the image.
    half_angle_rad : float
        Half the horizontal angle of view, in (0, pi/2).
    principal_px : float, optional
        Column of the optical axis; the middle of the image if not given.
    roll_rad : float
        Turn about the optical axis, in (-pi/2, pi/2); positive lifts the left side.
    stamp_offset_s : float
        Added to the camera's stamps to obtain the clock of the sound, seconds.
    position_m : tuple of float
        Camera position (x, y, z) in `base_link`.
    yaw_rad, pitch_rad : float
        Direction of the optical axis: azimuth, left positive, wrapped into (-pi, pi], and elevation, up
        positive, in (-pi/2, pi/2).
    nominal_range_m : float
        Distance from the camera at which azimuths are exact; larger than the horizontal offset.
    range_spread : float
        Standard deviation of the range divided by the nominal range.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range.

    Examples
    --------
    >>> camera = PinholeCamera.ovad()
    >>> right, left = camera.view_rad
    >>> round(math.degrees(left), 1), round(math.degrees(right), 1)
    (35.9, -36.3)
    >>> bool(camera.azimuth(0.0) > 0)
    True
    """

    width_px: int
    height_px: int
    half_angle_rad: float
    position_m: tuple[float, float, float]
    yaw_rad: float = 0.0
    pitch_rad: float = 0.0
    nominal_range_m: float = NOMINAL_RANGE_M
    range_spread: float = 0.5
    principal_px: float | None = None
    roll_rad: float = 0.0
    stamp_offset_s: float = 0.0

    def __post_init__(self) -> None:
        in_range("width_px", self.width_px, 1, 1 << 16)
        in_range("height_px", self.height_px, 1, 1 << 16)
        in_range("half_angle_rad", self.half_angle_rad, 0.0, math.pi / 2, open_low=True, open_high=True)
        if abs(in_range("yaw_rad", self.yaw_rad, -MOST_TURNS_RAD, MOST_TURNS_RAD)) > math.pi:
            object.__setattr__(self, "yaw_rad", wrap_angle(float(self.yaw_rad)))
        in_range("pitch_rad", self.pitch_rad, -math.pi / 2, math.pi / 2, open_low=True, open_high=True)
        in_range("roll_rad", self.roll_rad, -math.pi / 2, math.pi / 2, open_low=True, open_high=True)
        in_range("stamp_offset_s", self.stamp_offset_s, -MOST_OFFSET_S, MOST_OFFSET_S)
        in_range("range_spread", self.range_spread, 0.0, math.inf)
        if self.principal_px is not None:
            in_range("principal_px", self.principal_px, 0.0, self.width_px)
        x, y, _ = finite_array("position_m", self.position_m, (3,))
        in_range("nominal_range_m", self.nominal_range_m, float(np.hypot(x, y)), math.inf, open_low=True)

    @classmethod
    def ovad(cls, **changes: Any) -> "PinholeCamera":
        """Return the camera of OVAD by its published data, with the given changes.

        Half angle of view 0.6 rad, aspect 0.628, 0.567 m behind, 0.485 m below and 0.0316 m right of the
        array, pitched up by 0.11979 rad.

        Examples
        --------
        >>> PinholeCamera.ovad(width_px=640, height_px=402).position_m
        (-0.567, -0.0316, -0.485)
        """
        return replace(cls(1936, 1216, 0.6, (-0.567, -0.0316, -0.485), pitch_rad=0.11979), **changes)

    @property
    def view_rad(self) -> tuple[float, float]:
        """Azimuths of the right and the left edge of the image, in `base_link` at the nominal range."""
        return float(self.azimuth(self.width_px)), float(self.azimuth(0.0))

    def azimuth(self, column_px: ArrayLike) -> FloatArray:
        """Return the azimuth in `base_link` of an image column.

        Parameters
        ----------
        column_px : array_like
            From 0 at the left edge to `width_px` at the right edge, any shape.

        Returns
        -------
        ndarray
            Radians in (-pi, pi], left positive, same shape.
        """
        seen = np.arctan(self._tangent(np.asarray(column_px, dtype=np.float64))) + self.yaw_rad
        x = self.position_m[0] + self.nominal_range_m * np.cos(seen)
        y = self.position_m[1] + self.nominal_range_m * np.sin(seen)
        return np.asarray(wrap_angle(np.arctan2(y, x)))

    def column(self, azimuth_rad: ArrayLike) -> FloatArray:
        """Return the image column of an azimuth in `base_link`: the inverse of `azimuth`.

        Parameters
        ----------
        azimuth_rad : array_like
            Radians, left positive, any shape.

        Returns
        -------
        ndarray
            Pixels: outside [0, width_px] beyond the edges, NaN at 90 deg or more off the axis.
        """
        off_axis = self.off_axis(azimuth_rad)
        ahead = np.where(np.abs(off_axis) < math.pi / 2, off_axis, np.nan)
        across = (np.tan(ahead) * math.cos(self.roll_rad) - self._tilt) / self._slope
        return np.asarray(0.5 * self.width_px * (self._middle - across))

    def off_axis(self, azimuth_rad: ArrayLike) -> FloatArray:
        """Convert an azimuth in `base_link` to the azimuth off the optical axis at the camera, (-pi, pi]."""
        azimuth = np.asarray(azimuth_rad, dtype=np.float64)
        x, y, _ = self.position_m
        along = x * np.cos(azimuth) + y * np.sin(azimuth)
        # Distance at which the ray from the origin meets the circle of nominal range around the camera.
        reach = along + np.sqrt(along**2 - x**2 - y**2 + self.nominal_range_m**2)
        seen = np.arctan2(reach * np.sin(azimuth) - y, reach * np.cos(azimuth) - x)
        return np.asarray(wrap_angle(np.asarray(seen - self.yaw_rad)))

    def sees(self, azimuth_rad: ArrayLike) -> BoolArray:
        """Return whether an azimuth in `base_link` is between the edges of the image."""
        left, right = np.arctan(self._tangent(np.array([0.0, self.width_px])))
        off_axis = self.off_axis(azimuth_rad)
        return np.asarray((right <= off_axis) & (off_axis <= left))

    def sighting(self, box_px: ArrayLike, label: str, score: float, *, moving: bool = True) -> Sighting:
        r"""Convert a box to a sighting in `base_link`.

        The azimuth is that of the box's centre column. Its variance has two parts: the sound source may be
        anywhere across the box, and its range is unknown,

        .. math:: \sigma^2 = w^2 / 12 + (\rho\, \Delta)^2

        with the width w, the parallax shift Delta at the nominal range, and rho = `range_spread`.

        Parameters
        ----------
        box_px : array_like
            Shape (4,): left, top, right, bottom.
        label, score
            Class and score from the detector.
        moving : bool
            False for a parked object.

        Raises
        ------
        InvalidArgumentError
            If the box is outside the image, which means that it comes from another camera.

        Examples
        --------
        >>> seen = PinholeCamera.ovad().sighting((0, 500, 400, 800), "car", 0.9)
        >>> round(math.degrees(seen.azimuth_rad)), round(math.degrees(seen.width_rad))
        (30, 13)
        """
        left_px, _, right_px, _ = finite_array("box_px", box_px, (4,))
        if right_px < 0.0 or left_px > self.width_px:
            got = f"columns {left_px:g} to {right_px:g}: boxes of an image of another size or camera"
            raise InvalidArgumentError(f"box_px: expected columns 0 to {self.width_px}, got {got}")
        edges_px = np.clip([left_px, right_px], 0.0, self.width_px)
        left, right = self.azimuth(edges_px)
        width = float(wrap_angle(left - right))
        centre = float(self.azimuth(edges_px.mean()))
        shift = float(wrap_angle(centre - self.yaw_rad - float(self.off_axis(centre))))
        std = math.hypot(width / math.sqrt(12.0), self.range_spread * shift)
        return Sighting(centre, std, label, score, width, moving)

    @property
    def _middle(self) -> float:
        """Column of the optical axis in half widths of the image; 1 at the middle."""
        return 1.0 if self.principal_px is None else 2.0 * self.principal_px / self.width_px

    @property
    def _slope(self) -> float:
        return math.cos(self.pitch_rad) * math.tan(self.half_angle_rad)

    @property
    def _tilt(self) -> float:
        return math.sin(self.pitch_rad) * math.sin(self.roll_rad)

    def _tangent(self, column_px: FloatArray) -> FloatArray:
        """Return tan(a) off the optical axis."""
        across = self._middle - 2.0 * column_px / self.width_px
        return np.asarray((self._slope * across + self._tilt) / math.cos(self.roll_rad))


def read_camera(path: str | Path) -> PinholeCamera:
    """Read a camera from JSON.

    ``{"width_px", "height_px", "horizontal_fov_deg", "position_m": [x, y, z]}``, the position in `base_link`,
    metres. ``{"fx", "cx"}`` of a calibration without distortion, pixels, may replace the field of view.
    Optional, with default 0, are ``"yaw_deg"`` (left positive), ``"pitch_deg"`` (up positive), ``"roll_deg"``
    (left side up) and ``"stamp_offset_s"``, which is added to the camera's stamps to obtain the clock of the
    sound.

    Raises
    ------
    InputFileError
        If the file is missing, too large or not JSON, has an unknown key, or a number is missing or out of
        range.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     name = Path(folder) / "camera.json"
    ...     lens = '{"width_px": 1280, "height_px": 720, "horizontal_fov_deg": 90, "position_m": [0, 0, 0]}'
    ...     _ = name.write_text(lens)
    ...     camera = read_camera(name)
    >>> [round(math.degrees(edge), 1) for edge in camera.view_rad]
    [-45.0, 45.0]
    """
    with refused_as_file(path):
        return read_record(CameraRecord, path, "camera", by_hand=True).camera()


def _between(low: float, high: float) -> Check:
    return Check(f"a number in ({low}, {high})", lambda value: low < value < high)


_Tilt = Annotated[float, _between(-90.0, 90.0)]
_MOST_TURNS_DEG = math.degrees(MOST_TURNS_RAD)


@dataclass(frozen=True, slots=True)
class CameraRecord:
    """Fields of a camera file, and of each camera in a car file; in units and under names of the file."""

    width_px: int
    height_px: int
    horizontal_fov_deg: Annotated[float, _between(0.0, 180.0)] | None = None
    fx: Annotated[float, _between(0.0, math.inf)] | None = None
    cx: float | None = None
    yaw_deg: Annotated[float, _between(-_MOST_TURNS_DEG, _MOST_TURNS_DEG)] | None = None  # is wrapped later
    pitch_deg: _Tilt | None = None
    roll_deg: _Tilt | None = None
    position_m: tuple[float, float, float] | None = None
    stamp_offset_s: float | None = None
    name: str | None = None
    detections: str | None = None
    image_rate_hz: Annotated[float, _between(0.0, 1e4)] | None = None
    miss_rates: str | None = None
    classes: tuple[str, ...] = field(default=("car", "motorcycle"), metadata=ADDED)
    min_score: Probability = field(default=0.75, metadata=ADDED)
    min_box_px: Annotated[float, Check("a number >= 0", lambda value: value >= 0.0)] | None = None
    labels: tuple[str, ...] = field(default=("car",), metadata=ADDED)

    def camera(self) -> PinholeCamera:
        """Return the camera."""
        if (self.horizontal_fov_deg is None) == (self.fx is None):
            raise InvalidArgumentError("camera: expected either horizontal_fov_deg or fx")
        half_angle = 0.5 * math.radians(self.horizontal_fov_deg or 0.0)
        if self.fx is not None:
            half_angle = math.atan2(0.5 * self.width_px, self.fx)
        if self.cx is not None:
            in_range("camera.cx", self.cx, 0.0, self.width_px)
        if self.position_m is None:
            problem = "expected its position in base_link, metres; [0, 0, 0] if it is at the array"
            raise InvalidArgumentError(f"camera.position_m: {problem}")
        if math.hypot(*self.position_m[:2]) >= NOMINAL_RANGE_M:
            expected = f"expected less than {NOMINAL_RANGE_M:g} m from the array along x and y, metres"
            raise InvalidArgumentError(f"camera.position_m: {expected}, got {list(self.position_m)}")
        return PinholeCamera(
            width_px=self.width_px,
            height_px=self.height_px,
            half_angle_rad=half_angle,
            position_m=self.position_m,
            yaw_rad=math.radians(self.yaw_deg or 0.0),
            pitch_rad=math.radians(self.pitch_deg or 0.0),
            principal_px=self.cx,
            roll_rad=math.radians(self.roll_deg or 0.0),
            stamp_offset_s=self.stamp_offset_s or 0.0,
        )
