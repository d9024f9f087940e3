"""Detections of Stone Soup as positions for the filter.

python docs/examples/stone_soup.py
"""

from collections.abc import Iterator
from datetime import datetime, timedelta

import numpy as np
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.types.detection import Detection

from worldstate import WorldFilter
from worldstate.measurement import Position, PositionScan

START = datetime(2026, 1, 1)
RECEIVER = LinearGaussian(ndim_state=4, mapping=(0, 2), noise_covar=np.diag([0.25, 0.25]))  # of x, vx, y, vy


def detector() -> Iterator[tuple[datetime, set[Detection]]]:
    """Yield the detections of a car behind the corner, as a detector of Stone Soup does."""
    for hop in range(1, 21):
        time = START + timedelta(seconds=0.1 * hop)
        yield time, {Detection([10.0, 31.0 - 0.8 * hop], timestamp=time, measurement_model=RECEIVER)}


def scan(time: datetime, detections: set[Detection]) -> PositionScan:
    """Return the detections of one time as positions; x forward and y left, metres."""
    found = list[Position]()
    for one in detections:
        x_m, y_m = map(float, one.state_vector)
        covariance = tuple(map(tuple, one.measurement_model.noise_covar.tolist()))
        found.append(Position((x_m, y_m), covariance, existence_probability=0.95))
    stamp_ns = round((time - START) / timedelta(microseconds=1)) * 1000
    return PositionScan("stone soup", stamp_ns, tuple(found))


if __name__ == "__main__":
    world = WorldFilter()
    for time, detections in detector():
        world = world.update(scan(time, detections))
    for car in world.state.entities:
        x_m, y_m, _ = car.position_m or (0.0, 0.0, 0.0)
        print(f"{car.status} at ({x_m:.1f}, {y_m:.1f}) m, exists with {car.existence_probability:.2f}")
        print("in view in", [round(time_s, 1) for time_s in car.time_to_visible_s or ()], "s")
