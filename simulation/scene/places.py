"""Places besides the blind junctions: what hides a vehicle there, if anything does, and the ways of vehicles.

Most are in the open: no walls, only bodies that stand in the line of sight. A vehicle is a hazard where the
camera does not see it at first, for a body in between or because it comes from beside or from behind.
"""

from dataclasses import dataclass

import numpy as np

from worldstate.ground.checks import one_of

from .junction import Site
from .occluders import OccludingBody, box

Points = tuple[tuple[float, float], ...]

OPEN_M = 30.0


@dataclass(frozen=True, slots=True)
class Way:
    """Where a vehicle goes, and what that makes of a recording."""

    approach: str  # Side on which it comes into view; "none" where it is in view at first, or never
    route_m: Points = ()  # Points of its way; none for the lane of the crossing street


@dataclass(frozen=True, slots=True)
class Place:
    """A site, and the ways of vehicles that drive there."""

    site: Site
    ways: tuple[Way, ...]

    @property
    def approaches(self) -> tuple[str, ...]:
        """Sides from which a vehicle comes into view, left first."""
        return tuple(side for side in ("left", "right") if any(way.approach == side for way in self.ways))

    def drawn_way(self, approach: str, rng: np.random.Generator) -> Way | None:
        """Draw a way of that approach; of "none" in half of the draws only. None where there is none."""
        found = [way for way in self.ways if way.approach == approach]
        if not found or (approach == "none" and rng.random() < 0.5):
            return None
        return found[int(rng.integers(len(found)))]


# Nothing ever sees these: one turns off behind the ego, the other crosses there.
TURNS_OFF_BEHIND = Way("none", ((-80.0, 0.0), (-20.0, 0.0), (-16.0, -4.0), (-16.0, -80.0)))
CROSSES_BEHIND = Way("none", ((-12.0, 60.0), (-12.0, -60.0)))
# These are in view at first, and then beside.
ONCOMING = Way("none", ((90.0, 3.2), (-60.0, 3.2)))
TURNS_OFF_AHEAD = Way("none", ((90.0, 3.2), (16.0, 3.2), (11.5, -3.0), (11.5, -60.0)))


def lead_vehicle() -> Place:
    """Return a van six metres ahead that hides what comes towards us in the next lane."""
    hidden = Way("left", ((60.0, 2.2), (30.0, 2.6), (10.0, 3.2), (-10.0, 3.2)))
    return _open("SL1", (hidden, TURNS_OFF_BEHIND), box(6.0, 12.0, -1.1, 1.1))


def bridge_pier() -> Place:
    """Return two piers beside a ramp; a vehicle on a road that the ramp joins stays behind one for long."""
    left = ((60.0, 21.0), (24.0, 8.0), (12.0, 5.6), (-10.0, 5.6))
    piers = box(7.0, 9.0, 1.0, 3.0), box(7.0, 9.0, -3.0, -1.0)
    ways = Way("left", left), Way("right", _mirrored(left)), CROSSES_BEHIND
    return _open("SP1", ways, *piers)


def merge() -> Place:
    """Return a wall between our lane and the one that we merge into, and another beyond that lane."""
    near, far = OccludingBody(((-60.0, 2.6), (7.0, 2.6))), OccludingBody(((-60.0, 9.5), (60.0, 9.5)))
    return _open("SM1", (Way("left", ((-60.0, 5.6), (60.0, 5.6))),), near, far)


def open_road() -> Place:
    """Return a road where nothing stands: others overtake, come towards us, or stay behind."""
    left = ((-80.0, 3.2), (80.0, 3.2))
    overtaking = Way("left", left), Way("right", _mirrored(left))
    return _open("SO1", (*overtaking, ONCOMING, TURNS_OFF_BEHIND, CROSSES_BEHIND))


def wide_crossing() -> Place:
    """Return a crossing of wide streets: what comes is heard straight before the camera sees it."""
    site = Site("SW1", 14.0, 17.0, 8.0, None, 14.5, 17.5, 14.0, side_reflection=0.8, side_order=1)
    return Place(site, (Way("left"), Way("right"), ONCOMING, TURNS_OFF_BEHIND))


def one_corner() -> Place:
    """Return a crossing with a house on the left alone: from the right a vehicle is in plain direction."""
    house = OccludingBody(((-60.0, 2.8), (4.5, 2.8), (4.5, 60.0), (-60.0, 60.0)))
    ways = Way("left", ((6.5, 60.0), (6.5, -60.0))), Way("right", ((9.5, -60.0), (9.5, 60.0)))
    return _open("SC1", (*ways, TURNS_OFF_AHEAD, TURNS_OFF_BEHIND), house)


def parked_van() -> Place:
    """Return a crossing in the open, before which a van parked on our left hides who comes from there."""
    ways = Way("left", ((8.5, 60.0), (8.5, -60.0))), Way("right", ((11.5, -60.0), (11.5, 60.0)))
    return _open("SV1", (*ways, TURNS_OFF_AHEAD, CROSSES_BEHIND), box(1.5, 6.5, 2.0, 4.0))


PLACES = {
    "lead-vehicle": lead_vehicle,
    "bridge-pier": bridge_pier,
    "merge": merge,
    "open-road": open_road,
    "wide-crossing": wide_crossing,
    "one-corner": one_corner,
    "parked-van": parked_van,
}


def place(name: str) -> Place:
    """Return a place by its name.

    Parameters
    ----------
    name : str
        One of `PLACES`.

    Returns
    -------
    Place
        Its site, and the ways of vehicles there.

    Raises
    ------
    InvalidArgumentError
        For an unknown name.

    Examples
    --------
    >>> from worldstate.simulation import SimulationSettings
    >>> pier = place("bridge-pier")
    >>> way = pier.ways[0]
    >>> settings = SimulationSettings(pier.site, way.approach, entry_s=6.0, route_m=way.route_m)
    >>> settings.site.occluders[0].corners_m[0], pier.approaches
    ((7.0, 1.0), ('left', 'right'))
    """
    return PLACES[one_of("scene", name, PLACES)]()


def place_of(site_name: str) -> Place | None:
    """Return the place whose site has this name; None if it is none of them.

    Examples
    --------
    >>> place_of("SM1").approaches, place_of("SA1")
    (('left',), None)
    """
    return next((one for one in map(place, PLACES) if one.site.name == site_name), None)


def _mirrored(route_m: Points) -> Points:
    return tuple((x, -y) for x, y in route_m)


def _open(name: str, ways: tuple[Way, ...], *occluders: OccludingBody) -> Place:
    site = Site(
        name=name,
        corner_left_m=OPEN_M,
        corner_right_m=OPEN_M,
        corner_ahead_m=1.0,
        opposite_wall_m=None,
        side_wall_left_m=OPEN_M,
        side_wall_right_m=OPEN_M,
        street_width_m=12.0,
        side_order=0,
        facade_order=0,
        occluders=occluders,
        in_the_open=True,
    )
    return Place(site, ways)
