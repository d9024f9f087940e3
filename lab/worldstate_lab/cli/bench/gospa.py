"""`worldstate-lab bench gospa`: GOSPA on bearing of the world-state beside trackers, on streams.

Streams kept by `worldstate model make` are followed hop by hop. The cut-off is 60 degrees, with p = 1 and
alpha = 2. Hidden vehicles come into view within five seconds; visible ones are in line of sight and in the
image. Every method gives both. A tracker has no occlusion model: its tracks in the sector of the boxes are
visible.

example: worldstate-lab bench gospa streams/S??-*.npz --seconds 120
"""

import argparse
import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from itertools import takewhile
from pathlib import Path

import numpy as np

from worldstate import WorldFilter
from worldstate.abduction.evidence import SignatureEvidence
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.files.model_file import Model, read_model
from worldstate.cli.common.output import CommandResult
from worldstate.commissioning.heard_stream import HeardStream
from worldstate.ground.typing import FloatArray
from worldstate.ground.values import NotUsable
from worldstate.measurement.measurement import Measurement
from worldstate.operations.metrics.approach_table import LONGEST_LEAD_S
from worldstate.operations.recordings.hop_table import HOP_S
from worldstate.state import WorldState
from worldstate_lab.methods.oc_sort import OcSort
from worldstate_lab.metrics.track_measures import gospa_bearing
from worldstate_lab.passes.followed_stream import stream_detections, stream_measurements
from worldstate_lab.report.table import Cell, Table, Value

SILENCE, WORLD, UNHEARING = "silence", "world-state", "world-state without sound"
OC_SORT, GM_PHD, JPDA = "OC-SORT on the boxes", "GM-PHD (Stone Soup)", "JPDA (Stone Soup)"
PHASES, PARTS = ("hidden", "visible"), ("localised", "missed", "false")
EXISTS, ALPHA = 0.5, 0.02
Row = dict[str, float | None]
Costs = tuple[dict[str, FloatArray], FloatArray]
# By method: azimuths of hidden and of visible vehicles.
Said = dict[str, tuple[Sequence[float], Sequence[float]]]


def stated(
    heard: HeardStream, measured: Iterable[Measurement], start: WorldFilter
) -> Iterator[tuple[int, Said]]:
    """Yield the number of every hop of a stream, in tenths of a second, and the output of every method."""
    # Optional: this benchmark alone needs Stone Soup.
    from worldstate_lab.benchmarks.stone_soup_trackers import GmPhd, Jpda, scan_time, scans

    taken = list(measured)
    view, boxes = _view(taken), _oc_sort(heard)
    world, deaf, phd, jpda = start, start, GmPhd(), Jpda()
    for one in taken:
        world, deaf = world.update(one), deaf.update(_unheard(one))
        both, when, hop = scans(one, view), scan_time(one), round(one.stamp_ns * 1e-9 / HOP_S)
        said: Said = {
            SILENCE: ((), ()),
            WORLD: _by_phase(world.state),
            UNHEARING: _by_phase(deaf.state),
            OC_SORT: ((), boxes[hop]),
            GM_PHD: _by_place(phd.step(both, when), view),
            JPDA: _by_place(jpda.step(both, when), view),
        }
        yield hop, said


def _view(measured: Sequence[Measurement]) -> tuple[float, float]:
    """Return the sector of the boxes, from right to left, which the trackers are given."""
    azimuths = [box.azimuth_rad for one in measured for box in one.sightings]
    right, left = np.quantile(azimuths or [0.0], [0.01, 0.99])
    return float(right), float(left)


def _unheard(one: Measurement) -> Measurement:
    silent = NotUsable("not measured")
    even = SignatureEvidence(one.signature.directions, (0.0, 0.0), 0.0, 0.0)
    return replace(one, signature=even, bearing=silent, approach=silent, sequence=None)


def _by_phase(state: WorldState) -> tuple[list[float], list[float]]:
    """Return the azimuths of hidden vehicles that come within five seconds, and of those in view."""
    # A cue has a time if a vehicle is more likely than not to come within five seconds.
    coming_s = {cue.direction: cue.time_to_visible_s[1] for cue in state.cues if cue.time_to_visible_s}
    there = [one for one in state.entities if one.existence_probability >= EXISTS]
    hidden = [one for one in there if one.status == "hidden"]
    soon = [one for one in hidden if coming_s.get(str(one.direction), math.inf) <= LONGEST_LEAD_S]
    # A vehicle that has left the view is kept for some seconds without queries to the camera.
    seen = [one for one in there if one.status != "hidden" and one.visibility.answer != "unqueried"]
    return [one.azimuth_rad for one in soon], [one.azimuth_rad for one in seen]


def _by_place(azimuths: Sequence[float], view: tuple[float, float]) -> tuple[list[float], list[float]]:
    seen = [one for one in azimuths if view[0] <= one <= view[1]]
    return [one for one in azimuths if one not in seen], seen


def _oc_sort(heard: HeardStream) -> list[list[float]]:
    """Return the azimuths of the tracks of OC-SORT, image by image."""
    sort, camera = OcSort(), PinholeCamera.ovad()
    emitted = []
    for frame in stream_detections(heard, np.random.default_rng(0)).frames:
        tracks = [one for one in sort.step(frame.boxes_px, frame.scores) if one.certain]
        emitted.append([float(camera.azimuth(0.5 * (one.box_px[0] + one.box_px[2]))) for one in tracks])
    return emitted


def true_azimuths(heard: HeardStream) -> dict[int, tuple[list[float], list[float]]]:
    """Return the azimuths of the hidden and of the visible vehicles, by the number of the hop."""
    rows, right_left = heard.rows, PinholeCamera.ovad().view_rad
    hazards = heard.vehicles.vehicle[heard.vehicles.hazard]
    entry_s = dict(zip(hazards.tolist(), heard.vehicles.entry_s[heard.vehicles.hazard].tolist(), strict=True))
    lead_s = np.array([entry_s.get(one, np.inf) for one in rows.vehicle.tolist()]) - rows.time_s
    azimuth = np.arctan2(rows.y_m, rows.x_m)
    in_image = (azimuth >= right_left[0]) & (azimuth <= right_left[1])
    hidden = (lead_s > 0.0) & (lead_s <= LONGEST_LEAD_S) & ~rows.in_view
    there: dict[int, tuple[list[float], list[float]]] = defaultdict(lambda: ([], []))
    for phase, mask in enumerate((hidden, rows.in_view & in_image)):
        for hop, angle in zip(
            np.round(rows.time_s[mask] / HOP_S).astype(int).tolist(), azimuth[mask].tolist(), strict=True
        ):
            there[hop][phase].append(angle)
    return there


@cache
def _parts_deg(estimates: tuple[float, ...], truths: tuple[float, ...]) -> FloatArray:
    one = gospa_bearing(estimates, truths)
    return np.degrees([one.localisation, one.missed, one.false])


def costs(heard: HeardStream, measured: Iterable[Measurement], start: WorldFilter) -> Costs:
    """Return the summed costs of every method by phase and part, degrees, and the hops with a vehicle."""
    truths, summed = true_azimuths(heard), dict[str, FloatArray]()
    hops = np.zeros(len(PHASES))
    for hop, said in stated(heard, measured, start):
        there = truths.get(hop, ((), ()))
        hops += [bool(one) for one in there]
        for method, estimates in said.items():
            parts = [_parts_deg(tuple(a), tuple(b)) for a, b in zip(estimates, there, strict=True)]
            summed[method] = summed.get(method, 0.0) + np.array(parts)
    return summed, hops


def report_of(paths: Sequence[Path], model: Model, seconds: float) -> dict[str, dict[str, dict[str, Row]]]:
    """Return the figures by junction (and of all), method and phase."""
    summed: dict[tuple[str, str], FloatArray] = {}
    hops: dict[str, FloatArray] = defaultdict(lambda: np.zeros(len(PHASES)))
    for path in paths:
        heard, measured = stream_measurements(path, model, "all", 0)
        taken = takewhile(lambda one: one.stamp_ns * 1e-9 <= seconds, measured)
        costs_deg, there = costs(heard, taken, WorldFilter(policy=model.policies.for_alpha(ALPHA)))
        for name in (str(heard.hops.about["site"]), "all"):
            hops[name] = hops[name] + there
            for method, cost in costs_deg.items():
                summed[name, method] = summed.get((name, method), 0.0) + cost
    found: dict[str, dict[str, dict[str, Row]]] = defaultdict(dict)
    for (name, method), cost in sorted(summed.items(), key=lambda one: one[0][0]):
        total = cost.sum(axis=1)
        # Hidden vehicles relative to silence, visible ones relative to a tracker of boxes.
        beside = [summed[name, SILENCE][0].sum(), summed[name, OC_SORT][1].sum()]
        found[name][method] = {
            phase: {
                **dict(zip(PARTS, (cost[k] / max(hops[name][k], 1)).round(2).tolist(), strict=True)),
                "gospa_deg": round(float(total[k] / max(hops[name][k], 1)), 2),
                "share": round(float(total[k] / beside[k]), 3) if beside[k] else None,
            }
            for k, phase in enumerate(PHASES)
        }
    return found


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("streams", type=Path, nargs="+", metavar="NPZ")
    parser.add_argument("--model", type=Path, help="model with a sequence (default: the shipped one)")
    parser.add_argument("--seconds", type=float, default=math.inf, help="of every stream (default: all)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the benchmark; return its result."""
    found = report_of(arguments.streams, read_model(arguments.model), arguments.seconds)
    junctions, lines = [name for name in found if name != "all"], list[str]()
    for phase, reference in zip(PHASES, (SILENCE, OC_SORT), strict=True):
        rows: list[tuple[Cell, ...]] = []
        for method, by_phase in found["all"].items():
            shares = {one: found[one][method][phase]["share"] or 0.0 for one in junctions}
            worst = max(shares, key=shares.__getitem__)
            rows.append((method, *by_phase[phase].values(), Value(shares[worst], digits=3, note=worst)))
        heads = (phase, *PARTS, "GOSPA", f"of {reference}", "worst")
        lines += Table("gospa", "", heads, rows).lines()
    return CommandResult(found, table={}, lines=lines)
