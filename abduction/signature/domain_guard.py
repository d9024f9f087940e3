r"""Whether a sound is one that a signature model was made for.

A vector x of what one microphone heard over two seconds is given to a softmax over the street, kinds of
foreign sounds and warning signals of vehicles:

.. math:: \ell_c = w_c^T x + b_c, \qquad
          \lambda = \log \sum_{c \ne street} e^{\ell_c} - \ell_{street}

Above a threshold on lambda, held on streets never heard, the sound is not the street's. It is a warning
signal where the softmax says so and x lies within reach of a kind of signal, :math:`|A (x - \mu_k)| \le 1`.
"""

from dataclasses import dataclass
from typing import ClassVar, TypeAlias

import numpy as np

from worldstate.abduction.evidence import SignatureEvidence
from worldstate.ground.checks import freeze_arrays
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.serialisation import Layout
from worldstate.ground.typing import FloatArray


@dataclass(frozen=True, slots=True)
class Familiar:
    """A sound as the model knows them."""

    LAYOUT: ClassVar = Layout(constants={"kind": "familiar"})

    log_odds: float  # Of anything else, over the threshold: negative


@dataclass(frozen=True, slots=True)
class Foreign:
    """A sound that the model was not made for."""

    LAYOUT: ClassVar = Layout(constants={"kind": "foreign"})

    reason: str
    log_odds: float  # Over the threshold: positive


@dataclass(frozen=True, slots=True)
class WarningSignal:
    """What a vehicle warns with: siren, horn, reversing beeper, bell of a bicycle."""

    LAYOUT: ClassVar = Layout(constants={"kind": "warning-signal"})

    signal: str
    log_odds: float  # Over the threshold: positive


DomainVerdict: TypeAlias = Familiar | Foreign | WarningSignal


@dataclass(frozen=True, slots=True, eq=False)
class DomainGuard:
    """Coefficients of a guard, no rows of what it was trained on."""

    measures: tuple[str, ...]  # Names of what it reads, in their order
    foreign: tuple[str, ...]  # Kinds of foreign sounds that it has heard
    signals: tuple[str, ...]  # And of warning signals
    weights: FloatArray  # shape (1 + foreign + signals, measures): The street first
    biases: FloatArray  # shape (1 + foreign + signals,)
    threshold: float  # Log-odds that so many hops of streets never heard exceed as its training states
    # The softmax alone takes every whistle that it has never heard for a siren.
    kinds_of_signals: tuple[str, ...]  # The signal that each centre is of: two sirens are one
    centres: FloatArray  # shape (kinds, measures): Mean of every kind of signal
    whitening: FloatArray  # shape (measures, measures): Makes the reach of a kind the unit ball
    # Nats that flagged evidence has to exceed to say anything. Without end it costs .64 of the detections of
    # vehicles that come while a foreign sound is as loud as they are, with 2 nats .28; both leave alarms in
    # .016 and .018 of the hops of foreign sounds alone, .11 before (25 sounds, each of a kind never heard).
    margin: float = 2.0

    def __post_init__(self) -> None:
        classes, inputs = 1 + len(self.foreign) + len(self.signals), len(self.measures)
        if not self.foreign or not self.signals:
            raise InvalidArgumentError("foreign, signals: expected at least one kind of each, got none")
        freeze_arrays(self, weights=(classes, inputs), biases=(classes,), whitening=(inputs, inputs))
        freeze_arrays(self, centres=(len(self.kinds_of_signals), inputs))

    def log_odds(self, measures: FloatArray) -> FloatArray:
        """Return the log-odds of anything but the street, over the threshold, shape (n,)."""
        logits = measures @ self.weights.T + self.biases
        return np.asarray(np.logaddexp.reduce(logits[:, 1:], axis=1) - logits[:, 0] - self.threshold)

    def judge(self, measures: FloatArray) -> DomainVerdict:
        """Return what the measures of two seconds say, shape (measures,)."""
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
    left = np.sign(ratios) * np.maximum(np.abs(ratios) - margin, 0.0)
    hidden = tuple((evidence.none + left).tolist())
    return SignatureEvidence(evidence.directions, hidden, evidence.visible, evidence.none)
