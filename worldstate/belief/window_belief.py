r"""The belief by single windows: explanations on a Markov chain in continuous time, filtered in log space.

Its states are, in order: hidden in direction 1 .. K, in view having come from direction 1 .. K, in view from
elsewhere, none. All visible states leave at the same rates, so the chain lumps exactly onto (hidden_1 ..
hidden_K, visible, none) and, with equal rates for all directions, onto the three explanations. What the finer
chain adds is whether a source in view is the one that was heard while hidden.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, reduce
from operator import attrgetter
from typing import Annotated, TypeAlias

import numpy as np

from worldstate.abduction.evidence import SignatureEvidence
from worldstate.abduction.sequence.ratio_recursion import transitions
from worldstate.ground import InvalidArgumentError
from worldstate.ground.serialisation import Keys, Via
from worldstate.ground.typing import FloatArray

from .side_belief import SideBelief

RatesHz = tuple[float, ...]
"""arrival (each), emergence, departure, reocclusion (all together), visible arrival, visible departure"""


@lru_cache(maxsize=64)
def generator(rates_hz: RatesHz, directions: int) -> FloatArray:
    r"""Return Q, shape (2K + 2, 2K + 2), 1/s: row i holds the rates out of state i and sums to zero."""
    arrival, emergence, departure, reocclusion, visible_arrival, visible_departure = rates_hz
    hidden, emerged = np.arange(directions), np.arange(directions, 2 * directions)
    elsewhere, none = 2 * directions, 2 * directions + 1
    rate = np.zeros((none + 1, none + 1))
    rate[hidden, emerged] = emergence
    rate[hidden, none] = departure
    rate[directions:none, :directions] = reocclusion / directions
    rate[directions:none, none] = visible_departure
    rate[none, hidden] = arrival
    rate[none, elsewhere] = visible_arrival
    np.fill_diagonal(rate, -rate.sum(axis=1))
    rate.flags.writeable = False
    return rate


@lru_cache(maxsize=256)
def transition(rates_hz: RatesHz, directions: int, step_ns: int) -> FloatArray:
    r"""Return exp(Q dt), shape (2K + 2, 2K + 2), rows sum to one; cached, hops repeat a few lengths only."""
    return transitions(generator(rates_hz, directions), step_ns)


@lru_cache(maxsize=64)
def equilibrium(rates_hz: RatesHz, directions: int) -> FloatArray:
    """Return the distribution that the chain reaches from "none" after a long time, shape (2K + 2,)."""
    settled: FloatArray = transition(rates_hz, directions, 10**12)[-1]
    return settled


# About 1e-261: keeps every log finite, and is far below what the likelihoods of a few windows could raise
# again.
LOG_FLOOR = -600.0
_FLOOR = math.exp(LOG_FLOOR)


# No slots: the probabilities are computed once, and read some sixteen times a step.
@dataclass(frozen=True)
class ExplanationBelief:
    r"""Filtered P(hidden_k), P(in view, come from k), P(in view, from elsewhere) and P(none).

    predict is the Chapman-Kolmogorov step :math:`p \leftarrow p\, e^{Q\,dt}`, update is eq. (6).

    Examples
    --------
    >>> start = ExplanationBelief.settled(2, (0.05, 0.3, 0.1, 0.05, 0.05, 0.3))
    >>> [round(one, 3) for one in start.sides.hypotheses]
    [0.176, 0.235, 0.588]
    """

    log_probabilities: tuple[float, ...]  # In the order of the chain, length 2K + 2, nats

    @classmethod
    def settled(cls, k: int, rates_hz: RatesHz) -> "ExplanationBelief":
        """Return the equilibrium of the rates for K sides, all visible mass from elsewhere."""
        return reduce(cls.forget_origin, range(k), cls(_logs(equilibrium(rates_hz, k))))

    @classmethod
    def from_priors(cls, k: int, hidden: float, visible: float, none: float) -> "ExplanationBelief":
        """Return the belief of three priors, the hidden one divided evenly among K sides."""
        return cls(_logs(np.array([*[hidden / k] * k, *[0.0] * k, visible, none])))

    @property
    def k(self) -> int:
        """Number of approach sides."""
        return len(self.log_probabilities) // 2 - 1

    @cached_property
    def probabilities(self) -> FloatArray:
        """Shape (2K + 2,), in the order of the chain; read-only."""
        probabilities: FloatArray = np.exp(self.log_probabilities)
        probabilities.flags.writeable = False
        return probabilities

    @cached_property
    def sides(self) -> SideBelief:
        """The belief of the sides, which exclude each other here; whether and when one comes is not told."""
        k, each = self.k, tuple(self.probabilities.tolist())
        # A sum of exponentials may exceed one by rounding, which readers of a snapshot refuse.
        hidden, visible, none = (min(sum(one), 1.0) for one in (each[:k], each[k:-1], each[-1:]))
        return SideBelief(each[:k], each[k : 2 * k], each[:k], hidden, (hidden, visible, none))

    def predict(self, rates_hz: RatesHz, step_ns: int) -> "ExplanationBelief":
        """Return the belief after a time step without a measurement."""
        moved = self.probabilities @ transition(rates_hz, self.k, step_ns)
        return ExplanationBelief(_logs(moved / moved.sum()))

    def update(self, evidence: SignatureEvidence, log_co_evidence: FloatArray) -> "ExplanationBelief":
        r"""Return the belief after one window with its co-evidence.

        .. math:: p_i \propto p_i\, \ell_{h(i)}\, p(V \mid h(i))

        with the explanation h of a state: those in view share one.

        Shapes: log_co_evidence (K + 2,).
        """
        told = evidence.log_likelihoods + log_co_evidence
        joint = np.array(self.log_probabilities) + np.repeat(told, [*[1] * self.k, self.k + 1, 1])
        joint -= np.logaddexp.reduce(joint)
        return ExplanationBelief(tuple(np.minimum(np.maximum(joint, LOG_FLOOR), 0.0).tolist()))

    def emerge(self, direction: int, residual: float) -> "ExplanationBelief":
        """Return the belief after a hand-over: the vehicle that was hidden in a direction is in view."""
        # `residual` is P(it was another vehicle). Explanations exclude each other, so that what was believed
        # in the other directions was the same vehicle. It counts as from elsewhere: the entity is seen now,
        # and its existence no longer read from here.
        p, k = self.probabilities.copy(), self.k
        p[2 * k] += (1.0 - residual) * p[:k].sum() + p[k + direction]
        p[:k] *= residual
        p[k + direction] = 0.0
        return ExplanationBelief(_logs(p))

    def forget_origin(self, direction: int) -> "ExplanationBelief":
        """Return the belief with the visible mass that came from a direction counted as from elsewhere."""
        p, k = self.probabilities.copy(), self.k
        p[2 * k] += p[k + direction]
        p[k + direction] = 0.0
        return ExplanationBelief(_logs(p))


# As checkpoints hold it.
AsLogs: TypeAlias = Annotated[
    ExplanationBelief, Via(tuple[float, ...], attrgetter("log_probabilities"), ExplanationBelief)
]


def _logs(probabilities: FloatArray) -> tuple[float, ...]:
    return tuple(np.log(np.maximum(probabilities, _FLOOR)).tolist())


# Window ends are rounded to samples and stamps to nanoseconds: two windows end to end differ from one
# window's length by less than this.
SLACK_NS = 5_000_000


@dataclass(frozen=True, slots=True)
class SourceEvidence:
    """Most recent log-likelihoods of one source, (hidden_1 .. hidden_K, visible, none), nats."""

    source: str
    stamp_ns: int
    log_likelihoods: tuple[float, ...]


# No slots: what is read of the sides is computed once.
@dataclass(frozen=True)
class WindowBelief:
    r"""The belief and its past of one window W; an update starts from the one that is W old.

    .. math:: p_t \propto \Big(\int p(x_t \mid x_{t-W})\, p_{t-W}\, dx_{t-W}\Big)\, \ell(y_t)

    Examples
    --------
    >>> start = ExplanationBelief.from_priors(2, 0.2, 0.3, 0.5)
    >>> heard = SignatureEvidence(("left", "right"), (2.0, 0.0), 0.0, 0.0)
    >>> said = "acoustic", 10**9, heard, np.zeros(4), (0.05, 0.3, 0.1, 0.05, 0.05, 0.3)
    >>> belief, predicted = WindowBelief(start, ((0, start),)).update(*said, window_ns=10**9)
    >>> [round(one.sides.hidden[0], 2) for one in (predicted, belief.now)]
    [0.09, 0.43]
    """

    # A window of 1 s every 0.1 s repeats nine tenths of its samples. Multiplying in every window would count
    # each second ten times; raising likelihoods to the power 0.1 would delay a detection by up to a second.
    # Updating the belief of one window ago with the full likelihood makes ten interleaved filters of windows
    # that do not overlap, each of them exact.

    now: AsLogs = field(metadata={"key": "log_explanations"})
    # Time stamps, ns, in order, and the posterior at each.
    past: tuple[Annotated[tuple[int, AsLogs], Keys(("stamp_ns", "log_explanations"))], ...]
    heard: tuple[SourceEvidence, ...] = ()  # Most recent evidence of each source, sorted by its name

    @property
    def sides(self) -> SideBelief:
        """What is believed of the sides now."""
        return self.now.sides

    def check(self, directions: int) -> None:
        """Refuse what a file cannot have been written with, for so many approach sides."""
        states = [len(one.log_probabilities) for one in (self.now, *(past for _, past in self.past))]
        explanations = [len(one.log_likelihoods) for one in self.heard]
        if set(states) != {2 * directions + 2} or set(explanations) - {directions + 2} or not self.past:
            raise InvalidArgumentError(f"memory.belief: expected {directions} sides, and its past")

    def since(self, stamp_ns: int) -> "WindowBelief":
        """Return the belief without evidence of before a time."""
        heard = tuple(one for one in self.heard if one.stamp_ns >= stamp_ns)
        return self if len(heard) == len(self.heard) else replace(self, heard=heard)

    def predict(self, rates_hz: RatesHz, step_ns: int) -> "WindowBelief":
        """Return the belief after a time step without a window."""
        return replace(self, now=self.now.predict(rates_hz, step_ns))

    def update(
        self,
        source: str,
        stamp_ns: int,
        evidence: SignatureEvidence,
        log_co_evidence: FloatArray,
        rates_hz: RatesHz,
        window_ns: int,
    ) -> tuple["WindowBelief", ExplanationBelief]:
        """Return the belief after one window with its looks, and what was predicted for it.

        Shapes: log_co_evidence (K + 2,).
        """
        old = sum(past_ns <= stamp_ns - window_ns + SLACK_NS for past_ns, _ in self.past)
        first, others = max(old - 1, 0), np.zeros_like(log_co_evidence)
        # The newest belief that is a window old, and the evidence of others since.
        base_ns, belief = self.past[first]
        sources = [other for other in self.heard if other.source != source]
        for other in sources:
            if other.stamp_ns > base_ns:
                others += other.log_likelihoods
        prior = belief.predict(rates_hz, stamp_ns - base_ns)
        after = prior.update(evidence, log_co_evidence + others)
        # -inf would stay for the length of the window and cannot be written as JSON.
        own = np.maximum(evidence.log_likelihoods + log_co_evidence, LOG_FLOOR)
        heard = SourceEvidence(source, stamp_ns, tuple(own.tolist()))
        # Beliefs that no later window needs are left out.
        latest = [past for past in self.past if past[0] < stamp_ns]
        past = (*latest[first:], (stamp_ns, after))
        return WindowBelief(after, past, tuple(sorted([*sources, heard], key=attrgetter("source")))), prior

    def map(self, change: Callable[[ExplanationBelief], ExplanationBelief]) -> "WindowBelief":
        """Return the belief with a function applied to it and to its past, which later windows build on."""
        past = tuple((stamp_ns, change(belief)) for stamp_ns, belief in self.past)
        return replace(self, now=change(self.now), past=past)
