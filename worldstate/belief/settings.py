"""Settings of the filter."""

from dataclasses import dataclass, fields

from worldstate.ground import InvalidArgumentError, in_range
from worldstate.ground.serialisation import Probability


@dataclass(frozen=True, slots=True)
class FilterSettings:
    """Noise levels, association gates, and thresholds of birth and death.

    Parameters
    ----------
    window_s : float
        Length of the window that a signature is computed on. Windows that overlap repeat most of their
        samples: explanations build on the belief of one window ago, and a bearing or approach rate
        weighs kappa = (time since the last one) / window, at most 1.
    look_interval_s : float
        Looks of the co-evidence channel closer in time than this repeat each other's misses (same object,
        same light, same detector), so to the existence of a visible entity a look weighs (time since the
        last one) / interval, at most 1.
    birth_probability, death_probability : float
        A hidden entity is born when P(hidden on its side) reaches the first, or an advisory names its
        side, and dropped when its existence falls below the second.
    rearm_s : float
        No birth on a side that long after a hand-over: the window still holds the sound from before it.
    relaxation_s : float
        Time constant with which unmeasured components return to their priors: the azimuth of a hidden entity
        to the azimuth of hidden vehicles, the approach rate of any entity to its prior.
    acceleration_psd : float
        White acceleration of a moving vehicle, m^2/s^3.
    hidden_std : tuple of float
        Prior standard deviations of a hidden entity's (theta_dot rad/s, rho 1/s, log r).
    hidden_inverse_tta_hz, hidden_range_m : float
        Prior means of 1/TTA and range of a hidden entity.
    hidden_path_probability : float
        P(a peak heard while hidden belongs to this side's direct or diffracted path). In real hidden
        windows 21 % of the peaks stand near the corner and 36 % anywhere on the vehicle's side; the rest
        are images in the walls of the ego's own street.
    hidden_bearing_std_rad, hidden_bias_std_rad : float
        Standard deviation of such peaks about the apparent azimuth, and of the bias of the apparent azimuth
        itself, which averaging does not remove; the published deviation includes it.
    line_of_sight_std_rad, line_of_sight_path_probability : float
        Standard deviation of peaks of the direct path in line of sight, and P(a peak belongs to it) at most.
    gate_sigma, gate_rad : float
        A sighting may belong to a visible entity within so many standard deviations and so many radians.
    edge_std_rad : float
        First sightings of vehicles that come into view lie about their occluder's edge with this deviation.
    reocclusion_gate_rad : float
        A moving entity last seen within this of an edge may be the one now heard behind it.
    side_confusion : float
        P(the signature names the wrong side).
    unheard_probability : float
        P(a new sighting is a vehicle that was not heard before), the alternative to a hand-over.
    handover_residual : float
        Share of P(hidden) that a hand-over leaves: the sighting may have been of another vehicle.
    sighting_existence : float
        Existence of an object before its first sighting is counted.
    clutter_rate : float
        Probability of a spurious sighting where the co-evidence states none.
    visible_life_s : float
        Mean life of a seen entity without looks.
    delete_existence, lost_std_rad : float
        A visible entity is dropped below this existence, or once its azimuth is this uncertain.
    reocclusion_s : float
        A moving entity out of sight for at most this long may be the one now heard hidden nearby; it has
        to be out of sight for `reocclusion_after_s` at least.
    stream : str
        Name that entity ids are derived from: the same stream gives the same ids.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range.

    Examples
    --------
    >>> FilterSettings(birth_probability=0.6).window_s
    1.0
    """

    window_s: float = 1.0  # Of the published feature
    look_interval_s: float = 0.3  # Three images at 10 Hz: misses of consecutive images repeat each other
    # Far apart: with one threshold for both, a belief that wavers about it would change ids at every hop.
    birth_probability: Probability = 0.5
    death_probability: Probability = 0.1
    rearm_s: float = 1.0  # One window
    relaxation_s: float = 1.0  # One window: what the sound of the last one did not confirm fades
    acceleration_psd: float = 2.0  # 1.4 m/s of speed in a second: braking and turning in town
    # 5 m/s at 25 m, give or take as much again; the range within a factor of 1.8.
    hidden_std: tuple[float, float, float] = (0.15, 0.25, 0.6)
    hidden_inverse_tta_hz: float = 0.2
    hidden_range_m: float = 25.0
    hidden_path_probability: Probability = 0.25  # 21 % of the peaks in real hidden windows, rounded up
    hidden_bearing_std_rad: float = 0.25  # 14 deg: peaks spread from the edge to the vehicle itself
    hidden_bias_std_rad: float = 0.17  # 10 deg, half the spread of hidden vehicles behind a default corner
    # Peaks of single vehicles in view at the five junctions with a name: .86 within 20 degrees where 15 to 20
    # are stated, and these off by 7, along the vehicle and about it.
    line_of_sight_std_rad: float = 0.12
    line_of_sight_path_probability: Probability = 0.8  # The rest are images in walls, other sources
    # The second bounds the first: four deviations of an entity unseen for a second are most of the view.
    gate_sigma: float = 4.0
    gate_rad: float = 0.35
    # Corners of real junctions stand within 6 deg of the default; missed once or twice, a vehicle moves on by
    # 3 to 6 deg an image.
    edge_std_rad: float = 0.15
    reocclusion_gate_rad: float = 0.8  # Less than the 64 deg between the edges of a default junction
    # Rarely wrong on junctions that the signature model was trained on, often on others.
    side_confusion: Probability = 0.2
    unheard_probability: Probability = (
        0.05  # One in twenty: most vehicles from a side street are heard before
    )
    # Above zero: a second vehicle behind the same corner would have to be found anew.
    handover_residual: Probability = 0.02
    sighting_existence: Probability = 0.5  # Indifferent: the first sighting decides
    clutter_rate: Probability = 0.01
    visible_life_s: float = 10.0
    # Three full looks that find nothing take .99 below it, at a miss rate of .04.
    delete_existence: Probability = 0.05
    lost_std_rad: float = 0.8  # Beyond, the azimuth says no more than which half of the view
    reocclusion_after_s: float = 0.15  # More than one image at 10 Hz: a single miss is no occlusion
    reocclusion_s: float = 3.0  # Longer, and a following vehicle would get the id of the one ahead
    stream: str = "worldstate"

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, tuple):
                for number in value:
                    in_range(field.name, number, 0.0, 1e6, open_low=True)
            elif not isinstance(value, str):
                high = 1.0 if field.type is Probability else 1e6
                in_range(field.name, value, 0.0, high, open_low=True)
        if self.death_probability > self.birth_probability:
            raise InvalidArgumentError("death_probability: expected at most birth_probability")
