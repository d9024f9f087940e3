"""Staged videos of a corner, searched by a simple detector, and counts of its boxes; needs no recording."""

import json
from itertools import chain, product

import cv2
import numpy as np
import pytest
from worldstate_lab.cli.main import main
from worldstate_lab.degradation.conditions import FAMILIES, Condition
from worldstate_lab.metrics.intervals import stratified_draws
from worldstate_lab.sequences import staged_video
from worldstate_lab.sequences.recordings import read_boxes, read_recordings
from worldstate_lab.sequences.staged_looks import (
    staged_beta,
    vision_row,
)
from worldstate_lab.sequences.staged_video import Staging, stage_recording

from worldstate.adapters.camera.detections import DetectionFrame

WIDTH, HEIGHT, IMAGES, T0 = 240, 162, 40, 2.0
# The first and last row of the video are not searched, and the substitute for NanoDet searches every second
# image.
CLEAN, DARK, NOISY = Condition("clean"), Condition("darkness", 4), Condition("noise", 1)


def block(number):
    """Return left and right edge of the moving block from the image of T0 on, None before."""
    left = 6 * (number - 20)
    return (left, left + 60) if left >= 0 else None


class Bright:
    """A detector of one bright block."""

    def detect(self, frame):
        columns = np.flatnonzero(frame[frame.shape[0] // 2, :, 0] > 150)
        if not columns.size:
            return DetectionFrame(np.empty((0, 4)), np.empty(0), ())
        box = [[float(columns[0]), 30.0, float(columns[-1] + 1), 130.0]]
        return DetectionFrame(np.array(box), np.array([0.8]), ("car",))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two junctions with an approach and a hazard-free recording each, in the layout of the recordings."""
    folder, codec = tmp_path_factory.mktemp("corner"), cv2.VideoWriter.fourcc(*"mp4v")
    for place in ("video", "boxes"):
        (folder / place).mkdir()
    lines = ["id,junction,side,t0_s,seconds,entry_exit"]
    for site, (name, side) in product(("SA1", "SB3"), (("a", "left"), ("n", "none"))):
        lines.append(f"{name}{site},{site},{side},{T0},4.0,")
        video = cv2.VideoWriter(str(folder / "video" / f"{name}{site}.mp4"), codec, 10.0, (WIDTH, HEIGHT))
        frames = []
        for number in range(IMAGES):
            image = np.full((HEIGHT, WIDTH, 3), 80, np.uint8)
            place = block(number) if side == "left" else None
            if place:
                image[31:131, slice(*place)] = 230
            video.write(image)
            frames.append([[place[0], 31, place[1], 131, 0.8, "car"]] if place else [])
        video.release()
        document = {"frames": frames, "size": [WIDTH, HEIGHT], "fps": 10.0}
        (folder / "boxes" / f"{name}{site}.json").write_text(json.dumps(document))
    (folder / "truth.csv").write_text("\n".join(lines) + "\n")
    return folder


@pytest.fixture(scope="module")
def staging(folder, tmp_path_factory):
    states = [Condition(family, level) for family in FAMILIES for level in (1, 2, 3, 4)]
    staging = Staging(tmp_path_factory.mktemp("staged"), "nanodet", Bright, 2, (CLEAN, *states))
    for recording in read_recordings(folder):
        assert stage_recording(staging, recording) == 13 * IMAGES / 2
    return staging


def test_a_state_has_the_layout_of_the_clean_boxes_and_is_searched_once(folder, staging, tmp_path):
    recording = read_recordings(folder)[0]
    document = json.loads(staging.path(CLEAN, recording.name).read_text())
    assert (document["size"], document["fps"], len(document["frames"])) == ([WIDTH, HEIGHT], 10.0, IMAGES)
    assert [one is None for one in document["frames"]] == [False, True] * (IMAGES // 2)
    log = read_boxes(staging.path(CLEAN, recording.name))
    assert np.diff(log.stamps_ns).tolist() == [200_000_000] * (IMAGES // 2 - 1)
    (box,) = log.frames[-1].boxes_px
    np.testing.assert_allclose(box, [108.0, 31.0, 168.0, 131.0], atol=3.0)
    assert stage_recording(staging, recording) == 0
    # The result depends on state and image only: staged alone, the state is the same.
    alone = Staging(tmp_path, "nanodet", Bright, 2, (NOISY,))
    stage_recording(alone, recording)
    assert alone.path(NOISY, recording.name).read_bytes() == staging.path(NOISY, recording.name).read_bytes()


def test_the_dark_camera_is_not_aware_and_the_clean_one_is(folder, staging):
    recordings = read_recordings(folder)
    approaches = [one for one in recordings if not one.hazard_free]
    draws = stratified_draws([one.junction for one in approaches], np.random.default_rng(0), draws=20)
    clean, dark = (vision_row(staging, state, recordings, draws) for state in (CLEAN, DARK))
    assert (clean.looks, clean.aware.value, dark.aware.value) == (20, 1.0, 0.0)
    assert clean.hazard_free == {"SA1": 0.0, "SB3": 0.0}
    curves = staged_beta(staging, approaches, draws)
    darkness = curves.overall.value[1]
    assert darkness[0] == 0.0 and darkness[-1] == 1.0
    assert curves.looks[:, :, 0].sum() == 3 * 20
    assert not [one for one in curves.falls if one.along == "degradation" and one.where.startswith("dark")]


def test_the_command_stages_and_prints_its_counts(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(staged_video, "opened_nanodet", lambda model: Bright())
    words = ["staged", str(folder), "--out", str(tmp_path / "staged")]
    assert main([*words, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["recordings"] == 4
    states = [*report["vision"]]
    assert len(states) == 17 and states[0] == "clean" and states[-1] == "lens 1"
    rates = chain.from_iterable(report["beta"]["overall"].values())
    assert all(one is None or 0.0 <= np.ravel(one)[0] <= 1.0 for one in rates)
