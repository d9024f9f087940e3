r"""Positions that explain the sound of an array better than those of its file.

The descent starts from the best-fitting order and size, or from the delays of horizontal waves if these
explain more. It changes every coordinate so that

.. math:: \ln\Big(1 - \frac{\sum_s E_s(p)}{P}\Big) + \sum_m \frac{\|p_m - p^0_m\|^2}{D^2}

is minimal. E is the energy of part s that a plane wave in a diffuse field explains (`position_check`), P the
total coherent energy, D the extent of the array and :math:`p^0` its given positions. Coordinates that the
sound does not determine keep their given values. Rotations and mirror images of the whole array cannot be
determined. An axis without extent is not changed, and an axis without sound along it is uncertain.

References
----------
S. Thrun, "Affine structure from sound", NIPS 2005 (positions from far sources at unknown places).
"""

import math
from cmath import phase
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import minimize

from worldstate.frontend.array.microphone_array import SPEED_OF_SOUND_M_S
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import BoolArray, FloatArray

from .position_check import FEW, LEAST_PARTS, NO_SIDE, OFF_BY_30, Comparison, PositionCheck

# Number of parts over all recordings: two minutes. One evaluation takes about 10 ms with four channels.
_PARTS = 480
# Initial sizes; the best of them is close enough for a descent.
_SIZES = (1.0, 0.5, 0.6, 0.7, 0.85, 1.18, 1.43, 1.67, 2.0)
# Longest delay relative to the extent; largest residual of parts with a single wave relative to the median,
# and number of selections; two steps of the tested delays relative to the longest delay.
_LONGEST, _PLAIN, _ROUNDS, _FINE = 1.5, 2.0, 3, 0.02
# If the mean of the unit vectors towards all parts is longer than this, they do not determine the extent
# along its direction. Two sources 20 degrees apart in the open have 0.99, and the errors remain as large as
# before; two sources 60 degrees apart in a room have 0.83, with errors of 5 mm. True positions explain a
# share of 0.66 or more (rooms with 0.8 s of reverberation, talkers 2.5 m away).
_ONE_SIDE, _LEAST_EXPLAINED = 0.95, 0.6
# Smallest unexplained share of the coherent energy, so that a perfect fit has a finite logarithm.
_LEAST_LEFT = 1e-3
# Step of the numerical gradient, in extents of the array: directions are 5 degrees apart, and with smaller
# steps the discrete change of the best direction disturbs the gradient.
_STEP = 2e-3
# Relative gain at which the descent ends: a smaller value takes four times as long for less than 0.1 mm.
_FALL = 1e-4
# Ratio of the extent along an axis to the largest extent below which the array is flat along this axis.
_FLAT = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class FittedPositions:
    """Positions that explain the sound of an array at least as well as the given ones.

    Parameters
    ----------
    positions_m : ndarray, shape (M, 3)
        In `base_link` axes, metres; the given ones if no others explain significantly more.
    explained, explained_before : float
        Share of the coherent energy that these and the given positions explain, in parts that were not
        fitted. With less than 4 s of sound the parts are the fitted ones, and `unjudged` states this.
    unjudged : tuple of str
        Properties that this sound does not determine; there the positions are close to the given ones.

    Examples
    --------
    >>> FittedPositions(np.zeros((4, 3)), 0.97, 0.66).explained
    0.97
    """

    positions_m: FloatArray
    explained: float
    explained_before: float
    unjudged: tuple[str, ...] = ()


def fit_positions(checks: Sequence[PositionCheck], usable: BoolArray) -> FittedPositions:
    """Fit positions to the recordings of one array.

    Sound does not determine rotations and mirror images. Apart from them, plane waves from three directions
    give a ring within 1 mm. In simulated rooms (pyroomacoustics, at least six talkers), the given positions
    of rings of 4 and 6 with radii of 3.2 and 4.6 cm were 40 % too large, 30 % too small, permuted or 1 to 2
    cm off at random; the fitted ones are within 4 mm, and within 11 mm for 8 microphones on 24 cm.

    Parameters
    ----------
    checks : sequence of PositionCheck
        One per recording, all of one array and one sample rate.
    usable : ndarray of bool, shape (M,)
        Channels to fit, 3 to 16; the others keep their positions.

    Returns
    -------
    FittedPositions
        Positions of all channels, in the order of the checks' array.

    Raises
    ------
    InvalidArgumentError
        If the number of channels is outside 3 to 16, the sample rates differ, the coherent sound is shorter
        than two seconds or comes from one side, or no positions near the given ones explain most of it.

    Examples
    --------
    >>> from worldstate.frontend.array.microphone_array import MicrophoneArray
    >>> check = PositionCheck(MicrophoneArray(0.05 * np.eye(3)), 16000.0)
    >>> fit_positions([check], np.ones(3, bool))
    Traceback (most recent call last):
    worldstate.ground.errors.InvalidArgumentError: checks: expected 2 s of coherent sound, got 0 s
    """
    first, n = checks[0], int(np.count_nonzero(usable))
    heard = [one.heard()[: max(_PARTS // len(checks), 1)] for one in checks]
    parts = sum(map(len, heard))
    _refuse(
        not 3 <= n <= FEW and f"3 to {FEW} channels with a common sound, got {n}",
        len({one.sample_rate_hz for one in checks}) > 1 and "one sample rate, got several",
        parts < LEAST_PARTS and f"2 s of coherent sound, got {parts / 4:.2g} s",
    )
    step = 2 if parts >= 2 * LEAST_PARTS else 1
    parted = (np.concatenate(heard)[half::step] for half in (0, step - 1))
    fitted, judged = (Comparison(first, usable, part) for part in parted)
    given = first.positions_m[usable] - first.positions_m[usable].mean(axis=0)
    start = max(_starts(given, fitted), key=lambda one: fitted.explained(one).sum())
    found = _descent(start, fitted)
    best = found if judged.is_better(found, given) else given
    positions = first.positions_m.copy()
    positions[usable] += best - given
    after, before = (float(judged.explained(one).sum()) for one in (best, given))
    side = complex(np.exp(1j * judged.azimuths_rad(best)).mean())
    _refuse(
        abs(side) > _ONE_SIDE
        and f"sound from several sides, got sound from {math.degrees(phase(side)):.0f} degrees only",
        after < _LEAST_EXPLAINED and f"sound that some positions fit, the best explain {after:.2f} of it",
    )
    unsure = () if step == 2 else ("other sound: there are less than 4 s, which were fitted",)
    return FittedPositions(positions, after, before, (*unsure, *_loose_axes(best, judged), *NO_SIDE))


def _refuse(*problems: str | Literal[False]) -> None:
    for problem in filter(None, problems):
        raise InvalidArgumentError(f"checks: expected {problem}")


def _starts(given_m: FloatArray, fitted: Comparison) -> list[FloatArray]:
    """Return the given positions in the best-fitting order and size, and positions from delays alone."""
    placed = np.empty_like(given_m)
    placed[fitted.best_order()[0]] = given_m
    sized = placed * max(_SIZES, key=lambda size: fitted.explained(size * placed).sum())
    return [sized, *_by_delays(sized, fitted)]


def _by_delays(near_m: FloatArray, fitted: Comparison) -> list[FloatArray]:
    r"""Return positions (m, 3) from delays of horizontal waves, rotated to given ones; none if impossible.

    The delays D of all parts have rank two. The affine factor follows from the unit length of directions:

    .. math:: D = U S V^T, \qquad u_s^T B\, u_s = 1, \qquad B = L L^T, \qquad P = c\, V S\, L^{-T}
    """
    longest_s = _LONGEST * float(np.ptp(near_m, axis=0).max()) / SPEED_OF_SOUND_M_S
    delays_s = fitted.delays_s(longest_s)
    plain = np.ones(len(delays_s), bool)
    for _ in range(_ROUNDS):  # Excludes parts with two sounds or a reflection
        u, s, v = np.linalg.svd(delays_s[plain], full_matrices=False)
        left = np.linalg.norm(delays_s - delays_s @ v[:2].T @ v[:2], axis=1)
        plain = left <= max(_PLAIN * np.median(left), _FINE * longest_s)
    u, s, v = np.linalg.svd(delays_s[plain], full_matrices=False)
    x, y = u[:, 0], u[:, 1]
    a, b, c = np.linalg.lstsq(np.stack([x * x, 2.0 * x * y, y * y], axis=1), np.ones(len(x)), rcond=None)[0]
    values, axes = np.linalg.eigh(np.array([[a, b], [b, c]]))
    if not values[0] > 0.0:
        return []
    level_m = SPEED_OF_SOUND_M_S * (v[:2].T * s[:2]) @ (axes / np.sqrt(values))
    left_axes, _, right_axes = np.linalg.svd(level_m.T @ near_m[:, :2])
    return [np.column_stack([level_m @ left_axes @ right_axes, near_m[:, 2]])]


def _descent(start_m: FloatArray, fitted: Comparison) -> FloatArray:
    """Change positions (m, 3) along the axes of their extent until they explain the most."""
    scale_m = np.ptp(start_m) * (np.ptp(start_m, axis=0) > _FLAT * np.ptp(start_m))

    def left(steps: FloatArray) -> float:
        explained = fitted.explained(start_m + scale_m * steps.reshape(-1, 3)).sum()
        return float(np.log(max(1.0 - explained, _LEAST_LEFT)) + steps @ steps)

    best = minimize(left, np.zeros(start_m.size), method="L-BFGS-B", options={"eps": _STEP, "ftol": _FALL})
    return np.asarray(start_m + scale_m * best.x.reshape(-1, 3))


def _loose_axes(best_m: FloatArray, judged: Comparison) -> Iterator[str]:
    """Yield the axes along which arrays of another extent explain the sound equally well."""
    for axis, name in enumerate("xyz"):
        scaled = {scale: best_m * np.where(np.arange(3) == axis, scale, 1.0) for scale in OFF_BY_30}
        alike = [f"{scale:g}" for scale, one in scaled.items() if not judged.is_better(best_m, one)]
        if alike:
            yield f"{name}: {' or '.join(alike)} times the extent fits the sound as well"
