"""Entities: road users of the world-state, seen or hidden; their relations, and events in their life."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, TypeAlias
from uuid import NAMESPACE_OID, uuid5

from worldstate.ground.serialisation import Layout, Probability
from worldstate.ground.values import Answer

Status: TypeAlias = Literal["hidden", "emerged", "visible"]
AzimuthSource: TypeAlias = Literal["measured", "context"]
Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Classification:
    """A class label with its probability, given that the entity exists.

    Parameters
    ----------
    label : str
        Name of the class.
    probability : float
        In [0, 1]; the labels of one entity sum to at most 1.

    Examples
    --------
    >>> Classification("car", 0.8).label
    'car'
    """

    label: str
    probability: Probability


@dataclass(frozen=True, slots=True)
class Visibility:
    """Last answer of the co-evidence channel about an entity.

    Parameters
    ----------
    answer : {"visible", "absent", "unqueried"}
        Found, searched for and not found, or not searched for.
    miss_rate : float or None
        Probability that the channel misses such an entity in view; None where it was not asked.

    Examples
    --------
    >>> Visibility("absent", miss_rate=0.04)
    Visibility(answer='absent', miss_rate=0.04)
    """

    answer: Answer
    miss_rate: Probability | None = None


@dataclass(frozen=True, slots=True)
class SideShare:
    """One part of the azimuth density of a vehicle whose side is not known.

    Parameters
    ----------
    direction : str
        Approach side.
    probability : float
        P(it is on this side), given that it exists.
    azimuth_rad, azimuth_std_rad : float
        Where it is if so; left positive.

    Examples
    --------
    >>> SideShare("left", 0.6, 0.9, 0.3).direction
    'left'
    """

    direction: str
    probability: Probability
    azimuth_rad: float
    azimuth_std_rad: float


@dataclass(frozen=True, slots=True)
class Entity:
    """One road user. Unknown is None, never 0; all quantities are in `base_link`.

    Parameters
    ----------
    id : str
        UUID, stable for the life of the entity, through occlusion and back into view.
    status : {"hidden", "emerged", "visible"} or None
        Behind an occluder; in line of sight by its sound but not seen; handed over to vision. None if it is
        only known that something sounds there, as with an array without a model.
    existence_probability : float
        Probability that it exists; before vision has it, P(hidden on its side) + P(in view, come from there).
    hidden_probability : float or None
        Probability that it exists and is hidden; None if no model states it.
    azimuth_rad, azimuth_std_rad : float
        Left positive, in (-pi, pi]. Hidden entities have a coarse azimuth: their side is what can be known.
        Where the side is not known, those of the likelier one.
    created_ns, updated_ns : int
        First and last time stamps of the belief, ns.
    classification : tuple of Classification, or None
        Labels of the signature while hidden, of the detector once seen, and "unknown" for the rest; None if
        nothing has classified it.
    moving : bool
        False for an object that vision holds for parked.
    direction : str or None
        Approach side that it is hidden on, the likelier one where `sides` has several; of one in view, the
        side it came from, or whose edge it was first seen nearest to. None if its side is not known.
    azimuth_rate_rad_s : float or None
        d azimuth / dt, rad/s; None while hidden.
    range_m : float or None
        None while it cannot be observed, as from a standing ego without a ranging sensor.
    position_m : tuple of three floats or None
        None without a range; of a measured position, unless its standard deviation is below 5 m.
    velocity_mps : tuple of three floats or None
        Over ground; None without a measured position, and while its standard deviation exceeds 5 m/s.
    covariance : nested tuple of floats, shape (4, 4), or None
        Of (x, y, vx, vy), m and m/s; None unless a sensor has measured the position.
    time_to_visible_s : (float, float, float) or None
        Low, best and high of a hidden entity with a position, nine of ten in between; None unless it comes
        into view within eight seconds in nine of ten cases.
    inverse_tta_hz, inverse_tta_std_hz : float or None
        1/TTA = -r_dot/r, 1/s, positive while closing, and its standard deviation; None until measured.
    tta_s : float or None
        Time to arrival, s; None unless 1/TTA is positive by more than one standard deviation.
    visibility : Visibility
        Last answer of the co-evidence channel.
    sources : tuple of str
        Modalities that contributed.
    last_seen_ns : int or None
        Last sighting; None if never seen.
    sector_rad : (float, float) or None
        Where a hidden one is in nine of ten cases: from this azimuth to the left until that one.
    azimuth_covariance : (float, float, float) or None
        Variance of the azimuth, its covariance with its rate, variance of the rate; None while only heard.
    forecast : mapping of str to (float, float), or None
        Azimuth and its standard deviation in so many seconds ("1", "2") if it goes on as it does; None while
        only heard: the cue of its side tells when it comes into view.
    azimuth_source : {"measured", "context"} or None
        What the azimuth rests on: a box, a position or bearings; or the context's corners, with the time to
        visible where a sequence model gives one.
    sides : tuple of SideShare
        The parts of the azimuth density of one vehicle that may be hidden on several sides; empty where its
        side is known to nine of ten.

    Examples
    --------
    >>> hidden = Entity("id", "hidden", 0.9, 0.9, 0.8, azimuth_std_rad=0.3, created_ns=0, updated_ns=0)
    >>> hidden.range_m is None
    True
    """

    LAYOUT: ClassVar = Layout(
        order="id status existence_probability hidden_probability classification moving direction "
        "sides azimuth_rad azimuth_std_rad azimuth_source sector_rad azimuth_rate_rad_s range_m position_m "
        "velocity_mps inverse_tta_hz inverse_tta_std_hz tta_s visibility sources created_ns updated_ns"
    )

    id: str
    status: Status | None
    existence_probability: Probability
    hidden_probability: Probability | None
    azimuth_rad: float
    azimuth_std_rad: float
    created_ns: int
    updated_ns: int
    classification: tuple[Classification, ...] | None = ()
    moving: bool = True
    direction: str | None = None
    # None and not 0 from here on: a zero would read as a standing vehicle at the array.
    azimuth_rate_rad_s: float | None = None
    range_m: float | None = None
    position_m: Vector | None = None
    velocity_mps: Vector | None = None
    inverse_tta_hz: float | None = None
    inverse_tta_std_hz: float | None = None
    tta_s: float | None = None
    visibility: Visibility = Visibility("unqueried")
    sources: tuple[str, ...] = ()
    last_seen_ns: int | None = None
    covariance: tuple[tuple[float, ...], ...] | None = None
    time_to_visible_s: tuple[float, float, float] | None = None
    sector_rad: tuple[float, float] | None = None
    azimuth_covariance: Vector | None = None
    forecast: Mapping[str, tuple[float, float]] | None = None
    azimuth_source: AzimuthSource | None = None
    sides: tuple[SideShare, ...] = ()

    @property
    def azimuth_deg(self) -> float:
        """Azimuth, degrees, left positive."""
        return math.degrees(self.azimuth_rad)

    def on_each_side(self) -> tuple["Entity", ...]:
        """Return an entity of unknown side once for each, as likely as it is there; any other as it is.

        The likelier one keeps the id, the others have names of their own that follow from it.
        """
        parts = (
            replace(
                self,
                id=self.id
                if one.direction == self.direction
                else str(uuid5(NAMESPACE_OID, f"{self.id}/{one.direction}")),
                existence_probability=self.existence_probability * one.probability,
                hidden_probability=self.hidden_probability and self.hidden_probability * one.probability,
                direction=one.direction,
                azimuth_rad=one.azimuth_rad,
                azimuth_std_rad=one.azimuth_std_rad,
                sector_rad=None,
                sides=(),
            )
            for one in self.sides
        )
        return tuple(parts) or (self,)


EventKind: TypeAlias = Literal["born", "handed_over", "coasting", "hidden_again", "died", "merged"]


@dataclass(frozen=True, slots=True)
class Event:
    """A change in the life of an entity.

    Parameters
    ----------
    stamp_ns : int
        Of the state in which it is first, ns.
    kind : {"born", "handed_over", "coasting", "hidden_again", "died", "merged"}
        Begun; come into view of a sensor that had not seen it; in view before and not found by the last look;
        seen before and now behind an occluder; dropped; gone on as another one.
    entity_id : str
        Whose.
    into : str or None
        Under which id a merged one goes on; None of all other kinds.

    Examples
    --------
    >>> Event(0, "born", "a").kind
    'born'
    """

    stamp_ns: int
    kind: EventKind
    entity_id: str
    into: str | None = None


EGO = "ego"


@dataclass(frozen=True, slots=True)
class Relation:
    """An edge of the scene graph.

    Parameters
    ----------
    src, dst : str
        Ids of entities or occluders, or ``"ego"``.
    kind : str
        ``"occluded_by"``, ``"approaching_from"`` and ``"emerged_from"`` lead to an occluder,
        ``"approaching"`` and ``"conflicts_with_ego_path"`` (on the path ahead of it within five seconds) to
        the ego vehicle, ``"same_lane"`` and ``"in_front_of"`` to what an entity is next ahead of, the ego
        vehicle or another entity; these three are told of entities with a position.
    probability : float
        Probability that it holds, given that both ends exist; of ``"emerged_from"``, that the detection at
        the hand-over was of the entity that was hidden there.
    stamp_ns : int
        Time of the belief, ns.
    since_ns, until_ns : int or None
        Interval in which the probability was last at least .5, ns; the first is None if it never was, the
        second while it is. Both are forgotten five seconds after its end.

    Examples
    --------
    >>> Relation("a", EGO, "approaching", 0.9, 0).kind
    'approaching'
    """

    src: str
    dst: str
    kind: str
    probability: Probability
    stamp_ns: int
    since_ns: int | None = None
    until_ns: int | None = None
