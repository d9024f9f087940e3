"""Comparison of an array and a sample rate with the domain of a model."""

import hashlib
import logging
from collections.abc import Sequence

import numpy as np

from worldstate.abduction.signature.published_signature import EgoMotion, ModelDomain
from worldstate.frontend.array.microphone_array import MicrophoneArray, ovad_array
from worldstate.frontend.direction import feature as published
from worldstate.frontend.settings import FrontEndSettings
from worldstate.ground.errors import OutOfDomainError
from worldstate.ground.typing import IndexArray

from .array_match import TRAIN, WAY_OUT, array_difference, microphone_order
from .model_file import Model
from .odometry_file import STANDING_MPS

UNFIT = "the model is marked as unfit for use"

_LOG = logging.getLogger(__name__)


def domain_of(array: MicrophoneArray, rates_hz: Sequence[float], environments: Sequence[str]) -> ModelDomain:
    """Return the domain of windows of an array at these sample rates and environments."""
    heard = map(published.feature_rate_hz, rates_hz)
    alike = [_rate_of_long_frames(rate, published.feature_nfft(rate)) for rate in heard]
    low, high = (1.0 - published.RATE_TOLERANCE) * min(alike), (1.0 + published.RATE_TOLERANCE) * max(alike)
    motion = ego_motion_of(environments)
    feature, band_hz = published.FEATURE_VERSION, published.FEATURE_BAND_HZ
    return ModelDomain(array.name, array.positions_m, (low, high), band_hz, feature, motion)


def ego_motion_of(environments: Sequence[str]) -> EgoMotion:
    """Return the ego motion of environments: those named D.. are moving, others standing."""
    moved = {environment[:1] == "D" for environment in environments}
    return "any" if len(moved) > 1 else "moving" if True in moved else "standing"


def ovad_domain(environments: Sequence[str]) -> ModelDomain:
    """Return the domain of the windows published with OVAD."""
    return domain_of(ovad_array(), [published.FEATURE_RATE_HZ], environments)


def check_array(domain: ModelDomain, array: MicrophoneArray, way_out: str = TRAIN) -> IndexArray:
    """Return the channels of an array in the order of the model.

    Raises
    ------
    OutOfDomainError
        If the positions differ; the message contains the array, the difference and a remedy.
    """
    order = microphone_order(domain.positions_m, array)
    if order is None:
        difference = array_difference(domain.positions_m, array)
        model = f"{domain.array}, {len(domain.positions_m)} microphones"
        raise OutOfDomainError(f"{array.name}: not the array of the model ({model}): {difference}. {way_out}")
    return order


def array_of(domain: ModelDomain) -> MicrophoneArray:
    """Return the array of a domain."""
    return MicrophoneArray(domain.positions_m, domain.array)


def heard_with(domain: ModelDomain) -> str:
    """Return a text that distinguishes features of one array, band and version from others."""
    places = np.round(domain.positions_m, 3) + 0.0  # No minus zero
    told = hashlib.sha256(places.astype("<f8").tobytes()).hexdigest()[:12]
    return f"{domain.array}, {told}, {_feature(domain.feature, domain.band_hz)}"


def states_budget(model: Model, array: MicrophoneArray, moving_ego: bool) -> bool:
    """Return whether a model's thresholds hold for an array and the ego's motion; warn if not.

    Raises
    ------
    OutOfDomainError
        If the model was made for another array.
    """
    domain = model.domain
    if domain is None:
        _LOG.warning("the model file has no array: no budget is stated")
        return False
    check_array(domain, array, WAY_OUT)
    if domain.ego_motion == ("standing" if moving_ego else "moving"):
        does, made_for = "moves" if moving_ego else "stands", domain.ego_motion
        _LOG.warning("the model was made for a %s ego, this one %s: no budget is stated", made_for, does)
        return False
    if not model.provenance.fit_for_use:
        _LOG.warning("%s: no budget is stated, its sequence is not used, advisories are rare", UNFIT)
    return model.provenance.fit_for_use


def outside_of(domain: ModelDomain | None, speed_mps: float) -> str | None:
    """Return why a model is not used at an ego speed; None if it is used, or has no known domain."""
    if domain is None or abs(speed_mps) <= STANDING_MPS:
        return None
    if domain.ego_motion == "standing":
        return "the ego drives, the model was made for one that stands"
    is_fast = domain.fastest_mps is not None and abs(speed_mps) > domain.fastest_mps
    return f"the ego drives faster than the model learned ({domain.fastest_mps:.1f} m/s)" if is_fast else None


def feature_order(
    domain: ModelDomain,
    array: MicrophoneArray,
    sample_rate_hz: float,
    settings: FrontEndSettings,
    way_out: str = WAY_OUT,
) -> tuple[int, ...] | None:
    """Return the channels in the model's order if it differs; refuse data outside the model's domain.

    Raises
    ------
    OutOfDomainError
        If array, sample rate, band or feature differs from that of the model.
    """
    low, high = domain.sample_rate_hz
    if sample_rate_hz < published.LEAST_RATE_HZ:
        advice = "record at 8 kHz or more: this sound lacks part of the model's band up to 2.7 kHz"
        raise OutOfDomainError(f"sample rate: expected at least 6000 Hz, got {sample_rate_hz:g} Hz: {advice}")
    rate, nfft = settings.heard_rate_hz or sample_rate_hz, settings.nfft
    if not low <= _rate_of_long_frames(rate, nfft) <= high:
        expected = f"frames as in the model, {published.FEATURE_NFFT} samples at {low:.0f} to {high:.0f} Hz"
        raise OutOfDomainError(f"frames: expected {expected}, got {nfft} at {rate:g} Hz. {way_out}")
    made_with = _feature(domain.feature, domain.band_hz)
    got = _feature(published.FEATURE_VERSION, published.FEATURE_BAND_HZ)
    if got != made_with:
        raise OutOfDomainError(f"feature: the model was made with {made_with}, got {got}. {way_out}")
    order = check_array(domain, array, way_out)
    if (np.diff(order) == 1).all():
        return None
    _LOG.warning("%s: its microphones are in another order than the model's and are reordered", array.name)
    return tuple(order.tolist())


def _feature(version: str, band_hz: tuple[float, float]) -> str:
    return f"{version}, {band_hz[0]:g} to {band_hz[1]:g} Hz"


def _rate_of_long_frames(sample_rate_hz: float, nfft: int) -> float:
    """Return the rate at which 512 samples last as long as a frame: ``512 f_s / N``."""
    # The feature depends only on this rate: frames of 64 samples at 6 kHz are equivalent to 512 at 48 kHz.
    return sample_rate_hz * published.FEATURE_NFFT / nfft


def check_tables(model: ModelDomain, table: ModelDomain) -> None:
    """Refuse windows of another array or feature than the model's, or with another channel order.

    Raises
    ------
    OutOfDomainError
        If array, order, band or feature differs.
    """
    order = check_array(model, array_of(table))
    if (np.diff(order) != 1).any():
        advice = "extract the features again with the channels in the model's order"
        raise OutOfDomainError(f"the table's microphones are the model's in another order: {advice}")
    expected, got = (_feature(one.feature, one.band_hz) for one in (model, table))
    if got != expected:
        raise OutOfDomainError(f"feature: expected {expected}, got {got}")
