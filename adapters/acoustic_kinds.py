"""What kind of road user is heard, and as what a camera would see it."""

from worldstate.abduction.road_users import (
    SEEN_AS,
    SIREN,
    UNKNOWN,
    ClassShares,
    RoadUserModel,
    likeliest,
    with_siren,
)
from worldstate.abduction.signature.domain_guard import DomainVerdict, Foreign, WarningSignal
from worldstate.frontend.spectra.sound_character import BANDS, MEASURES
from worldstate.ground.errors import OutOfDomainError
from worldstate.ground.typing import FloatArray

# Kinds that the camera is asked about together hold the one that is heard this often; a narrower question
# would take a wrong guess of the ear for a look at the right thing.
_ASKED = 0.95


def check_road_users(model: RoadUserModel) -> None:
    """Refuse a model that reads other numbers than the front-end measures."""
    if model.measures != (*MEASURES, *BANDS):
        expected = f"one of {len(MEASURES) + len(BANDS)} measures of this version"
        raise OutOfDomainError(f"road users: expected {expected}, got {len(model.measures)} others")


def heard_kinds(model: RoadUserModel, character: FloatArray, domain: DomainVerdict | None) -> ClassShares:
    """Return the classes of one hop; none where the sound is foreign."""
    if isinstance(domain, Foreign):
        return ()
    shares = model.classify(character)
    if isinstance(domain, WarningSignal) and domain.signal == SIREN:
        return with_siren(shares, domain.log_odds)
    return shares


def expected_labels(kinds: ClassShares) -> frozenset[str] | None:
    """Return the detector's classes that what is heard may be; None where it may be anything.

    Examples
    --------
    >>> sorted(expected_labels((("car", 0.9), ("unknown", 0.01), ("van", 0.09))))
    ['car', 'truck']
    >>> expected_labels((("car", 0.9), ("unknown", 0.1))) is expected_labels(()) is None
    True
    """
    likely = likeliest(kinds, _ASKED)
    if not likely or likely & {UNKNOWN, SIREN}:
        return None
    return frozenset().union(*(SEEN_AS[name] for name in likely))
