"""Application of a sequence model to a stream, hop by hop."""

from dataclasses import dataclass, field
from functools import partial

import numpy as np

from worldstate.ground import FloatArray, InvalidArgumentError, NotUsable
from worldstate.ground.checks import freeze_arrays
from worldstate.ground.serialisation import ADDED, Count

from . import sequence_inputs as inputs
from .sequence_model import GROUPS, HELD_HOPS, SequenceAlarm, SequenceModel
from .street_sides import StreetListener

# With fewer hops, the usual values of a street would be those of the current sound.
LEAST_HOPS = HELD_HOPS
_ROUNDING = 1e-5  # Tolerated error of the sum of probabilities
TOO_FEW = NotUsable(f"less than {LEAST_HOPS} hops of evidence")


@dataclass(frozen=True, slots=True, eq=False)
class SequenceHistory:
    """Stored part of a stream: eight seconds of its evidence and a minute of the columns `USUAL`.

    Examples
    --------
    >>> SequenceHistory().hops
    0
    """

    # Shapes (up to 81, 13), see `hop_columns`, and (up to 600, 9), see `streets_own`; the last hop is last.
    recent: FloatArray = field(default_factory=partial(np.zeros, (0, len(inputs.COLUMNS))))
    minute: FloatArray = field(default_factory=partial(np.zeros, (0, len(inputs.USUAL))))
    missed: Count = field(default=0, metadata=ADDED)  # Hops since the last usable one

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
        """Number of stored hops, at most those of eight seconds."""
        return len(self.recent)

    def missed_hop(self) -> "SequenceHistory":
        """Return the history after an unusable hop; the hops before and after it become adjacent.

        After three seconds without usable hops the recent evidence is deleted.
        """
        missed = self.missed + 1
        recent = self.recent if missed < inputs.RECENT_HOPS else self.recent[:0]
        return SequenceHistory(recent, self.minute, missed)

    def heard(self, columns: FloatArray) -> "SequenceHistory":
        """Return the history after one more hop, given by its row of `hop_columns`."""
        recent = np.concatenate([self.recent[1 - inputs.MEMORY_HOPS :], columns])
        minute = np.concatenate([self.minute[1 - inputs.QUIET_HOPS :], inputs.streets_own(columns)])
        return SequenceHistory(recent, minute)


@dataclass(frozen=True, slots=True, eq=False)
class SequenceReading:
    """Posterior of both sides from the last seconds, at the share of hazards in the model's training.

    Examples
    --------
    >>> even = np.full(len(GROUPS), 1 / len(GROUPS))
    >>> SequenceReading(np.stack([even, even]), even, margin_s=0.2).groups.shape == (2, len(GROUPS))
    True
    """

    groups: FloatArray  # shape (2, groups): Posterior of the left and the right side
    share: FloatArray  # shape (groups,): Prior of the posterior
    margin_s: float = 0.0
    alarm: SequenceAlarm | None = None

    def __post_init__(self) -> None:
        freeze_arrays(self, groups=(len(inputs.SIDES), len(GROUPS)), share=(len(GROUPS),))
        # `numpy.allclose` makes fifty calls, which take a third of the time of the trees.
        off = np.abs(np.add.reduce(self.groups, 1) - 1.0)
        if np.minimum.reduce(self.groups, None) < 0.0 or np.maximum.reduce(off) > _ROUNDING:
            raise InvalidArgumentError("groups: expected probabilities that sum to one on each side")
        if (self.share <= 0.0).any():
            raise InvalidArgumentError(f"share: expected positive numbers, got {self.share.min()}")


class SequenceReader:
    """Computes hop by hop the posterior that `SequenceModel.posterior` computes for a whole stream.

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
        self.street = street  # Learns the sides of a street
        self.history = history or SequenceHistory()  # The whole state; `Checkpoint` writes it to disk

    def miss(self, hops: int = 1) -> None:
        """Skip unusable hops without learning from them."""
        # In ten simulated demos with one second lost, the probability of an approaching vehicle is off by
        # 0.04 in the first usable half second and by 0.02 in the next. With each lost hop replaced by the
        # last usable one the errors were 0.08 and 0.03; without a history there was no result for a second.
        for _ in range(min(hops, inputs.RECENT_HOPS)):
            self.history = self.history.missed_hop()
        if self.street is not None and not self.history.hops:
            self.street.interrupt()

    def read(self, columns: FloatArray, feature: FloatArray | None = None) -> SequenceReading | NotUsable:
        """Add the next hop and return the posterior of the last seconds.

        `feature`, shape (azimuths,), is that of the hop's window; the street's patterns apply to it.
        """
        self.history = history = self.history.heard(columns)
        if history.hops < LEAST_HOPS:
            return TOO_FEW
        model = self._model
        groups = model.of_inputs(inputs.last_inputs(history.recent, history.minute)).groups[0]
        if self.street is not None and feature is not None:
            groups = self.street.turned(groups, feature)
        return SequenceReading(groups, model.share, model.margin_s, model.alarm)
