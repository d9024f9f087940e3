r"""Descriptors of road-user classes: speed prior, camera labels, and couplings between observables and speed.

A coupling says what an observable of the signature is worth at a given radial speed, as curves over speed. It
can be tested by itself and switched off.

References
----------
Light vehicles, rolling and propulsion noise in octave bands over speed: European Commission, Directive
2015/996 (CNOSSOS-EU), annex, tables of category 1.
"""

from dataclasses import dataclass
from math import pi

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground.checks import finite_array, in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray

SPEED_OF_SOUND_M_S = 343.0
# Total ratio of gearbox and final drive, first to fifth gear: ordinary numbers of a passenger car (3.6, 2.05,
# 1.4, 1.05 and 0.85 times 3.9), no measured ones.
GEAR_RATIOS = (14.0, 8.0, 5.4, 4.1, 3.3)
WHEEL_RADIUS_M = 0.3
FIRINGS_PER_TURN = 2.0
IDLE_HZ = 25.0
REFERENCE_SPEED_M_S, LOWEST_SPEED_M_S = 70.0 / 3.6, 20.0 / 3.6


@dataclass(frozen=True, slots=True)
class Coupling:
    """An observable that depends on the radial speed."""

    observable: str  # Its name, unit included
    speed_m_s: tuple[float, ...]  # Knots, rising; speed towards the listener is positive
    # Values at the knots, linear between and constant beyond; several where one of them holds but not known
    # which, such as the gear, all equally likely.
    curves: tuple[tuple[float, ...], ...]
    std: float  # How far a source of this class scatters about its curve, in the observable's unit, > 0

    def __post_init__(self) -> None:
        knots = finite_array("speed_m_s", self.speed_m_s, (None,))
        if not knots.size or (np.diff(knots) <= 0).any() or not self.curves:
            raise InvalidArgumentError("coupling: expected rising speeds and at least one curve")
        for curve in self.curves:
            finite_array("curves", curve, (knots.size,))
        in_range("std", self.std, 0.0, np.inf, open_low=True, open_high=True)

    def expected(self, radial_speed_m_s: ArrayLike) -> FloatArray:
        r"""Return the value on every curve, shape (curves, n).

        .. math:: f_g(v) = f_{g,i} + (f_{g,i+1} - f_{g,i})\, \frac{v - v_i}{v_{i+1} - v_i}, \qquad
                  v_i \le v \le v_{i+1}

        Shapes: radial_speed_m_s (n,).
        """
        speed = np.asarray(radial_speed_m_s, dtype=np.float64)
        return np.stack([np.interp(speed, self.speed_m_s, curve) for curve in self.curves])

    def log_likelihood(self, value: float, value_std: float, radial_speed_m_s: ArrayLike) -> FloatArray:
        r"""Return log p(value | c, v_r) at each speed, shape (n,), nats.

        .. math:: p = \frac{1}{G} \sum_g N\big(value;\ f_g(v_r),\ \sigma_c^2 + \sigma_{value}^2\big)

        Shapes: radial_speed_m_s (n,).
        """
        expected = self.expected(radial_speed_m_s)
        variance = self.std**2 + value_std**2
        log_density = -0.5 * ((value - expected) ** 2 / variance + np.log(2 * pi * variance))
        return np.asarray(np.logaddexp.reduce(log_density, axis=0) - np.log(len(expected)))


@dataclass(frozen=True, slots=True)
class Descriptor:
    """One class of road user.

    Parameters
    ----------
    name : str
        Of the class.
    labels : tuple of str
        What a camera would report if it were in plain view: the co-evidence that its signature predicts.
    weight : float
        Prior share among all classes, > 0; shares are normalised by the model.
    speed_mean_m_s, speed_std_m_s : float
        Of the radial speed of one that approaches, a normal law cut off at the model's speeds.
    couplings : tuple of Coupling
        At most one for each observable.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range or an observable is coupled twice.

    Examples
    --------
    >>> car().labels
    ('car', 'truck', 'bus')
    """

    name: str
    labels: tuple[str, ...]
    weight: float
    speed_mean_m_s: float
    speed_std_m_s: float
    couplings: tuple[Coupling, ...] = ()

    def __post_init__(self) -> None:
        in_range("weight", self.weight, 0.0, np.inf, open_low=True, open_high=True)
        finite_array("speed_mean_m_s", self.speed_mean_m_s, ())
        in_range("speed_std_m_s", self.speed_std_m_s, 0.0, np.inf, open_low=True, open_high=True)
        names = [coupling.observable for coupling in self.couplings]
        if len(set(names)) != len(names):
            raise InvalidArgumentError(f"couplings: expected each observable once, got {names}")

    def log_speed_prior(self, radial_speed_m_s: FloatArray) -> FloatArray:
        r"""Return log P(v_r | c) on a grid, normalised to one over it, shape (n,), nats.

        .. math:: P(v_i) \propto \exp\big(-\tfrac12 (v_i - \mu)^2 / \sigma^2\big), \qquad \sum_i P(v_i) = 1

        Parameters
        ----------
        radial_speed_m_s : ndarray, shape (n,)
            Grid of v_r, m/s.
        """
        log_weight = -0.5 * ((radial_speed_m_s - self.speed_mean_m_s) / self.speed_std_m_s) ** 2
        return np.asarray(log_weight - np.logaddexp.reduce(log_weight))


def engine_line(std_hz: float = 4.0) -> Coupling:
    r"""Spacing of the engine's harmonics over speed, one curve a gear.

    .. math:: f = \max\Big( f_{idle},\ \frac{n_f\, G\, |v|}{2 \pi R} \Big)

    with n_f firings a turn (2 for four cylinders), total ratio G and wheel radius R.
    """
    speed = np.linspace(-40.0, 40.0, 161)
    per_speed = FIRINGS_PER_TURN / (2 * pi * WHEEL_RADIUS_M)
    curves = [np.maximum(IDLE_HZ, per_speed * ratio * np.abs(speed)) for ratio in GEAR_RATIOS]
    return Coupling("line_spacing_hz", _tuple(speed), tuple(map(_tuple, curves)), std_hz)


def tyre_noise_shape(std_db: float = 3.0) -> Coupling:
    r"""Level of the 1 kHz octave above that of 125 Hz: rolling noise takes over from the engine with speed.

    .. math:: \Delta L = L_{1000} - L_{125}, \qquad
              L = 10 \log_{10} \big(10^{L_R / 10} + 10^{L_P / 10}\big)

    Each octave is the power sum of :math:`A_R + B_R \log_{10}(v / v_0)` and :math:`A_P + B_P (v - v_0) / v_0`
    with v_0 = 70 km/h; below 20 km/h, where the method ends, it is held constant.
    """
    speed = np.linspace(-40.0, 40.0, 161)
    at = np.maximum(np.abs(speed), LOWEST_SPEED_M_S)
    low = _octave_db(at, rolling=(85.7, 41.5), propulsion=(89.2, 7.2))
    high = _octave_db(at, rolling=(97.3, 32.5), propulsion=(84.2, 8.0))
    return Coupling("tyre_shape_db", _tuple(speed), (_tuple(high - low),), std_db)


def doppler_trajectory(std: float = 0.01) -> Coupling:
    """Ratio of the frequencies heard before and after a pass-by.

    .. math:: f_{before} / f_{after} = (c + v) / (c - v)

    References
    ----------
    P. M. Morse and K. U. Ingard, *Theoretical Acoustics*, 1968, section 11.2 (the shift of a moving source).

    Examples
    --------
    >>> doppler_trajectory().expected([10.0]).round(3)
    array([[1.06]])
    """
    speed = np.linspace(-40.0, 40.0, 161)
    ratio = (SPEED_OF_SOUND_M_S + speed) / (SPEED_OF_SOUND_M_S - speed)
    return Coupling("doppler_ratio", _tuple(speed), (_tuple(ratio),), std)


def car() -> Descriptor:
    """Return a motor vehicle that approaches at town speed, all three couplings in place.

    Returns
    -------
    Descriptor
        With three couplings.

    Examples
    --------
    >>> car().name
    'motor_vehicle'
    """
    couplings = (engine_line(), tyre_noise_shape(), doppler_trajectory())
    return Descriptor("motor_vehicle", ("car", "truck", "bus"), 0.9, 8.0, 4.0, couplings)


def motorcycle() -> Descriptor:
    """Return a motorcycle: faster, with an engine line of its own gearing left open.

    Returns
    -------
    Descriptor
        With the Doppler coupling only.
    """
    return Descriptor("motorcycle", ("motorcycle",), 0.1, 9.0, 5.0, (doppler_trajectory(),))


def _octave_db(
    speed_m_s: FloatArray, rolling: tuple[float, float], propulsion: tuple[float, float]
) -> FloatArray:
    ratio = speed_m_s / REFERENCE_SPEED_M_S
    rolling_db = rolling[0] + rolling[1] * np.log10(ratio)
    propulsion_db = propulsion[0] + propulsion[1] * (ratio - 1.0)
    return np.asarray(10.0 * np.log10(10.0 ** (rolling_db / 10.0) + 10.0 ** (propulsion_db / 10.0)))


def _tuple(values: FloatArray) -> tuple[float, ...]:
    return tuple(values.tolist())
