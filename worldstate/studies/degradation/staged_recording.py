"""A recording whose camera was staged in several states: a few numbers a hop and state."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.ground.checks import check_shape, finite_array
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import BoolArray, FloatArray, IntArray
from worldstate.operations.recordings.hop_stream import HopStream


@dataclass(frozen=True, slots=True, eq=False)
class StagedRecording:
    """One recording in S states of its camera, n hops each."""

    name: str  # Of the recording; label ``"none"`` where it is hazard-free
    label: str
    t0_s: float  # Line-of-sight entry; NaN where there is none
    states: tuple[str, ...]  # Names of the states
    time_s: FloatArray  # shape (n,): End of each window
    there: BoolArray  # shape (n,): Whether a moving object is in view, by the reference
    approach: FloatArray  # shape (n,): As in `HopStream`
    log_likelihoods: FloatArray  # shape (n, K + 2): As in `HopStream`
    answer: IntArray  # shape (S, n): As in `HopStream`
    miss_rate: FloatArray
    clutter_rate: FloatArray
    seen: BoolArray
    degradation: FloatArray  # shape (S, n): d as it was estimated
    presence: FloatArray  # shape (S, n): P(hidden) + P(visible) of the filter
    # shape (S, n): Whether a moving object that is in view, by the reference, was detected; `seen` takes
    # any detection.
    found: BoolArray

    def __post_init__(self) -> None:
        shape = len(self.states), np.size(self.time_s)
        for name in _BY_STATE:
            check_shape(name, np.shape(getattr(self, name)), shape)
        for name in ("degradation", "presence"):
            finite_array(name, getattr(self, name), shape)
        for i in range(len(self.states)):
            self._stream(i)  # which checks the rest

    @classmethod
    def of(
        cls,
        streams: Sequence[HopStream],
        states: Sequence[str],
        *,
        degradation: FloatArray,
        presence: FloatArray,
        found: BoolArray,
    ) -> "StagedRecording":
        """Return the streams of one recording, one a state, in one piece."""
        if not streams:
            raise InvalidArgumentError("streams: expected at least one state")
        first = streams[0]
        return cls(
            name=first.name,
            label=first.label,
            t0_s=first.t0_s,
            states=tuple(states),
            **{name: getattr(first, name) for name in _SHARED},
            **{name: np.stack([getattr(stream, name) for stream in streams]) for name in _STACKED},
            degradation=degradation,
            presence=presence,
            found=found,
        )

    @property
    def hazard_free(self) -> bool:
        """Whether nothing approaches."""
        return self.label == "none"

    def index(self, state: str) -> int:
        """Return the row of a state."""
        if state not in self.states:
            raise InvalidArgumentError(f"state: expected one of {', '.join(self.states)}, got {state:.40}")
        return self.states.index(state)

    def stream(self, state: str) -> HopStream:
        """Return the stream of one state."""
        return self._stream(self.index(state))

    @property
    def after_sight(self) -> BoolArray:
        """Hops after T0 with the vehicle in view, shape (n,)."""
        stream = self._stream(0)
        return np.asarray(stream.there & ~stream.before_sight) & (not self.hazard_free)

    def _stream(self, row: int) -> HopStream:
        return HopStream(
            name=self.name,
            label=self.label,
            t0_s=self.t0_s,
            **{name: getattr(self, name) for name in _SHARED},
            **{name: getattr(self, name)[row] for name in _STACKED},
        )


_SHARED = ("time_s", "there", "approach", "log_likelihoods")
_STACKED = ("answer", "miss_rate", "clutter_rate", "seen")
_BY_STATE = (*_STACKED, "degradation", "presence", "found")
