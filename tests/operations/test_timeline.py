"""The figure of a recording: every entity has lines of its own, and none crosses what was not believed."""

from dataclasses import replace

import numpy as np
import pytest

from worldstate.ground.errors import InputFileError
from worldstate.operations.figure_style import with_gaps
from worldstate.operations.recordings.hop_table import HopTable
from worldstate.operations.recordings.timeline import Timeline, draw_timeline, write_timeline
from worldstate.operations.recordings.true_track import TrueTrack, read_true_tracks

TIME_S = 1.0 + 0.1 * np.arange(40)


def track(time_s, azimuth_rad, t0_s):
    return np.array([(now_s, azimuth_rad, 0.1, now_s < t0_s) for now_s in time_s])


@pytest.fixture
def timeline():
    flat = np.linspace(0.0, 1.0, TIME_S.size)
    return Timeline(
        hops=HopTable(
            {
                "time_s": TIME_S,
                "statistic": flat,
                "risk": flat,
                "left": flat > 0.7,
                "right": flat > 2.0,
                "srp": np.ones((TIME_S.size, 7)),
            }
        ),
        threshold=0.7,
        alpha=0.02,
        azimuths_rad=np.linspace(-1.5, 1.5, 7),
        entities=(track(TIME_S[5:20], 0.5, TIME_S[12]), track(TIME_S[25:35], -0.5, np.inf)),
        t0_s=2.2,
        truth=(
            TrueTrack(TIME_S, 0.02 * np.arange(40), (TIME_S > 2.15) & (TIME_S < 3.65), np.zeros((40, 2))),
        ),
    )


def drawn(timeline):
    """Points of every line of an entity."""
    axes = draw_timeline(timeline).axes[0]
    lines = [np.array(line.get_xydata()) for line in axes.lines if line.get_label().startswith("entity")]
    return [line[np.isfinite(line).all(axis=1)] for line in lines]


def test_each_entity_has_its_own_lines_and_the_hidden_one_reaches_into_view(timeline):
    hidden, seen, other = drawn(timeline)
    assert hidden[:, 0] == pytest.approx(TIME_S[5:13])
    assert seen[:, 0] == pytest.approx(TIME_S[12:20])
    assert other[:, 0] == pytest.approx(TIME_S[25:35])
    assert np.degrees(0.5) == pytest.approx(seen[0, 1]) == pytest.approx(hidden[-1, 1])


def test_no_line_is_drawn_across_a_gap(timeline):
    apart = np.concatenate([TIME_S[2:6], TIME_S[20:30]])
    broken = with_gaps(track(apart, 0.2, np.inf))
    assert np.isnan(broken[4]).all()
    assert np.isfinite(np.delete(broken, 4, axis=0)).all()
    assert np.isfinite(with_gaps(track(TIME_S, 0.2, np.inf))).all()


def test_the_axis_begins_with_the_first_window_on_a_clock_of_1970_too(timeline):
    late = replace(timeline, hops=timeline.hops.replace(time_s=TIME_S + 1.7e9))
    for one, first_s in ((timeline, 0.0), (late, 1.7e9)):
        low, high = draw_timeline(one).axes[0].get_xlim()
        assert low == pytest.approx(first_s, abs=1e-3)
        assert high == pytest.approx(one.hops.time_s[-1] + 0.1, abs=1e-3)


def test_a_recording_without_entities_is_drawn(timeline, tmp_path):
    empty = replace(timeline, entities=())
    assert not drawn(empty)
    write_timeline(empty, tmp_path / "t.png")
    assert (tmp_path / "t.png").read_bytes()[:4] == b"\x89PNG"


def test_power_is_drawn_at_the_middle_of_its_window_and_boxes_when_they_were_seen(timeline):
    boxes = replace(timeline, sightings=np.stack([TIME_S[12:14], np.zeros(2)], axis=1))
    axes = draw_timeline(boxes).axes[0]
    edges = np.asarray(axes.collections[0].get_coordinates()[0, :, 0])
    assert (edges[1:] + edges[:-1]) / 2 == pytest.approx(TIME_S - 0.5)
    (camera,) = (line for line in axes.lines if line.get_label().startswith("camera"))
    assert camera.get_xdata() == pytest.approx(TIME_S[12:14])


def test_an_advisory_stands_in_the_row_of_its_side(timeline):
    rows = draw_timeline(timeline).axes[1]
    names = dict(zip(rows.get_yticks(), (label.get_text() for label in rows.get_yticklabels()), strict=True))
    (bar,) = [patch for patch in rows.collections if patch.get_paths()[0].get_extents().height < 1]
    box = bar.get_paths()[0].get_extents()
    assert names[round((box.y0 + box.y1) / 2)] == "advisory left"
    assert (box.x0, box.x1) == pytest.approx((TIME_S[timeline.hops.left][0], TIME_S[-1] + 0.1))


def test_the_true_track_and_the_time_in_line_of_sight_are_drawn(timeline):
    axes = draw_timeline(timeline).axes
    (seen,) = (line for line in axes[0].lines if line.get_label() == "vehicle, truth, in sight")
    shown = np.isfinite(seen.get_ydata())
    assert seen.get_xdata()[shown][[0, -1]] == pytest.approx(timeline.truth[0].visible_s) == [2.2, 3.6]
    legends = [text.get_text() for panel in axes[:3] for text in panel.get_legend().get_texts()]
    assert "in line of sight (truth)" in legends
    unknown = draw_timeline(replace(timeline, truth=())).axes
    assert not any("truth" in line.get_label() for line in unknown[0].lines)


def test_no_legend_hides_data(timeline):
    figure = draw_timeline(timeline)
    figure.draw_without_rendering()
    for axes in figure.axes[:3]:
        assert not axes.get_legend().get_window_extent().overlaps(axes.get_window_extent())


def test_a_recording_without_truth_has_no_true_track(tmp_path):
    assert read_true_tracks(tmp_path) == ()
    (tmp_path / "truth.json").write_text("[1]")
    with pytest.raises(InputFileError, match="truth"):
        read_true_tracks(tmp_path)
