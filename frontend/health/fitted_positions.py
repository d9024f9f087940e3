r"""Positions near those of an array file that explain its sound better.

The size that fits best is taken first, then every coordinate is moved so that

.. math:: \ln\Big(1 - \frac{\sum_s E_s(p)}{P}\Big) + \sum_m \frac{\|p_m - p^0_m\|^2}{D^2}

is least, with the energy E of part s that a plane wave over a diffuse field explains (`position_check`), all
coherent energy P, the extent D of the array and its positions :math:`p^0`: what the sound does not show stays
as it was given. A turn and a mirror image of the whole array are never seen. An axis along which the array
has no extent is not moved, and one along which no sound comes is held poorly.

References
----------
S. Thrun, "Affine structure from sound", NIPS 2005 (positions by far sources whose places are not known).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import BoolArray, FloatArray

from .position_check import FEW, LEAST_PARTS, NO_SIDE, OFF_BY_30, Comparison, PositionCheck

# Parts of all recordings together: two minutes, of which one evaluation takes some 10 ms with four channels.
_PARTS = 480
# Sizes to begin from, of which the best is within the reach of a descent.
_SIZES = (1.0, 0.5, 0.6, 0.7, 0.85, 1.18, 1.43, 1.67, 2.0)
# Least share of the coherent energy that counts as unexplained, so that a perfect fit has a logarithm.
_LEAST_LEFT = 1e-3
# Step of the numerical gradient, in extents of the array: directions are 5 degrees apart, and smaller steps
# see where the best one changes.
_STEP = 2e-3
# Extent along an axis over the largest below which the positions are flat there.
_FLAT = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class FittedPositions:
    """Positions that explain the sound of an array at least as well as those given.

    Parameters
    ----------
    positions_m : ndarray, shape (M, 3)
        In `base_link` axes, metres; those given where no others explain significantly more.
    explained, explained_before : float
        Share of the coherent energy that these and those given explain, in parts that were not fitted; in the
        same ones where there are less than 4 s, which `unjudged` then states.
    unjudged : tuple of str
        What this sound does not show: there the positions are near those given.

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
    """Fit positions to the recordings of one array that checks have taken.

    In simulated rooms (pyroomacoustics, reverberation of 0.4 s, talkers from 12 to 18 sides) rings of 4 and 6
    with radii of 3.2 and 4.5 cm whose file was 40 % too large, 30 % too small or 5 mm off at random come out
    within 4 mm at every microphone, up to a turn and a mirror image, which no sound shows.

    Parameters
    ----------
    checks : sequence of PositionCheck
        One a recording, all of one array and one sample rate.
    usable : ndarray of bool, shape (M,)
        Channels to fit, 3 to 16; the others stay where they are.

    Returns
    -------
    FittedPositions
        Of all channels, in the order of the checks' array.

    Raises
    ------
    InvalidArgumentError
        On another number of channels, sample rates that differ, or less than two seconds of sound that all
        microphones hear.

    Examples
    --------
    >>> from worldstate.frontend.array.microphone_array import MicrophoneArray
    >>> check = PositionCheck(MicrophoneArray(0.05 * np.eye(3)), 16000.0)
    >>> fit_positions([check], np.ones(3, bool))
    Traceback (most recent call last):
    worldstate.ground.errors.InvalidArgumentError: checks: expected 2 s of sound that all ..., got 0 s
    """
    first, n = checks[0], int(np.count_nonzero(usable))
    heard = [one.heard()[: max(_PARTS // len(checks), 1)] for one in checks]
    parts = sum(map(len, heard))
    for problem in (
        not 3 <= n <= FEW and f"3 to {FEW} channels that hear one sound, got {n}",
        len({one.sample_rate_hz for one in checks}) > 1 and "one sample rate, got several",
        parts < LEAST_PARTS and f"2 s of sound that all microphones hear, got {parts / 4:.2g} s",
    ):
        if problem:
            raise InvalidArgumentError(f"checks: expected {problem}")
    step = 2 if parts >= 2 * LEAST_PARTS else 1
    fitted, judged = (first.comparison(usable, np.concatenate(heard)[half::step]) for half in (0, step - 1))
    given = first.positions_m[usable] - first.positions_m[usable].mean(axis=0)
    found = _descent(_start(given, fitted), fitted)
    best = found if judged.is_better(found, given) else given
    positions = first.positions_m.copy()
    positions[usable] += best - given
    after, before = (float(judged.explained(one).sum()) for one in (best, given))
    unsure = () if step == 2 else ("other sound: there are less than 4 s, which were fitted",)
    return FittedPositions(positions, after, before, (*unsure, *_loose_axes(best, judged), *NO_SIDE))


def _start(given_m: FloatArray, fitted: Comparison) -> FloatArray:
    """Return the positions given in the order and the size that fit best."""
    placed = np.empty_like(given_m)
    placed[fitted.best_order()[0]] = given_m
    return placed * max(_SIZES, key=lambda size: fitted.explained(size * placed).sum())


def _descent(start_m: FloatArray, fitted: Comparison) -> FloatArray:
    """Move positions (m, 3) along the axes of their extent to where they explain the most."""
    scale_m = np.ptp(start_m) * (np.ptp(start_m, axis=0) > _FLAT * np.ptp(start_m))

    def left(steps: FloatArray) -> float:
        explained = fitted.explained(start_m + scale_m * steps.reshape(-1, 3)).sum()
        return float(np.log(max(1.0 - explained, _LEAST_LEFT)) + steps @ steps)

    best = minimize(left, np.zeros(start_m.size), method="L-BFGS-B", options={"eps": _STEP})
    return np.asarray(start_m + scale_m * best.x.reshape(-1, 3))


def _loose_axes(best_m: FloatArray, judged: Comparison) -> Iterator[str]:
    """Name the axes along which arrays of another extent explain the sound as well."""
    for axis, name in enumerate("xyz"):
        scaled = {scale: best_m * np.where(np.arange(3) == axis, scale, 1.0) for scale in OFF_BY_30}
        alike = [f"{scale:g}" for scale, one in scaled.items() if not judged.is_better(best_m, one)]
        if alike:
            yield f"{name}: {' or '.join(alike)} times the extent fits this sound as well"
