"""A sequence model read hop by hop: what is kept of a stream, and what its last hop says of both sides."""

from dataclasses import dataclass, field
from functools import partial

import numpy as np

from worldstate.ground import FloatArray, InvalidArgumentError, NotUsable
from worldstate.ground.checks import freeze_arrays
from worldstate.ground.serialisation import ADDED, Count

from . import sequence_inputs as inputs
from .sequence_model import GROUPS, HELD_HOPS, SequenceAlarm, SequenceModel
from .street_sides import StreetListener

# Before, what is usual in a street is what was heard just now.
LEAST_HOPS = HELD_HOPS
_ROUNDING = 1e-5  # By which probabilities may miss a sum of one
TOO_FEW = NotUsable(f"less than {LEAST_HOPS} hops of evidence")


@dataclass(frozen=True, slots=True, eq=False)
class SequenceHistory:
    """What is kept of a stream: three seconds of its evidence, a minute of what is usual in its street.

    Examples
    --------
    >>> SequenceHistory().hops
    0
    """

    # shapes (up to 81, 13), as `hop_columns`, and (up to 600, 9), as `streets_own`; the last hop last
    recent: FloatArray = field(default_factory=partial(np.zeros, (0, len(inputs.COLUMNS))))
    minute: FloatArray = field(default_factory=partial(np.zeros, (0, len(inputs.USUAL))))
    missed: Count = field(default=0, metadata=ADDED)  # Hops since the last one that was heard

    def __post_init__(self) -> None:
        # An empty list in a file has no second axis.
        for name, width in (("recent", len(inputs.COLUMNS)), ("minute", len(inputs.USUAL))):
            object.__setattr__(self, name, np.asarray(getattr(self, name)).reshape(-1, width))
        minute = len(self.minute)
        if self.hops > inputs.MEMORY_HOPS or minute > inputs.QUIET_HOPS or self.hops > minute:
            most = f"at most {inputs.MEMORY_HOPS} hops in a minute of {inputs.QUIET_HOPS}"
            raise InvalidArgumentError(f"history: expected {most}, got {self.hops} in {minute}")

    @property
    def hops(self) -> int:
        """Number of hops that are kept, up to eight seconds of them."""
        return len(self.recent)

    def missed_hop(self) -> "SequenceHistory":
        """Return the history one hop on that could not be heard: the seconds before it and after it join.

        Those before are forgotten after three seconds without sound.
        """
        missed = self.missed + 1
        recent = self.recent if missed < inputs.RECENT_HOPS else self.recent[:0]
        return SequenceHistory(recent, self.minute, missed)

    def heard(self, columns: FloatArray) -> "SequenceHistory":
        """Return the history one hop on, of `hop_columns` of one row."""
        recent = np.concatenate([self.recent[1 - inputs.MEMORY_HOPS :], columns])
        minute = np.concatenate([self.minute[1 - inputs.QUIET_HOPS :], inputs.streets_own(columns)])
        return SequenceHistory(recent, minute)


@dataclass(frozen=True, slots=True, eq=False)
class SequenceReading:
    """What the last seconds said of both sides, at the share of hazards that the model was trained at.

    Examples
    --------
    >>> even = np.full(len(GROUPS), 1 / len(GROUPS))
    >>> SequenceReading(np.stack([even, even]), even, margin_s=0.2).groups.shape == (2, len(GROUPS))
    True
    """

    groups: FloatArray  # shape (2, groups): Posterior of the left and the right side
    share: FloatArray  # shape (groups,): The prior in it
    margin_s: float = 0.0
    alarm: SequenceAlarm | None = None

    def __post_init__(self) -> None:
        freeze_arrays(self, groups=(len(inputs.SIDES), len(GROUPS)), share=(len(GROUPS),))
        # As `numpy.allclose`, whose fifty calls take as long as a third of the trees.
        off = np.abs(np.add.reduce(self.groups, 1) - 1.0)
        if np.minimum.reduce(self.groups, None) < 0.0 or np.maximum.reduce(off) > _ROUNDING:
            raise InvalidArgumentError("groups: expected probabilities that sum to one on each side")
        if (self.share <= 0.0).any():
            raise InvalidArgumentError(f"share: expected positive numbers, got {self.share.min()}")


class SequenceReader:
    """Reads a stream hop by hop, what `SequenceModel.posterior` reads of the whole.

    Examples
    --------
    >>> from worldstate.abduction.sequence.sequence_model import BoostedTrees
    >>> stump = dict(split=[[0, 0, 0]], threshold=[[0.5, 0, 0]], yes=[[1, 1, 2]], no=[[2, 1, 2]])
    >>> trees = BoostedTrees(**stump, value=[[0.0, -1.0, 1.0]], tree_class=[0], baseline=[0.0] * len(GROUPS))
    >>> reader = SequenceReader(SequenceModel(trees, np.full(len(GROUPS), 1 / len(GROUPS))))
    >>> hop = np.ones((1, len(inputs.COLUMNS)))
    >>> [isinstance(reader.read(hop), SequenceReading) for _ in range(10)].count(True)
    1
    """

    def __init__(
        self,
        model: SequenceModel,
        history: SequenceHistory | None = None,
        street: StreetListener | None = None,
    ) -> None:
        self._model = model
        self.street = street  # Where sides are learned
        self.history = history or SequenceHistory()  # All that is carried; `Checkpoint` writes it to disk

    def miss(self, hops: int = 1) -> None:
        """Pass hops that could not be heard; nothing is learned from them."""
        # Ten simulated demos, one second lost: the probability that a vehicle comes is off by .04 in the
        # first half second that is heard again and by .02 in the next. With the last hop heard in place of
        # each lost one it was .08 and .03, with nothing kept there was no reading for a second.
        for _ in range(min(hops, inputs.RECENT_HOPS)):
            self.history = self.history.missed_hop()
        if self.street is not None and not self.history.hops:
            self.street.interrupt()

    def read(self, columns: FloatArray, feature: FloatArray | None = None) -> SequenceReading | NotUsable:
        """Take the next hop in; return what it says together with those before.

        `feature` is that of its window, shape (azimuths,), by which the street tells the sides.
        """
        self.history = history = self.history.heard(columns)
        if history.hops < LEAST_HOPS:
            return TOO_FEW
        model = self._model
        groups = model.of_inputs(inputs.last_inputs(history.recent, history.minute)).groups[0]
        if self.street is not None and feature is not None:
            groups = self.street.turned(groups, feature)
        return SequenceReading(groups, model.share, model.margin_s, model.alarm)
