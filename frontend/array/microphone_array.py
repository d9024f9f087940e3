"""Microphone array: positions, delays, steering vectors, selected channels and two roof arrays.

Axes are those of `base_link`: x forward, y left, z up.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground import InvalidArgumentError, finite_array
from worldstate.ground.typing import BoolArray, Complex64Array, Complex128Array, FloatArray, IndexArray

SPEED_OF_SOUND_M_S = 343.0
"""Speed of sound in dry air at 20 degrees Celsius."""

Ambiguity = Literal["cone", "front-back", "up-down", "mirror", "none"]

# Extent along a principal axis relative to the largest extent below which an array is flat: 1 mm per metre,
# the accuracy of mounting.
_FLAT = 1e-3
# Direction cosine (10 degrees) above which a normal is considered parallel to an axis of the vehicle.
_ALONG_AXIS = 0.985

# Covariances grow with the square: 40 bins of 1024 channels need 0.3 GB.
MAX_MICROPHONES = 1024
LEAST_SPACING_M = 1e-4
"""Microphones closer than this are considered identical, because capsules are several millimetres wide."""

# Placement of 56 microphones: 7 staggered rows of 8. A low-discrepancy sequence shifts each microphone
# (against grating lobes), and a power law moves the columns inwards. The constants were found by one search;
# tests check the result.
_COLUMNS, _ROWS = 8, 7
_WIDTH_M, _HEIGHT_M = 0.78, 0.65
_JITTER = 0.57
_COLUMN_POWER = 1.013


def direction_vectors(azimuths_rad: ArrayLike, elevations_rad: ArrayLike = 0.0) -> FloatArray:
    r"""Return unit vectors towards far-field sources, shape (..., 3).

    .. math:: u = (\cos\phi\cos\theta,\; \cos\phi\sin\theta,\; \sin\phi)
    """
    angles = (np.asarray(one, dtype=np.float64) for one in (azimuths_rad, elevations_rad))
    azimuth, elevation = np.broadcast_arrays(*angles)
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)


def nearest_spacings_m(positions_m: FloatArray) -> FloatArray:
    r"""Return the distance from every microphone to its nearest neighbour, metres.

    .. math:: d_m = \min_{j \ne m} \|p_m - p_j\|

    Shapes: positions_m (M, 3).

    Examples
    --------
    >>> nearest_spacings_m(np.array([[0, 0, 0], [0, 0.1, 0], [0, 0.3, 0]])).round(3)
    array([0.1, 0.1, 0.2])
    """
    distance = np.linalg.norm(positions_m[:, None] - positions_m[None], axis=-1)
    np.fill_diagonal(distance, np.inf)
    return np.asarray(distance.min(axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class MicrophoneArray:
    r"""Microphones at fixed positions on the vehicle.

    A plane wave from direction u reaches microphone m at

    .. math:: \tau_m(\theta, \phi) = -p_m^T u(\theta, \phi) / c

    relative to the origin. Only differences of delays are used, so the origin is arbitrary.

    Parameters
    ----------
    positions_m : array_like, shape (M, 3)
        Coordinates in `base_link` axes (x forward, y left, z up), metres; 2 <= M <= 1024, at least 0.1 mm
        apart. The order is that of the audio channels.
    name : str
        Name in messages.
    channels : tuple of int
        Channel of each microphone, from 1, if a recording has further channels; none by default.

    Raises
    ------
    InvalidArgumentError
        On another shape, numbers that are not finite or two microphones at one place (the message gives their
        numbers, from 1), or if `channels` does not have a different channel for every microphone.

    Examples
    --------
    >>> array = MicrophoneArray([[0, 0.1, 0], [0, -0.1, 0]])
    >>> array.n_microphones, array.ambiguity
    (2, 'cone')
    >>> (1e6 * array.delays_s(np.pi / 2)).round(1)
    array([-291.5,  291.5])
    """

    positions_m: FloatArray
    name: str = "the array given"
    channels: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        positions = finite_array("positions_m", self.positions_m, (None, 3)).copy()
        if not 2 <= len(positions) <= MAX_MICROPHONES:
            expected = f"2 to {MAX_MICROPHONES} microphones"
            raise InvalidArgumentError(f"positions_m: expected {expected}, got {len(positions)}")
        spacings = nearest_spacings_m(positions)
        if spacings.min() < LEAST_SPACING_M:
            from_one_m = np.linalg.norm(positions - positions[spacings.argmin()], axis=1)
            one, other = np.argsort(from_one_m, kind="stable")[:2] + 1
            expected = f"expected microphones at least {LEAST_SPACING_M:g} m apart"
            got = f"got microphones {one} and {other} {spacings.min():.2g} m apart"
            raise InvalidArgumentError(f"positions_m: {expected}, {got}")
        numbers = {one for one in self.channels if type(one) is int and one > 0}
        if self.channels and not len(numbers) == len(self.channels) == len(positions):
            expected = f"expected {len(positions)} different numbers from 1 on, one for each microphone"
            raise InvalidArgumentError(f"channels: {expected}, got {', '.join(map(str, self.channels)):.60}")
        positions.flags.writeable = False
        object.__setattr__(self, "positions_m", positions)

    @property
    def n_microphones(self) -> int:
        """Number of microphones M."""
        return len(self.positions_m)

    @property
    def centred_m(self) -> FloatArray:
        """Positions relative to their mean, shape (M, 3), metres."""
        return np.asarray(self.positions_m - self.positions_m.mean(axis=0))

    def nearest(self, keep: BoolArray | None = None) -> IndexArray:
        """Return channels from the centre outwards: those kept (M,), or all if none is kept."""
        order = np.argsort(np.linalg.norm(self.centred_m, axis=1), kind="stable")
        return order if keep is None or not keep.any() else order[keep[order]]

    @property
    def middle(self) -> int:
        """Channel nearest to the centre."""
        return int(self.nearest()[0])

    @property
    def aperture_m(self) -> FloatArray:
        """Extent along x, y and z, shape (3,), metres."""
        return np.asarray(np.ptp(self.positions_m, axis=0))

    @property
    def widest_m(self) -> float:
        """Largest distance between two microphones, metres."""
        return float(np.linalg.norm(self.positions_m[:, None] - self.positions_m, axis=-1).max())

    @property
    def horizontal_moment_m2(self) -> float:
        """S_xx of eq. (4): sum of (p_m - mean p)^2 over the coordinates p = y, square metres."""
        return float(np.sum(self.centred_m[:, 1] ** 2))

    @property
    def mean_spacing_m(self) -> float:
        """Mean distance to the nearest neighbour, metres."""
        return float(nearest_spacings_m(self.positions_m).mean())

    def alias_hz(self) -> float:
        r"""Return the frequency below which the mean spacing d causes no aliasing in any direction, Hz.

        .. math:: f = c / (2 d)

        Returns
        -------
        float
            Frequency in Hz.

        References
        ----------
        H. L. Van Trees, *Optimum Array Processing*, 2002, chapter 2 (half a wavelength between sensors); with
        the mean spacing as in "Evidence of Absence", section IV.

        Examples
        --------
        >>> MicrophoneArray([[0, 0.1, 0], [0, -0.1, 0]]).alias_hz()
        857.5
        """
        return SPEED_OF_SOUND_M_S / (2.0 * self.mean_spacing_m)

    @property
    def ambiguity(self) -> Ambiguity:
        r"""Directions that an array of this shape cannot distinguish with any algorithm.

        With the singular values :math:`s_1 \ge s_2 \ge s_3` of the centred positions and the direction n of
        the last, an array is linear for :math:`s_2 < 10^{-3} s_1` and otherwise planar for
        :math:`s_3 < 10^{-3} s_1`. A planar array is across the road for :math:`|n_x| > 0.985` and horizontal
        for :math:`|n_z| > 0.985`.

        Examples
        --------
        >>> MicrophoneArray([[0, 0, 0], [0, 1, 0], [0, 0, 1.0]]).ambiguity
        'front-back'
        """
        # A linear array only measures the angle to its axis (`cone`). A planar array cannot distinguish a
        # direction from its mirror image in the array plane: `front-back` if the plane is across the road,
        # `up-down` if it is horizontal, `mirror` if it is tilted or faces sideways. A three-dimensional array
        # has no ambiguity.
        spread, axes = np.linalg.svd(self.centred_m, full_matrices=True)[1:]
        thickness = np.pad(spread, (0, 3 - len(spread)))
        if thickness[1] < _FLAT * thickness[0]:
            return "cone"
        if thickness[2] >= _FLAT * thickness[0]:
            return "none"
        normal = np.abs(axes[2])
        if normal[0] > _ALONG_AXIS:
            return "front-back"
        return "up-down" if normal[2] > _ALONG_AXIS else "mirror"

    def delays_s(self, azimuths_rad: ArrayLike, elevations_rad: ArrayLike = 0.0) -> FloatArray:
        r"""Return the far-field arrival time at every microphone relative to the origin, seconds.

        .. math:: \tau_m(\theta, \phi) = -p_m^T u(\theta, \phi) / c

        Parameters
        ----------
        azimuths_rad, elevations_rad : array_like, broadcast together
            Azimuth, left positive, and elevation, up positive, radians.

        Returns
        -------
        ndarray, shape (..., M)
            Seconds; negative at microphones closer to the source than the origin.

        References
        ----------
        H. L. Van Trees, *Optimum Array Processing*, 2002, section 2.2.

        Examples
        --------
        >>> (1e6 * MicrophoneArray([[0, 0.1, 0], [0, -0.1, 0]]).delays_s(np.pi / 6)).round(1)
        array([-145.8,  145.8])
        """
        directions = direction_vectors(azimuths_rad, elevations_rad)
        return np.asarray(-(directions @ self.positions_m.T) / SPEED_OF_SOUND_M_S)

    def steering(
        self, frequencies_hz: ArrayLike, azimuths_rad: ArrayLike, elevations_rad: ArrayLike = 0.0
    ) -> Complex128Array:
        r"""Return steering vectors at given frequencies and directions.

        .. math:: a_m(f, \theta, \phi) = e^{-j 2 \pi f \tau_m(\theta, \phi)}

        Parameters
        ----------
        frequencies_hz : array_like, shape (F,)
            Frequencies in Hz.
        azimuths_rad, elevations_rad : array_like, broadcast to shape (D,)
            Azimuth, left positive, and elevation, up positive, radians.

        Returns
        -------
        ndarray of complex128, shape (F, M, D)
            Values of modulus one.

        References
        ----------
        H. L. Van Trees, *Optimum Array Processing*, 2002, section 2.2.

        Examples
        --------
        >>> MicrophoneArray([[0, 0.1, 0], [0, -0.1, 0]]).steering([500.0, 1000.0], [0.0, 0.5, 1.0]).shape
        (2, 2, 3)
        """
        delays = self.delays_s(np.atleast_1d(azimuths_rad), elevations_rad)
        frequencies = np.atleast_1d(np.asarray(frequencies_hz, dtype=np.float64))
        return np.asarray(np.exp(-2j * np.pi * frequencies[:, None, None] * delays.T))


def roof_array_56() -> MicrophoneArray:
    """Return a roof array of 56 microphones in the y-z plane, across the vehicle, centred at the origin.

    It has the dimensions of the array in the paper (section IV): aperture 0.78 m x 0.65 m, S_xx = 3.03 m^2,
    mean nearest spacing 8.8 cm. It is therefore alias-free up to about 1.9 kHz. The positions are this
    library's own.

    Returns
    -------
    MicrophoneArray
        The same array on each call.

    Examples
    --------
    >>> array = roof_array_56()
    >>> array.n_microphones, array.aperture_m.round(3).tolist(), array.ambiguity
    (56, [0.0, 0.78, 0.65], 'front-back')
    """
    index = np.arange(_COLUMNS * _ROWS)
    row, column = np.divmod(index, _COLUMNS)
    y = column + 0.5 * (row % 2) + _JITTER * (np.mod(index * 0.7548776662466927, 1.0) - 0.5)
    z = row + _JITTER * (np.mod(index * 0.5698402909980532, 1.0) - 0.5)
    y, z = _to_unit(y), _to_unit(z)
    y = np.sign(y) * np.abs(y) ** _COLUMN_POWER
    positions = np.stack([np.zeros_like(y), 0.5 * _WIDTH_M * y, 0.5 * _HEIGHT_M * z], axis=1)
    return MicrophoneArray(positions, "roof_array_56")


def _to_unit(values: FloatArray) -> FloatArray:
    return np.asarray(2.0 * (values - values.min()) / np.ptp(values) - 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class ChannelMask:
    r"""Selection of microphones.

    A whitened channel that is set to zero adds nothing to a sum over microphones, so the beams of the whole
    array also serve for a part of it. Only the scale changes: with n of M microphones, beam power is smaller
    by (n / M)^2 and the sum over pairs by n (n - 1) / (M (M - 1)). Sums are rescaled per hop, so a window may
    contain hops with different masks.
    """

    keep: BoolArray  # shape (M,): False for excluded microphones

    @classmethod
    def all_of(cls, n_channels: int) -> "ChannelMask":
        """Return the mask that keeps all microphones."""
        return cls(np.ones(n_channels, bool))

    @property
    def n_kept(self) -> int:
        """Number n of microphones kept."""
        return int(np.add.reduce(self.keep))

    @property
    def is_whole(self) -> bool:
        """Whether all microphones are kept."""
        return False not in self.keep

    @property
    def power_scale(self) -> float:
        """(M / n)^2: converts the beam power of n microphones to that of M; finite for none."""
        return float((len(self.keep) / max(self.n_kept, 1)) ** 2)

    @property
    def pair_scale(self) -> float:
        """Ratio of the numbers of pairs; finite for fewer than two microphones."""
        whole, kept = len(self.keep), max(self.n_kept, 2)
        return whole * (whole - 1) / (kept * (kept - 1))

    def silence(self, spectra: Complex64Array) -> None:
        """Set the excluded channels of spectra (..., M) to zero, in place."""
        if not self.is_whole:
            spectra[..., ~self.keep] = 0.0

    def cross(self, matrices: Complex64Array) -> Complex64Array:
        """Return cross-spectra ``R'_ij = k_i k_j R_ij``, (..., M, M); the same array if all are kept."""
        return matrices if self.is_whole else np.asarray(matrices * (self.keep[:, None] & self.keep))


# (y, z) in metres, in the order of OVAD's channels; x is zero. Released with Schulz et al. 2021 in axes that
# point right and up; no digit is rounded.
# fmt: off
_LEFT_UP_M = (
    (0.392, 0.288), (0.289024, 0.328443), (0.303659, 0.217809), (0.212195, 0.258831), (0.392, 0.128308),
    (0.32561, 0.063668), (0.247117, 0.148328), (0.17439, 0.109539), (0.084146, 0.312283),
    (0.123229, 0.23465), (0.087, 0.141538), (0.013415, 0.167385), (0.036, 0.06232), (-0.036, 0.06232),
    (-0.070732, 0.323471), (-0.015156, 0.250456), (-0.14, 0.216514), (-0.082927, 0.139077),
    (-0.207317, 0.274991), (-0.29878, 0.287422), (-0.291463, 0.176788), (-0.392, 0.210462),
    (-0.19878, 0.118154), (-0.15, 0.051237), (-0.292683, 0.067397), (-0.392, 0.027077),
    (-0.247561, -0.046769), (-0.317073, -0.089231), (-0.392, -0.152634), (-0.276829, -0.201108),
    (-0.392, -0.316308), (-0.303659, -0.320443), (-0.150906, -0.18845), (-0.02439, -0.175003),
    (-0.206098, -0.273206), (-0.103659, -0.322929), (-0.026359, -0.260182), (0.048996, -0.309255),
    (0.087801, -0.198622), (0.179901, -0.218845), (0.253048, -0.178723), (0.230488, -0.312985),
    (0.392, -0.248615), (0.314634, -0.27072), (0.392, -0.049452), (0.320732, -0.116578), (0.252, -0.018349),
    (0.190667, -0.097859), (0.158537, 0.023385), (0.072, 0.0), (-0.072, 0.0), (-0.162195, -0.069342),
    (-0.036, -0.06232), (-0.090244, -0.108308), (0.036, -0.06232), (0.102439, -0.104124),
)
# fmt: on


def ovad_array() -> MicrophoneArray:
    """Return the array of the OVAD recordings: 56 microphones in the y-z plane, across the vehicle.

    Its positions were released with Schulz et al., "Hearing What You Cannot See: Acoustic Vehicle Detection
    Around Corners", 2021. It is the default for recordings in OVAD's layout without an array of their own and
    for the simulator.

    Returns
    -------
    MicrophoneArray
        Microphones in the order of OVAD's channels; the same array on each call.

    Examples
    --------
    >>> array = ovad_array()
    >>> array.n_microphones, array.aperture_m.round(3).tolist(), round(array.horizontal_moment_m2, 3)
    (56, [0.0, 0.784, 0.651], 3.027)
    """
    y, z = np.array(_LEFT_UP_M).T
    return MicrophoneArray(np.stack([np.zeros_like(y), y, z], axis=1), "OVAD (Schulz et al. 2021)")
