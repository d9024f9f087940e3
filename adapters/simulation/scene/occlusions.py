"""Other ways to be hidden than behind a corner: a lead vehicle, a bridge pier at a ramp, a merge.

All of them are in the open: no walls, only bodies that stand in the line of sight. Each gives a scene and the
route of a vehicle that comes into sight while it approaches; give both to `SimulationSettings`.
"""

from dataclasses import dataclass

from worldstate.ground.errors import InvalidArgumentError

from .junction import Site
from .occluders import OccludingBody, box

OPEN_M = 30.0


@dataclass(frozen=True, slots=True)
class OccludedScene:
    """A scene in the open and the way of the vehicle that it hides."""

    site: Site  # No walls; its bodies hide the vehicle
    route_m: tuple[tuple[float, float], ...]  # Points of the vehicle's way
    approach: str  # Side on which it comes into sight


def lead_vehicle() -> OccludedScene:
    """Return a van six metres ahead that hides what comes towards us in the next lane."""
    return OccludedScene(
        _open("SL1", box(6.0, 12.0, -1.1, 1.1)), ((60.0, 2.2), (30.0, 2.6), (10.0, 3.2), (-10.0, 3.2)), "left"
    )


def bridge_pier() -> OccludedScene:
    """Return a pier beside a ramp; a vehicle on the road that the ramp joins stays behind it for long."""
    return OccludedScene(
        _open("SP1", box(7.0, 9.0, 1.6, 4.0)), ((60.0, 22.0), (24.0, 9.0), (8.0, 6.5), (-10.0, 6.5)), "left"
    )


def merge() -> OccludedScene:
    """Return a barrier between our lane and the one that we merge into; a faster vehicle is behind us."""
    barrier = OccludingBody(((-60.0, 2.6), (7.0, 2.6)))
    return OccludedScene(_open("SM1", barrier), ((-60.0, 5.6), (60.0, 5.6)), "left")


OCCLUSIONS = {"lead-vehicle": lead_vehicle, "bridge-pier": bridge_pier, "merge": merge}


def occluded_scene(name: str) -> OccludedScene:
    """Return a scene by its name.

    Parameters
    ----------
    name : str
        One of `OCCLUSIONS`.

    Returns
    -------
    OccludedScene
        Site, approach and route of the vehicle.

    Raises
    ------
    InvalidArgumentError
        For an unknown name.

    Examples
    --------
    >>> from worldstate.adapters.simulation import SimulationSettings
    >>> scene = occluded_scene("bridge-pier")
    >>> settings = SimulationSettings(scene.site, scene.approach, entry_s=6.0, route_m=scene.route_m)
    >>> settings.site.occluders[0].corners_m[0]
    (7.0, 1.6)
    """
    if name not in OCCLUSIONS:
        raise InvalidArgumentError(f"scene: expected one of {', '.join(OCCLUSIONS)}, got {name!r}")
    return OCCLUSIONS[name]()


def scene_of(site_name: str) -> OccludedScene | None:
    """Return the scene in the open whose site has this name; None if it is none of them.

    Examples
    --------
    >>> scene_of("SM1").approach, scene_of("SA1")
    ('left', None)
    """
    return next((scene for scene in map(occluded_scene, OCCLUSIONS) if scene.site.name == site_name), None)


def _open(name: str, occluder: OccludingBody) -> Site:
    return Site(
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
        occluders=(occluder,),
    )
