"""A day of a street: constant memory, and checkpoints that continue to the same state."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from worldstate import Measurement, NotUsable, Sighting, SignatureEvidence, WorldFilter
from worldstate.abduction.co_evidence import Absent, Present
from worldstate.abduction.sequence.sequence_model import COMING_S, GROUPS, SequenceAlarm
from worldstate.abduction.sequence.sequence_reader import SequenceReading
from worldstate.measurement import Bearing, Look, Position, PositionScan

HOP_NS, HOPS_PER_HOUR = 10**8, 36_000
SHARE = np.array([0.004] * len(COMING_S) + [0.05, 0.05, 0.05, 0.05, 0.05, 0.714])
SILENT = NotUsable("nothing to be heard")
# Each side has a vehicle about every 20 s, audible for 5 s and visible for 3 s.
HEARD_S, SEEN_S, APART_S = 5.0, 3.0, 20.0


def reading(rng: np.random.Generator, times_s: list[float | None]) -> SequenceReading:
    """Return a reading of two sides with the time to visible of each, if any."""
    groups = np.tile(SHARE, (2, 1))
    for side, time_s in enumerate(times_s):
        if time_s is not None:
            groups[side, np.searchsorted(COMING_S, time_s)] += 3.0
        groups[side] *= rng.gamma(3.0, size=len(GROUPS))
    groups /= groups.sum(axis=1, keepdims=True)
    return SequenceReading(groups, SHARE, 0.1, SequenceAlarm(0.5, 30.0))


def street(rng: np.random.Generator, hops: int) -> Iterator[Measurement | PositionScan]:
    """Yield ten hops of sound and camera per second and one radar scan per second."""
    entry_s = rng.exponential(APART_S, 2) + HEARD_S
    for hop in range(1, hops + 1):
        now_s, stamp_ns = hop / 10, hop * HOP_NS
        passed = entry_s + SEEN_S < now_s
        entry_s[passed] = now_s + HEARD_S + rng.exponential(APART_S, int(passed.sum()))
        left_s = entry_s - now_s
        seen = [
            Sighting(sign * (0.5 - 0.3 * -float(time_s)) + 0.02 * float(rng.normal()), 0.03, "car", 0.9)
            for sign, time_s in zip((1.0, -1.0), left_s, strict=True)
            if time_s < 0.0 and rng.random() > 0.05
        ]
        coming = [float(time_s) if 0.0 <= time_s <= HEARD_S else None for time_s in left_s]
        answer = Present(0.05, 0.01) if seen else Absent(0.05, 0.01)
        yield Measurement(
            stamp_ns,
            SignatureEvidence(("left", "right"), (0.0, 0.0), 0.0, 0.5),
            answer,
            Bearing(0.6 * float(rng.normal()), 0.2, 2.0) if any(coming) else SILENT,
            SILENT,
            tuple(seen),
            look=Look("camera", stamp_ns, answer),
            sequence=reading(rng, coming),
        )
        if hop % 10 == 0:
            there = tuple(
                Position((8.0, sign * 4.0 * (1.5 + float(time_s))), ((0.5, 0.0), (0.0, 0.5)))
                for sign, time_s in zip((1.0, -1.0), left_s, strict=True)
                if time_s < 0.0
            )
            yield PositionScan("radar", stamp_ns, there)


def kept_in_memory() -> int:
    """Return the pages that this process holds."""
    return int(Path("/proc/self/statm").read_text().split()[1])


def drive(hours: float, checkpoints: int) -> tuple[list[int], list[int]]:
    """Return memory and bytes of the checkpoint, each at the end of every part."""
    rng, world = np.random.default_rng(4), WorldFilter()
    hops = round(hours * HOPS_PER_HOUR)
    pages, sizes, copy = [], [], None
    for number, measured in enumerate(street(rng, hops), 1):
        world = world.update(measured)
        if copy is not None:
            copy = copy.update(measured)
            if number % 50 == 0:
                assert copy.state.to_json() == world.state.to_json()
                copy = None
        if number % (hops * 11 // 10 // checkpoints) == 0:
            written = json.dumps(world.to_dict(), allow_nan=False)
            copy = WorldFilter.from_dict(json.loads(written))
            pages, sizes = [*pages, kept_in_memory()], [*sizes, len(written)]
            assert len(world.state.entities) < 20
    return pages, sizes


def test_a_checkpoint_continues_to_the_same_state_and_does_not_grow() -> None:
    _, sizes = drive(0.01, 3)
    assert max(sizes) < 2 * min(sizes)


@pytest.mark.slow
def test_a_day_leaves_memory_flat() -> None:
    pages, sizes = drive(24.0, 24)
    assert len(pages) == 24
    assert max(pages[1:]) < 1.05 * pages[0]
    assert max(sizes) < 3 * min(sizes)
