r"""Where the ego vehicle is and how it moves: dead reckoning along arcs, set right by a localiser.

With speed v and yaw rate omega it drives in a time t the chord

.. math:: \Delta = v t\, \operatorname{sinc}\frac{\omega t}{2}
          \begin{pmatrix} \cos(\psi + \omega t / 2) \\ \sin(\psi + \omega t / 2) \end{pmatrix},
          \qquad P \leftarrow F P F^T + G \operatorname{diag}(\sigma_v^2, \sigma_\omega^2)\, G^T t^2
"""

import math
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from worldstate.belief.kinematics.cartesian import arc
from worldstate.ground.serialisation import Via
from worldstate.ground.typing import FloatArray
from worldstate.ground.values import wrap_angle
from worldstate.measurement.odometry import Odometry

_ROW = Via(FloatArray, np.asarray, lambda row: row.reshape(3))
_SQUARE = Via(FloatArray, np.ravel, lambda row: row.reshape(3, 3))


@dataclass(frozen=True, slots=True, eq=False)
class EgoBelief:
    """Gaussian over the pose (x, y, yaw) in the map frame, and the twist that holds.

    Shapes: pose (3,), covariance (3, 3).
    """

    pose: Annotated[FloatArray, _ROW]
    covariance: Annotated[FloatArray, _SQUARE]
    speed_mps: float
    yaw_rate_rad_s: float
    speed_std_mps: float
    yaw_rate_std_rad_s: float


def driven(ego: EgoBelief, step_s: float) -> EgoBelief:
    """Return the ego vehicle some seconds later.

    Examples
    --------
    >>> quarter = EgoBelief(np.zeros(3), np.zeros((3, 3)), math.pi, math.pi / 2.0, 0.0, 0.0)
    >>> driven(quarter, 1.0).pose.round(3)
    array([2.   , 2.   , 1.571])
    """
    chord, turned = arc(ego.speed_mps, ego.yaw_rate_rad_s, step_s)
    heading = float(ego.pose[2]) + 0.5 * turned
    ahead = np.array([math.cos(heading), math.sin(heading), 0.0])
    pose = ego.pose + chord * ahead + np.array([0.0, 0.0, turned])
    flow, gain = np.eye(3), np.stack([ahead, [0.0, 0.0, 1.0]], axis=1)
    flow[:2, 2] = -chord * ahead[1], chord * ahead[0]
    noise = gain * (np.array([ego.speed_std_mps, ego.yaw_rate_std_rad_s]) * step_s) ** 2 @ gain.T
    pose[2] = wrap_angle(pose[2])
    return replace(ego, pose=pose, covariance=flow @ ego.covariance @ flow.T + noise)


def corrected(ego: EgoBelief | None, told: Odometry) -> EgoBelief:
    """Return the ego vehicle as odometry has it: its twist, and its pose where that was told."""
    pose, covariance = (np.zeros(3), np.zeros((3, 3))) if ego is None else (ego.pose, ego.covariance)
    if told.pose is not None:
        at = told.pose
        pose = np.array([*at.position_m, at.yaw_rad])
        covariance = np.diag([at.position_std_m**2] * 2 + [at.yaw_std_rad**2])
    twist = told.speed_mps, told.yaw_rate_rad_s, told.speed_std_mps, told.yaw_rate_std_rad_s
    return EgoBelief(pose, covariance, *twist)
