"""The world-state on artificial streams: advisories, kept identities, and new entities."""

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from hop_tables import heard_stream
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import butter, lfilter, sosfilt
from worldstate_lab.cli import scenarios
from worldstate_lab.cli.scenarios import scenario_figures
from worldstate_lab.cli.streams import worst_of
from worldstate_lab.cli.street import Facts, camera_numbers, vehicle_facts
from worldstate_lab.passes.budget_days import budget_days, chance_blocks, quiet_blocks
from worldstate_lab.passes.followed_stream import (
    EVERYBODY,
    FollowedStream,
    PassedStream,
    filtered,
    stream_detections,
    stream_measurements,
)
from worldstate_lab.passes.pass_outcomes import (
    above_quiet_db,
    added_db,
    level_db,
    pass_figures,
    second_figures,
)

from worldstate import Context, Measurement, NotUsable, SignatureEvidence, WorldFilter, nanoseconds
from worldstate.abduction.co_evidence import Present, Unqueried
from worldstate.abduction.road_users import Foreign, neutral
from worldstate.abduction.sequence.sequence_model import COMING_S, GROUPS, HORIZONS_S, SequenceAlarm
from worldstate.abduction.sequence.sequence_reader import SequenceReading
from worldstate.adapters.acoustic import asked_again, beside_foreign
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.vision_query import VisionQuery
from worldstate.adapters.files.model_file import read_model
from worldstate.belief.hidden_bearing import hidden_bearing
from worldstate.belief.site_geometry import SideGeometry
from worldstate.commissioning.heard_stream import HeardStream, StreamSettings, junction_named, traffic_named
from worldstate.commissioning.sequence_training import stream_truth
from worldstate.ground.errors import InvalidArgumentError
from worldstate.measurement.measurement import Look, Sighting
from worldstate.operations.metrics.approach_table import Figures
from worldstate.simulation.dataset.recording import FULL_SCALE_PA
from worldstate.state import SideShare
from worldstate.state.cue import Tally

Vehicle = tuple[str, str, float]  # flow, arm, T0; "from_ahead" comes along the ego's own street
CORNER_RAD, STREET_M, PACE_MPS = math.radians(32.0), 9.0, 4.5
STEP_40_DB = 32767.0 * 2e-5 * 10.0 ** (40.0 / 20.0) / FULL_SCALE_PA
DUMB = SignatureEvidence(("left", "right"), (0.0, 0.0), 0.0, 0.0)


def stream(
    vehicles: list[Vehicle], duration_s: float = 60.0, band_db: list[float] | None = None
) -> HeardStream:
    """Return vehicles that cross the street ahead, visible between the corners, or come along the ego's
    own."""
    loud_db = band_db or [60.0] * len(vehicles)
    told, rows, edge_m = [], [], STREET_M * math.tan(CORNER_RAD)
    for number, (flow, arm, entry_s) in enumerate(vehicles):
        told.append((number, flow, "light", arm, entry_s, flow != "from_ahead"))
        for time_s in np.round(np.arange(max(entry_s - 8.0, 0.0), entry_s + 4.0, 0.1), 1):
            x_m, y_m = STREET_M, (1.0 if arm == "left" else -1.0) * (edge_m - PACE_MPS * (time_s - entry_s))
            if flow == "from_ahead":
                x_m, y_m = 22.0 - 4.0 * (time_s - entry_s), 0.5
            seen = bool(time_s > entry_s and abs(y_m) <= edge_m and x_m > 4.0)
            rows.append((number, time_s, x_m, y_m, seen, loud_db[number]))
    time_s = np.round(np.arange(1.0, duration_s, 0.1), 1)
    # White noise of one pascal has 94 dB: this gives 40 dB of background, of which the 1.7-kHz band has five
    # ninths.
    middle = np.random.default_rng(4).normal(0.0, STEP_40_DB, (len(time_s), 600)).round().astype(np.int16)
    hops = {"time_s": time_s, "middle": middle}
    found = heard_stream(told, rows, hops, site="SB2", sample_rate_hz=6000.0)
    return replace(found, rows=found.rows.replace(band_db=found.rows.loudness_db))


def heard(made_up: HeardStream, lag_s: float = 0.4) -> list[Measurement]:
    """Return measurements of a good sequence model (the group of `lag_s` ago, with 0.8) and of the camera."""
    groups = stream_truth(made_up).groups()
    said = np.full((*groups.shape, len(GROUPS)), 0.2 / (len(GROUPS) - 1))
    np.put_along_axis(said, groups[..., None], 0.8, -1)
    said = np.concatenate([np.repeat(said[:1], round(lag_s * 10), axis=0), said])[: len(groups)]
    # In view as often as vehicles with that arrival rate, each in view for three seconds.
    share = np.full(len(GROUPS), 0.02)
    share[GROUPS.index("seen")] = 0.24
    share[GROUPS.index("none")] = 1.0 - 0.24 - 0.02 * (len(GROUPS) - 2)
    detections = stream_detections(made_up, np.random.default_rng(1))
    vision = VisionQuery(PinholeCamera.ovad(), detections, keep=EVERYBODY)
    silent, unasked = NotUsable("not scripted"), Unqueried("no camera")
    measured = []
    for time_s, sides in zip(made_up.hops.time_s.tolist(), said, strict=True):
        reading = SequenceReading(sides, share, 0.0, SequenceAlarm(0.0, 20.0))
        plain = Measurement(nanoseconds(time_s), DUMB, unasked, silent, silent, sequence=reading)
        measured.append(asked_again(plain, vision))
    return measured


def passed(vehicles: list[Vehicle], duration_s: float = 60.0) -> PassedStream:
    """Return a stream with the beliefs of the filter."""
    made_up = stream(vehicles, duration_s)
    return PassedStream(made_up, stream_truth(made_up), filtered(WorldFilter(Context()), heard(made_up)))


def figures_of(vehicles: list[Vehicle], duration_s: float = 60.0) -> Figures:
    return pass_figures([passed(vehicles, duration_s)])


@pytest.mark.long
def test_a_vehicle_raises_an_advisory_only_before_it_is_seen_and_keeps_its_identity() -> None:
    told = figures_of([("left", "left", 12.0), ("right", "right", 26.0), ("from_ahead", "left", 40.0)])
    assert (told["approaches"], told["detected"], told["other_side_too"]) == (2, 1.0, 0.0)
    assert (told["identity_judged"], told["identity_kept"]) == (2, 1.0)
    # The sequence reports "coming" for another 0.4 s after T0: this is the vehicle that the camera detects.
    assert told["onset_after_pass"] == 0.0
    assert (told["seen_ahead"], told["took_hidden_identity"]) == (1, 0.0)
    assert told["skill_2s"] is not None and told["skill_2s"] > 0.3
    assert told["hidden_nees"] is not None and 0.05 < float(told["hidden_nees"]) < 1.5


@pytest.mark.long
def test_two_simultaneous_vehicles_are_two_entities_and_a_car_ahead_is_neither() -> None:
    told = figures_of([("both", "left", 15.0), ("both", "right", 15.8), ("from_ahead", "left", 9.5)])
    assert (told["both_sides_found"], told["phantom_third"]) == (1.0, 0.0)
    assert (told["identity_kept"], told["took_hidden_identity"]) == (1.0, 0.0)


def test_undefined_figures_of_a_street_without_approaches_are_none() -> None:
    told = figures_of([("from_ahead", "left", 12.0)], duration_s=30.0)
    assert (told["onsets_per_hour"], told["detected"], told["time_rmse_of_constant"]) == (0.0, None, None)
    json.dumps(told, allow_nan=False)


PAIR: list[Vehicle] = [("both", "left", 12.0), ("both", "right", 15.0)]
SINGLES: list[Vehicle] = [("left", "left", 30.0), ("right", "right", 48.0)]


def stated(made_up: HeardStream, chance: float, *, masked: bool = False) -> PassedStream:
    """Return a stream with one constant chance for either side at every hop and no other beliefs."""
    n = len(made_up.hops)
    none = np.zeros((n, 2), bool)
    within, times = np.full((n, 2, 4), chance), np.full((n, 2, 3), np.nan)
    heard_all, nothing = (np.full(n, masked), np.zeros(n, bool)), ((),) * n
    columns = made_up.hops.time_s, none, none * 0.0, within, times, *heard_all
    follow = FollowedStream(*columns, nothing, ())
    return PassedStream(made_up, stream_truth(made_up), follow)


def test_an_approaching_vehicle_ranks_above_a_leaving_one_and_certain_chances_are_counted() -> None:
    made_up = stream([("left", "left", 15.0), ("leaves", "right", 40.0)])
    made_up.vehicles.hazard[1], made_up.vehicles.entry_s[1] = False, np.nan
    made_up.rows.in_view[made_up.rows.vehicle == 1] = False
    told = stated(made_up, 0.1)
    time_s, risk = told.followed.time_s, told.followed.risk
    sure = (time_s > 13.5) & (time_s < 14.9)
    for coming, leaving, area in ((0.6, 0.2, 1.0), (0.2, 0.6, 0.0)):
        risk[sure, 0], risk[np.abs(time_s - 32.0) < 1.0, 1] = coming, leaving
        figures = pass_figures([told])
        assert (figures["leaving"], figures["coming_leaving_auroc"]) == (1, area)
    assert (figures["certain_right"], figures["certain_said"]) == (None, 0.0)
    alone = stream([("left", "left", 15.0), ("leaves", "right", 40.0)])
    alone.vehicles.hazard[1], alone.rows.in_view[alone.rows.vehicle == 1] = False, True
    assert pass_figures([stated(alone, 0.1)])["leaving"] == 0  # It is in view all the time
    told.followed.within[sure, 0] = 0.9
    told.followed.within[np.searchsorted(time_s, 45.0), 1] = 0.9
    figures = pass_figures([told])
    assert figures["certain_right"] == pytest.approx(sure.sum() / (sure.sum() + 1))
    assert figures["certain_said"] == 1.0


def test_second_vehicles_are_scored_at_the_base_rate_of_the_street() -> None:
    """One of three vehicles is followed by one from the other side: a chance of one third has no loss."""
    group = "other, 1.5 to 4 s"
    told = second_figures([stated(stream(PAIR + SINGLES), 1.0 / 3.0, masked=True)])
    # It is as loud as the first and adds three decibels, so nothing is masked.
    assert (told[f"{group}: approaches"], told[f"{group}: hops of 1 dB"]) == (1, 29)
    assert told[f"{group}: skill"] == pytest.approx(0.0, abs=1e-9)
    assert told[f"{group}: said masked"] is None and told["behind, 1.5 to 4 s: approaches"] == 0
    faint = stream(PAIR + SINGLES, band_db=[60.0, 50.0, 60.0, 60.0])
    told = second_figures([stated(faint, 1.0 / 3.0, masked=True)])
    assert (told[f"{group}: hops of 1 dB"], told[f"{group}: skill"]) == (0, None)
    assert told[f"{group}: said masked"] == pytest.approx(1.0)
    assert second_figures([stated(faint, 0.0)])[f"{group}: said masked"] == pytest.approx(0.0)


@pytest.mark.long
def test_a_second_vehicle_is_kept_apart_from_the_first() -> None:
    whole = passed([*PAIR, ("queue", "left", 30.0), ("follows", "left", 33.0), *SINGLES[1:]])
    follow, told = whole.followed, second_figures([whole])
    group = "other, 1.5 to 4 s"
    assert (told[f"{group}: stated apart"], told[f"{group}: identity kept"]) == (1, 1.0)
    # An entity of unknown side belongs to the first vehicle, and to the second only as far as it is likelier.
    shares = SideShare("left", 0.8, 0.8, 0.1), SideShare("right", 0.2, -0.8, 0.1)
    single = tuple(
        tuple(replace(one, sides=shares) for one in hop if one.status == "hidden" and one.direction == "left")
        for hop in follow.entities
    )
    unknown = replace(whole, followed=replace(follow, entities=single))
    assert second_figures([unknown])[f"{group}: stated apart"] == 0


def test_the_added_level_is_the_power_relative_to_all_others() -> None:
    made_up = stream(PAIR, band_db=[60.0, 63.0])
    background_db = 10.0 * math.log10(np.mean(10.0 ** (level_db(made_up)[10:] / 10.0)))
    assert background_db == pytest.approx(40.0 + 10.0 * math.log10(1.7 / 3.0), abs=0.5)
    added = added_db(made_up)
    at = np.searchsorted(made_up.hops.time_s, 12.0)
    expected = [10.0 * math.log10(1.0 + 10.0 ** (one / 10.0)) for one in (-3.0, 3.0)]
    assert added[:, at].tolist() == pytest.approx(expected, abs=0.05)
    assert added[:, -1].tolist() == pytest.approx([0.0, 0.0], abs=1e-6)


def test_the_meter_measures_decibels_above_the_earlier_level() -> None:
    made_up = stream([("left", "left", 12.0)])
    louder = made_up.hops.middle.copy()
    louder[300:320] *= 10
    hops = made_up.hops.replace(middle=louder)
    above = above_quiet_db(level_db(replace(made_up, hops=hops)))
    assert np.abs(above[50:300]).max() < 2.0
    assert above[305:320] == pytest.approx(np.full(15, 20.0), abs=2.0)
    # After the burst the quiet level is the same as before: a fifth of the past is below either.
    assert np.abs(above[330:]).max() < 2.0


def test_the_worst_junction_is_the_worst_of_those_with_eight_cases() -> None:
    few, bad, good = (
        {"approaches": n, "detected": share, "a: hops of 1 dB": n, "a: skill": share, "hours": 1.0}
        for n, share in ((7, 0.1), (8, 0.5), (20, 0.9))
    )
    worst = worst_of({"SA1": few, "SB1": bad, "SB2": good})
    assert (worst["detected"], worst["a: skill"], worst["hours"]) == (0.5, 0.5, None)


@given(seed=st.integers(0, 2**32))
@settings(max_examples=20)
def test_a_scenario_counts_approaches_and_inaudible_hops_in_gusts_and_outside(seed: int) -> None:
    rng, streams = np.random.default_rng(seed), []
    for vehicles in ([("left", "left", 15.0), ("right", "right", 40.0)], [("from_ahead", "left", 20.0)]):
        passed = stated(stream(vehicles), 0.1)
        n = len(passed.heard.hops)
        passed.followed.unheard[:], passed.followed.advisory[:, 0] = rng.random((2, n)) < rng.random((2, 1))
        streams.append((passed, rng.random(n) < 0.3))
    found, counts = scenario_figures(streams), np.zeros((2, 2))
    for passed, in_gust in streams:
        for gust, unheard in zip(in_gust, passed.followed.unheard, strict=True):
            counts[int(gust)] += (unheard, 1)
    assert found["approaches"] == 2
    assert found["unheard_in_gusts"] == pytest.approx(counts[1, 0] / counts[1, 1])
    assert found["unheard_else"] == pytest.approx(counts[0, 0] / counts[0, 1])
    hazards, free = (one.followed.advisory[:, 0] for one, _ in streams)
    time_s = streams[0][0].followed.time_s
    at_t0 = [hazards[np.flatnonzero(time_s < t0_s - 0.05)[-1]] for t0_s in (15.0, 40.0)]
    assert found["advised_at_t0"] == np.mean(at_t0)
    onsets = int(free[0]) + int((free[1:] & ~free[:-1]).sum())
    assert found["onsets_per_hour"] == pytest.approx(onsets / (len(free) / 36_000.0))


@pytest.mark.long
def test_the_hops_of_gusts_are_those_in_which_the_wind_is_loud(tmp_path: Path) -> None:
    gusty = replace(traffic_named("no-hazard-gusts"), per_hour={}, sounds={"wind": 300.0})
    plan = StreamSettings(junction_named("SB2"), 0.7, 3, gusty, sample_rate_hz=6000.0)
    (rendered, in_gust), (again, _) = (scenarios.follow_plan(plan, read_model(), tmp_path) for _ in range(2))
    np.testing.assert_array_equal(rendered.followed.risk, again.followed.risk)
    assert 30 < in_gust.sum() < len(in_gust) - 30
    # Below 150 Hz there is only wind: without vehicles the level separates the hops.
    samples = rendered.heard.hops.middle.astype(float)
    low = sosfilt(butter(4, 150.0, fs=6000.0, output="sos"), samples.ravel()).reshape(samples.shape)
    power = lfilter(np.full(10, 0.1), 1.0, np.square(low).mean(axis=1))
    assert (power[in_gust][:, None] > power[~in_gust]).mean() > 0.8


def test_the_guard_acts_in_the_exam_as_in_a_run(tmp_path: Path) -> None:
    """A guard that classifies everything as foreign reduces evidence and `heard`, as in `AcousticAdapter`."""
    made_up, rng = stream([("left", "left", 12.0)], duration_s=16.0), np.random.default_rng(1)
    n = len(made_up.hops)
    names = "bearing_rad", "bearing_std_rad", "looming_hz", "looming_std_hz"
    refused = dict.fromkeys(names, np.full(n, np.nan))
    fully = dict.fromkeys(("heard", "prominence"), np.ones(n))
    fully |= {"unheard": np.full(n, ""), "excess_db": np.zeros(n)}
    feature, energy = rng.uniform(0.1, 1.0, (n, 60)), rng.normal(size=(n, 16))
    hops = made_up.hops.replace(feature=feature, band_log_energy=energy, **refused, **fully)
    replace(made_up, hops=hops).save(tmp_path / "stream.npz")
    model = read_model()
    assert model.guard is not None
    guard = replace(model.guard, threshold=-50.0, signal_nats=1e3)
    plain, guarded = (
        list(stream_measurements(tmp_path / "stream.npz", replace(model, guard=one), "none", 0)[1])
        for one in (None, guard)
    )
    judged = [(one, other) for one, other in zip(plain, guarded, strict=True) if other.domain is not None]
    assert len(plain) - len(judged) == 20  # two seconds of sound are classified
    for one, other in judged:
        assert isinstance(other.domain, Foreign)
        assert other.signature == neutral(one.signature, guard.margin)
        assert other.heard == beside_foreign(other.domain, one.heard)


@given(st.floats(0.0, 8.0))
@settings(max_examples=20)
def test_a_known_edge_narrows_the_bearing_and_keeps_the_errors_of_the_time(edge_deg: float) -> None:
    """An edge less certain than the usual one adds all of its variance, a more certain one leaves half of
    it."""
    coming = np.full(len(COMING_S), 1.0 / len(COMING_S))

    def variance(degrees: float) -> float:
        side = SideGeometry("left", 0.56, 0.96, 0.35, math.radians(degrees))
        return math.degrees(math.degrees(hidden_bearing(coming, side)[1] ** 2))

    expected = edge_deg**2 - 25.0 if edge_deg > 5.0 else 0.5 * (edge_deg**2 - 25.0)
    assert variance(edge_deg) - variance(5.0) == pytest.approx(expected, abs=1e-6)


HOUR = 36_000  # One hour
BUDGET = 25.0


@dataclass(frozen=True)
class MadeUp:
    """The fields of a stream and of its beliefs from which days are drawn."""

    tallies: tuple[Tally, ...]
    within: np.ndarray
    coming_s: np.ndarray
    hazard_free: bool = False

    followed = truth = heard = property(lambda self: self)


def hour(per_hour: float, seed: int, chance: float = 0.05, true: float = 0.05) -> MadeUp:
    """Return an hour with random onsets, and chances for two seconds of which a share comes true."""
    rng = np.random.default_rng(seed)
    false = np.cumsum(rng.random(HOUR) < per_hour / HOUR).tolist()
    tallies = tuple(Tally(quiet_ns=100_000_000 * k, false_onsets=n) for k, n in enumerate(false, 1))
    came = np.repeat(rng.random((HOUR // 20, 2)) < true, 20, axis=0)
    within = np.full((HOUR, 2, len(HORIZONS_S)), chance)
    return MadeUp(tallies, within, np.where(came, 1.0, np.inf))


def test_every_onset_of_whole_blocks_is_in_the_block_in_which_it_came() -> None:
    streams = [hour(60.0, seed) for seed in (1, 2)]
    blocks = quiet_blocks(streams)
    assert blocks.shape == (20, 36)
    assert blocks.sum() == sum(one.tallies[-1].false_onsets for one in streams)
    assert blocks[0].sum() == streams[0].tallies[3599].false_onsets
    assert chance_blocks(streams).shape == (20, 180, 2)


def test_a_kept_budget_is_not_reported_and_larger_excess_is_detected_sooner() -> None:
    streams = [hour(12.0, seed) for seed in range(6)]
    found = dict(budget_days(streams, BUDGET, 40, np.random.default_rng(0)))
    assert found["as they are"]["broken"] == found["chances"]["broken"] == 0.0
    assert found["the budget"]["broken"] <= 0.1
    twice, ten, later = (found[name] for name in ("2 times", "10 times", "2 times, after six hours"))
    assert twice["broken"] == ten["broken"] == later["broken"] == 1.0
    assert ten["median_h"] < 0.25 < twice["median_h"] < later["median_h"] < 6.0


@pytest.mark.parametrize(("chance", "true"), [(0.4, 0.02), (0.02, 0.4)])
def test_chances_that_do_not_come_true_are_detected(chance: float, true: float) -> None:
    streams = [hour(12.0, 1, chance, true)]
    found = dict(budget_days(streams, BUDGET, 5, np.random.default_rng(0)))
    assert found["chances"]["broken"] == 1.0


def test_streams_without_a_false_onset_are_rejected() -> None:
    with pytest.raises(InvalidArgumentError, match=r"expected false onsets .*, got none in 60 minutes"):
        next(budget_days([hour(0.0, 1)], BUDGET, 1, np.random.default_rng(0)))


@given(st.lists(st.floats(3.0, 9.0), min_size=2, max_size=5))
@settings(max_examples=10)
def test_distances_and_times_in_view_are_those_of_the_drawn_vehicles(gaps_s: list[float]) -> None:
    entries_s = np.round(9.0 + np.cumsum(gaps_s), 1).tolist()
    facts, heard = Facts(list), stream([("left", "left", one) for one in entries_s])
    hidden_rad, lone_rad = vehicle_facts(heard, facts)
    edge_m = STREET_M * math.tan(CORNER_RAD)
    assert np.mean(facts["view_s"]) == pytest.approx(2.0 * edge_m / PACE_MPS, abs=0.11)
    assert facts["gap_s"] == pytest.approx([*np.diff(entries_s), math.inf])
    # Along a street at a distance d a bearing turns by v / d times the square of its cosine.
    azimuth, turned = np.array(facts["log"]).imag, np.array(facts["rate"]).imag
    assert np.median(turned / np.cos(azimuth) ** 2) == pytest.approx(-PACE_MPS / STREET_M, rel=0.02)
    assert np.nanmin(hidden_rad[:, 0]) > CORNER_RAD > np.nanmax(lone_rad) and np.isnan(hidden_rad[:, 1]).all()


@given(st.floats(0.02, 0.3), st.integers(2, 9), st.integers(0, 4))
@settings(max_examples=10)
def test_tracks_single_boxes_and_growth_are_counted(growth: float, vehicles: int, single: int) -> None:
    """Every vehicle has six images, then none for a second; single boxes are in images of their own."""
    silent, look, hops = NotUsable("-"), Present(0.05, 0.01), []
    for image in range(16 * (vehicles + single)):
        number, at = divmod(image, 16)
        is_there = at < (6 if number < vehicles else 1)
        box = Sighting(0.5 - 0.01 * at, 0.02, "car", 0.9, 0.05 * math.exp(growth * at))
        stamp_ns = 10**8 * (image + 1)
        seen = Look("camera", stamp_ns, look)
        sightings = (box,) if is_there else ()
        hops.append(Measurement(stamp_ns, DUMB, look, silent, silent, look=seen, sightings=sightings))
    found = camera_numbers([hops])
    assert found["clutter"] == pytest.approx(single / len(hops))
    assert found["width_change"] == pytest.approx(growth) and found["size_spread"] == pytest.approx(
        0.0, abs=1e-9
    )
