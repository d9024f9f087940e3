"""T0 and hidden places of smoothed passes on simulated streams, beside what the filter said at the time.

Run: python benchmarks/bench_labels.py streams/*-approaches-*.npz [--passes 30] [--json]

Boxes are drawn from the truth of the streams, with misses. T0 against that of the simulation, places of the
front's middle against its path, .5 to 3 s before T0. The filter is `worldstate.belief`'s in modified polar
coordinates from the same prior, with the same approach rates and the bearings that the front-end heard, as
hidden ones (25 degrees): its place is the best that it could have said. Intervals by 1000 draws of passes.
"""

import argparse
import json
import math
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

LEADS_S, HOP_S = (0.5, 1.0, 2.0, 3.0), 0.1
HIDDEN_BEARING_STD_RAD, SAME_PASS_S = math.radians(25.0), 2.0


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
    filtered = _filtered(stream, one, entry_s)
    places = {"smoothed_m": [], "filtered_m": [], "smoothed_deg": [], "filtered_deg": [], "nees": []}
    for lead_s in LEADS_S:
        at = int(np.argmin(np.abs(time_s - (entry_s - lead_s))))
        mine_now = int(np.argmin(np.abs(one.track.time_s - (entry_s - lead_s))))
        if abs(time_s[at] - (entry_s - lead_s)) > HOP_S:
            for values in places.values():
                values.append(math.nan)
            continue
        true = complex(x[at], y[at])
        smoothed = complex(*one.track.states[mine_now, :2])
        off = np.array([(smoothed - true).real, (smoothed - true).imag])
        spread = one.track.covariance[mine_now, :2, :2]
        places["smoothed_m"].append(abs(smoothed - true))
        places["filtered_m"].append(abs(filtered[lead_s] - true))
        places["smoothed_deg"].append(abs(np.angle(smoothed / true, deg=True)))
        places["filtered_deg"].append(abs(np.angle(filtered[lead_s] / true, deg=True)))
        places["nees"].append(float(off @ np.linalg.solve(spread, off)) / 2.0)
    return {"t0_s": [one.t0.time_s - entry_s], "t0_std_s": [one.t0.std_s], **places}


def _filtered(stream: HeardStream, one: PassLabel, entry_s: float) -> dict[float, complex]:
    hops, belief, said = stream.hops, start_of(one.arm), {}
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
        place = math.exp(belief.mean[3]) * complex(math.cos(belief.mean[0]), math.sin(belief.mean[0]))
        for lead_s in LEADS_S:
            if hops.time_s[hop] <= entry_s - lead_s + 0.5 * HOP_S:
                said[lead_s] = place
    return {lead_s: said.get(lead_s, math.nan + 0j) for lead_s in LEADS_S}


def figures(found: list[dict[str, list[float]]], came: int, rng: np.random.Generator) -> dict[str, object]:
    off = np.array([one["t0_s"][0] for one in found])
    told: dict[str, object] = {
        "vehicles": came,
        "labelled": len(found),
        "t0_within_0.2_s": float((np.abs(off) < 0.2).sum() / max(came, len(found))),
        "t0_median_s": float(np.median(off)),
        "t0_worst_s": float(np.abs(off).max()),
    }
    for name in ("smoothed_m", "filtered_m", "smoothed_deg", "filtered_deg"):
        errors = np.array([one[name] for one in found])
        for column, lead_s in enumerate(LEADS_S):
            told[f"{name} {lead_s:g} s"] = _rms(errors[:, column], rng)
    for column, lead_s in enumerate(LEADS_S):
        told[f"median_m {lead_s:g} s"] = float(np.nanmedian([one["smoothed_m"][column] for one in found]))
        told[f"nees {lead_s:g} s"] = float(np.nanmedian([one["nees"][column] for one in found]))
    return told


def _rms(errors: np.ndarray, rng: np.random.Generator) -> list[float]:
    """Root mean square and its interval of nine tenths."""
    known = errors[np.isfinite(errors)]
    draws = known[rng.integers(0, known.size, (1000, known.size))]
    low, high = np.quantile(np.sqrt((draws**2).mean(axis=1)), (0.05, 0.95))
    return [round(float(value), 2) for value in (np.sqrt((known**2).mean()), low, high)]


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
    print(json.dumps(told, indent=2) if options.json else "\n".join(f"{k:24s} {v}" for k, v in told.items()))


if __name__ == "__main__":
    main()
