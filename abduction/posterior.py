r"""Competition of explanations: hidden source, visible source, no source.

Hypotheses stand in the order of `SignatureEvidence`: hidden in each of K directions, visible, none. All is
done in nats, and a prior of zero is a log of -inf.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground import FloatArray, InvalidArgumentError
from worldstate.ground.checks import check_shape, finite_array

from .co_evidence import CoEvidence
from .evidence import SignatureEvidence


@dataclass(frozen=True, slots=True)
class Posterior:
    """Probabilities of the explanations after one look.

    Parameters
    ----------
    directions : tuple of str
        Labels of the hidden hypotheses.
    log_probabilities : tuple of float
        Log posterior (hidden_1 .. hidden_K, visible, none), nats; sums to one when exponentiated.
    log_lambda : float
        Log of the mixture likelihood ratio Lambda, nats; see `log_lambda`.
    log_evidence : float
        log Z: what the priors expected of this observation, nats.

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
        return float(self.probabilities[:-2].sum())

    @property
    def visible(self) -> float:
        """P(visible source)."""
        return float(np.exp(self.log_probabilities[-2]))

    @property
    def none(self) -> float:
        """P(no source)."""
        return float(np.exp(self.log_probabilities[-1]))


def abduce(log_prior: ArrayLike, evidence: SignatureEvidence, co_evidence: CoEvidence) -> Posterior:
    r"""Weigh the explanations of one observation.

    .. math::
        p(h \mid y, V) = \pi_h\, \ell_h(y)\, p(V \mid h) \,/\, Z,

    eq. (6) with V absent: :math:`p(V \mid h)` is :math:`\beta_c(\theta, d)` for the visible explanation
    and 1 for the others.

    Parameters
    ----------
    log_prior : array_like, shape (K + 2,)
        Log prior of (hidden_1 .. hidden_K, visible, none), nats; normalised or not, -inf for a prior of zero.
    evidence : SignatureEvidence
        Log-likelihoods of the observation.
    co_evidence : CoEvidence
        What the channel that was asked answered.

    Returns
    -------
    Posterior
        Over hidden_1 .. hidden_K, visible, none.

    Raises
    ------
    InvalidArgumentError
        On a prior of another shape, with NaN, +inf or no mass, or if no explanation remains possible.

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


def posterior_of(prior: FloatArray, evidence: SignatureEvidence, co_evidence: CoEvidence) -> Posterior:
    """Return what `abduce` does for the log prior of a belief, shape (K + 2,), which is not checked."""
    log_likelihood = _log_likelihood(evidence, co_evidence)
    joint = prior + log_likelihood
    log_evidence = _log_sum(joint)
    if log_evidence == -np.inf:
        raise InvalidArgumentError("log_prior: expected mass on an explanation that the co-evidence allows")
    return Posterior(
        evidence.directions,
        tuple((joint - log_evidence).tolist()),
        _log_ratio(prior, log_likelihood),
        log_evidence,
    )


def log_lambda(log_prior: ArrayLike, evidence: SignatureEvidence, co_evidence: CoEvidence) -> float:
    r"""Return the log of the mixture likelihood ratio that the Neyman-Pearson test thresholds, nats.

    .. math::
        \Lambda(y) = \frac{\ell_{hid}(y)}{w_{vis}\, \beta_c(\theta, d)\, \ell_{vis}(y) + w_0\, \ell_0(y)},
        \qquad w = \pi / (1 - \pi_{hid}),

    with :math:`\ell_{hid} = \sum_k P(k \mid hid)\, \ell_{hid,k}`. It does not depend on how probable a hidden
    source is beforehand; where that prior is zero, all directions weigh alike. +inf where neither other
    explanation is possible.

    Errors are those of `abduce`.

    Parameters
    ----------
    log_prior : array_like, shape (K + 2,)
        Log prior of the explanations, nats.
    evidence : SignatureEvidence
        Log-likelihoods of the signature.
    co_evidence : Absent, Present or Unqueried
        Answer of the co-evidence channel.

    Returns
    -------
    float
        Nats.

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
    r"""Return eq. (6) at a fixed prior: the score in [0, 1] that a threshold was set for.

    With a classifier's likelihood ratios and its own training prior this is

    .. math:: s = \frac{P_l + P_r}{P_l + P_r + \beta\, P_{front} + P_{none}},

    the published :math:`P_l + P_r` at beta = 1 and ours, with the visible explanation removed, at beta = 0.
    It is a monotone map of Lambda, whatever context and time say of the priors.

    Parameters
    ----------
    evidence : SignatureEvidence
        Log-likelihoods of the observation.
    co_evidence : CoEvidence
        What the channel that was asked answered.
    reference_prior : sequence of float, shape (K + 2,)
        Probabilities, not logs, of (hidden_1 .. hidden_K, visible, none).

    Returns
    -------
    float
        In [0, 1].

    Raises
    ------
    InvalidArgumentError
        As `abduce`.

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


def _checked_log_prior(log_prior: ArrayLike, directions: int) -> FloatArray:
    prior = np.asarray(log_prior, dtype=np.float64)
    check_shape("log_prior", prior.shape, (directions + 2,))
    if not np.isfinite(prior.max()):
        raise InvalidArgumentError(f"log_prior: expected logs with some mass, got {prior.tolist()}")
    return prior


def _log_likelihood(evidence: SignatureEvidence, co_evidence: CoEvidence) -> FloatArray:
    hidden, visible, none = co_evidence.log_likelihoods()
    log_likelihood = evidence.log_likelihoods
    log_likelihood[:-2] += hidden
    log_likelihood[-2:] += visible, none
    return log_likelihood


def _log_ratio(prior: FloatArray, log_likelihood: FloatArray) -> float:
    hidden, others = prior[:-2], prior[-2:]
    if np.isneginf(hidden).all():
        hidden = np.zeros_like(hidden)
    if np.isneginf(others).all():
        return float("inf")
    hidden_mean = _log_sum(hidden + log_likelihood[:-2]) - _log_sum(hidden)
    return hidden_mean - (_log_sum(others + log_likelihood[-2:]) - _log_sum(others))


def _log_sum(values: FloatArray) -> float:
    """log(sum(exp(values))) without overflow; a sum of nothing possible is -inf."""
    largest = float(values.max())
    if largest == -np.inf:
        return largest
    return largest + float(np.log(np.exp(values - largest).sum()))
