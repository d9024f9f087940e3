"""A learned street as the context that the filter takes."""

import math
from dataclasses import replace

from worldstate.state.context import Context, Occluder, Rates

from .event_rate import EventRate
from .learned_street import USUAL_DEPARTURE_HZ, USUAL_REVEAL_HZ, LearnedArm, LearnedStreet

# An arm of which no edge was seen keeps the corner of a usual junction.
_LEAST_WEIGHT = 0.5


def context_of(street: LearnedStreet) -> Context:
    """Return edges, pace and rates of a street; what no pass has told is as in `Context()`.

    Arrivals are left to the filter, which learns the traffic of the hour: given as priors, they move its
    alarm away from the onsets an hour that it was set for.

    Examples
    --------
    >>> from worldstate.smoothing.learned_street import LearnedStreet, StreetPass, with_pass
    >>> street = with_pass(LearnedStreet(site="Elm Street"), StreetPass("left", 0.45, 0.6))
    >>> [(round(one.edge_azimuth_rad, 2), one.assumed) for one in context_of(street).occluders]
    [(0.45, False), (-0.56, True)]
    """
    usual = Context()
    occluders = tuple(map(_occluder, street.arms, usual.occluders))
    return replace(usual, rates=_rates(street, usual.rates), occluders=occluders, site=street.site)


def _rates(street: LearnedStreet, usual: Rates) -> Rates:
    """Return how long who comes is hidden and in view: the filter has one rate for both arms.

    How a time ends is not told by those who came into view: of the rates out of a state all are scaled alike.
    """
    reveals, departures = EventRate(), EventRate()
    for arm in street.arms:
        reveals, departures = reveals.plus(arm.reveals), departures.plus(arm.departures)
    sooner = reveals.mean_hz(USUAL_REVEAL_HZ) / USUAL_REVEAL_HZ
    shorter = departures.mean_hz(USUAL_DEPARTURE_HZ) / USUAL_DEPARTURE_HZ
    return replace(
        usual,
        emergence_hz=sooner * usual.emergence_hz,
        departure_hz=sooner * usual.departure_hz,
        reocclusion_hz=shorter * usual.reocclusion_hz,
        visible_departure_hz=shorter * usual.visible_departure_hz,
    )


def _occluder(arm: LearnedArm, usual: Occluder) -> Occluder:
    sign = math.copysign(1.0, usual.edge_azimuth_rad)
    known = arm.edge.moments.weight >= _LEAST_WEIGHT
    edge_rad = arm.edge.mean_rad if known else abs(usual.edge_azimuth_rad)
    slope, pace_hz = math.tan(edge_rad), arm.pace_hz
    near, middle, far = (math.atan(slope + pace_hz * time_s) for time_s in (1.0, 2.0, 3.0))
    return replace(
        usual,
        edge_azimuth_rad=sign * edge_rad,
        hidden_azimuth_rad=sign * middle,
        hidden_std_rad=0.5 * (far - near),
        edge_std_rad=arm.edge.std_rad if known else usual.edge_std_rad,
        pace_hz=pace_hz,
        assumed=not known,
    )
