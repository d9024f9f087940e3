"""Advisories over whole recordings: onsets, lead time, false alarms per hour.

A detection is an alarm onset before line-of-sight entry T0; onsets more than 5 s before it spoke of something
else and are counted apart. A false alarm is one rising edge on a hazard-free recording.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from worldstate.ground.checks import finite_array, in_range
from worldstate.ground.typing import IndexArray

LONGEST_LEAD_S = 5.0
SECONDS_PER_HOUR = 3600.0
# A hop ends with a whole sample, T0 is a camera frame: one that ends at T0 misses it by 10 us and more.
SLACK_S = 1e-3
# With fewer, one recording moves a rate by more than 5 % and most intervals span what is of interest.
FEWEST_RECORDINGS = 20


def caution(count: int, what: str = "recordings") -> str | None:
    """Return what to say of figures from so few; None from 20 on.

    Examples
    --------
    >>> caution(6), caution(20)
    ('6 recordings: figures from fewer than 20 cannot be read', None)
    """
    if count >= FEWEST_RECORDINGS:
        return None
    return f"{count} {what}: figures from fewer than {FEWEST_RECORDINGS} cannot be read"


@dataclass(frozen=True, slots=True)
class ApproachOutcome:
    """How the advisories of one occluded approach stand to its T0.

    Examples
    --------
    >>> ApproachOutcome(lead_time_s=1.7, false_advisories_before=0).detected
    True
    """

    lead_time_s: float | None  # T0 minus the first onset within 5 s before it; None for a missed approach
    false_advisories_before: int  # Onsets earlier than that

    @property
    def detected(self) -> bool:
        """Whether an advisory came before line of sight."""
        return self.lead_time_s is not None


def rising_edges(alarm: ArrayLike) -> IndexArray:
    """Return the hops at which an alarm begins; one that is on from the first hop begins there.

    Examples
    --------
    >>> rising_edges([True, False, False, True, True])
    array([0, 3])
    """
    on = finite_array("alarm", alarm, (None,)) > 0.5
    return np.flatnonzero(on & ~np.concatenate([[False], on[:-1]]))


def detection(onsets_s: Sequence[float], t0_s: float) -> ApproachOutcome:
    """Compare the onsets of one recording with its line-of-sight entry, both in seconds from its start.

    Examples
    --------
    >>> detection([0.5, 5.5, 6.75], t0_s=7.0)
    ApproachOutcome(lead_time_s=1.5, false_advisories_before=1)
    """
    onsets = finite_array("onsets_s", np.asarray(onsets_s, dtype=np.float64), (None,))
    lead_s = in_range("t0_s", t0_s, -np.inf, np.inf) - onsets
    counted = lead_s[(lead_s > SLACK_S) & (lead_s <= LONGEST_LEAD_S + SLACK_S)]
    longest_s = float(counted.max()) if counted.size else None
    return ApproachOutcome(longest_s, int((lead_s > LONGEST_LEAD_S + SLACK_S).sum()))


def false_alarms_per_hour(alarms: Sequence[ArrayLike], hop_s: float = 0.1) -> float:
    """Return rising edges per hour of scored time over hazard-free recordings.

    Shapes: alarms (hops,).

    Examples
    --------
    >>> round(false_alarms_per_hour([[False, True, True, False], [True] * 5 + [False] * 3]))
    6000
    """
    period_s = in_range("hop_s", hop_s, 0.0, np.inf, open_low=True)
    streams = [np.asarray(alarm) for alarm in alarms]
    scored_hours = sum(stream.size for stream in streams) * period_s / SECONDS_PER_HOUR
    onsets = sum(rising_edges(stream).size for stream in streams)
    return onsets / scored_hours if scored_hours else float("nan")
