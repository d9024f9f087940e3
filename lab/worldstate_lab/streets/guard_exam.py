"""What a domain guard makes of sounds that it never heard, and of streets that it never heard."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np

from worldstate.abduction.signature.domain_guard import DomainGuard, Foreign, WarningSignal
from worldstate.commissioning.guard_training import fit_guard, threshold_of
from worldstate.commissioning.sound_rows import FOREIGN, SIGNALS, STREET, SoundRows
from worldstate.ground.typing import FloatArray

# What a listener would take for one another: each left out as a whole.
FAMILIES: Mapping[str, tuple[str, ...]] = {
    "speech": ("voice",),
    "music": ("music",),
    "ringing": ("bell", "tone"),
    "tools": ("saw", "drill"),
    "impacts": ("steps", "rain"),
    "birds": ("birds",),
}
_FOREIGN, _SIGNAL = 1.0, 2.0
GUARDS = 1 + len(FOREIGN) + sum(len(kinds) > 1 for kinds in FAMILIES.values())


@dataclass(frozen=True, slots=True)
class GuardShares:
    """How a guard judged the hops of one kind of sound."""

    without: str  # What it had not heard: nothing, a kind or a family; never the site
    kind: str
    hops: int
    foreign: float  # Share called foreign
    signal: float  # Share called a warning signal
    worst_site: float  # The least share not taken for the street of all sites; of a street the largest


def guard_exam(rows: SoundRows, advance: Callable[[], object] = lambda: None) -> list[GuardShares]:
    """Judge every kind by a guard that knows all kinds, by one without it, and by one without its family."""
    found = _judged(rows, "nothing", (), (*STREET, *FOREIGN, *SIGNALS), advance)
    for kind in FOREIGN:
        found += _judged(rows, kind, (kind,), (kind,), advance)
    for family, kinds in FAMILIES.items():
        if len(kinds) > 1:
            found += _judged(rows, family, kinds, kinds, advance)
    return found


def _judged(
    rows: SoundRows,
    name: str,
    without: Collection[str],
    kinds: Collection[str],
    advance: Callable[[], object],
) -> list[GuardShares]:
    verdicts = _verdicts(rows, without, kinds)
    advance()
    found = []
    for kind in kinds:
        here = rows.kinds == kind
        by_site = [
            float((verdicts[here & (rows.sites == one)] > 0).mean()) for one in np.unique(rows.sites[here])
        ]
        if not by_site:
            continue
        found.append(
            GuardShares(
                without=name,
                kind=kind,
                hops=int(here.sum()),
                foreign=float((verdicts[here] == _FOREIGN).mean()),
                signal=float((verdicts[here] == _SIGNAL).mean()),
                worst_site=max(by_site) if kind in STREET else min(by_site),
            )
        )
    return found


def _verdicts(rows: SoundRows, without: Collection[str], kinds: Collection[str]) -> FloatArray:
    """0 for the street, else a code, by guards that never heard the site, shape (n,)."""
    sites = np.unique(rows.sites).tolist()
    guards = {
        one: fit_guard(rows.select((rows.sites != one) & ~np.isin(rows.kinds, list(without))))
        for one in sites
    }
    excesses = {
        (one, label): guard.log_odds(rows.measures[(rows.sites == one) & (rows.kinds == label)])
        for one, guard in guards.items()
        for label in STREET
    }
    out = np.zeros(len(rows.kinds))
    for one, guard in guards.items():
        others = [
            np.concatenate([excesses[other, label] for other in sites if other != one]) for label in STREET
        ]
        chosen = replace(guard, threshold=threshold_of(others))
        here = np.flatnonzero((rows.sites == one) & np.isin(rows.kinds, list(kinds)))
        out[here] = [_code(chosen, rows.measures[i]) for i in here]
    return out


def _code(guard: DomainGuard, measures: FloatArray) -> float:
    verdict = guard.judge(measures)
    return (
        _SIGNAL if isinstance(verdict, WarningSignal) else _FOREIGN if isinstance(verdict, Foreign) else 0.0
    )
