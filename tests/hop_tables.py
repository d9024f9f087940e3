"""Hop tables without information, and streams of given vehicles, to be filled in by a test."""

import numpy as np

from worldstate.commissioning.heard_stream import HeardStream
from worldstate.operations.recordings.hop_table import HopTable


def blank_stream(name, hops):
    """Return a hazard-free hop stream."""
    return HopTable(
        {
            "time_s": 1.0 + 0.1 * np.arange(hops),
            "log_likelihoods": np.zeros((hops, 4)),
            "answer": np.zeros(hops, dtype=np.int64),
            "miss_rate": np.ones(hops),
            "clutter_rate": np.zeros(hops),
            "approach": np.full(hops, np.nan),
            "seen": np.zeros(hops, dtype=bool),
            "there": np.zeros(hops, dtype=bool),
        },
        name=name,
    )


VEHICLE = [("vehicle", int), *((name, "U16") for name in ("flow", "kind", "arm"))]
VEHICLE += [("entry_s", float), ("hazard", bool)]
ROW = [(name, float) for name in ("vehicle", "time_s", "x_m", "y_m", "in_view", "loudness_db")]


def heard_stream(vehicles, rows, hops, **about):
    """Return a processed stream from rows as in `VEHICLE` and `ROW`, and from columns of its hops."""
    made = np.array(vehicles, VEHICLE), np.array(rows, ROW)
    told, seen = (HopTable({name: one[name] for name in one.dtype.names}) for one in made)
    return HeardStream(HopTable(hops, about=about), told, seen.replace(in_view=seen.in_view > 0.0))
