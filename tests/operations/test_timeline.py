"""The figure of a recording: every entity has lines of its own, and none crosses what was not believed."""

from dataclasses import replace

import numpy as np
import pytest

from worldstate.operations.recordings.timeline import EntityTrail, Timeline, draw_timeline, write_timeline

TIME_S = 1.0 + 0.1 * np.arange(40)


def trail(time_s, azimuth_rad, t0_s):
    time_s = np.asarray(time_s)
    return EntityTrail(time_s, np.full(time_s.size, azimuth_rad), np.full(time_s.size, 0.1), time_s < t0_s)


@pytest.fixture
def timeline():
    flat = np.linspace(0.0, 1.0, TIME_S.size)
    return Timeline(
        time_s=TIME_S,
        statistic=flat,
        risk=flat,
        threshold=0.7,
        alpha=0.02,
        advisory=flat > 0.7,
        azimuths_rad=np.linspace(-1.5, 1.5, 7),
        srp=np.ones((TIME_S.size, 7)),
        entities=(trail(TIME_S[5:20], 0.5, TIME_S[12]), trail(TIME_S[25:35], -0.5, np.inf)),
        sighting_time_s=np.empty(0),
        sighting_azimuth_rad=np.empty(0),
        t0_s=2.2,
        title="",
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
    broken = trail(apart, 0.2, np.inf).broken()
    gaps = np.flatnonzero(np.isnan(broken.azimuth_rad))
    assert gaps.tolist() == [4]
    assert np.isnan(broken.time_s[4])
    assert np.isfinite(np.delete(broken.azimuth_rad, 4)).all()
    whole = trail(TIME_S, 0.2, np.inf).broken()
    assert np.isfinite(whole.azimuth_rad).all()


def test_a_recording_without_entities_is_drawn(timeline, tmp_path):
    empty = replace(timeline, entities=())
    assert not drawn(empty)
    write_timeline(empty, tmp_path / "t.png")
    assert (tmp_path / "t.png").read_bytes()[:4] == b"\x89PNG"
