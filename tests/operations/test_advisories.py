"""Onsets, lead time and false alarms per hour."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from worldstate.operations.metrics.approach_table import ApproachTable, onset_outcome, rising_edges
from worldstate.operations.recordings.hop_table import HopTable


@given(st.lists(st.booleans(), max_size=50))
def test_every_onset_is_a_change_from_quiet_to_alarm(alarm):
    by_hand = [t for t, on in enumerate(alarm) if on and (t == 0 or not alarm[t - 1])]
    assert rising_edges(alarm).tolist() == by_hand


def test_lead_time_counts_from_the_first_onset_within_five_seconds():
    assert onset_outcome([6.0, 6.5], 7.0).lead_s == pytest.approx(1.0)
    early = onset_outcome([1.0, 1.9, 4.0], 7.0)
    assert early.lead_s == pytest.approx(3.0)
    assert early.onsets_earlier == 2


@pytest.mark.parametrize("onsets", [[], [7.0, 8.0], [0.5]])
def test_too_late_or_too_early_is_a_miss(onsets):
    assert not onset_outcome(onsets, 7.0).detected


def test_one_onset_of_the_static_set_is_9_7_per_hour():
    # One onset in 0.103 h of hazard-free audio is 9.7 per hour.
    hops = round(0.103 * 36000)
    alarm = np.zeros(hops, dtype=bool)
    alarm[100:140] = True
    found = ApproachTable([], [alarm[:2000], alarm[2000:]]).figures()
    assert found["onsets_per_hour"] == pytest.approx(9.7, abs=0.02)


def test_an_onset_at_line_of_sight_is_no_warning():
    # At 47,998 Hz the hop of T0 = 7 s ends at sample 335,986, 6.3 us before T0.
    at_t0_s = round(7.0 * 47_998) / 47_998 - 6.3e-6
    assert not onset_outcome([at_t0_s], 7.0).detected
    assert onset_outcome([at_t0_s - 0.1], 7.0).detected
    table = HopTable({"time_s": np.array([7.0 + 9e-6, 7.1])}, label="left", t0_s=7.0)
    assert table.before_sight().tolist() == [True, False]
