"""Comparison of microphone positions in any order with expected ones, and sorting by numbers in names."""

import logging
import re
from collections.abc import Sequence
from itertools import permutations, product
from pathlib import Path

import numpy as np

from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.typing import FloatArray, IndexArray

# Array files are accurate to a millimetre; half a wavelength at the top of the feature's band is 114 mm.
TOLERANCE_M = 1e-3
# Only `run` and `live` accept a model of another array; the other commands lack this option.
TRAIN = "Make a model for it (worldstate model make; of recordings model features, model fit)"
WAY_OUT = f"{TRAIN}, or go on with --uncalibrated (settings=ListenSettings(uncalibrated=True))"
_UNITS = {1.0: "", 1e-3: "looks like millimetres", 1e-2: "looks like centimetres"}
_LEAST_TURN_DEG = 0.5
_LOG = logging.getLogger(__name__)


def microphone_order(expected_m: FloatArray, array: MicrophoneArray) -> IndexArray | None:
    """Return the channels of `array` in the order of the expected positions; None if they do not match.

    A displacement of the whole array is ignored, because plane waves depend only on differences of delays.

    Parameters
    ----------
    expected_m : ndarray, shape (M, 3)
        Positions in `base_link` axes, metres.
    array : MicrophoneArray
        Array to compare, with a tolerance of 1 mm.

    Returns
    -------
    ndarray of int, shape (M,), or None
        ``array.positions_m[order]`` are the expected positions.

    Examples
    --------
    >>> there = np.array([[0.0, 0.1, 0.0], [0.0, -0.1, 0.0], [0.0, 0.0, 0.3]])
    >>> microphone_order(there, MicrophoneArray(there[[2, 0, 1]] + [2.0, 0.0, 1.5]))
    array([1, 2, 0])
    """
    return None if array.n_microphones != len(expected_m) else _order(_centred(expected_m), array.centred_m)


def array_difference(expected_m: FloatArray, array: MicrophoneArray) -> str:
    """Describe how an array differs from the expected positions, (M, 3), and the likely cause.

    Examples
    --------
    >>> there = np.array([[0.0, 0.1, 0.0], [0.0, -0.1, 0.0], [0.0, 0.0, 0.3], [0.0, 0.2, 0.2]])
    >>> array_difference(there, MicrophoneArray(there * [1, -1, 1]))
    'microphones up to 300 mm elsewhere; looks mirrored'
    """
    if array.n_microphones != len(expected_m):
        return f"{array.n_microphones} microphones, expected {len(expected_m)}"
    expected, found = _centred(expected_m), array.centred_m
    largest_m = float(np.linalg.norm(found - expected, axis=1).max())
    apart = f"microphones up to {1e3 * largest_m:.0f} mm elsewhere"
    return "; ".join(filter(None, (apart, _cause(expected, found))))


def by_number(path: Path, names: Sequence[str]) -> list[int]:
    """Return the order of microphones with numbered names; warn if they are given in another one.

    If the names differ only in their numbers and are sorted as by a shell or a spreadsheet (mic_1, mic_10,
    mic_2), they are sorted by number. Any other order is taken as intended and kept.

    Examples
    --------
    >>> by_number(Path("street"), ["mic_1.wav", "mic_10.wav", "mic_2.wav"])
    [0, 2, 1]
    >>> by_number(Path("street"), ["mic_3.wav", "mic_1.wav", "mic_2.wav"])
    [0, 1, 2]
    """
    given, small = list(range(len(names))), [name.casefold() for name in names]
    parts = [re.split(r"(\d{1,9})", name) for name in small]
    numbers, texts = [tuple(map(int, part[1::2])) for part in parts], {tuple(part[::2]) for part in parts}
    ranked = sorted(given, key=numbers.__getitem__)
    if len(texts) > 1 or len({*numbers}) < len(names) or ranked == given:
        return given
    # Some locales ignore punctuation and sort mic_10.wav before mic_1.wav.
    bare = [re.sub(r"[\W_]", "", name) for name in small]
    by_text = any(sorted(one) == one for one in (list(names), small, bare))
    done = "taken in that of the numbers" if by_text else "kept as they were given"
    at = next(i for i in given[:-1] if ranked[i] != i)
    told = "%s: %s, %s, ... are not in the order of their numbers: %s"
    _LOG.warning(told, path, names[at], names[at + 1], done)
    return ranked if by_text else given


def _centred(positions_m: FloatArray) -> FloatArray:
    return np.asarray(positions_m - positions_m.mean(axis=0))


def _order(expected: FloatArray, found: FloatArray) -> IndexArray | None:
    """Return the nearest of `found` for each of `expected` if all are within the tolerance and distinct."""
    distance = np.linalg.norm(expected[:, None] - found[None], axis=-1)
    # Try the given order first, so that microphones closer than the tolerance keep it.
    if np.diagonal(distance).max() <= TOLERANCE_M:
        return np.arange(len(expected))
    nearest = distance.argmin(axis=1)
    near = distance.min(axis=1).max() <= TOLERANCE_M
    return nearest if near and len(np.unique(nearest)) == len(nearest) else None


def _cause(expected: FloatArray, found: FloatArray) -> str:
    """Return the first simple mistake that explains the difference, empty if there is none."""
    for unit, in_words in _UNITS.items():
        for turn, how in _turns():
            if _order(expected, unit * found @ turn.T) is not None:
                return ", ".join(filter(None, (in_words, how)))
    scale = np.sqrt((found**2).sum() / (expected**2).sum())
    if _order(expected, found / scale) is not None:
        return f"looks scaled by {scale:.3g}"
    return _rotation(expected, found)


def _turns() -> "list[tuple[FloatArray, str]]":
    """Return the 48 permutations and reflections of three axes, simple ones first."""
    found = []
    for axes, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        turn = np.diag(signs)[:, axes]
        swapped, flipped = axes != (0, 1, 2), signs.count(-1.0)
        # A reversal of two axes is half a turn about the third.
        how = "looks mirrored" if flipped % 2 else "looks turned by half a turn" if flipped else ""
        found.append((6 * swapped + flipped, turn, "axes swapped" if swapped else how))
    return [(turn, how) for _, turn, how in sorted(found, key=lambda item: item[0])]


def _rotation(expected: FloatArray, found: FloatArray) -> str:
    """Return the rotation that explains the difference with channels in order (Kabsch's method)."""
    left, _, right = np.linalg.svd(found.T @ expected)
    proper = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    turn = left @ proper @ right
    if _order(expected, found @ turn) is None:
        return ""
    angle_deg = np.degrees(np.arccos(np.clip(0.5 * (np.trace(turn) - 1.0), -1.0, 1.0)))
    return f"looks rotated by {angle_deg:.0f} deg" if angle_deg > _LEAST_TURN_DEG else ""
