"""Lagged beliefs: each window updates the belief of one window ago, so that no sample counts twice."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from worldstate.ground.serialisation import Keys
from worldstate.ground.typing import FloatArray

from .explanation import AsLogs, ExplanationBelief

# Window ends are rounded to samples and stamps to nanoseconds: two windows end to end differ from one
# window's length by less than this.
SLACK_NS = 5_000_000


@dataclass(frozen=True, slots=True)
class SourceEvidence:
    """Most recent log-likelihoods of one source, (hidden_1 .. hidden_K, visible, none), nats."""

    source: str
    stamp_ns: int
    log_likelihoods: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class LaggedBelief:
    """A belief that shares no samples with the present window, and the evidence of other sources since."""

    stamp_ns: int
    belief: ExplanationBelief
    log_likelihoods: FloatArray


@dataclass(frozen=True, slots=True)
class BeliefLag:
    r"""Past beliefs over one window W; the update starts from the one that is W old.

    .. math:: p_t \propto \Big(\int p(x_t \mid x_{t-W})\, p_{t-W}\, dx_{t-W}\Big)\, \ell(y_t)

    Examples
    --------
    >>> belief = ExplanationBelief.from_priors(2, 0.2, 0.3, 0.5)
    >>> lag = BeliefLag(((0, belief),))
    >>> lag.base("acoustic", 10**9, window_ns=10**9).stamp_ns
    0
    """

    # A window of 1 s every 0.1 s repeats nine tenths of its samples. Multiplying in every window would count
    # each second ten times; raising likelihoods to the power 0.1 would delay a detection by up to a second.
    # Updating the belief of one window ago with the full likelihood makes ten interleaved filters of windows
    # that do not overlap, each of them exact.

    # Time stamps, ns, in order, and the posterior at each.
    beliefs: tuple[Annotated[tuple[int, AsLogs], Keys("stamp_ns", "log_explanations")], ...]
    heard: tuple[SourceEvidence, ...] = ()  # Most recent evidence of each source, sorted by its name

    def base(self, source: str, stamp_ns: int, window_ns: int) -> LaggedBelief:
        """Return the newest belief that is a window old, or the oldest there is."""
        old = [past for past in self.beliefs if past[0] <= stamp_ns - window_ns + SLACK_NS]
        since_ns, belief = old[-1] if old else self.beliefs[0]
        others = np.zeros(belief.k + 2)
        for other in self.heard:
            if other.source != source and other.stamp_ns > since_ns:
                others += other.log_likelihoods
        return LaggedBelief(since_ns, belief, others)

    def add(self, heard: SourceEvidence, belief: ExplanationBelief, window_ns: int) -> "BeliefLag":
        """Return the lag with one more posterior, without those that no later window needs."""
        latest = [past for past in self.beliefs if past[0] < heard.stamp_ns]
        old = sum(stamp_ns <= heard.stamp_ns - window_ns + SLACK_NS for stamp_ns, _ in latest)
        others = [other for other in self.heard if other.source != heard.source]
        return BeliefLag(
            (*latest[max(old - 1, 0) :], (heard.stamp_ns, belief)),
            tuple(sorted([*others, heard], key=lambda evidence: evidence.source)),
        )

    def map(self, change: Callable[[ExplanationBelief], ExplanationBelief]) -> "BeliefLag":
        """Return the lag with a function applied to every belief, as at a hand-over."""
        return replace(self, beliefs=tuple((stamp_ns, change(belief)) for stamp_ns, belief in self.beliefs))
