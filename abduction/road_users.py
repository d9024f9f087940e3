r"""Classification of road users by the sound at one microphone, and a guard against unknown sounds.

Both are a softmax over classes. Its input x is the sound character of one microphone over two seconds:

.. math:: p_c = \frac{e^{\ell_c}}{\sum_k e^{\ell_k}}, \qquad \ell_c = w_c^T x + b_c

One kind is *unknown*: any vehicle in such a sound is quieter than the ambience. The classes of the guard are
the street, kinds of foreign sounds and warning signals of vehicles:

.. math:: \lambda = \log \sum_{c \ne street} e^{\ell_c} - \ell_{street}

If lambda exceeds a threshold, chosen on streets outside the training set, the sound is foreign to the street.
It is a warning signal if the log-odds of signals over foreign sounds exceed a second threshold.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from math import exp
from typing import ClassVar, TypeAlias

import numpy as np

from worldstate.abduction.evidence import SignatureEvidence
from worldstate.ground import FloatArray, InvalidArgumentError, replaced
from worldstate.ground.checks import all_of, freeze_arrays, in_range, named
from worldstate.ground.serialisation import ADDED, Layout

UNKNOWN, SIREN = "unknown", "siren"
# The COCO classes that detectors report for each kind; they report a van as a car or as a truck.
SEEN_AS = {
    "car": {"car"},
    "van": {"car", "truck"},
    "truck": {"truck", "bus"},
    "motorcycle": {"motorcycle"},
    "bicycle": {"bicycle"},
    "tram": {"train"},
}
# Total probability of the kinds that are searched for in the camera image. With fewer kinds, a wrong
# classification would lead to a search for the wrong object.
_ASKED = 0.95
_ROUNDING = 1e-6
ClassShares: TypeAlias = tuple[tuple[str, float], ...]
"""Classes with their probabilities, sorted by name."""


def class_shares(name: str, value: object) -> ClassShares:
    """Return classes with their probabilities, checked and sorted.

    Examples
    --------
    >>> class_shares("classes", [("van", 0.25), ("car", 0.75)])
    (('car', 0.75), ('van', 0.25))
    """
    shares = list[tuple[str, float]]()
    for one in all_of(name, value, tuple):
        if len(one) != 2:
            raise InvalidArgumentError(f"{name}: expected a class and its probability, got {one!r:.40}")
        label, share = one
        if type(label) is not str or not label or type(share) is not float or not 0.0 <= share <= 1.0:
            named(name, label)
            share = in_range(name, share, 0.0, 1.0)
        shares.append((label, share))
    if (total := sum([share for _, share in shares])) > 1.0 + _ROUNDING:
        raise InvalidArgumentError(f"{name}: expected probabilities that sum to at most one, got {total:g}")
    return tuple(sorted(shares))


@dataclass(frozen=True, slots=True, eq=False)
class RoadUserModel:
    """Softmax over kinds of road users.

    Parameters
    ----------
    measures : tuple of str
        Names of the inputs, in order.
    classes : tuple of str
        Kinds, including *unknown*.
    weights : ndarray, shape (classes, measures)
        Weights of the softmax.
    biases : ndarray, shape (classes,)
        Biases of the softmax; they include the frequencies of the classes in use.
    shares : ndarray, shape (classes,), optional
        Frequencies of the classes that the biases include.

    Raises
    ------
    InvalidArgumentError
        If the shapes of the coefficients differ or no class is *unknown*.

    Examples
    --------
    >>> model = RoadUserModel(("deep",), ("car", "truck", "unknown"), [[0.0], [2.0], [0.0]], [2.0, 0.0, 0.0])
    >>> [(name, round(share, 2)) for name, share in model.classify(np.array([3.0]))]
    [('car', 0.02), ('truck', 0.98), ('unknown', 0.0)]
    """

    measures: tuple[str, ...]
    classes: tuple[str, ...]
    weights: FloatArray
    biases: FloatArray
    shares: FloatArray | None = field(default=None, metadata=ADDED)

    def __post_init__(self) -> None:
        if UNKNOWN not in self.classes:
            raise InvalidArgumentError(f"classes: expected {UNKNOWN!r} among them, got {self.classes}")
        freeze_arrays(self, weights=(len(self.classes), len(self.measures)), biases=(len(self.classes),))
        if self.shares is not None:
            freeze_arrays(self, shares=(len(self.classes),))

    def with_shares(self, shares: FloatArray) -> "RoadUserModel":
        r"""Return the model with other class frequencies; unchanged if the model has no frequencies.

        .. math:: p_c' \propto p_c\, \pi_c' / \pi_c

        Parameters
        ----------
        shares : ndarray, shape (classes,)
            Frequencies with sum 1; a class with frequency 0 is never detected.
        """
        if self.shares is None:
            return self
        now, before = (np.log(np.maximum(one, np.finfo(float).tiny)) for one in (shares, self.shares))
        return replaced(self, biases=self.biases + (now - before), shares=shares)

    def probabilities(self, measures: FloatArray) -> FloatArray:
        r"""Return the probability of every class, shape (n, classes).

        .. math:: p_c \propto e^{w_c^T x + b_c}

        Parameters
        ----------
        measures : ndarray, shape (n, measures)
            One row of inputs per hop.
        """
        logits = measures @ self.weights.T + self.biases
        return np.asarray(np.exp(logits - np.logaddexp.reduce(logits, axis=1, keepdims=True)))

    def classify(self, measures: FloatArray) -> ClassShares:
        """Return the classes of one hop with their probabilities, sorted by name.

        Parameters
        ----------
        measures : ndarray, shape (measures,)
            `AcousticFrame.character` of the hop.
        """
        return tuple(sorted(zip(self.classes, self.probabilities(measures[None])[0].tolist(), strict=True)))


def with_siren(shares: ClassShares, log_odds: float) -> ClassShares:
    r"""Return the classes together with a siren, which is not a class of the softmax.

    .. math:: p_{siren} = \frac{1}{1 + e^{-\lambda}}, \qquad p_c' = (1 - p_{siren})\, p_c

    Examples
    --------
    >>> with_siren((("car", 0.75), ("unknown", 0.25)), log_odds=0.0)
    (('car', 0.375), ('siren', 0.5), ('unknown', 0.125))
    """
    siren = 1.0 / (1.0 + exp(-log_odds))
    return tuple(sorted([(SIREN, siren), *((name, (1.0 - siren) * share) for name, share in shares)]))


def likeliest(shares: Iterable[tuple[str, float]], mass: float) -> frozenset[str]:
    r"""Return the smallest set of classes whose probabilities reach `mass`.

    Examples
    --------
    >>> sorted(likeliest((("car", 0.7), ("truck", 0.1), ("van", 0.2)), mass=0.85))
    ['car', 'van']
    """
    found, total = set[str](), 0.0
    for share, name in sorted([(-share, name) for name, share in shares]):
        if total < mass:
            found |= {name}
        total -= share
    return frozenset(found)


@dataclass(frozen=True, slots=True)
class Familiar:
    """A kind of sound that the model was trained on.

    Parameters
    ----------
    log_odds : float
        Log-odds of all other sounds minus the guard's threshold, nats: not positive.

    Examples
    --------
    >>> Familiar(-3.2).log_odds
    -3.2
    """

    LAYOUT: ClassVar = Layout(constants={"kind": "familiar"})

    log_odds: float


@dataclass(frozen=True, slots=True)
class Foreign:
    """A kind of sound that the model was not trained on.

    Parameters
    ----------
    reason : str
        Most similar kind of foreign sound.
    log_odds : float
        Log-odds of a foreign sound minus the guard's threshold, nats: positive.

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
    """A warning signal of a vehicle; it does not change the evidence.

    Parameters
    ----------
    signal : str
        Siren, horn, reversing beeper or bicycle bell.
    log_odds : float
        Log-odds of a foreign sound minus the guard's threshold, nats: positive.

    Examples
    --------
    >>> WarningSignal("siren", 9.0).signal
    'siren'
    """

    LAYOUT: ClassVar = Layout(constants={"kind": "warning-signal"})

    signal: str
    log_odds: float


DomainVerdict: TypeAlias = Familiar | Foreign | WarningSignal


def heard_kinds(model: RoadUserModel, character: FloatArray, domain: DomainVerdict | None) -> ClassShares:
    """Return the classes of one hop; none if the sound is foreign."""
    if isinstance(domain, Foreign):
        return ()
    shares = model.classify(character)
    if isinstance(domain, WarningSignal) and domain.signal == SIREN:
        return with_siren(shares, domain.log_odds)
    return shares


def expected_labels(kinds: ClassShares) -> frozenset[str] | None:
    """Return the detector classes that match the likely kinds; None if the kind is unknown.

    Examples
    --------
    >>> sorted(expected_labels((("car", 0.9), ("unknown", 0.01), ("van", 0.09))))
    ['car', 'truck']
    >>> expected_labels((("car", 0.9), ("unknown", 0.1))) is expected_labels(()) is None
    True
    """
    likely = likeliest(kinds, _ASKED)
    if not likely or likely & {UNKNOWN, SIREN}:
        return None
    return frozenset().union(*(SEEN_AS[name] for name in likely))


@dataclass(frozen=True, slots=True, eq=False)
class DomainGuard:
    """Domain guard, a softmax over kinds of sound; it holds no training data.

    Parameters
    ----------
    measures : tuple of str
        Names of the inputs, in order.
    foreign, signals : tuple of str
        Kinds of foreign sounds and of warning signals in its training data.
    weights : ndarray, shape (1 + foreign + signals, measures)
        Weights of the softmax; the first row is the street.
    biases : ndarray, shape (1 + foreign + signals,)
        Biases of the softmax.
    threshold : float
        Log-odds that 2.5 % of the hops exceed on streets outside the training set.
    signal_nats : float
        Log-odds of signals over foreign sounds above which a sound is a signal.
    margin : float
        Amount that is subtracted from the log ratios of a foreign sound, nats.

    Raises
    ------
    InvalidArgumentError
        If the shapes of the coefficients differ or a kind is missing.

    Examples
    --------
    >>> weights = [[0.0], [1.0], [2.0]]
    >>> guard = DomainGuard(("x",), ("speech",), ("siren",), weights, [3.0, 0.0, -5.0], 1.0)
    >>> guard.judge(np.array([0.0])).log_odds < 0.0, guard.judge(np.array([4.5])).reason
    (True, 'sounds like speech')
    """

    measures: tuple[str, ...]
    foreign: tuple[str, ...]
    signals: tuple[str, ...]
    weights: FloatArray
    biases: FloatArray
    threshold: float
    signal_nats: float = field(default=0.0, metadata=ADDED)
    # Foreign sounds alone raise an alarm in 14 % of their hops; in 6 % with a margin of 2 nats, and in 4 %
    # if all evidence is dropped. Of vehicles that approach during an equally loud foreign sound, 84, 63 and
    # 42 % are detected (43 sounds, five sites, kind and site outside the training set): lab/NOTES.md.
    margin: float = 2.0

    def __post_init__(self) -> None:
        classes, inputs = 1 + len(self.foreign) + len(self.signals), len(self.measures)
        if not self.foreign or not self.signals:
            raise InvalidArgumentError("foreign, signals: expected at least one kind of each, got none")
        freeze_arrays(self, weights=(classes, inputs), biases=(classes,))

    def log_odds(self, measures: FloatArray) -> FloatArray:
        r"""Return the log-odds of all classes but the street minus the threshold, shape (n,).

        .. math:: \log \sum_{c \ne street} e^{w_c^T x + b_c} - (w_{street}^T x + b_{street}) - \tau

        Parameters
        ----------
        measures : ndarray, shape (n, measures)
            One row of inputs per hop.
        """
        logits = measures @ self.weights.T + self.biases
        return np.asarray(np.logaddexp.reduce(logits[:, 1:], axis=1) - logits[:, 0] - self.threshold)

    def judge(self, measures: FloatArray) -> DomainVerdict:
        """Classify the sound of two seconds as familiar, foreign or a warning signal.

        Parameters
        ----------
        measures : ndarray, shape (measures,)
            `AcousticFrame.character` of the hop.
        """
        log_odds = float(self.log_odds(measures[None])[0])
        if log_odds <= 0.0:
            return Familiar(log_odds)
        logits = (self.weights @ measures + self.biases)[1:]
        foreign, signal = logits[: len(self.foreign)], logits[len(self.foreign) :]
        if np.logaddexp.reduce(signal) - np.logaddexp.reduce(foreign) > self.signal_nats:
            return WarningSignal(self.signals[int(signal.argmax())], log_odds)
        return Foreign(f"sounds like {self.foreign[int(foreign.argmax())]}", log_odds)


def neutral(evidence: SignatureEvidence, margin: float) -> SignatureEvidence:
    r"""Return the evidence with the log ratios of hidden to none reduced by a margin, nats.

    .. math:: \ell_k' = \ell_0 + \mathrm{sign}(r_k) \max(|r_k| - m, 0), \qquad r_k = \ell_k - \ell_0

    Examples
    --------
    >>> neutral(SignatureEvidence(("left", "right"), (3.0, -1.0), -2.0, 0.5), margin=2.0).hidden
    (1.0, 0.5)
    """
    ratios = np.array(evidence.hidden) - evidence.none
    hidden = tuple((evidence.none + beyond(ratios, margin)).tolist())
    sides = evidence.sides
    if sides is not None:
        sides = replaced(sides, log_ratios=tuple(beyond(np.array(sides.log_ratios), margin).tolist()))
    return replaced(evidence, hidden=hidden, sides=sides)


def beyond(ratios: FloatArray, margin: float) -> FloatArray:
    """Return log ratios reduced by a margin towards zero, nats, as in `neutral`."""
    return np.asarray(np.sign(ratios) * np.maximum(np.abs(ratios) - margin, 0.0))
