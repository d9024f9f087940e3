"""`worldstate-lab bench labels`: T0 and hidden places of smoothed passes on streams, beside the filter.

Boxes are drawn from the truth of the streams, with misses. T0 against that of the simulation, places of the
front's middle against its path, in the three seconds before T0 ("hidden": all of their hops). The filter is
`worldstate.belief`'s in modified polar coordinates from the same prior, with the same approach rates and the
bearings that the front-end heard, as hidden ones (25 degrees): its place is the best that it could state.
"nees" is the squared error of azimuth and log range over the stated covariance, halved: 1 in the mean where
deviations are stated rightly; "place_nees" that of x and y in metres, and "covered" the share of places in
their ellipse of nine tenths. Intervals of nine tenths by 1000 draws of passes.
"""

import argparse
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.belief.kinematics import motion
from worldstate.belief.kinematics.motion import MotionBelief
from worldstate.cli.common.output import CommandResult
from worldstate.commissioning.heard_stream import HeardStream
from worldstate.ground.typing import FloatArray
from worldstate.operations.figure_style import RED, figure_file, legend_beside
from worldstate.operations.labelling.box_tracks import box_tracks
from worldstate.operations.labelling.pass_labels import PassLabel, label_passes, start_of
from worldstate.operations.labelling.street_figure import draw_passes, draw_track
from worldstate.operations.recordings.true_track import TrueTrack
from worldstate.simulation.scene.kinds import vehicle_kind
from worldstate.smoothing.observations import SmoothedTrack
from worldstate_lab.passes.followed_stream import EVERYBODY
from worldstate_lab.passes.stream_camera import stream_detections

EXAMPLE = "example: worldstate-lab bench labels streams/*-approaches-*.npz --passes 30"

HOP_S = 0.1
LEADS_S, SHOWN_S = HOP_S * np.arange(1, 31), (0.5, 1.0, 2.0, 3.0)
HIDDEN_BEARING_STD_RAD, SAME_PASS_S = math.radians(25.0), 2.0
METHODS = ("smoothed", "filter")
PLACE = [0, 3]  # Azimuth and logarithm of the range, of a state
ELLIPSE_HALVED = math.log(10.0)  # Half the quantile of .9 of chi-square with two degrees of freedom


def stream_passes(path: Path, passes: int, seed: int = 0) -> tuple[HeardStream, list[PassLabel], int]:
    """Return a stream, the labels of its first passes, and how many vehicles came until then."""
    stream, camera = HeardStream.load(path), PinholeCamera()
    log = stream_detections(stream, np.random.default_rng(seed), camera)
    tracks = [one for one in box_tracks(log, camera, EVERYBODY) if one.arm is not None][:passes]
    until_s = float(tracks[-1].time_s[0]) + SAME_PASS_S
    vehicles = stream.vehicles
    came = vehicles.hazard & (vehicles.entry_s > 0.0) & (vehicles.entry_s < until_s)
    return stream, label_passes(tracks, camera.position_m[0]), int(came.sum())


def true_track(stream: HeardStream, one: PassLabel) -> tuple[float, TrueTrack] | None:
    """Return T0 and path of the vehicle that a label is of, None where none came at that time."""
    vehicles = stream.vehicles
    near = np.where(vehicles.arm == one.arm, np.abs(vehicles.entry_s - one.t0.time_s), np.inf)
    near[~vehicles.hazard] = np.inf
    row = int(np.nanargmin(near))
    if near[row] > SAME_PASS_S:
        return None
    mine = stream.rows.vehicle == vehicles.vehicle[row]
    time_s, x, y, seen = (stream.rows.columns[name][mine] for name in ("time_s", "x_m", "y_m", "in_view"))
    # Rows hold the front axle; boxes show the bumper ahead of it.
    y = y - (1.0 if one.arm == "left" else -1.0) * vehicle_kind(str(vehicles.kind[row])).axles_m[0]
    return float(vehicles.entry_s[row]), TrueTrack(time_s, np.arctan2(y, x), seen, np.stack([x, y], axis=1))


def filtered_track(stream: HeardStream, one: PassLabel) -> SmoothedTrack:
    """Return what a filter would have stated at every hop until T0."""
    hops, belief, said = stream.hops, start_of(one.arm), []
    first, last = np.searchsorted(hops.time_s, [one.track.time_s[0], one.t0.time_s]).tolist()
    for hop in range(first, last):
        belief = motion.predict(belief, HOP_S, 1.0)
        bearing = float(hops.bearing_rad[hop])
        # Images on the other side say nothing of this one.
        if np.isfinite(bearing) and (bearing > 0.0) == (one.arm == "left"):
            belief = motion.update_azimuth(belief, bearing, HIDDEN_BEARING_STD_RAD, 1.0)
        if np.isfinite(hops.looming_hz[hop]):
            rate, std = float(hops.looming_hz[hop]), float(hops.looming_std_hz[hop])
            belief = motion.update_approach(belief, rate, math.hypot(std, 0.3), 1.0)
        said.append(belief)
    stamps = np.round(1e9 * hops.time_s[first:last]).astype(np.int64)
    return SmoothedTrack("filter", stamps, MotionBelief.stacked(said), np.zeros(2))


def pass_errors(stream: HeardStream, one: PassLabel) -> dict[str, list[float]]:
    """Return errors of T0, and of smoother and filter at every lead; none for a label of no vehicle."""
    found = true_track(stream, one)
    if found is None:
        return {}
    entry_s, vehicle = found
    true = _at(vehicle.time_s, vehicle.position_m @ np.array([1.0, 1j]), entry_s)
    told = {"t0_s": [one.t0.time_s - entry_s]}
    for name, track in zip(METHODS, (one.track, filtered_track(stream, one)), strict=True):
        mean = _at(track.time_s, track.motion.mean, entry_s)
        spread = _at(track.time_s, track.motion.covariance, entry_s)[:, PLACE][:, :, PLACE]
        said = np.exp(mean[:, 3] + 1j * mean[:, 0])
        off = np.stack([np.angle(said * true.conj()), np.log(np.abs(said) / np.abs(true))], axis=1)
        told[f"{name}_m"] = np.abs(said - true).tolist()
        told[f"{name}_deg"] = np.degrees(np.abs(off[:, 0])).tolist()
        told[f"{name}_nees"] = _halved(off, spread).tolist()
        place = _at(track.time_s, track.states, entry_s)[:, :2]
        aside = place - np.stack([true.real, true.imag], axis=1)
        square = _halved(aside, _at(track.time_s, track.covariance, entry_s)[:, :2, :2])
        told[f"{name}_place_nees"] = square.tolist()
        told[f"{name}_covered"] = np.where(np.isnan(square), math.nan, square < ELLIPSE_HALVED).tolist()
    return told


def _halved(off: FloatArray, spread: FloatArray) -> FloatArray:
    """Return the squared error over the covariance, of two numbers each, halved."""
    return np.asarray(0.5 * np.einsum("ni,nij,nj->n", off, np.linalg.inv(spread), off))


def _at(time_s: FloatArray, rows: FloatArray, entry_s: float) -> FloatArray:
    """Return rows at every lead, linear between two, NaN from half a hop beyond the first and last on."""
    asked_s = entry_s - LEADS_S
    columns = [np.interp(asked_s, time_s, column) for column in rows.reshape(len(rows), -1).T]
    found = np.stack(columns, axis=1).reshape(LEADS_S.size, *rows.shape[1:])
    found[(asked_s < time_s[0] - 0.5 * HOP_S) | (asked_s > time_s[-1] + 0.5 * HOP_S)] = math.nan
    return found


def figures(found: list[dict[str, list[float]]], came: int, rng: np.random.Generator) -> dict[str, object]:
    """Return the figures of passes with their intervals."""
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
        measure = _mean if key.endswith(("nees", "covered")) else _rms
        for column in shown:
            told[f"{key} {LEADS_S[column]:g} s"] = _interval([values[:, [column]]], measure, rng)
        told[f"{key} hidden"] = _interval([values], measure, rng)
        told[f"{key} hidden, median"] = round(float(np.nanmedian(values)), 2)
    for unit in ("m", "deg"):
        pair = [errors[f"{name}_{unit}"] for name in METHODS]
        told[f"smoothed_{unit} of filter_{unit}"] = _interval(pair, lambda a, b: _rms(a) / _rms(b), rng)
    for column in shown:
        told[f"smoothed_m median {LEADS_S[column]:g} s"] = round(
            float(np.nanmedian(errors["smoothed_m"][:, column])), 2
        )
    return told


def _mean(values: FloatArray) -> float:
    return float(np.nanmean(values))


def _rms(errors: FloatArray) -> float:
    return math.sqrt(np.nanmean(errors**2))


def _interval(
    columns: list[FloatArray], measure: Callable[..., float], rng: np.random.Generator
) -> list[float]:
    """Return a figure of passes, and its interval of nine tenths."""
    known = np.all([np.isfinite(one).any(axis=1) for one in columns], axis=0)
    kept = [one[known] for one in columns]
    draws = rng.integers(0, known.sum(), (1000, known.sum()))
    low, high = np.quantile([measure(*(one[rows] for one in kept)) for rows in draws], (0.05, 0.95))
    return [round(float(value), 2) for value in (measure(*kept), low, high)]


def write_figure(path: Path, one: PassLabel, stream: HeardStream) -> None:
    """Draw a pass from above: smoother and filter, the edge as learned, and the true track."""
    track, found = filtered_track(stream, one), true_track(stream, one)
    with figure_file(path, 8.5, 3.4) as figure:
        axes = figure.add_subplot()
        draw_track(axes, track, np.ones(len(track.stamps_ns), bool), RED, f"{one.arm}, filter")
        draw_passes(axes, [one], [found[1]] if found else [])
        legend_beside(axes)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("streams", type=Path, nargs="+", metavar="NPZ")
    add("--passes", type=int, default=30, help="of every stream, the first so many (default: %(default)s)")
    add("--figure", type=Path, metavar="PNG", help="draw the pass of the median hidden error")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the benchmark; return what it found."""
    found, came = [], 0
    for path in arguments.streams:
        stream, passes, vehicles = stream_passes(path, arguments.passes)
        found += [(one, stream, errors) for one in passes if (errors := pass_errors(stream, one))]
        came += vehicles
    told = figures([errors for *_, errors in found], came, np.random.default_rng(0))
    if arguments.figure:
        hidden_m = [_rms(np.array(errors["smoothed_m"])) for *_, errors in found]
        write_figure(arguments.figure, *found[int(np.argsort(hidden_m)[len(found) // 2])][:2])
    return CommandResult(told)
