"""Hop tables that say nothing, to be filled in by a test."""

import numpy as np

from worldstate.operations.recordings.hop_table import HopTable
from worldstate.studies.streets.recording_features import decisions


def blank_stream(name, hops):
    """A hazard-free hop stream."""
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


def blank_recording(name, hops):
    """What the front-end keeps of a hazard-free simulated recording, classified as nothing."""
    unknown = np.full(hops, np.nan)
    return blank_stream(name, hops).replace(
        features=np.zeros((hops, 60)),
        prominence=np.ones(hops),
        log_slope_hz=unknown,
        reference_rad=unknown,
        srp_rad=unknown,
        music_rad=unknown,
        about={"site": "SA1", "pass_s": None, "doppler": "no vehicle"},
        **decisions(np.full((hops, 4), 0.25), np.zeros(hops)),
    )
