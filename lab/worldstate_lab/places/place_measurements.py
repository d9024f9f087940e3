"""Adapter of spatial spectra: a place as a scan of positions, or a side as evidence."""

import math
from dataclasses import dataclass

from worldstate.abduction.co_evidence import Unqueried
from worldstate.abduction.evidence import SignatureEvidence
from worldstate.ground.checks import in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray
from worldstate.ground.values import NotUsable, nanoseconds, seconds
from worldstate.measurement.measurement import Measurement
from worldstate.measurement.position import Position, PositionScan

from .estimate import KnownPlace, PlaceEstimate
from .place_filter import STATED_STD_M, PlaceBelief, PlaceFilter

LANE_STD_M = 1.0  # Either lane of the crossing street
# A place heard through walls is never proof of somebody.
LEAST_EXISTENCE, MOST_EXISTENCE = 0.01, 0.99
LEAST_SHARE = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class SpatialSpectrum:
    """A spatial spectrum and when it ended.

    Examples
    --------
    >>> import numpy as np
    >>> SpatialSpectrum(100_000_000, np.array([0.1, 0.3, 0.2])).stamp_ns
    100000000
    """

    stamp_ns: int
    values: FloatArray  # shape (G,): On the azimuths of the model, at any scale


class PlaceMeasurements:
    r"""Turns spatial spectra into measurements of the world filter, one an interval.

    The filter of places has counted every spectrum already. What is passed on is what the interval added to
    the belief carried over from the last one: of a place with mean m and variance P, and m', P' without
    these spectra, the equivalent measurement

    .. math:: R^{-1} = P^{-1} - P'^{-1}, \qquad z = R (P^{-1} m - P'^{-1} m'),

    and where none can be stated the ratio of both beliefs by side, in view and of nobody.

    Parameters
    ----------
    places : PlaceFilter
        Of the junction and the array.
    interval_s : float
        Between measurements, .1 to 10 s.

    Examples
    --------
    >>> import numpy as np
    >>> from worldstate.frontend import MicrophoneArray
    >>> from worldstate_lab.places.spectrum_model import SpectrumModel
    >>> from worldstate_lab.places.street_walls import StreetWalls
    >>> array = MicrophoneArray([[x, y, 0.0] for x in (0.0, 0.12) for y in (-0.3, -0.1, 0.1, 0.3)])
    >>> azimuths, walls = np.radians(np.linspace(90.0, -90.0, 37)), StreetWalls(4.45, 2.8, 2.8, 7.15)
    >>> frequencies = np.arange(300.0, 2000.0, 300.0)
    >>> model = SpectrumModel.of(walls, array, azimuths, frequencies, draws=4)
    >>> adapter = PlaceMeasurements(PlaceFilter(model))
    >>> beams = array.steering(frequencies, azimuths).conj().transpose(0, 2, 1)
    >>> heard = (np.abs(beams @ array.steering(frequencies, np.radians(20.0))) ** 2).sum(axis=(0, 2))
    >>> found = [adapter.measure(SpatialSpectrum(k * 100_000_000, heard)) for k in range(1, 12)]
    >>> [type(one).__name__ for (one,) in filter(None, found)]
    ['PositionScan']
    """

    def __init__(self, places: PlaceFilter, interval_s: float = 1.0) -> None:
        self.source = "place"
        self._places = places
        self._interval_ns = nanoseconds(in_range("interval_s", interval_s, 0.1, 10.0))
        self._heard = self._carried = places.unknown
        self._begin_ns: int | None = None
        self._last_ns = 0

    @property
    def estimate(self) -> PlaceEstimate:
        """What is believed of the vehicle now, all spectra counted."""
        return self._places.estimate(self._heard)

    def measure(self, spectrum: SpatialSpectrum) -> list[Measurement | PositionScan]:
        """Take the next spectrum; return the measurement that it completes, if any.

        Parameters
        ----------
        spectrum : SpatialSpectrum
            Later than the last one; at most 10 s later.

        Returns
        -------
        list of Measurement or PositionScan
            None or one.

        Raises
        ------
        InvalidArgumentError
            If it is not later than the last one, or of another shape.
        """
        if self._begin_ns is None:
            self._begin_ns = self._last_ns = spectrum.stamp_ns
        elif spectrum.stamp_ns <= self._last_ns:
            raise InvalidArgumentError(
                f"stamp_ns: expected one after {self._last_ns}, got {spectrum.stamp_ns}"
            )
        dt_s = seconds(spectrum.stamp_ns - self._last_ns)
        self._heard = self._places.update(self._places.predict(self._heard, dt_s), spectrum.values)
        self._carried = self._places.predict(self._carried, dt_s)
        self._last_ns = spectrum.stamp_ns
        if spectrum.stamp_ns - self._begin_ns < self._interval_ns:
            return []
        found = self._interval(spectrum.stamp_ns)
        self._begin_ns, self._carried = spectrum.stamp_ns, self._heard
        return found

    def _interval(self, stamp_ns: int) -> list[Measurement | PositionScan]:
        now, before = self._places.estimate(self._heard), self._places.estimate(self._carried)
        if not isinstance(now.place, KnownPlace):
            return [self._sides(stamp_ns)]
        added = now.std_m**-2 - before.std_m**-2
        # Nothing, or too little to state: the interval told no more than what was known already.
        if added * STATED_STD_M**2 <= 1.0:
            return []
        along = (now.mean_m / now.std_m**2 - before.mean_m / before.std_m**2) / added
        exists = min(max(now.existence_probability, LEAST_EXISTENCE), MOST_EXISTENCE)
        spread = ((LANE_STD_M**2, 0.0), (0.0, 1.0 / added))
        there = Position((self._places.model.walls.crossing_m, along), spread, existence_probability=exists)
        return [PositionScan(self.source, stamp_ns, (there,))]

    def _sides(self, stamp_ns: int) -> Measurement:
        right, left, view, nobody = (
            math.log(now / before)
            for now, before in zip(self._shares(self._heard), self._shares(self._carried), strict=True)
        )
        told = SignatureEvidence(("left", "right"), hidden=(left, right), visible=view, none=nobody)
        unknown = NotUsable("no place can be stated")
        return Measurement(stamp_ns, told, Unqueried("heard"), unknown, unknown, source=self.source)

    def _shares(self, belief: PlaceBelief) -> list[float]:
        """Probabilities hidden on the right, hidden on the left, in view, and of nobody."""
        model = self._places.model
        somebody = 1.0 - math.exp(belief.log_nobody)
        at, (right, left) = model.along_m, model.walls.sight_m
        parts = [
            belief.of_places[part].sum() for part in (at < right, at > left, (at >= right) & (at <= left))
        ]
        return [max(float(part * somebody), LEAST_SHARE) for part in parts] + [
            max(1.0 - somebody, LEAST_SHARE)
        ]
