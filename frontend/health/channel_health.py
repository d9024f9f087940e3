"""Faults of channels and the health of an array, as values."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from worldstate.frontend.array.microphone_array import ChannelMask
from worldstate.ground import BoolArray, FloatArray, NotUsable

from .dropouts import Dropout


class Fault(StrEnum):
    """Kinds of faults of one channel.

    Examples
    --------
    >>> Fault("dead").name, len(Fault)
    ('DEAD', 11)
    """

    DEAD = "dead"
    """Constant, or 30 dB below the median channel."""
    INTERMITTENT = "intermittent"
    """Silent or crackling in several stretches of hops."""
    NOISY = "noisy"
    """Incoherent with the prediction from the other channels."""
    INVERTED = "inverted"
    """Fits its position with the opposite sign: crossed leads."""
    SWAPPED = "swapped"
    """Fits the position of another microphone better than its own."""
    CLIPPED = "clipped"
    """Samples pile up at one extreme value."""
    OFFSET = "offset"
    """A mean that is not small against the sound."""
    LEVEL = "level"
    """Louder or quieter than the median channel by more than microphones differ."""
    GUSTS = "gusts"
    """Much louder than the others for half a second to seconds, now and then: wind at this microphone."""
    DELAY = "delayed"
    """Later or earlier than sound from any direction, by an amount that stays the same."""
    DRIFT = "drifting"
    """Later and later, or earlier and earlier: a card with a clock of its own."""


MASKED_FAULTS = frozenset(Fault) - {Fault.CLIPPED, Fault.OFFSET, Fault.LEVEL, Fault.GUSTS}
"""Faults for which a channel is left out. The others leave its phase intact, which is all that PHAT uses."""


@dataclass(frozen=True, slots=True)
class ChannelFault:
    """One fault of one channel.

    Parameters
    ----------
    channel : int
        From 0, in the order of the array.
    fault : Fault
        What is wrong.
    value : float
        Size of the fault. Dead and intermittent: share of the last five seconds. Noisy and inverted:
        coherence with the prediction from the other channels, over the median channel's. Swapped: gain in
        that coherence at the other position, -2 to 2. Clipped: share of samples. Offset: mean over the
        peak-to-peak value. Level: dB relative to the median channel. Gusts: share of the last ten seconds.
        Delayed: seconds. Drifting: seconds a second. Swapped, up to 16 channels: gain in sharpness, nats.
    looks_like : int or None
        Swapped: the channel whose position it fits.
    std : float or None
        Delayed and drifting: standard deviation of `value`.

    Examples
    --------
    >>> ChannelFault(3, Fault.SWAPPED, 0.8, looks_like=7).fault.value
    'swapped'
    """

    channel: int
    fault: Fault
    value: float
    looks_like: int | None = None
    std: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ArrayHealth:
    """Health of an array at the end of a hop.

    Parameters
    ----------
    mask : ChannelMask
        Microphones that count in this hop.
    faults : tuple of ChannelFault
        Present faults by channel; a channel may have several.
    dropouts : tuple of Dropout
        The last 16 places in the stream where samples are missing, constant or repeated.
    n_dropouts : int
        Number of such places since the start.
    coherence : float or NotUsable
        Median over the channels of the coherence with the prediction from the others. Not usable in the
        first second and without a coherent sound; swapped, inverted and noisy channels are then not found.
    clipped : float
        Share of the samples of the hop that are clipped, over all channels.

    Examples
    --------
    >>> health = ArrayHealth.unknown(n_channels=4)
    >>> health.is_healthy, health.mask.n_kept
    (True, 4)
    """

    mask: ChannelMask
    faults: tuple[ChannelFault, ...]
    dropouts: tuple[Dropout, ...]
    n_dropouts: int
    coherence: float | NotUsable
    clipped: float = 0.0

    @classmethod
    def unknown(cls, n_channels: int, reason: str = "no hop so far") -> "ArrayHealth":
        """Return the health of an array of which nothing is known: all channels kept.

        Parameters
        ----------
        n_channels : int
            Number of microphones M.
        reason : str
            Why there is no estimate of the coherence.

        Returns
        -------
        ArrayHealth
            Without faults.

        Examples
        --------
        >>> ArrayHealth.unknown(3).mask.keep
        array([ True,  True,  True])
        """
        return cls(ChannelMask.all_of(n_channels), (), (), 0, NotUsable(reason))

    @property
    def is_healthy(self) -> bool:
        """Whether there is no fault and no dropout."""
        return not (self.faults or self.n_dropouts)


def faults_where(fault: Fault, found: BoolArray, values: FloatArray) -> list[ChannelFault]:
    """List one kind of fault for all channels in which it was found; both arrays have shape (M,)."""
    return [ChannelFault(int(m), fault, float(values[m])) for m in np.flatnonzero(found)]


def repeated(
    found: list[ChannelFault], before: list[ChannelFault]
) -> tuple[list[ChannelFault], list[ChannelFault]]:
    """Return the faults that were found the last time, too, and all of them for the next time."""
    known = {(one.channel, one.fault) for one in before}
    return [one for one in found if (one.channel, one.fault) in known], found
