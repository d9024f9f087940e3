"""Log-likelihoods of one observation under every explanation, and the vote of a bearing for a side."""

import math
from dataclasses import dataclass, replace

import numpy as np

from worldstate.ground import InvalidArgumentError, finite_array


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
        If a likelihood is not finite or the numbers do not fit the directions.

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
        if not self.directions or len(set(self.directions)) != len(self.directions):
            raise InvalidArgumentError(f"directions: expected different labels, got {self.directions!r}")
        if np.size(self.hidden) != len(self.directions):
            raise InvalidArgumentError(f"hidden: expected one of each direction, got {self.hidden!r:.80}")
        every = (*self.hidden, self.visible, self.none)
        *hidden, visible, none = finite_array("hidden, visible, none", every, (len(every),)).tolist()
        # Whole numbers among them would make arrays that no likelihood can be added to.
        object.__setattr__(self, "hidden", tuple(hidden))
        object.__setattr__(self, "visible", visible)
        object.__setattr__(self, "none", none)

    @property
    def log_likelihoods(self) -> np.ndarray:
        """The vector (hidden_1 .. hidden_K, visible, none), shape (K + 2,), nats."""
        return np.array([*self.hidden, self.visible, self.none], dtype=np.float64)


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
