"""`worldstate-lab bench street`: what ten passes tell of a street.

Without streams only what needs no sound: vehicles at drawn junctions before a camera with misses, ten passes
at a time. Corners are the plan's. A change is the same arm at another junction, seen after ten passes. With
streams (approaches of the named junctions) the filter follows each with the usual street and with the one
learned from its first ten passes, or --passes; the passes after these are compared in pairs, intervals of
95 % by 1000 draws of passes. What is left of the azimuth's error with the true time to visible, and with the
true azimuth at T0 in place of the edge besides, is the share of the time and that of the place.
"""

import argparse
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from worldstate.abduction.sequence.sequence_model import HORIZONS_S
from worldstate.adapters.acoustic_sequence import street_listener
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.files.model_file import read_model
from worldstate.cli.common.output import CommandResult
from worldstate.commissioning.heard_stream import HeardStream, junction_named, vehicle_rows, vehicle_table
from worldstate.commissioning.sequence_training import stream_truth
from worldstate.commissioning.stream_exam import alarm_outcomes, approaches
from worldstate.core.filter import WorldFilter
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.values import wrap_angle
from worldstate.operations.labelling.box_tracks import box_tracks
from worldstate.operations.labelling.street_passes import seen_edge, streets_after
from worldstate.operations.metrics.approach_table import rising_edges
from worldstate.operations.recordings.hop_table import HOP_S, HopTable
from worldstate.simulation.scene.settings import rate_for
from worldstate.simulation.stream.settings import StreamSettings, traffic_named
from worldstate.simulation.stream.writing import draw_stream
from worldstate.smoothing.learned_edge import LearnedEdge
from worldstate.smoothing.learned_street import LearnedStreet, context_of
from worldstate.state.context import Context
from worldstate_lab.passes.followed_stream import (
    EVERYBODY,
    FollowedStream,
    followed,
    stream_measurements,
    watched_stream,
)
from worldstate_lab.passes.pass_outcomes import true_azimuth
from worldstate_lab.passes.stream_camera import stream_detections

EXAMPLE = "example: worldstate-lab bench street --junctions 20"

PASSES, MINUTES, SEED, NOTICED = 10, 30.0, 7, 3
SIDES = ("left", "right")
BANDS_DEG = ((0, 1), (1, 2), (2, 4), (4, 8), (8, 90))  # Of changes
# Of a pass; outwards is positive of degrees.
KEYS = ("azimuth_deg", "nees", "time_s", "side", "true_time_deg", "true_place_deg")
Edges = list[tuple[str, float]]
PassErrors = dict[str, list[float]]


@dataclass(frozen=True, slots=True)
class ComparedStream:
    """The passes of a stream after the first ones, with the usual street and with the learned one."""

    site: str
    usual: list[PassErrors]
    street: list[PassErrors]
    figures: dict[str, dict[str, float]]


def edges_of(name: str, seed: int) -> Edges:
    """Return arm and edge of every vehicle that came out of hiding at a junction, in order."""
    array = MicrophoneArray(np.array([[0.0, 0.1, 0.0], [0.0, -0.1, 0.0], [0.0, 0.0, 0.1]]))
    traffic, rate = traffic_named("approaches"), rate_for(2000.0)
    settings = StreamSettings(junction_named(name), MINUTES, seed, traffic, sample_rate_hz=rate)
    stream, camera = unheard_stream(settings, array), PinholeCamera()
    log = stream_detections(stream, np.random.default_rng(seed), camera)
    told = [
        (one.arm, seen_edge(one.arm, one.edge_rad)) for one in box_tracks(log, camera, EVERYBODY) if one.arm
    ]
    return [(arm, edge_rad) for arm, edge_rad in told if edge_rad is not None]


def unheard_stream(settings: StreamSettings, array: MicrophoneArray) -> HeardStream:
    """Draw a stream of which no sound is rendered: its hops hold times only."""
    stream = draw_stream(settings, array)
    hops = HopTable(
        {"time_s": np.arange(HOP_S, settings.duration_s, HOP_S)},
        name=settings.name,
        about={"site": settings.site.name, "traffic": settings.traffic.name, "seed": settings.seed},
    )
    silence = {one.number: np.zeros(len(one.time_s)) for one in stream.vehicles}
    return HeardStream(hops, vehicle_table(stream.vehicles), vehicle_rows(stream.vehicles, silence))


def corners_of(name: str) -> dict[str, float]:
    """Return the azimuth of the corner of either arm of a junction."""
    plan = junction_named(name)
    asides = zip(SIDES, (plan.corner_left_m, plan.corner_right_m), strict=True)
    return {arm: math.atan2(aside_m, plan.corner_ahead_m) for arm, aside_m in asides}


def tens(edges: Edges) -> Iterator[Edges]:
    """Yield ten passes at a time."""
    for first in range(0, len(edges) - PASSES + 1, PASSES):
        yield edges[first : first + PASSES]


def learned(edges: Edges, arm: str) -> LearnedEdge:
    """Return the edge of an arm after these passes."""
    edge = LearnedEdge()
    for other, edge_rad in edges:
        edge = edge.with_pass(abs(edge_rad)) if other == arm else edge
    return edge


def geometry(junctions: int) -> dict[str, object]:
    """Errors of corners after ten passes, false changes, and changes noticed by their size."""
    names = [f"S{'AB'[i % 2]}{101 + i // 2}" for i in range(junctions)]
    edges = {name: edges_of(name, SEED + i) for i, name in enumerate(names)}
    errors, false, counted = [], 0, 0
    for name in names:
        for ten in tens(edges[name]):
            both = {arm: learned(ten, arm) for arm in SIDES}
            errors += [
                both[arm].mean_rad - corners_of(name)[arm] for arm in SIDES if both[arm].moments.weight
            ]
            false += any(edge.changes for edge in both.values())
            counted += 1
    sizes, needed = [], []
    for name in names:
        for other in names:
            for arm in SIDES if other != name else ():
                sizes.append(abs(corners_of(name)[arm] - corners_of(other)[arm]))
                needed.append(_needed(learned(edges[name][:PASSES], arm), edges[other], arm))
    degrees, counts = np.degrees(sizes), np.array(needed)
    off = np.degrees(np.abs(errors))
    return {
        "corners": len(off),
        "corner_off_median_deg": float(np.median(off)),
        "corner_off_worst_deg": float(off.max()),
        "within_3_deg": float(np.mean(off <= 3.0)),
        "tens": counted,
        "tens_with_a_false_change": false,
        "changes": {
            f"{low} to {high} degrees": [int(mine.sum()), float(np.mean(counts[mine] <= NOTICED))]
            for low, high in BANDS_DEG
            if (mine := (degrees >= low) & (degrees < high)).any()
        },
    }


def _needed(edge: LearnedEdge, edges: Edges, arm: str) -> float:
    """Return after how many passes of a moved edge it is noticed; infinite if never."""
    before = edge.changes
    for count, edge_rad in enumerate((one for other, one in edges if other == arm), start=1):
        edge = edge.with_pass(abs(edge_rad))
        if edge.changes > before:
            return count
    return math.inf


def compared(path: Path, passes: int, window_s: Sequence[float]) -> ComparedStream:
    """Follow a stream with the usual street and with the one learned from its first passes."""
    model = read_model(None)
    stream, recording = HeardStream.load(path), watched_stream(path, 0, model)
    *stages, _ = streets_after(LearnedStreet(stream.site), recording)
    street = stages[passes - 1]
    since_s = sorted(one.t0.time_s for one in recording.passes)[passes - 1] + 3.0
    listener = street_listener(model.domain, street.patterns, None)
    errors, figures = {}, {}
    for name, context, hears in (("usual", Context(), None), ("street", context_of(street), listener)):
        measured = stream_measurements(path, model, "all", 0, hears)[1]
        one = followed(WorldFilter(context, model.policies.for_alpha(0.02)), measured)
        errors[name] = passes_of(stream, one, since_s, window_s, context)
        figures[name] = figures_of(stream, one, since_s)
    return ComparedStream(stream.site, errors["usual"], errors["street"], figures)


def passes_of(
    stream: HeardStream, one: FollowedStream, since_s: float, window_s: Sequence[float], context: Context
) -> list[PassErrors]:
    """Return errors of azimuth, time and side in the last seconds before T0, pass by pass."""
    found = []
    for approach in approaches(stream):
        if approach.quiet or approach.entries_s[0] < since_s:
            continue
        entry_s, side = approach.entries_s[0], approach.sides[0]
        vehicle = int(stream.vehicles.vehicle[np.nanargmin(np.abs(stream.vehicles.entry_s - entry_s))])
        corner, entry = context.occluders[side], true_azimuth(stream, vehicle, entry_s)
        starts = {"true_time_deg": corner.edge_azimuth_rad, "true_place_deg": entry}
        mine: PassErrors = {key: [] for key in KEYS}
        lead_s, (first_s, last_s) = one.time_s - entry_s, window_s
        for hop in np.flatnonzero((lead_s > -first_s) & (lead_s < -max(last_s, 0.05))).tolist():
            azimuth = true_azimuth(stream, vehicle, float(one.time_s[hop]))
            for entity in one.hidden(hop, side, 0.5)[:1]:
                if azimuth is None:
                    continue
                off = wrap_angle(entity.azimuth_rad - azimuth)
                mine["azimuth_deg"].append(math.degrees(math.copysign(off, off * azimuth)))
                mine["nees"].append((off / entity.azimuth_std_rad) ** 2)
                for key, start in starts.items():
                    if start is not None:
                        told = math.atan(math.tan(abs(start)) - corner.pace_hz * lead_s[hop])
                        mine[key].append(math.degrees(told - abs(azimuth)))
            best_s, soon = one.time_to_visible_s[hop, side, 1], one.within[hop, :, HORIZONS_S.index(2.0)]
            if np.isfinite(best_s):
                mine["time_s"].append(float(best_s + lead_s[hop]))
            if approach.flow == "single" and np.isfinite(soon).all():
                mine["side"].append(float(soon[side] > soon[1 - side]))
        found.append(mine)
    return found


def figures_of(stream: HeardStream, one: FollowedStream, since_s: float) -> dict[str, float]:
    """Return skill, warnings and onsets after the first passes."""
    later, truth = one.time_s > since_s, stream_truth(stream).coming_s
    soon, comes = one.within[later][:, :, HORIZONS_S.index(2.0)], truth[later] <= 2.0
    alarms = [
        a for a in alarm_outcomes(stream, one.time_s, one.advisory) if a.approach.entries_s[0] > since_s
    ]
    loud = [a for a in alarms if not a.approach.quiet]
    onsets_s = one.time_s[rising_edges(one.advisory.any(axis=1))]
    entries_s = stream.vehicles.entry_s[stream.vehicles.hazard]
    stray = [
        at for at in onsets_s[onsets_s > since_s] if not ((entries_s > at - 1) & (entries_s < at + 8)).any()
    ]
    hours = (one.time_s[-1] - since_s) / 3600.0
    single, both = ([a for a in loud if a.approach.flow == flow] for flow in ("single", "both"))
    return {
        "singles": len(single),
        "other_side_too": sum(a.other_side for a in single),
        "two_sided": len(both),
        "both_found": sum(a.every_side for a in both),
        "skill_2s": float(1.0 - np.nanmean((soon - comes) ** 2) / (comes.mean() * (1.0 - comes.mean()))),
        "warned": float(np.mean([a.detected for a in loud])),
        "stray_onsets_per_hour": len(stray) / hours,
    }


def paired_errors(streams: Sequence[ComparedStream]) -> dict[str, object]:
    """Return root mean squares with the usual and the learned street, and intervals of differences."""
    rng, found = np.random.default_rng(0), dict[str, object]()
    for key in KEYS:
        pairs, sites = [], dict[str, list[tuple[list[float], list[float]]]]()
        for stream in streams:
            both = zip(stream.usual, stream.street, strict=True)
            mine = [(a[key], b[key]) for a, b in both if a[key] and b[key]]
            pairs += mine
            sites.setdefault(stream.site, []).extend(mine)
        draws = [[pairs[i] for i in rng.integers(0, len(pairs), len(pairs))] for _ in range(1000)]
        apart = [_pooled(key, draw, 1) - _pooled(key, draw, 0) for draw in draws]
        found[key] = {
            "passes": len(pairs),
            "usual": _pooled(key, pairs, 0),
            "street": _pooled(key, pairs, 1),
            "difference": np.quantile(apart, [0.025, 0.975]).round(3).tolist(),
            "means": [float(np.mean(np.concatenate([pair[k] for pair in pairs]))) for k in (0, 1)],
            "sites": {
                site: [round(_pooled(key, mine, k), 3) for k in (0, 1)] for site, mine in sites.items()
            },
        }
    return found


def _pooled(key: str, pairs: Sequence[tuple[list[float], list[float]]], which: int) -> float:
    values = np.concatenate([pair[which] for pair in pairs])
    return float(np.sqrt(np.mean(values**2)) if key.endswith(("_deg", "_s")) else np.mean(values))


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("streams", type=Path, nargs="*", metavar="NPZ", help="approaches at the named junctions")
    add("--junctions", type=int, default=20, help="drawn ones (default: %(default)s)")
    window = "seconds before T0 that count (default: %(default)s)"
    add("--window", type=float, nargs=2, default=[3.0, 0.0], metavar="S", help=window)
    add("--passes", type=int, default=PASSES, help="learned from (default: %(default)s)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the benchmark; return what it found."""
    report: dict[str, object] = {"geometry": geometry(arguments.junctions)}
    streams = [compared(path, arguments.passes, arguments.window) for path in arguments.streams]
    if streams:
        report["street"] = paired_errors(streams)
        report["figures"] = [{"site": one.site, **one.figures} for one in streams]
    return CommandResult(report)
