r"""Offset of a camera's clock and yaw relative to the array, from the bearings of vehicles in view.

A bearing of the sound is either that of the vehicle in view, with a normal error, or that of another source,
at a uniform azimuth. With the position b(t) of the sound source in the boxes, clock offset d and yaw y, the
log-likelihood is

.. math:: L(d, y) = \sum_i \log\Big(\epsilon + (1 - \epsilon)\, \pi\,
      N\big(\theta_i; b(t_i - d) + y, \sigma^2\big)\Big)

A bearing without a box at its time adds nothing. L is computed on a grid, so that no initial value is needed.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.adapters.audio.sound_file import open_sound
from worldstate.adapters.source import Source
from worldstate.frontend.array.microphone_array import SPEED_OF_SOUND_M_S
from worldstate.frontend.stream import FrontEnd
from worldstate.ground import InvalidArgumentError, wrap_angle
from worldstate.ground.typing import FloatArray
from worldstate.ground.values import vertex
from worldstate.operations.labelling.pass_labels import BoxTrack, box_tracks
from worldstate.operations.recordings.bearing_track import track_bearings
from worldstate.operations.recordings.hop_table import HopTable

# Search range, for clocks that are started by hand and brackets that are mounted by eye.
LARGEST_OFFSET_S, LARGEST_YAW_DEG = 1.0, 15.0
_OFFSET_STEP_S, _YAW_STEP_DEG = 0.01, 0.25
_OFFSETS_S, _YAWS_DEG = (
    step * np.arange(-round(largest / step), round(largest / step) + 1)
    for largest, step in ((LARGEST_OFFSET_S, _OFFSET_STEP_S), (LARGEST_YAW_DEG, _YAW_STEP_DEG))
)
# Error of a bearing of a vehicle in view: the published median of 3.4 degrees, and the error of a box.
_STD_RAD = np.radians(4.0)
# Share of bearings of other sources: one half at busy junctions.
_OTHER = 0.5
# Error at which a bearing is equally likely to come from the vehicle and from another source.
_OWN_RATIO = (1.0 - _OTHER) * np.pi / (_OTHER * _STD_RAD * np.sqrt(2.0 * np.pi))
_OWN_RAD = _STD_RAD * np.sqrt(2.0 * np.log(_OWN_RATIO))
# With fewer passes the interval would describe only one or two vehicles.
FEWEST_PASSES = 5
_FEWEST_A_SIDE = 2
_DRAWS = 400
# Weights of bearings near the first or last box decrease over this time. Boxes and bearings have a period of
# 0.1 s, so without weights the offset would tend to multiples of it.
_TAPER_S = 0.2
# After this time most of a vehicle has passed the corner, which cuts its earlier boxes.
_WHOLE_AFTER_S = 0.5
# Position of the sound source in its box, from the leading edge to the trailing one: between the middle and
# the front axle with the engine. On 38 simulated passes without an offset it gives an offset of zero; a tenth
# of a box more or less changes the offset by 0.1 s.
_HEARD_AT = 0.33
# Shorter views cannot separate offset and yaw.
_SHORTEST_S = 0.5
# Larger deviations come from flat spectra; the fit itself rejects bearings of other sources.
_LARGEST_STD_DEG = 40.0


@dataclass(frozen=True, slots=True, eq=False)
class HeardPass:
    """One vehicle: position of the sound source in its boxes, and all bearings around that time."""

    box_time_s: FloatArray  # Shape (n,), increasing, on the clock of the images
    box_rad: FloatArray  # Shape (n,): azimuth of the sound source in the box
    sound_time_s: FloatArray  # Shape (m,): emission time of the sound, on the clock of the sound
    sound_rad: FloatArray  # Shape (m,)


def heard_passes(source: Source, margin_s: float) -> list[HeardPass]:
    """Return every vehicle that crossed the view, with the bearings from `margin_s` before to after."""
    if source.detections is None:
        return []
    bearings = _bearings(source)
    # The bearing belongs to the time at which the vehicle emitted the sound.
    emitted_s = bearings.time_s - source.camera.nominal_range_m / SPEED_OF_SOUND_M_S
    usable = np.isfinite(bearings.azimuth_deg) & (bearings.std_deg < _LARGEST_STD_DEG)
    found = []
    for time_s, heard_rad in _whole(box_tracks(source.detections, source.camera, source.settings.boxes)):
        near = usable & (emitted_s > time_s[0] - margin_s) & (emitted_s < time_s[-1] + margin_s)
        found.append(HeardPass(time_s, heard_rad, emitted_s[near], np.radians(bearings.azimuth_deg[near])))
    return found


def _bearings(source: Source) -> HopTable:
    n_microphones, channels = source.array.n_microphones, source.array.channels
    with open_sound(source.sound, n_microphones, channels=channels, strict=False) as audio:
        settings = source.settings.front_end(source.array, audio.sample_rate_hz)
        return track_bearings(audio, FrontEnd(source.array, audio.sample_rate_hz, settings))


def _whole(tracks: list[BoxTrack]) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield times and azimuths of sound sources whose box neither corner nor image border cuts."""
    for track in tracks:
        trailing_rad = track.left_rad + track.right_rad - track.leading_rad
        heard_rad = (1.0 - _HEARD_AT) * track.leading_rad + _HEARD_AT * trailing_rad
        whole = np.isfinite(heard_rad) & (track.time_s >= track.time_s[0] + _WHOLE_AFTER_S)
        time_s = track.time_s[whole]
        if track.arm is not None and len(time_s) > 1 and time_s[-1] - time_s[0] >= _SHORTEST_S:
            yield time_s, heard_rad[whole]


@dataclass(frozen=True, slots=True)
class Alignment:
    """Corrections of a camera's stamps and yaw, each with its 95 % interval."""

    offset_s: float  # Correction that is added to the stamps of the images, to obtain the clock of the sound
    offset_interval_s: tuple[float, float]
    yaw_deg: float  # Correction that is added to the camera's yaw, left positive
    yaw_interval_deg: tuple[float, float]
    passes: int  # Number of vehicles in view
    bearings: int  # Number of bearings while a vehicle was in view
    agreeing: float  # Share of these bearings that are more likely from the vehicle than from another source
    median_error_deg: float  # Median error of the agreeing bearings


def align(passes: Sequence[HeardPass]) -> Alignment:
    """Return the alignment with the largest L; the interval is a bootstrap over the passes.

    Parameters
    ----------
    passes : sequence of HeardPass
        Vehicles that crossed the view; offset and yaw are separable only with vehicles from both sides.

    Returns
    -------
    Alignment
        Corrections to add to the values of the camera's file.

    Raises
    ------
    InvalidArgumentError
        If there are fewer than five passes or fewer than two from one side, or if the best alignment is at
        the edge of the search range.
    """
    _check_enough(passes)
    support = np.stack([_support(one) for one in passes])
    offset_s, yaw_deg = _best(support.sum(axis=0))
    _check_inside(offset_s, yaw_deg)
    draws = np.random.default_rng(0).integers(0, len(passes), (_DRAWS, len(passes)))
    counts = np.stack([np.bincount(draw, minlength=len(passes)) for draw in draws])
    drawn = np.array([_best(np.tensordot(count, support, 1)) for count in counts])
    low, high = np.percentile(drawn, (2.5, 97.5), axis=0)
    seen = (_errors(one, offset_s, yaw_deg)[_weights(one, offset_s) > 0.0] for one in passes)
    errors = np.concatenate(list(seen))
    own = np.abs(errors) < _OWN_RAD
    return Alignment(
        offset_s=offset_s,
        offset_interval_s=(float(low[0]), float(high[0])),
        yaw_deg=yaw_deg,
        yaw_interval_deg=(float(low[1]), float(high[1])),
        passes=len(passes),
        bearings=len(errors),
        agreeing=float(own.mean()),
        median_error_deg=float(np.degrees(np.median(np.abs(errors[own])))),
    )


def _check_enough(passes: Sequence[HeardPass]) -> None:
    if len(passes) < FEWEST_PASSES:
        problem = f"expected at least {FEWEST_PASSES} vehicles that turn through the view, got {len(passes)}"
        raise InvalidArgumentError(f"passes: {problem}: give more recordings")
    left = sum(float(one.box_rad[0]) > float(one.box_rad[-1]) for one in passes)
    right = len(passes) - left
    if min(left, right) < _FEWEST_A_SIDE:
        got = f"{left} from the left, {right} from the right"
        problem = f"expected at least {_FEWEST_A_SIDE} vehicles from each side, got {got}"
        raise InvalidArgumentError(f"passes: {problem}: from one side a yaw error looks like an offset")


def _check_inside(offset_s: float, yaw_deg: float) -> None:
    if abs(offset_s) > LARGEST_OFFSET_S - _OFFSET_STEP_S or abs(yaw_deg) > LARGEST_YAW_DEG - _YAW_STEP_DEG:
        within = f"within {LARGEST_OFFSET_S:g} s and {LARGEST_YAW_DEG:g} deg"
        got = f"got {offset_s:.2f} s and {yaw_deg:.1f} deg at its edge"
        raise InvalidArgumentError(f"passes: expected an alignment {within}, {got}: correct it by hand first")


def _support(one: HeardPass) -> FloatArray:
    """Return L of one pass on the grid, shape (offsets, yaws)."""
    yaws_rad = np.radians(_YAWS_DEG)
    rows = [_weights(one, at_s) @ _gain(_errors(one, at_s, 0.0)[:, None] - yaws_rad) for at_s in _OFFSETS_S]
    return np.stack(rows)


def _errors(one: HeardPass, offset_s: float, yaw_deg: float) -> FloatArray:
    """Return bearing minus box, radians."""
    box_rad = np.interp(one.sound_time_s - offset_s, one.box_time_s, one.box_rad)
    return np.asarray(wrap_angle(one.sound_rad - box_rad - np.radians(yaw_deg)))


def _weights(one: HeardPass, offset_s: float) -> FloatArray:
    """Return the weight of each bearing: 1 within the boxes, 0 outside."""
    at_s = one.sound_time_s - offset_s
    inside_s = np.minimum(at_s - one.box_time_s[0], one.box_time_s[-1] - at_s)
    return np.asarray(np.clip(inside_s / _TAPER_S, 0.0, 1.0))


def _gain(errors_rad: FloatArray) -> FloatArray:
    density = np.exp(-0.5 * (errors_rad / _STD_RAD) ** 2) / (_STD_RAD * np.sqrt(2.0 * np.pi))
    return np.asarray(np.log(_OTHER + (1.0 - _OTHER) * np.pi * density))


def _best(total: FloatArray) -> tuple[float, float]:
    """Return offset and yaw of the maximum, interpolated between grid points by parabolas."""
    row, column = np.unravel_index(int(total.argmax()), total.shape)
    return _peak(_OFFSETS_S, total[:, column], int(row)), _peak(_YAWS_DEG, total[row], int(column))


def _peak(grid: np.ndarray, values: FloatArray, at: int) -> float:
    shift = vertex(*values[at - 1 : at + 2].tolist()) if 0 < at < len(grid) - 1 else 0.0
    return float(grid[at] + shift * (grid[1] - grid[0]))
