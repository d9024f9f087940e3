"""Beliefs over the entities, one by one or as columns for a step of the filter."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import starmap
from operator import attrgetter
from typing import Annotated, Any, TypeAlias, get_type_hints
from uuid import UUID, uuid5

import numpy as np
from numpy.typing import NDArray

from worldstate.abduction.road_users import UNKNOWN, ClassShares
from worldstate.belief.kinematics.cartesian import CartesianBelief, NumbersT, polar_motion, predict_place
from worldstate.belief.kinematics.motion import (
    AZIMUTH,
    AZIMUTH_RATE,
    LEAST_STD,
    LOG_RANGE,
    MotionBelief,
    predict,
    relax,
)
from worldstate.ground import BoolArray, FloatArray, IntArray, wrap_angle
from worldstate.ground.serialisation import FLAT, Count, Keys, Probability
from worldstate.ground.values import Answer

from .site_geometry import IN_VIEW, SiteGeometry, normal_shares
from .street_model import StreetModel

# Namespace of the UUIDs below; a change would rename every entity of every recording.
_NAMESPACE = UUID("6f1d3c52-8a0e-5a6b-9d0f-3f6f0f6f5b11")
NEVER_NS = np.iinfo(np.int64).min  # "Never seen" in a column


Label: TypeAlias = Annotated[tuple[str, float], Keys(("label", "probability"))]
Objects: TypeAlias = NDArray[np.object_]


# Not frozen, because a snapshot of twenty would take a tenth longer. No code writes into a track.
@dataclass(slots=True, eq=False)
class Track:
    """Existence, motion, class and history of one entity."""

    id: str  # UUID, constant over the life of the entity
    existence: Probability
    created_ns: int  # Birth
    updated_ns: int  # Last measurement that changed it
    # Index of the approach side on which it is hidden, from which it came, or nearest to its first sighting.
    side: Count = 0
    # Whether a camera has found it; before that, its existence is a marginal of the belief
    seen: bool = False
    motion: MotionBelief = field(default=IN_VIEW, metadata=FLAT)  # Azimuth, rates, log range
    labels: tuple[Label, ...] = ((UNKNOWN, 1.0),)  # Class probabilities, sorted by label
    moving: bool = True  # False if a camera finds it parked
    sources: tuple[str, ...] = ()  # Modalities that contributed, sorted
    last_seen_ns: int | None = None
    answer: Answer = "unqueried"  # Last answer of the co-evidence channel about it
    miss_rate: Probability | None = None  # beta of that answer
    approach_heard: bool = False  # Whether its approach rate was ever measured
    # P(it was hidden on its side); for an entity in view, by the association at its hand-over.
    came_from: Probability = 0.0
    place: CartesianBelief | None = None  # Position, if there is one; `motion` then follows from it
    behind: Probability = 1.0  # P(no line of sight to it | exists)
    width_rad: float = 0.0  # Width of its last box
    # P(it is on a side | exists) for a sound-only entity of unknown side; otherwise empty.
    side_shares: tuple[Probability, ...] = ()

    @property
    def detected(self) -> bool:
        """Whether a sensor or a message has located it; otherwise only its sound is known."""
        return self.seen or self.place is not None


@dataclass(eq=False)
class Tracks:
    """All entities in columns: row i of each column belongs to entity i.

    A step writes into its own draft. Shapes: (n,), means (n, 4), covariances (n, 4, 4).
    """

    id: Objects
    side: IntArray
    seen: BoolArray
    existence: FloatArray
    mean: FloatArray
    covariance: FloatArray
    labels: Objects
    moving: BoolArray
    sources: Objects
    created_ns: IntArray
    updated_ns: IntArray
    last_seen_ns: IntArray
    answer: Objects
    miss_rate: FloatArray  # NaN without an answer
    approach_heard: BoolArray
    came_from: FloatArray
    placed: BoolArray  # Whether a track has a position; without one, the next two columns are invalid
    place_mean: FloatArray
    place_covariance: FloatArray
    behind: FloatArray
    width_rad: FloatArray
    side_shares: Objects

    def __len__(self) -> int:
        return len(self.seen)

    @classmethod
    def of(cls, rows: Sequence[Track]) -> "Tracks":
        """Return the columns of some entities."""
        motion = MotionBelief.stacked([one.motion for one in rows])
        place = CartesianBelief.stacked([one.place or _NOWHERE for one in rows])
        placed = np.array([one.place is not None for one in rows], bool)
        beliefs = motion.mean, motion.covariance, placed, place.mean, place.covariance
        columns: dict[str, Any] = dict(zip(_BELIEFS, beliefs, strict=True))
        for name, kind in _COLUMNS.items():
            values = (_UNKNOWN[name] if one is None else one for one in map(attrgetter(name), rows))
            columns[name] = np.fromiter(values, kind, len(rows))
        return cls(**columns)

    def rows(self) -> tuple[Track, ...]:
        """Return the entities one by one."""
        lists = [column.tolist() for column in _COLUMNS_OF(self)]
        columns: dict[str, list[Any]] = dict(zip(_COLUMNS, lists, strict=True))
        columns["last_seen_ns"] = [None if ns == NEVER_NS else ns for ns in columns["last_seen_ns"]]
        columns["miss_rate"] = [None if rate != rate else rate for rate in columns["miss_rate"]]  # NaN
        columns["motion"], columns["place"] = self.motion.each(), [None] * len(lists[0])
        for row in self.placed.nonzero()[0].tolist():
            columns["place"][row] = self.place(row)
        return tuple(starmap(Track, zip(*[columns[name] for name in Track.__slots__], strict=True)))

    def taken(self, where: IntArray | BoolArray | list[int]) -> "Tracks":
        """Return the columns of some entities."""
        return Tracks(*[column[where] for column in vars(self).values()])

    def without(self, rows: Sequence[int]) -> "Tracks":
        """Return the columns of all other entities."""
        return self.taken(np.delete(np.arange(len(self)), rows)) if rows else self

    def joined(self, rows: Sequence[Track]) -> "Tracks":
        """Return the columns with more entities at the end."""
        if not rows:
            return self
        pairs = zip(vars(self).values(), vars(Tracks.of(rows)).values(), strict=True)
        return Tracks(*map(np.concatenate, pairs))

    def draft(self) -> "Tracks":
        """Return a copy that a step may write into."""
        return Tracks(*[column.copy() for column in vars(self).values()])

    @property
    def motion(self) -> MotionBelief:
        """The motion of all entities."""
        return MotionBelief(self.mean, self.covariance)

    @property
    def azimuth_std_rad(self) -> FloatArray:
        """Standard deviations of the azimuths."""
        return np.asarray(np.sqrt(self.covariance[:, AZIMUTH, AZIMUTH]))

    @property
    def detected(self) -> BoolArray:
        """Whether a sensor or a message has located each entity; otherwise only its sound is known."""
        return self.seen | self.placed

    def place(self, row: int) -> CartesianBelief | None:
        """Return the position of an entity; None if it has none."""
        return CartesianBelief(self.place_mean[row], self.place_covariance[row]) if self.placed[row] else None

    def put(self, row: int, belief: MotionBelief | CartesianBelief) -> None:
        """Set the motion or the position of an entity."""
        if isinstance(belief, MotionBelief):
            self.mean[row], self.covariance[row] = belief.mean, belief.covariance
        else:
            self.placed[row] = True
            self.place_mean[row], self.place_covariance[row] = belief.mean, belief.covariance


_BELIEFS = ("mean", "covariance", "placed", "place_mean", "place_covariance")
_UNKNOWN = {"last_seen_ns": NEVER_NS, "miss_rate": math.nan}  # Column values that stand for None
_KINDS: dict[Any, Any] = {Objects: object, BoolArray: bool, IntArray: np.int64, FloatArray: float}
_COLUMNS = {name: _KINDS[hint] for name, hint in get_type_hints(Tracks).items() if name not in _BELIEFS}
_COLUMNS_OF = attrgetter(*_COLUMNS)
_NOWHERE = CartesianBelief(np.zeros_like(IN_VIEW.mean), np.zeros_like(IN_VIEW.covariance))


def entity_id(stream: str, kind: str, number: int) -> str:
    """Return the name-based UUID of the n-th entity of a kind in a stream; the same run gives the same ids.

    Examples
    --------
    >>> entity_id("drive", "left", 0) == entity_id("drive", "left", 0) != entity_id("drive", "left", 1)
    True
    """
    return str(uuid5(_NAMESPACE, f"{stream}/{kind}/{number}"))


def born(kind: str, number: int, existence: float, stamp_ns: int, site: SiteGeometry) -> Track:
    """Return the n-th entity of a kind, with defaults for everything else."""
    return Track(entity_id(site.settings.stream, kind, number), existence, stamp_ns, stamp_ns)


def after_empty_look(existence: NumbersT, miss_rate: NumbersT) -> NumbersT:
    r"""Return the existence after a missed detection.

    .. math:: r \leftarrow \frac{r \beta}{r \beta + 1 - r} = \frac{r (1 - p_D)}{1 - r\, p_D},
        \qquad p_D = 1 - \beta
    """
    missed = existence * miss_rate
    return missed / (missed + 1.0 - existence)


def predict_tracks(tracks: Tracks, step_s: float, site: SiteGeometry) -> None:
    """Predict tracks over a time step without a measurement."""
    tracks.existence[tracks.seen] *= math.exp(-step_s / site.street.unseen_s)
    if True in tracks.placed:
        _drive_on(tracks, tracks.placed.nonzero()[0], step_s, site)
    polar = ~tracks.placed  # Includes those that have just lost their position
    if True in polar:
        # A slice of all rows copies nothing.
        _relax(tracks, polar if False in polar else slice(None), step_s, site)
    occlude(tracks, site, step_s)


def turn(tracks: Tracks, faster_rad_s: float) -> None:
    """Turn tracks into the axes of an ego vehicle whose yaw rate has risen by this much."""
    tracks.mean[tracks.seen & ~tracks.placed, AZIMUTH_RATE] -= faster_rad_s


def _drive_on(tracks: Tracks, rows: IntArray, step_s: float, site: SiteGeometry) -> None:
    """Predict the positions of tracks, and drop positions that have become too uncertain."""
    before = CartesianBelief(tracks.place_mean[rows], tracks.place_covariance[rows])
    accelerations = acceleration_psd(tracks.moving[rows], site)
    after = predict_place(before, step_s, accelerations, site.ego_speed_mps, site.ego_yaw_rate_rad_s)
    tracks.place_mean[rows], tracks.place_covariance[rows] = after.mean, after.covariance
    for i, place in zip(rows.tolist(), after.each(), strict=True):
        # No lifetime is needed: a sender that keeps sending is there, and a silent one is lost within
        # seconds. Above twice the published uncertainty only the azimuth is tracked, or the side of a hidden
        # entity.
        if place.position_std_m > 2.0 * site.street.known_m:
            tracks.placed[i], tracks.behind[i] = False, 1.0
            if not tracks.seen[i]:
                tracks.put(i, site.sides[tracks.side[i]].prior())
    follow_places(tracks, site)


def acceleration_psd(moving: BoolArray, site: SiteGeometry) -> FloatArray:
    """Return the densities of the entities' white acceleration, m^2/s^3."""
    # A parked entity must not follow its boxes' noise, but its belief must stay updatable.
    return np.where(moving, site.street.acceleration, LEAST_STD)


def _relax(tracks: Tracks, rows: BoolArray | slice, step_s: float, site: SiteGeometry) -> None:
    """Predict tracks without a position; they relax to the prior of vehicles in view or hidden."""
    seen = tracks.seen[rows]
    before = MotionBelief(tracks.mean[rows], tracks.covariance[rows])
    motion = predict(before, step_s, acceleration_psd(tracks.moving[rows], site))
    # The azimuth relaxes to the hidden prior by P(hidden | exists): a vehicle that is still hidden has not
    # passed the corner, whatever its last rates were.
    kept = np.exp(-step_s * np.where(seen, 0.0, tracks.behind[rows]) / site.settings.window_s)
    expected, of = site.expected, np.where(seen, -1, tracks.side[rows])
    towards = MotionBelief(expected.mean[of], expected.covariance[of])
    relaxed = relax(motion, towards, kept, math.exp(-step_s / site.settings.window_s))
    tracks.mean[rows], tracks.covariance[rows] = relaxed.mean, relaxed.covariance


def follow_places(tracks: Tracks, site: SiteGeometry) -> None:
    """Compute the polar motion of tracks from their positions."""
    if True not in tracks.placed:
        return
    rows = tracks.placed.nonzero()[0]
    places = CartesianBelief(tracks.place_mean[rows], tracks.place_covariance[rows])
    polar = polar_motion(places, site.ego_speed_mps, site.ego_yaw_rate_rad_s)
    tracks.mean[rows], tracks.covariance[rows] = polar.mean, polar.covariance


def occluded(tracks: Tracks, site: SiteGeometry, step_s: float = 0.0) -> FloatArray:
    r"""Return P(an occluder hides a track), for each side's occluder and each other track, shape (n, K + n).

    .. math:: P_k = \min\big(a_k,\ P + (1 - e^{-dt / T})\, (a_k n_k - P)_+\big)

    with the chances P that it was hidden before, a that it is at the azimuths of k, and n that k is nearer.
    The division of time into steps has no effect. The position of a corner is known or assumed; of two boxes
    the wider one is nearer, as far as ranges and the spread of sizes allow. A corner cuts off the visible
    box, so the leading end of the box is used for an entity without a position.
    """
    azimuth_rad, widths, sides = tracks.mean[:, AZIMUTH], tracks.width_rad, len(site.sides)
    way = np.sign(tracks.mean[:, AZIMUTH_RATE]) * tracks.moving  # 0 for a first sighting
    at = np.zeros((len(tracks), sides + len(tracks)))
    nearer = np.zeros_like(at)
    at[:, :sides] = site.past_edge(azimuth_rad + 0.5 * way * widths, tracks.azimuth_std_rad, way)
    if True in (placed := tracks.placed):
        range_m = np.hypot(*tracks.place_mean[placed, :2].T)
        at[placed, :sides] = site.behind(azimuth_rad[placed], tracks.azimuth_std_rad[placed, None], range_m)
    nearer[:, :sides] = np.where(tracks.seen[:, None], [one.certainty for one in site.sides], 1.0)
    covers = (widths > 0.0) & tracks.seen & (2.0 * widths >= widths[:, None])
    np.fill_diagonal(covers, False)
    i, j = np.nonzero(covers & tracks.detected[:, None])
    if len(i):
        apart_rad, variance = wrap_angle(azimuth_rad[i] - azimuth_rad[j]), tracks.covariance
        std_rad = np.sqrt(variance[i, AZIMUTH, AZIMUTH] + variance[j, AZIMUTH, AZIMUTH])
        ends = normal_shares((0.5 * widths[j] * np.array([[1.0], [-1.0]]) - apart_rad) / std_rad)
        at[i, sides + j] = (ends[0] - ends[1]) * tracks.existence[j]
        ranges = variance[i, LOG_RANGE, LOG_RANGE] + variance[j, LOG_RANGE, LOG_RANGE]
        sizes = np.where(widths[i] > 0.0, 2.0 * site.street.size_spread**2, np.inf)
        wider = np.log(widths[j] / np.where(widths[i] > 0.0, widths[i], 1.0))
        farther = (tracks.mean[i, LOG_RANGE] - tracks.mean[j, LOG_RANGE]) / ranges + wider / sizes
        nearer[i, sides + j] = normal_shares(farther / np.sqrt(1.0 / ranges + 1.0 / sizes))
    before = np.where(tracks.seen, tracks.behind, 0.0)[:, None]
    changed = np.where(nearer < 1.0, 1.0 - math.exp(-step_s / site.street.look_s), 1.0)
    return np.asarray(np.minimum(before + np.maximum(at * nearer - before, 0.0) * changed, at))


def occlude(tracks: Tracks, site: SiteGeometry, step_s: float = 0.0) -> None:
    """Set P(hidden) of the detected tracks from their azimuths and positions."""
    if True in tracks.detected:
        tracks.behind = np.where(tracks.detected, occluded(tracks, site, step_s).max(axis=1), tracks.behind)


def relabelled(
    labels: tuple[Label, ...], seen_as: ClassShares, gain: float, least: float = 0.0
) -> tuple[Label, ...]:
    """Return class probabilities after one detection, as an exponential average over detections.

    Examples
    --------
    >>> relabelled((("car", 0.9),), (("truck", 0.8),), 0.3)
    (('car', 0.63), ('truck', 0.24))
    """
    kept = {label: probability * (1.0 - gain) for label, probability in labels}
    for label, probability in seen_as:
        kept[label] = kept.get(label, 0.0) + gain * probability
    return tuple([(label, round(kept[label], 9)) for label in sorted(kept) if kept[label] > least])


def side_weights(track: Track, sides: int) -> tuple[float, ...]:
    """Return P(an entity is on a side | exists), shape (sides,)."""
    known = tuple([float(k == track.side) for k in range(sides)])
    return known if track.detected or not track.side_shares else track.side_shares


def heard_as(tracks: Tracks, row: int, kinds: ClassShares, street: StreetModel) -> tuple[Label, ...]:
    """Return class probabilities after one more hop of sound; a class from a detector stays."""
    labels: tuple[Label, ...] = tracks.labels[row]
    is_heard = kinds and tracks.last_seen_ns[row] == NEVER_NS
    return relabelled(labels, kinds, street.label_gain, street.doubt) if is_heard else labels


def merged(sources: tuple[str, ...], source: str) -> tuple[str, ...]:
    """Return the sorted source names with one more."""
    return sources if source in sources else tuple(sorted((*sources, source)))
