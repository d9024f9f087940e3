"""Position of a vehicle behind a corner, for known walls: python docs/examples/place.py."""

import numpy as np
from worldstate_lab.places.place_filter import PlaceFilter, added_position
from worldstate_lab.places.spectrum_model import SpectrumModel, StreetWalls

from worldstate import WorldFilter, WorldState
from worldstate.frontend import MicrophoneArray
from worldstate.measurement import PositionScan

AZIMUTHS = np.radians(np.linspace(90.0, -90.0, 61))
ARRAY = MicrophoneArray([[x, y, 0.0] for x in (-0.2, 0.0, 0.2) for y in (-0.3, -0.1, 0.1, 0.3)])
HZ = np.arange(200.0, 2000.0, 200.0)
MODEL = SpectrumModel.of(StreetWalls(4.5, 2.8, 2.8, 7.2), ARRAY, AZIMUTHS, HZ)


def behind_the_corner(hops: int) -> WorldState:
    """Return the state for a vehicle on the left: its sound comes off the right wall and the corner."""
    world, places = WorldFilter(), PlaceFilter(MODEL)
    waves = ARRAY.steering(HZ, np.radians([-59.0, 32.0])) * [1.0, 0.3]
    power = (np.abs(ARRAY.steering(HZ, AZIMUTHS).conj().transpose(0, 2, 1) @ waves) ** 2).sum(axis=(0, 2))
    belief = carried = places.unknown
    for hop in range(1, hops + 1):
        belief, carried = places.update(places.predict(belief, 0.1), power), places.predict(carried, 0.1)
        # Once per second, only the new information is added, so that no spectrum is used twice.
        if hop % 10 == 0:
            found = added_position(places.estimate(belief), places.estimate(carried), MODEL.walls.crossing_m)
            if found is not None:
                world = world.update(PositionScan("place", hop * 100_000_000, (found,)))
            carried = belief
    return world.state


if __name__ == "__main__":
    print(behind_the_corner(25).entities)
