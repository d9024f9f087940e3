r"""The vehicle of all planners and its stopping law.

A vehicle that is to stand after d metres, and reacts after tau, may drive

.. math:: v(d) = -b \tau + \sqrt{b^2 \tau^2 + 2 b d}
"""

from dataclasses import dataclass

import numpy as np

from worldstate.ground.typing import FloatArray


@dataclass(frozen=True, slots=True)
class EgoVehicle:
    """A car with its limits; seen and heard are all things `reaction_s` late."""

    length_m: float = 4.3
    width_m: float = 1.8
    # Cameras in the bumper's corners, as parking aids have them: from behind a windscreen, two metres back,
    # nobody can see into these streets before the bumper is in them.
    eye_m: float = 0.5  # Behind the bumper
    limit_mps: float = 25.0 / 3.6  # Of both streets; the fastest vehicle of the streams drives 22 km/h
    acceleration_mps2: float = 2.0
    comfortable_mps2: float = 2.0  # Braking for what may come
    full_mps2: float = 6.0  # Braking for what is there
    reaction_s: float = 0.3
    begins_m: float = 30.0  # Before the line at which it would stand
    begins_mps: float = 25.0 / 3.6
    gap_m: float = 0.25  # Between the bumper that stands and whoever passes
    gap_s: float = 0.3  # Between one who leaves the conflict zone and one who enters it

    def stopping_speed_mps(self, room_m: FloatArray, reaction_s: float) -> FloatArray:
        """Return the highest speed from which it stands within some room.

        Examples
        --------
        >>> EgoVehicle().stopping_speed_mps(np.array([0.0, 1.6]), reaction_s=0.3)
        array([0., 2.])
        """
        lost = self.comfortable_mps2 * reaction_s
        return -lost + np.sqrt(lost**2 + 2.0 * self.comfortable_mps2 * np.maximum(room_m, 0.0))

    def soonest_s(self, way_m: FloatArray, speed_mps: FloatArray) -> FloatArray:
        """Return how long it takes for some way if it accelerates to the limit.

        Examples
        --------
        >>> EgoVehicle(limit_mps=4.0).soonest_s(np.array([-1.0, 1.0, 8.0]), np.array([0.0, 0.0, 0.0]))
        array([0., 1., 3.])
        """
        way, a = np.maximum(way_m, 0.0), self.acceleration_mps2
        until_m = (self.limit_mps**2 - speed_mps**2) / (2.0 * a)
        rising = (np.sqrt(speed_mps**2 + 2.0 * a * np.minimum(way, until_m)) - speed_mps) / a
        return np.asarray(rising + np.maximum(way - until_m, 0.0) / self.limit_mps)


# Where the states were recorded: the bumper two metres ahead of an array that stands about so far away.
FROM_STANDING = EgoVehicle(begins_m=3.5, begins_mps=0.0)
