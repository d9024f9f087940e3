"""Hold an array, in whatever order, and a sample rate against what a model or a data set was made for."""

import hashlib
import logging
from collections.abc import Sequence
from itertools import permutations, product

import numpy as np

from worldstate.abduction.signature.published_signature import EgoMotion, ModelDomain
from worldstate.frontend.array.microphone_array import MicrophoneArray, ovad_array
from worldstate.frontend.direction.feature import (
    FEATURE_BAND_HZ,
    FEATURE_NFFT,
    FEATURE_RATE_HZ,
    FEATURE_VERSION,
    RATE_TOLERANCE,
    feature_nfft,
)
from worldstate.frontend.settings import FrontEndSettings
from worldstate.ground.errors import OutOfDomainError
from worldstate.ground.typing import FloatArray, IndexArray

from .model_file import Model

# Array files give millimetres; half a wavelength at the top of the feature's band is 114 mm.
TOLERANCE_M = 1e-3
# Only `run` and `live` go on with a model of another array; the other commands have no such option to name.
TRAIN = "Make a model for it (worldstate model make; of recordings model features, model fit)"
WAY_OUT = f"{TRAIN}, or go on with --uncalibrated (uncalibrated=True)"
_UNITS = {1.0: "", 1e-3: "looks like millimetres", 1e-2: "looks like centimetres"}
_LEAST_TURN_DEG = 0.5


def microphone_order(expected_m: FloatArray, array: MicrophoneArray) -> IndexArray | None:
    """Return the channels of `array` in the order of the expected positions, None where they are elsewhere.

    A displacement of the whole array does not count: plane waves show differences of delays only.

    Parameters
    ----------
    expected_m : ndarray, shape (M, 3)
        Positions in `base_link` axes, metres.
    array : MicrophoneArray
        To be compared, to 1 mm.

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
    if array.n_microphones != len(expected_m):
        return None
    return _order(_centred(expected_m), array.centred_m)


def array_difference(expected_m: FloatArray, array: MicrophoneArray) -> str:
    """Say how an array differs from the expected positions, (M, 3), and what is the likely cause.

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
    return "; ".join(
        filter(None, (f"microphones up to {1e3 * largest_m:.0f} mm elsewhere", _cause(expected, found)))
    )


def matched_order(made_for: MicrophoneArray, array: MicrophoneArray, way_out: str = TRAIN) -> IndexArray:
    """Return the channels of `array` in the order of the one that a model was made for.

    Raises
    ------
    OutOfDomainError
        If the microphones stand elsewhere; the message names the array, the difference and the way out.

    Examples
    --------
    >>> pair = MicrophoneArray([[0.0, 0.2, 0.0], [0.0, -0.2, 0.0]])
    >>> matched_order(pair, pair)
    array([0, 1])
    """
    order = microphone_order(made_for.positions_m, array)
    if order is None:
        difference = array_difference(made_for.positions_m, array)
        model = f"{made_for.name}, {made_for.n_microphones} microphones"
        raise OutOfDomainError(f"{array.name}: not the array of the model ({model}): {difference}. {way_out}")
    return order


def _centred(positions_m: FloatArray) -> FloatArray:
    return np.asarray(positions_m - positions_m.mean(axis=0))


def _order(expected: FloatArray, found: FloatArray) -> IndexArray | None:
    """Return the nearest of `found` for each of `expected` if all are near and each is taken once."""
    distance = np.linalg.norm(expected[:, None] - found[None], axis=-1)
    # Channel by channel first, so that microphones closer than the tolerance keep their order.
    if np.diagonal(distance).max() <= TOLERANCE_M:
        return np.arange(len(expected))
    nearest = distance.argmin(axis=1)
    near = distance.min(axis=1).max() <= TOLERANCE_M
    return nearest if near and len(np.unique(nearest)) == len(nearest) else None


def _cause(expected: FloatArray, found: FloatArray) -> str:
    """Return the first simple mistake that explains the difference, empty where none does."""
    for unit, in_words in _UNITS.items():
        for turn, how in _turns():
            if _order(expected, unit * found @ turn.T) is not None:
                return ", ".join(filter(None, (in_words, how)))
    scale = np.sqrt((found**2).sum() / (expected**2).sum())
    if _order(expected, found / scale) is not None:
        return f"looks scaled by {scale:.3g}"
    return _rotation(expected, found)


def _turns() -> "list[tuple[FloatArray, str]]":
    """Return the 48 ways to name and count three axes, the simple ones first."""
    found = []
    for axes, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        turn = np.diag(signs)[:, axes]
        swapped, flipped = axes != (0, 1, 2), signs.count(-1.0)
        # Two axes counted backwards are half a turn about the third.
        how = "looks mirrored" if flipped % 2 else "looks turned by half a turn" if flipped else ""
        found.append((6 * swapped + flipped, turn, "axes swapped" if swapped else how))
    return [(turn, how) for _, turn, how in sorted(found, key=lambda item: item[0])]


def _rotation(expected: FloatArray, found: FloatArray) -> str:
    """Return the rotation that explains the difference channel by channel (Kabsch's solution)."""
    left, _, right = np.linalg.svd(found.T @ expected)
    proper = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    turn = left @ proper @ right
    if _order(expected, found @ turn) is None:
        return ""
    angle_deg = np.degrees(np.arccos(np.clip(0.5 * (np.trace(turn) - 1.0), -1.0, 1.0)))
    return f"looks rotated by {angle_deg:.0f} deg" if angle_deg > _LEAST_TURN_DEG else ""


UNFIT = "the model says that it is unfit for use"

_LOG = logging.getLogger(__name__)


def domain_of(
    array: MicrophoneArray,
    rates_hz: Sequence[float],
    environments: Sequence[str],
    feature: str = FEATURE_VERSION,
) -> ModelDomain:
    """Return the domain of windows that an array heard at these rates, the ego as the environments say."""
    alike = [_rate_of_long_frames(rate, feature_nfft(rate)) for rate in rates_hz]
    low, high = (1.0 - RATE_TOLERANCE) * min(alike), (1.0 + RATE_TOLERANCE) * max(alike)
    motion = ego_motion_of(environments)
    return ModelDomain(array.name, array.positions_m, (low, high), FEATURE_BAND_HZ, feature, motion)


def ego_motion_of(environments: Sequence[str]) -> EgoMotion:
    """Return what the ego did at environments S.. (standing) and D.. (moving)."""
    kinds = {environment[:1] for environment in environments}
    return "any" if len(kinds) > 1 else "moving" if kinds == {"D"} else "standing"


def ovad_domain(environments: Sequence[str]) -> ModelDomain:
    """Return the domain of the windows released with OVAD."""
    return domain_of(ovad_array(), [FEATURE_RATE_HZ], environments)


def check_array(domain: ModelDomain, array: MicrophoneArray, way_out: str = TRAIN) -> IndexArray:
    """Return the channels of an array in the order that a model was made with.

    Raises
    ------
    OutOfDomainError
        If the microphones stand elsewhere; the message names the array, the difference and the way out.
    """
    return matched_order(array_of(domain), array, way_out)


def array_of(domain: ModelDomain) -> MicrophoneArray:
    """Return the array of a domain."""
    return MicrophoneArray(domain.positions_m, domain.array)


def heard_with(domain: ModelDomain) -> str:
    """Return what tells features of one array, band and kind from those of others."""
    places = np.round(domain.positions_m, 3) + 0.0  # No minus zero
    told = hashlib.sha256(places.astype("<f8").tobytes()).hexdigest()[:12]
    return f"{domain.array}, {told}, {_feature(domain.feature, domain.band_hz)}"


def states_budget(model: Model, array: MicrophoneArray, moving_ego: bool) -> bool:
    """Return whether a model's thresholds hold for an array and the ego's motion; a word where not.

    Raises
    ------
    OutOfDomainError
        If the model was made for another array.
    """
    domain = model.domain
    if domain is None:
        _LOG.warning("the model names no array that it was made for: no budget is stated")
        return False
    check_array(domain, array, WAY_OUT)
    if domain.ego_motion == ("standing" if moving_ego else "moving"):
        does, made_for = "moves" if moving_ego else "stands", domain.ego_motion
        _LOG.warning("the model was made for a %s ego, this one %s: no budget is stated", made_for, does)
        return False
    if not model.provenance.fit_for_use:
        _LOG.warning("%s: no budget is stated, its sequence is not used, advisories are rare", UNFIT)
    return model.provenance.fit_for_use


def feature_order(
    domain: ModelDomain,
    array: MicrophoneArray,
    sample_rate_hz: float,
    settings: FrontEndSettings,
    way_out: str = WAY_OUT,
) -> tuple[int, ...] | None:
    """Return the channels in the model's order where it is another one, or refuse what it was not made for.

    Raises
    ------
    OutOfDomainError
        If array, sample rate, band or feature is not what the model was made with.
    """
    low, high = domain.sample_rate_hz
    if not low <= _rate_of_long_frames(sample_rate_hz, settings.nfft) <= high:
        expected = (
            f"a model made for {low:.0f} to {high:.0f} Hz and frames of {FEATURE_NFFT} expects such sound"
        )
        got = f"{sample_rate_hz:g} Hz and frames of {settings.nfft}"
        raise OutOfDomainError(
            f"sample rate: {expected}, or a half, a quarter or an eighth of both, got {got}. {way_out}"
        )
    made_with = _feature(domain.feature, domain.band_hz)
    got = _feature(settings.feature_version, FEATURE_BAND_HZ)
    if got != made_with:
        raise OutOfDomainError(f"feature: the model was made with {made_with}, got {got}. {way_out}")
    order = check_array(domain, array, way_out)
    if (np.diff(order) == 1).all():
        return None
    _LOG.warning("%s: the model's microphones in another order; channels are put in the model's", array.name)
    return tuple(order.tolist())


def _feature(version: str, band_hz: tuple[float, float]) -> str:
    return f"{version}, {band_hz[0]:g} to {band_hz[1]:g} Hz"


def _rate_of_long_frames(sample_rate_hz: float, nfft: int) -> float:
    """Rate at which 512 samples last as long as a frame: ``512 f_s / N``."""
    # What the feature depends on: a model hears sound of 6 kHz in frames of 64 as it hears that of 48 kHz.
    return sample_rate_hz * FEATURE_NFFT / nfft


def check_tables(model: ModelDomain, table: ModelDomain) -> None:
    """Refuse windows of another array or feature than the model's; their channels cannot be put in order.

    Raises
    ------
    OutOfDomainError
        If array, order, band or feature differ.
    """
    order = check_array(model, array_of(table))
    if (np.diff(order) != 1).any():
        raise OutOfDomainError(
            "the table's microphones are the model's in another order: extract the features again with the "
            "channels in the model's order"
        )
    expected, got = (_feature(one.feature, one.band_hz) for one in (model, table))
    if got != expected:
        raise OutOfDomainError(f"feature: expected {expected}, got {got}")
