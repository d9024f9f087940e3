"""Which advisories a file of snapshots holds, and which of its times is worth explaining first."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from worldstate.ground.values import seconds
from worldstate.state import WorldState


@dataclass(frozen=True, slots=True)
class ToldAdvisory:
    """An advisory of one side, from its onset to the last snapshot that has it.

    Examples
    --------
    >>> ToldAdvisory("left", 700_000_000, 1_500_000_000).line()
    'left   0.70 to 1.50 s'
    """

    direction: str
    since_ns: int
    last_ns: int

    def line(self) -> str:
        """Return it for people."""
        return f"{self.direction:6s} {seconds(self.since_ns):.2f} to {seconds(self.last_ns):.2f} s"


@dataclass(frozen=True, slots=True)
class ToldAdvisories:
    """The advisories of a file, in the order of their onsets, and when its risk was highest."""

    advisories: tuple[ToldAdvisory, ...]
    riskiest_ns: int

    @property
    def explained_ns(self) -> int:
        """The first onset; where there is no advisory, the time of the highest risk."""
        return self.advisories[0].since_ns if self.advisories else self.riskiest_ns

    def lines(self) -> Iterator[str]:
        """Yield them for people, and which is explained."""
        yield from ("advisories", *(f"  {one.line()}" for one in self.advisories))
        which = "at the first onset" if self.advisories else "none; at the highest risk"
        yield f"  {which}, another by --time"


def told_advisories(states: Iterable[WorldState], side: str | None = None) -> ToldAdvisories:
    """Return the advisories of snapshots, of one side or of all."""
    last_ns: dict[tuple[int, str], int] = {}
    highest, riskiest_ns = -1.0, 0
    for state in states:
        cues = [cue for cue in state.cues if side in (None, cue.direction)]
        for cue in cues:
            if cue.advisory is not None:
                last_ns[cue.advisory.since_ns, cue.direction] = state.stamp_ns
        risk = max((cue.risk for cue in cues), default=0.0)
        if risk > highest:
            highest, riskiest_ns = risk, state.stamp_ns
    told = (ToldAdvisory(direction, since, last) for (since, direction), last in sorted(last_ns.items()))
    return ToldAdvisories(tuple(told), riskiest_ns)
