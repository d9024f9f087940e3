r"""`worldstate-lab street`: parameters of the street model, fitted on streams of both renderers.

Rates and shares are counts; spreads are those of the true positions about the expected ones; the others
maximise the likelihood of the truth. Parameters of the camera are means of the simulated and the real
detector. The side is that of the entity when the vehicle came into view.

Examples
--------
  worldstate-lab street streams/*-pairs-*.npz --sequences ovad-sequences
"""

import argparse
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from operator import itemgetter
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from worldstate.abduction.sequence.sequence_inputs import SIDES
from worldstate.abduction.sequence.sequence_model import COMING_S, GROUPS, HORIZONS_S
from worldstate.adapters.camera.box_linking import AzimuthBox, linked_boxes
from worldstate.adapters.files.model_file import Model, read_model
from worldstate.belief.hidden_bearing import hidden_bearing
from worldstate.belief.joint_belief import BINS, DISTANT, FIRST_BIN, NONE
from worldstate.belief.street_model import FilterSettings, StreetModel
from worldstate.cli.common.output import CommandResult
from worldstate.cli.common.progress import track
from worldstate.commissioning.heard_stream import HeardStream
from worldstate.commissioning.sequence_training import stream_truth
from worldstate.core.filter import WorldFilter
from worldstate.core.site_model import site_geometry_of
from worldstate.ground import FloatArray, seconds
from worldstate.measurement.measurement import Bearing, Measurement, Sighting
from worldstate.operations.recordings.hop_table import HOP_S
from worldstate.state import Context
from worldstate_lab.passes.followed_stream import stream_measurements
from worldstate_lab.report.table import figure_lines
from worldstate_lab.sequences.hearing import ovad_chain
from worldstate_lab.sequences.recordings import read_recordings
from worldstate_lab.sequences.tracking import NEAR_RAD

# Data of a fit, per vehicle, hop or row.
Facts: TypeAlias = defaultdict[str, list[Any]]
STREET, SITE = StreetModel(), site_geometry_of(Context(), FilterSettings())
_GAP_S = 0.35  # Three images without a box end a track
_LIKELY, _SLACK_S = 0.5, 1e-3
_ROUNDS, _VALUES = 100, 61  # Rounds of expectation-maximization, and values of a search
_LAGS = 11  # Hops of the second of a bearing


def vehicle_facts(heard: HeardStream, facts: Facts) -> tuple[FloatArray, FloatArray]:
    """Collect the arrivals of vehicles; return azimuths at every hop, NaN without one.

    The azimuths are of the next hidden vehicle of each side, shape (n, 2), and of a single one in view, shape
    (n,).
    """
    rows, vehicles, n = heard.rows, heard.vehicles, len(heard.hops)
    hops, inside = heard.row_hops()
    hidden_rad, seen = np.full((n, len(SIDES)), np.nan), np.zeros((n, 2))
    ahead = inside & rows.in_view & (rows.x_m > 0.0)
    azimuth_rad = np.arctan2(rows.y_m, rows.x_m)[ahead]
    np.add.at(seen, hops[ahead], np.stack([np.ones_like(azimuth_rad), azimuth_rad], axis=1))
    for arm in SIDES:
        entries_s = np.sort(vehicles.entry_s[vehicles.hazard & (vehicles.arm == arm)])
        facts["gap_s"] += np.diff(entries_s, append=np.inf).tolist()
    hazards = np.flatnonzero(vehicles.hazard)
    for i in hazards[np.argsort(-vehicles.entry_s[hazards])].tolist():  # The next one of a side comes last
        mine, k = inside & (rows.vehicle == vehicles.vehicle[i]), SIDES.index(vehicles.arm[i])
        way, left_s = 1 - 2 * k, vehicles.entry_s[i] - rows.time_s[mine]
        log = np.log(rows.x_m[mine] + 1j * way * rows.y_m[mine])  # log r + i theta
        hidden, in_view = (left_s > 0.0) & (left_s <= COMING_S[-1]), rows.in_view[mine]
        facts["log"] += log[hidden].tolist()
        facts["rate"] += np.gradient(log, rows.time_s[mine])[hidden].tolist()
        facts["passed_rad"] += log.imag[in_view & (rows.x_m[mine] > 0.0)].tolist()
        facts["view_s"].append(HOP_S * in_view.sum())
        hidden_rad[hops[mine][hidden], k] = way * log.imag[hidden]
    return hidden_rad, np.where(seen[:, 0] == 1.0, seen[:, 1], np.nan)


def stream_facts(path: Path, model: Model, facts: Facts) -> list[Measurement]:
    """Collect the truth of a stream and the beliefs about it; return its measurements."""
    heard, measured = stream_measurements(path, model, "all", 0)
    (hidden_rad, lone_rad), truth, world = vehicle_facts(heard, facts), stream_truth(heard), WorldFilter()
    groups, distant = truth.groups(), [GROUPS.index("rising"), GROUPS.index("falling")]
    parts = np.where(groups < BINS, groups + FIRST_BIN, np.where(np.isin(groups, distant), DISTANT, NONE))
    facts["moves"] += np.stack([parts[:-1], parts[1:]], axis=-1).reshape(-1, 2).tolist()
    comes, every = parts >= FIRST_BIN, list(measured)
    for i, hop in enumerate(every[:-2]):
        world = world.update(hop)
        assert world.memory is not None
        belief, peak = world.memory.belief, hop.bearing
        for k in range(len(SIDES)):
            if belief.comes[k] >= _LIKELY and np.isfinite(hidden_rad[i, k]):
                own_rad = (1 - 2 * k) * hidden_rad[i, k]
                facts["bearing"].append((belief.coming[k] / belief.comes[k], own_rad))
            if comes[i, k] and truth.coming_s[i, k] < truth.coming_s[i + 1, k]:
                facts["emerged"].append((belief.joint, k, belief.both_come > _LIKELY, parts[i + 2]))
                if not comes[i, 1 - k] and belief.comes.max() >= _LIKELY:
                    facts["wrong"].append(belief.comes[k] < belief.comes[1 - k])
        before_rad = lone_rad[i - np.arange(min(_LAGS, i + 1))]
        if isinstance(peak, Bearing) and not comes[i].any() and np.isfinite(before_rad).sum() == _LAGS:
            facts["peak"].append(peak.azimuth_rad - before_rad)
        soon = truth.coming_s[i] <= HORIZONS_S[-1]
        if isinstance(peak, Bearing) and comes[i].sum() == soon.sum() == 1 and not truth.seen[i]:
            facts["hidden_peak"] += (peak.azimuth_rad - hidden_rad[i, soon]).tolist()
    return every


def camera_numbers(recordings: Iterable[Sequence[Measurement]]) -> dict[str, float]:
    """Return the parameters of a camera from the boxes of recordings; moving boxes form tracks."""
    images, tracks = 0, list[list[AzimuthBox]]()
    for measured in recordings:
        looks = {one.look.stamp_ns: one.sightings for hop in measured for one in hop.looks}
        boxes = [(ns, [_box(seconds(ns), one) for one in seen if one.moving]) for ns, seen in looks.items()]
        images += len(looks)
        tracks += linked_boxes([(seconds(ns), some) for ns, some in boxes], NEAR_RAD, _GAP_S)
    several = [one for one in tracks if len(one) > 1]
    view_rad = 2.0 * SITE.view_half_angle_rad
    from_edge_rad = [
        min(side.distance_rad(one.middle_rad, one.left_rad - one.right_rad) for side in SITE.sides)
        for one, *_ in several
    ]
    widths = [np.log([box.left_rad - box.right_rad for box in one]) for one in several]
    return {
        "clutter": (len(tracks) - len(several)) / images,
        "width_change": _rms(np.concatenate([np.diff(one) for one in widths])),
        "size_spread": float(np.std([one.mean() for one in widths])),
        "edge_std_rad": _mixture(np.array(from_edge_rad), view_rad)[1],
    }


def _box(time_s: float, one: Sighting) -> AzimuthBox:
    left_rad, right_rad = one.azimuth_rad + 0.5 * one.width_rad, one.azimuth_rad - 0.5 * one.width_rad
    return AzimuthBox(time_s, left_rad, right_rad, one.azimuth_rad, math.nan, one.label)


def _rms(errors: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(errors))))


def _least(loss: Callable[[StreetModel], float], name: str) -> float:
    """Return the value with the smallest loss between a tenth and ten times the shipped one."""
    values = getattr(STREET, name) * np.geomspace(0.1, 10.0, _VALUES)
    return float(min(values.tolist(), key=lambda value: loss(replace(STREET, **{name: value}))))


def _mixture(errors: FloatArray, span_rad: float) -> tuple[float, float, float]:
    """Return by EM the share and deviation of normal errors, the rest uniform, and the likelihood."""
    share, std = 0.5, 0.1
    for _ in range(_ROUNDS):
        own = share * np.exp(-0.5 * (errors / std) ** 2) / (std * math.sqrt(2.0 * math.pi))
        every = own + (1.0 - share) / span_rad
        weight = own / every
        share, std = float(weight.mean()), float(np.sqrt(weight @ errors**2 / weight.sum()))
    return share, std, float(np.log(every).mean())


def street_numbers(facts: Facts) -> dict[str, float]:
    """Return the parameters that follow from the data of streams."""
    log, rate, moves, gaps_s = (np.array(facts[name]) for name in ("log", "rate", "moves", "gap_s"))
    side = SITE.sides[0]
    comes = moves >= FIRST_BIN
    from_none, from_far = moves[:, 0] == NONE, moves[:, 0] == DISTANT
    arrives = ((from_none | from_far) & comes[:, 1]) | (from_none & (moves[:, 1] == DISTANT))
    turning = -side.pace_hz * np.cos(log.imag) ** 2

    def bearing(street: StreetModel) -> float:
        found = [(*hidden_bearing(one, replace(side, street=street)), rad) for one, rad in facts["bearing"]]
        mean, std, true = np.array(found).T
        return float(np.mean(0.5 * ((true - mean) / std) ** 2 + np.log(std)))

    def handed_over(street: StreetModel) -> float:
        after = [
            (one.emerged(k, street.unheard, street.follows, apart, street).hidden, parts)
            for one, k, apart, parts in facts["emerged"]
        ]
        return -float(np.mean([np.log(one[[0, 1], parts]).sum() for one, parts in after]))

    # The likeliest delay after which the peak is at the vehicle's former azimuth.
    late = [(*_mixture(errors, math.pi), hops) for hops, errors in enumerate(np.array(facts["peak"]).T)]
    seen_path, seen_std, _, hops = max(late, key=itemgetter(2))
    followed = gaps_s <= COMING_S[-1]
    return {
        "passage_s": float(np.mean(facts["view_s"])),
        "arrival_s": HOP_S * float(2 * from_none.sum() + from_far.sum()) / float(arrives.sum()),
        "far_s": HOP_S * float(from_far.sum()) / float((from_far & (moves[:, 1] == NONE)).sum()),
        "unheard": _least(handed_over, "unheard"),
        "follows": float(followed.mean()),
        "follows_s": float(gaps_s[followed].max()),
        "range_m": float(np.exp(log.real.mean())),
        "range_spread": float(log.real.std()),
        "closing_hz": -float(rate.real.mean()),
        "turn_share": _rms(rate.imag / turning - 1.0),
        "past_std_rad": _rms(np.array(facts["passed_rad"]) - 0.5 * side.edge_azimuth_rad),
        "extent_rad": _least(bearing, "extent_rad"),
        "heard_std_rad": _mixture(np.array(facts["hidden_peak"]), math.pi)[1],
        "seen_path": seen_path,
        "seen_std_rad": seen_std,
        "bearing_s": hops * HOP_S,
    }


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("streams", type=Path, nargs="+", metavar="NPZ", help="streams with vehicles from hidden arms")
    add("--sequences", type=Path, metavar="DIR", help="a real corner, for the parameters of camera and side")
    add("--model", type=Path, metavar="JSON", help="model with a sequence (default: the shipped one)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return its result."""
    model, facts, real = read_model(arguments.model), Facts(list), list[list[Measurement]]()
    measured = [stream_facts(path, model, facts) for path in track(arguments.streams, "streams")]
    fitted = street_numbers(facts)
    sides, camera = [float(np.mean(facts["wrong"]))], [camera_numbers(measured)]
    if arguments.sequences is not None:
        wrong, chain = list[bool](), ovad_chain(model, path="seven_on_time")
        for one in track(read_recordings(arguments.sequences), "recordings"):
            steps = list(chain.steps(one))
            real.append([step.measurement for step in steps])
            before = [step for step in steps if step.state.time_s < one.t0_s - _SLACK_S]
            risks = {cue.direction: cue.risk or 0.0 for cue in before[-1].state.cues}
            if not one.hazard_free and max(risks.values()) >= _LIKELY:
                wrong.append(risks[one.side] < max(risks.values()))
        sides, camera = [*sides, float(np.mean(wrong))], [*camera, camera_numbers(real)]
    fitted |= {name: float(np.mean([one[name] for one in camera])) for name in camera[0]}
    fitted["side_confusion"] = float(np.mean(sides))
    # Boxes of the real detector appear anywhere in the view.
    fitted["edge_std_rad"] = camera[0]["edge_std_rad"]
    shipped = {name: float(getattr(STREET, name)) for name in fitted}
    count = {"vehicles": len(facts["view_s"]), "hand-overs": len(facts["emerged"]), "recordings": len(real)}
    report = {**count, "shipped": shipped, "fitted": fitted}
    return CommandResult(report, table={}, lines=figure_lines({"ships": shipped, "fitted": fitted}))
