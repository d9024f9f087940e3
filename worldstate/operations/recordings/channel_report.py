"""What was wrong with the microphones of a recording, over all of its hops."""

from dataclasses import dataclass, replace

from worldstate.frontend.frame import AcousticFrame
from worldstate.frontend.health.channel_health import MASKED_FAULTS, ArrayHealth, Fault
from worldstate.frontend.health.dropouts import Dropout
from worldstate.frontend.health.sample_clock import RateEstimate
from worldstate.ground.values import NotUsable, seconds

# What a fault also looks like, before it is known or now and then.
_EXPLAINS = {
    Fault.GUSTS: {Fault.NOISY, Fault.INTERMITTENT, Fault.DEAD, Fault.DELAY, Fault.DRIFT},
    Fault.SWAPPED: {Fault.NOISY},
    Fault.DELAY: {Fault.NOISY},
    Fault.DRIFT: {Fault.NOISY},
}
# Each of them misplaces the others' waves, too: what was seen in most hops is the cause, and what is left
# shows when that is mended.
_MISPLACED = frozenset({Fault.SWAPPED, Fault.DELAY, Fault.DRIFT})
# Dropouts beyond these are counted, not listed.
_LISTED_DROPOUTS = 100


@dataclass(frozen=True, slots=True)
class ChannelVerdict:
    """One fault of one channel over a recording.

    Examples
    --------
    >>> ChannelVerdict(2, Fault.DEAD, 1.0, 1.0, 1.0).masked
    True
    """

    channel: int  # From 0
    fault: Fault  # What is wrong
    share: float  # Of the hops in which it was seen
    first_s: float  # End of the first of these hops, seconds
    value: float  # How wrong, when last seen: see `worldstate.frontend.health.channel_health.ChannelFault`
    looks_like: int | None = None  # Swapped: the channel whose place it fits
    std: float | None = None  # Delayed and drifting: standard deviation of the value

    @property
    def masked(self) -> bool:
        """Whether the front-end leaves such a channel out."""
        return self.fault in MASKED_FAULTS


@dataclass(frozen=True, slots=True)
class RecordingHealth:
    """Everything that was wrong with a recording.

    Examples
    --------
    >>> HealthLog().summary().is_healthy
    True
    """

    verdicts: tuple[ChannelVerdict, ...]  # By channel; empty where nothing was wrong
    dropouts: tuple[Dropout, ...]  # The first hundred
    n_dropouts: int  # All of them
    n_hops: int  # Hops processed
    coherence: float | NotUsable  # At the end: see `worldstate.frontend.health.channel_health.ArrayHealth`
    sample_rate: RateEstimate | NotUsable  # By another clock

    @property
    def is_healthy(self) -> bool:
        """Whether nothing was wrong."""
        rate_is_wrong = isinstance(self.sample_rate, RateEstimate) and self.sample_rate.is_wrong
        return not (self.verdicts or self.n_dropouts or rate_is_wrong)

    @property
    def masked_channels(self) -> tuple[int, ...]:
        """Channels, from 0, that the front-end left out, most of the time or now and then."""
        return tuple(sorted({verdict.channel for verdict in self.verdicts if verdict.masked}))


class HealthLog:
    """Collect what the frames of a recording say about its microphones.

    Examples
    --------
    >>> import numpy as np
    >>> from worldstate.frontend.array.microphone_array import MicrophoneArray
    >>> from worldstate.frontend.stream import FrontEnd
    >>> array = MicrophoneArray([[0, 0.1, 0], [0, 0.0, 0], [0, -0.1, 0]])
    >>> sound = np.random.default_rng(0).standard_normal((24_000, 1)) * [1.0, 1.0, 0.0]
    >>> log = HealthLog()
    >>> for frame in FrontEnd(array, 16_000).process(sound):
    ...     log.add(frame)
    >>> [(verdict.channel, verdict.fault.value) for verdict in log.summary().verdicts]
    [(2, 'dead')]
    """

    def __init__(self) -> None:
        self._n_hops = 0
        self._seen: dict[tuple[int, Fault], ChannelVerdict] = {}
        self._dropouts: list[Dropout] = []
        self._latest: ArrayHealth | None = None

    def add(self, frame: AcousticFrame) -> None:
        """Take one hop; frames without a health report count as healthy."""
        self._n_hops += 1
        health = frame.health
        if isinstance(health, NotUsable):
            return
        n_new = health.n_dropouts - (self._latest.n_dropouts if self._latest else 0)
        self._dropouts.extend(
            health.dropouts[-n_new:] if n_new and len(self._dropouts) < _LISTED_DROPOUTS else ()
        )
        self._latest = health
        for fault in health.faults:
            key = fault.channel, fault.fault
            before = self._seen.get(key)
            # Shares are hops until the summary divides them.
            self._seen[key] = ChannelVerdict(
                channel=fault.channel,
                fault=fault.fault,
                share=1.0 + (before.share if before else 0.0),
                first_s=before.first_s if before else seconds(frame.stamp_ns),
                value=fault.value,
                looks_like=fault.looks_like,
                std=fault.std,
            )

    def summary(self) -> RecordingHealth:
        """Return the verdicts so far."""
        latest = self._latest
        unknown = NotUsable("nothing heard")
        return RecordingHealth(
            verdicts=self._verdicts(),
            dropouts=tuple(self._dropouts[:_LISTED_DROPOUTS]),
            n_dropouts=latest.n_dropouts if latest else 0,
            n_hops=self._n_hops,
            coherence=latest.coherence if latest else unknown,
            sample_rate=latest.sample_rate if latest else unknown,
        )

    def _verdicts(self) -> tuple[ChannelVerdict, ...]:
        ordered = sorted(self._seen.values(), key=lambda verdict: (verdict.channel, verdict.fault))
        explained = {(channel, other) for channel, fault in self._seen for other in _EXPLAINS.get(fault, ())}
        kept = [
            verdict
            for verdict in ordered
            if (verdict.channel, verdict.fault) not in explained and not self._is_other_half(verdict)
        ]
        return tuple(replace(verdict, share=verdict.share / self._n_hops) for verdict in _one_cause(kept))

    def _is_other_half(self, verdict: ChannelVerdict) -> bool:
        """Tell a channel that was called dead while it came and went, or the other way round, mostly that."""
        others = {Fault.DEAD: Fault.INTERMITTENT, Fault.INTERMITTENT: Fault.DEAD}
        other = self._seen.get((verdict.channel, others.get(verdict.fault, verdict.fault)))
        return other is not None and other.fault != verdict.fault and other.share > verdict.share


def _one_cause(verdicts: list[ChannelVerdict]) -> list[ChannelVerdict]:
    """Of misplaced channels, keep those of the fault seen in most hops that were seen in half of these."""
    misplaced = [verdict for verdict in verdicts if verdict.fault in _MISPLACED]
    if any(verdict.fault is Fault.DRIFT for verdict in misplaced):
        # It begins as a delay.
        misplaced = [verdict for verdict in misplaced if verdict.fault is not Fault.DELAY]
    cause = max(misplaced, key=lambda verdict: verdict.share, default=None)
    return [
        verdict
        for verdict in verdicts
        if verdict.fault not in _MISPLACED
        or (cause and verdict.fault is cause.fault and 2.0 * verdict.share >= cause.share)
    ]
