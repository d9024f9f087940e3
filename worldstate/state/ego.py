"""The ego vehicle by its odometry."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Ego:
    """Pose in the map frame and twist of the ego vehicle.

    Parameters
    ----------
    position_m : (float, float)
        Of `base_link` in the map frame, m.
    yaw_rad : float
        Its x axis, counter-clockwise from that of the map.
    covariance : nested tuple of floats, shape (3, 3)
        Of (x, y, yaw).
    speed_mps, yaw_rate_rad_s : float
        Along its x axis and about its z axis, left positive.

    Examples
    --------
    >>> Ego((2.0, 0.0), 0.0, ((0.01, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 1e-4)), 5.0, 0.0).speed_mps
    5.0
    """

    position_m: tuple[float, float]
    yaw_rad: float
    covariance: tuple[tuple[float, ...], ...]
    speed_mps: float
    yaw_rate_rad_s: float
