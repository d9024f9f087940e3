"""Adapter of spatial spectra: a place as a scan of positions, or a side as evidence."""

import math

from worldstate.abduction.co_evidence import Unqueried
from worldstate.abduction.evidence import SignatureEvidence
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray
from worldstate.ground.values import NotUsable, seconds
from worldstate.measurement.measurement import Measurement
from worldstate.measurement.position import Position, PositionScan

from .place_filter import STATED_STD_M, PlaceBelief, PlaceEstimate, PlaceFilter

LANE_STD_M = 1.0  # Either lane of the crossing street
# Between measurements.
INTERVAL_NS = 1_000_000_000
# A place heard through walls never proves a vehicle.
LEAST_EXISTENCE, MOST_EXISTENCE = 0.01, 0.99
LEAST_SHARE = 1e-6


class PlaceMeasurements:
    r"""Turns spatial spectra into measurements of the world filter, one a second.

    The filter of places has counted every spectrum already. What is passed on is what this second added to
    the belief carried over from the last one: of a place with mean m and variance P, and m', P' without
    these spectra, the equivalent measurement

    .. math:: R^{-1} = P^{-1} - P'^{-1}, \qquad z = R (P^{-1} m - P'^{-1} m'),

    and where none can be stated the ratio of both beliefs by side, in view and of an empty street.

    Parameters
    ----------
    places : PlaceFilter
        Of the junction and the array.

    Examples
    --------
    >>> import numpy as np
    >>> from worldstate.frontend import MicrophoneArray
    >>> from worldstate_lab.places.spectrum_model import SpectrumModel, StreetWalls
    >>> array = MicrophoneArray([[x, y, 0.0] for x in (0.0, 0.12) for y in (-0.3, -0.1, 0.1, 0.3)])
    >>> azimuths, walls = np.radians(np.linspace(90.0, -90.0, 37)), StreetWalls(4.45, 2.8, 2.8, 7.15)
    >>> frequencies = np.arange(300.0, 2000.0, 300.0)
    >>> model = SpectrumModel.of(walls, array, azimuths, frequencies, draws=4)
    >>> adapter = PlaceMeasurements(PlaceFilter(model))
    >>> beams = array.steering(frequencies, azimuths).conj().transpose(0, 2, 1)
    >>> heard = (np.abs(beams @ array.steering(frequencies, np.radians(20.0))) ** 2).sum(axis=(0, 2))
    >>> found = [adapter.measure(k * 100_000_000, heard) for k in range(1, 12)]
    >>> [type(one).__name__ for (one,) in filter(None, found)]
    ['PositionScan']
    """

    source = "place"

    def __init__(self, places: PlaceFilter) -> None:
        self._places = places
        self._heard = self._carried = places.unknown
        self._begin_ns: int | None = None
        self._last_ns = 0

    @property
    def estimate(self) -> PlaceEstimate:
        """What is believed of the vehicle now, all spectra counted."""
        return self._places.estimate(self._heard)

    def measure(self, stamp_ns: int, spectrum: FloatArray) -> list[Measurement | PositionScan]:
        """Take the next spectrum; return the measurement that it completes, if any.

        Parameters
        ----------
        stamp_ns : int
            When the spectrum ended: later than the last one, by at most 10 s.
        spectrum : ndarray, shape (G,)
            On the azimuths of the model, at any scale.

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
            self._begin_ns = self._last_ns = stamp_ns
        elif stamp_ns <= self._last_ns:
            raise InvalidArgumentError(f"stamp_ns: expected one after {self._last_ns}, got {stamp_ns}")
        dt_s = seconds(stamp_ns - self._last_ns)
        self._heard = self._places.update(self._places.predict(self._heard, dt_s), spectrum)
        self._carried = self._places.predict(self._carried, dt_s)
        self._last_ns = stamp_ns
        if stamp_ns - self._begin_ns < INTERVAL_NS:
            return []
        found = self._interval(stamp_ns)
        self._begin_ns, self._carried = stamp_ns, self._heard
        return found

    def _interval(self, stamp_ns: int) -> list[Measurement | PositionScan]:
        now, before = self._places.estimate(self._heard), self._places.estimate(self._carried)
        if not now.stated:
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
        right, left, view, empty = (
            math.log(now / before)
            for now, before in zip(self._shares(self._heard), self._shares(self._carried), strict=True)
        )
        told = SignatureEvidence(("left", "right"), hidden=(left, right), visible=view, none=empty)
        unknown = NotUsable("no place can be stated")
        return Measurement(stamp_ns, told, Unqueried("heard"), unknown, unknown, source=self.source)

    def _shares(self, belief: PlaceBelief) -> list[float]:
        """Probabilities hidden on the right, hidden on the left, in view, and of an empty street."""
        at, (right, left) = self._places.model.along_m, self._places.model.walls.sight_m
        exists = 1.0 - math.exp(belief.log_empty)
        parts = at < right, at > left, (at >= right) & (at <= left)
        shares = [exists * float(belief.of_places[part].sum()) for part in parts]
        return [max(share, LEAST_SHARE) for share in (*shares, 1.0 - exists)]
