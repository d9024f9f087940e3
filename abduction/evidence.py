"""Log-likelihoods of one observation under every explanation, and the vote of a bearing for a side."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from worldstate.ground import InvalidArgumentError, in_range
from worldstate.ground.checks import all_of

# A window of a second differs by tens of nats between explanations; beyond this, sums lose the digits that
# probabilities consist of.
MOST_NATS = 1000.0


@dataclass(frozen=True, slots=True)
class SideEvidence:
    r"""What one window says of each side by itself: a vehicle on one leaves the other open.

    Parameters
    ----------
    directions : tuple of str
        Labels of the sides.
    log_ratios : tuple of float
        By side, log-likelihood of a vehicle hidden there above that of one in view or none, nats; 0 and less
        where nothing speaks for it.
    both : float
        Posterior of hidden vehicles on both sides at the training prior.
    direct : float
        Posterior of a source in the open, whose bearing says where it is: no side is named then.
    visible : float
        Log-likelihood of one in view above that of none, with a source in the open left aside, nats.

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
        _check_each("log_ratios", self.log_ratios, self.directions)
        _nats(log_ratios=self.log_ratios, visible=(self.visible,))


@dataclass(frozen=True, slots=True)
class SignatureEvidence:
    r"""Log-likelihoods of one observation under every explanation, up to a common constant.

    The hidden explanation has one hypothesis per direction k, so that

    .. math:: \ell_{hid}(y) = \sum_k P(k \mid hid)\, \ell_{hid,k}(y)

    is the integral over the hidden state of eq. (6), with the direction weights carried by the filter.

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
        Each side by itself, where the model tells.

    Raises
    ------
    InvalidArgumentError
        If a log-likelihood is not finite or beyond 1,000 nats, or the numbers do not fit the directions.

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
        labels = all_of("directions", self.directions, str, most=64)
        if not labels or len(set(labels)) != len(labels):
            raise InvalidArgumentError(f"directions: expected different labels, got {labels!r}")
        _check_each("hidden", self.hidden, self.directions)
        *hidden, visible, none = _nats(hidden=self.hidden, visible=(self.visible,), none=(self.none,))
        # Whole numbers among them would make arrays that no likelihood can be added to.
        object.__setattr__(self, "hidden", tuple(hidden))
        object.__setattr__(self, "visible", visible)
        object.__setattr__(self, "none", none)

    @property
    def log_likelihoods(self) -> np.ndarray:
        """The vector (hidden_1 .. hidden_K, visible, none), shape (K + 2,), nats."""
        return np.array([*self.hidden, self.visible, self.none], dtype=np.float64)


def _check_each(name: str, values: object, directions: Sequence[str]) -> None:
    if not isinstance(values, Sequence | np.ndarray) or len(values) != len(directions):
        raise InvalidArgumentError(f"{name}: expected one of each direction, got {values!r:.80}")


def _nats(**named: Sequence[float]) -> list[float]:
    """Return log-likelihoods by name in a row; refuse what is none or too large."""
    return [
        one if type(one) is float and abs(one) <= MOST_NATS else in_range(name, one, -MOST_NATS, MOST_NATS)
        for name, values in named.items()
        for one in values
    ]


# Chance that the peak is an image after all, and the least probability of direct sound that counts.
_IMAGE, _LEAST = 0.02, 0.01


def with_bearing_vote(
    evidence: SignatureEvidence, azimuth_rad: float, std_rad: float, direct: float
) -> SignatureEvidence:
    r"""Return the evidence after a bearing of sound that is direct with a probability d; other sides stay.

    .. math:: L'_{hid} = \min\big(L_{hid},\; (1 - d) L_{hid} + d\, \overline{L}\big), \qquad
              P'(k \mid hid) = (1 - d)\, P(k \mid hid) + d\, P(k \mid \theta), \quad
              P(left \mid \theta) = \tfrac{\epsilon}{2} + (1 - \epsilon)\, \Phi(\theta / \sigma)

    with the mean of the likelihoods of visible and none: the hidden explanation gains nothing on the others,
    and its side is that of the bearing :math:`\theta \pm \sigma`. Reflected sound has no vote: its peak may
    be an image in a wall.

    Examples
    --------
    >>> wrong = SignatureEvidence(("left", "right"), hidden=(-2.0, 4.0), visible=0.0, none=0.0)
    >>> voted = with_bearing_vote(wrong, azimuth_rad=0.7, std_rad=0.1, direct=1.0)
    >>> [round(value, 1) for value in voted.hidden], with_bearing_vote(wrong, 0.7, 0.1, 0.0) == wrong
    ([0.7, -3.9], True)
    """
    if direct < _LEAST or set(evidence.directions) != {"left", "right"}:
        return evidence
    hidden = np.array(evidence.hidden)
    total = float(np.logaddexp(*hidden))
    neutral = float(np.logaddexp(evidence.visible, evidence.none))
    # Log of the sum over two sides, and of the two others: the means differ by the same log 2.
    kept = np.log1p(-direct) if direct < 1.0 else -np.inf
    level = min(total, float(np.logaddexp(kept + total, np.log(direct) + neutral)))
    left = 0.5 * _IMAGE + (1.0 - _IMAGE) * 0.5 * math.erfc(-azimuth_rad / (math.sqrt(2.0) * std_rad))
    by_bearing = np.array([left if side == "left" else 1.0 - left for side in evidence.directions])
    shares = (1.0 - direct) * np.exp(hidden - total) + direct * by_bearing
    return replace(evidence, hidden=tuple((level + np.log(shares)).tolist()))
