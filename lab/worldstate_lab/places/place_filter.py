r"""Exact grid filter over position and speed on the crossing street, with a state for an empty street.

.. math:: p_t(x', v') \propto L_t(x') \sum_{x, v} T_v(x' | x)\, A(v' | v)\, p_{t-1}(x, v)

Positions change by v dt, speeds by a random walk. If a vehicle leaves the grid, the street is empty; a new
vehicle has a uniform position on it.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg import expm

from worldstate.ground.checks import in_range
from worldstate.ground.typing import FloatArray
from worldstate.measurement.position import Position

from .spectrum_model import FARTHEST_M, STEP_M, RayModel, SpectrumModel

# To the left and to the right: urban speeds, and cars that creep into a junction.
SPEEDS_MPS = np.arange(1.0, 8.1, 0.5)
VELOCITIES_MPS = np.concatenate([-SPEEDS_MPS[::-1], SPEEDS_MPS])
# m/s in one second: drivers brake with 0.5 to 1 m/s^2 before a junction.
SPEED_NOISE = 0.5
TURNS_HZ = 1e-3  # Turns per second: few vehicles turn round in a street
# The rates of `state.Rates`, both sides together; departures are vehicles that leave without passing.
ARRIVALS_HZ, DEPARTURES_HZ = 0.1, 0.01
# The sound comes from an axle, but the position is that of the vehicle's centre, half a wheelbase (1.35 m)
# away at most.
EXTENT_STD_M = 1.0
_REACH_M = np.arange(-3.0 * EXTENT_STD_M, 3.0 * EXTENT_STD_M + 0.5 * STEP_M, STEP_M)
_EXTENT = np.exp(-0.5 * (_REACH_M / EXTENT_STD_M) ** 2)
STATED_STD_M = 5.0


@dataclass(frozen=True, slots=True)
class PlaceEstimate:
    """Belief about one vehicle on the crossing street; all fields but the last are given that it exists.

    Parameters
    ----------
    mean_m, std_m : float
        Of the position along the street, left positive.
    interval_m : (float, float)
        From the 5 % to the 95 % quantile.
    left_probability : float
        Probability that it is left of the ego's axis.
    existence_probability : float
        Probability that there is a vehicle.

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
        """Whether a position can be published; otherwise only the side."""
        return self.std_m < STATED_STD_M


@dataclass(frozen=True, slots=True, eq=False)
class PlaceBelief:
    """Log probabilities of every velocity and position, and of an empty street.

    Examples
    --------
    >>> PlaceBelief(np.zeros((30, 89)), 0.0).of_places.shape
    (89,)
    """

    log_present: FloatArray  # shape (V, N)
    log_empty: float

    @property
    def of_places(self) -> FloatArray:
        """Probability of every position, given a vehicle, shape (N,)."""
        present = np.exp(self.log_present - self.log_present.max()).sum(axis=0)
        return np.asarray(present / present.sum())


@dataclass(frozen=True, slots=True, eq=False)
class PlaceFilter:
    """Updates the belief about one vehicle from one spatial spectrum to the next.

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
        """Return the belief before any sound: existence 0.5, uniform position."""
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
        # After underflow to zero, no evidence could raise the probability of a position again.
        return PlaceBelief(np.log(np.maximum(present, 1e-300)), float(np.log(empty - come + left + 1e-300)))

    def update(self, belief: PlaceBelief, spectrum: FloatArray) -> PlaceBelief:
        """Return the belief after a spectrum; see `SpectrumModel.log_likelihood` for its errors."""
        like, without = self.model.log_likelihood(spectrum)
        present, empty = belief.log_present + like, belief.log_empty + without
        most = max(float(present.max()), empty)
        total = most + np.log(np.exp(present - most).sum() + np.exp(empty - most))
        return PlaceBelief(present - total, float(empty - total))

    def estimate(self, belief: PlaceBelief) -> PlaceEstimate:
        """Return the estimate for the centre of the vehicle."""
        along = self.model.along_m
        heard = belief.of_places
        shares = np.convolve(heard, _EXTENT, mode="same")
        shares = shares / shares.sum()
        mean = float(shares @ along)
        std = float(np.sqrt(shares @ (along - mean) ** 2))
        ends = np.interp((0.05, 0.95), shares.cumsum(), along + 0.5 * STEP_M).tolist()
        on_left = float(heard[along > 0.0].sum() + 0.5 * heard[along == 0.0].sum())
        exists = 1.0 - min(float(np.exp(belief.log_empty)), 1.0)
        return PlaceEstimate(mean, std, (ends[0], ends[1]), min(on_left, 1.0), exists)


@lru_cache(maxsize=4)
def _transitions(dt_s: float) -> tuple[FloatArray, FloatArray]:
    """Return the transitions of speeds, (V, V), and of positions by velocity, (V, N, N), rows to columns."""
    number, places = len(VELOCITIES_MPS), round(2.0 * FARTHEST_M / STEP_M) + 1
    rate = 0.5 * (SPEED_NOISE / (SPEEDS_MPS[1] - SPEEDS_MPS[0])) ** 2
    generator = rate * (np.eye(number, k=1) + np.eye(number, k=-1))
    middle = number // 2
    # A change between the slowest speeds to the left and to the right is a turn, because the vehicle has to
    # stop.
    generator[middle - 1, middle] = generator[middle, middle - 1] = 0.0
    generator += TURNS_HZ * np.eye(number)[::-1]
    generator -= np.diag(generator.sum(axis=1))
    moves = np.array([_moved(velocity * dt_s / STEP_M, places) for velocity in VELOCITIES_MPS])
    return expm(generator * dt_s), moves if dt_s else np.broadcast_to(np.eye(places), moves.shape)


def _moved(steps: float, places: int) -> FloatArray:
    """Return a matrix that moves by a mean number of steps, variance 1/4 step^2, (places, places)."""
    # Linear interpolation would blur slow vehicles but not those that move by whole steps.
    whole = int(np.rint(steps))
    rest, spread = steps - whole, 0.25
    ahead, back = 0.5 * (spread + rest**2 + rest), 0.5 * (spread + rest**2 - rest)
    eye = [np.eye(places, k=whole + k) for k in (-1, 0, 1)]
    return np.asarray(back * eye[0] + (1.0 - ahead - back) * eye[1] + ahead * eye[2])


LANE_STD_M = 1.0  # A vehicle may use either lane of the crossing street
# Sound from behind walls is never proof of a vehicle.
LEAST_EXISTENCE, MOST_EXISTENCE = 0.01, 0.99


def added_position(now: PlaceEstimate, before: PlaceEstimate, crossing_m: float) -> Position | None:
    r"""Return the information that spectra added to a belief predicted without them, for the world filter.

    The filter of positions has already used every spectrum. For a position with mean m and variance P, and
    m', P' without these spectra, the equivalent measurement is

    .. math:: R^{-1} = P^{-1} - P'^{-1}, \qquad z = R (P^{-1} m - P'^{-1} m').

    None if no position can be published, or the spectra added no information.

    Parameters
    ----------
    now, before : PlaceEstimate
        With and without these spectra, at one time.
    crossing_m : float
        Distance ahead at which vehicles cross.

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
