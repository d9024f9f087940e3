"""The belief of one entity."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Annotated, TypeAlias, TypeVar
from uuid import UUID, uuid5

import numpy as np

from worldstate.abduction.road_users import UNKNOWN, ClassShares
from worldstate.belief.kinematics.cartesian import CartesianBelief, polar_motion, predict_place
from worldstate.belief.kinematics.motion import AZIMUTH_RATE, MotionBelief, predict, relax
from worldstate.ground import BoolArray, FloatArray
from worldstate.ground.serialisation import FLAT, Count, Keys, Probability
from worldstate.ground.values import Answer

from .side_belief import SideBelief
from .site_geometry import SideGeometry, SiteGeometry

# Of the name-based UUIDs below; any constant serves, but a change renames every entity of every recording.
_NAMESPACE = UUID("6f1d3c52-8a0e-5a6b-9d0f-3f6f0f6f5b11")
# At a score of .9 three sightings in a row outvote a label held with certainty; with a gain of 1 every
# misread image would rename the entity.
LABEL_GAIN = 0.3
# Hops share nineteen twentieths of the two seconds that they are classified by.
_HEARD_GAIN = 0.2
# White acceleration, m^2/s^3: 1.4 m/s of speed in a second, as braking and turning in town have. A parked one
# must not drift with its boxes, but stay updatable.
_ACCELERATION, _PARKED_ACCELERATION = 2.0, 1e-4
# To the prior, of components that are not measured: one window; what its sound did not confirm fades.
_RELAXATION_S = 1.0
_VISIBLE_LIFE_S = 10.0  # Mean, of a seen entity without looks
# Prior of a vehicle in view, of which only the azimuth is measured: neither closing nor receding, within .5
# 1/s, at exp(3.2) = 25 m within a factor of 1.8.
_IN_VIEW = MotionBelief.around((0.0, 0.0, 0.0, 3.2), (1.0, 1.0, 0.5, 0.6))

# Of the position, m: five seconds after a sharp one, and twice what is published. Then only the azimuth is
# tracked, or a hidden one's side.
_LOST_PLACE_M = 10.0


NumbersT = TypeVar("NumbersT", float, FloatArray)  # Of one entity, or of each of many
Label: TypeAlias = Annotated[tuple[str, float], Keys("label", "probability")]


@dataclass(eq=False)
class Track:
    """Existence, motion, class and history of one entity; a step writes into copies of its own."""

    id: str  # UUID for life
    side: Count  # Index of the approach side that it is hidden on, came from, or first appeared nearest to
    seen: bool  # Whether vision has it; before that its existence is read from the explanation belief
    existence: Probability
    motion: MotionBelief = field(metadata=FLAT)  # Azimuth, rates, log range
    labels: tuple[Label, ...]  # Class probabilities, sorted by label
    moving: bool  # False for what vision holds for parked
    sources: tuple[str, ...]  # Modalities that contributed, sorted
    created_ns: int  # Birth and last measurement that moved it
    updated_ns: int
    last_seen_ns: int | None = None  # Last sighting
    answer: Answer = "unqueried"  # Last answer of the co-evidence channel about it
    miss_rate: Probability | None = None  # beta of that answer
    approach_heard: bool = False  # Whether its approach rate was ever measured
    # P(it was hidden on its side): of one in view, that of the association at its hand-over.
    came_from: Probability = 0.0
    place: CartesianBelief | None = None  # Then `motion` follows from it
    behind: Probability = 1.0  # P(behind its side's occluder), by that place
    width_rad: float = 0.0  # Of its last box
    # P(it is of a side | exists) of one only heard, whose side is not known; empty where it is.
    side_shares: tuple[Probability, ...] = ()

    @property
    def of_side(self) -> int | None:
        """The side that its existence is read from: None, of any, where it is not known."""
        return None if self.side_shares and not self.detected else self.side

    def may_be_on(self, side: int) -> bool:
        """Tell whether it is, or may be, of a side."""
        return self.side == side if self.of_side is not None else self.side_shares[side] > 0.0

    def unseen_ns(self, stamp_ns: int) -> float:
        """Return how long before a time it was last seen; infinite where it never was."""
        return math.inf if self.last_seen_ns is None else stamp_ns - self.last_seen_ns

    @property
    def detected(self) -> bool:
        """Whether a sensor or a message has told where it is: it was not only heard."""
        return self.seen or self.place is not None


@dataclass(frozen=True, slots=True, eq=False)
class TrackArrays:
    """What a step reads of all tracks at once, shape (tracks,) each."""

    motion: MotionBelief
    existence: FloatArray
    seen: BoolArray
    detected: BoolArray
    moving: BoolArray
    behind: FloatArray
    width_rad: FloatArray

    @classmethod
    def of(cls, tracks: Sequence[Track]) -> "TrackArrays":
        """Return the arrays of some tracks."""
        seen = np.array([one.seen for one in tracks], bool)
        return cls(
            MotionBelief.stacked([one.motion for one in tracks]),
            np.array([one.existence for one in tracks]),
            seen,
            seen | np.array([one.place is not None for one in tracks], bool),
            np.array([one.moving for one in tracks], bool),
            np.array([one.behind for one in tracks]),
            np.array([one.width_rad for one in tracks]),
        )


def entity_id(stream: str, kind: str, number: int) -> str:
    """Return the name-based UUID of the n-th entity of a kind in a stream; the same run gives the same ids.

    Examples
    --------
    >>> entity_id("drive", "left", 0) == entity_id("drive", "left", 0) != entity_id("drive", "left", 1)
    True
    """
    return str(uuid5(_NAMESPACE, f"{stream}/{kind}/{number}"))


def born(kind: str, number: int, existence: float, stamp_ns: int, site: SiteGeometry) -> Track:
    """Return the n-th entity of a kind, of which nothing else is known: what has found it follows."""
    return Track(
        id=entity_id(site.settings.stream, kind, number),
        side=0,
        seen=False,
        existence=existence,
        motion=_IN_VIEW,
        labels=((UNKNOWN, 1.0),),
        moving=True,
        sources=(),
        created_ns=stamp_ns,
        updated_ns=stamp_ns,
    )


def after_empty_look(existence: NumbersT, miss_rate: NumbersT) -> NumbersT:
    r"""Return the existence after a missed detection.

    .. math:: r \leftarrow \frac{r \beta}{r \beta + 1 - r} = \frac{r (1 - p_D)}{1 - r\, p_D},
        \qquad p_D = 1 - \beta
    """
    missed = existence * miss_rate
    return missed / (missed + 1.0 - existence)


def after_sighting(existence: NumbersT, miss_rate: float, clutter_rate: float) -> NumbersT:
    r"""Return the existence after a detection.

    .. math:: r \leftarrow \frac{r\, (1 - \beta (1 - c))}{r\, (1 - \beta (1 - c)) + (1 - r)\, c}
    """
    # A look finds something where the entity is detected or, if it is missed, where there is clutter.
    found = existence * (1.0 - miss_rate * (1.0 - clutter_rate))
    return found / (found + (1.0 - existence) * clutter_rate)


def predict_tracks(tracks: Sequence[Track], sides: SideBelief, step_s: float, site: SiteGeometry) -> None:
    """Move tracks on by a time step without a measurement."""
    shares = {track.id: hidden_share(track, sides) for track in tracks}
    _drive_on([track for track in tracks if track.place is not None], step_s, site)
    # Those that have just lost their place, too.
    polar = [track for track in tracks if track.place is None]
    if polar:
        _relax(polar, [shares[track.id] for track in polar], step_s, site)


def turn(tracks: Sequence[Track], faster_rad_s: float) -> None:
    """Turn tracks into the axes of an ego vehicle that now turns so much faster to the left."""
    for track in tracks:
        if track.seen and track.place is None:
            mean = track.motion.mean.copy()
            mean[AZIMUTH_RATE] -= faster_rad_s
            track.motion = replace(track.motion, mean=mean)


def _drive_on(tracks: Sequence[Track], step_s: float, site: SiteGeometry) -> None:
    """Move the places of tracks on by a step, and drop those that are lost."""
    if not tracks:
        return
    stacked = CartesianBelief.stacked([one.place for one in tracks if one.place])
    accelerations = np.array([acceleration_psd(one) for one in tracks])
    after = predict_place(stacked, step_s, accelerations, site.ego_speed_mps, site.ego_yaw_rate_rad_s)
    for track, place in zip(tracks, after.each(), strict=True):
        # No life time here: a sender that keeps sending is there, a silent one is lost within seconds.
        track.place = place
        if place.position_std_m > _LOST_PLACE_M:
            track.place, track.behind = None, 1.0
            if not track.seen:
                track.motion = site.sides[track.side].prior()
    follow_places(tracks, site)


def acceleration_psd(track: Track) -> float:
    """Return the density of the white acceleration that a track moves by, m^2/s^3."""
    return _ACCELERATION if track.moving else _PARKED_ACCELERATION


def _relax(
    tracks: Sequence[Track], hidden_shares: Sequence[float], step_s: float, site: SiteGeometry
) -> None:
    """Move tracks without a place by a step, drawn to what is expected of vehicles in view or hidden."""
    seen = np.array([track.seen for track in tracks])
    accelerations = np.where([track.moving for track in tracks], _ACCELERATION, _PARKED_ACCELERATION)
    motion = predict(MotionBelief.stacked([track.motion for track in tracks]), step_s, accelerations)
    # The azimuth relaxes to the hidden prior by P(hidden | exists): a vehicle still hidden has not passed the
    # corner, whatever its last rates said.
    kept = np.exp(-step_s * np.where(seen, 0.0, hidden_shares) / _RELAXATION_S)
    expected = _expected(site.sides)
    of = [-1 if one.seen else one.side for one in tracks]
    towards = MotionBelief(expected.mean[of], expected.covariance[of])
    relaxed = relax(motion, towards, kept, math.exp(-step_s / _RELAXATION_S))
    lasts = math.exp(-step_s / _VISIBLE_LIFE_S)
    for track, moved in zip(tracks, relaxed.each(), strict=True):
        track.motion = moved
        if track.seen:
            track.existence *= lasts


@lru_cache(maxsize=64)
def _expected(sides: tuple[SideGeometry, ...]) -> MotionBelief:
    """Return what is expected of vehicles that are hidden on each side, and last of those in view."""
    return MotionBelief.stacked([*(side.prior() for side in sides), _IN_VIEW])


def follow_places(tracks: Sequence[Track], site: SiteGeometry) -> None:
    """Give tracks the polar motion, and the chance to be hidden, that follow from their places."""
    placed = [track for track in tracks if track.place is not None]
    if not placed:
        return
    places = CartesianBelief.stacked([track.place for track in placed if track.place])
    polar = polar_motion(places, site.ego_speed_mps, site.ego_yaw_rate_rad_s)
    for track, motion in zip(placed, polar.each(), strict=True):
        track.motion = motion
        track.behind = site.sides[track.side].behind(motion.azimuth_rad, motion.azimuth_std_rad)


def relabelled(
    labels: tuple[Label, ...], seen_as: ClassShares, gain: float = LABEL_GAIN
) -> tuple[Label, ...]:
    """Return class probabilities after one detection, an exponential average over detections.

    Examples
    --------
    >>> relabelled((("car", 0.9),), (("truck", 0.8),))
    (('car', 0.63), ('truck', 0.24))
    """
    kept = {label: probability * (1.0 - gain) for label, probability in labels}
    for label, probability in seen_as:
        kept[label] = kept.get(label, 0.0) + gain * probability
    return tuple(sorted((label, round(p, 12)) for label, p in kept.items() if p > 1e-3))


def hidden_share(track: Track, sides: SideBelief) -> float:
    """Return P(hidden | exists) of a track, 0 once it was seen."""
    if track.seen:
        return 0.0
    return sides.hidden_share(track.of_side) if track.place is None else track.behind


def side_weights(track: Track, sides: int) -> tuple[float, ...]:
    """Return P(an entity is of a side | exists), shape (sides,)."""
    known = tuple(float(k == track.side) for k in range(sides))
    return track.side_shares if track.of_side is None else known


def heard_as(track: Track, kinds: ClassShares) -> tuple[Label, ...]:
    """Return class probabilities after one more hop; what a detector once said, the ear does not change."""
    if not kinds or track.last_seen_ns is not None:
        return track.labels
    return relabelled(track.labels, kinds, _HEARD_GAIN)


def merged(sources: tuple[str, ...], source: str) -> tuple[str, ...]:
    """Return the sorted names of the sources with one more."""
    return sources if source in sources else tuple(sorted((*sources, source)))
