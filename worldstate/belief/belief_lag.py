"""The beliefs of the last window, so that windows which overlap are not counted twice."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from worldstate.ground.typing import FloatArray

from .explanation import ExplanationBelief

# Window ends are rounded to samples and stamps to nanoseconds; a window's length apart is that, give or take.
SLACK_NS = 5_000_000


@dataclass(frozen=True, slots=True)
class SourceEvidence:
    """What one source said last: log-likelihoods of (hidden_1 .. hidden_K, visible, none), nats."""

    source: str
    stamp_ns: int
    log_likelihoods: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class LaggedBelief:
    """A belief that shares no samples with the present window, and what other sources said since."""

    stamp_ns: int
    belief: ExplanationBelief
    log_likelihoods: FloatArray


@dataclass(frozen=True, slots=True)
class BeliefLag:
    r"""Past beliefs, the oldest at least one window old.

    .. math:: p_t \propto \Big(\int p(x_t \mid x_{t-W})\, p_{t-W}\, dx_{t-W}\Big)\, \ell(y_t),

    Examples
    --------
    >>> belief = ExplanationBelief.from_priors(("left", "right"), 0.2, 0.3, 0.5)
    >>> trail = BeliefLag(((0, belief),))
    >>> trail.base("acoustic", 10**9, window_ns=10**9).stamp_ns
    0
    """

    # A 1-s window every 0.1 s repeats nine tenths of its samples. Multiplied in at every hop, one second of
    # sound would be believed ten times over; raised to the power 0.1, a window would take a second to be
    # heard. So each window is counted in full, onto the belief of one window ago,
    #
    # which makes ten interleaved filters of windows that do not overlap, each an exact one.

    beliefs: tuple[tuple[int, ExplanationBelief], ...]  # Time stamps, ns, in order, and the posterior at each
    heard: tuple[SourceEvidence, ...] = ()  # The last word of each source, sorted by its name

    def base(self, source: str, stamp_ns: int, window_ns: int) -> LaggedBelief:
        """Return the newest belief that is a window old, or the oldest there is."""
        old = [past for past in self.beliefs if past[0] <= stamp_ns - window_ns + SLACK_NS]
        since_ns, belief = old[-1] if old else self.beliefs[0]
        others = np.zeros(len(belief.directions) + 2)
        for word in self.heard:
            if word.source != source and word.stamp_ns > since_ns:
                others += word.log_likelihoods
        return LaggedBelief(since_ns, belief, others)

    def add(self, heard: SourceEvidence, belief: ExplanationBelief, window_ns: int) -> "BeliefLag":
        """Return the trail after a posterior, without what no later window will need."""
        latest = [past for past in self.beliefs if past[0] < heard.stamp_ns]
        old = sum(stamp_ns <= heard.stamp_ns - window_ns + SLACK_NS for stamp_ns, _ in latest)
        words = [other for other in self.heard if other.source != heard.source]
        return BeliefLag(
            (*latest[max(old - 1, 0) :], (heard.stamp_ns, belief)),
            tuple(sorted([*words, heard], key=lambda word: word.source)),
        )

    def map(self, change: Callable[[ExplanationBelief], ExplanationBelief]) -> "BeliefLag":
        """Return the trail with a change made to every belief, as when vision takes a vehicle over."""
        return replace(self, beliefs=tuple((stamp_ns, change(belief)) for stamp_ns, belief in self.beliefs))
