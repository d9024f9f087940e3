"""Effects of a wrong mounting on positions and bearings."""

import dataclasses

import numpy as np
import pytest
from hop_tables import heard_stream
from hypothesis import given
from hypothesis import strategies as st

from worldstate.commissioning import commission
from worldstate.commissioning.heard_stream import (
    CommissionSettings,
    HeardStream,
    hear_stream,
    mountings,
    quick_settings,
)
from worldstate.commissioning.stream_exam import in_view_bearings
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.simulation import site
from worldstate.simulation.stream.settings import StreamSettings

ARRAY = MicrophoneArray([[0.1, 0.2, 0.0], [0.0, 0.05, 0.1], [0.0, -0.1, 0.0], [-0.1, -0.25, 0.2]])


@given(st.floats(-np.pi, np.pi))
def test_a_turned_array_turns_the_bearing(azimuth_rad: float) -> None:
    _, turned, _ = mountings(ARRAY, np.random.default_rng(1)).values()
    np.testing.assert_allclose(
        turned.delays_s(azimuth_rad + np.radians(2.0)), ARRAY.delays_s(azimuth_rad), atol=1e-12
    )


def test_position_errors_are_five_millimetres_in_every_direction() -> None:
    many = MicrophoneArray(np.random.default_rng(1).uniform(-1.0, 1.0, (600, 3)))
    *_, off = mountings(many, np.random.default_rng(2)).values()
    np.testing.assert_allclose((off.positions_m - many.positions_m).std(axis=0), 5e-3, rtol=0.12)


def test_one_rendering_serves_all_arrays() -> None:
    settings = StreamSettings(site("SB1"), minutes=0.05, sample_rate_hz=6000.0)
    mounted = list(mountings(ARRAY, np.random.default_rng(1)).values())
    right, turned, _ = hear_stream(settings, [ARRAY], [mounted])
    (alone,) = hear_stream(settings, [ARRAY])
    for name, column in alone.hops.columns.items():
        np.testing.assert_array_equal(right.hops.columns[name], column, err_msg=name)
    assert not np.array_equal(turned.hops.feature, right.hops.feature)


def test_renderings_are_reused_for_other_arrays(tmp_path, monkeypatch) -> None:
    """A second array needs no new rendering and has the sound it has alone."""
    settings = StreamSettings(site("SB1"), minutes=0.05, sample_rate_hz=6000.0)
    board = MicrophoneArray(ARRAY.positions_m[:3] * [1.0, 0.5, 1.0])
    (expected,) = hear_stream(settings, [board])
    list(commission.heard_streams([settings], ARRAY, tmp_path, beside=[board]))
    monkeypatch.delattr(commission, "hear_stream")
    (kept,) = commission.heard_streams([settings], board, tmp_path)
    np.testing.assert_allclose(kept.hops.feature, expected.hops.feature, atol=1e-5)
    np.testing.assert_array_equal(kept.hops.time_s, expected.hops.time_s)


def test_wrong_mountings_use_the_requested_processes(tmp_path, monkeypatch) -> None:
    """One process for half an hour of streams per array would take as long as the exam."""
    asked, heard = [], [passing(0.0), passing(2.0), passing(1.0)]
    monkeypatch.setattr(commission, "examine_stream", lambda model, one: one)
    monkeypatch.setattr(
        commission, "in_processes", lambda work, items, jobs: asked.append(jobs) or [heard] * len(items)
    )
    settings = quick_settings(CommissionSettings())
    found = list(commission.exam_of_mountings(ARRAY, None, settings, tmp_path, jobs=2))
    assert asked == [2]
    assert found
    assert all(list(stream.values()) == heard for stream in found)


def passing(bearing_deg: float) -> HeardStream:
    """Return a stream with a vehicle at 45 degrees, 7 m, for 1 s, and a fainter one at -90 degrees."""
    time_s = np.round(np.arange(1.0, 3.0, 0.1), 1)
    places = ((1, 5.0, 5.0, 70.0), (2, 0.0, -9.0, 60.0))
    rows = [(number, t, x, y, t < 2.0, level) for number, x, y, level in places for t in time_s]
    hops = {"time_s": time_s, "bearing_rad": np.full(len(time_s), np.radians(bearing_deg))}
    return heard_stream([], rows, hops)


def test_bearings_are_compared_with_the_loudest_vehicle_in_view() -> None:
    assert in_view_bearings([passing(48.0)])["bearing_error_deg"] == pytest.approx(3.0)
    two_to_one = [passing(48.0), passing(38.0), passing(38.0)]
    assert in_view_bearings(two_to_one)["bearing_error_deg"] == pytest.approx(7.0)
    unseen = passing(48.0)
    nobody = dataclasses.replace(unseen, rows=unseen.rows.replace(in_view=np.zeros(len(unseen.rows), bool)))
    assert in_view_bearings([nobody]) == dict.fromkeys(in_view_bearings([unseen]))


def test_a_clock_offset_equals_the_turn_of_a_vehicle() -> None:
    turning = passing(0.0)
    azimuth = np.radians(30.0) * turning.rows.time_s
    rows = turning.rows.replace(x_m=7.0 * np.cos(azimuth), y_m=7.0 * np.sin(azimuth))
    found = in_view_bearings([dataclasses.replace(turning, rows=rows)])
    assert found["offset_50ms_deg"] == pytest.approx(1.5)
    assert found["offset_50ms_95_deg"] == pytest.approx(1.5)
