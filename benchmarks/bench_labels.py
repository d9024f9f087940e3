"""T0 and hidden places of smoothed passes on simulated streams, beside what the filter said at the time.

Run: python benchmarks/bench_labels.py streams/*-approaches-*.npz [--passes 30] [--json]

Boxes are drawn from the truth of the streams, with misses. T0 against that of the simulation, places of the
front's middle against its path, in the three seconds before T0 ("hidden": all of their hops). The filter is
`worldstate.belief`'s in modified polar coordinates from the same prior, with the same approach rates and the
bearings that the front-end heard, as hidden ones (25 degrees): its place is the best that it could have said.
"nees" is the squared error of azimuth and log range over the stated covariance, halved: 1 in the mean where
deviations are stated rightly. Intervals of nine tenths by 1000 draws of passes.
"""

import argparse
import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.simulation.scene.kinds import vehicle_kind
from worldstate.belief.kinematics import motion
from worldstate.operations.commissioning.heard_stream import HeardStream
from worldstate.operations.labelling.box_tracks import box_tracks
from worldstate.operations.labelling.pass_labels import PassLabel, label_passes, start_of
from worldstate.studies.passes.stream_camera import stream_detections
from worldstate.studies.passes.world_exam import EVERYBODY

HOP_S = 0.1
LEADS_S, SHOWN_S = HOP_S * np.arange(1, 31), (0.5, 1.0, 2.0, 3.0)
HIDDEN_BEARING_STD_RAD, SAME_PASS_S = math.radians(25.0), 2.0
METHODS = ("smoothed", "filter")
PLACE = [0, 3]  # Azimuth and logarithm of the range, of a state


def stream_errors(path: Path, passes: int, seed: int = 0) -> tuple[list[dict[str, list[float]]], int]:
    """Errors of every labelled pass, and how many vehicles came out of an arm."""
    stream, camera = HeardStream.load(path), PinholeCamera()
    log = stream_detections(stream, np.random.default_rng(seed), camera)
    tracks = [one for one in box_tracks(log, camera, EVERYBODY) if one.arm is not None][:passes]
    until_s = float(tracks[-1].time_s[0]) + SAME_PASS_S
    found = [_errors(stream, one) for one in label_passes(tracks, camera.position_m[0])]
    vehicles = stream.vehicles
    came = vehicles.hazard & (vehicles.entry_s > 0.0) & (vehicles.entry_s < until_s)
    return [one for one in found if one], int(came.sum())


def _errors(stream: HeardStream, one: PassLabel) -> dict[str, list[float]]:
    vehicles = stream.vehicles
    near = np.where(vehicles.arm == one.arm, np.abs(vehicles.entry_s - one.t0.time_s), np.inf)
    near[~vehicles.hazard] = np.inf
    row = int(np.nanargmin(near))
    if near[row] > SAME_PASS_S:
        return {}
    entry_s, side = float(vehicles.entry_s[row]), 1.0 if one.arm == "left" else -1.0
    mine = stream.rows.vehicle == vehicles.vehicle[row]
    time_s, x, y = (column[mine] for column in (stream.rows.time_s, stream.rows.x_m, stream.rows.y_m))
    # Rows hold the front axle; boxes show the bumper ahead of it.
    y = y - side * vehicle_kind(str(vehicles.kind[row])).axles_m[0]
    hop = np.round(10.0 * (entry_s - LEADS_S)).astype(int)
    seen = dict(zip(np.round(10.0 * time_s).astype(int).tolist(), (x + 1j * y).tolist(), strict=True))
    true = np.array([seen.get(at, math.nan + 0j) for at in hop.tolist()])
    smoothed, rows = one.track.motion, np.searchsorted(one.track.time_s, entry_s - LEADS_S - 0.5 * HOP_S)
    means = {"smoothed": smoothed.mean[rows]}
    spreads = {"smoothed": smoothed.covariance[rows]}
    means["filter"], spreads["filter"] = _filtered(stream, one, entry_s)
    told = {"t0_s": [one.t0.time_s - entry_s], "t0_std_s": [one.t0.std_s]}
    for name in METHODS:
        said = np.exp(means[name][:, 3] + 1j * means[name][:, 0])
        off = np.stack([np.angle(said * true.conj()), np.log(np.abs(said) / np.abs(true))], axis=1)
        spread = spreads[name][:, PLACE][:, :, PLACE]
        told[f"{name}_m"] = np.abs(said - true).tolist()
        told[f"{name}_deg"] = np.degrees(np.abs(off[:, 0])).tolist()
        told[f"{name}_nees"] = (np.einsum("ni,nij,nj->n", off, np.linalg.inv(spread), off) / 2.0).tolist()
    return told


def _filtered(stream: HeardStream, one: PassLabel, entry_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance that a filter would have said at every lead, NaN where it had not begun."""
    hops, belief = stream.hops, start_of(one.arm)
    means, spreads = np.full((LEADS_S.size, 4), math.nan), np.tile(np.eye(4), (LEADS_S.size, 1, 1))
    first = int(np.searchsorted(hops.time_s, one.track.time_s[0]))
    for hop in range(first, int(np.searchsorted(hops.time_s, entry_s))):
        belief = motion.predict(belief, HOP_S, 1.0)
        bearing = float(hops.bearing_rad[hop])
        # Images on the other side say nothing of this one.
        if np.isfinite(bearing) and (bearing > 0.0) == (one.arm == "left"):
            belief = motion.update_azimuth(belief, bearing, HIDDEN_BEARING_STD_RAD, 1.0)
        if np.isfinite(hops.looming_hz[hop]):
            rate, std = float(hops.looming_hz[hop]), float(hops.looming_std_hz[hop])
            belief = motion.update_approach(belief, rate, math.hypot(std, 0.3), 1.0)
        near = np.abs(hops.time_s[hop] - (entry_s - LEADS_S)) <= 0.5 * HOP_S
        means[near], spreads[near] = belief.mean, belief.covariance
    return means, spreads


def figures(found: list[dict[str, list[float]]], came: int, rng: np.random.Generator) -> dict[str, object]:
    off = np.array([one["t0_s"][0] for one in found])
    told: dict[str, object] = {
        "vehicles": came,
        "labelled": len(found),
        "t0_within_0.2_s": float((np.abs(off) < 0.2).sum() / max(came, len(found))),
        "t0_median_s": float(np.median(off)),
        "t0_worst_s": float(np.abs(off).max()),
    }
    shown = [round(lead_s / HOP_S) - 1 for lead_s in SHOWN_S]
    errors = {key: np.array([one[key] for one in found]) for key in found[0] if key[:2] != "t0"}
    for key, values in errors.items():
        for column in shown:
            told[f"{key} {LEADS_S[column]:g} s"] = _interval([values[:, [column]]], _measure(key), rng)
        told[f"{key} hidden"] = _interval([values], _measure(key), rng)
        told[f"{key} hidden, median"] = round(float(np.nanmedian(values)), 2)
    for unit in ("m", "deg"):
        pair = [errors[f"{name}_{unit}"] for name in METHODS]
        told[f"smoothed_{unit} of filter_{unit}"] = _interval(pair, lambda a, b: _rms(a) / _rms(b), rng)
    for column in shown:
        told[f"smoothed_m median {LEADS_S[column]:g} s"] = round(
            float(np.nanmedian(errors["smoothed_m"][:, column])), 2
        )
    return told


def _measure(key: str) -> Callable[[np.ndarray], float]:
    return _mean if key.endswith("nees") else _rms


def _mean(values: np.ndarray) -> float:
    return float(np.nanmean(values))


def _rms(errors: np.ndarray) -> float:
    return math.sqrt(np.nanmean(errors**2))


def _interval(
    columns: list[np.ndarray], measure: Callable[..., float], rng: np.random.Generator
) -> list[float]:
    """A figure of passes, and its interval of nine tenths."""
    known = np.all([np.isfinite(one).any(axis=1) for one in columns], axis=0)
    kept = [one[known] for one in columns]
    draws = rng.integers(0, known.sum(), (1000, known.sum()))
    low, high = np.quantile([measure(*(one[rows] for one in kept)) for rows in draws], (0.05, 0.95))
    return [round(float(value), 2) for value in (measure(*kept), low, high)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("streams", type=Path, nargs="+", metavar="NPZ")
    parser.add_argument("--passes", type=int, default=30, help="of every stream, the first so many")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args()
    found, came = [], 0
    for path in options.streams:
        errors, vehicles = stream_errors(path, options.passes)
        found, came = found + errors, came + vehicles
    told = figures(found, came, np.random.default_rng(0))
    print(json.dumps(told, indent=2) if options.json else "\n".join(f"{k:26s} {v}" for k, v in told.items()))


if __name__ == "__main__":
    main()
