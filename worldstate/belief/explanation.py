"""The belief over explanations, carried through time in log space."""

from dataclasses import dataclass, replace

import numpy as np

from worldstate.abduction.co_evidence import Unqueried
from worldstate.abduction.evidence import SignatureEvidence
from worldstate.abduction.posterior import Posterior, abduce
from worldstate.ground.typing import FloatArray

from .markov_chain import RatesHz, equilibrium, transition

# Keeps every log finite: about 1e-261, far below anything that a likelihood could bring back in time.
LOG_FLOOR = -600.0

_FOLDED_IN = Unqueried("already weighed into the prior")


@dataclass(frozen=True, slots=True)
class ExplanationBelief:
    r"""P(hidden_k), P(in view, come from k), P(in view, from elsewhere), P(none), given all so far.

    predict is the Chapman-Kolmogorov step :math:`p \leftarrow p\, e^{Q\,dt}`, update is eq. (6).

    Examples
    --------
    >>> start = ExplanationBelief.settled(("left", "right"), (0.05, 0.3, 0.1, 0.05, 0.05, 0.3))
    >>> round(start.hidden_total, 3), round(start.visible, 3), round(start.none, 3)
    (0.176, 0.235, 0.588)
    """

    directions: tuple[str, ...]  # The K approach sides
    log_probabilities: tuple[float, ...]  # In the order of `chain`, length 2K + 2, nats

    @classmethod
    def settled(cls, directions: tuple[str, ...], rates_hz: RatesHz) -> "ExplanationBelief":
        """Return the equilibrium of the rates, with nothing yet known to have come from a side."""
        return cls(directions, _logs(equilibrium(rates_hz, len(directions))))._disowned()

    @classmethod
    def from_priors(
        cls, directions: tuple[str, ...], hidden: float, visible: float, none: float
    ) -> "ExplanationBelief":
        """Return the three given priors, the hidden one spread evenly over the directions."""
        k = len(directions)
        return cls(directions, _logs(np.array([*[hidden / k] * k, *[0.0] * k, visible, none])))

    @property
    def probabilities(self) -> FloatArray:
        """Shape (2K + 2,), in the order of `chain`."""
        return np.exp(self.log_probabilities)

    @property
    def hidden(self) -> tuple[float, ...]:
        """P(hidden in direction k)."""
        return tuple(self.probabilities[: len(self.directions)].tolist())

    @property
    def emerged(self) -> tuple[float, ...]:
        """P(in view, having come from direction k)."""
        k = len(self.directions)
        return tuple(self.probabilities[k : 2 * k].tolist())

    @property
    def hidden_total(self) -> float:
        """P(hidden): the first of the paper's three explanations."""
        return float(self.probabilities[: len(self.directions)].sum())

    @property
    def visible(self) -> float:
        """P(visible)."""
        return float(self.probabilities[len(self.directions) : -1].sum())

    @property
    def none(self) -> float:
        """P(none)."""
        return float(np.exp(self.log_probabilities[-1]))

    def predict(self, rates_hz: RatesHz, step_ns: int) -> "ExplanationBelief":
        """Return the belief after a time step without a measurement."""
        moved = self.probabilities @ transition(rates_hz, len(self.directions), step_ns)
        return replace(self, log_probabilities=_logs(moved / moved.sum()))

    def update(
        self,
        evidence: SignatureEvidence,
        log_co_evidence: FloatArray,
    ) -> "ExplanationBelief":
        """Return the belief after one look.

        Shapes: log_co_evidence (K + 2,).
        """
        k = len(self.directions)
        parts = np.array(self.log_probabilities[k:-1])
        visible = np.logaddexp.reduce(parts)
        prior = np.array([*self.log_probabilities[:k], visible, self.log_probabilities[-1]])
        seen: Posterior = abduce(prior + log_co_evidence, evidence, _FOLDED_IN)
        posterior = np.array(seen.log_probabilities)
        spread = np.concatenate([posterior[:k], parts + (posterior[-2] - visible), posterior[-1:]])
        return replace(self, log_probabilities=tuple(np.clip(spread, LOG_FLOOR, 0.0).tolist()))

    def emerge(self, direction: int, residual: float) -> "ExplanationBelief":
        """Return the belief once vision has the vehicle of a direction: its mass is in view now."""
        # `residual` is the share that stays hidden: the sighting may have been of another vehicle.
        p, k = self.probabilities, len(self.directions)
        moved = p[direction] * (1.0 - residual)
        p[direction] -= moved
        p[2 * k] += moved + p[k + direction]
        p[k + direction] = 0.0
        return replace(self, log_probabilities=_logs(p))

    def disown(self, direction: int) -> "ExplanationBelief":
        """Return the belief with whatever came into view from a direction counted as from elsewhere."""
        p, k = self.probabilities, len(self.directions)
        p[2 * k] += p[k + direction]
        p[k + direction] = 0.0
        return replace(self, log_probabilities=_logs(p))

    def _disowned(self) -> "ExplanationBelief":
        belief = self
        for direction in range(len(self.directions)):
            belief = belief.disown(direction)
        return belief


def _logs(probabilities: FloatArray) -> tuple[float, ...]:
    with np.errstate(divide="ignore"):
        return tuple(np.maximum(np.log(probabilities), LOG_FLOOR).tolist())
