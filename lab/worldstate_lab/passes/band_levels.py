"""How loud a stream and its vehicles are where they mask each other: 300 Hz to 2 kHz, half a second.

A vehicle of power p2 beside others of p1 adds 10 log10(1 + p2 / (p1 + background)) decibels; the background
is the level that a fifth of the stream's hops stays below.
"""

from bisect import insort

import numpy as np
from scipy.signal import lfilter, sosfilt

from worldstate.commissioning.heard_stream import HeardStream
from worldstate.ground.typing import AnyArray, FloatArray
from worldstate.simulation.dataset.recording import FULL_SCALE_PA
from worldstate.simulation.scene.octave_bands import REFERENCE_PA
from worldstate.simulation.stream.rendering import SILENCE_PA2, band_filter

QUIET_SHARE, MEAN_HOPS = 0.2, 5
_PASCAL = FULL_SCALE_PA / 32767.0  # Of one step of 16 bit


def level_db(heard: HeardStream) -> FloatArray:
    """Return the level of one microphone in the half second that ends with every hop, shape (n,)."""
    sections = band_filter(float(heard.hops.about["sample_rate_hz"]))
    sound = sosfilt(sections, heard.hops.middle.ravel() * _PASCAL)
    power = np.square(sound).reshape(len(heard.hops), -1).mean(axis=1)
    return np.asarray(10.0 * np.log10(_half_second(power) / REFERENCE_PA**2 + 1e-9))


def above_place_db(heard: HeardStream) -> FloatArray:
    """Return how far the level lies above its 20 % quantile of the stream so far, shape (n,)."""
    level, past, place = level_db(heard), list[float](), list[float]()
    for one in level.tolist():
        insort(past, one)
        place.append(past[int(QUIET_SHARE * len(past))])
    return np.asarray(level - np.array(place))


def added_db(heard: HeardStream) -> FloatArray:
    """Return what every vehicle adds to the level at every hop, shape (vehicles, n)."""
    rows, number = heard.rows, {name: i for i, name in enumerate(heard.vehicles.vehicle.tolist())}
    power = np.full((len(number), len(heard.hops)), SILENCE_PA2 / REFERENCE_PA**2)
    hop, inside = heard.row_hops()
    vehicle = np.array([number[one] for one in rows.vehicle.tolist()], np.intp)
    power[vehicle[inside], hop[inside]] = 10.0 ** (rows.band_db[inside] / 10.0)
    own = _half_second(power)
    background = 10.0 ** (np.quantile(level_db(heard), QUIET_SHARE) / 10.0)
    return np.asarray(10.0 * np.log10(1.0 + own / (own.sum(axis=0) - own + background)))


def _half_second(power: AnyArray) -> FloatArray:
    return np.asarray(lfilter(np.full(MEAN_HOPS, 1.0 / MEAN_HOPS), 1.0, power))
