"""Build the public WorldState from the internal beliefs."""

import math
from collections.abc import Iterable
from functools import partial
from statistics import NormalDist
from typing import Any, TypeAlias

import numpy as np

from worldstate.abduction.co_evidence import MOSTLY_MISSED, Present, Unqueried
from worldstate.abduction.road_users import UNKNOWN
from worldstate.abduction.sequence.sequence_model import TAIL
from worldstate.belief.hidden_bearing import hidden_bearing, time_to_visible
from worldstate.belief.kinematics.cartesian import EgoBelief
from worldstate.belief.kinematics.motion import (
    AZIMUTH,
    AZIMUTH_RATE,
    FARTHEST_M,
    LEAST_STD,
    LOG_RANGE,
    NEAREST_M,
    RADIAL_RATE,
    MotionBelief,
    white_acceleration,
)
from worldstate.belief.site_geometry import SideGeometry, SiteGeometry
from worldstate.belief.sound_tracks import SoundTrack
from worldstate.belief.street_model import FilterSettings
from worldstate.belief.track import Track, Tracks, acceleration_psd, entity_id
from worldstate.ground import seconds
from worldstate.measurement.measurement import Heard
from worldstate.state import Classification, Context, Entity, Hearing, SearchedView, SensorHealth, Visibility
from worldstate.state.entity import AzimuthSource, SideShare
from worldstate.state.sensor import Ego

from .birth_death import HIDDEN
from .memory import NEWS_HOLDS_NS, CountedLook, Memory
from .street_belief import StreetBelief

# Decimals of published numbers; full precision takes twice as long to write.
_DIGITS, _SHORT = 9, 6
# Forecasts end at two seconds, because vehicles at junctions turn or brake by then.
_AFTER_S = np.array([1.0, 2.0])
_CUBES = np.array([white_acceleration(after_s)[0, 0] for after_s in _AFTER_S])
_SOONER, _LATER = (f"{after_s:g}" for after_s in _AFTER_S)
Forecast: TypeAlias = dict[str, tuple[float, float]]
# Means and deviations of a track's motion, covariance of azimuth and rate, forecast, as Python numbers.
_Moments: TypeAlias = tuple[list[float], list[float], list[float], Forecast]


def forecasts(tracks: Tracks, site: SiteGeometry) -> list[Forecast]:
    r"""Return the forecast of every track at constant velocity, for all tracks at once.

    With the state :math:`(\theta, \dot\theta, \rho, \log r)` and its covariance P, after t seconds

    .. math:: \theta_t = \theta + \operatorname{atan2}(b, a), \quad a = 1 + \rho t, \quad
              b = \dot\theta t, \quad q = a^2 + b^2, \qquad
              \sigma_t^2 = h^T P h + \frac{s t^3}{3 r^2 q}, \quad h = (1, a t / q, -b t / q, 0),

    with white acceleration of density s.
    """
    theta, omega, rho, log_range = tracks.mean.T[:, :, None]
    a, b = 1.0 + rho * _AFTER_S, omega * _AFTER_S
    # At the array itself, q = 0, the coordinates are singular; the limit is 1 % of the first range.
    q = np.maximum(a * a + b * b, LEAST_STD)
    gradient = np.array([np.ones(a.shape), a * _AFTER_S / q, -b * _AFTER_S / q]).transpose(1, 2, 0)
    known = np.add.reduce(gradient @ tracks.covariance[:, :LOG_RANGE, :LOG_RANGE] * gradient, -1)
    density = acceleration_psd(tracks.moving, site)
    range_m = np.exp(np.minimum(np.maximum(log_range, math.log(NEAREST_M)), math.log(FARTHEST_M)))
    variance = known + density[:, None] * _CUBES / (range_m**2 * q)
    azimuth_rad = theta + np.arctan2(b, a)
    azimuth_rad -= math.tau * np.round(azimuth_rad / math.tau)
    # Full precision takes twice as long to write.
    means = np.minimum(np.maximum(azimuth_rad.round(_SHORT), -np.pi), np.pi).tolist()
    pairs = zip(means, np.sqrt(variance).round(_SHORT).tolist(), strict=True)
    return [{_SOONER: (at[0], std[0]), _LATER: (at[1], std[1])} for at, std in pairs]


# Deviation of log r, 25 % of the range. The priors have 0.6; a range with a larger deviation was not
# measured.
_KNOWN_LOG_RANGE_STD = 0.25
NINE_OF_TEN = NormalDist().inv_cdf(1.0 - TAIL)  # Half width of a 90 % interval, standard deviations
_UPPER = [AZIMUTH, AZIMUTH, AZIMUTH_RATE], [AZIMUTH, AZIMUTH_RATE, AZIMUTH_RATE]


def entities_of(tracks: Tracks, memory: Memory, site: SiteGeometry) -> tuple[Entity, ...]:
    """Return some tracks as published entities."""
    # All at once: to read a single number from an array takes as long as to read a row.
    stds = np.sqrt(tracks.covariance.diagonal(axis1=1, axis2=2))
    lists = [array.round(_DIGITS).tolist() for array in (tracks.mean, stds, tracks.covariance[:, *_UPPER])]
    moments = zip(*lists, forecasts(tracks, site), strict=True)
    return tuple(map(partial(_entity, memory.belief, site), tracks.rows(), moments))


def _entity(belief: StreetBelief, site: SiteGeometry, track: Track, moments: _Moments) -> Entity:
    mean, std, (variance, mixed, rate_variance), forecast = moments
    existence, hidden, side = track.existence, track.behind >= HIDDEN, site.sides[track.side]
    if hidden and track.place is not None and not track.seen:
        # The maximum, not a combination: the belief over the side may include the same messages.
        existence = max(existence, belief.sides.hidden[track.side])
    heard_only = hidden and not track.detected
    range_m = None if heard_only or std[LOG_RANGE] >= _KNOWN_LOG_RANGE_STD else math.exp(mean[LOG_RANGE])
    closing_hz = -mean[RADIAL_RATE] if track.approach_heard else None
    # Rounding could move an azimuth directly behind the ego vehicle beyond pi.
    azimuth_rad, std_rad = min(max(mean[AZIMUTH], -math.pi), math.pi), std[AZIMUTH]
    source: AzimuthSource = "measured" if track.detected else _rests_on(track.motion, side)
    if heard_only:
        azimuth_rad, std_rad, source = hidden_azimuth(track.side, track, belief, site)
    return Entity(
        id=track.id,
        status="hidden" if hidden else "visible" if track.seen else "emerged",
        existence_probability=existence,
        hidden_probability=track.behind * existence,
        classification=_classes(track),
        moving=track.moving,
        direction=side.label,
        azimuth_rad=azimuth_rad,
        azimuth_std_rad=std_rad,
        azimuth_rate_rad_s=None if hidden else mean[AZIMUTH_RATE],
        range_m=range_m,
        **_place(track, hidden and not track.seen, site),
        inverse_tta_hz=closing_hz,
        inverse_tta_std_hz=None if closing_hz is None else std[RADIAL_RATE],
        tta_s=time_to_arrival(closing_hz, std[RADIAL_RATE]),
        visibility=Visibility(track.answer, track.miss_rate),
        sources=track.sources,
        created_ns=track.created_ns,
        updated_ns=track.updated_ns,
        last_seen_ns=track.last_seen_ns,
        sector_rad=sector(azimuth_rad, std_rad) if hidden else None,
        azimuth_covariance=None if heard_only else (variance, mixed, rate_variance),
        forecast=None if heard_only else forecast,
        azimuth_source=source,
        sides=_side_shares(track, belief, site),
    )


def sound_entities(tracks: Iterable[SoundTrack], settings: FilterSettings) -> tuple[Entity, ...]:
    """Return likely tracks of sound as entities with only an existence and an azimuth."""
    likely = (one for one in tracks if one.existence >= settings.street.birth)
    return tuple(
        Entity(
            entity_id(settings.stream, f"sound of {one.source}", one.created_ns),
            None,
            one.existence,
            None,
            *(one.motion.azimuth_rad, one.motion.azimuth_std_rad, one.created_ns, one.updated_ns),
            classification=None,
            azimuth_rate_rad_s=round(float(one.motion.mean[AZIMUTH_RATE]), _DIGITS),
            azimuth_covariance=tuple(one.motion.covariance[*_UPPER].round(_DIGITS).tolist()),
            azimuth_source="measured",
            sources=(one.source,),
        )
        for one in likely
    )


def _classes(track: Track) -> tuple[Classification, ...]:
    """Return the class probabilities of a track; the rest is unknown, so that they sum to one."""
    classes = [Classification(label, share) for label, share in track.labels if label != UNKNOWN]
    rest = round(1.0 - sum([one.probability for one in classes]), _DIGITS)
    return (*classes, Classification(UNKNOWN, rest)) if rest > 0.0 else tuple(classes)


def sector(azimuth_rad: float, std_rad: float) -> tuple[float, float]:
    """Return the 90 % sector around an azimuth, from its right end to its left end."""
    half_rad = NINE_OF_TEN * std_rad
    if half_rad >= math.pi:
        return -math.pi, math.pi
    right_rad, left_rad = (math.remainder(azimuth_rad + way * half_rad, math.tau) for way in (-1.0, 1.0))
    return round(right_rad, _SHORT), round(left_rad, _SHORT)


def time_to_arrival(closing_hz: float | None, std_hz: float) -> float | None:
    """Return the time to arrival in seconds if the approach rate exceeds its deviation, else None."""
    return 1.0 / closing_hz if closing_hz is not None and closing_hz > std_hz else None


def hidden_azimuth(
    side: int, track: Track | None, belief: StreetBelief, site: SiteGeometry
) -> tuple[float, float, AzimuthSource]:
    """Return azimuth, standard deviation and source of a hidden vehicle.

    The source is its position, its time to visible, or a bearing.
    """
    if track is not None and track.place is not None:
        return track.motion.azimuth_rad, track.motion.azimuth_std_rad, "measured"
    if belief.has_times:
        return *hidden_bearing(belief.coming[side], site.sides[side]), "context"
    corner = site.sides[side]
    motion = track.motion if track is not None and track.side == side else corner.prior()
    # Sound round a corner comes from the edge, not from the vehicle; an average over hops keeps this bias.
    std_rad = math.hypot(motion.azimuth_std_rad, corner.bias_std_rad)
    return motion.azimuth_rad, std_rad, _rests_on(motion, corner)


def _rests_on(motion: MotionBelief, side: SideGeometry) -> AzimuthSource:
    """Return the source of an azimuth: bearings if they at least halve the context's variance."""
    return "measured" if 2.0 * motion.azimuth_std_rad**2 <= side.std_rad**2 else "context"


def _side_shares(track: Track, belief: StreetBelief, site: SiteGeometry) -> tuple[SideShare, ...]:
    """Return the azimuth on each side, for an entity that may be on several sides."""
    shares = [] if track.detected else [(k, share) for k, share in enumerate(track.side_shares) if share]
    return tuple(
        SideShare(site.sides[k].label, round(share, _DIGITS), *hidden_azimuth(k, track, belief, site)[:2])
        for k, share in shares
        if len(shares) > 1
    )


def _place(track: Track, hidden: bool, site: SiteGeometry) -> dict[str, Any]:
    """Return position, velocity and covariance if known, and the time to visible if hidden."""
    place = track.place
    if place is None or place.position_std_m >= site.street.known_m:
        return {}
    x, y, vx, vy = place.mean.tolist()
    moves = place.velocity_std_mps < site.street.known_m  # The same limit in m/s
    return {
        "position_m": (x, y, 0.0),
        "velocity_mps": (vx, vy, 0.0) if moves else None,
        "covariance": tuple(tuple(row) for row in place.covariance.tolist()),
        "time_to_visible_s": time_to_visible(place, site.sides[track.side], site)[1] if hidden else None,
    }


def ego_of(ego: EgoBelief) -> Ego:
    """Return the published form of the ego vehicle."""
    x, y, yaw = ego.pose.round(_DIGITS).tolist()
    covariance = tuple(map(tuple, ego.covariance.round(_DIGITS).tolist()))
    return Ego((x, y), yaw, covariance, ego.speed_mps, ego.yaw_rate_rad_s, ego.localised)


def sensors_of(memory: Memory) -> tuple[SensorHealth, ...]:
    """Return the condition of every sensor that has delivered data."""
    last = {name: (look.stamp_ns, _look_fault(look)) for name, look in memory.looks.items()}
    last |= {name: (one.stamp_ns, one.fault) for name, one in memory.sources.items()}
    return tuple(_health(name, *last[name], memory.stamp_ns) for name in sorted(last))


def hearings(memory: Memory) -> tuple[Hearing, ...] | None:
    """Return the audibility of vehicles for each active source; None if no source measures it."""
    listening = [(name, one) for name, one in sorted(memory.sources.items()) if one.heard.measured]
    told = [pair for pair in listening if memory.stamp_ns <= pair[1].stamp_ns + NEWS_HOLDS_NS]
    every = tuple(_hearing(name, one.heard, one.heard_ns) for name, one in told)
    return every if listening else None


def _hearing(source: str, heard: Heard, since_ns: int) -> Hearing:
    shares = heard.kinds if heard.kinds and heard.usable else {}
    # These shares were measured on some tens of approaches, so three decimals suffice.
    kinds = {kind: round(heard.share * share, 3) for kind, share in shares.items()}
    return Hearing(source, heard.share, since_ns, heard.reason, kinds or None)


def _health(sensor: str, stamp_ns: int, fault: str | None, now_ns: int) -> SensorHealth:
    if now_ns > stamp_ns + NEWS_HOLDS_NS:
        return SensorHealth(sensor, "silent", stamp_ns, f"nothing for {seconds(now_ns - stamp_ns):.1f} s")
    return SensorHealth(sensor, "working" if fault is None else "impaired", stamp_ns, fault)


def _look_fault(look: CountedLook) -> str | None:
    answer = look.answer
    if look.fault is not None or isinstance(answer, Unqueried) or answer.miss_rate < MOSTLY_MISSED:
        return look.fault
    return f"misses {answer.miss_rate:.0%} of what is in view"


def searched_views(memory: Memory, context: Context) -> tuple[SearchedView, ...]:
    """Return the last look of every sensor that searched its view."""
    half_rad = context.view_half_angle_rad
    return tuple(
        SearchedView(
            sensor,
            look.stamp_ns,
            isinstance(look.answer, Present),
            look.answer.miss_rate,
            look.answer.clutter_rate,
            look.sector_rad or (-half_rad, half_rad),
        )
        for sensor, look in sorted(memory.looks.items())
        if not isinstance(look.answer, Unqueried)
    )
