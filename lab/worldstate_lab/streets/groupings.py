"""Which real junctions are held against which: the distance that real streets have from one another."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from worldstate.adapters.datasets.feature_table import FeatureTable


@dataclass(frozen=True, slots=True)
class Grouping:
    """Two sets of junctions that have none in common."""

    one: tuple[str, ...]
    other: tuple[str, ...]

    def tables(self, table: FeatureTable) -> tuple[FeatureTable, FeatureTable]:
        """Return the windows of either set."""
        one, other = (table.select(np.isin(table.environments, names)) for names in (self.one, self.other))
        return one, other

    def __str__(self) -> str:
        return f"{' '.join(self.one)} | {' '.join(self.other)}"


def halves(sites: list[str]) -> tuple[Grouping, ...]:
    """Return the splits into two as equal sets as possible, of which both hold both types where any does.

    Examples
    --------
    >>> [str(one) for one in halves(["SA1", "SA2", "SB1", "SB2"])]
    ['SA1 SB1 | SA2 SB2', 'SA1 SB2 | SA2 SB1']
    """
    # As equal as possible: one junction against four is told apart at .99, whatever it is.
    found = []
    for one in combinations(sites, len(sites) // 2):
        other = tuple(name for name in sites if name not in one)
        if len(one) < len(other) or one[0] == sites[0]:  # of equal sets every split comes twice
            found.append(Grouping(one, other))
    # Type A against type B would measure the wall across the street (transfer .87).
    mixed = [one for one in found if len(_types(one.one)) == len(_types(one.other)) == len(_types(sites))]
    return tuple(mixed or found)


def within_types(sites: list[str]) -> tuple[Grouping, ...]:
    """Return every junction against the others of its type.

    Examples
    --------
    >>> [str(one) for one in within_types(["DA1", "DB1", "DB2"])]
    ['DB1 | DB2']
    """
    found = []
    for name in sites:
        others = tuple(other for other in sites if other != name and other[:2] == name[:2])
        # Of two junctions of a type the one order is the other.
        if others and (len(others) > 1 or name < others[0]):
            found.append(Grouping((name,), others))
    return tuple(found)


def _types(sites: tuple[str, ...] | list[str]) -> set[str]:
    return {name[:2] for name in sites}
