"""What can be wrong with the microphones of an array, as values."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from worldstate.frontend.array.channel_mask import ChannelMask
from worldstate.ground.typing import BoolArray, FloatArray, IndexArray
from worldstate.ground.values import NotUsable

from .dropouts import Dropout
from .sample_clock import RateEstimate


class Fault(StrEnum):
    """Kinds of faults of one channel.

    Examples
    --------
    >>> Fault("dead").name, len(Fault)
    ('DEAD', 8)
    """

    DEAD = "dead"
    """Constant, or 30 dB below the median channel."""
    INTERMITTENT = "intermittent"
    """Comes and goes, or crackles."""
    NOISY = "noisy"
    """Its sound has nothing to do with that of the others."""
    INVERTED = "inverted"
    """Fits its place with the wrong sign: crossed leads."""
    SWAPPED = "swapped"
    """Its sound fits another place than its own."""
    CLIPPED = "clipped"
    """Samples pile up at one extreme value."""
    OFFSET = "offset"
    """A mean that is not small against the sound."""
    LEVEL = "level"
    """Far louder or quieter than the median channel."""


MASKED_FAULTS = frozenset({Fault.DEAD, Fault.INTERMITTENT, Fault.NOISY, Fault.INVERTED, Fault.SWAPPED})
"""Faults that cost a channel its vote. The others leave its phase, which is all that PHAT reads."""


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
        How wrong. Dead and intermittent: share of the last five seconds. Noisy and inverted: coherence with
        what the others predict at its place, in units of the median channel's. Swapped: gain of that
        coherence, -2 to 2. Clipped: share of samples. Offset: in units of the peak-to-peak sound. Level: dB.
    looks_like : int or None
        Swapped: the channel whose place it fits.

    Examples
    --------
    >>> ChannelFault(3, Fault.SWAPPED, 0.8, looks_like=7).fault.value
    'swapped'
    """

    channel: int
    fault: Fault
    value: float
    looks_like: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ArrayHealth:
    """State of an array at the end of a hop.

    Parameters
    ----------
    mask : ChannelMask
        Microphones that count in this hop.
    faults : tuple of ChannelFault
        What is wrong now, by channel; one channel may have several.
    gaps : tuple of Dropout
        The last few places where samples are missing, silent or repeated.
    n_gaps : int
        Number of such places since the start.
    coherence : float or NotUsable
        Median over the channels of their coherence with what the others predict. Not usable until the
        first second is heard and where nothing coherent sounds: then swapped, inverted and noisy channels go
        unseen.
    sample_rate : RateEstimate or NotUsable
        Rate of the samples by the caller's clock.

    Examples
    --------
    >>> health = ArrayHealth.unknown(n_channels=4)
    >>> health.is_healthy, health.mask.n_kept
    (True, 4)
    """

    mask: ChannelMask
    faults: tuple[ChannelFault, ...]
    gaps: tuple[Dropout, ...]
    n_gaps: int
    coherence: float | NotUsable
    sample_rate: RateEstimate | NotUsable

    @classmethod
    def unknown(cls, n_channels: int, reason: str = "nothing heard yet") -> "ArrayHealth":
        """Nothing is known against any microphone.

        Parameters
        ----------
        n_channels : int
            M.
        reason : str
            Why there is no estimate of the sample rate.

        Returns
        -------
        ArrayHealth
            All channels kept.
        """
        nothing = NotUsable(reason)
        return cls(ChannelMask.all_of(n_channels), (), (), 0, nothing, nothing)

    @property
    def is_healthy(self) -> bool:
        """Whether nothing is wrong."""
        rate_is_wrong = isinstance(self.sample_rate, RateEstimate) and self.sample_rate.is_wrong
        return not (self.faults or self.n_gaps or rate_is_wrong)

    def with_fault(self, *kinds: Fault) -> IndexArray:
        """Channels that have one of these faults, ascending.

        Parameters
        ----------
        *kinds : Fault
            Any of these.

        Returns
        -------
        ndarray of int
            Channel indices from 0.

        Examples
        --------
        >>> ArrayHealth.unknown(2).with_fault(Fault.DEAD)
        array([], dtype=int64)
        """
        return np.unique(np.array([f.channel for f in self.faults if f.fault in kinds], np.intp))


def faults_where(fault: Fault, found: BoolArray, values: FloatArray) -> list[ChannelFault]:
    """List one fault of several channels, (M,) each.

    Shapes: found (M,), values (M,).

    Examples
    --------
    >>> faults_where(Fault.DEAD, np.array([False, True]), np.array([0.0, 1.0]))
    [ChannelFault(channel=1, fault=<Fault.DEAD: 'dead'>, value=1.0, looks_like=None)]
    """
    return [ChannelFault(int(m), fault, float(values[m])) for m in np.flatnonzero(found)]
