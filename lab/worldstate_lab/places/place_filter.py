r"""Exact filter over place and speed on a grid, with a state for an empty street.

.. math:: p_t(x', v') \propto L_t(x') \sum_{x, v} T_v(x' | x)\, A(v' | v)\, p_{t-1}(x, v)

Places move by v dt, speeds by a random walk. A vehicle that leaves the grid leaves the street empty; one that
comes may be anywhere on it.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from worldstate.ground.checks import in_range
from worldstate.ground.typing import FloatArray
from worldstate.measurement.position import Position

from .spectrum_model import FARTHEST_M, STEP_M, RayModel, SpectrumModel

# Toward the left and toward the right: streets in town, cars that creep into a junction included.
SPEEDS_MPS = np.arange(1.0, 8.1, 0.5)
VELOCITIES_MPS = np.concatenate([-SPEEDS_MPS[::-1], SPEEDS_MPS])
# m/s in a second: drivers brake by .5 to 1 m/s^2 before a junction.
SPEED_NOISE = 0.5
TURNS_HZ = 1e-3  # Few vehicles turn round in a street
# The rates of `state.Rates`, both sides; departures are of vehicles that leave without passing.
ARRIVALS_HZ, DEPARTURES_HZ = 0.1, 0.01
# An axle is heard, and the middle of the vehicle is meant: half a wheelbase of 2.7 m, and some.
EXTENT_STD_M = 1.0
STATED_STD_M = 5.0


@dataclass(frozen=True, slots=True)
class PlaceEstimate:
    """Belief about one vehicle on the crossing street; all but its existence given that there is one.

    Parameters
    ----------
    mean_m, std_m : float
        Of the place along the street, left positive.
    interval_m : (float, float)
        From the 5 % to the 95 % quantile.
    left_probability : float
        That it is left of the ego's axis.
    existence_probability : float
        That there is a vehicle.

    Examples
    --------
    >>> PlaceEstimate(7.2, 1.4, (5.0, 9.5), 1.0, 0.99).stated
    True
    """

    mean_m: float
    std_m: float
    interval_m: tuple[float, float]
    left_probability: float
    existence_probability: float

    @property
    def stated(self) -> bool:
        """Whether a place can be stated; otherwise only the side."""
        return self.std_m < STATED_STD_M


@dataclass(frozen=True, slots=True, eq=False)
class PlaceBelief:
    """Log probabilities of every velocity and place, and of an empty street.

    Examples
    --------
    >>> PlaceBelief(np.zeros((30, 89)), 0.0).of_places.shape
    (89,)
    """

    log_present: FloatArray  # shape (V, N)
    log_empty: float

    @property
    def of_places(self) -> FloatArray:
        """Probability of every place, given a vehicle, shape (N,)."""
        present = np.exp(self.log_present - self.log_present.max()).sum(axis=0)
        return np.asarray(present / present.sum())


@dataclass(frozen=True, slots=True, eq=False)
class PlaceFilter:
    """Carries the belief about one vehicle from one spatial spectrum to the next.

    Parameters
    ----------
    model : SpectrumModel or RayModel
        Likelihood of the spectra.

    Examples
    --------
    >>> from worldstate.frontend import MicrophoneArray
    >>> from worldstate_lab.places.spectrum_model import StreetWalls
    >>> array = MicrophoneArray([[x, y, 0.0] for x in (0.0, 0.12) for y in (-0.3, -0.1, 0.1, 0.3)])
    >>> azimuths, walls = np.radians(np.linspace(90.0, -90.0, 37)), StreetWalls(4.45, 2.8, 2.8, 7.15)
    >>> frequencies = np.arange(300.0, 2000.0, 300.0)
    >>> beams = array.steering(frequencies, azimuths).conj().transpose(0, 2, 1)
    >>> wave = np.abs(beams @ array.steering(frequencies, np.radians(20.0))) ** 2
    >>> places = PlaceFilter(SpectrumModel.of(walls, array, azimuths, frequencies, draws=4))
    >>> belief = places.unknown
    >>> for _ in range(5):
    ...     belief = places.update(places.predict(belief, 0.1), wave.sum(axis=(0, 2)))
    >>> estimate = places.estimate(belief)
    >>> round(estimate.mean_m), estimate.left_probability > 0.9
    (3, True)
    """

    model: SpectrumModel | RayModel

    @property
    def unknown(self) -> PlaceBelief:
        """Belief before anything was heard: a vehicle as probable as none, anywhere."""
        shape = len(VELOCITIES_MPS), len(self.model.along_m)
        return PlaceBelief(np.full(shape, -np.log(2.0 * shape[0] * shape[1])), -np.log(2.0))

    def predict(self, belief: PlaceBelief, dt_s: float) -> PlaceBelief:
        """Return the belief after a time, 0 to 10 s, without a spectrum."""
        in_range("dt_s", dt_s, 0.0, 10.0)
        speeds, moves = _transitions(dt_s)
        empty = np.exp(belief.log_empty)
        stayed = np.exp(-DEPARTURES_HZ * dt_s) * (speeds.T @ np.exp(belief.log_present))
        present = (stayed[:, None] @ moves)[:, 0]
        come = empty * -np.expm1(-ARRIVALS_HZ * dt_s)
        left = max(1.0 - empty - present.sum(), 0.0)
        present = present + come / present.size
        # Underflow leaves places that nothing could ever bring back.
        return PlaceBelief(np.log(np.maximum(present, 1e-300)), float(np.log(empty - come + left + 1e-300)))

    def update(self, belief: PlaceBelief, spectrum: FloatArray) -> PlaceBelief:
        """Return the belief after a spectrum; see `SpectrumModel.log_likelihood` for its errors."""
        like, without = self.model.log_likelihood(spectrum)
        present, empty = belief.log_present + like, belief.log_empty + without
        most = max(float(present.max()), empty)
        total = most + np.log(np.exp(present - most).sum() + np.exp(empty - most))
        return PlaceBelief(present - total, float(empty - total))

    def estimate(self, belief: PlaceBelief) -> PlaceEstimate:
        """Return what can be said of the middle of the vehicle."""
        along = self.model.along_m
        heard = belief.of_places
        shares = np.convolve(heard, _extent(), mode="same")
        shares = shares / shares.sum()
        mean = float(shares @ along)
        std = float(np.sqrt(shares @ (along - mean) ** 2))
        ends = np.interp((0.05, 0.95), shares.cumsum(), along + 0.5 * STEP_M).tolist()
        on_left = float(heard[along > 0.0].sum() + 0.5 * heard[along == 0.0].sum())
        exists = 1.0 - min(float(np.exp(belief.log_empty)), 1.0)
        return PlaceEstimate(mean, std, (ends[0], ends[1]), min(on_left, 1.0), exists)


@lru_cache(maxsize=4)
def _transitions(dt_s: float) -> tuple[FloatArray, FloatArray]:
    """Speeds, shape (V, V), and places by velocity, shape (V, N, N), from rows to columns."""
    from scipy.linalg import expm

    number, places = len(VELOCITIES_MPS), round(2.0 * FARTHEST_M / STEP_M) + 1
    rate = 0.5 * (SPEED_NOISE / (SPEEDS_MPS[1] - SPEEDS_MPS[0])) ** 2
    generator = rate * (np.eye(number, k=1) + np.eye(number, k=-1))
    middle = number // 2
    # Between the slowest to the left and the slowest to the right lies a stop: that is turning round.
    generator[middle - 1, middle] = generator[middle, middle - 1] = 0.0
    generator += TURNS_HZ * np.eye(number)[::-1]
    generator -= np.diag(generator.sum(axis=1))
    moves = np.array([_moved(velocity * dt_s / STEP_M, places) for velocity in VELOCITIES_MPS])
    return expm(generator * dt_s), moves if dt_s else np.broadcast_to(np.eye(places), moves.shape)


def _moved(steps: float, places: int) -> FloatArray:
    """Matrix that moves by a number of steps in the mean, with a variance of 1/4 step^2, (places, places)."""
    # Linear interpolation would spread slow vehicles and leave those that move by whole steps sharp.
    whole = int(np.rint(steps))
    rest, spread = steps - whole, 0.25
    ahead, back = 0.5 * (spread + rest**2 + rest), 0.5 * (spread + rest**2 - rest)
    eye = [np.eye(places, k=whole + k) for k in (-1, 0, 1)]
    return np.asarray(back * eye[0] + (1.0 - ahead - back) * eye[1] + ahead * eye[2])


def _extent() -> FloatArray:
    reach = np.arange(-3.0 * EXTENT_STD_M, 3.0 * EXTENT_STD_M + 0.5 * STEP_M, STEP_M)
    return np.asarray(np.exp(-0.5 * (reach / EXTENT_STD_M) ** 2))


LANE_STD_M = 1.0  # Either lane of the crossing street
# A place heard through walls never proves a vehicle.
LEAST_EXISTENCE, MOST_EXISTENCE = 0.01, 0.99


def added_position(now: PlaceEstimate, before: PlaceEstimate, crossing_m: float) -> Position | None:
    r"""Return what spectra have added to a belief that was carried on without them, for the world filter.

    The filter of places has counted every spectrum already. Of a place with mean m and variance P, and m', P'
    without these spectra, the equivalent measurement is

    .. math:: R^{-1} = P^{-1} - P'^{-1}, \qquad z = R (P^{-1} m - P'^{-1} m').

    None where no place can be stated, or the spectra told no more than what was known already.

    Parameters
    ----------
    now, before : PlaceEstimate
        With and without these spectra, at one time.
    crossing_m : float
        How far ahead vehicles cross.

    Examples
    --------
    >>> before, now = (PlaceEstimate(0.0, std_m, (-5.0, 5.0), 0.5, 0.9) for std_m in (10.0, 2.0))
    >>> added_position(now, before, 7.2).position_m, added_position(now, now, 7.2)
    ((7.2, 0.0), None)
    """
    added = now.std_m**-2 - before.std_m**-2
    if not now.stated or added * STATED_STD_M**2 <= 1.0:
        return None
    along = (now.mean_m / now.std_m**2 - before.mean_m / before.std_m**2) / added
    exists = min(max(now.existence_probability, LEAST_EXISTENCE), MOST_EXISTENCE)
    spread = ((LANE_STD_M**2, 0.0), (0.0, 1.0 / added))
    return Position((crossing_m, along), spread, existence_probability=exists)
