r"""Which kind of road user one microphone hears.

.. math:: p_c = \frac{e^{w_c^T x + b_c}}{\sum_k e^{w_k^T x + b_k}}

x are the numbers of one microphone over two seconds. One of the classes is *unknown*: sound in which a
vehicle, if there is one, lies below the ambience.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from math import exp
from typing import TypeAlias

import numpy as np

from worldstate.ground import FloatArray, InvalidArgumentError
from worldstate.ground.checks import all_of, freeze_arrays, in_range, named

UNKNOWN, SIREN = "unknown", "siren"
# As detectors of COCO's classes call them; a van is a car to some and a truck to others.
SEEN_AS = {
    "car": {"car"},
    "van": {"car", "truck"},
    "truck": {"truck", "bus"},
    "motorcycle": {"motorcycle"},
    "bicycle": {"bicycle"},
    "tram": {"train"},
}
ClassShares: TypeAlias = tuple[tuple[str, float], ...]
"""Names of classes with their probabilities, sorted by name."""


def class_shares(name: str, value: object) -> ClassShares:
    """Return classes with their probabilities, sorted; refuse what is none.

    Examples
    --------
    >>> class_shares("classes", [("van", 0.25), ("car", 0.75)])
    (('car', 0.75), ('van', 0.25))
    """
    shares = list[tuple[str, float]]()
    for one in all_of(name, value, tuple, most=64):
        if len(one) != 2:
            raise InvalidArgumentError(f"{name}: expected a class and its probability, got {one!r:.40}")
        label, share = one
        named(name, label)
        shares.append((label, in_range(name, share, 0.0, 1.0)))
    return tuple(sorted(shares))


@dataclass(frozen=True, slots=True, eq=False)
class RoadUserModel:
    """Coefficients of a softmax over kinds of road users.

    Parameters
    ----------
    measures : tuple of str
        Names of what it reads, in their order.
    classes : tuple of str
        Kinds, *unknown* among them.
    weights : ndarray, shape (classes, measures)
        Of the softmax.
    biases : ndarray, shape (classes,)
        Of the softmax; they hold the shares of the classes in use.

    Raises
    ------
    InvalidArgumentError
        If the coefficients do not fit one another or no class is *unknown*.

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

    def __post_init__(self) -> None:
        if UNKNOWN not in self.classes:
            raise InvalidArgumentError(f"classes: expected {UNKNOWN!r} among them, got {self.classes}")
        freeze_arrays(self, weights=(len(self.classes), len(self.measures)), biases=(len(self.classes),))

    def probabilities(self, measures: FloatArray) -> FloatArray:
        r"""Return the probability of every class, shape (n, classes).

        .. math:: p_c \propto e^{w_c^T x + b_c}

        Parameters
        ----------
        measures : ndarray, shape (n, measures)
            Rows.
        """
        logits = measures @ self.weights.T + self.biases
        return np.asarray(np.exp(logits - np.logaddexp.reduce(logits, axis=1, keepdims=True)))

    def classify(self, measures: FloatArray) -> ClassShares:
        """Return the classes of one hop with their probabilities, sorted by name.

        Parameters
        ----------
        measures : ndarray, shape (measures,)
            `AcousticFrame.character`.
        """
        shares = self.probabilities(measures[None])[0].tolist()
        return tuple(sorted(zip(self.classes, shares, strict=True)))


def with_siren(shares: ClassShares, log_odds: float) -> ClassShares:
    r"""Return classes of a sound in which a siren is heard: of the softmax over kinds it is none.

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
    total, names = 0.0, set()
    for name, share in sorted(shares, key=lambda one: -one[1]):
        if total >= mass:
            break
        names.add(name)
        total += share
    return frozenset(names)
