r"""Grounded signature likelihoods, eq. (5), and their integral over class and state.

.. math::
    \ell_h(y) = \frac{P(h \mid s)}{\pi_h} \sum_c P(c) \int p(o \mid c, v_r)\, p(\hat v \mid v_r)\,
                dP(v_r \mid c, h) \int p(\hat\theta \mid \theta)\, dP(\theta \mid h)

The first factor is the calibrated score of any classifier; o are the observables that physics couples to the
radial speed. All densities are relative to those of a spurious signature, whose own factors are one: where
nothing beside the feature was measured, the classifier's evidence is handed on unchanged.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import pi

import numpy as np

from worldstate.abduction.evidence import SignatureEvidence
from worldstate.ground.checks import finite_array, in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray
from worldstate.ground.values import NotUsable

from .class_descriptors import Descriptor


@dataclass(frozen=True, slots=True)
class Observable:
    """A number with its standard deviation, which comes from a bound or from the estimator itself."""

    value: float  # In the unit that the name says
    std: float  # Of the estimate, >= 0

    def __post_init__(self) -> None:
        finite_array("value", self.value, ())
        in_range("std", self.std, 0.0, float("inf"), open_high=True)


NOT_MEASURED = NotUsable("not measured")


@dataclass(frozen=True, slots=True)
class GroundedObservation:
    """The front-end's statistics y = (s, theta, v) besides the classifier's scores.

    Parameters
    ----------
    bearing_rad : Observable or NotUsable
        Azimuth, left positive.
    radial_speed_m_s : Observable or NotUsable
        From Doppler, positive while closing.
    inverse_tta_hz : Observable or NotUsable
        From looming, 1/s.
    signature : mapping of str to Observable
        Observables that descriptors couple to speed, such as ``line_spacing_hz``; those that are missing are
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


_SPEEDS_M_S = np.linspace(-5.0, 30.0, 141)
_AZIMUTHS_RAD = np.radians(np.arange(-90.0, 90.5, 1.0))
_SPEED_CELL_M_S = 0.25
_AZIMUTH_CELL_RAD = float(np.radians(1.0))
_RANGES_M = np.geomspace(5.0, 60.0, 24)


@dataclass(frozen=True, slots=True)
class Background:
    """Density of an observable that belongs to no source; all other densities are relative to it."""

    mean: float  # Of a broad normal law, in the observable's unit
    std: float

    def log_density(self, value: float) -> float:
        r"""Return the log density at a value, nats.

        .. math:: \log p = -\tfrac12 (x - \mu)^2 / \sigma^2 - \log(\sigma \sqrt{2 \pi})
        """
        return float(-0.5 * ((value - self.mean) / self.std) ** 2 - np.log(self.std * np.sqrt(2 * pi)))


BACKGROUNDS = {
    "line_spacing_hz": Background(70.0, 40.0),
    "tyre_shape_db": Background(0.0, 10.0),
    "doppler_ratio": Background(1.0, 0.05),
    "radial_speed_m_s": Background(0.0, 10.0),
    "inverse_tta_hz": Background(0.0, 1.0),
}


@dataclass(frozen=True, slots=True)
class AzimuthPrior:
    """Prior of a source's azimuth under one explanation: a normal law truncated at +-90 degrees."""

    azimuth_rad: float  # Centre, left positive, and standard deviation; infinite for any azimuth alike
    std_rad: float

    def log_prior(self, azimuths_rad: FloatArray) -> FloatArray:
        r"""Return log P(theta) on a grid, normalised over it, shape (n,), nats.

        .. math:: P(\theta_i) \propto \exp\big(-\tfrac12 (\theta_i - \theta_0)^2 / \sigma^2\big), \qquad
                  \sum_i P(\theta_i) = 1

        Shapes: azimuths_rad (n,).
        """
        log_weight = -0.5 * ((azimuths_rad - self.azimuth_rad) / self.std_rad) ** 2
        return np.asarray(log_weight - np.logaddexp.reduce(log_weight))


@dataclass(frozen=True, slots=True)
class GroundedSettings:
    """Azimuth priors and the couplings that are used.

    Parameters
    ----------
    hidden : AzimuthPrior
        Of the strongest direction of a hidden source. It is a wall or an edge that is heard, whose side says
        little of the side that the vehicle comes from: by default any azimuth alike, from both sides.
    visible : AzimuthPrior
        Of a source in plain view.
    without : frozenset of str
        Observables that are left out, for ablations: of a coupling, or of the approach rate,
        `radial_speed_m_s` and `inverse_tta_hz`.
    backgrounds : mapping of str to Background
        One for every observable that a descriptor couples.

    Examples
    --------
    >>> GroundedSettings(without=frozenset({"line_spacing_hz"})).hidden.std_rad
    inf
    """

    hidden: AzimuthPrior = AzimuthPrior(0.0, np.inf)
    visible: AzimuthPrior = AzimuthPrior(0.0, np.radians(35.0))
    without: frozenset[str] = frozenset()
    backgrounds: Mapping[str, Background] = field(default_factory=lambda: BACKGROUNDS)


@dataclass(frozen=True, slots=True)
class HiddenState:
    """The state z that explains an observation best under the hidden explanation.

    Examples
    --------
    >>> HiddenState("left", "motor_vehicle", ("car",), 0.5, 8.0, -3.0).labels
    ('car',)
    """

    direction: str  # Of `SignatureEvidence.directions`
    entity_class: str  # Name of the descriptor
    labels: tuple[str, ...]  # What a camera would report of it
    azimuth_rad: float  # Most probable values, on the grid of the quadrature
    radial_speed_m_s: float
    log_posterior: float  # Of the whole of it, among hidden states, nats


@dataclass(frozen=True, slots=True)
class GroundedAnswer:
    """Likelihoods of the explanations, and the best hidden state with its predictions.

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
    >>> hidden = HiddenState("left", "motor_vehicle", ("car",), 0.5, 8.0, -3.0)
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

    for h hidden or visible, with p_0 the density without a source; that of none is left as it is.

    Parameters
    ----------
    evidence : SignatureEvidence
        The classifier's, from calibrated scores.
    observation : GroundedObservation
        Bearing, approach and observables with their spreads; what is not usable is marginalised.
    descriptors : sequence of Descriptor
        Classes of road users, at least one, names all different.
    settings : GroundedSettings, optional
        Sectors and switched-off couplings.

    Returns
    -------
    GroundedAnswer
        Class, speed and evidence after physics.

    Raises
    ------
    InvalidArgumentError
        If there is no descriptor, a name comes twice, or a measured observable has no background.

    References
    ----------
    "Evidence of Absence", eq. (5), and its integral in section V.

    Examples
    --------
    >>> from worldstate.abduction.grounding.class_descriptors import car
    >>> scores = SignatureEvidence(("left", "right"), (1.0, -1.0), 0.0, 0.0)
    >>> closing = GroundedObservation(radial_speed_m_s=Observable(8.0, 1.0))
    >>> answer = ground(scores, closing, [car()])
    >>> answer.best.direction, answer.best.radial_speed_m_s, answer.evidence.hidden[0] > 1.0
    ('left', 8.0, True)
    """
    chosen = settings or GroundedSettings()
    names = [descriptor.name for descriptor in descriptors]
    if not names or len(set(names)) != len(names):
        raise InvalidArgumentError(f"descriptors: expected one or more with different names, got {names}")
    over_speed = _over_speed(observation, descriptors, chosen)
    hidden_azimuth, visible_azimuth = (
        _over_azimuth(observation.bearing_rad, sector) for sector in (chosen.hidden, chosen.visible)
    )
    per_class = np.logaddexp.reduce(over_speed, axis=1)
    moving = np.logaddexp.reduce(per_class)
    grounded = SignatureEvidence(
        evidence.directions,
        tuple((np.array(evidence.hidden) + moving + np.logaddexp.reduce(hidden_azimuth)).tolist()),
        float(evidence.visible + moving + np.logaddexp.reduce(visible_azimuth)),
        evidence.none,
    )
    best = _best(evidence, descriptors, over_speed, hidden_azimuth)
    return GroundedAnswer(grounded, best, dict(zip(names, np.exp(per_class - moving).tolist(), strict=True)))


def _over_speed(
    observation: GroundedObservation, descriptors: Sequence[Descriptor], settings: GroundedSettings
) -> FloatArray:
    """Log of P(c) P(v_r | c) p(o | c, v_r) p(v | v_r) over the background, shape (classes, speeds)."""
    weights = np.log([descriptor.weight for descriptor in descriptors])
    weights -= np.logaddexp.reduce(weights)
    approach = _log_approach(observation, settings)
    rows = [
        weight + d.log_speed_prior(_SPEEDS_M_S) + _log_couplings(observation, d, settings) + approach
        for weight, d in zip(weights, descriptors, strict=True)
    ]
    return np.stack(rows)


def _log_couplings(
    observation: GroundedObservation, descriptor: Descriptor, settings: GroundedSettings
) -> FloatArray:
    """Log of p(o | c, v_r) over the background; an observable that a class leaves open adds nothing."""
    total = np.zeros(_SPEEDS_M_S.size)
    for coupling in descriptor.couplings:
        seen = observation.signature.get(coupling.observable)
        if seen is None or coupling.observable in settings.without:
            continue
        if coupling.observable not in settings.backgrounds:
            raise InvalidArgumentError(f"backgrounds: expected one of {coupling.observable}")
        background = settings.backgrounds[coupling.observable].log_density(seen.value)
        total += coupling.log_likelihood(seen.value, seen.std, _SPEEDS_M_S) - background
    return total


def _log_approach(observation: GroundedObservation, settings: GroundedSettings) -> FloatArray:
    """Log of p(v | v_r) over that of the background: Doppler, else looming with the range marginalised."""
    speed, inverse_tta = observation.radial_speed_m_s, observation.inverse_tta_hz
    if isinstance(speed, Observable) and "radial_speed_m_s" not in settings.without:
        background = settings.backgrounds["radial_speed_m_s"].log_density(speed.value)
        return _log_normal(speed, _SPEEDS_M_S, _SPEED_CELL_M_S) - background
    if isinstance(inverse_tta, Observable) and "inverse_tta_hz" not in settings.without:
        background = settings.backgrounds["inverse_tta_hz"].log_density(inverse_tta.value)
        ranges = _SPEED_CELL_M_S / _RANGES_M
        over_range = _log_normal(inverse_tta, _SPEEDS_M_S[:, None] / _RANGES_M, ranges)
        return np.asarray(np.logaddexp.reduce(over_range, axis=1) - np.log(_RANGES_M.size) - background)
    return np.zeros(_SPEEDS_M_S.size)


def _over_azimuth(bearing: Observable | NotUsable, sector: AzimuthPrior) -> FloatArray:
    """Log of P(theta | h) p(bearing | theta) over that of any azimuth alike, shape (azimuths,)."""
    prior = sector.log_prior(_AZIMUTHS_RAD)
    if isinstance(bearing, NotUsable):
        return prior
    fit = _log_normal(bearing, _AZIMUTHS_RAD, _AZIMUTH_CELL_RAD)
    return np.asarray(prior + fit - np.logaddexp.reduce(fit - np.log(fit.size)))


def _log_normal(seen: Observable, expected: FloatArray, cell: FloatArray | float) -> FloatArray:
    """Log density of what was seen; a spread below half a cell of the grid is held there."""
    std = np.maximum(seen.std, np.asarray(cell) / 2.0)
    return np.asarray(-0.5 * ((seen.value - expected) / std) ** 2 - np.log(std * np.sqrt(2 * pi)))


def _best(
    evidence: SignatureEvidence,
    descriptors: Sequence[Descriptor],
    over_speed: FloatArray,
    over_azimuth: FloatArray,
) -> HiddenState:
    """Return arg max of p(k, c, theta, v_r | y, hidden): its factors part, so each is taken by itself."""
    sides = np.array(evidence.hidden) - np.logaddexp.reduce(evidence.hidden)
    entity, speed = divmod(int(over_speed.argmax()), over_speed.shape[1])
    states = over_speed - np.logaddexp.reduce(over_speed, axis=None)
    azimuths = over_azimuth - np.logaddexp.reduce(over_azimuth)
    return HiddenState(
        direction=evidence.directions[int(sides.argmax())],
        entity_class=descriptors[entity].name,
        labels=descriptors[entity].labels,
        azimuth_rad=float(_AZIMUTHS_RAD[over_azimuth.argmax()]),
        radial_speed_m_s=float(_SPEEDS_M_S[speed]),
        log_posterior=float(sides.max() + states.max() + azimuths.max()),
    )
