"""The blind junction: two walled streets and the site's own measures.

The ego stands at the origin in its own street, which runs along +x between two side walls and opens into the
crossing street (along y) between two corners. Type A has a wall across the crossing street, type B none.
"""

import hashlib
import re
from dataclasses import dataclass, replace

import numpy as np

from worldstate.ground import FloatArray, InvalidArgumentError
from worldstate.ground.checks import check_ranges, in_range, one_of

from .occluders import OccludingBody, box

SITES = ("SA1", "SA2", "SB1", "SB2", "SB3")  # OVAD's location numbers 00..04, in this order
MOVING_SITES = ("DA1", "DA2", "DB1", "DB2", "DB3")  # the same places, the ego drives up to the corner
MAX_OCCLUDERS = 4
# Named or drawn: where the ego moves at the place S.., T.. or M..; DA1, DTA101.
_MOVING = re.compile(r"D([TM]?)([AB]\d+)")
# By the first letter of a drawn place: TA1, MB917. All others are heard along the paths of their plan.
_RENDERERS = {"T": "rays", "M": "mirrors"}
_DRAWN = re.compile(r"[TM][AB]\d{1,6}")
# The fits want smooth side walls, and a rough one opposite: shop fronts, doors, parked bicycles.
ROUGHNESS_A, ROUGHNESS_B = (1.0, 4.0), (0.3, 1.0)
WALL_END_M = 99.0  # openings before a wall begins and after it ends go on to here


@dataclass(frozen=True, slots=True)
class Site:
    """Plan of one junction, metres in `base_link`.

    Parameters
    ----------
    name : str
        Folder name in the OVAD layout.
    corner_left_m, corner_right_m : float
        Distance of the building corners to the left and right of the ego's axis, >= 1.
    corner_ahead_m : float
        How far ahead the corners stand.
    opposite_wall_m : float or None
        Distance ahead of the wall across the crossing street; None where there is none (type B).
    side_wall_left_m, side_wall_right_m : float
        Distance of the side walls of the ego's own street; nearer than the corners where these are bevelled.
    street_width_m : float
        Width of the crossing street's roadway; lanes are at a quarter and three quarters.
    verge_m : float
        Pavement, verge or square between the corners and that roadway.
    side_shares : tuple of (float, float)
        Of `side_reflection`, what the left and the right wall have: a hedge or a fence less than brick, 0..1.
    roughness : tuple of (float, float)
        Scattering of the side walls and of the crossing street's facades against the preset's, 0..6.
    surface_db : float
        How much louder vehicles are on its roadway than on the preset's, -12 to 12: smooth asphalt, setts.
    left_openings_m, right_openings_m : tuple of (float, float)
        Stretches along x in which the side wall is missing: driveways, set-back fronts, and the places
        before it begins and after it ends.
    side_reflection, facade_reflection : float
        Pressure reflection factors of the side walls and of the crossing street's facades, 0..1.
    side_order, facade_order : int
        Highest number of reflections followed in the ego's street and in the crossing street.
    occluders : tuple of OccludingBody
        Bodies in the open that hide a vehicle, at most 4. Where there are any the site is in the open.
    in_the_open : bool
        Whether there are neither corners nor walls to be heard; the corners only limit what the camera sees.

    Raises
    ------
    InvalidArgumentError
        If a measure is out of range or the vehicles' street has no room.

    Examples
    --------
    >>> Site("SA1", 2.8, 2.8, 4.45, 9.9, 2.8, 2.8, 5.45).lanes_m
    (5.8125, 8.5375)
    """

    name: str
    corner_left_m: float
    corner_right_m: float
    corner_ahead_m: float
    opposite_wall_m: float | None
    side_wall_left_m: float
    side_wall_right_m: float
    street_width_m: float
    side_reflection: float = 0.8
    facade_reflection: float = 0.8
    side_order: int = 3
    facade_order: int = 4
    verge_m: float = 0.0
    side_shares: tuple[float, float] = (1.0, 1.0)
    roughness: tuple[float, float] = (1.0, 1.0)
    surface_db: float = 0.0
    left_openings_m: tuple[tuple[float, float], ...] = ()
    right_openings_m: tuple[tuple[float, float], ...] = ()
    occluders: tuple[OccludingBody, ...] = ()
    in_the_open: bool = False

    def __post_init__(self) -> None:
        if not self.name.isascii() or not self.name.isalnum():
            raise InvalidArgumentError(f"name: expected letters and digits, got {self.name!r}")
        check_ranges(self, corner_left_m=(1.0, 30.0), corner_right_m=(1.0, 30.0), corner_ahead_m=(1.0, 50.0))
        check_ranges(self, side_wall_left_m=(1.0, 60.0), side_wall_right_m=(1.0, 60.0))
        check_ranges(self, street_width_m=(3.0, 40.0), verge_m=(0.0, 40.0), surface_db=(-12.0, 12.0))
        for factor in self.roughness:
            in_range("roughness", factor, 0.0, 6.0)
        for share in self.side_shares:
            in_range("side_shares", share, 0.0, 1.0)
        check_ranges(self, side_reflection=(0.0, 0.98), facade_reflection=(0.0, 0.98))
        check_ranges(self, side_order=(0, 8), facade_order=(0, 8))
        if len(self.occluders) > MAX_OCCLUDERS:
            raise InvalidArgumentError(f"occluders: expected at most {MAX_OCCLUDERS}")
        if self.opposite_wall_m is not None:
            in_range("opposite_wall_m", self.opposite_wall_m, self.far_kerb_m, 200.0)

    @property
    def is_open(self) -> bool:
        """Whether sound meets only the road and bodies."""
        return self.in_the_open or bool(self.occluders)

    @property
    def renderer(self) -> str:
        """What carries sound: "paths", "rays" through drawn houses (TA1), "mirrors": smooth walls (MA1)."""
        return renderer_named(self.name)

    @property
    def far_kerb_m(self) -> float:
        """Distance ahead of the crossing roadway's far edge."""
        return self.corner_ahead_m + self.verge_m + self.street_width_m

    @property
    def lanes_m(self) -> tuple[float, float]:
        """Distance ahead of the near lane (traffic from the left keeps right) and of the far lane."""
        quarter = self.street_width_m / 4.0
        return self.far_kerb_m - 3.0 * quarter, self.far_kerb_m - quarter

    def sight_m(self, ahead_m: float, eye_m: tuple[float, float] = (0.0, 0.0)) -> tuple[float, float]:
        """Return the lateral limits (right, left) of what an eye sees between the corners, at a distance.

        Examples
        --------
        >>> Site("SA1", 2.8, 2.8, 4.45, 9.9, 2.8, 2.8, 5.45).sight_m(8.9)
        (-5.6, 5.6)
        """
        right, left = self.sights_m(np.array([ahead_m]), eye_m)
        return float(right[0]), float(left[0])

    def sights_m(
        self, ahead_m: FloatArray, eye_m: tuple[float | FloatArray, float]
    ) -> tuple[FloatArray, FloatArray]:
        """Return those limits for distances, and an eye, that change: shape (T,) each."""
        x, y = eye_m
        reach = (ahead_m - x) / (self.corner_ahead_m - x)
        return y + (-self.corner_right_m - y) * reach, y + (self.corner_left_m - y) * reach


def renderer_named(name: str) -> str:
    """Return what carries the sound of a junction of this name.

    Examples
    --------
    >>> [renderer_named(name) for name in ("SA1", "DA1", "TA911", "DMB1")]
    ['paths', 'paths', 'rays', 'mirrors']
    """
    place = standing_name(name)
    return _RENDERERS[place[0]] if _DRAWN.fullmatch(place) else "paths"


def site(name: str) -> Site:
    """Return a site: fitted plans for SA1, SB1 and SB2, drawn ones of their family for SA2 and SB3.

    What the plan leaves open is drawn from generators seeded with the site's name, so that a site keeps its
    face from one recording to the next. DA1 is the place of SA1, and so on: there the ego moves.

    Parameters
    ----------
    name : str
        One of `SITES` or `MOVING_SITES`, or TA1, TB1, ... and MA1, ... of the other renderers; DTA1 and DMA1
        are these places with an ego that moves.

    Returns
    -------
    Site
        Walls, corners and occluders, metres.

    Raises
    ------
    InvalidArgumentError
        For an unknown name.

    Examples
    --------
    >>> site("SB1").opposite_wall_m is None, site("SA2") == site("SA2")
    (True, True)
    """
    if ego_moves(name):
        return replace(site(standing_name(name)), name=name)
    if not _DRAWN.fullmatch(name):
        one_of("site", name, (*SITES, *MOVING_SITES, "TA1", "TB1", "MA1", "MB1"))
    return PLANS[name] if name in PLANS else drawn_site(name)


# Fitted: a search for the least difference, and the least odd part of it, between the expected pattern
# (energies of all paths, the array's beams, an ambience that gives the site's empty windows) and the mean
# released one, hidden and in front, by side and half, averaged over the speeds that are drawn. It started
# from the published plans of a type A and a type B junction (corners 2.8 m aside, 4.5 m ahead), moved them by
# up to .7 m and leaves .07, .13 and .09 nepers rms; the plans and drivers before, with the vehicle's level
# free, left .13, .23 and .13. A wall nearer than its corner ends where the line of sight to the corner leaves
# it: one that went on would be seen, and hide the street.
PLANS = {
    "SA1": Site(
        "SA1",
        *(2.4, 2.5, 4.5, 8.95, 2.4, 2.0, 3.0),
        side_reflection=0.98,
        facade_reflection=0.98,
        verge_m=1.15,
        side_shares=(0.8, 1.0),
        roughness=ROUGHNESS_A,
        surface_db=6.0,
        left_openings_m=((-WALL_END_M, 2.0),),
        right_openings_m=((-WALL_END_M, 0.25), (3.57, WALL_END_M)),
    ),
    "SB1": Site(
        "SB1",
        *(2.3, 2.95, 5.2, None, 2.02, 2.2, 3.0),
        side_reflection=0.98,
        verge_m=1.9,
        side_shares=(0.9, 1.0),
        roughness=ROUGHNESS_B,
        surface_db=11.0,
        left_openings_m=((-WALL_END_M, -0.9), (4.57, WALL_END_M)),
        right_openings_m=((-WALL_END_M, 0.25), (3.88, WALL_END_M)),
    ),
    "SB2": Site(
        "SB2",
        *(3.0, 3.05, 5.2, None, 2.7, 2.9, 5.1),
        side_reflection=0.98,
        verge_m=0.9,
        side_shares=(0.87, 1.0),
        roughness=ROUGHNESS_B,
        surface_db=8.5,
        left_openings_m=((-WALL_END_M, -1.95), (4.68, WALL_END_M)),
        right_openings_m=((-WALL_END_M, 0.8), (4.94, WALL_END_M)),
    ),
}


def ego_moves(name: str) -> bool:
    """Tell whether the ego moves at a site of this name.

    Examples
    --------
    >>> [ego_moves(name) for name in ("SA1", "DA1", "DB101", "DTA101")]
    [False, True, True, True]
    """
    return _MOVING.fullmatch(name) is not None


def standing_name(name: str) -> str:
    """Return the name of the same place for an ego that stands there.

    Examples
    --------
    >>> [standing_name(name) for name in ("DA1", "DTA101", "MB203")]
    ['SA1', 'TA101', 'MB203']
    """
    found = _MOVING.fullmatch(name)
    return (found[1] or "S") + found[2] if found else name


def drawn_site(name: str) -> Site:
    """Draw a site from the family of those in `PLANS`, by a generator seeded with its name.

    Examples
    --------
    >>> drawn_site("SA101").opposite_wall_m is None, drawn_site("SB101").opposite_wall_m is None
    (False, True)
    >>> drawn_site("DA101") == replace(drawn_site("SA101"), name="DA101")  # there the ego moves
    True
    """
    if ego_moves(name):
        return replace(drawn_site(standing_name(name)), name=name)
    rng = site_generator(name)
    if _DRAWN.fullmatch(name):
        return _wider_site(name, rng)
    with_wall = name[:2] == "SA"
    ahead, corners = rng.uniform(4.5, 5.2), rng.uniform(2.3, 3.1, 2)
    walls = corners - rng.uniform(0.1, 0.7, 2)
    begins = rng.uniform(-1.5, 1.2, 2)
    verge = rng.uniform(*((0.8, 1.4) if with_wall else (0.9, 1.9)))
    street = 3.0 if with_wall else rng.uniform(3.0, 5.1)
    # A wall ends where the line of sight to the corner leaves it.
    ends = ahead * walls / corners
    openings = [((-WALL_END_M, begin), (end, WALL_END_M)) for begin, end in zip(begins, ends, strict=True)]
    return Site(
        name,
        *(corners[0], corners[1], ahead),
        ahead + verge + street + rng.uniform(0.1, 0.5) if with_wall else None,
        *(walls[0], walls[1], street),
        side_reflection=0.98,
        facade_reflection=rng.uniform(0.9, 0.98),
        verge_m=verge,
        side_shares=(rng.uniform(0.8, 1.0), rng.uniform(0.8, 1.0)),
        roughness=ROUGHNESS_A if with_wall else ROUGHNESS_B,
        surface_db=rng.uniform(*((5.0, 8.0) if with_wall else (8.0, 12.0))),
        left_openings_m=openings[0],
        right_openings_m=openings[1],
    )


# Of the image, whose edge is at 34 degrees: tangent, and how far its camera stands behind the array.
WIDEST_CORNER, CAMERA_BEHIND_M = 0.65, 0.57


def _wider_site(name: str, rng: np.random.Generator) -> Site:
    """Draw a site of the other renderers: wider streets, and more of them, than the fitted family has."""
    corners, ahead = rng.uniform(2.2, 8.0, 2), rng.uniform(3.0, 10.0)
    # A vehicle passes a corner outside the image before the camera sees it: T0 would be no line of sight.
    left, right = np.minimum(corners, WIDEST_CORNER * (ahead + CAMERA_BEHIND_M)).tolist()
    verge, street = rng.uniform(0.3, 3.5), rng.uniform(4.0, 9.0)
    opposite = ahead + verge + street + rng.uniform(0.3, 4.0) if name[1] == "A" else None
    plan = Site(name, left, right, ahead, opposite, left, right, street, verge_m=verge)
    side, facade = rng.uniform(0.9, 0.97, 2) if plan.renderer == "mirrors" else (0.8, 0.8)
    return replace(plan, surface_db=rng.uniform(0.0, 9.0), side_reflection=side, facade_reflection=facade)


def site_generator(name: str, purpose: str = "plan") -> np.random.Generator:
    """Return a generator that depends on the site alone: on the place, not on what happens there.

    Examples
    --------
    >>> site_generator("SA1").random() == site_generator("SA1").random()
    True
    """
    digest = hashlib.sha256(f"worldstate {standing_name(name)} {purpose}".encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:8], "little"))


Points = tuple[tuple[float, float], ...]

OPEN_M = 30.0


@dataclass(frozen=True, slots=True)
class Way:
    """Where a vehicle goes, and what that makes of a recording."""

    approach: str  # Side on which it comes into view; "none" where it is in view at first, or never
    route_m: Points = ()  # Points of its way; none for the lane of the crossing street


@dataclass(frozen=True, slots=True)
class Place:
    """A site besides the junctions, and the ways of vehicles that drive there.

    Most are in the open: no walls, only bodies that stand in the line of sight. A vehicle is a hazard where
    the camera does not see it at first, for a body in between or because it comes from beside or behind.
    """

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
    return _open("SP1", (Way("left", left), Way("right", _mirrored(left)), CROSSES_BEHIND), *piers)


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
    """Return a crossing in the open, before which a van parked on our left hides vehicles from there."""
    ways = Way("left", ((8.5, 60.0), (8.5, -60.0))), Way("right", ((11.5, -60.0), (11.5, 60.0)))
    return _open("SV1", (*ways, TURNS_OFF_AHEAD, CROSSES_BEHIND), box(1.5, 6.5, 2.0, 4.0))


_PLACES = lead_vehicle, bridge_pier, merge, open_road, wide_crossing, one_corner, parked_van
PLACES = {one.__name__.replace("_", "-"): one for one in _PLACES}


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
    plan = Site(name, OPEN_M, OPEN_M, 1.0, None, OPEN_M, OPEN_M, 12.0, side_order=0, facade_order=0)
    return Place(replace(plan, occluders=occluders, in_the_open=True), ways)
