"""Ego motion: standing objects move in the axes of the ego vehicle, and a passed corner hides nothing."""

import math
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from street_measurements import after, car, diagonal, hop, reading

from worldstate import Context, Measurement, WorldFilter
from worldstate.abduction.co_evidence import Absent, Present
from worldstate.abduction.cueing.cueing_policy import uncalibrated_policy
from worldstate.adapters.files.odometry_file import OdometryRecord, read_odometry
from worldstate.belief.association import reached_edge
from worldstate.belief.hidden_bearing import hidden_motion
from worldstate.belief.kinematics.cartesian import EgoBelief, driven
from worldstate.belief.kinematics.motion import MotionBelief
from worldstate.belief.site_geometry import SiteGeometry
from worldstate.belief.street_model import FilterSettings
from worldstate.belief.track import born
from worldstate.core.site_model import FilterModel, from_here, site_geometry_of
from worldstate.ground.errors import InputFileError
from worldstate.measurement import CameraLook, Look, Position, PositionScan
from worldstate.measurement.odometry import EgoPose, Odometry
from worldstate.state.context import corner_at, open_side

CORNERS = Context(occluders=(corner_at("left", (8.0, 3.0), 12.0), corner_at("right", (8.0, -4.0), 12.0)))
OPEN = Context(occluders=(open_side("left", 1), open_side("right", -1)))
TWISTS = st.lists(st.tuples(st.floats(-5.0, 15.0), st.floats(-1.0, 1.0)), min_size=1, max_size=8)


def heard(time_s: float, left: float = 4.0, *boxes, **parts) -> Measurement:
    """Return evidence of a hidden vehicle on the left and a look."""
    answer = Present(0.04) if boxes else Absent(0.04)
    return hop(10 * time_s, (left, 0.0, 2.0, 0.0), *boxes, answer=answer, **parts)


def odometry(time_s: float, speed_mps: float, yaw_rate: float = 0.0, pose: EgoPose | None = None) -> Odometry:
    return Odometry("wheels", round(time_s * 1e9), speed_mps, yaw_rate, pose=pose)


@given(TWISTS)
def test_a_standing_object_moves_with_the_inverse_pose(twists: list[tuple[float, float]]) -> None:
    stands = Position((20.0, 5.0), diagonal(*[1e-3**0.5] * 4), (0.0, 0.0), 0.99)
    world = after(PositionScan("v2x", 0, (stands,)))
    pose = gtsam.Pose2(0.0, 0.0, 0.0)
    for at, (speed, rate) in enumerate(twists):
        world = world.update(odometry(0.1 * at, speed, rate)).predict(0.1)
        pose = pose.compose(gtsam.Pose2.Expmap(np.array([speed * 0.1, 0.0, rate * 0.1])))
    ego, place = world.state.ego, world.memory.tracks.place(0)
    assert ego is not None and place is not None
    assert [*ego.position_m, ego.yaw_rad] == pytest.approx([pose.x(), pose.y(), pose.theta()], abs=1e-7)
    assert place.mean[:2] == pytest.approx(pose.transformTo(np.array([20.0, 5.0])), abs=1e-6)
    assert place.mean[2:] == pytest.approx([0.0, 0.0], abs=1e-9)


def test_the_pose_covariance_matches_noisy_odometry() -> None:
    rng = np.random.default_rng(1)
    ego = EgoBelief(np.zeros(3), np.zeros((3, 3)), 6.0, 0.3, 0.2, 0.02)
    ends = []
    for _ in range(2000):
        one = EgoBelief(np.zeros(3), np.zeros((3, 3)), 0.0, 0.0, 0.0, 0.0)
        for _ in range(20):
            twist = 6.0 + 0.2 * rng.standard_normal(), 0.3 + 0.02 * rng.standard_normal()
            one = driven(EgoBelief(one.pose, one.covariance, *twist, 0.0, 0.0), 0.1)
        ends.append(one.pose)
    for _ in range(20):
        ego = driven(ego, 0.1)
    scale = np.sqrt(np.outer(ego.covariance.diagonal(), ego.covariance.diagonal()))
    # The standard error of a correlation over 2,000 draws is 0.02.
    assert np.cov(np.array(ends).T) / scale == pytest.approx(ego.covariance / scale, abs=0.1)


def test_an_edge_moves_with_the_pose_and_its_uncertainty() -> None:
    at = EgoPose((3.0, 0.5), 0.1, position_std_m=0.3, yaw_std_rad=0.02)
    near, far = (
        WorldFilter(CORNERS).update(odometry(0.0, 5.0, pose=pose)).state.context.occluders
        for pose in (at, EgoPose((0.0, 0.0), 0.0, 1e-3, 1e-3))
    )
    assert near[0].edge_azimuth_rad == pytest.approx(math.atan2(2.5, 5.0) - 0.1)
    assert near[1].edge_azimuth_rad == pytest.approx(math.atan2(-4.5, 5.0) - 0.1)
    assert far[0].edge_azimuth_rad == pytest.approx(math.atan2(3.0, 8.0))
    spread = math.sqrt(0.5**2 + 0.3**2) / math.hypot(5.0, 2.5)
    assert near[0].edge_std_rad == pytest.approx(math.hypot(spread, 0.02), rel=1e-3)
    assert near[0].hides and WorldFilter(CORNERS).state.context.occluders == CORNERS.occluders


@pytest.mark.parametrize("yaw_rad", [0.9, -0.9])
def test_a_rotated_ego_vehicle_has_the_rotated_site(yaw_rad: float) -> None:
    """Both edges are then on one side of the x axis."""
    model = FilterModel(CORNERS, uncalibrated_policy(), site_geometry_of(CORNERS, FilterSettings()))
    ahead, turned = (
        from_here(model, EgoBelief(np.array([0.0, 0.0, yaw]), np.zeros((3, 3)), 0.0, 0.0, 0.0, 0.0)).site
        for yaw in (0.0, yaw_rad)
    )
    azimuths, stds, way = np.linspace(-1.2, 1.2, 9), np.full(9, 0.05), np.tile([1.0, -1.0, 0.0], 3)
    looks_rad = np.array([(-0.6, 0.6), (0.2, 1.2), (-1.5, -0.2)])

    def told(site: SiteGeometry, by_rad: float) -> list[list[float]]:
        """Return P(leaves) and P(reached the edge), hidden azimuths and miss rates, as seen from `ahead`."""
        leaving = site.past_edge(azimuths - by_rad, stds, way).max(axis=1)
        far = [(at - by_rad, 0.0, 0.0, 3.0) for at in (1.1, -1.1)]
        there = [MotionBelief.around(one, (0.05, 0.1, 0.1, 0.6)) for one in far]
        hidden = [replace(born("left", 0, 0.9, 0, site), side=k, motion=one) for k, one in enumerate(there)]
        reached = [reached_edge(one, site) for one in hidden]
        moved = [hidden_motion(np.eye(9)[5], 0.5, side, side.prior()) for side in site.sides]
        looks = [Look("camera", 0, Absent(0.1), tuple(ends)) for ends in (looks_rad - by_rad).tolist()]
        missed = [site.in_sight(CameraLook(look)).answer.miss_rate for look in looks]
        return [leaving.tolist(), reached, [one.azimuth_rad + by_rad for one in moved], missed]

    leaving, reached, *_ = expected = told(ahead, 0.0)
    for one, other in zip(told(turned, yaw_rad), expected, strict=True):
        assert one == pytest.approx(other, abs=1e-9)
    assert 0.1 < np.mean(leaving) < 0.5 and max(reached) < 0.5


@pytest.mark.parametrize("sequence", [False, True])
@pytest.mark.parametrize("context", [CORNERS, OPEN])
def test_no_vehicle_is_hidden_without_an_occluder(context: Context, sequence: bool) -> None:
    """Past both corners or on an open road, whatever the evidence and the priors are."""
    told = reading({"coming_1s": (1.0, 1e-3), "other": (1e-3, 1.0)}) if sequence else None
    behind = after(*(heard(0.1 * at, 8.0, sequence=told) for at in range(1, 15)), world=WorldFilter(CORNERS))
    assert behind.state.entities and behind.state.cues[0].advisory is not None
    world = WorldFilter(context)
    assert (world.belief.risk < 1e-6) == (context is OPEN)
    if context is CORNERS:
        world = behind.update(odometry(1.5, 0.0, pose=EgoPose((9.0, 0.0))))
    edge_rad = world.state.context.occluders[0].edge_azimuth_rad
    for at in range(16, 36):
        boxes = [car(edge_rad - 0.02 * (at - 20))] * (20 <= at < 24)
        world = world.update(heard(0.1 * at, 8.0, *boxes, sequence=told))
        assert world.belief.risk < 1e-6 and not any(cue.advisory for cue in world.state.cues)
        assert not any(one.status == "hidden" for one in world.state.entities)
    assert not any(one.hides for one in world.state.context.occluders)


def test_a_message_from_an_open_road_is_not_hidden() -> None:
    far = Position((10.0, 14.0), ((1.0, 0.0), (0.0, 1.0)), existence_probability=0.95)
    for context, status in ((OPEN, "emerged"), (Context(), "hidden")):
        entity = WorldFilter(context).update(PositionScan("v2x", 0, (far,))).state.entities[0]
        assert entity.status == status


def test_odometry_csv_is_read_with_empty_poses(tmp_path) -> None:
    path = tmp_path / "ego.csv"
    path.write_text("time_s,speed_mps,yaw_rate_rad_s,x_m,y_m,yaw_rad\n0,5,0.1,2,1,0.3\n0.1,5.5,0,,,\n")
    log = read_odometry(path)
    assert log.told[0] == Odometry("odometry", 0, 5.0, 0.1, pose=EgoPose((2.0, 1.0), 0.3))
    assert log.moves and log.told[1] == Odometry("odometry", 100_000_000, 5.5)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("\n0,fast\n", "line 2: expected a finite number as speed_mps"),
        ("\n0,\n", "line 2: expected a finite number as speed_mps"),
        ("\n0,500\n", "line 2: speed_mps: expected a number in"),
        ("\n", "at least one line"),
        (",x_m\n1,5,0\n", "expected x_m, y_m and yaw_rad together"),
        (",x_m,y_m,yaw_rad\n0,5,1e9,0,0\n", "line 2: x_m: expected a number in"),
        ("\n1e308,5\n", r"line 2: time: expected nanoseconds of 64 bits, got 1e\+308 s"),
    ],
)
def test_errors_of_an_odometry_csv_have_the_line(tmp_path, text: str, words: str) -> None:
    path = tmp_path / "ego.csv"
    path.write_text("time_s,speed_mps" + text)
    with pytest.raises(InputFileError, match=words):
        read_odometry(path)


@given(
    turns=st.integers(-1000, 1000), yaw_rad=st.floats(-3.1, 3.1), told_as=st.sampled_from(["csv", "datagram"])
)
def test_an_unwrapped_yaw_of_a_localiser_is_wrapped(turns, yaw_rad, told_as, tmp_path_factory) -> None:
    counted = yaw_rad + 2.0 * math.pi * turns
    if told_as == "csv":
        path = tmp_path_factory.getbasetemp() / "yaw.csv"
        path.write_text(f"time_s,speed_mps,x_m,y_m,yaw_rad\n0,5,0,0,{counted!r}\n")
        told = read_odometry(path).told[0]
    else:
        told = OdometryRecord(5.0, 0.0, 5.4e6, 6.9e5, counted).at(0)  # UTM
    assert told.speed_mps == 5.0 and told.pose is not None
    assert told.pose.yaw_rad == pytest.approx(yaw_rad, abs=1e-9)
