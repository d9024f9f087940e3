"""Hop tables without information, to be filled in by a test."""

import numpy as np

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
