"""A street learned while it is listened to: whoever comes into view tells what its arm has sounded like."""

from dataclasses import dataclass, field
from functools import partial

import numpy as np

from worldstate.ground.checks import freeze_arrays
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import FloatArray

from .sequence_inputs import SIDES
from .side_patterns import PassSound, SidePatterns
from .street_sides import SECTORS, StreetSides, arrival_pattern, somebody_comes

# Who comes is heard for some three seconds; in the company of the other arm nobody knows whose sound it is.
HEARD_HOPS = 30


@dataclass(frozen=True, slots=True, eq=False)
class StreetHearing:
    """What is known of the arms' sound, and that of the last three seconds, whose arm nobody knows yet.

    Examples
    --------
    >>> StreetHearing(SidePatterns("roof")).hops
    0
    """

    known: SidePatterns
    # shape (up to 30, 13): Pattern and chance that somebody comes; the last hop last
    recent: FloatArray = field(default_factory=partial(np.zeros, (0, SECTORS + 1)))
    since: tuple[int, int] = (HEARD_HOPS, HEARD_HOPS)  # Hops since somebody came out of either arm

    def __post_init__(self) -> None:
        object.__setattr__(self, "recent", np.reshape(self.recent, (-1, SECTORS + 1)))
        freeze_arrays(self, recent=(None, SECTORS + 1))
        if self.hops > HEARD_HOPS:
            raise InvalidArgumentError(f"recent: expected at most {HEARD_HOPS} hops, got {self.hops}")

    @property
    def hops(self) -> int:
        """Number of hops that are kept."""
        return len(self.recent)

    def heard(self, groups: FloatArray, feature: FloatArray) -> "StreetHearing":
        """Return it one hop on; shapes: groups (2, groups), feature (azimuths,)."""
        now = np.append(arrival_pattern(feature[None])[0], somebody_comes(groups))
        left, right = (min(one + 1, HEARD_HOPS) for one in self.since)
        return StreetHearing(
            self.known, np.concatenate([self.recent[1 - HEARD_HOPS :], now[None]]), (left, right)
        )

    def interrupted(self) -> "StreetHearing":
        """Return it without the last seconds, as after sound that was lost."""
        return StreetHearing(self.known, since=self.since)

    def passed(self, arm: str) -> "StreetHearing":
        """Return it after somebody came into view out of an arm."""
        own = SIDES.index(arm)
        alone = self.since[1 - own] >= HEARD_HOPS
        left, right = (0 if k == own else hops for k, hops in enumerate(self.since))
        known = self.known
        if alone and self.hops:
            sound = PassSound(self.recent[:, :SECTORS], self.recent[:, SECTORS], known.heard_by)
            known = known.with_pass(arm, sound)
        return StreetHearing(known, self.recent, (left, right))


class StreetListener:
    """Puts those who come where the street says, hop by hop, and learns the street from whoever comes.

    Examples
    --------
    >>> from .sequence_model import GROUPS
    >>> listener = StreetListener(StreetHearing(SidePatterns("roof")))
    >>> even = np.full((2, len(GROUPS)), 1 / len(GROUPS))
    >>> for hop in range(30):
    ...     told = listener.turned(even, np.ones(60))
    >>> listener.passed("left")
    >>> bool((told == even).all()), listener.hearing.since
    (True, (0, 30))
    """

    def __init__(self, hearing: StreetHearing) -> None:
        self.hearing = hearing  # All that is carried; `Checkpoint` writes it to disk
        self._sides: StreetSides | None = hearing.known.sides()

    def turned(self, groups: FloatArray, feature: FloatArray) -> FloatArray:
        """Take the next hop in; return its posteriors with the sides that are known so far.

        Shapes: groups (2, groups), feature (azimuths,), positive.
        """
        self.hearing = self.hearing.heard(groups, feature)
        if self._sides is None:
            return groups
        return np.asarray(self._sides.turned(groups[None], feature[None])[0])

    def interrupt(self) -> None:
        """Forget the last seconds; what is known of the street stays."""
        self.hearing = self.hearing.interrupted()

    def passed(self, arm: str) -> None:
        """Learn from somebody who came into view out of an arm just now."""
        self.hearing = self.hearing.passed(arm)
        self._sides = self.hearing.known.sides()
