r"""What a sequence model reads: each side's evidence, how it changed, and what else the sound did.

One row a hop and side, from the hop itself and those up to three seconds before it. The right side is
mirrored onto the left, so that one model serves both. Where less than that was heard, the oldest hop stands
in.
"""

from dataclasses import dataclass, fields

import numpy as np

from worldstate.ground.typing import FloatArray

MEMORY_HOPS = 31  # three seconds and the hop itself
QUIET_HOPS = 600
# The street's own level is what the quietest fifth of the last minute stays below, its own evidence what half
# of the minute does: another junction moves both, and a vehicle a few seconds long neither.
QUIET_SHARE, USUAL_SHARE = 0.2, 0.5
_SECOND, _TWO, _THREE = 10, 20, 30
SIDES = ("left", "right")


@dataclass(frozen=True, slots=True, eq=False)
class HopEvidence:
    """What the hops of a stream said, each of shape (n,), the two sides of shape (n, 2)."""

    sides: FloatArray  # Log ratio of hidden on the left, on the right, to visible or none; nats
    visible: FloatArray  # Log ratio of visible to none, nats
    level: FloatArray  # Mean of the log of the 60 values
    loudness: FloatArray  # Mean log energy of the bands, nats
    prominence: FloatArray  # Natural logarithm of the peak-to-median ratio
    looming_hz: FloatArray  # 1/TTA; NaN where refused
    looming_std_hz: FloatArray
    bearing_rad: FloatArray  # Left positive; NaN where refused

    def __len__(self) -> int:
        return len(self.visible)

    def last(self, hops: int) -> "HopEvidence":
        """Return the last hops alone."""
        return HopEvidence(*(getattr(self, one.name)[-hops:] for one in fields(self)))


INPUTS = (
    *("this", "this_above", "this_1s", "this_2s", "this_before", "this_highest"),
    *("other", "other_above", "other_1s", "other_2s", "other_highest"),
    *("visible", "visible_above", "visible_1s", "visible_2s", "visible_highest"),
    *("level", "level_1s", "level_2s"),
    *("loudness", "loudness_1s", "loudness_2s"),
    *("prominence", "prominence_1s"),
    *("approach", "approach_std"),
    *("bearing", "bearing_1s", "bearing_spread"),
)


def sequence_inputs(evidence: HopEvidence) -> FloatArray:
    """Return the inputs of both sides at every hop, shape (n, 2, inputs).

    Examples
    --------
    >>> flat = HopEvidence(np.zeros((5, 2)), *np.zeros((7, 5)))
    >>> sequence_inputs(flat).shape == (5, 2, len(INPUTS))
    True
    """
    level, loudness = (one - running(one, QUIET_SHARE) for one in (evidence.level, evidence.loudness))
    above = evidence.sides - np.stack([running(side, USUAL_SHARE) for side in evidence.sides.T], axis=1)
    # Where nothing could be read the rate is 0 and its deviation that of knowing nothing.
    refused = ~np.isfinite(evidence.looming_hz)
    rate = np.where(refused, 0.0, evidence.looming_hz)
    spread = np.where(refused, 10.0, np.minimum(evidence.looming_std_hz, 10.0))
    azimuth = np.where(np.isfinite(evidence.bearing_rad), evidence.bearing_rad, 0.0)
    swing = highest(azimuth, _SECOND) + highest(-azimuth, _SECOND)
    shared = [evidence.visible, evidence.visible - running(evidence.visible, USUAL_SHARE)]
    shared += [*_changes(evidence.visible), highest(evidence.visible, _THREE)]
    shared += [level, *_changes(evidence.level), loudness, *_changes(evidence.loudness)]
    shared += [evidence.prominence, ago(evidence.prominence, _SECOND), rate / spread, np.log(spread)]
    both = []
    for side in range(len(SIDES)):
        mine, other, sign = evidence.sides[:, side], evidence.sides[:, 1 - side], 1.0 - 2.0 * side
        own = [mine, above[:, side], *_changes(mine)]
        own += [ago(mine, _SECOND) - ago(mine, _THREE), highest(mine, _THREE)]
        own += [other, above[:, 1 - side], *_changes(other), highest(other, _THREE)]
        turned = [sign * azimuth, sign * (azimuth - ago(azimuth, _SECOND)), swing]
        both.append(np.stack([*own, *shared, *turned], axis=1))
    return np.stack(both, axis=1)


def _changes(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    return values - ago(values, _SECOND), values - ago(values, _TWO)


def ago(values: FloatArray, hops: int) -> FloatArray:
    """Return what each value was so many hops before; the first one where there is none.

    Examples
    --------
    >>> ago(np.array([1.0, 2.0, 3.0]), 1)
    array([1., 1., 2.])
    """
    before = np.maximum(np.arange(len(values)) - hops, 0)
    return np.asarray(values[before])


def highest(values: FloatArray, hops: int) -> FloatArray:
    """Return the largest of each value and those up to so many hops before it.

    Examples
    --------
    >>> highest(np.array([3.0, 1.0, 2.0, 0.0]), 1)
    array([3., 3., 2., 2.])
    """
    padded = np.concatenate([np.full(hops, -np.inf), values])
    return np.asarray(np.lib.stride_tricks.sliding_window_view(padded, hops + 1).max(axis=1))


def running(values: FloatArray, share: float) -> FloatArray:
    """Return the value that a share of the last minute stays below, hop by hop.

    Examples
    --------
    >>> running(np.array([3.0, 1.0, 2.0]), 0.5)
    array([3., 1., 2.])
    """
    padded = np.concatenate([np.full(QUIET_HOPS - 1, np.nan), values])
    found = np.empty(len(values))
    heard = np.minimum(np.arange(len(values)) + 1, QUIET_HOPS)
    # NaN sorts last: the rank counts what was heard.
    rank = np.floor(share * (heard - 1)).astype(np.intp)
    windows = np.lib.stride_tricks.sliding_window_view(padded, QUIET_HOPS)
    for begin in range(0, len(values), 1000):
        block = np.sort(windows[begin : begin + 1000], axis=1)
        found[begin : begin + 1000] = np.take_along_axis(block, rank[begin : begin + 1000, None], 1)[:, 0]
    return found
