"""A street with a camera: false alarms, and a vehicle that is audible before it is in view."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from street_measurements import ABSENT, EVEN, PRESENT, car, hop, reading

from worldstate import Measurement
from worldstate.abduction.co_evidence import CoEvidence
from worldstate.abduction.sequence.sequence_model import GROUPS, SequenceAlarm
from worldstate.measurement import Look

SIDES, HOP_NS, START_NS = ("left", "right"), 10**8, 3600 * 10**9
ALARM = SequenceAlarm(0.0, 4.0)  # Four onsets per hour


def heard(number: int, loud: str | None, answer: CoEvidence, level: float = 20.0) -> Measurement:
    """Return a hop with evidence `level` for a vehicle on a side."""
    weights = np.full((2, len(GROUPS)), 1e-3)
    weights[:, -1] = 1.0
    if loud is not None:
        side = SIDES.index(loud)
        weights[side, GROUPS.index("coming_2s")] += level
        weights[1 - side, GROUPS.index("other")] += level
    said = replace(reading(weights, share=EVEN), alarm=ALARM)
    at, nats = START_NS // HOP_NS + number, (-1.0, -1.0, -1.0, 1.0)
    return hop(at, nats, answer=answer, look=Look("camera", at * HOP_NS, answer), sequence=said)


def false_alarms(hops: int = 500) -> Iterator[Measurement]:
    """Yield a false alarm of 0.4 s every 4 s on alternating sides."""
    for number in range(1, hops):
        side = SIDES[number // 40 % 2] if number % 40 < 4 else None
        yield heard(number, side, ABSENT)


def arrival(first: int, level: float = 20.0) -> Iterator[Measurement]:
    """Yield a vehicle that is audible on the left for 2 s and then in view."""
    for number in range(100):
        seen, loud = 80 <= number < 92, "left" if 60 <= number < 80 else None
        one = heard(first + number, loud, PRESENT if seen else ABSENT, level)
        yield replace(one, sightings=(car(0.53 - 0.04 * (number - 80)),) if seen else ())
