"""Log-likelihoods of one observation under every explanation, and the posterior that follows from them.

The explanations have the order of `SignatureEvidence`: hidden in each of K directions, visible, none. All
values are in nats; the log of a zero prior is -inf.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from operator import add
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground import FloatArray, InvalidArgumentError, in_range, replaced
from worldstate.ground.checks import all_of, check_fields, check_shape, finite_array

from .co_evidence import CoEvidence

# A window of 1 s differs by tens of nats between explanations. Beyond this limit, sums lose the digits from
# which probabilities are computed.
MOST_NATS = 1000.0
_NATS = (-MOST_NATS, MOST_NATS)


@dataclass(frozen=True, slots=True)
class SideEvidence:
    r"""Evidence of one window for each side separately: a vehicle on one side does not exclude the other.

    Parameters
    ----------
    directions : tuple of str
        Labels of the sides.
    log_ratios : tuple of float
        Per side, log-likelihood of a vehicle hidden there minus that of "visible or none", nats; 0 or less
        without evidence of a vehicle.
    both : float
        Posterior of hidden vehicles on both sides at the training prior.
    direct : float
        Posterior of a source in the open. Its bearing gives its position, so it has no side.
    visible : float
        Log-likelihood of a visible vehicle minus that of none, without sources in the open, nats.

    Raises
    ------
    InvalidArgumentError
        If a log-likelihood is not finite or beyond 1,000 nats.

    Examples
    --------
    >>> SideEvidence(("left", "right"), (2.5, -1.0), 0.02, 0.01, 0.3).log_ratios[0]
    2.5
    """

    directions: tuple[str, ...]
    log_ratios: tuple[float, ...]
    both: float
    direct: float
    visible: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "log_ratios", _nats("log_ratios", self.log_ratios, len(self.directions)))
        check_fields(self, both=(0.0, 1.0), direct=(0.0, 1.0), visible=_NATS)


@dataclass(frozen=True, slots=True)
class SignatureEvidence:
    r"""Log-likelihoods of one observation under every explanation, up to a common constant.

    The hidden explanation has one hypothesis per direction k, so that

    .. math:: \ell_{hid}(y) = \sum_k P(k \mid hid)\, \ell_{hid,k}(y)

    is the integral over the hidden state in eq. (6); the filter provides the direction weights.

    Parameters
    ----------
    directions : tuple of str
        Labels of the hidden hypotheses, for example ``("left", "right")``; at least one, all different.
    hidden : tuple of float
        log l_hid,k, one per direction, nats.
    visible : float
        log l_vis, nats.
    none : float
        log l_0, nats.
    sides : SideEvidence, optional
        Evidence for each side separately, if the model provides it.

    Raises
    ------
    InvalidArgumentError
        If a log-likelihood is not finite or beyond 1,000 nats, or their number differs from the directions'.

    Examples
    --------
    >>> SignatureEvidence(("left", "right"), (1.2, -0.3), -2.0, 0.1).hidden
    (1.2, -0.3)
    """

    directions: tuple[str, ...]
    hidden: tuple[float, ...]
    visible: float
    none: float
    sides: SideEvidence | None = None

    def __post_init__(self) -> None:
        labels = all_of("directions", self.directions, str)
        if not labels or len(set(labels)) != len(labels):
            raise InvalidArgumentError(f"directions: expected different labels, got {labels!r}")
        hidden = _nats("hidden", self.hidden, len(labels))
        (visible,), (none,) = _nats("visible", (self.visible,), 1), _nats("none", (self.none,), 1)
        for name, value in (("directions", labels), ("hidden", hidden), ("visible", visible), ("none", none)):
            object.__setattr__(self, name, value)

    @property
    def log_likelihoods(self) -> np.ndarray:
        """The vector (hidden_1 .. hidden_K, visible, none), shape (K + 2,), nats."""
        return np.array([*self.hidden, self.visible, self.none], dtype=np.float64)

    @property
    def likelier_side(self) -> Literal["left", "right"] | None:
        """The side with the higher likelihood; None if they are equal or the directions are not sides."""
        by_direction = dict(zip(self.directions, self.hidden, strict=True))
        left, right = by_direction.get("left"), by_direction.get("right")
        if left is None or right is None or left == right:
            return None
        return "left" if left > right else "right"


def _nats(name: str, values: object, size: int) -> tuple[float, ...]:
    """Return log-likelihoods as floats after checks of their number and range."""
    if (type(values) is not tuple and not isinstance(values, Sequence | np.ndarray)) or len(values) != size:
        raise InvalidArgumentError(f"{name}: expected one value per direction, got {values!r:.80}")
    # Integers would create integer arrays, to which no likelihood can be added in place.
    return tuple([in_range(name, one, *_NATS) for one in values])


_IMAGE = 0.02  # Probability that the peak of a direct sound is nevertheless a reflection


def with_bearing_vote(
    evidence: SignatureEvidence, azimuth_rad: float, std_rad: float, direct: float
) -> SignatureEvidence:
    r"""Return the evidence combined with a bearing whose sound is direct with probability d.

    .. math:: L'_{hid} = \min\big(L_{hid},\; (1 - d) L_{hid} + d\, \overline{L}\big), \qquad
              P'(k \mid hid) = (1 - d)\, P(k \mid hid) + d\, P(k \mid \theta), \quad
              P(left \mid \theta) = \tfrac{\epsilon}{2} + (1 - \epsilon)\, \Phi(\theta / \sigma)

    where L-bar is the mean likelihood of visible and none. The hidden explanation does not become more likely
    relative to the others, and its side becomes that of the bearing :math:`\theta \pm \sigma`. A reflected
    sound has no effect, because its peak may be an image in a wall. `SignatureEvidence.sides` is unchanged.

    Examples
    --------
    >>> wrong = SignatureEvidence(("left", "right"), hidden=(-2.0, 4.0), visible=0.0, none=0.0)
    >>> voted = with_bearing_vote(wrong, azimuth_rad=0.7, std_rad=0.1, direct=1.0)
    >>> [round(value, 1) for value in voted.hidden], with_bearing_vote(wrong, 0.7, 0.1, 0.0) == wrong
    ([0.7, -3.9], True)
    """
    # The probability of direct sound is too low for its bearing to be used.
    if direct < 0.5 * _IMAGE or set(evidence.directions) != {"left", "right"}:
        return evidence
    hidden = np.array(evidence.hidden)
    total = float(np.logaddexp(*hidden))
    neutral = float(np.logaddexp(evidence.visible, evidence.none))
    # Sums replace the means over two explanations, because all of them differ by the same log 2.
    kept = np.log1p(-direct) if direct < 1.0 else -np.inf
    level = min(total, float(np.logaddexp(kept + total, np.log(direct) + neutral)))
    left = 0.5 * _IMAGE + (1.0 - _IMAGE) * 0.5 * math.erfc(-azimuth_rad / (math.sqrt(2.0) * std_rad))
    by_bearing = np.array([left if side == "left" else 1.0 - left for side in evidence.directions])
    shares = (1.0 - direct) * np.exp(hidden - total) + direct * by_bearing
    return replaced(evidence, hidden=tuple((level + np.log(shares)).tolist()))


@dataclass(frozen=True, slots=True)
class Posterior:
    """Probabilities of the explanations after one observation.

    Parameters
    ----------
    directions : tuple of str
        Labels of the hidden hypotheses.
    log_probabilities : tuple of float
        Log posterior (hidden_1 .. hidden_K, visible, none), nats; sums to one when exponentiated.
    log_lambda : float
        Log of the mixture likelihood ratio Lambda, nats; see `log_lambda`.
    log_evidence : float
        log Z: log of the probability of this observation under the prior, nats.

    Examples
    --------
    >>> posterior = Posterior(("left", "right"), tuple(np.log([0.5, 0.1, 0.1, 0.3])), 0.4, -1.0)
    >>> round(posterior.hidden_total, 3)
    0.6
    """

    directions: tuple[str, ...]
    log_probabilities: tuple[float, ...]
    log_lambda: float
    log_evidence: float

    @property
    def probabilities(self) -> FloatArray:
        """The vector (hidden_1 .. hidden_K, visible, none), shape (K + 2,)."""
        return np.exp(self.log_probabilities)

    @property
    def hidden(self) -> tuple[float, ...]:
        """P(hidden in direction k), one per direction."""
        return tuple(self.probabilities[:-2].tolist())

    @property
    def hidden_total(self) -> float:
        """P(hidden), all directions together."""
        return sum(map(math.exp, self.log_probabilities[:-2]))

    @property
    def visible(self) -> float:
        """P(visible source)."""
        return float(np.exp(self.log_probabilities[-2]))

    @property
    def none(self) -> float:
        """P(no source)."""
        return float(np.exp(self.log_probabilities[-1]))


def abduce(log_prior: ArrayLike, evidence: SignatureEvidence, co_evidence: CoEvidence) -> Posterior:
    r"""Return the posterior of the explanations of one observation.

    .. math::
        p(h \mid y, V) = \pi_h\, \ell_h(y)\, p(V \mid h) \,/\, Z,

    which is eq. (6) if V is absent: :math:`p(V \mid h)` is :math:`\beta_c(\theta, d)` for the visible
    explanation and 1 for the others.

    Parameters
    ----------
    log_prior : array_like, shape (K + 2,)
        Log prior of (hidden_1 .. hidden_K, visible, none), nats; need not be normalised; -inf for zero.
    evidence : SignatureEvidence
        Log-likelihoods of the observation.
    co_evidence : CoEvidence
        Result of the co-evidence channel.

    Returns
    -------
    Posterior
        Probabilities of hidden_1 .. hidden_K, visible, none.

    Raises
    ------
    InvalidArgumentError
        If the prior has another shape, NaN, +inf or no mass, or if no explanation remains possible.

    References
    ----------
    "Evidence of Absence", eq. (6), section V.

    Examples
    --------
    >>> from worldstate.abduction.co_evidence import Absent
    >>> heard = SignatureEvidence(("left", "right"), hidden=(1.0, -1.0), visible=1.2, none=-2.0)
    >>> seen = abduce(np.log([0.1, 0.1, 0.4, 0.4]), heard, Absent(miss_rate=0.04))
    >>> round(seen.hidden_total, 3), round(seen.visible, 3)
    (0.742, 0.128)
    """
    return posterior_of(_checked_log_prior(log_prior, len(evidence.directions)), evidence, co_evidence)


def posterior_of(prior: Sequence[float], evidence: SignatureEvidence, co_evidence: CoEvidence) -> Posterior:
    """Return the posterior as `abduce` does, without checks of the log prior, shape (K + 2,)."""
    log_likelihood = _log_likelihood(evidence, co_evidence)
    joint = tuple(map(add, prior, log_likelihood))
    log_evidence = _log_sum(joint)
    if log_evidence == -math.inf:
        raise InvalidArgumentError("log_prior: expected mass on an explanation that the co-evidence allows")
    log_probabilities = tuple([one - log_evidence for one in joint])
    return Posterior(evidence.directions, log_probabilities, _log_ratio(prior, log_likelihood), log_evidence)


def log_lambda(log_prior: ArrayLike, evidence: SignatureEvidence, co_evidence: CoEvidence) -> float:
    r"""Return the log of the mixture likelihood ratio, nats: the test statistic of Neyman and Pearson.

    .. math::
        \Lambda(y) = \frac{\ell_{hid}(y)}{w_{vis}\, \beta_c(\theta, d)\, \ell_{vis}(y) + w_0\, \ell_0(y)},
        \qquad w = \pi / (1 - \pi_{hid}),

    with :math:`\ell_{hid} = \sum_k P(k \mid hid)\, \ell_{hid,k}`. It does not depend on the prior of a hidden
    source; if that prior is zero, all directions have equal weights. It is +inf if neither other explanation
    is possible.

    It raises the errors of `abduce`.

    Parameters
    ----------
    log_prior : array_like, shape (K + 2,)
        Log prior of the explanations, nats.
    evidence : SignatureEvidence
        Log-likelihoods of the signature.
    co_evidence : Absent, Present or Unqueried
        Result of the co-evidence channel.

    Returns
    -------
    float
        Log ratio, nats.

    References
    ----------
    "Evidence of Absence", section V, after eq. (6).

    Examples
    --------
    >>> from worldstate.abduction.co_evidence import Absent, Unqueried
    >>> heard = SignatureEvidence(("side",), hidden=(1.0,), visible=1.0, none=-1.0)
    >>> round(log_lambda(np.log([0.2, 0.4, 0.4]), heard, Unqueried("no camera")), 3)
    0.566
    >>> round(log_lambda(np.log([0.2, 0.4, 0.4]), heard, Absent(miss_rate=0.04)), 3)
    2.434
    """
    prior = _checked_log_prior(log_prior, len(evidence.directions))
    return _log_ratio(prior, _log_likelihood(evidence, co_evidence))


def statistic(
    evidence: SignatureEvidence, co_evidence: CoEvidence, reference_prior: Sequence[float]
) -> float:
    r"""Return the hidden posterior, eq. (6), at a fixed prior: the score that the threshold applies to.

    With a classifier's likelihood ratios and its training prior this is

    .. math:: s = \frac{P_l + P_r}{P_l + P_r + \beta\, P_{front} + P_{none}},

    At beta = 1 this is the published :math:`P_l + P_r`. At beta = 0 the visible explanation is removed. The
    statistic is a monotone function of Lambda and does not depend on context or time.

    Parameters
    ----------
    evidence : SignatureEvidence
        Log-likelihoods of the observation.
    co_evidence : CoEvidence
        Result of the co-evidence channel.
    reference_prior : sequence of float, shape (K + 2,)
        Probabilities, not logs, of (hidden_1 .. hidden_K, visible, none).

    Returns
    -------
    float
        Score in [0, 1].

    Raises
    ------
    InvalidArgumentError
        In the cases of `abduce`, or if a prior is negative.

    References
    ----------
        "Evidence of Absence", eq. (6) at a fixed prior.

    Examples
    --------
    >>> from worldstate.abduction.co_evidence import Absent, Unqueried
    >>> posteriors, prior = np.array([0.3, 0.1, 0.5, 0.1]), np.array([0.25, 0.25, 0.25, 0.25])
    >>> ratios = np.log(posteriors / prior)
    >>> heard = SignatureEvidence(("left", "right"), tuple(ratios[:2]), ratios[2], ratios[3])
    >>> [round(statistic(heard, answer, prior), 3) for answer in (Unqueried("no camera"), Absent(0.0))]
    [0.4, 0.8]
    """
    prior = finite_array("reference_prior", reference_prior, (len(evidence.directions) + 2,))
    if (prior < 0).any():
        raise InvalidArgumentError("reference_prior: expected probabilities, got a negative number")
    with np.errstate(divide="ignore"):
        return abduce(np.log(prior), evidence, co_evidence).hidden_total


def _checked_log_prior(log_prior: ArrayLike, directions: int) -> list[float]:
    prior = np.asarray(log_prior, dtype=np.float64)
    check_shape("log_prior", prior.shape, (directions + 2,))
    if not np.isfinite(prior.max()):
        raise InvalidArgumentError(f"log_prior: expected finite logs with some mass, got {prior.tolist()}")
    return list(map(float, prior))


# Lists, because arrays of so few numbers take ten times as long.
def _log_likelihood(evidence: SignatureEvidence, co_evidence: CoEvidence) -> list[float]:
    hidden, visible, none = co_evidence.log_likelihoods().tolist()
    return [*(one + hidden for one in evidence.hidden), evidence.visible + visible, evidence.none + none]


def _log_ratio(prior: Sequence[float], log_likelihood: Sequence[float]) -> float:
    hidden, others = prior[:-2], prior[-2:]
    if max(hidden) == -math.inf:
        hidden = [0.0] * len(hidden)
    if max(others) == -math.inf:
        return math.inf
    hidden_mean = _log_sum(map(add, hidden, log_likelihood)) - _log_sum(hidden)
    return hidden_mean - (_log_sum(map(add, others, log_likelihood[-2:])) - _log_sum(others))


def _log_sum(values: Iterable[float]) -> float:
    """log(sum(exp(values))) without overflow; -inf if every value is -inf."""
    every = tuple(values)
    largest = max(every)
    if largest == -math.inf:
        return largest
    return largest + math.log(sum([math.exp(one - largest) for one in every]))
