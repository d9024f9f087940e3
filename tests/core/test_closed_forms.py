"""Closed forms of the core in cases that can be summed by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from street_measurements import COMING, SEEDS, after, drawn_groups, hop, reading

from worldstate import Context, Sighting, WorldFilter
from worldstate.abduction.co_evidence import Absent, Present
from worldstate.abduction.cueing.cueing_policy import uncalibrated_policy
from worldstate.abduction.cueing.risk_map import PlattMap
from worldstate.abduction.sequence.sequence_model import COMING_S, GROUPS, SequencePosterior
from worldstate.belief.association import associated, emergence_density, joint_association, reached_edge
from worldstate.belief.detection import camera_scan, fused
from worldstate.belief.hidden_bearing import hidden_motion, motion_in_view, time_to_visible
from worldstate.belief.joint_belief import joint_reading
from worldstate.belief.kinematics.cartesian import CartesianBelief, arc
from worldstate.belief.kinematics.motion import AZIMUTH_RATE, MotionBelief
from worldstate.belief.side_belief import SideBelief
from worldstate.belief.site_geometry import SideGeometry, SiteGeometry
from worldstate.belief.street_model import FilterSettings, StreetModel
from worldstate.belief.track import Tracks, born
from worldstate.core.acoustic_update import acoustic_update, association_probability
from worldstate.core.birth_death import hidden_on
from worldstate.core.detection_update import _hidden
from worldstate.core.memory import first_memory
from worldstate.core.street_belief import ArrivalRate, StreetBelief, carried, informed, of_two
from worldstate.ground import LEAST_HEARD
from worldstate.measurement import Bearing, CameraLook, Heard, Look, Sector

UNIT, NATS, LARGE = st.floats(0.01, 0.99), st.floats(-4.0, 4.0), st.floats(0.0, 9.0)  # Large ones are limited
LEFT, RIGHT = SideGeometry("left", 0.56, 0.96, 0.35), SideGeometry("right", -0.56, -0.96, 0.35)
SITE = SiteGeometry((LEFT, RIGHT), 0.6, FilterSettings())
# A reading or a window takes effect at once.
WHOLE = StreetModel(reading_s=1e-3, reading_gain=1.0, window_s=1e-3)


def odds(chance: float) -> float:
    return chance / (1.0 - chance)


def drawn(seed: int) -> np.ndarray:
    """Return random groups of two sides."""
    return drawn_groups(np.random.default_rng(seed), 2, least=0.01)


# Hearing


@pytest.mark.parametrize("sequence", [False, True])
@given(SEEDS, SEEDS, st.floats(LEAST_HEARD, 1.0))
@settings(max_examples=10)
def test_partly_masked_evidence_mixes_odds_of_reading_and_prediction(sequence, one, other, share) -> None:
    r"""Eq.: odds' = s odds(read) + (1 - s) odds(expected), of a vehicle that comes from any side."""

    def heard(number: int, seed: int, share: float):
        nats = np.random.default_rng(seed).uniform(-4.0, 4.0, 4).tolist()
        said = reading(drawn(seed)) if sequence else None
        return hop(number, nats, sequence=said, heard=Heard(share, "wind"))

    before = WorldFilter(settings=FilterSettings(street=WHOLE)).update(heard(1, one, 1.0))
    expected = before.predict(0.1).belief.risk  # Without a sequence model that of all that is hidden
    read, masked = (before.update(heard(2, other, chance)).belief for chance in (1.0, share))
    mixed = share * odds(read.risk) + (1.0 - share) * odds(expected)
    assert odds(masked.risk) == pytest.approx(mixed, rel=1e-6)
    # The odds of visible and none do not depend on masking.
    visible, none = np.array([read.hypotheses, masked.hypotheses])[:, 1:].T
    assert visible[0] / none[0] == pytest.approx(visible[1] / none[1], rel=1e-6)


def test_an_alarm_ends_one_second_after_the_sound_becomes_unusable() -> None:
    loud, quiet = ((nats, -3.0, -3.0, -nats) for nats in (6.0, -6.0))
    policy = replace(uncalibrated_policy(), alpha=0.02)
    world = after(*(hop(number, loud) for number in range(1, 11)), world=WorldFilter(policy=policy))
    assert world.state.calibrated
    for number in range(11, 24):
        # Unusable noise that resembles an empty street.
        world = world.update(hop(number, quiet, heard=Heard(0.0, "lost samples")))
        state = world.state
        named = any(cue.advisory is not None for cue in state.cues)
        assert named == (number <= 20), number
        assert state.heard is not None and not state.calibrated
        assert [(one.share, one.since_ns) for one in state.heard] == [(0.0, 11 * 10**8)]


# Belief


@given(SEEDS)
@settings(max_examples=20)
def test_the_risk_of_any_side_is_the_sum_less_both(seed) -> None:
    sides = after(hop(1, sequence=reading(drawn(seed)))).belief
    assert sides.hidden_on(None) == pytest.approx(sum(sides.hidden) - sides.both) == pytest.approx(sides.risk)


@given(UNIT, UNIT, UNIT, UNIT)
def test_messages_scale_the_other_hypotheses_alike(hidden, visible, one, other) -> None:
    before = hidden, (1.0 - hidden) * visible, (1.0 - hidden) * (1.0 - visible)
    quiet = SideBelief((hidden, 0.0), (0.0, 0.0), (hidden, 0.0), hidden, before)
    after = quiet.at_least((one, other)).hypotheses
    expected = max(hidden, 1.0 - (1.0 - one) * (1.0 - other))
    assert sum(after) == pytest.approx(1.0) and after[0] == pytest.approx(expected)
    assert after[1] * (1.0 - visible) == pytest.approx(after[2] * visible)


@given(st.floats(0.0, 1.0), st.floats(0.01, 0.9))
def test_the_answers_of_a_look_sum_to_one(miss_rate, clutter_rate) -> None:
    nothing, something = (kind(miss_rate, clutter_rate).log_likelihoods() for kind in (Absent, Present))
    assert np.exp(nothing) + np.exp(something) == pytest.approx([1.0] * 3)
    assert np.exp(nothing) == pytest.approx((1.0 - clutter_rate) * np.array([1.0, miss_rate, 1.0]))


@given(st.floats(5e-324, 0.9))
def test_a_sensor_that_always_misses_answers_alike_under_every_hypothesis(clutter_rate) -> None:
    for answer in (Absent(1.0, clutter_rate), Present(1.0, clutter_rate)):
        assert np.ptp(answer.log_likelihoods()) == pytest.approx(0.0, abs=1e-9)


@given(SEEDS, UNIT)
@settings(max_examples=20)
def test_a_hidden_vehicle_beside_a_visible_one_mixes_prior_and_sound(seed, by_sound) -> None:
    """At most as often as the sound does; else a detection against it would add a hidden vehicle."""
    groups, usual = drawn(seed), 0.2
    rest = 1.0 - groups[:, :COMING].sum(axis=1) - groups[:, GROUPS.index("other")]
    in_view = (groups[:, COMING] / rest).mean()
    joint = joint_reading(groups, usual, by_sound)
    quiet = joint[:2, :2].sum(axis=(0, 1))
    beside = joint.sum(axis=(0, 1)) - quiet
    mixed = min(by_sound * in_view + (1.0 - by_sound) * usual, in_view)
    assert quiet[1] / quiet.sum() == pytest.approx(in_view)
    assert beside[1] / beside.sum() == pytest.approx(mixed)
    assert joint[2:].sum() == pytest.approx(groups[0, :COMING].sum())


def memory_of(groups: np.ndarray, **more) -> StreetBelief:
    world = WorldFilter(settings=FilterSettings(street=WHOLE)).update(hop(0, sequence=reading(groups)))
    return replace(world.memory.belief, **more)


def informed_by(kept: StreetBelief, groups: np.ndarray) -> StreetBelief:
    policy, whole = uncalibrated_policy(), FilterSettings(street=WHOLE)
    return informed(kept, hop(1, sequence=reading(groups)), (), Context(), policy, whole)


@given(SEEDS, UNIT)
@settings(max_examples=20)
def test_after_a_hand_over_the_usual_share_of_followers_remains(seed, residual) -> None:
    before = memory_of(drawn(seed))
    after = before.handed_over({0: residual}, (1,), 10**9, WHOLE)
    often = (1.0 - residual) * WHOLE.follows + residual * before.comes[0]
    assert after.comes[0] == pytest.approx(often)
    assert after.comes[1] == pytest.approx(before.comes[1])


# Alarm


@given(SEEDS, st.tuples(LARGE, LARGE))
@settings(max_examples=20)
def test_the_less_likely_side_is_limited_by_the_odds_of_two_vehicles(seed, log_odds) -> None:
    groups, nats = drawn(seed), np.array(log_odds)
    comes, alone = groups[:, :COMING].sum(axis=1), groups[:, GROUPS.index("other")]
    decided, less = of_two(nats, comes, alone, nats, 0.3), int(np.argmin(log_odds))
    if log_odds[0] != log_odds[1]:
        apart = math.log(comes[less] / alone[less])
        assert decided[less] == pytest.approx(min(log_odds[less], 0.3 + apart), abs=1e-6)
        assert decided[1 - less] == log_odds[1 - less]


@given(SEEDS)
@settings(max_examples=10)
def test_learned_traffic_moves_prior_and_alarm_unless_a_prior_is_given(seed) -> None:
    groups = drawn(seed)
    busy = (ArrivalRate(20.0, 100.0), ArrivalRate(0.0, 6e3))
    usual, learned = (informed_by(memory_of(groups, **more), groups) for more in ({}, {"arrivals": busy}))
    moved = [np.log(one.comes) - np.log1p(-one.comes) for one in (usual, learned)]
    np.testing.assert_allclose(moved[1] - moved[0], [0.5, -0.5], atol=1e-6)
    assert np.sign(learned.alarm_nats - usual.alarm_nats).tolist() == [1.0, -1.0]
    given_ = Context(hidden_by_side={"left": 0.2, "right": 0.2})
    priors = [StreetBelief.expected(given_, WHOLE), replace(memory_of(groups), arrivals=busy)]
    after = [carried(one, 10**8, 10**8, given_, WHOLE).groups for one in priors]
    assert all((one[:, 0] / one[:, -1] == one[0, 0] / one[0, -1]).all() for one in after)


@given(NATS, NATS, NATS, NATS, UNIT)
@settings(max_examples=10)
def test_a_window_with_an_empty_look_gives_the_statistic_and_the_risk(
    left, right, visible, none, miss
) -> None:
    hidden, others = np.exp([left, right]).sum(), miss * math.exp(visible) + math.exp(none)
    policy = replace(uncalibrated_policy(), risk_map=PlattMap(-0.5, -2.0))
    told = hop(10, (left, right, visible, none), answer=Absent(miss))
    world = after(told, world=WorldFilter(policy=policy))
    cue, (any_hidden, *_) = world.state.cues[0], world.belief.hypotheses
    assert world.risk == pytest.approx(min(policy.risk_map(any_hidden), any_hidden))
    assert cue.statistic == pytest.approx(hidden / (hidden + others))
    # The ratio of the means, whatever the prior.
    assert cue.log_lambda == pytest.approx(math.log(hidden / others))


@pytest.mark.parametrize("sequence", [False, True])
def test_only_the_window_rule_has_alpha_and_confidences_sum_to_one(sequence) -> None:
    policy = replace(uncalibrated_policy(), alpha=0.02, risk_map=PlattMap(-0.5, -2.0))
    said = reading(drawn(3)) if sequence else None
    told = (hop(number, (1.0, 0.2, 0.0, 0.0), sequence=said) for number in range(1, 9))
    cues = after(*told, world=WorldFilter(policy=policy)).state.cues
    assert {cue.alpha for cue in cues} == {None if sequence else 0.02}
    assert sum(cue.confidence for cue in cues) == pytest.approx(1.0)
    # The risk is at most P(hidden), whatever the map returns.
    assert all(cue.risk <= cue.hypotheses.hidden + 1e-12 for cue in cues)


@pytest.mark.parametrize("group", range(7))
def test_the_time_interval_is_the_90_per_cent_interval_plus_margin(group) -> None:
    groups = np.full((1, 2, len(GROUPS)), 1e-12)
    groups[..., group] = 1.0
    begin, end = (0.0, *COMING_S)[group], COMING_S[group]
    low, mean, high = SequencePosterior(groups, 0.2).time_to_visible_s()[0, 0]
    assert mean == pytest.approx(0.5 * (begin + end))
    within = begin + np.array([0.05, 0.95]) * (end - begin)
    assert (low, high) == pytest.approx((max(within[0] - 0.2, 0.0), within[1] + 0.2), abs=1e-6)


# Association


def seen(azimuth_rad: float, existence: float):
    motion = MotionBelief.around((azimuth_rad, 0.0, 0.0, 3.2), (0.05, 0.1, 0.1, 0.3))
    return replace(born("visible", 0, existence, 0, SITE), seen=True, motion=motion, behind=0.0)


def box_scan(azimuth_rad: float, miss_rate: float, name: str = "camera", std_rad: float = 0.02):
    look = Look(name, 0, Present(miss_rate, 0.01), (-0.6, 0.6))
    boxes = (Sighting(azimuth_rad, std_rad, "car", 0.9),)
    return camera_scan(CameraLook(look, boxes), Sector(0.0, 0.6), 1.0, StreetModel(births=0.05))


@given(st.floats(-0.1, 0.1), st.floats(0.1, 0.9), st.floats(0.05, 0.6))
@settings(max_examples=20)
def test_a_box_belongs_to_the_entity_or_a_new_one(apart, existence, miss_rate) -> None:
    detections = box_scan(0.1 + apart, miss_rate).detections
    variance, found = 0.05**2 + 0.02**2, 1.0 - miss_rate
    own = found * existence * math.exp(-0.5 * apart**2 / variance) / math.sqrt(2.0 * math.pi * variance)
    new = (1.0 - found * existence) * (0.05 - math.log(0.99) / 9.0) / 1.2  # New ones and clutter
    whose = associated(Tracks.of([seen(0.1, existence)]), detections, SITE)
    assert whose.pairs[0, 0] == pytest.approx(own / (own + new), rel=1e-4)


def test_a_visible_entity_takes_a_poor_detection_in_its_gate() -> None:
    poor = np.array([[-1.0]])
    in_view, hidden = (joint_association(poor, np.array([detected])) for detected in (True, False))
    assert (in_view.found, in_view.new, hidden.found, hidden.new) == ({0: 0}, [], {}, [0])


@given(UNIT, UNIT)
@settings(max_examples=10)
def test_two_cameras_miss_only_if_both_miss(one, other) -> None:
    scans = [box_scan(0.1, one, "a"), box_scan(0.1, other, "b", std_rad=0.04)]
    both, by_look = fused(scans)
    assert both.found == pytest.approx([1.0 - one * other]) and by_look.tolist() == [[True, True]]
    assert both.std_rad**-2 == pytest.approx([0.02**-2 + 0.04**-2])
    assert both.log_new == pytest.approx([math.log((0.05 - math.log(0.99) / 9.0) / 1.2)])
    clutter = 1.0 - scans[0].detections.existence[0]
    assert both.existence == pytest.approx([1.0 - clutter**2])  # New unless clutter of both


@given(st.floats(0.3, 1.4), st.floats(0.05, 0.4))
@settings(max_examples=20)
def test_emergence_is_symmetric_and_likelier_near_the_edge(azimuth, std) -> None:
    def near(side: int, way: float, at: float) -> float:
        motion = MotionBelief.around((way * at, 0.0, -0.2, 3.2), (std, 0.1, 0.1, 0.3))
        return reached_edge(replace(born("left", 0, 0.9, 0, SITE), side=side, motion=motion), SITE)

    assert near(0, 1.0, azimuth) == pytest.approx(near(1, -1.0, azimuth))
    assert near(0, 1.0, azimuth) >= near(0, 1.0, azimuth + 0.3)
    assert near(0, 1.0, 0.5) > near(0, 1.0, 1.5)


def test_emergence_on_the_wrong_side_has_the_confusion_rate() -> None:
    hidden = replace(born("left", 0, 0.9, 0, SITE), side=0)
    at_edges = (replace(box_scan(way * 0.56, 0.1).detections, width_rad=np.zeros(1)) for way in (1.0, -1.0))
    here, there = (emergence_density([hidden], one, SITE)[0, 0] for one in at_edges)
    wrong, peak = SITE.street.side_confusion, 1.0 / (SITE.street.edge_std_rad * math.sqrt(2.0 * math.pi))
    assert (here, there) == pytest.approx(((1.0 - wrong) * peak, wrong * peak), rel=1e-6)


@given(st.floats(-0.5, 0.5), UNIT)
@settings(max_examples=20)
def test_a_peak_belongs_to_the_entity_or_is_uniform(apart, own_path) -> None:
    variance = 0.05**2 + 0.1**2
    own = own_path * math.exp(-0.5 * apart**2 / variance) / math.sqrt(2.0 * math.pi * variance)
    motion, path = Tracks.of([seen(0.1, 0.9)]).motion, np.array([own_path])
    (chance,) = association_probability(motion, 0.1 + apart, np.array([0.1]), path)
    assert chance == pytest.approx(own / (own + (1.0 - own_path) / math.pi), rel=1e-9)


def after_peaks(motion: MotionBelief, bearing: Bearing, *weights: float) -> MotionBelief:
    """Return the motion of a visible vehicle after peaks, each with a share of new sound."""
    memory = first_memory(Context(), FilterSettings(), 0)
    memory.tracks = Tracks.of([replace(born("left", 0, 0.9, 0, SITE), motion=motion)])
    for weight in weights:
        acoustic_update(memory, hop(1, bearing=bearing), weight, SITE)
    return memory.tracks.rows()[0].motion


@given(st.floats(-1.0, 1.0), st.floats(-0.6, 0.6), st.floats(0.01, 0.3))
@settings(max_examples=20)
def test_a_peak_describes_the_vehicle_at_the_delay_of_bearings(azimuth, rate, apart) -> None:
    """Peaks at equal distances ahead of and behind that place move the vehicle equally far."""
    motion = MotionBelief.around((azimuth, rate, -0.2, 3.2), (0.1, 0.3, 0.1, 0.3))
    late_rad, moved = azimuth - SITE.street.bearing_s * rate, list[np.ndarray]()
    for way in (1.0, -1.0):
        there = after_peaks(motion, Bearing(late_rad + way * apart, 0.3, 3.0), 1.0)
        moved.append(way * (there.mean - motion.mean))
    assert moved[0] == pytest.approx(moved[1], abs=1e-9) and moved[0][0] > 1e-4


def test_ten_tenths_of_a_window_count_about_as_one() -> None:
    """Slightly more, because each hop associates the peak with the vehicle again."""
    motion, bearing = MotionBelief.around((0.9, 0.0, -0.2, 3.2), (0.2, 0.1, 0.1, 0.3)), Bearing(0.9, 0.06)
    once, often = (after_peaks(motion, bearing, *weights).covariance[0, 0] for weights in ([1.0], [0.1] * 10))
    assert often == pytest.approx(once, rel=0.4) and once < 0.9 * motion.covariance[0, 0]


@given(UNIT, UNIT, UNIT)
@settings(max_examples=20)
def test_a_miss_raises_and_a_detection_lowers_occlusion(before, detected, chance) -> None:
    tracks = Tracks.of([replace(seen(0.1, 0.9), behind=before)])
    missed = before / (before + (1.0 - before) * (1.0 - detected))
    for by_radar, rate in ((False, 0.0), (True, SITE.street.hidden_return)):
        found = before * rate / (before * rate + 1.0 - before)
        (after,) = _hidden(tracks, np.array([detected]), np.array([chance]), by_radar, SITE.street)
        assert after == pytest.approx(chance * found + (1.0 - chance) * missed)


@given(
    st.floats(9.0, 15.0), st.floats(12.0, 30.0), st.floats(-2.0, 2.0), st.floats(-10.0, -4.0),
    st.floats(-2.0, 9.0), st.floats(-0.3, 0.3), st.floats(4.0, 9.0),
)  # fmt: skip
@settings(max_examples=100)
def test_the_time_to_visible_is_the_crossing_of_the_line_of_sight(
    x, y, vx, vy, speed, turning, corner_m
) -> None:
    place = CartesianBelief(np.array([x, y, vx, vy]), np.diag([0.2, 0.2, 0.1, 0.1]))
    for side in (LEFT, replace(LEFT, corner_m=corner_m)):
        site = replace(SITE, ego_speed_mps=speed, ego_yaw_rate_rad_s=turning)
        _, times_s = time_to_visible(place, side, site)
        if times_s is not None and times_s[1] > 0.0:
            # The line of sight past a corner at unknown distance does not move.
            driven_s = times_s[1] if side.corner_m else 0.0
            ego, _ = arc(speed, turning, driven_s)
            corner = corner_m * np.array([math.cos(0.56), math.sin(0.56)]) - ego
            off = place.mean[:2] + times_s[1] * place.mean[2:] - ego
            apart = corner[0] * off[1] - corner[1] * off[0]
            assert apart == pytest.approx(0.0, abs=0.02 * corner_m * max(np.hypot(*off), 1.0))


@pytest.mark.parametrize("group", [1, 4, 7])
def test_a_hidden_vehicle_moves_towards_the_axis_at_the_pace_of_its_lane(group) -> None:
    coming = np.full(COMING, 1e-9)
    coming[group] = 1.0
    for side, way in ((LEFT, 1.0), (RIGHT, -1.0)):
        moved = hidden_motion(coming, 1.0, side, side.prior())
        assert way * moved.azimuth_rad > 0.56
        expected = -way * side.pace_hz * math.cos(moved.azimuth_rad) ** 2
        assert moved.mean[AZIMUTH_RATE] == pytest.approx(expected, rel=1e-9)


@given(SEEDS)
@settings(max_examples=10)
def test_emerged_motion_has_the_likeliest_mean_and_the_total_covariance(seed) -> None:
    rng, before = np.random.default_rng(seed), LEFT.prior()
    coming, shares = drawn(seed)[:, :COMING], rng.dirichlet(np.ones(2))
    pairs = zip(coming, SITE.sides, strict=True)
    each = [hidden_motion(one, 0.0, side, before) for one, side in pairs]
    found, mean = motion_in_view(coming, shares, SITE, before), each[int(shares.argmax())].mean
    errors = [one.covariance + np.outer(one.mean - mean, one.mean - mean) for one in each]
    np.testing.assert_allclose(found.mean, mean)
    np.testing.assert_allclose(found.covariance, shares[0] * errors[0] + shares[1] * errors[1], atol=1e-12)


def test_a_cue_refers_to_its_own_side_before_unknown_sides() -> None:
    faint, likely = born("left", 0, 0.3, 0, SITE), born("left", 1, 0.6, 0, SITE)
    unknown = replace(born("right", 0, 0.9, 0, SITE), side=1, side_shares=(0.4, 0.6))
    assert hidden_on(Tracks.of([unknown, faint, likely]), 0) == 2
    assert hidden_on(Tracks.of([unknown, faint]), 1) == hidden_on(Tracks.of([unknown]), 0) == 0
    assert hidden_on(Tracks.of([faint, likely]), 1) is None
