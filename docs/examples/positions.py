"""Radar and V2X: positions and velocities with covariance, and a vehicle that no sensor detects.

python docs/examples/positions.py
"""

import math

from worldstate import WorldFilter, WorldState
from worldstate.measurement import Position, PositionScan, SearchedSector, Sector

# Standard deviations of 0.5 m and 0.3 m/s, as of a good satellite receiver or a front radar.
NOISE = tuple(tuple(std**2 * (i == j) for j in range(4)) for i, std in enumerate((0.5, 0.5, 0.3, 0.3)))
FRONT_RADAR = SearchedSector(Sector(0.0, math.radians(60.0)), range_m=70.0, detection_probability=0.9)


def radar_alone(scans: int) -> WorldState:
    """Return the state for a car ahead that approaches at 4 m/s; the fifth scan misses it."""
    world = WorldFilter()
    for scan in range(1, scans + 1):
        car = Position((30.0 - 0.4 * scan, 2.0), NOISE, velocity_mps=(-4.0, 0.0))
        found = (car,) if scan != 5 else ()
        world = world.update(PositionScan("radar", scan * 100_000_000, found, FRONT_RADAR))
    return world.state


def announced(messages: int) -> WorldState:
    """Return the state for a car behind the corner that sends its position."""
    world = WorldFilter()
    for hop in range(1, messages + 1):
        car = Position((10.0, 31.0 - 0.8 * hop), NOISE, (0.0, -8.0), 0.95, (("car", 1.0),))
        world = world.update(PositionScan("v2x", hop * 100_000_000, (car,)))
    return world.state


if __name__ == "__main__":
    for state in (radar_alone(10), announced(10)):
        (car,) = state.entities
        x_m, y_m, _ = car.position_m or (math.nan,) * 3
        print(f"{car.status}, exists with {car.existence_probability:.2f}, at ({x_m:.1f}, {y_m:.1f}) m")
        if car.time_to_visible_s is not None:
            low, _, high = car.time_to_visible_s
            print(f"  in view in {low:.1f} to {high:.1f} s")
