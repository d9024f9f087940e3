"""Bearings of vehicles in view against the truth of streams, and what an offset of the clocks costs them."""

from collections.abc import Sequence

import numpy as np

from worldstate.ground.typing import FloatArray
from worldstate.ground.values import wrap_angle

from .heard_stream import HeardStream
from .stream_labels import ROW_S

NEAR_M = 20.0  # Farther away a vehicle in view is no louder than the street
OFFSET_S = 0.05  # Between the clocks of sound and camera


def in_view_bearings(streams: Sequence[HeardStream]) -> dict[str, float | None]:
    """Return the median error of bearings of the loudest vehicle in view, and its turn in the offset."""
    errors = np.concatenate([_errors_rad(one) for one in streams])
    turned = np.concatenate([_turn_rates(one) for one in streams]) * OFFSET_S
    return {
        "bearing_error_deg": float(np.degrees(np.median(errors))) if errors.size else None,
        # What a box lies beside its bearing where the camera is so much earlier or later: truth alone.
        "offset_50ms_deg": float(np.degrees(np.median(turned))) if turned.size else None,
        "offset_50ms_95_deg": float(np.degrees(np.quantile(turned, 0.95))) if turned.size else None,
    }


def _errors_rad(heard: HeardStream) -> FloatArray:
    """Return how far bearings are from the loudest vehicle in view near by, one a hop."""
    rows, time_s = heard.rows, heard.hops.time_s
    hop = np.round((rows.time_s - time_s[0]) / ROW_S).astype(np.intp)
    seen = rows.in_view & (np.hypot(rows.x_m, rows.y_m) <= NEAR_M) & (hop >= 0) & (hop < len(time_s))
    order = np.flatnonzero(seen)[np.lexsort((rows.loudness_db[seen], hop[seen]))]
    loudest = order[np.diff(hop[order], append=-1) != 0]
    true = np.arctan2(rows.y_m[loudest], rows.x_m[loudest])
    return np.asarray(np.abs(wrap_angle(heard.hops.bearing_rad[hop[loudest]] - true)))


def _turn_rates(heard: HeardStream) -> FloatArray:
    """Return how fast vehicles in view near by turn round the array, rad/s, one a row and next."""
    rows = heard.rows
    near = rows.in_view & (np.hypot(rows.x_m, rows.y_m) <= NEAR_M)
    on = (np.diff(rows.vehicle) == 0) & near[1:] & near[:-1]
    return np.asarray(np.abs(wrap_angle(np.diff(np.arctan2(rows.y_m, rows.x_m)))[on]) / ROW_S)
