"""The whole world-state on made-up streams: who is warned of, who keeps an identity, who takes none."""

import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from worldstate_lab.passes.followed_stream import EVERYBODY, PassedStream, followed
from worldstate_lab.passes.pass_outcomes import pass_figures
from worldstate_lab.passes.stream_camera import stream_detections

from worldstate import Context, Measurement, NotUsable, SignatureEvidence, WorldFilter, nanoseconds
from worldstate.abduction.co_evidence import Unqueried
from worldstate.abduction.sequence.sequence_model import COMING_S, GROUPS, SequenceAlarm
from worldstate.abduction.sequence.sequence_reader import SequenceReading
from worldstate.adapters.acoustic import asked_again
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.vision_query import VisionQuery
from worldstate.belief.hidden_bearing import hidden_bearing
from worldstate.belief.site_geometry import SideGeometry
from worldstate.commissioning.heard_stream import HeardStream
from worldstate.commissioning.sequence_training import stream_truth
from worldstate.operations.recordings.hop_table import HopTable

Vehicle = tuple[str, str, float]  # flow, arm, T0; "from_ahead" comes along the ego's own street
CORNER_RAD, STREET_M, PACE_MPS = math.radians(32.0), 9.0, 4.5
DUMB = SignatureEvidence(("left", "right"), (0.0, 0.0), 0.0, 0.0)


def stream(vehicles: list[Vehicle], duration_s: float = 60.0) -> HeardStream:
    """Return vehicles that cross the street ahead, seen between the corners, or come down the ego's own."""
    rows, edge_m = [], STREET_M * math.tan(CORNER_RAD)
    for number, (flow, arm, entry_s) in enumerate(vehicles):
        for time_s in np.round(np.arange(max(entry_s - 8.0, 0.0), entry_s + 4.0, 0.1), 1):
            x_m, y_m = STREET_M, (1.0 if arm == "left" else -1.0) * (edge_m - PACE_MPS * (time_s - entry_s))
            if flow == "from_ahead":
                x_m, y_m = 22.0 - 4.0 * (time_s - entry_s), 0.5
            seen = bool(time_s > entry_s and abs(y_m) <= edge_m and x_m > 4.0)
            rows.append((number, time_s, x_m, y_m, seen, 60.0))
    flow, arm, entry_s = zip(*vehicles, strict=True)
    told = {
        "vehicle": np.arange(len(vehicles)),
        "flow": np.array(flow, np.str_),
        "kind": np.array(["light"] * len(vehicles), np.str_),
        "arm": np.array(arm, np.str_),
        "entry_s": np.array(entry_s, np.float64),
        "hazard": np.array([one != "from_ahead" for one in flow]),
    }
    names = ("vehicle", "time_s", "x_m", "y_m", "in_view", "loudness_db")
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    hops = HopTable({"time_s": np.round(np.arange(1.0, duration_s, 0.1), 1)}, about={"site": "SB2"})
    return HeardStream(hops, HopTable(told), HopTable(dict(zip(names, columns, strict=True))))


def heard(made_up: HeardStream, lag_s: float = 0.4) -> list[Measurement]:
    """Return what a good sequence model says: the group of `lag_s` ago, as sure as .8, and the camera."""
    groups = stream_truth(made_up).groups()
    said = np.full((*groups.shape, len(GROUPS)), 0.2 / (len(GROUPS) - 1))
    np.put_along_axis(said, groups[..., None], 0.8, -1)
    said = np.concatenate([np.repeat(said[:1], round(lag_s * 10), axis=0), said])[: len(groups)]
    share = np.full(len(GROUPS), 0.02)
    share[GROUPS.index("none")] = 1.0 - 0.02 * (len(GROUPS) - 1)
    detections = stream_detections(made_up, np.random.default_rng(1))
    vision = VisionQuery(PinholeCamera(), detections, keep=EVERYBODY)
    silent, unasked = NotUsable("not scripted"), Unqueried("no camera")
    measured = []
    for time_s, sides in zip(made_up.hops.time_s.tolist(), said, strict=True):
        reading = SequenceReading(sides, share, 0.0, SequenceAlarm(0.0, 20.0))
        plain = Measurement(nanoseconds(time_s), DUMB, unasked, silent, silent, sequence=reading)
        measured.append(asked_again(plain, vision))
    return measured


def test_a_vehicle_is_warned_of_keeps_its_identity_and_raises_nothing_once_it_is_seen() -> None:
    made_up = stream([("left", "left", 12.0), ("right", "right", 26.0), ("from_ahead", "left", 40.0)])
    follow = followed(WorldFilter(Context()), heard(made_up))
    told = pass_figures([PassedStream(made_up, stream_truth(made_up), follow)])
    assert (told["approaches"], told["detected"], told["other_side_too"]) == (2, 1.0, 0.0)
    assert (told["identity_judged"], told["identity_kept"]) == (2, 1.0)
    # The sequence says "coming" for another .4 s after T0: it is the one that the camera has in view.
    assert told["onset_after_pass"] == 0.0
    assert (told["seen_ahead"], told["took_hidden_identity"]) == (1, 0.0)
    assert told["skill_2s"] is not None and told["skill_2s"] > 0.3
    assert told["hidden_nees"] is not None and 0.05 < float(told["hidden_nees"]) < 1.5


def test_two_that_come_at_once_are_two_and_a_car_ahead_is_neither() -> None:
    made_up = stream([("both", "left", 15.0), ("both", "right", 15.8), ("from_ahead", "left", 9.5)])
    follow = followed(WorldFilter(Context()), heard(made_up))
    told = pass_figures([PassedStream(made_up, stream_truth(made_up), follow)])
    assert (told["both_sides_found"], told["phantom_third"]) == (1.0, 0.0)
    assert (told["identity_kept"], told["took_hidden_identity"]) == (1.0, 0.0)


def test_of_a_street_where_nobody_comes_what_cannot_be_told_is_none() -> None:
    made_up = stream([("from_ahead", "left", 12.0)], duration_s=30.0)
    follow = followed(WorldFilter(Context()), heard(made_up))
    told = pass_figures([PassedStream(made_up, stream_truth(made_up), follow)])
    assert (told["onsets_per_hour"], told["detected"], told["time_rmse_of_constant"]) == (0.0, None, None)
    json.dumps(told, allow_nan=False)


def test_boxes_stand_where_the_truth_has_a_vehicle_in_view() -> None:
    made_up = stream([("left", "left", 12.0)])
    log = stream_detections(made_up, np.random.default_rng(1))
    boxed_s = log.stamps_ns[[len(frame) > 0 for frame in log.frames]] * 1e-9
    assert 12.0 < boxed_s[0] < 12.6 and boxed_s[-1] < 15.0 and boxed_s.size > 15
    middles = [np.mean(frame.boxes_px[0, [0, 2]]) for frame in log.frames if len(frame)]
    # It crosses from the left to the right of the image.
    assert middles[0] < 600 and middles[-1] > 1300


@given(st.integers(0, 2**32 - 1), st.floats(0.2, 1.2))
@settings(max_examples=10)
def test_a_hidden_bearing_lies_behind_the_edge_and_is_mirrored(seed: int, edge_rad: float) -> None:
    coming = np.random.default_rng(seed).dirichlet(np.ones(len(COMING_S)))
    sides = [SideGeometry("left", s * edge_rad, s * 1.2, 0.35) for s in (1.0, -1.0)]
    (left, std), (right, same) = (hidden_bearing(coming, side) for side in sides)
    assert (left, std) == pytest.approx((-right, same))
    assert edge_rad - 1e-9 <= left <= math.radians(80.0) and 0.0 < std < 0.6
    nearer = coming.copy()
    nearer[0], nearer[1:] = 0.9, 0.1 * coming[1:] / coming[1:].sum()
    assert coming[0] > 0.9 or hidden_bearing(nearer, sides[0])[0] <= left + 1e-9


@given(st.floats(0.0, 8.0))
@settings(max_examples=20)
def test_a_known_edge_narrows_the_bearing_and_keeps_the_errors_of_the_time(edge_deg: float) -> None:
    """An edge less sure than the usual one adds all of its variance, a surer one leaves half of the usual."""
    coming = np.full(len(COMING_S), 1.0 / len(COMING_S))

    def variance(degrees: float) -> float:
        side = SideGeometry("left", 0.56, 0.96, 0.35, math.radians(degrees))
        return math.degrees(math.degrees(hidden_bearing(coming, side)[1] ** 2))

    expected = edge_deg**2 - 25.0 if edge_deg > 5.0 else 0.5 * (edge_deg**2 - 25.0)
    assert variance(edge_deg) - variance(5.0) == pytest.approx(expected, abs=1e-6)


def test_the_benchmark_charges_silence_half_the_cutoff_and_trackers_follow_the_boxes() -> None:
    pytest.importorskip("stonesoup", reason="the benchmark's trackers: pip install 'worldstate[oracles]'")
    import worldstate_lab.cli.bench.gospa as bench

    made_up = stream([("left", "left", 8.0)], duration_s=12.0)
    costs, hops = bench.costs(made_up, heard(made_up), WorldFilter(Context()))
    assert hops.tolist() == pytest.approx([50, 24], abs=1)
    per_hop = {method: cost / hops[:, None] for method, cost in costs.items()}
    # One vehicle, of which nothing is said: 30 degrees a hop for a miss, and no others.
    np.testing.assert_allclose(per_hop[bench.SILENCE], [[0.0, 30.0, 0.0]] * 2, atol=1e-9)
    hidden, visible = per_hop[bench.WORLD].sum(axis=1)
    assert hidden < 15.0 and visible < 15.0
    for tracker in (bench.UNHEARING, bench.OC_SORT, bench.GM_PHD, bench.JPDA):
        hidden, visible = per_hop[tracker].sum(axis=1)
        # Without the sound nobody knows of whom no box has shown; a box, each of them follows.
        assert hidden >= 29.0 and visible < 20.0 and per_hop[tracker][1, 0] < 10.0
