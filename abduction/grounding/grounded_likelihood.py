r"""Grounded signature likelihoods, eq. (5), and their integral over class and state.

.. math::
    \ell_h(y) = \frac{P(h \mid s)}{\pi_h} \sum_c P(c) \int p(o \mid c, v_r)\, p(\hat v \mid v_r)\,
                dP(v_r \mid c, h) \int p(\hat\theta \mid \theta)\, dP(\theta \mid h)

The first factor is the calibrated score of any classifier; o are the observables that depend on the radial
speed. All densities are relative to those of a spurious signature, whose own factors are one. If only the
feature was measured, the classifier's evidence is returned unchanged.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from math import hypot, pi

import numpy as np
from numpy.typing import ArrayLike

from worldstate.abduction.evidence import MOST_NATS, SignatureEvidence
from worldstate.ground import FloatArray, InvalidArgumentError, NotUsable
from worldstate.ground.checks import ABOVE_ZERO, MOST, check_fields, freeze_arrays

LINE_SPACING = "line_spacing_hz"
SPEED_OF_SOUND_M_S = 343.0
# Total ratio of gearbox and final drive, first to fifth gear, in even steps: typical values of a passenger
# car (3.6 to 0.85 times 3.9), not measured ones.
GEAR_RATIOS = tuple(np.geomspace(14.0, 3.3, 5).tolist())
WHEEL_RADIUS_M = 0.3
FIRINGS_PER_TURN = 2.0
IDLE_HZ = 25.0
_KMH_M_S = 1.0 / 3.6
REFERENCE_SPEED_M_S, LOWEST_SPEED_M_S = 70.0 * _KMH_M_S, 20.0 * _KMH_M_S
# Grid of the quadrature; a positive speed is towards the array.
_SPEED_CELL_M_S = 0.5
_SPEEDS_M_S = np.arange(-5.0, 30.0 + _SPEED_CELL_M_S, _SPEED_CELL_M_S)
_DECIBELS = 10.0 / np.log(10.0)  # dB per unit of log power


@dataclass(frozen=True, slots=True, eq=False)
class Coupling:
    r"""An observable that depends on the radial speed.

    A coupling gives the expected value of an observable at a radial speed, as curves over speed. It can be
    tested and switched off separately.

    References
    ----------
    Light vehicles, rolling and propulsion noise in octave bands over speed: European Commission, Directive
    2015/996 (CNOSSOS-EU), annex, tables of category 1.
    """

    observable: str  # Name with its unit
    speed_m_s: FloatArray  # Knots, rising, shape (n,); positive towards the array
    # Values at the knots, linear between and constant beyond, shape (curves, n). With several curves, such as
    # one per gear, it is unknown which one applies; all are equally likely.
    curves: FloatArray
    std: float  # Standard deviation of a source of this class about its curve, in the observable's unit, > 0

    def __post_init__(self) -> None:
        freeze_arrays(self, speed_m_s=(None,))
        freeze_arrays(self, curves=(None, self.speed_m_s.size))
        if not self.curves.size or (np.diff(self.speed_m_s) <= 0).any():
            raise InvalidArgumentError("coupling: expected rising speeds and at least one curve")
        check_fields(self, std=(ABOVE_ZERO, MOST))

    def expected(self, radial_speed_m_s: ArrayLike) -> FloatArray:
        r"""Return the expected value on every curve, shape (curves, n).

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
        seen = Observable(value, hypot(self.std, value_std))
        log_density = _log_normal(seen, self.expected(radial_speed_m_s), 0.0)
        return np.asarray(np.logaddexp.reduce(log_density, axis=0) - np.log(len(log_density)))


@dataclass(frozen=True, slots=True)
class Descriptor:
    """One class of road user.

    Parameters
    ----------
    name : str
        Name of the class.
    labels : tuple of str
        Labels that a camera would report for a visible road user of this class: the expected co-evidence.
    weight : float
        Prior share among all classes, > 0; shares are normalised by the model.
    speed_mean_m_s, speed_std_m_s : float
        Radial speed of an approaching road user: a normal distribution, truncated at the model's speeds.
    couplings : tuple of Coupling
        At most one per observable.

    Raises
    ------
    InvalidArgumentError
        If a number is out of range or two couplings have the same observable.

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
        above_zero = (ABOVE_ZERO, MOST)
        check_fields(self, weight=above_zero, speed_mean_m_s=(-MOST, MOST), speed_std_m_s=above_zero)
        names = [coupling.observable for coupling in self.couplings]
        if len(set(names)) != len(names):
            raise InvalidArgumentError(f"couplings: expected each observable once, got {names}")


def engine_line(std_hz: float = 4.0) -> Coupling:
    r"""Return the spacing of the engine's harmonics over speed, one curve per gear.

    .. math:: f = \max\Big( f_{idle},\ \frac{n_f\, G\, |v|}{2 \pi R} \Big)

    with n_f firings per revolution (2 for four cylinders), total ratio G and wheel radius R.
    """
    per_speed = FIRINGS_PER_TURN / (2 * pi * WHEEL_RADIUS_M)
    curves = [np.maximum(IDLE_HZ, per_speed * ratio * np.abs(_SPEEDS_M_S)) for ratio in GEAR_RATIOS]
    return Coupling(LINE_SPACING, _SPEEDS_M_S, np.array(curves), std_hz)


def tyre_noise_shape(std_db: float = 3.0) -> Coupling:
    r"""Return the level of the 1 kHz octave minus that of the 125 Hz octave over speed.

    .. math:: \Delta L = L_{1000} - L_{125}, \qquad
              L = 10 \log_{10} \big(10^{L_R / 10} + 10^{L_P / 10}\big)

    Each octave is the power sum of :math:`A_R + B_R \log_{10}(v / v_0)` and :math:`A_P + B_P (v - v_0) / v_0`
    with v_0 = 70 km/h. Rolling noise exceeds engine noise at higher speeds. Below 20 km/h, the lower limit of
    the method, the level is constant.
    """
    # A_R, B_R, A_P and B_P of category 1 at 125 Hz and at 1 kHz, dB.
    octaves_db = np.array([[85.7, 41.5, 89.2, 7.2], [97.3, 32.5, 84.2, 8.0]])
    a_rolling, b_rolling, a_propulsion, b_propulsion = octaves_db.T[..., None]
    ratio = np.maximum(np.abs(_SPEEDS_M_S), LOWEST_SPEED_M_S) / REFERENCE_SPEED_M_S
    rolling_db = a_rolling + b_rolling * np.log10(ratio)
    propulsion_db = a_propulsion + b_propulsion * (ratio - 1.0)
    low, high = _DECIBELS * np.logaddexp(rolling_db / _DECIBELS, propulsion_db / _DECIBELS)
    return Coupling("tyre_shape_db", _SPEEDS_M_S, (high - low)[None], std_db)


def doppler_trajectory(std: float = 0.01) -> Coupling:
    """Return the ratio of the received frequencies before and after a pass-by, over speed.

    .. math:: f_{before} / f_{after} = (c + v) / (c - v)

    References
    ----------
    P. M. Morse and K. U. Ingard, *Theoretical Acoustics*, 1968, section 11.2 (the shift of a moving source).

    Examples
    --------
    >>> doppler_trajectory().expected([10.0]).round(3)
    array([[1.06]])
    """
    ratio = (SPEED_OF_SOUND_M_S + _SPEEDS_M_S) / (SPEED_OF_SOUND_M_S - _SPEEDS_M_S)
    return Coupling("doppler_ratio", _SPEEDS_M_S, ratio[None], std)


def car() -> Descriptor:
    """Return a motor vehicle that approaches at urban speed, with all three couplings.

    Returns
    -------
    Descriptor
        Class with three couplings.

    Examples
    --------
    >>> car().name
    'motor_vehicle'
    """
    couplings = (engine_line(), tyre_noise_shape(), doppler_trajectory())
    return Descriptor("motor_vehicle", ("car", "truck", "bus"), 0.9, 8.0, 4.0, couplings)


def motorcycle() -> Descriptor:
    """Return a motorcycle: as fast as a car, with unknown gear ratios.

    Returns
    -------
    Descriptor
        Class with the Doppler coupling only.
    """
    usual = car()
    open_gearing = ("motorcycle",), 1.0 - usual.weight, usual.speed_mean_m_s, usual.speed_std_m_s
    return Descriptor("motorcycle", *open_gearing, (doppler_trajectory(),))


@dataclass(frozen=True, slots=True)
class Observable:
    """A value with its standard deviation, which comes from a bound or from the estimator itself."""

    value: float  # In the unit that is part of the name
    std: float  # Standard deviation of the estimate, >= 0

    def __post_init__(self) -> None:
        check_fields(self, value=(-MOST, MOST), std=(0.0, MOST))


NOT_MEASURED = NotUsable("not measured")


@dataclass(frozen=True, slots=True)
class GroundedObservation:
    """Statistics y = (s, theta, v) of the front-end that supplement the classifier's scores.

    Parameters
    ----------
    bearing_rad : Observable or NotUsable
        Azimuth, left positive.
    radial_speed_m_s : Observable or NotUsable
        Radial speed from Doppler, positive for an approach.
    inverse_tta_hz : Observable or NotUsable
        Reciprocal of the time to arrival, from looming, 1/s.
    signature : mapping of str to Observable
        Observables that depend on speed in a descriptor, such as ``line_spacing_hz``; missing ones are
        marginalised.

    Examples
    --------
    >>> GroundedObservation().bearing_rad
    NotUsable(reason='not measured')
    """

    bearing_rad: Observable | NotUsable = NOT_MEASURED
    radial_speed_m_s: Observable | NotUsable = NOT_MEASURED
    inverse_tta_hz: Observable | NotUsable = NOT_MEASURED
    signature: Mapping[str, Observable] = field(default_factory=dict)


_AZIMUTHS_RAD = np.linspace(-0.5 * pi, 0.5 * pi, 181)
_AZIMUTH_CELL_RAD = float(np.radians(1.0))
_RANGES_M = np.geomspace(5.0, 60.0, 24)


# Broad normal distributions of observables without a source; all other densities are relative to them.
BACKGROUNDS = {
    LINE_SPACING: Observable(70.0, 40.0),
    "tyre_shape_db": Observable(0.0, 10.0),
    "doppler_ratio": Observable(1.0, 0.05),
    "radial_speed_m_s": Observable(0.0, 10.0),
    "inverse_tta_hz": Observable(0.0, 1.0),
}
# Deviation of the azimuth of a visible source, and of the strongest direction of a hidden one. The sound of a
# hidden source arrives from a wall or an edge, whose side is hardly related to the side of the vehicle.
_VISIBLE_STD_RAD, _HIDDEN_STD_RAD = float(np.radians(35.0)), np.inf


@dataclass(frozen=True, slots=True)
class GroundedSettings:
    """Settings that switch observables off.

    Parameters
    ----------
    without : frozenset of str
        Omitted observables, for ablations: those of couplings, `radial_speed_m_s` and `inverse_tta_hz`.

    Examples
    --------
    >>> len(GroundedSettings(without=frozenset({"line_spacing_hz"})).without)
    1
    """

    without: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True)
class HiddenState:
    """The state z that best explains an observation under the hidden explanation.

    Examples
    --------
    >>> HiddenState("left", "motor_vehicle", ("car",), 0.5, 8.0).labels
    ('car',)
    """

    direction: str  # One of `SignatureEvidence.directions`
    entity_class: str  # Name of the descriptor
    labels: tuple[str, ...]  # Labels that a camera would report
    azimuth_rad: float  # Most probable values, on the grid of the quadrature
    radial_speed_m_s: float


@dataclass(frozen=True, slots=True)
class GroundedAnswer:
    """Log-likelihoods of the explanations, the best hidden state and the class probabilities.

    Parameters
    ----------
    evidence : SignatureEvidence
        Log-likelihoods, for eq. (6).
    best : HiddenState
        arg max over z.
    class_posterior : dict of str to float
        P(c | y, hidden).

    Examples
    --------
    >>> hidden = HiddenState("left", "motor_vehicle", ("car",), 0.5, 8.0)
    >>> evidence = SignatureEvidence(("left", "right"), (1.2, -0.3), -0.5, 0.1)
    >>> GroundedAnswer(evidence, hidden, {"motor_vehicle": 1.0}).best.direction
    'left'
    """

    evidence: SignatureEvidence
    best: HiddenState
    class_posterior: dict[str, float]


def ground(
    evidence: SignatureEvidence,
    observation: GroundedObservation,
    descriptors: Sequence[Descriptor],
    settings: GroundedSettings | None = None,
) -> GroundedAnswer:
    r"""Combine the classifier's evidence with the physical likelihoods of the other measurements.

    .. math:: \log \ell'_h = \log \ell_h + \log \sum_{c, v} P(c)\, P(v \mid c)\,
              \frac{p(o \mid c, v)\, p(\hat v \mid v)}{p_0}
              + \log \sum_\theta P(\theta \mid h)\, \frac{p(\hat\theta \mid \theta)}{p_0}

    for h hidden or visible, with p_0 the density without a source. The evidence of none does not change.

    Parameters
    ----------
    evidence : SignatureEvidence
        Evidence of the classifier, from calibrated scores.
    observation : GroundedObservation
        Bearing, approach and observables with their deviations; unusable values are marginalised.
    descriptors : sequence of Descriptor
        At least one class of road users, all named differently.
    settings : GroundedSettings, optional
        Observables that are switched off.

    Returns
    -------
    GroundedAnswer
        Class, speed and evidence after the physical likelihoods.

    Raises
    ------
    InvalidArgumentError
        If there is no descriptor or two have the same name.

    References
    ----------
    "Evidence of Absence", eq. (5), and its integral in section V.

    Examples
    --------
    >>> from worldstate.abduction.grounding.grounded_likelihood import car
    >>> scores = SignatureEvidence(("left", "right"), (1.0, -1.0), 0.0, 0.0)
    >>> closing = GroundedObservation(radial_speed_m_s=Observable(8.0, 1.0))
    >>> answer = ground(scores, closing, [car()])
    >>> answer.best.direction, answer.best.radial_speed_m_s, answer.evidence.hidden[0] > 1.0
    ('left', 8.0, True)
    """
    names = [descriptor.name for descriptor in descriptors]
    if not names or len(set(names)) != len(names):
        raise InvalidArgumentError(f"descriptors: expected one or more with different names, got {names}")
    without = settings.without if settings else frozenset[str]()
    approach, weights = _log_approach(observation, without), [one.weight for one in descriptors]
    couplings = np.stack([_log_couplings(observation, one, without) for one in descriptors])
    # P(c) and P(v_r | c), a normal distribution on the grid, one row per class.
    mean, std = np.array([(one.speed_mean_m_s, one.speed_std_m_s) for one in descriptors]).T[..., None]
    prior = -0.5 * ((_SPEEDS_M_S - mean) / std) ** 2
    prior -= np.logaddexp.reduce(prior, axis=1, keepdims=True)
    over_speed = np.log(weights / np.sum(weights))[:, None] + prior + couplings + approach
    stds_rad = _HIDDEN_STD_RAD, _VISIBLE_STD_RAD
    hidden_azimuth, visible_azimuth = (_over_azimuth(observation.bearing_rad, one) for one in stds_rad)
    per_class = np.logaddexp.reduce(over_speed, axis=1)
    moving = np.logaddexp.reduce(per_class)
    hidden = np.array(evidence.hidden) + moving + np.logaddexp.reduce(hidden_azimuth)
    visible = evidence.visible + moving + np.logaddexp.reduce(visible_azimuth)
    # The log-likelihood of an observation that no descriptor explains has no lower bound.
    *hidden, visible = np.clip([*hidden, visible], -MOST_NATS, MOST_NATS).tolist()
    grounded = SignatureEvidence(evidence.directions, tuple(hidden), visible, evidence.none)
    # The arg max over the hidden state: it factorises, so each factor has its own maximum.
    entity, speed = divmod(int(over_speed.argmax()), _SPEEDS_M_S.size)
    best, direction = descriptors[entity], evidence.directions[int(np.argmax(evidence.hidden))]
    at = float(_AZIMUTHS_RAD[hidden_azimuth.argmax()]), float(_SPEEDS_M_S[speed])
    classes = dict(zip(names, np.exp(per_class - moving).tolist(), strict=True))
    return GroundedAnswer(grounded, HiddenState(direction, best.name, best.labels, *at), classes)


def _log_couplings(
    observation: GroundedObservation, descriptor: Descriptor, without: Collection[str]
) -> FloatArray:
    """Return log p(o | c, v_r) minus the background's; an observable without a coupling adds nothing."""
    total = np.zeros(_SPEEDS_M_S.size)
    for coupling in descriptor.couplings:
        seen = observation.signature.get(coupling.observable)
        if seen is not None and coupling.observable not in without:
            density = coupling.log_likelihood(seen.value, seen.std, _SPEEDS_M_S)
            total += density - _log_background(coupling.observable, seen)
    return total


def _log_approach(observation: GroundedObservation, without: Collection[str]) -> FloatArray:
    """Return log p(v | v_r) minus the background's: Doppler, or looming with the range marginalised."""
    speed, inverse_tta = observation.radial_speed_m_s, observation.inverse_tta_hz
    if isinstance(speed, Observable) and "radial_speed_m_s" not in without:
        return _log_normal(speed, _SPEEDS_M_S, _SPEED_CELL_M_S) - _log_background("radial_speed_m_s", speed)
    if isinstance(inverse_tta, Observable) and "inverse_tta_hz" not in without:
        rates_hz, cells_hz = (one / _RANGES_M for one in (_SPEEDS_M_S[:, None], _SPEED_CELL_M_S))
        over_range = _log_normal(inverse_tta, rates_hz, cells_hz) - np.log(_RANGES_M.size)
        density = np.logaddexp.reduce(over_range, axis=1)
        return np.asarray(density - _log_background("inverse_tta_hz", inverse_tta))
    return np.zeros(_SPEEDS_M_S.size)


def _over_azimuth(bearing: Observable | NotUsable, std_rad: float) -> FloatArray:
    """Return log P(theta | h) p(bearing | theta) relative to a uniform azimuth, shape (azimuths,)."""
    prior: FloatArray = -0.5 * (_AZIMUTHS_RAD / std_rad) ** 2
    prior -= np.logaddexp.reduce(prior)
    if isinstance(bearing, NotUsable):
        return prior
    fit = _log_normal(bearing, _AZIMUTHS_RAD, _AZIMUTH_CELL_RAD)
    return np.asarray(prior + fit - np.logaddexp.reduce(fit - np.log(fit.size)))


def _log_background(name: str, seen: Observable) -> FloatArray:
    return _log_normal(BACKGROUNDS[name], seen.value, 0.0)


def _log_normal(seen: Observable, expected: FloatArray | float, cell: FloatArray | float) -> FloatArray:
    """Return the log density of an observable; its deviation is at least half a cell of the grid."""
    std = np.maximum(seen.std, np.asarray(cell) / 2.0)
    return np.asarray(-0.5 * ((seen.value - expected) / std) ** 2 - np.log(std * np.sqrt(2 * pi)))


@dataclass(frozen=True, slots=True)
class Grounding:
    """Classes of road users and the couplings between their sound and their motion.

    Parameters
    ----------
    descriptors : tuple of Descriptor
        At least one class of road users.
    settings : GroundedSettings
        Observables that are switched off.

    Examples
    --------
    >>> scores = SignatureEvidence(("left", "right"), (1.0, -1.0), 0.0, 0.0)
    >>> observation = GroundedObservation(inverse_tta_hz=Observable(0.4, 0.05))
    >>> answer = Grounding().answer(scores, observation)
    >>> answer.best.entity_class, answer.evidence.hidden[0] > 1.0
    ('motor_vehicle', True)
    """

    descriptors: tuple[Descriptor, ...] = (car(), motorcycle())
    settings: GroundedSettings = field(default_factory=GroundedSettings)

    def answer(self, signature: SignatureEvidence, observation: GroundedObservation) -> GroundedAnswer:
        """Return the result of `ground` for calibrated scores and the other observations."""
        return ground(signature, observation, self.descriptors, self.settings)
