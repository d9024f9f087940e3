r"""Likelihood of a spatial spectrum given a position on the crossing street.

After the phase transform every frequency has equal weight, and its power is divided among the paths p and the
diffuse sound d. The expected SRP over azimuth is a mixture of the array's responses B to plane waves,

.. math:: t_x(\theta) = \Big\langle \frac{\sum_p g_p(x, f) B_f(\theta, \theta_p) + d D_f(\theta)}
                                        {\sum_p g_p(x, f) + d} \Big\rangle_f .

Scale and offset of a spectrum are arbitrary. Both are fitted in the metric of the array's resolution
:math:`C(\theta, \theta') = \langle B_f(\theta, \theta') \rangle_f + \lambda I`, which leaves the correlation
r of spectrum and template. The reflection of the walls, the screen loss at the corner and the sound of the
street are unknown: the likelihood is the mean over draws k of them,

.. math:: L(x) = \Big\langle w_k (1 - r_+^2)^{-\nu/2} + (1 - w_k) (1 - r_0^2)^{-\nu/2} \Big\rangle_k ,

where w is the share of the sound that arrives by paths, and r_0 the correlation of a spectrum without a
vehicle.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.checks import finite_array, in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray

SPEED_OF_SOUND_MPS = 343.0
# The sound of a far vehicle enters the mouth of the street only after several reflections in its side walls:
# 2 at 11 m, 3 at 15 m, from alternating sides. With at most three, a real vehicle at 9 m was estimated on the
# wrong side for half a second.
SIDE_ORDER, FACADE_ORDER = 8, 2
# A ray this far inside the mouth no longer has the corner's loss of 5 dB.
LIT_DEPTH_M = 0.5


@dataclass(frozen=True, slots=True)
class StreetWalls:
    """Two side walls up to the corners, the crossing street beyond them, and the wall opposite the ego.

    Parameters
    ----------
    corner_ahead_m : float
        Distance of the corners ahead of the array, at the ends of the side walls.
    left_m, right_m : float
        Distance of the side walls to the left and to the right of the array.
    crossing_m : float
        Distance ahead at which vehicles cross, beyond the corners.
    facing_m : float or None
        Distance ahead of the wall beyond the crossing street; None if there is none.

    Raises
    ------
    InvalidArgumentError
        If a distance is out of range, or the street is not between the corners and the facing wall.

    Examples
    --------
    >>> [round(limit, 2) for limit in StreetWalls(4.45, 2.8, 2.8, 7.15, facing_m=9.9).sight_m]
    [-4.5, 4.5]
    """

    corner_ahead_m: float
    left_m: float
    right_m: float
    crossing_m: float
    facing_m: float | None = None

    def __post_init__(self) -> None:
        for name in ("corner_ahead_m", "left_m", "right_m"):
            in_range(name, getattr(self, name), 0.5, 100.0)
        in_range("crossing_m", self.crossing_m, self.corner_ahead_m + 0.5, 200.0)
        if self.facing_m is not None:
            in_range("facing_m", self.facing_m, self.crossing_m + 0.5, 200.0)

    @property
    def sight_m(self) -> tuple[float, float]:
        """Limits (right, left) of the part of the crossing street in line of sight, y left positive."""
        reach = self.crossing_m / self.corner_ahead_m
        return -self.right_m * reach, self.left_m * reach


@dataclass(frozen=True, slots=True)
class SoundPath:
    """One propagation path from every position, shape (N,), at every frequency, (F,)."""

    azimuth_rad: FloatArray  # shape (N,): Direction of arrival
    length_m: FloatArray  # shape (N,)
    passed: FloatArray  # shape (N, F): Share of the power that passes the corner
    facades: int  # Number of reflections in the crossing street
    side_walls: tuple[int, int]  # Number of reflections in the left and in the right side wall

    def power(self, facade: float, left: float, right: float) -> FloatArray:
        r"""Return :math:`\rho_f^{2 n_f} \rho_l^{2 n_l} \rho_r^{2 n_r} D / r^2`, shape (N, F)."""
        of_left, of_right = self.side_walls
        walls = facade**self.facades * left**of_left * right**of_right
        return np.asarray(walls**2 * self.passed / self.length_m[:, None] ** 2)


def sound_paths(
    walls: StreetWalls, crossing_m: float, along_m: FloatArray, frequencies_hz: FloatArray
) -> list[SoundPath]:
    """Return all paths from positions on a lane, including those from behind a corner.

    Examples
    --------
    >>> walls = StreetWalls(4.45, 2.8, 2.8, 7.15)
    >>> direct = sound_paths(walls, 7.15, np.array([2.0, 12.0]), np.array([500.0]))[0]
    >>> np.degrees(direct.azimuth_rad).round(1), direct.passed.round(3).ravel()
    (array([15.6, 32.2]), array([1.   , 0.018]))
    """
    mouth, left, right = walls.corner_ahead_m, walls.left_m, -walls.right_m
    paths = []
    for facades, ahead in enumerate(_source_images(walls, crossing_m)):
        for end, sign, side_walls in _array_images(walls):
            crossed = end + (along_m - end) * mouth / ahead
            aim = np.clip(crossed, right, left)
            straight = np.hypot(ahead, along_m - end)
            way = np.hypot(ahead - mouth, along_m - aim) + np.hypot(mouth, aim - end)
            inside = np.minimum(crossed - right, left - crossed)
            passed = _corner_share(way - straight, inside, frequencies_hz)
            azimuth = np.arctan2(sign * (aim - end), mouth)
            paths.append(SoundPath(azimuth, way, passed, facades, side_walls))
    return paths


def _source_images(walls: StreetWalls, crossing_m: float) -> list[float]:
    """Return the distances ahead of a lane and of its images in the two facades of the crossing street."""
    if walls.facing_m is None:
        return [crossing_m]
    mouth, depth = walls.corner_ahead_m, walls.facing_m - walls.corner_ahead_m
    inside = crossing_m - mouth
    return [mouth + 2.0 * depth * ((k + 1) // 2) + inside * (-1) ** k for k in range(FACADE_ORDER + 1)]


def _array_images(walls: StreetWalls) -> Iterator[tuple[float, int, tuple[int, int]]]:
    """Yield lateral position, orientation and reflections (left, right) of the array's images."""
    yield 0.0, 1, (0, 0)
    width = walls.left_m + walls.right_m
    for order in range(1, SIDE_ORDER + 1):
        shift, odd = 2.0 * width * (order // 2), order % 2
        more, fewer = (order + 1) // 2, order // 2
        yield shift + 2.0 * walls.left_m * odd, (-1) ** order, (more, fewer)
        yield -shift - 2.0 * walls.right_m * odd, (-1) ** order, (fewer, more)


def _corner_share(detour_m: FloatArray, inside_m: FloatArray, frequencies_hz: FloatArray) -> FloatArray:
    r"""Return the share behind a screen, (N, F): :math:`1 / (3 + 20 N)`, :math:`N = 2 \delta f / c`."""
    # Z. Maekawa, "Noise reduction by screens", Applied Acoustics 1 (1968): 10 log10(3 + 20 N) dB.
    fresnel = 2.0 * detour_m[:, None] * frequencies_hz / SPEED_OF_SOUND_MPS
    lit = np.clip(inside_m / LIT_DEPTH_M, 0.0, 1.0)[:, None]
    return np.where(inside_m[:, None] < 0.0, 1.0 / (3.0 + 20.0 * fresnel), (1.0 + 2.0 * lit) / 3.0)


# Vehicles farther away cannot be distinguished from the rest of the street: in simulated passes, and in real
# ones without positions, detectable sound starts at 17 to 20 m.
FARTHEST_M, STEP_M = 22.0, 0.5
# Each of 32 draws samples these uniformly: pressure reflection factor of the left and right side walls and of
# the facades, diffuse sound relative to a vehicle at 1 m (dB), screen loss relative to Maekawa's (dB), lane
# (m).
DRAWS = 32
LEAST = np.array([0.65, 0.65, 0.5, -35.0, -3.0, -1.0])
MOST = np.array([1.0, 1.0, 1.0, -15.0, 3.0, 1.0])
# An additive recurrence on powers of the root of g^7 = g + 1 fills six dimensions evenly without a random
# generator.
_GOLDEN = 1.1127756842787055 ** -np.arange(1.0, 7.0)
# Tyres and engine: the sound comes from three points along a vehicle.
PARTS_M = (-1.3, 0.0, 1.3)
# Degrees of freedom of a spectrum 0.1 s after the previous one, of about ten that the array resolves, and the
# share r_0^2. They were set on 40 simulated passes (the 90 % interval covers 0.89) and on real ones without
# positions. With 6 and 0.35 the error is 0.3 m smaller in simulation and 0.3 m larger on the real ones.
FREEDOM, CHANCE = 4.5, 0.3
# The metric ignores directions below this share of the total, which contain noise of microphones and method.
LEAST_RESOLVED = 1e-3
# r = 1 would mean certainty.
MOST_ALIKE = 0.999
# Constant weights of direct, diffracted and singly reflected rays in the simple likelihood.
DIRECT, BENT, REFLECTED = 1.0, 0.5, 0.5
# Nats between a ray at the peak and one at the lowest level: of 2, 4, 8 and 16, the value with the smallest
# error on the simulated passes on which the constants above were set.
SHARPNESS = 16.0
_ARRIVALS_RAD = np.radians(np.arange(-90.0, 90.5, 1.0))
_ALL_ROUND_RAD = np.radians(np.arange(-180.0, 180.0, 5.0))


@dataclass(frozen=True, slots=True, eq=False)
class SpectrumModel:
    """Expected spatial spectra of an array between known walls, and the likelihood of a spectrum by position.

    Examples
    --------
    >>> array = MicrophoneArray([[x, y, 0.0] for x in (0.0, 0.12) for y in (-0.3, -0.1, 0.1, 0.3)])
    >>> azimuths, walls = np.radians(np.linspace(90.0, -90.0, 37)), StreetWalls(4.45, 2.8, 2.8, 7.15)
    >>> model = SpectrumModel.of(walls, array, azimuths, np.array([500.0, 1000.0, 1500.0]), draws=4)
    >>> towards = np.exp(-(((azimuths - np.radians(20.0)) / 0.2) ** 2))
    >>> like, empty = model.log_likelihood(towards)
    >>> float(model.along_m[like.argmax()]), bool(like.max() > empty)
    (3.0, True)
    """

    walls: StreetWalls
    along_m: FloatArray  # shape (N,): Positions along the crossing street, left positive
    metric: FloatArray  # shape (G, G): Square root of the inverse of C, without the constant component
    templates: FloatArray  # shape (K, N, G): Expected spectra in that metric, normalised to length 1
    heard_share: FloatArray  # shape (K, N): w, the share of the sound that arrives by paths

    @classmethod
    def of(
        cls,
        walls: StreetWalls,
        array: MicrophoneArray,
        azimuths_rad: FloatArray,
        frequencies_hz: FloatArray,
        *,
        draws: int = DRAWS,
    ) -> "SpectrumModel":
        """Compute expected spectra of an array on given azimuths, left positive, summed over frequencies.

        Parameters
        ----------
        walls : StreetWalls
            Geometry of reflection and diffraction.
        array : MicrophoneArray
            The array, in the axes of the walls.
        azimuths_rad : ndarray, shape (G,)
            Azimuths of the spectra; left positive.
        frequencies_hz : ndarray, shape (F,)
            Frequencies of the sum.
        draws : int
            Number K of draws of reflection factors and levels for the mean.

        Returns
        -------
        SpectrumModel
        """
        hz, azimuths = frequencies_hz, azimuths_rad
        along = np.arange(-FARTHEST_M, FARTHEST_M + 0.5 * STEP_M, STEP_M)
        beams = _responses(array, hz, azimuths, _ARRIVALS_RAD)
        # All frequencies are in one matrix product: separate products took 12 s instead of 1.
        beams = np.ascontiguousarray(beams.transpose(0, 2, 1)).reshape(-1, len(azimuths)) / len(hz)
        diffuse = _responses(array, hz, azimuths, _ALL_ROUND_RAD).mean(axis=2) / len(hz)
        metric = _metric(_responses(array, hz, azimuths, azimuths).mean(axis=0))
        templates, heard = [], []
        for draw in _draws(draws):
            by_azimuth = _arriving(walls, along, hz, draw)
            ambience = 10.0 ** (draw[3] / 10.0)
            arriving = by_azimuth.sum(axis=2)  # shape (N, F)
            shares = by_azimuth / (arriving + ambience)[:, :, None]
            around = ambience / (arriving + ambience)
            expected = shares.reshape(len(along), -1) @ beams + around @ diffuse
            templates.append(_directions(expected @ metric))
            heard.append(1.0 - around.mean(axis=1))
        return cls(walls, along, metric, np.array(templates), np.array(heard))

    def log_likelihood(self, spectrum: FloatArray) -> tuple[FloatArray, float]:
        """Return the log-likelihood of a spectrum at any scale and offset, by position and without a vehicle.

        Parameters
        ----------
        spectrum : ndarray, shape (G,)
            On the azimuths of the model.

        Returns
        -------
        tuple of (ndarray, float)
            For every position in `along_m`, and without a vehicle, in nats up to a common constant.

        Raises
        ------
        InvalidArgumentError
            If the shape is wrong, a value is not finite, or all values are equal.
        """
        values = finite_array("spectrum", spectrum, (len(self.metric),))
        if np.ptp(values) == 0.0:
            got = f"got only {values[0]:g}"
            raise InvalidArgumentError(f"spectrum: expected values that differ over azimuth, {got}")
        # The scale is arbitrary. Values are centred first, because a large offset would reduce precision.
        alike = np.clip(self.templates @ _directions((values - values.mean()) @ self.metric), 0.0, MOST_ALIKE)
        by_path = (1.0 - alike**2) ** (-0.5 * FREEDOM)
        by_chance = (1.0 - CHANCE) ** (-0.5 * FREEDOM)
        like = self.heard_share * by_path + (1.0 - self.heard_share) * by_chance
        return np.log(like.mean(axis=0)), float(np.log(by_chance))


@dataclass(frozen=True, slots=True, eq=False)
class RayModel:
    """Simple likelihood for comparison: the mean of the spectrum at the arrivals of three kinds of rays.

    Examples
    --------
    >>> azimuths = np.radians(np.linspace(90.0, -90.0, 180))
    >>> model = RayModel.of(StreetWalls(4.45, 2.8, 2.8, 7.15), azimuths, np.arange(-20.0, 21.0))
    >>> like, _ = model.log_likelihood(np.exp(-((azimuths - 0.3) ** 2) / 0.01))
    >>> int(model.along_m[like.argmax()])
    2
    """

    walls: StreetWalls
    along_m: FloatArray
    columns: FloatArray  # shape (G, N): Weights over azimuths

    @classmethod
    def of(cls, walls: StreetWalls, azimuths_rad: FloatArray, along_m: FloatArray) -> "RayModel":
        """Trace the rays from all positions."""
        every, columns = np.arange(len(along_m)), np.zeros((len(azimuths_rad), len(along_m)))
        for path in sound_paths(walls, walls.crossing_m, along_m, np.array([1000.0])):
            order = path.facades + sum(path.side_walls)
            if order <= 1:
                lit = path.passed[:, 0] >= 1.0 / 3.0
                weight = np.where(lit, REFLECTED, 0.0) if order else np.where(lit, DIRECT, BENT)
                nearest = np.abs(azimuths_rad[:, None] - path.azimuth_rad).argmin(axis=0)
                columns[nearest, every] += weight
        return cls(walls, along_m, columns / columns.sum(axis=0))

    def log_likelihood(self, spectrum: FloatArray) -> tuple[FloatArray, float]:
        """Return the log-likelihood by position; an empty street is not a state of the simple filter."""
        level = (spectrum - spectrum.min()) / np.ptp(spectrum)
        return SHARPNESS * (level @ self.columns), -np.inf


def _draws(number: int) -> FloatArray:
    """Return values between `LEAST` and `MOST`, shape (number, 6)."""
    return np.asarray(LEAST + (MOST - LEAST) * np.mod(0.5 + np.arange(1, number + 1)[:, None] * _GOLDEN, 1.0))


def _arriving(walls: StreetWalls, along_m: FloatArray, hz: FloatArray, draw: FloatArray) -> FloatArray:
    """Return the power from every position by azimuth of arrival, (N, F, azimuths of `_ARRIVALS_RAD`)."""
    left, right, facade, _, screen_db, off_m = draw.tolist()
    arriving = np.zeros((len(along_m), len(hz), len(_ARRIVALS_RAD)))
    every = np.arange(len(along_m))
    for part_m in PARTS_M:
        for path in sound_paths(walls, walls.crossing_m + off_m, along_m + part_m, hz):
            # A path counts as diffracted if the corner removes more than half of its power.
            bent = np.where(path.passed < 1.0 / 3.0, 10.0 ** (screen_db / 10.0), 1.0)
            at = np.rint(np.degrees(path.azimuth_rad)).astype(int) + 90
            arriving[every, :, at] += path.power(facade, left, right) * bent / len(PARTS_M)
    return arriving


def _responses(
    array: MicrophoneArray, frequencies_hz: FloatArray, azimuths_rad: FloatArray, waves_rad: FloatArray
) -> FloatArray:
    r"""Return the beam power of plane waves, :math:`|a_f(\theta)^H a_f(\phi)|^2 / M^2`, (F, G, waves)."""
    beams = array.steering(frequencies_hz, azimuths_rad).conj().transpose(0, 2, 1)
    return np.asarray(np.abs(beams @ array.steering(frequencies_hz, waves_rad)) ** 2 / array.n_microphones**2)


def _metric(resolution: FloatArray) -> FloatArray:
    """Return the symmetric root of the inverse of C, without the component of a constant."""
    values, vectors = np.linalg.eigh(resolution)
    values = np.maximum(values, 0.0) + LEAST_RESOLVED * np.trace(resolution)
    root = (vectors / np.sqrt(values)) @ vectors.T
    constant = root.sum(axis=1)
    constant /= np.linalg.norm(constant)
    return np.asarray(root - np.outer(root @ constant, constant))


def _directions(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
