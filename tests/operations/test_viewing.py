"""Figures of snapshots: their content and colours, refusals of the command, and files that stay whole."""

from contextlib import contextmanager
from dataclasses import replace
from itertools import combinations

import matplotlib as mpl
import numpy as np
import pytest
import soundfile
from matplotlib import pyplot
from matplotlib.figure import Figure
from PIL import Image
from scripted_states import scripted_states

from worldstate.adapters.datasets.ovad import TrueTrack
from worldstate.cli.main import main
from worldstate.ground.errors import InputFileError
from worldstate.operations.figure_style import (
    CATEGORIES,
    DECISION,
    HEARD,
    HIDDEN,
    IN_VIEW,
    SEARCHED,
    TRUTH,
    figure_file,
    legend_beside,
    with_gaps,
)
from worldstate.operations.viewing import state_figure
from worldstate.operations.viewing.state_figure import (
    write_animation,
    write_birds_eye,
    write_state_figure,
)
from worldstate.state import WorldState

TIME_S = 0.2 + 0.1 * np.arange(40)


@pytest.fixture(scope="module")
def states():
    return scripted_states()


@pytest.fixture(scope="module")
def log(states, tmp_path_factory):
    path = tmp_path_factory.mktemp("plot") / "states.jsonl"
    path.write_text("".join(state.to_json() + "\n" for state in states))
    return path


def test_the_figure_over_time_names_its_panels(log, tmp_path):
    assert main(["log", "plot", str(log), "--out", str(tmp_path / "states.svg")]) == 0
    text = (tmp_path / "states.svg").read_text()
    for said in ("advisory left", "camera (tall: found)", "log-odds, left", "risk, right"):
        assert f"<!-- {said} -->" in text
    assert "@media (prefers-color-scheme: dark)" in text


def test_a_state_plots_itself_on_new_and_on_given_axes(states):
    axes = states[0].plot()
    figure, given = pyplot.subplots()
    assert states[0].plot(given) is given
    assert axes.figure is not figure
    assert axes.get_title(loc="left").startswith(f"{states[0].time_s:.1f} s")
    pyplot.close("all")


def test_a_vehicle_hidden_on_the_left_is_drawn_on_the_left(states, tmp_path):
    write_birds_eye(states[0], tmp_path / "above.png")
    with Image.open(tmp_path / "above.png") as image:
        shown = np.asarray(image.convert("RGB"), dtype=int)
    red = shown[..., 0] > shown[..., 2] + 60
    left, right = np.array_split(red, 2, axis=1)
    assert left.sum() > 3 * right.sum()


def test_an_animation_has_a_frame_for_every_state_at_the_speed_of_the_run(states, tmp_path):
    write_animation(states[:2] + states[-1:], tmp_path / "above.gif")
    with Image.open(tmp_path / "above.gif") as image:
        assert image.n_frames == 3
        span_ms = (states[-1].stamp_ns - states[0].stamp_ns) / 1e6
        assert image.info["duration"] == pytest.approx(span_ms / 2, abs=10.0)


def test_the_snapshot_nearest_to_the_time_is_drawn(log, states, tmp_path, capsys):
    above, time_s = str(tmp_path / "above.png"), states[2].stamp_ns / 1e9
    assert main(["log", "plot", str(log), "--birds-eye", above, "--time", f"{time_s + 0.03}", "--json"]) == 0
    assert f'"birds_eye_s": {time_s}' in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ([], "expected one of --out"),
        (["--animate", "above.png"], "ending in .gif"),
        (["--out", "states.gif"], "ending in .png"),
        (["--out", "states.png", "--recording", "-"], "pcm:RATE"),
    ],
)
def test_wrong_names_of_figures_and_sound_give_one_line(log, tmp_path, monkeypatch, capsys, options, said):
    monkeypatch.chdir(tmp_path)
    assert main(["log", "plot", str(log), *options]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("first_s", "last_s", "sound_s"),
    [(1.0, 4.0, 0.0), (2.5, 4.0, 0.0), (3.0, 6.0, 2.0), (1_700_000_001.0, 1_700_000_004.0, 1_700_000_000.0)],
    ids=["run", "run --resume", "run --start 2", "bag"],
)
def test_the_sound_is_drawn_on_the_clock_of_its_states(tmp_path, monkeypatch, first_s, last_s, sound_s):
    """A single click, two seconds after the first sample, is drawn at its time."""
    sound = np.random.default_rng(0).normal(0.0, 1e-4, (32_000, 1)) * np.ones(2)
    sound[16_000:16_400] += np.random.default_rng(1).normal(0.0, 0.5, (400, 1))
    soundfile.write(tmp_path / "click.wav", sound, 8000)
    (tmp_path / "pair.csv").write_text("0,0.2,1\n0,-0.2,1\n")
    stamps = [round(first_s * 10) * 10**8 + hop * 10**8 for hop in range(round((last_s - first_s) * 10) + 1)]
    log = tmp_path / "states.jsonl"
    log.write_text("".join(WorldState(stamp, 0).to_json() + "\n" for stamp in stamps))
    drawn = []
    monkeypatch.setattr(state_figure.style, "draw_power", lambda *parts: drawn.append(parts))
    options = ["--recording", str(tmp_path / "click.wav"), "--array", str(tmp_path / "pair.csv")]
    assert main(["log", "plot", str(log), "--out", str(tmp_path / "states.png"), *options]) == 0
    ((_, time_s, _, power, _),) = drawn
    loud = time_s[power.max(axis=1) > 0.9 * power.max()]
    assert loud.mean() == pytest.approx(sound_s + 2.0, abs=0.1)


@pytest.fixture
def panels(states, tmp_path, monkeypatch):
    """Return the panels of the figure over time, which is drawn and not written."""

    def drawn(states=states, **parts):
        figure = Figure(figsize=(10.0, 9.6), layout="constrained")

        @contextmanager
        def lent(*rest):
            yield figure

        monkeypatch.setattr(state_figure.style, "figure_file", lent)
        write_state_figure(states, tmp_path / "states.png", **parts)
        return figure.axes[:4]

    return drawn


def test_the_true_track_is_drawn_in_line_of_sight_and_out_of_it(panels):
    in_view = (TIME_S > 2.15) & (TIME_S < 3.65)
    true = TrueTrack(TIME_S, 0.02 * np.arange(40), in_view, np.zeros((40, 2)))
    shown = panels(t0_s=2.2, truth=(true,))
    lines = {line.get_label(): line for line in shown[0].lines}
    seen = lines["true vehicle, in sight"]
    assert seen.get_xdata()[np.isfinite(seen.get_ydata())][[0, -1]] == pytest.approx([2.2, 3.6])
    assert lines["line-of-sight entry $T_0$"].get_xdata() == [2.2, 2.2]
    shown[0].figure.draw_without_rendering()
    for axes in (shown[0], *shown[2:]):
        assert not axes.get_legend().get_window_extent().overlaps(axes.get_window_extent())
    assert not any("truth" in line.get_label() for line in panels()[0].lines)


def test_the_axis_begins_with_the_first_window_on_a_clock_of_1970_too(panels, states):
    late = [replace(state, stamp_ns=state.stamp_ns + 1_700_000_000 * 10**9) for state in states]
    for told in (states, late):
        low, high = panels(told)[0].get_xlim()
        assert low == pytest.approx(told[0].stamp_ns / 1e9 - 1.0, abs=1e-3)
        assert high == pytest.approx(told[-1].stamp_ns / 1e9 + 0.1, abs=1e-3)


def test_an_advisory_stands_in_the_row_of_its_side(panels, states):
    raised = [one for one in states if one.left.advisory]
    rows = panels()[1]
    names = [label.get_text() for label in rows.get_yticklabels()]
    bar = rows.collections[0].get_paths()[0].get_extents()
    assert names[round((bar.y0 + bar.y1) / 2)] == "advisory left"
    assert bar.x0 == pytest.approx(raised[0].stamp_ns / 1e9)


def test_log_odds_are_drawn_with_onsets_and_the_threshold_of_calibrated_states(panels, states):
    half = [replace(state, calibrated=i > 0) for i, state in enumerate(states)]
    terms = [state.left.evidence for state in states]
    shown = panels(half)
    # The last line of a name is that of the right side.
    lines = {line.get_label(): line for line in reversed(shown[2].lines)}
    compared = [one.compared_nats for one in terms]
    assert lines["log-odds, left"].get_ydata() == pytest.approx(compared)
    thresholds = [one.threshold_nats if k else np.nan for k, one in enumerate(terms)]
    assert lines["threshold"].get_ydata() == pytest.approx(thresholds, nan_ok=True)
    first = [bool(state.left.advisory) for state in states].index(True)
    onset = [[states[first].stamp_ns / 1e9, compared[first]]]
    assert lines["onset"].get_xydata().tolist() == pytest.approx(np.array(onset))
    assert "uncalibrated in 1 of" in shown[0].figure.get_suptitle()
    shown = panels(states)
    assert not any(line.get_label() == "threshold" for line in shown[2].lines)
    assert shown[0].figure.get_suptitle() == " (uncalibrated)"


def test_no_line_is_drawn_across_a_gap():
    apart = np.column_stack([np.concatenate([TIME_S[2:6], TIME_S[20:30]]), np.ones(14)])
    broken = with_gaps(apart)
    assert np.isnan(broken[4]).all()
    assert np.isfinite(np.delete(broken, 4, axis=0)).all()
    assert np.isfinite(with_gaps(np.column_stack([TIME_S, TIME_S]))).all()


MEANINGS = HIDDEN, IN_VIEW, SEARCHED, HEARD, TRUTH, DECISION


@pytest.mark.parametrize("name", ["a.xyz", "a", "a.jpg"])
def test_an_unknown_figure_format_raises_an_error_before_drawing(name, tmp_path):
    with pytest.raises(InputFileError, match=r"\.png, \.svg, \.pdf"), figure_file(tmp_path / name, 3, 2):
        pytest.fail("drawn")
    assert not list(tmp_path.iterdir())


def test_figures_are_reproducible_and_keep_the_style_of_the_caller(tmp_path):
    before = dict(mpl.rcParams)
    for name in ("a.svg", "b.svg"):
        with figure_file(tmp_path / name, 3, 2) as figure:
            axes = figure.subplots()
            axes.plot([1, 2], label="twice")
            axes.plot([2, 1], label="twice")
            legend_beside(axes)
            assert [text.get_text() for text in axes.get_legend().get_texts()] == ["twice"]
    first, second = ((tmp_path / name).read_text() for name in ("a.svg", "b.svg"))
    strip = [[line for line in text.splitlines() if "dc:date" not in line] for text in (first, second)]
    assert strip[0] == strip[1]
    assert dict(mpl.rcParams) == before


def test_a_figure_that_fails_leaves_no_file(tmp_path):
    with pytest.raises(ZeroDivisionError), figure_file(tmp_path / "a.png", 3, 2):
        raise ZeroDivisionError
    assert not list(tmp_path.iterdir())


# Linear sRGB as seen with protanopia, deuteranopia and tritanopia (Machado et al. 2009), and CIE XYZ.
SEEN = np.array([
    np.eye(3),
    [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
])  # fmt: skip
XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


def linear(colour):
    shown = np.array(mpl.colors.to_rgb(colour))
    return np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)


def lab(seen):
    share = XYZ @ np.clip(seen, 0.0, 1.0) / XYZ.sum(axis=1)
    x, y, z = np.where(share > 0.008856, np.cbrt(share), 7.787 * share + 16 / 116)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("colours", [MEANINGS, CATEGORIES])
def test_colours_differ_with_any_colour_vision(colours):
    for one, other in combinations(colours, 2):
        apart = [np.linalg.norm(lab(seen @ linear(one)) - lab(seen @ linear(other))) for seen in SEEN]
        assert min(apart) > 15.0, (one, other)


@pytest.mark.parametrize("colour", MEANINGS)
def test_colours_have_contrast_on_white(colour):
    assert 1.05 / (XYZ[1] @ linear(colour) + 0.05) > 3.0
