r"""The vote of a bearing for a side, where sound is direct: elsewhere a peak may be an image in a wall.

With the probability d that it is direct, the hidden explanation says no more than the others do, and its side
is that of the bearing :math:`\theta \pm \sigma`:

.. math:: L'_{hid} = \min\big(L_{hid},\; (1 - d) L_{hid} + d\, \overline{L}\big), \qquad
          P'(k \mid hid) = (1 - d)\, P(k \mid hid) + d\, P(k \mid \theta), \quad
          P(left \mid \theta) = \tfrac{\epsilon}{2} + (1 - \epsilon)\, \Phi(\theta / \sigma)

with the mean of the likelihoods of visible and none.
"""

import math
from dataclasses import replace

import numpy as np

from .evidence import SignatureEvidence

# Chance that the peak is an image after all, and the least probability of direct sound that counts.
_IMAGE, _LEAST = 0.02, 0.01


def with_bearing_vote(
    evidence: SignatureEvidence, azimuth_rad: float, std_rad: float, direct: float
) -> SignatureEvidence:
    """Return the evidence after a bearing of sound that is direct with a probability; other sides stay.

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
