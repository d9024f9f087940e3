"""The second vehicle of an approach, while the first is in view or has just left: heard, stated, kept apart.

Hops count from the first T0 until the second one's own, of the side that it comes from. Beside them stand
hops of sides where no second one comes, as long after the first T0: each is shared among the groups as hops
with a second vehicle are then, so that every group has the street's own odds.
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import product

import numpy as np

from worldstate.abduction.sequence.sequence_model import COMING_S, HORIZONS_S
from worldstate.commissioning.stream_exam import approaches
from worldstate.ground.typing import BoolArray, FloatArray
from worldstate.operations.metrics.approach_table import SLACK_S, Figures, StreamApproach, mean_of
from worldstate.operations.recordings.hop_table import HOP_S, HopTable, joined

from .followed_stream import PassedStream
from .pass_outcomes import SEEN_AFTER_S, added_db, seen_at, vehicle_at

WITHIN_S, NOTICED_DB, STATED = 3.0, 1.0, 0.3
JUST_LEFT_S = 2.0  # What has left the view is as loud as it was for so long, and masks as before
SIDES_OF = ("other", "behind")
GAPS_S = {"below 1.5 s": (0.0, 1.5), "1.5 to 4 s": (1.5, 4.0)}
BEFORE_S = (3.0, 2.0, 1.5, 1.0, 0.5, 0.1, -0.4)
COLUMNS = ("behind", "since", "gap_s", "added_db", "chance", "comes", "masked")


def second_hops(stream: PassedStream) -> HopTable:
    """Return hops of both sides after the first T0, until a second vehicle comes; no gap where none does."""
    rows = [row for one, added in _loud(stream) for row in _rows(stream, one, added)]
    return HopTable.of_rows(COLUMNS, rows)


def _loud(stream: PassedStream) -> Iterator[tuple[StreamApproach, FloatArray]]:
    """Yield the loud approaches, with what the last vehicle adds at every hop."""
    loud = [one for one in approaches(stream.heard) if not one.quiet]
    numbers, added = (
        stream.heard.vehicles.vehicle.tolist(),
        added_db(stream.heard) if loud else np.zeros((0, 0)),
    )
    for one in loud:
        yield one, added[numbers.index(vehicle_at(stream.heard, one.entries_s[-1]))]


def _rows(stream: PassedStream, one: StreamApproach, added: FloatArray) -> Iterator[tuple[float, ...]]:
    followed, rows = stream.followed, stream.heard.rows
    first = rows.in_view & (rows.vehicle == vehicle_at(stream.heard, one.entries_s[0]))
    since_s = followed.time_s - one.entries_s[0]
    end_s = rows.time_s[first].max(initial=one.entries_s[0]) + JUST_LEFT_S
    for behind in (False, True):
        side = one.sides[0] if behind else 1 - one.sides[0]
        coming_s = stream.truth.coming_s[:, side]
        gap_s = one.entries_s[-1] - one.entries_s[0] if one.sides[1:] == (side,) else np.nan
        still = since_s < gap_s - SLACK_S if gap_s >= 0.0 else coming_s > COMING_S[-1]
        chance = followed.within[:, side, HORIZONS_S.index(WITHIN_S)]
        there = (since_s > SLACK_S) & (followed.time_s <= end_s) & still & np.isfinite(chance)
        for hop in np.flatnonzero(there).tolist():
            told = chance[hop], coming_s[hop] <= WITHIN_S, followed.masked[hop]
            yield behind, round(since_s[hop] / HOP_S), gap_s, added[hop], *told


def second_figures(streams: Sequence[PassedStream]) -> Figures:
    """Return what is stated of second vehicles, and what becomes of their entities, by side and gap."""
    hops = joined(map(second_hops, streams))
    kept = [row for stream in streams for row in _kept(stream)]
    heard = hops.added_db >= NOTICED_DB
    found: Figures = {}
    for (behind, side), (gap, (low, high)) in product(enumerate(SIDES_OF), GAPS_S.items()):
        here = (hops.behind == behind) & (hops.gap_s >= low) & (hops.gap_s < high)
        mine = [row[2:] for row in kept if row[0] == behind and low <= row[1] < high]
        same, merged = ([row[i] for row in mine if row[0]] for i in (1, 2))
        figures = {
            **{"approaches": len(mine)} | _noticed(hops, here & heard) | _masked(hops, here & ~heard),
            **{"stated apart": len(same), "identity kept": mean_of(same), "merged": mean_of(merged)},
        }
        found |= {f"{side}, {gap}: {name}": value for name, value in figures.items()}
    return found


def _noticed(hops: HopTable, mine: BoolArray) -> Figures:
    """Return the Brier skill of the chance where the second one adds a decibel or more."""
    weight = _with_empty(hops, mine)
    share = np.average(hops.comes, weights=weight) if mine.any() else 0.0
    constant = share * (1.0 - share)
    brier = np.average((hops.chance - hops.comes) ** 2, weights=weight) if mine.any() else 0.0
    return {"hops of 1 dB": int(mine.sum()), "skill": float(1.0 - brier / constant) if constant else None}


def _masked(hops: HopTable, mine: BoolArray) -> Figures:
    """Return how far chances are from shares where it adds less, and how often `heard` gives a reason."""
    names = ("stated", "true", "ECE", "said masked")
    if not mine.any():
        return dict.fromkeys(names)
    weight = _with_empty(hops, mine)
    bins = np.minimum(10.0 * hops.chance, 9.0).astype(np.intp)
    error = np.abs(np.bincount(bins, weight * (hops.chance - hops.comes))).sum() / weight.sum()
    stated, true, masked = (np.average(one, weights=weight) for one in (hops.chance, hops.comes, hops.masked))
    return dict(zip(names, map(float, (stated, true, error, masked)), strict=True))


def _with_empty(hops: HopTable, mine: BoolArray) -> FloatArray:
    """Return weights: 1 of some hops with a second vehicle, of empty ones as long after T0 their share."""
    pair = np.isfinite(hops.gap_s)
    key = 2 * hops.since.astype(np.intp) + hops.behind.astype(np.intp)
    some, every = (np.bincount(key[which], minlength=key.max(initial=0) + 1) for which in (mine, pair))
    return np.where(pair, mine, (some / np.maximum(every, 1))[key])


def _kept(stream: PassedStream) -> Iterator[tuple[bool, float, bool, bool, bool]]:
    """Yield side and gap of second vehicles, and what became of the entity stated before the first T0.

    Whether there was one, whether it is seen in the vehicle's place, and whether it became the first's.
    """
    followed = stream.followed
    for one, _ in _loud(stream):
        if len(one.entries_s) < 2:
            continue
        behind = one.sides[0] == one.sides[1]
        before = int(np.searchsorted(followed.time_s, one.entries_s[0] - SLACK_S)) - 1
        # By its share of that side: one of unknown side is the first's, too. Behind another one the
        # likeliest entity is that one's.
        hidden = sorted(followed.hidden(before, one.sides[1], STATED), key=lambda e: -e.existence_probability)
        stated = {e.id for e in hidden[behind:]}
        first, second = (_seen_after(stream, entry_s) for entry_s in one.entries_s)
        merged = first in stated or bool(stated & followed.merged)
        yield behind, one.entries_s[1] - one.entries_s[0], bool(stated), second in stated, merged


def _seen_after(stream: PassedStream, entry_s: float) -> str | None:
    """Return the id of the entity seen at the place of the vehicle that came into view, a second later."""
    later = int(np.searchsorted(stream.followed.time_s, entry_s + SEEN_AFTER_S))
    found = seen_at(stream, vehicle_at(stream.heard, entry_s), min(later, len(stream.followed.time_s) - 1))
    return None if found is None else found.id


def hearing_allows(streams: Sequence[PassedStream]) -> Mapping[str, Figures]:
    """Return the median of what second vehicles add, in dB, by seconds before their own T0, side and gap."""
    found: dict[str, Figures] = {f"{-before:g} s": {} for before in BEFORE_S}
    pairs = [(s, one, added) for s in streams for one, added in _loud(s) if len(one.entries_s) > 1]
    for (behind, side), (gap, (low, high)) in product(enumerate(SIDES_OF), GAPS_S.items()):
        mine = [
            np.interp(one.entries_s[1] - np.array(BEFORE_S), stream.followed.time_s, added)
            for stream, one, added in pairs
            if (one.sides[0] == one.sides[1]) == behind and low <= one.entries_s[1] - one.entries_s[0] < high
        ]
        medians = np.median(mine, axis=0).tolist() if mine else [None] * len(BEFORE_S)
        for figures, median in zip(found.values(), medians, strict=True):
            figures[f"{side}, {gap} ({len(mine)})"] = median
    return found
