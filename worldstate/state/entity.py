"""Entities: road users of the world-state, in view or hidden; their relations and events."""

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
    """Last result of the co-evidence channel for an entity.

    Parameters
    ----------
    answer : {"visible", "absent", "unqueried"}
        Found, searched but not found, or not searched.
    miss_rate : float or None
        Probability that the channel misses such an entity in view; None if it was not searched.

    Examples
    --------
    >>> Visibility("absent", miss_rate=0.04)
    Visibility(answer='absent', miss_rate=0.04)
    """

    answer: Answer
    miss_rate: Probability | None = None


@dataclass(frozen=True, slots=True)
class SideShare:
    """One part of the azimuth density of a vehicle of unknown side.

    Parameters
    ----------
    direction : str
        Approach side.
    probability : float
        P(it is on this side), given that it exists.
    azimuth_rad, azimuth_std_rad : float
        Its azimuth on this side and the standard deviation, left positive.

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
    """One road user. Unknown quantities are None, never 0; all are in the frame `base_link`.

    Parameters
    ----------
    id : str
        UUID, which stays the same through occlusion and hand-over.
    status : {"hidden", "emerged", "visible"} or None
        Behind an occluder; in line of sight by its sound but not detected by a camera; detected by a camera.
        None if only a direction of sound is known, as with an array without a model.
    existence_probability : float
        Probability that it exists. Before the hand-over to a camera: P(hidden on its side) + P(in view, from
        that side).
    hidden_probability : float or None
        Probability that it exists and is hidden; None without a model.
    azimuth_rad, azimuth_std_rad : float
        Left positive, in (-pi, pi]. The azimuth of a hidden entity is coarse: only its side can be inferred.
        If the side is unknown, the values are those of the likelier side.
    created_ns, updated_ns : int
        Times of the first and the last belief about it, ns.
    classification : tuple of Classification, or None
        Labels of the signature model while hidden, of the detector after the hand-over, and "unknown" for the
        rest; None if nothing has classified it.
    moving : bool
        False if its boxes did not move: a parked vehicle.
    direction : str or None
        Approach side on which it is hidden, the likelier one if `sides` has several. In view: the side from
        which it came, or the side of the edge nearest to its first detection. None if the side is unknown.
    azimuth_rate_rad_s : float or None
        d azimuth / dt, rad/s; None while hidden.
    range_m : float or None
        None while it is unobservable, as for a standing ego without a ranging sensor.
    position_m : tuple of three floats or None
        None without a range, and while the standard deviation of a measured position is 5 m or more.
    velocity_mps : tuple of three floats or None
        Over ground; None without a measured position, and while its standard deviation exceeds 5 m/s.
    covariance : nested tuple of floats, shape (4, 4), or None
        Covariance of (x, y, vx, vy), m and m/s; None unless a sensor has measured the position.
    time_to_visible_s : (float, float, float) or None
        Low, best and high estimate for a hidden entity with a position, a 90 % interval; None unless it comes
        into view within 8 s with 90 % probability.
    inverse_tta_hz, inverse_tta_std_hz : float or None
        1/TTA = -r_dot/r, 1/s, positive while closing, and its standard deviation; None until measured.
    tta_s : float or None
        Time to arrival, s; None unless 1/TTA is positive by more than one standard deviation.
    visibility : Visibility
        Last result of the co-evidence channel.
    sources : tuple of str
        Modalities that contributed.
    last_seen_ns : int or None
        Time of the last sighting; None if there was none.
    sector_rad : (float, float) or None
        Right and left end of the 90 % interval of the azimuth of a hidden entity.
    azimuth_covariance : (float, float, float) or None
        Variance of the azimuth, its covariance with the rate, and variance of the rate; None if it was
        detected by sound only.
    forecast : mapping of str to (float, float), or None
        Azimuth and its standard deviation in 1 and 2 s (keys "1", "2") at constant motion; None if it was
        detected by sound only: `time_to_visible_s` of the cue is the forecast then.
    azimuth_source : {"measured", "context"} or None
        Origin of the azimuth: a box, a position or bearings; or the corners of the context, with the time to
        visible of a sequence model if there is one.
    sides : tuple of SideShare
        The parts of the azimuth density of one vehicle that may be hidden on several sides; empty if one side
        has at least 90 %.

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
    # The defaults below are None: 0 would mean a standing vehicle at the array.
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
        """Return an entity of unknown side once per side, with the probability of that side.

        The likeliest one keeps the id; the ids of the others are derived from it. An entity of known side is
        returned unchanged.
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
    """A change of an entity.

    Parameters
    ----------
    stamp_ns : int
        Time of the first state that has the change, ns.
    kind : {"born", "handed_over", "coasting", "hidden_again", "died", "merged"}
        New; detected by a sensor for the first time after it was hidden; in view before but not found by the
        last look; in view before and now behind an occluder; dropped; continued as another entity.
    entity_id : str
        Id of the entity.
    into : str or None
        Id under which a merged entity continues; None for other kinds.

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
        ``"occluded_by"``, ``"approaching_from"`` and ``"emerged_from"`` lead to an occluder;
        ``"approaching"`` and ``"conflicts_with_ego_path"`` (on the path ahead of it within 5 s) lead to the
        ego vehicle; ``"same_lane"`` and ``"in_front_of"`` lead to the next object behind the entity, the ego
        vehicle or another entity. The last three exist only for entities with a position.
    probability : float
        Probability that the relation holds, given that both ends exist; for ``"emerged_from"``, that the
        detection at the hand-over belongs to the entity that was hidden there.
    stamp_ns : int
        Time of the belief, ns.
    since_ns, until_ns : int or None
        Last interval in which the probability was at least 0.5, ns. `since_ns` is None if there was none,
        `until_ns` during it. Both become None 5 s after its end.

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
