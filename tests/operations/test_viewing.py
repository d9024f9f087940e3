"""Figures of snapshots: what stands in them, and where the command refuses."""

from itertools import pairwise

import numpy as np
import pytest
from PIL import Image
from scripted_states import scripted_states

from worldstate.cli.main import main
from worldstate.operations.viewing.state_figure import write_animation, write_birds_eye


@pytest.fixture(scope="module")
def states():
    return scripted_states()


@pytest.fixture(scope="module")
def log(states, tmp_path_factory):
    path = tmp_path_factory.mktemp("plot") / "states.jsonl"
    path.write_text("".join(state.to_json() + "\n" for state in states))
    return path


def pixels(path):
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"), dtype=int)


def reddish(image):
    return (image[..., 0] > image[..., 2] + 60).sum(axis=0)


def test_the_figure_over_time_names_its_panels(log, tmp_path):
    assert main(["log", "plot", str(log), "--out", str(tmp_path / "states.svg")]) == 0
    text = (tmp_path / "states.svg").read_text()
    for said in ("advisory left", "camera (blue: found)", "somebody hidden, left", "risk, right"):
        assert f"<!-- {said} -->" in text


def test_who_is_hidden_on_the_left_is_drawn_on_the_left(states, tmp_path):
    write_birds_eye(states[0], tmp_path / "above.png")
    red = reddish(pixels(tmp_path / "above.png"))
    left, right = np.split(red[: red.size // 2 * 2], 2)
    assert left.sum() > 3 * right.sum()


def test_an_animation_has_a_frame_for_every_state_at_the_speed_of_the_run(states, tmp_path):
    write_animation(states[:2] + states[-1:], tmp_path / "above.gif")
    with Image.open(tmp_path / "above.gif") as image:
        assert image.n_frames == 3
        span_ms = (states[-1].stamp_ns - states[0].stamp_ns) / 1e6
        assert image.info["duration"] == pytest.approx(span_ms / 2, abs=10.0)


def test_the_snapshot_nearest_to_the_time_is_drawn(log, states, tmp_path, capsys):
    stamps_s = [state.stamp_ns / 1e9 for state in states]
    assert all(a < b for a, b in pairwise(stamps_s))
    above = str(tmp_path / "above.png")
    assert (
        main(["log", "plot", str(log), "--birds-eye", above, "--time", f"{stamps_s[2] + 0.03}", "--json"])
        == 0
    )
    assert f'"birds_eye_s": {stamps_s[2]}' in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ([], "expected one of --out"),
        (["--animate", "above.png"], "ending in .gif"),
        (["--out", "states.gif"], "ending in .png"),
        (["--out", "states.png", "--recording", "-"], "pcm:RATE"),
    ],
)
def test_what_cannot_be_drawn_is_refused_in_one_line(log, tmp_path, monkeypatch, capsys, options, said):
    monkeypatch.chdir(tmp_path)
    assert main(["log", "plot", str(log), *options]) == 2
    assert said in capsys.readouterr().err
