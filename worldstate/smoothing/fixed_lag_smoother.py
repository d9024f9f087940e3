"""The smoother: entities, ego, corners and walls in one factor graph that reaches a fixed lag back."""

import math
from bisect import bisect_left, insort
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from worldstate.belief.kinematics.cartesian import CartesianBelief
from worldstate.belief.kinematics.motion import MotionBelief
from worldstate.ground import FloatArray, InvalidArgumentError, finite_array, in_range, seconds
from worldstate.measurement import Approach, Bearing, Position
from worldstate.smoothing import factors as f

from .factors import CORNER, EGO, ENTITY, HEIGHT, WALL, Factor, key_of
from .geometry import moved, polar
from .graph import FactorGraph, Refined
from .observations import (
    AngularHeight,
    EgoStep,
    FirstSight,
    Observation,
    PastEdge,
    Range,
    ReflectedBearing,
    SmoothedTrack,
    SmoothingSettings,
    crossing,
)

# Of (theta, theta_dot, rho) of an entity of which nothing is known: anywhere, passing or closing at
# up to the rates of a vehicle some ten metres away.
_START_STD = (1.5, 0.7, 0.7)
_BLOCK_NS = 1_000_000_000
_ORIGIN_STD = (1e-3, 1e-3, 1e-4)


@dataclass(slots=True)
class _Entity:
    """The states of an entity within the lag, in order."""

    number: int
    anchor_m: FloatArray
    stamps_ns: list[int] = field(default_factory=list)
    keys: dict[int, int] = field(default_factory=dict)  # By stamp
    sized: bool = False  # Whether its height is a variable


@dataclass(frozen=True, slots=True, eq=False)
class _Landmark:
    key: int
    start: FloatArray  # shape (2,)
    side: int = 0


class FixedLagSmoother:
    r"""Corrects where entities were once it is known where they came out.

    Every update adds a state to each entity that it observes, and a factor to the graph for each observation;
    gtsam's incremental smoother solves for all of the last `lag_s` seconds. The map is the ego's axes at the
    first update; an ego without odometry stands. Late observations within the lag are taken in.

    Parameters
    ----------
    settings : SmoothingSettings, optional
        Lag, motion and losses.

    Attributes
    ----------
    n_dropped : int
        Observations that came later than the lag reaches.

    Examples
    --------
    >>> smoother = FixedLagSmoother()
    >>> for hop in range(20):
    ...     far_m = 12.0 - 0.5 * hop
    ...     seen = Range(math.hypot(9.0, far_m), 0.3)
    ...     heard = Bearing(math.atan2(far_m, 9.0), 0.07)
    ...     smoother.update(hop * 100_000_000, {"car": [heard, seen] if hop > 9 else [heard]})
    >>> track = smoother.track("car")
    >>> bool(abs(track.states[0] - [9.0, 12.0, 0.0, -5.0]).max() < 1.0)
    True
    """

    def __init__(self, settings: SmoothingSettings | None = None) -> None:
        self.settings = settings or SmoothingSettings()
        self.n_dropped = 0
        self._graph = FactorGraph(self.settings)
        self._entities: dict[str, _Entity] = {}
        self._landmarks: dict[str, _Landmark] = {}
        self._ego: dict[int, int] = {}  # Keys by stamp
        self._ego_velocity = (0.0, 0.0)
        self._origin_ns: int | None = None
        self._now_ns = 0
        self._numbers = 0
        self._refined: Refined | None = None

    @property
    def entities(self) -> tuple[str, ...]:
        """Names of the entities with a state within the lag."""
        return tuple(self._entities)

    @property
    def n_factor_slots(self) -> int:
        """How many factors the graph has room for, used or not."""
        return self._graph.n_factor_slots

    def add_corner(
        self, name: str, side: Literal[1, -1], position_m: Sequence[float], std_m: Sequence[float]
    ) -> None:
        """Add an occluder's edge as a variable that outlives all passes.

        Parameters
        ----------
        name : str
            For `PastEdge` and `first_sight`.
        side : {1, -1}
            1 where hidden entities stand to the left of it, -1 to the right.
        position_m, std_m : pair of float
            x and y in the map, m, and their standard deviations.

        Raises
        ------
        InvalidArgumentError
            If the name is taken, or a number is not finite or a deviation not positive.
        """
        self._add_landmark(name, CORNER, finite_array("position_m", position_m, (2,)), std_m, side)

    def add_wall(self, name: str, azimuth_rad: float, distance_m: float, std: Sequence[float]) -> None:
        """Add a wall that reflects sound as a variable that outlives all passes.

        Parameters
        ----------
        name : str
            For `ReflectedBearing`.
        azimuth_rad, distance_m : float
            Direction of its normal in the map, and its distance from the map's origin.
        std : pair of float
            Standard deviations of the two.

        Raises
        ------
        InvalidArgumentError
            As `add_corner`.
        """
        self._add_landmark(name, WALL, finite_array("wall", (azimuth_rad, distance_m), (2,)), std)

    def begin(self, entity: str, stamp_ns: int, belief: MotionBelief | CartesianBelief) -> None:
        """Add an entity with what is known of it; without, it begins where it is first observed.

        Parameters
        ----------
        entity : str
            Name of an entity that has no state yet.
        stamp_ns : int
            Time of the belief, ns; the update at this stamp or a later one takes it in.
        belief : MotionBelief or CartesianBelief
            Of the filter, say; in the map's axes.

        Raises
        ------
        InvalidArgumentError
            If it has a state.
        """
        if entity in self._entities:
            raise InvalidArgumentError(f"entity: expected a new one, got {entity!r:.40}")
        self._start(stamp_ns)
        one = self._born(entity, np.zeros(2))
        if isinstance(belief, MotionBelief):
            key = self._add_state(one, stamp_ns, belief.mean)
            self._graph.add(f.prior_factor(key, belief.mean, belief.covariance))
            return
        state = polar(belief.mean, one.anchor_m)
        key = self._add_state(one, stamp_ns, state)
        whole = tuple(map(tuple, belief.covariance.tolist()))
        place, velocity = belief.mean[:2].tolist(), belief.mean[2:].tolist()
        said = Position((place[0], place[1]), whole, velocity_mps=(velocity[0], velocity[1]))
        self._graph.add(f.position_factor(f.Node(key, state, one.anchor_m), said))

    def update(
        self,
        stamp_ns: int,
        observations: Mapping[str, Sequence[Observation]],
        odometry: EgoStep | None = None,
    ) -> None:
        """Take in what was observed at one instant, of any number of entities.

        Parameters
        ----------
        stamp_ns : int
            When it was observed, ns; earlier than the last one where it comes late.
        observations : mapping of str to sequence
            By entity. A new one begins at a bearing or a position.
        odometry : EgoStep, optional
            How the ego has moved since the last update; not with a late one.

        Raises
        ------
        InvalidArgumentError
            If an observation names a corner or wall that was not added, a new entity has neither bearing nor
            position, or odometry comes late.
        """
        self._start(stamp_ns)
        late = stamp_ns < self._now_ns
        if odometry is not None:
            if late:
                raise InvalidArgumentError("odometry: expected it in order, got it late")
            self._move_ego(stamp_ns, odometry)
        self._now_ns = max(stamp_ns, self._now_ns)
        if self._time_s(stamp_ns) < self._oldest_s:
            self.n_dropped += sum(map(len, observations.values()))
            return
        for entity, every in observations.items():
            self._observe(entity, stamp_ns, every)
        self._keep_lasting()
        self._graph.update()
        self._refined = None
        self._forget()

    def track(self, entity: str) -> SmoothedTrack:
        """Return the corrected trajectory of an entity within the lag.

        Parameters
        ----------
        entity : str
            One of `entities`.

        Returns
        -------
        SmoothedTrack
            With covariance at every state.

        Raises
        ------
        InvalidArgumentError
            If there is none of this name.
        """
        one, refined = self._known(entity), self._all_refined()
        keys = [one.keys[stamp] for stamp in one.stamps_ns]
        mean = np.array([refined.value(key) for key in keys])
        covariance = np.array([refined.covariance(key) for key in keys])
        belief = MotionBelief(mean, 0.5 * (covariance + covariance.mT))
        return SmoothedTrack(entity, np.array(one.stamps_ns, np.int64), belief, one.anchor_m)

    def landmark(self, name: str) -> tuple[FloatArray, FloatArray]:
        """Return mean (2,) and covariance (2, 2) of a corner or a wall."""
        refined, key = self._all_refined(), self._landmark(name).key
        return refined.value(key), refined.covariance(key)

    def first_sight(self, entity: str, corner: str) -> FirstSight | None:
        r"""Return when an entity passed the line of sight of a corner, None where it did not within the lag.

        With u the azimuth beyond the edge and g its derivative by state and corner,

        .. math:: u(T_0) = 0, \qquad \sigma = \sqrt{g^T C g}\, /\, |\dot u|.
        """
        one, edge, refined = self._known(entity), self._landmark(corner), self._all_refined()
        stamps, beyond, slopes = one.stamps_ns, [], []
        for stamp in stamps:
            ego = self._ego_at(stamp)
            state = refined.value(one.keys[stamp])
            pose = None if ego is None else refined.pose(ego)
            node = f.Node(one.keys[stamp], state, one.anchor_m, ego_key=ego, pose=pose)
            values = (
                [state, refined.value(edge.key)] if pose is None else [state, pose, refined.value(edge.key)]
            )
            found, by = f.beyond_edge(node, edge.side, *values)
            beyond.append(found)
            # The pose is known far better than either of the others.
            slopes.append(np.concatenate([by[0][0], by[-1][0]]))
        passed = crossing(stamps, beyond)
        if passed is None:
            return None
        i, time_s, rate = passed
        spread = refined.joint_covariance(one.keys[stamps[i]], edge.key)
        return FirstSight(time_s, math.sqrt(slopes[i] @ spread @ slopes[i]) / rate)

    def _start(self, stamp_ns: int) -> None:
        if self._origin_ns is None:
            self._origin_ns = self._now_ns = stamp_ns

    def _time_s(self, stamp_ns: int) -> float:
        # In whole seconds: the states of one second are marginalised together. One after the other every step
        # would eliminate the whole lag anew.
        return float((stamp_ns - (self._origin_ns or 0)) // _BLOCK_NS)

    @property
    def _oldest_s(self) -> float:
        return self._time_s(self._now_ns) - self.settings.lag_s

    def _number(self) -> int:
        self._numbers += 1
        return self._numbers

    def _add_landmark(
        self, name: str, kind: str, value: FloatArray, std: Sequence[float], side: int = 0
    ) -> None:
        if name in self._landmarks:
            raise InvalidArgumentError(f"name: expected a new one, got {name!r:.40}")
        deviations = [in_range("std", one, 0.0, 1e6, open_low=True) for one in std]
        key = key_of(kind, self._number())
        self._graph.add_variable(key, value, self._time_s(self._now_ns))
        self._graph.add(f.prior_factor(key, value, np.diag(np.square(deviations))))
        self._landmarks[name] = _Landmark(key, value, side)

    def _born(self, entity: str, anchor_m: FloatArray) -> _Entity:
        one = self._entities[entity] = _Entity(self._number(), anchor_m)
        return one

    def _add_state(self, one: _Entity, stamp_ns: int, state: FloatArray) -> int:
        # Of an entity and a stamp: keys may not come again within the lag, and stamps are too long for one.
        key = key_of(ENTITY, self._number())
        one.keys[stamp_ns] = key
        insort(one.stamps_ns, stamp_ns)
        self._graph.add_variable(key, state, self._time_s(stamp_ns))
        return key

    def _observe(self, entity: str, stamp_ns: int, every: Sequence[Observation]) -> None:
        one = self._entities.get(entity)
        if one is None:
            one = self._first(entity, stamp_ns, every)
        elif stamp_ns > one.stamps_ns[-1]:
            self._go_on(one, stamp_ns)
        node = self._node(one, stamp_ns)
        for said in every:
            self._graph.add(self._factor(one, node, said))

    def _first(self, entity: str, stamp_ns: int, every: Sequence[Observation]) -> _Entity:
        """Begin an entity where it is first observed, with a prior that is wide in all else."""
        chosen, ego = self.settings, self._pose_at(stamp_ns)
        toward = next((one.azimuth_rad for one in every if isinstance(one, Bearing)), None)
        log_m = math.log(next((one.range_m for one in every if isinstance(one, Range)), chosen.range_m))
        place = next((one.position_m for one in every if isinstance(one, Position)), None)
        if place is not None:
            toward, log_m = math.atan2(place[1], place[0]), math.log(max(math.hypot(*place), 1.0))
        if toward is None:
            raise InvalidArgumentError(
                f"observations: expected {entity!r:.40} to begin with a bearing or position"
            )
        one = self._born(entity, ego[:2].copy())
        state = np.array([ego[2] + toward, 0.0, 0.0, log_m])
        prior = np.array([state[0], 0.0, 0.0, math.log(chosen.range_m)])
        key = self._add_state(one, stamp_ns, state)
        spread = np.diag(np.square([*_START_STD, chosen.range_log_std]))
        self._graph.add(f.prior_factor(key, prior, spread))
        return one

    def _go_on(self, one: _Entity, stamp_ns: int) -> None:
        """Add the next state of an entity, reached at constant velocity."""
        last_ns = one.stamps_ns[-1]
        key, step_s = one.keys[last_ns], seconds(stamp_ns - last_ns)
        before = f.Node(key, self._graph.value(key), one.anchor_m)
        state = moved(before.state, step_s)
        after = f.Node(self._add_state(one, stamp_ns, state), state, one.anchor_m)
        self._graph.add(f.motion_factor(before, after, step_s, f.motion_noise(self.settings, step_s)))

    def _node(self, one: _Entity, stamp_ns: int) -> f.Node:
        """Return the state nearest to a stamp, with the ego as it was then."""
        # A state in between would need the motion between its neighbours taken out of the graph. Over half a
        # hop white acceleration moves no vehicle by more than a centimetre.
        nearest = one.stamps_ns[min(bisect_left(one.stamps_ns, stamp_ns), len(one.stamps_ns) - 1)]
        before = one.stamps_ns[max(bisect_left(one.stamps_ns, stamp_ns) - 1, 0)]
        if abs(stamp_ns - before) < abs(nearest - stamp_ns):
            nearest = before
        key, ego = one.keys[nearest], self._ego_at(stamp_ns)
        return f.Node(
            key,
            self._graph.value(key),
            one.anchor_m,
            offset_s=seconds(stamp_ns - nearest),
            ego_key=ego,
            pose=None if ego is None else self._graph.value(ego),
            ego_velocity_mps=self._ego_velocity,
        )

    def _factor(self, one: _Entity, node: f.Node, said: Observation) -> Factor:
        match said:
            case Bearing():
                return f.bearing_factor(node, said, self.settings)
            case Approach():
                return f.approach_factor(node, said, self.settings)
            case Position():
                return f.position_factor(node, said)
            case Range():
                return f.range_factor(node, said, self.settings)
            case AngularHeight():
                return f.height_factor(node, self._height(one, said), said, self.settings)
            case ReflectedBearing():
                wall = self._landmark(said.wall)
                return f.reflected_factor(node, wall.key, wall.start, said, self.settings)
            case PastEdge():
                edge = self._landmark(said.corner)
                return f.edge_factor(node, edge.key, edge.start, edge.side, said, self.settings)

    def _height(self, one: _Entity, said: AngularHeight) -> int:
        """Return the key of an entity's height, which lives as long as its states."""
        key = key_of(HEIGHT, one.number)
        if not one.sized:
            one.sized, start = True, np.array([math.log(said.true_height_m)])
            self._graph.add_variable(key, start, self._time_s(self._now_ns))
            self._graph.add(f.prior_factor(key, start, np.array([[said.true_relative_std**2]])))
        return key

    def _move_ego(self, stamp_ns: int, odometry: EgoStep) -> None:
        here = self._pose_at(self._now_ns)
        if not self._ego:
            first = self._add_pose(self._now_ns, here)
            self._graph.add(f.pose_prior(first, here, _ORIGIN_STD))
        if stamp_ns == self._now_ns:
            return
        last, step_s = self._ego[max(self._ego)], seconds(stamp_ns - self._now_ns)
        c, s = math.cos(here[2]), math.sin(here[2])
        ahead, left = odometry.ahead_m, odometry.left_m
        moved = np.array([c * ahead - s * left, s * ahead + c * left, odometry.turn_rad])
        self._graph.add(f.odometry_factor(last, self._add_pose(stamp_ns, here + moved), odometry))
        self._ego_velocity = (ahead / step_s, left / step_s)

    def _add_pose(self, stamp_ns: int, pose: FloatArray) -> int:
        key = self._ego[stamp_ns] = key_of(EGO, self._number())
        self._graph.add_variable(key, pose, self._time_s(stamp_ns))
        return key

    def _ego_at(self, stamp_ns: int) -> int | None:
        """Return the key of the pose nearest in time, None of an ego that has always stood."""
        if not self._ego:
            return None
        return self._ego[min(self._ego, key=lambda at: abs(at - stamp_ns))]

    def _pose_at(self, stamp_ns: int) -> FloatArray:
        key = self._ego_at(stamp_ns)
        return np.zeros(3) if key is None else self._graph.value(key)

    def _keep_lasting(self) -> None:
        """Keep what outlives the lag: corners, walls, heights of the entities, the latest pose."""
        lasting = [one.key for one in self._landmarks.values()]
        if self._ego:
            lasting.append(self._ego[max(self._ego)])
        for key in lasting:
            self._graph.keep(key, self._time_s(self._now_ns))
        # A height that outlives the states of its entity is refused by gtsam when its turn comes.
        for one in self._entities.values():
            if one.sized:
                self._graph.keep(key_of(HEIGHT, one.number), self._time_s(one.stamps_ns[-1]))

    def _forget(self) -> None:
        """Forget states that gtsam has marginalised."""
        oldest_s = self._oldest_s
        for name, one in list(self._entities.items()):
            while one.stamps_ns and self._time_s(one.stamps_ns[0]) < oldest_s:
                del one.keys[one.stamps_ns.pop(0)]
            if not one.stamps_ns:
                del self._entities[name]
        newest = max(self._ego, default=0)
        for stamp in [at for at in self._ego if self._time_s(at) < oldest_s and at != newest]:
            del self._ego[stamp]

    def _all_refined(self) -> Refined:
        if self._refined is None:
            self._refined = self._graph.refined()
        return self._refined

    def _known(self, entity: str) -> _Entity:
        if entity not in self._entities:
            raise InvalidArgumentError(f"entity: expected one of {self.entities}, got {entity!r:.40}")
        return self._entities[entity]

    def _landmark(self, name: str) -> _Landmark:
        if name not in self._landmarks:
            raise InvalidArgumentError(f"name: expected one of {tuple(self._landmarks)}, got {name!r:.40}")
        return self._landmarks[name]
