"""Which streams a model for an array is learned from, which ones examine it, and how it may be mounted."""

from dataclasses import dataclass, replace
from math import ceil

import numpy as np

from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.checks import in_range
from worldstate.simulation.scene.junction import MOVING_SITES, SITES, Site, drawn_site, site
from worldstate.simulation.scene.settings import rate_for
from worldstate.simulation.stream.settings import StreamSettings, traffic_named

APPROACHES, HAZARD_FREE = "approaches", "no-hazard"
# Seeds of streams that are learned from and of those that examine; neither is ever the other. Every
# junction has its own: of one seed the same drivers come at the same times everywhere.
LEARNED_SEED, EXAM_SEED, SEEDS_EACH = 1_000_000, 2_000_000, 1000
# Of a moving ego a stream is many drives, each with a seed of its own. An approach is judged to six seconds
# after its last vehicle, and a second one of a queue comes four seconds after the first.
DRIVES_S, DRIVES_EACH = {APPROACHES: 18.0, HAZARD_FREE: 12.0}, 1000
MOUNTING = 2  # Number of the junction where wrong mountings are heard


@dataclass(frozen=True, slots=True)
class CommissionSettings:
    """How much is simulated, and what alarms are allowed.

    Parameters
    ----------
    junctions : int
        Drawn junctions to learn from, half with a wall across the crossing street; with few, a model learns
        these streets instead of streets.
    approach_minutes, hazard_free_minutes : float
        Stream at each of them.
    exam_minutes : float
        Hazard-free stream at each junction of the exam; approaches take three fifths of that.
    onsets_per_hour : float
        Alarms allowed where nobody comes.
    bandwidth_hz : float
        Sound is rendered up to here.
    seed : int
        Another seed, other streams.
    moving_ego : bool
        Whether the ego drives up to the corner, in many drives a junction, or stands there.
    leave_out : tuple of str
        Real junctions whose labelled windows are not learned.
    quick : bool
        Whether this is to try the command: what comes out is marked as unfit for use.

    Examples
    --------
    >>> plan = learned_streams(CommissionSettings(junctions=2))
    >>> [f"{one.site.name} {one.traffic.name} {one.minutes:g}" for one in plan][:2]
    ['SA101 approaches 7.2', 'SA101 no-hazard 6']
    """

    junctions: int = 16
    approach_minutes: float = 7.2
    hazard_free_minutes: float = 6.0
    exam_minutes: float = 24.0
    onsets_per_hour: float = 30.0
    bandwidth_hz: float = 2000.0
    seed: int = 1
    leave_out: tuple[str, ...] = ()
    quick: bool = False
    moving_ego: bool = False

    @property
    def sites(self) -> tuple[str, ...]:
        """The junctions with a name, which examine."""
        return MOVING_SITES if self.moving_ego else SITES

    def __post_init__(self) -> None:
        in_range("junctions", self.junctions, 2, 200)
        # Of less there are streams in which nobody comes, and nothing is learned.
        in_range("approach_minutes", self.approach_minutes, 0.8, 120.0)
        in_range("hazard_free_minutes", self.hazard_free_minutes, 0.5, 120.0)
        in_range("exam_minutes", self.exam_minutes, 0.5, 160.0)
        in_range("onsets_per_hour", self.onsets_per_hour, 0.1, 3600.0)
        in_range("seed", self.seed, 0, SEEDS_EACH - 1)


def quick_settings(settings: CommissionSettings) -> CommissionSettings:
    """Return settings under which two junctions of a minute each are all that is learned."""
    return replace(
        settings, junctions=2, approach_minutes=1.2, hazard_free_minutes=0.5, exam_minutes=2.0, quick=True
    )


def learned_streams(settings: CommissionSettings) -> list[StreamSettings]:
    """Return the streams that a model learns from: drawn junctions, none of the five with a name."""
    kinds = ((APPROACHES, settings.approach_minutes), (HAZARD_FREE, settings.hazard_free_minutes))
    motion = settings.sites[0][0]
    return [
        one
        for i in range(settings.junctions)
        for traffic, minutes in kinds
        for one in _streams(
            f"{motion}{'AB'[i % 2]}{101 + i // 2}", traffic, minutes, LEARNED_SEED + i, settings
        )
    ]


def exam_streams(settings: CommissionSettings) -> list[StreamSettings]:
    """Return the streams of an exam: the five junctions with a name, twenty singles of each and more."""
    kinds = ((APPROACHES, 0.6 * settings.exam_minutes), (HAZARD_FREE, settings.exam_minutes))
    chosen = (MOUNTING,) if settings.quick else range(len(settings.sites))
    return [
        one
        for i in chosen
        for traffic, minutes in kinds
        for one in _streams(settings.sites[i], traffic, minutes, EXAM_SEED + i, settings)
    ]


def mounting_streams(settings: CommissionSettings) -> list[StreamSettings]:
    """Return the streams of the exam at the junction where wrong mountings are heard, too."""
    return [one for one in exam_streams(settings) if one.site.name == settings.sites[MOUNTING]]


def junction_named(name: str) -> Site:
    """Return one of the five junctions, or the drawn one of another name."""
    return site(name) if name in SITES + MOVING_SITES else drawn_site(name)


def _streams(
    name: str, traffic: str, minutes: float, seed: int, settings: CommissionSettings
) -> list[StreamSettings]:
    """Return the stream of a junction and traffic, or as many drives as last so long."""
    own = seed + SEEDS_EACH * settings.seed
    whole = StreamSettings(
        junction_named(name),
        DRIVES_S[traffic] / 60.0 if settings.moving_ego else minutes,
        own,
        traffic_named(traffic),
        sample_rate_hz=rate_for(settings.bandwidth_hz),
    )
    if not settings.moving_ego:
        return [whole]
    drives = ceil(minutes / whole.minutes - 1e-9)
    return [replace(whole, seed=own * DRIVES_EACH + i) for i in range(drives)]


# What a bracket and a tape measure leave: two degrees are 14 mm over the width of 40 cm.
YAW_DEG, POSITION_MM = 2.0, 5.0


def mountings(array: MicrophoneArray, rng: np.random.Generator) -> dict[str, MicrophoneArray]:
    """Return what an array may be believed to be: itself, turned, or with every coordinate a little off.

    Examples
    --------
    >>> found = mountings(MicrophoneArray([[0, 1, 0], [0, -1, 0]]), np.random.default_rng(1))
    >>> {name: one.positions_m[0, :2].round(2).tolist() for name, one in found.items()}
    {'as mounted': [0.0, 1.0], '2 deg of yaw': [-0.03, 1.0], '5 mm of position': [0.0, 1.0]}
    """
    cosine, sine = np.cos(np.radians(YAW_DEG)), np.sin(np.radians(YAW_DEG))
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    off = 1e-3 * POSITION_MM * rng.standard_normal(array.positions_m.shape)
    return {
        "as mounted": array,
        f"{YAW_DEG:g} deg of yaw": MicrophoneArray(array.positions_m @ turn.T),
        f"{POSITION_MM:g} mm of position": MicrophoneArray(array.positions_m + off),
    }
