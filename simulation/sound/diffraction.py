"""Losses along a path: round an edge, in the air, and over the ground."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import modfresnelm

from worldstate.ground.typing import Complex128Array, FloatArray
from worldstate.simulation.scene.octave_bands import OCTAVES_HZ

REFERENCE_KELVIN, TRIPLE_POINT_KELVIN = 293.15, 273.16
STREET_KELVIN, STREET_HUMIDITY = 283.15, 70.0
ROAD_REFLECTION = 0.9  # Pressure reflection factor of dense asphalt and paving
SMALLEST_LENGTH_M = 0.1


def absorption_db_per_m(
    frequency_hz: ArrayLike, kelvin: float = STREET_KELVIN, humidity_percent: float = STREET_HUMIDITY
) -> FloatArray:
    r"""Return the atmospheric absorption of pure tones at sea level.

    .. math:: \alpha = 8.686 f^2 \Big[1.84 \cdot 10^{-11} \tau^{1/2} + \tau^{-5/2} \Big(
              \frac{0.01275\, e^{-2239.1 / T}}{f_{rO} + f^2 / f_{rO}} +
              \frac{0.1068\, e^{-3352 / T}}{f_{rN} + f^2 / f_{rN}}\Big)\Big], \qquad \tau = T / T_{20}

    References
    ----------
    ISO 9613-1:1993, equations (3) to (5) and annex B.
    """
    f2 = np.asarray(frequency_hz, dtype=np.float64) ** 2
    tau = kelvin / REFERENCE_KELVIN
    saturation = 10.0 ** (-6.8346 * (TRIPLE_POINT_KELVIN / kelvin) ** 1.261 + 4.6151)
    water = humidity_percent * saturation  # Molar concentration of water vapour, per cent
    oxygen_hz = 24.0 + 4.04e4 * water * (0.02 + water) / (0.391 + water)
    nitrogen_hz = tau**-0.5 * (9.0 + 280.0 * water * np.exp(-4.170 * (tau ** (-1.0 / 3.0) - 1.0)))
    relaxed = 0.01275 * np.exp(-2239.1 / kelvin) / (oxygen_hz + f2 / oxygen_hz)
    relaxed = relaxed + 0.1068 * np.exp(-3352.0 / kelvin) / (nitrogen_hz + f2 / nitrogen_hz)
    return np.asarray(8.686 * f2 * (1.84e-11 * tau**0.5 + tau**-2.5 * relaxed))


OCTAVE_DB_PER_M = absorption_db_per_m(OCTAVES_HZ)


def air_gain(length_m: FloatArray) -> FloatArray:
    """Return the amplitude after `length_m` (T,) through air, shape (T, 8)."""
    return np.asarray(10.0 ** (-length_m[:, None] * OCTAVE_DB_PER_M / 20.0))


def ground_gain(length_m: FloatArray, source_m: float, receiver_m: float) -> FloatArray:
    r"""Return the amplitude by the road's reflection per octave, relative to the energy sum, shape (T, 8).

    .. math:: g^2 = 1 + \frac{2 \rho}{1 + \rho^2} \overline{\cos k \Delta}, \qquad
              \Delta \approx 2 h_s h_r / r

    with the mean over the octave's band. Source levels already include hard ground, which doubles the energy;
    the interference remains: +3 dB if both paths are equal, 0 dB at high frequencies.

    Shapes: length_m (T,).
    """
    detour = 2.0 * source_m * receiver_m / np.maximum(length_m, SMALLEST_LENGTH_M)
    phase = 2.0 * np.pi * detour[:, None] * OCTAVES_HZ / SPEED_OF_SOUND_MPS
    low, high = phase / np.sqrt(2.0), phase * np.sqrt(2.0)
    mean_cosine = (np.sin(high) - np.sin(low)) / np.maximum(high - low, 1e-9)
    share = 2.0 * ROAD_REFLECTION / (1.0 + ROAD_REFLECTION**2)
    return np.asarray(np.sqrt(1.0 + share * mean_cosine))


SPEED_OF_SOUND_MPS = 343.0
EXTERIOR_RAD = 1.5 * np.pi  # Exterior angle of a right-angled building corner
# On the shadow boundary the formula is 0 times infinity; at this distance from it, it is exact
LEAST_RAD = 1e-6


def screen_attenuation_db(detour_m: ArrayLike, frequency_hz: ArrayLike, cap_db: float = 40.0) -> FloatArray:
    r"""Return the attenuation by a thin screen beyond spherical spreading.

    .. math:: A = 5 + 20\log_{10}\frac{\sqrt{2\pi N}}{\tanh\sqrt{2\pi N}}, \qquad N = 2\delta f / c

    References
    ----------
    U. J. Kurze and G. S. Anderson, "Sound attenuation by barriers", Applied Acoustics 4 (1971), eq. (13).
    """
    # In the light (N < 0) tanh becomes tan and the attenuation falls to 0 dB at N of about -0.2. It is
    # continuous through the shadow boundary, where it is 5 dB.
    fresnel = 2.0 * np.asarray(detour_m) * np.asarray(frequency_hz) / SPEED_OF_SOUND_MPS
    root = np.sqrt(2.0 * np.pi * np.maximum(np.abs(fresnel), 1e-9))
    shadow = 20.0 * np.log10(root / np.tanh(root))
    # tan is needed down to N = -0.2 only; clipping keeps its argument away from the pole.
    light = 20.0 * np.log10(root / np.tan(np.minimum(root, 1.2)))
    attenuation = 5.0 + np.where(fresnel >= 0.0, shadow, np.where(root < 1.2, light, -5.0))
    return np.asarray(np.clip(attenuation, 0.0, cap_db))


def edge_gain(
    turn_rad: FloatArray, reduced_m: FloatArray, detour_m: FloatArray, frequency_hz: ArrayLike
) -> FloatArray:
    r"""Return the amplitude of a wave past a building's corner, relative to the free field, shape (T, F).

    .. math:: \Big| H(\pi - \beta) - \frac{e^{-j\pi/4}}{2 n \sqrt{2 \pi k L}} \sum_{\pm}
              \cot\frac{\pi \pm \beta}{2 n}\, F\big(2 k L \cos^2\tfrac{2 n \pi N_\pm - \beta}{2}\big)\,
              e^{-jk\delta} \Big|, \qquad n = \tfrac{3}{2}, \quad L = \frac{s s'}{s + s'}

    with the angle beta between the two legs s', s (below pi: in the light) and the detour delta, which is 0
    in shadow. These are the two terms of R. G. Kouyoumjian and P. H. Pathak, "A uniform geometrical theory of
    diffraction for an edge in a perfectly conducting surface", Proc. IEEE 62 (1974), for the incident wave.
    The other two, for the wave reflected by a face of the corner, are the same terms for the mirror image in
    that face.

    Shapes: turn_rad, reduced_m, detour_m (T,), frequency_hz (F,).

    Examples
    --------
    >>> turn, detour = np.radians([90.0, 180.0, 240.0]), np.array([4.0, 0.0, 0.0])
    >>> gain = edge_gain(turn, np.full(3, 4.0), detour, np.array([1000.0]))
    >>> (20 * np.log10(gain[:, 0])).round(1)
    array([ -0. ,  -5.9, -24.3])
    """
    wave = 2.0 * np.pi * np.asarray(frequency_hz) / SPEED_OF_SOUND_MPS
    root = np.sqrt(2.0 * reduced_m[:, None] * wave)
    n = EXTERIOR_RAD / np.pi
    turn = np.where(np.abs(turn_rad - np.pi) < LEAST_RAD, np.pi + LEAST_RAD, turn_rad)
    away = np.pi - turn
    terms = np.zeros(root.shape, np.complex128)
    # N- is 0 and N+ is 1 for every angle beyond pi / 2; for smaller angles the second term is small for any
    # N+.
    for angle, argument in ((away, 0.5 * turn), (np.pi + turn, EXTERIOR_RAD - 0.5 * turn)):
        size = root * np.abs(np.cos(argument))[:, None]
        terms += _transition(size) / np.tan(angle / (2.0 * n))[:, None]
    edge = -np.exp(-0.25j * np.pi) / (2.0 * n * np.sqrt(np.pi) * root) * terms
    lit = away > 0.0
    # In shadow the detour has no effect, so these exponentials, a third of the cost, are not computed there.
    edge[lit] *= np.exp(-1j * detour_m[lit, None] * wave)
    return np.asarray(np.abs(lit[:, None] + edge))


def _transition(root: FloatArray) -> Complex128Array:
    r"""Return F(x) = 2j sqrt(x) exp(jx) times the integral of exp(-j t^2) from sqrt(x) to infinity.

    It uses the rational approximations 7.3.32 and 7.3.33 of M. Abramowitz and I. A. Stegun, "Handbook of
    mathematical functions" (1964), to 0.002.
    """
    z = root * np.sqrt(2.0 / np.pi)
    cosine = (1.0 + 0.926 * z) / (2.0 + z * (1.792 + 3.104 * z))
    sine = 1.0 / (2.0 + z * (4.142 + z * (3.492 + 6.670 * z)))
    return np.asarray(np.sqrt(2.0 * np.pi) * root * (cosine + 1j * sine))


def corner_gain(edge_m: tuple[float, float], x_m: FloatArray, y_m: FloatArray) -> FloatArray:
    r"""Return the amplitude round the corner of a house to the array at the origin, (T, 8), octave rms.

    .. math:: \frac{|D|}{\sqrt{s' s (s' + s)}}

    with the coefficient D of a hard wedge of 90 degrees (Kouyoumjian and Pathak, eqs. 25 to 29) whose faces
    extend back along the ego's street and sideways along the crossing street.
    """
    # A corner on the right is a corner on the left of the mirrored plan.
    side = np.sign(edge_m[1])
    ahead, beside = edge_m[0], abs(edge_m[1])
    from_edge = x_m - ahead, side * y_m - beside
    away, last = np.maximum(np.hypot(*from_edge), 0.1), float(np.hypot(ahead, beside))
    seen = np.mod(np.arctan2(*from_edge[::-1]) - np.pi, 2.0 * np.pi)
    own = float(np.mod(np.arctan2(-beside, -ahead) - np.pi, 2.0 * np.pi))
    octave = 2.0 ** (np.array([-1.0, 0.0, 1.0]) / 3.0)
    k = 2.0 * np.pi * np.outer(OCTAVES_HZ, octave) / SPEED_OF_SOUND_MPS
    distance = (away * last / (away + last))[:, None, None]
    total = np.zeros((len(away), *k.shape), np.complex128)
    for angle in (seen - own, seen + own):
        for sign in (1.0, -1.0):
            total += _wedge_term(angle[:, None, None], sign, k * distance)
    coefficient = np.abs(total) / (2.0 * WEDGE * np.sqrt(2.0 * np.pi * k))
    rms = np.sqrt(np.square(coefficient).mean(axis=2))
    return np.asarray(rms / np.sqrt(away * last * (away + last))[:, None])


WEDGE = 1.5  # Open angle round the corner, in half turns


def _wedge_term(angle_rad: FloatArray, sign: float, k_distance: FloatArray) -> FloatArray:
    """Return one of the four cotangents with its transition function."""
    # On the boundary the cotangent is infinite and the transition zero, so the angle is a milliradian beside
    # it.
    tangent = np.tan((np.pi + sign * angle_rad) / (2.0 * WEDGE))
    beside = angle_rad + np.where(np.abs(tangent) < 1e-3, 4e-3, 0.0)
    turns = np.rint((beside + sign * np.pi) / (2.0 * np.pi * WEDGE))
    a = 2.0 * np.cos(0.5 * (2.0 * np.pi * WEDGE * turns - beside)) ** 2
    root = np.sqrt(k_distance * a)
    transition = 2j * root * np.exp(1j * root**2) * modfresnelm(root)[0]
    return np.asarray(transition / np.tan((np.pi + sign * beside) / (2.0 * WEDGE)))
