r"""Whether a sound is one that a signature model was made for.

A vector x of what one microphone heard over two seconds is given to a softmax over the street, kinds of
foreign sounds and warning signals of vehicles:

.. math:: \ell_c = w_c^T x + b_c, \qquad
          \lambda = \log \sum_{c \ne street} e^{\ell_c} - \ell_{street}

Above a threshold on lambda, held on streets never heard, the sound is not the street's. It is a warning
signal where the softmax says so and x lies within reach of a kind of signal, :math:`|A (x - \mu_k)| \le 1`.
"""

from dataclasses import dataclass, replace
from typing import ClassVar, Literal, TypeAlias

import numpy as np

from worldstate.abduction.evidence import SignatureEvidence
from worldstate.ground import FloatArray, InvalidArgumentError
from worldstate.ground.checks import freeze_arrays, in_range
from worldstate.ground.serialisation import Layout

EgoMotion = Literal["standing", "moving", "any"]


@dataclass(frozen=True, slots=True, eq=False)
class ModelDomain:
    """Of what the windows were made that a model was trained on, or that a table holds.

    Parameters
    ----------
    array : str
        Name of the microphone array.
    positions_m : ndarray, shape (M, 3)
        Its microphones in the order of the channels, `base_link` axes, metres.
    sample_rate_hz : (float, float)
        Lowest and highest rate with frames of 512; lower ones with frames shorter by as much count as these.
    band_hz : (float, float)
        Band of the feature.
    feature : str
        Name and version of the feature.
    ego_motion : {"standing", "moving", "any"}
        What the ego vehicle did.

    Raises
    ------
    InvalidArgumentError
        If the positions are no (M, 3) array of finite numbers or an interval is empty.

    Examples
    --------
    >>> ModelDomain("pair", [[0, 0.1, 0], [0, -0.1, 0]], (47e3, 49e3), (50, 1500), "f 1", "standing").extent_m
    (0.0, 0.2, 0.0)
    """

    array: str
    positions_m: FloatArray
    sample_rate_hz: tuple[float, float]
    band_hz: tuple[float, float]
    feature: str
    ego_motion: EgoMotion

    def __post_init__(self) -> None:
        freeze_arrays(self, positions_m=(None, 3))
        for name in ("sample_rate_hz", "band_hz"):
            low, high = getattr(self, name)
            in_range(name, low, 0.0, high)

    @property
    def extent_m(self) -> tuple[float, float, float]:
        """Extent of the array along x, y and z, metres."""
        x, y, z = np.ptp(self.positions_m, axis=0).tolist()
        return x, y, z


@dataclass(frozen=True, slots=True)
class Familiar:
    """A sound of the kind that the model was made for.

    Parameters
    ----------
    log_odds : float
        Of anything else, over the guard's threshold, nats: not positive.

    Examples
    --------
    >>> Familiar(-3.2).log_odds
    -3.2
    """

    LAYOUT: ClassVar = Layout(constants={"kind": "familiar"})

    log_odds: float


@dataclass(frozen=True, slots=True)
class Foreign:
    """A sound that the model was not made for.

    Parameters
    ----------
    reason : str
        What it is taken for.
    log_odds : float
        Over the guard's threshold, nats: positive.

    Examples
    --------
    >>> Foreign("sounds like speech", 4.0).reason
    'sounds like speech'
    """

    LAYOUT: ClassVar = Layout(constants={"kind": "foreign"})

    reason: str
    log_odds: float


@dataclass(frozen=True, slots=True)
class WarningSignal:
    """A warning signal of a vehicle: evidence of it is left as it is.

    Parameters
    ----------
    signal : str
        Siren, horn, reversing beeper or bicycle bell.
    log_odds : float
        Over the guard's threshold, nats: positive.

    Examples
    --------
    >>> WarningSignal("siren", 9.0).signal
    'siren'
    """

    LAYOUT: ClassVar = Layout(constants={"kind": "warning-signal"})

    signal: str
    log_odds: float


DomainVerdict: TypeAlias = Familiar | Foreign | WarningSignal


@dataclass(frozen=True, slots=True, eq=False)
class DomainGuard:
    """Coefficients of a guard, no rows of what it was trained on.

    Parameters
    ----------
    measures : tuple of str
        Names of what it reads, in their order.
    foreign, signals : tuple of str
        Kinds of foreign sounds and of warning signals that it has heard.
    weights : ndarray, shape (1 + foreign + signals, measures)
        Of the softmax, the street first.
    biases : ndarray, shape (1 + foreign + signals,)
        Of the softmax.
    threshold : float
        Log-odds that .025 of the hops of streets never heard exceed.
    kinds_of_signals : tuple of str
        The signal that each centre is of: two sirens are one.
    centres : ndarray, shape (kinds, measures)
        Mean of every kind of signal.
    whitening : ndarray, shape (measures, measures)
        Makes the reach of a kind the unit ball.
    margin : float
        Nats that evidence of a foreign sound has to exceed to say anything.

    Raises
    ------
    InvalidArgumentError
        If the coefficients do not fit one another or a kind is missing.

    Examples
    --------
    >>> reach = {"kinds_of_signals": ("siren",), "centres": [[9.0]], "whitening": [[1.0]]}
    >>> weights = [[0.0], [1.0], [2.0]]
    >>> guard = DomainGuard(("x",), ("speech",), ("siren",), weights, [3.0, 0.0, -5.0], 1.0, **reach)
    >>> guard.judge(np.array([0.0])).log_odds < 0.0, guard.judge(np.array([4.5])).reason
    (True, 'sounds like speech')
    """

    measures: tuple[str, ...]
    foreign: tuple[str, ...]
    signals: tuple[str, ...]
    weights: FloatArray
    biases: FloatArray
    threshold: float
    # The softmax alone takes every whistle that it has never heard for a siren.
    kinds_of_signals: tuple[str, ...]
    centres: FloatArray
    whitening: FloatArray
    # Foreign sounds alone alarm in .14 of their hops; less 2 nats in .06, less all in .04. Of vehicles that
    # come while one is as loud as they are, .84, .63 and .42 are detected (43 sounds at five sites, kind and
    # site never heard): docs/foreign_sounds.md.
    margin: float = 2.0

    def __post_init__(self) -> None:
        classes, inputs = 1 + len(self.foreign) + len(self.signals), len(self.measures)
        if not self.foreign or not self.signals:
            raise InvalidArgumentError("foreign, signals: expected at least one kind of each, got none")
        freeze_arrays(self, weights=(classes, inputs), biases=(classes,), whitening=(inputs, inputs))
        freeze_arrays(self, centres=(len(self.kinds_of_signals), inputs))

    def log_odds(self, measures: FloatArray) -> FloatArray:
        r"""Return the log-odds of anything but the street, over the threshold, shape (n,).

        .. math:: \log \sum_{c \ne street} e^{w_c^T x + b_c} - (w_{street}^T x + b_{street}) - \tau

        Parameters
        ----------
        measures : ndarray, shape (n, measures)
            Rows.
        """
        logits = measures @ self.weights.T + self.biases
        return np.asarray(np.logaddexp.reduce(logits[:, 1:], axis=1) - logits[:, 0] - self.threshold)

    def judge(self, measures: FloatArray) -> DomainVerdict:
        """Return what the measures of two seconds say.

        Parameters
        ----------
        measures : ndarray, shape (measures,)
            `AcousticFrame.character`.
        """
        log_odds = float(self.log_odds(measures[None])[0])
        if log_odds <= 0.0:
            return Familiar(log_odds)
        logits = (self.weights @ measures + self.biases)[1:]
        foreign, signal = logits[: len(self.foreign)], logits[len(self.foreign) :]
        if np.logaddexp.reduce(signal) > np.logaddexp.reduce(foreign):
            apart = np.square((measures - self.centres) @ self.whitening.T).sum(axis=1)
            if apart.min() <= 1.0:
                return WarningSignal(self.kinds_of_signals[int(apart.argmin())], log_odds)
        return Foreign(f"sounds like {self.foreign[int(foreign.argmax())]}", log_odds)


def neutral(evidence: SignatureEvidence, margin: float) -> SignatureEvidence:
    r"""Return evidence that tells hidden from none only by what exceeds a margin, nats.

    .. math:: \ell_k' = \ell_0 + \mathrm{sign}(r_k) \max(|r_k| - m, 0), \qquad r_k = \ell_k - \ell_0

    Examples
    --------
    >>> neutral(SignatureEvidence(("left", "right"), (3.0, -1.0), -2.0, 0.5), margin=2.0).hidden
    (1.0, 0.5)
    """
    ratios = np.array(evidence.hidden) - evidence.none
    hidden = tuple((evidence.none + _beyond(ratios, margin)).tolist())
    sides = evidence.sides
    if sides is not None:
        sides = replace(sides, log_ratios=tuple(_beyond(np.array(sides.log_ratios), margin).tolist()))
    return SignatureEvidence(evidence.directions, hidden, evidence.visible, evidence.none, sides)


def _beyond(ratios: FloatArray, margin: float) -> FloatArray:
    return np.asarray(np.sign(ratios) * np.maximum(np.abs(ratios) - margin, 0.0))
