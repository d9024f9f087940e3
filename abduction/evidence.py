"""Log-likelihoods of one observation under every explanation."""

from dataclasses import dataclass

import numpy as np

from worldstate.ground.checks import finite_array
from worldstate.ground.errors import InvalidArgumentError


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
