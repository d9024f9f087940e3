"""A node around `worldstate.Listener`: sound, boxes and odometry in; advisories, objects and markers out."""

import math
import sys
from collections import deque
from typing import Any

import numpy as np
import rclpy
from autoware_perception_msgs.msg import PredictedObjects
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosidl_runtime_py import set_message_fields
from std_msgs.msg import String
from vision_msgs.msg import Detection2DArray
from visualization_msgs.msg import MarkerArray
from worldstate_msgs.msg import MultiChannelAudio, RiskAdvisories

import worldstate
from worldstate.adapters.export.other_stacks import autoware_objects, is_localised
from worldstate.adapters.files.context_file import read_context
from worldstate.adapters.ros.bag_input import detection_frame
from worldstate.adapters.ros.bag_writer import risk_advisories, scene_markers
from worldstate.adapters.ros.message_types import stamp_of
from worldstate.measurement.odometry import EgoPose

# At most this part of a loss is replaced by silence, so that the states show it; the rest is skipped.
HEARD_NS = 900_000_000
# A stamp that is earlier by more belongs to another run: a repeated bag, or a simulated clock.
AGAIN_NS = 2_000_000_000
# A delay that is not in this number of consecutive messages is jitter of the transport, and no loss.
MESSAGES = 5


class SampleClock:
    """The time of samples in messages: the first stamp plus the samples, corrected by later stamps.

    Parameters
    ----------
    first_ns : int
        Stamp of the first message.

    Attributes
    ----------
    next_ns : int
        Time of the next sample.

    Examples
    --------
    >>> clock = SampleClock(0)
    >>> [clock.moved_by(100 * k, 100) for k in (0, 1, 2, 3, 4, 7, 8, 9, 10, 11)]
    [0, 0, 0, 0, 0, 0, 0, 0, 0, 200]
    """

    def __init__(self, first_ns: int) -> None:
        self.next_ns = self._last_ns = first_ns
        self._late_ns: deque[int] = deque([0] * MESSAGES, maxlen=MESSAGES)

    def goes_back(self, stamp_ns: int) -> bool:
        """Return whether a stamp belongs to another run."""
        return stamp_ns < self._last_ns - AGAIN_NS

    def moved_by(self, stamp_ns: int, length_ns: int) -> int:
        """Add a message; return the length of the sound that was lost before it, ns.

        It is 0 for less than half a message. It is minus the length of the message if the message has to be
        left out, because the converter is faster than the clock of the stamps.
        """
        self._last_ns = stamp_ns
        self._late_ns.append(stamp_ns - self.next_ns)
        moved_ns = 0
        if 2 * min(self._late_ns) > length_ns:
            moved_ns = min(self._late_ns)
        elif max(self._late_ns) < -length_ns:
            moved_ns = -length_ns
        self._late_ns = deque((late - moved_ns for late in self._late_ns), maxlen=MESSAGES)
        self.next_ns += moved_ns + length_ns
        return moved_ns

    def time_ns(self, stamp_ns: int) -> int:
        """Return the time of another sensor's stamp on the clock of the samples."""
        return stamp_ns - min(self._late_ns)


class WorldStateNode(Node):
    """Publish each world-state, ten times per second.

    States have the time of the stamps of the sound. Sound waits `wait_s` for the boxes of its time.
    """

    def __init__(self) -> None:
        super().__init__("worldstate")
        given = {name: self._parameter(name, "") for name in ("array", "model", "camera", "context")}
        if not given["array"]:
            raise worldstate.WorldstateError("array: expected a board's name or a file, got none")
        self._array, self._moving = given["array"], self._parameter("moving", False)
        self._parts = {name: given[name] or None for name in ("model", "camera")}
        self._parts["context"] = read_context(given["context"]) if given["context"] else None
        self._parts["budget"] = self._parameter("budget", 0.0) or None
        self._wait_ns = worldstate.nanoseconds(self._parameter("wait_s", 0.12))
        self._map_frame = self._parameter("map_frame", "map")
        self._crossing_m = self._parameter("crossing_m", 9.0)
        self._listener: worldstate.Listener | None = None
        self._clock, self._rate_hz = SampleClock(0), 0
        self._waiting: deque[tuple[int, int, NDArray[np.float32]]] = deque()
        self._advisories = self.create_publisher(RiskAdvisories, "~/advisories", 10)
        self._objects = self.create_publisher(PredictedObjects, "~/objects", 10)
        self._markers = self.create_publisher(MarkerArray, "~/markers", 10)
        self._snapshots = self.create_publisher(String, "~/snapshot", 10)
        # After a stall, seconds of sound may arrive at once; some drivers repeat messages and some do not.
        quality = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_AVAILABLE)
        self.create_subscription(MultiChannelAudio, "audio", self.on_audio, quality)
        if given["camera"]:
            self.create_subscription(Detection2DArray, "detections", self.on_detections, quality)
        if self._moving:
            self.create_subscription(Odometry, "odometry", self.on_odometry, quality)

    def _parameter(self, name: str, default: Any) -> Any:
        return self.declare_parameter(name, default).value

    def on_audio(self, message: MultiChannelAudio) -> None:
        """Queue a block of sound; process the blocks that have waited long enough."""
        stamp_ns, rate_hz = stamp_of(message.header), int(message.sample_rate)
        samples = np.asarray(message.data, dtype=np.float32)
        if not rate_hz or not message.channels or len(samples) % message.channels:
            wanted = f"samples of {message.channels} channels at {rate_hz} Hz"
            self._refuse(f"audio: expected {wanted}, got {len(samples)} numbers")
            return
        shape = (message.channels, -1) if message.layout == "planar" else (-1, message.channels)
        samples = samples.reshape(shape).T if message.layout == "planar" else samples.reshape(shape)
        if self._listener is None or rate_hz != self._rate_hz or self._clock.goes_back(stamp_ns):
            self._begin(stamp_ns, rate_hz)
        lost_ns = self._clock.moved_by(stamp_ns, worldstate.nanoseconds(len(samples) / rate_hz))
        if lost_ns >= 0:
            self._waiting.append((self._clock.next_ns, lost_ns, samples))
        while self._waiting and self._waiting[0][0] + self._wait_ns <= self._clock.next_ns:
            _, lost_ns, samples = self._waiting.popleft()
            if lost_ns:
                self.get_logger().warning(f"audio: {1e-9 * lost_ns:.3f} s of sound were lost")
                heard_ns = min(lost_ns, HEARD_NS)
                self._hear(np.zeros((round(1e-9 * heard_ns * rate_hz), samples.shape[1]), np.float32))
                self._listener.skip(lost_ns - heard_ns)
            self._hear(samples)

    def _begin(self, stamp_ns: int, rate_hz: int) -> None:
        """Start a new listener at a stamp."""
        if self._listener is not None:
            self.get_logger().warning("audio: stamps went back or the rate changed; the states start again")
        start_s = 1e-9 * stamp_ns
        self._listener = worldstate.Listener(
            self._array, rate_hz, start_s=start_s, moving_ego=self._moving, **self._parts
        )
        self._clock, self._rate_hz = SampleClock(stamp_ns), rate_hz
        self._waiting.clear()

    def _hear(self, samples: NDArray[np.float32]) -> None:
        try:
            for state in self._listener.push(samples):
                self.publish(state)
        except worldstate.WorldstateError as error:
            self._refuse(f"audio: {error}")

    def on_detections(self, message: Detection2DArray) -> None:
        """Pass on the boxes of an image, also of one without boxes, because it was searched."""
        try:
            if self._listener is not None:
                taken_ns = self._clock.time_ns(stamp_of(message.header))
                self._listener.look(taken_ns, detection_frame(message.detections))
        except worldstate.WorldstateError as error:
            self._refuse(f"detections: {error}")

    def on_odometry(self, message: Odometry) -> None:
        """Pass on speed and yaw rate, and the pose if the frame is the map."""
        try:
            if self._listener is not None:
                twist, at_ns = message.twist.twist, self._clock.time_ns(stamp_of(message.header))
                pose = _pose(message.pose.pose) if message.header.frame_id == self._map_frame else None
                moved = twist.linear.x, twist.angular.z
                self._listener.add(worldstate.Odometry("odometry", at_ns, *moved, pose=pose))
        except worldstate.WorldstateError as error:
            self._refuse(f"odometry: {error}")

    def _refuse(self, problem: str) -> None:
        self.get_logger().error(problem, throttle_duration_sec=5.0)
        if self._listener is not None:
            self._listener.refuse(1)

    def publish(self, state: worldstate.WorldState) -> None:
        """Publish a state."""
        self._advisories.publish(_filled(RiskAdvisories, risk_advisories(state)))
        self._markers.publish(_filled(MarkerArray, scene_markers(state)))
        self._snapshots.publish(_filled(String, {"data": state.to_json()}))
        if is_localised(state):  # Autoware's objects are in the map
            self._objects.publish(_filled(PredictedObjects, autoware_objects(state, self._crossing_m)))


def _pose(pose: Any) -> EgoPose:
    """Return the position of a pose in the plane, and its yaw."""
    turn = pose.orientation
    yaw_rad = math.atan2(2.0 * (turn.w * turn.z + turn.x * turn.y), 1.0 - 2.0 * (turn.y**2 + turn.z**2))
    return EgoPose((pose.position.x, pose.position.y), yaw_rad)


def _filled(kind: Any, values: dict[str, Any]) -> Any:
    message = kind()
    set_message_fields(message, values)
    return message


def main() -> None:
    """Run the node until it is interrupted."""
    rclpy.init()
    try:
        rclpy.spin(WorldStateNode())
    except worldstate.WorldstateError as error:
        sys.exit(f"worldstate: {error}")
    except KeyboardInterrupt:
        pass
    finally:
        rclpy.try_shutdown()
