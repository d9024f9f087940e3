r"""Classes of a window, and the evidence for the explanations from their posteriors, for any classifier.

A window may contain a hidden vehicle on *both* sides or a *direct* sound: one plane wave from a source in the
open. Half of the first is assigned to each side; the second is equally likely under every explanation,

.. math:: P'_{left} = P_{left} + \tfrac{1}{2} P_{both} + P_{direct}\, \frac{\pi'_{left}}{\sum_k \pi'_k},
          \qquad \pi'_{left} = \pi_{left} + \tfrac{1}{2} \pi_{both},

so that a direct sound does not change the likelihood ratios; its bearing gives its side.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from worldstate.abduction.evidence import SideEvidence, SignatureEvidence
from worldstate.ground import FloatArray, InvalidArgumentError, finite_array

CLASSES = ("front", "left", "none", "right")
DIRECTIONS = ("left", "right")
FRONT, LEFT, NONE, RIGHT = range(len(CLASSES))
# Columns of the posteriors in the order of the explanations: hidden left, hidden right, visible, none.
EXPLANATION_COLUMNS = (LEFT, RIGHT, FRONT, NONE)

# As in libsvm: no probability is 0 or 1, so no log-likelihood is infinite.
SMALLEST_PROBABILITY = 1e-7

BOTH, DIRECT = "both", "direct"
WINDOW_CLASSES = (*CLASSES, BOTH, DIRECT)
_MIRRORED = {LEFT: RIGHT, RIGHT: LEFT}
_IS_SIDE = np.isin(range(len(CLASSES)), (LEFT, RIGHT)).astype(float)


def hazard_statistic(probabilities: ArrayLike, miss_rate: float = 1.0) -> FloatArray:
    r"""Return the hidden posterior, eq. (6), at the training prior for many windows, shape (n,).

    .. math:: s = \frac{P_l + P_r}{P_l + P_r + \beta\, P_{front} + P_{none}}

    Shapes: probabilities (n, 4).
    """
    posteriors = finite_array("probabilities", probabilities, (None, len(CLASSES)))
    hazard = posteriors[:, LEFT] + posteriors[:, RIGHT]
    return np.asarray(hazard / (hazard + miss_rate * posteriors[:, FRONT] + posteriors[:, NONE]))


def evidence_of(
    posteriors: FloatArray, class_prior: FloatArray, sides: SideEvidence | None = None
) -> SignatureEvidence:
    r"""Return the log-likelihoods of one window from its posteriors at the training prior.

    .. math:: \log \ell_c = \log P_c - \log \pi_c

    Shapes: posteriors (1, 4), class_prior (4,).

    References
    ----------
    Bayes' rule; H. Bourlard and N. Morgan, *Connectionist Speech Recognition*, 1994 (scaled likelihoods).

    Examples
    --------
    >>> [round(one, 2) for one in evidence_of(np.array([[0.1, 0.4, 0.4, 0.1]]), np.full(4, 0.25)).hidden]
    [0.47, -0.92]
    """
    ratios = np.log(posteriors) - np.log(class_prior)
    left, right, visible, none = ratios[0, list(EXPLANATION_COLUMNS)].tolist()
    return SignatureEvidence(DIRECTIONS, (left, right), visible, none, sides)


def checked_classes(classes: tuple[str, ...]) -> tuple[str, ...]:
    """Return the classes of a model after a check: the four basic ones, then both and direct if present."""
    more = tuple(name for name in WINDOW_CLASSES[len(CLASSES) :] if name in classes)
    if classes != CLASSES + more:
        raise InvalidArgumentError(f"classes: expected {CLASSES} and then both, direct, got {classes!r:.80}")
    return classes


def mirrored_classes(n_classes: int) -> list[int]:
    """Return the column of each class in the mirrored scene: only left and right are exchanged."""
    return [_MIRRORED.get(column, column) for column in range(n_classes)]


def explained(shares: FloatArray, classes: tuple[str, ...], prior: FloatArray) -> FloatArray:
    r"""Return posteriors (or the prior) of all classes as those of front, left, none and right, shape (n, 4).

    .. math:: P'_k = P_k + \tfrac{1}{2} P_{both} [k \text{ a side}] + P_{direct}\, \pi'_k / \sum \pi'

    Shapes: shares (n, classes), prior (classes,).

    Examples
    --------
    >>> window = np.array([[0.0, 0.5, 0.0, 0.0, 0.5, 0.0], [0.0, 0.0, 0.0, 0.0, 0.0, 1.0]])
    >>> explained(window, WINDOW_CLASSES, np.full(6, 1 / 6)).round(2)
    array([[0.  , 0.75, 0.  , 0.25],
           [0.2 , 0.3 , 0.2 , 0.3 ]])
    """
    (four, both, direct), (known, known_both, _) = _six(shares, classes), _six(prior[None], classes)
    usual = (known + 0.5 * known_both * _IS_SIDE)[0]
    return np.asarray(four + 0.5 * both * _IS_SIDE + direct * (usual / np.add.reduce(usual)))


def side_ratios(posteriors: FloatArray, classes: tuple[str, ...], prior: FloatArray) -> FloatArray:
    r"""Return the log ratios of a hidden vehicle on the left and on the right, shape (n, 2), nats.

    .. math:: \lambda_k = \log \frac{P_k + P_{both}}{\pi_k + \pi_{both}}
              - \log \Big( \frac{P_{front}}{\pi_{front}} + \frac{P_{none}}{\pi_{none}} \Big)

    A direct sound is equally likely under each. The sides do not exclude each other.

    Shapes: posteriors (n, classes), prior (classes,).

    Examples
    --------
    >>> window = np.array([[0.05, 0.05, 0.05, 0.05, 0.8, 0.0]])
    >>> side_ratios(window, WINDOW_CLASSES, np.full(6, 1 / 6)).round(2)
    array([[1.45, 1.45]])
    """
    (four, both, direct), of_prior = _six(posteriors, classes), _six(prior[None], classes)
    known, known_both, known_direct = of_prior
    told = 1.0 - known_direct
    sides = (four[:, [LEFT, RIGHT]] + both) / (known[:, [LEFT, RIGHT]] + known_both)
    rest = four[:, [FRONT, NONE]] / known[:, [FRONT, NONE]] * told + direct
    return np.asarray(np.log(sides * told + direct) - np.log(rest[:, :1] + rest[:, 1:]))


def visible_ratios(posteriors: FloatArray, prior: FloatArray) -> FloatArray:
    r"""Return the log ratio of a visible vehicle to none, shape (n,), nats.

    .. math:: \log \frac{P_{front}}{\pi_{front}} - \log \frac{P_{none}}{\pi_{none}}

    Shapes: posteriors (n, classes), prior (classes,).

    Examples
    --------
    >>> visible_ratios(np.array([[0.4, 0.2, 0.2, 0.2]]), np.full(4, 0.25)).round(2)
    array([0.69])
    """
    ratios = posteriors[:, [FRONT, NONE]] / prior[[FRONT, NONE]]
    return np.asarray(np.log(ratios[:, 0]) - np.log(ratios[:, 1]))


def window_evidence(posteriors: FloatArray, classes: tuple[str, ...], prior: FloatArray) -> SignatureEvidence:
    """Return the evidence of one window from its posteriors at the training prior.

    Shapes: posteriors (1, classes), prior (classes,).

    Examples
    --------
    >>> window = np.array([[0.05, 0.6, 0.05, 0.1, 0.1, 0.1]])
    >>> sides = window_evidence(window, WINDOW_CLASSES, np.full(6, 1 / 6)).sides
    >>> sides.both, sides.direct, sides.log_ratios[0] > sides.log_ratios[1]
    (0.1, 0.1, True)
    """
    seen, known = [explained(one, classes, prior) for one in (posteriors, prior[None])]
    left, right = side_ratios(posteriors, classes, prior)[0].tolist()
    visible = visible_ratios(posteriors, prior).item()
    _, both, direct = _six(posteriors, classes)
    sides = SideEvidence(DIRECTIONS, (left, right), both.item(), direct.item(), visible)
    return evidence_of(seen, known[0], sides)


@lru_cache
def _columns(classes: tuple[str, ...]) -> list[int]:
    return [WINDOW_CLASSES.index(name) for name in classes]


def _six(shares: FloatArray, classes: tuple[str, ...]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the shares of the four basic classes, of both and of direct; zero for missing classes."""
    every = np.zeros((len(shares), len(WINDOW_CLASSES)))
    every[:, _columns(classes)] = shares
    n = len(CLASSES)
    return every[:, :n], every[:, n : n + 1], every[:, n + 1 :]
