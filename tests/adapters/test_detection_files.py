"""Files of detections: the forms of several programs, numbers and names of images, and refusals."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from worldstate.adapters import read_any_detections
from worldstate.adapters.camera.class_names import class_name, may_be
from worldstate.adapters.camera.detections import read_detections, read_mot_text, read_yolo_text
from worldstate.adapters.files.odometry_file import read_odometry
from worldstate.ground.errors import InputFileError, InvalidArgumentError

WIDTH, HEIGHT = 640, 400
GOOD: dict[str, list[Any]] = {"boxes": [[0, 0, 10, 20]], "scores": [0.9], "classes_str": ["car"]}
NONE: dict[str, list[Any]] = {"boxes": [], "scores": [], "classes_str": []}
RESULT = {"image_id": 0, "category_id": 3, "bbox": [0, 0, 9, 9], "score": 0.9}
YOLO, MOT = "2 0.5 0.5 0.1 0.2 0.9\n", "1,1,0,0,9,9,1,-1,-1,-1\n"


def frames(*rows: object) -> str:
    return json.dumps({"detections_per_frame": list(rows)})


def written(path: Path, document: object) -> Path:
    path.write_text(json.dumps(document))
    return path


def yolo_folder(folder: Path, names: Sequence[str], texts: Sequence[str] | None = None) -> Path:
    folder.mkdir(exist_ok=True)
    for name, text in zip(names, texts or [YOLO] * len(names), strict=True):
        (folder / f"{name}.txt").write_text(text)
    return folder


def test_the_same_boxes_from_four_kinds_of_file(tmp_path: Path) -> None:
    rows = [[], [[10.0, 20.0, 60.0, 140.0]], [[0.0, 0.0, 64.0, 40.0], [320.0, 200.0, 640.0, 400.0]]]
    told = [{"boxes": r, "scores": [0.5] * len(r), "classes_str": ["car"] * len(r)} for r in rows]
    corners = [(i, *b) for i, row in enumerate(rows) for b in row]
    sizes = [(i, x, y, right - x, bottom - y) for i, x, y, right, bottom in corners]
    coco = [RESULT | {"image_id": i, "bbox": box, "score": 0.5} for i, *box in sizes]
    mot = [f"{i + 1},-1,{x},{y},{w},{h},0.5,-1,-1,-1" for i, x, y, w, h in sizes]
    (tmp_path / "ovad.json").write_text(frames(*told))
    (tmp_path / "coco.json").write_text(" \n" + json.dumps(coco))
    (tmp_path / "mot.txt").write_text("\n".join(mot))
    of_images = [(x + w / 2, y + h / 2, w, h) for _, x, y, w, h in sizes]
    lines = [f"2 {x / WIDTH} {y / HEIGHT} {w / WIDTH} {h / HEIGHT} 0.5" for x, y, w, h in of_images]
    texts = [lines[0], "\n".join(lines[1:])]
    yolo_folder(tmp_path / "yolo", ("street_00001", "street_00002"), texts)
    for name in ("ovad.json", "coco.json", "yolo", "mot.txt"):
        log = read_any_detections(tmp_path / name, 10.0, (WIDTH, HEIGHT))
        assert log.stamps_ns.tolist() == [0, 100_000_000, 200_000_000]
        for frame, row in zip(log.frames, rows, strict=True):
            assert frame.boxes_px == pytest.approx(np.array(row).reshape(-1, 4))
            assert set(frame.labels) <= {"car"} and set(frame.scores) <= {0.5}


COCO = '[{"image_id": %s, "category_id": 3, "bbox": [0,0,%s,%s], "score": %s}]'
REFUSED = [
    *((text, "expected JSON") for text in ("", "{", '{"detections_per_frame": [', "[" * 100_000)),
    (frames(GOOD, 3), "frame 1: expected an object, got 3"),
    (frames({"boxes": [], "scores": []}), r"frame 0\.classes_str: expected a list .*, got None"),
    (frames({**GOOD, "scores": []}), "frame 0: expected as many of each, .*1 boxes, 0 scores"),
    (frames({**GOOD, "boxes": [[0, 0, 10]]}), r"boxes_px: expected shape \(1, 4\), got \(1, 3\)"),
    (frames({**GOOD, "boxes": [[0, 0, True, 2]]}), r"boxes\[0\]\[2\]: expected a finite number, got True"),
    (frames({**GOOD, "boxes": [[10, 0, 0, 20]]}), "x1 <= x2"),
    (frames({**GOOD, "scores": [1.5]}), r"boxes\[0\]: .* scores in \[0, 1\], got .* with 1\.5"),
    (frames({**GOOD, "classes_str": [3]}), r"classes_str\[0\]: expected text, got 3"),
    (frames(GOOD, {**GOOD, "scores": [float("nan")]}), "NaN is not a JSON"),
    (frames(GOOD).replace("20", "2" * 5000), "expected JSON"),
    (frames({key: value * 1001 for key, value in GOOD.items()}), "at most 1000"),
    (frames(GOOD | {"stamp_ns": 5}, GOOD), "frame 1: expected stamp_ns, as in other frames"),
    (frames(GOOD | {"stamp_ns": 0.5}), r"frame 0\.stamp_ns: expected a whole number .*, got 0\.5"),
    *(
        (frames(*[NONE | {name: 1.7e9}] * 9), f'"stamp_ns", whole nanoseconds, got .*{name}')
        for name in ("timestamp", "stamp", "time_s", "timestamp_ms")
    ),
    # Files whose images are read one by one.
    ('{"detections_per_frame": [%s %s]}', "frame 1: expected JSON"),
    ('{"detections_per_frame": [%s, %s]} {}', "expected JSON"),
    ('{"note": {"detections_per_frame": [%s, %s]}}', "expected an object with a list"),
    ('{"detections_per_frame": [%s, %s], "a": NaN}', "NaN is not a JSON"),
    ('{"detections_per_frame": [%s, %s], "a": "\\ud800"}', "half a surrogate pair"),
    # COCO results.
    ("[%s, %s]", r"COCO.annotations\[0\].image_id"),
    ("[1]", "COCO"),
    *(
        (COCO % numbers, "")
        for numbers in (("-1", 1, 1, 1), (0, -1, 1, 1), (0, 1, "NaN", 1), (0, 1, 1, 2), ("true", 1, 1, 1))
    ),
    (COCO % (999_999_999, 1, 1, 1), "frame numbers from 0"),
]


@pytest.mark.parametrize(("text", "problem"), REFUSED)
def test_damaged_json_is_refused_with_its_place(tmp_path: Path, text: str, problem: str) -> None:
    name, good = tmp_path / "d.json", json.dumps(GOOD)
    name.write_text(text % (good, good) if "%s" in text else text)
    with pytest.raises(InputFileError, match=problem) as raised:
        read_any_detections(name)
    assert str(raised.value).startswith(f"{name}: ") and "\n" not in str(raised.value)


def test_blanks_and_further_keys_do_not_matter_and_a_list_is_needed(tmp_path: Path) -> None:
    for blanks in (
        '{ "detections_per_frame" :\n[ %s\n,\t%s ]\n, "model": 1}',
        '{"a": {}, "detections_per_frame": [%s,%s]}',
    ):
        (tmp_path / "d.json").write_text(blanks % (json.dumps(GOOD), json.dumps(GOOD)))
        assert len(read_any_detections(tmp_path / "d.json")) == 2
    for document in ([], {}, {"detections_per_frame": {}}):
        with pytest.raises(InputFileError, match="detections_per_frame"):
            read_detections(written(tmp_path / "d.json", document))
    for rate_hz in (0.0, float("nan"), 1e6):
        with pytest.raises(InvalidArgumentError, match="frame_rate_hz"):
            read_detections(tmp_path / "no.json", rate_hz)


BAD_YOLO = ["car 0 0 1 1", "2 0 0 1", "2 0 nan 1 1", "2 0 0 -1 1", "2 0 0 1 1 1.5", "2 0 0 1 1 1 1"]
BAD_MOT = [
    *("0,1,0,0,9,9,1,-1,-1,-1", "1.5,1,0,0,9,9,1,-1,-1,-1", "250001,1,0,0,9,9,1,-1,-1,-1"),
    *("nan,1,0,0,9,9,1,-1,-1,-1", "1,1,nan,0,9,9,1,-1,-1,-1", "1,1,0,inf,9,9,1,-1,-1,-1"),
    *("1,1,0,0,-9,9,1,-1,-1,-1", "1,1,0,0,9,9,67.5,-1,-1,-1", "1,1,0,0,9,9,1,nan,-1,-1", "1,1,0,0,9,9"),
    *("1,1,0,0,9,9,1,-1,-1,-1,5", "frame,id,x,y,w,h,conf", "1 1 0 0 9 9 1 -1 -1 -1", YOLO.strip()),
]


@pytest.mark.parametrize("line", BAD_YOLO)
def test_damaged_yolo_text_is_refused(line: str, tmp_path: Path) -> None:
    (tmp_path / "a_0.txt").write_text(line)
    with pytest.raises(InputFileError, match=r"a_0\.txt"):
        read_yolo_text(tmp_path, (64, 48))


@pytest.mark.parametrize("line", BAD_MOT)
def test_damaged_mot_text_is_refused_with_its_line(line: str, tmp_path: Path) -> None:
    (tmp_path / "det.txt").write_text(MOT + line)
    with pytest.raises(InputFileError, match=r"det\.txt.*line 2: expected frame, id, .* got '"):
        read_any_detections(tmp_path / "det.txt")


def test_text_is_bounded_and_needs_images_and_their_size(tmp_path: Path) -> None:
    for text, problem in (("\n" * 1_000_001, "1000000 lines"), (MOT * 1001, "1000 boxes a frame")):
        (tmp_path / "a.txt").write_text(text)
        with pytest.raises(InputFileError, match=f"at most {problem}"):
            read_mot_text(tmp_path / "a.txt")
    for path, problem in ((tmp_path, "size"), (tmp_path / "nothing.json", "nothing.*No such file")):
        with pytest.raises(InputFileError, match=problem):
            read_any_detections(path)
    (tmp_path / "a.txt").unlink()
    with pytest.raises(InputFileError, match="got none"):
        read_yolo_text(tmp_path, (64, 48))


tracks = st.dictionaries(
    st.tuples(st.integers(1, 20), st.integers(1, 5)),  # a frame has an id once
    st.tuples(*[st.floats(-1e4, 1e4)] * 2, *[st.floats(0.0, 1e4)] * 2, st.floats(0.0, 1.0)),
    max_size=20,
)


@given(tracks=tracks, looks=st.integers(20, 25))
def test_text_of_a_tracker_is_read_frame_by_frame(tracks, looks, tmp_path_factory) -> None:
    """Frames count from 1 and are in order, ids are not used, and frames without a line were searched."""
    path = tmp_path_factory.getbasetemp() / "sequence.txt"
    lines = [", ".join(map(repr, (*key, *box, -1, -1, -1))) for key, box in sorted(tracks.items())]
    path.write_text("".join(line + "\r\n" for line in lines))
    log = read_any_detections(path, 30.0, n_images=looks)
    assert len(log) == looks
    assert log.stamps_ns[[0, 15]].tolist() == [0, 500_000_000]
    for number, frame in enumerate(log.frames, 1):
        expected = [box for (at, _), box in sorted(tracks.items()) if at == number]
        assert frame.boxes_px.tolist() == [[x, y, x + w, y + h] for x, y, w, h, _ in expected]
        assert frame.scores.tolist() == [score for *_, score in expected]
    told = max((number for number, _ in tracks), default=0)
    named = sorted({number - 1 for number, _ in tracks})
    step = math.gcd(*np.diff(named).tolist()) if len(named) > 2 else 1
    seen = read_any_detections(path, 10.0).stamps_ns // 10**8
    # If the numbers rise by more than one, only every n-th image is listed.
    assert seen.tolist() == [*range(named[0] % step if named else 0, told, step)]
    if step > 1:
        with pytest.raises(InputFileError, match=rf"rise by {step}.*image_rate_hz"):
            read_any_detections(path)
    with pytest.raises(InputFileError, match=r"images by its boxes"):
        read_any_detections(path, n_images=told - 1)


def test_ground_truth_in_mot_text_has_classes_and_vehicles_without_visibility(tmp_path: Path) -> None:
    rows = ["1,1,0,0,9,9,1,3,0.5", "1,2,0,0,9,9,1,1,1", "1,3,0,0,9,9,0,3,1", "1,4,0,0,9,9,1,3,0"]
    (tmp_path / "gt.txt").write_text("\n".join([*rows, "1,5,0,0,9,9,1,8,1", "1,6,0,0,9,9,-1,-1,-1,-1"]))
    frame = read_mot_text(tmp_path / "gt.txt").frames[0]
    assert frame.labels == ("car", "person", "car", "car", "8", "car")
    # The third one is not to be considered, the fourth one is hidden, and the last line states no confidence.
    assert frame.scores.tolist() == [1.0, 1.0, 0.0, 0.0, 1.0, 1.0]


def test_class_numbers_follow_the_file_format(tmp_path: Path) -> None:
    def coco(*numbers: object) -> tuple[str, ...]:
        rows = [RESULT | {"category_id": k} for k in numbers]
        return read_any_detections(written(tmp_path / "c.json", rows)).frames[0].labels

    def yolo(*numbers: int) -> tuple[str, ...]:
        (tmp_path / "000000.txt").write_text("\n".join(f"{k} 0.5 0.5 0.1 0.2 0.9" for k in numbers))
        return read_yolo_text(tmp_path, (640, 480)).frames[0].labels

    assert coco(3, 8, 10, 90, 95) == ("car", "truck", "traffic light", "toothbrush", "95")
    assert coco("Van") == ("Van",)
    # Numbers from 0, and ambiguous numbers, which give no known class.
    assert coco(0, 2, 7) == ("person", "car", "truck")
    person, *others = coco(1, 2, 5)
    assert person == "person" and not {"car", "bicycle", "bus"} & {*map(class_name, others)}
    assert all(may_be(class_name(name), {"car"}) for name in others)
    assert yolo(2, 7, 9, 79, 80) == ("car", "truck", "traffic light", "toothbrush", "80")
    (tmp_path / "classes.txt").write_text("Van\r\nPedestrian\r\nMisc\r\n")
    assert [class_name(one) for one in yolo(0, 1, 2)] == ["car", "person", "misc"]


@pytest.mark.parametrize("size_px", [(640, 402), (1280, 720), (1936, 1217), (3840, 2412)])
def test_listed_images_must_have_the_size_of_the_camera(size_px: tuple[int, int], tmp_path: Path) -> None:
    listed = {"images": [{"id": 0, "width": size_px[0], "height": size_px[1]}], "annotations": []}
    path = written(tmp_path / "c.json", listed)
    assert len(read_any_detections(path, size_px=size_px)) == 1
    with pytest.raises(InputFileError, match=f"got {size_px[0]} x {size_px[1]}: width_px and height_px"):
        read_any_detections(path, size_px=(1936, 1216))


def test_images_that_a_detector_found_empty_are_looks(tmp_path: Path) -> None:
    boxes = [RESULT | {"image_id": 2}]
    images = [{"id": number, "file_name": f"{number}.jpg"} for number in (0, 2, 3)]
    listed, path = {"images": images, "annotations": boxes}, tmp_path / "coco.json"

    def found(document: object, n_images: int | None = None) -> list[int]:
        log = read_any_detections(written(path, document), n_images=n_images)
        return [len(frame) for frame in log.frames]

    # The results do not show that image 3 was searched.
    assert found(boxes) == found({"annotations": boxes}) == [0, 0, 1]
    assert found([]) == [] and found([], n_images=30) == [0] * 30
    assert found(boxes, n_images=5) == [0, 0, 1, 0, 0]
    assert found(listed) == [0, 1, 0]
    assert read_any_detections(path).stamps_ns.tolist() == [0, 200_000_000, 300_000_000]
    for document, more in ((boxes, 2), (listed, 5)):
        with pytest.raises(InputFileError, match="images"):
            found(document, more)
    with pytest.raises(InputFileError, match="images of all boxes listed, 2 is not"):
        found({"images": images[:1], "annotations": boxes})


def numbered(pattern: str, *numbers: object) -> list[str]:
    return [pattern.format(one) for one in numbers]


# Names of label files of exporters with the times of the images in 0.1 s; None if the order is ambiguous.
NAMES: dict[str, tuple[Sequence[str], Sequence[int] | None]] = {
    "one name and a number": (("street_0", "street_1", "street_3"), (0, 1, 2, 3)),
    "without leading zeros": (("f8", "f9", "f10"), range(11)),
    "Roboflow": ([f"cam_000{i}_jpg.rf.{n}" for i, n in ((1, "4f1e77"), (2, "08c5"), (3, "1"))], (0, 1, 2)),
    "Roboflow, of other images": (("0001_webp.rf.01", "0002_JPG.rf.02", "0004_tiff.rf.04"), (1, 2, 4)),
    "hashes": (("4f1e77aa0b3c", "08c5d2219e71"), None),
    "two cameras": (("left_0001", "right_0001"), None),
    "dates": (numbered("2024-05-01_10-0{}", "0-00", "0-01", "1-00"), None),
    "nanoseconds": (("1700000000000000000", "1700000000100000000"), None),
    "seconds and milliseconds": (numbered("1700000000.{}", 100, 200, 300), None),
    "milliseconds": (("000000", "000100", "000200"), None),
    "every third": (("frame_0", "frame_3", "frame_6", "frame_9"), None),
    "no number": (("first", "second"), None),
    "one number twice": (("a_01", "a_1"), None),
}


@pytest.mark.parametrize("name", NAMES)
def test_names_of_label_files_give_times_only_for_sequences(tmp_path: Path, name: str) -> None:
    names, expected = NAMES[name]
    yolo_folder(tmp_path, names)
    if expected is None:
        with pytest.raises(InputFileError, match=r"image_rate_hz|file_name|stamp_ns"):
            read_any_detections(tmp_path, size_px=(640, 480))
        return
    log = read_any_detections(tmp_path, size_px=(640, 480))
    assert (log.stamps_ns // 10**8).tolist() == [*expected]
    assert sum(map(len, log.frames)) == len(names)


def test_a_stated_rate_allows_every_third_image_and_empty_files_are_images(tmp_path: Path) -> None:
    log = read_any_detections(yolo_folder(tmp_path / "a", numbered("f_{}", 0, 3, 9, 12)), 30.0, (640, 480))
    assert [len(frame) for frame in log.frames] == [1, 1, 0, 1, 1]
    assert (log.stamps_ns // 10**8).tolist() == [0, 1, 2, 3, 4]
    folder = yolo_folder(tmp_path / "b", numbered("f_{:02d}", 0, 1, 4, 9), (YOLO, "", "", YOLO))
    # With an empty file every image has one.
    assert (read_any_detections(folder, size_px=(640, 480)).stamps_ns // 10**8).tolist() == [0, 1, 4, 9]


FRAMES = [f"frame_{i:04d}.jpg" for i in range(20)]
# Ids and file names of listed images, and their times in 0.1 s.
LISTED: dict[str, tuple[Sequence[int | str], Sequence[str | None], Sequence[int]]] = {
    "from 0": (range(4), [None] * 4, range(4)),
    "from 1": (range(1, 5), [None] * 4, range(4)),
    "from 1, named from 1": (range(1, 5), FRAMES[1:5], range(4)),
    "from 1, listed backwards": (range(1, 5), FRAMES[3::-1], (3, 2, 1, 0)),
    "arbitrary, in another order": ((1, 700, 3), [FRAMES[2], FRAMES[0], FRAMES[1]], (2, 0, 1)),
    "arbitrary, cut from a longer video": ((7, 9, 8), FRAMES[10:13], range(3)),
    "arbitrary, some of a video": ((7, 9, 8), (FRAMES[0], FRAMES[4], FRAMES[9]), (0, 4, 9)),
    "named by times": ((3, 2, 1), numbered("17000000{}.jpg", "00", 12, 25), range(3)),
    "ids are names of a part": (("v_0", "v_7", "v_3"), [None] * 3, (0, 7, 3)),
    "ids are numbers as text": (("1", "2", "3"), [None] * 3, range(3)),
    "ids are hashes": (("0a1f", "93bc", "77ee"), FRAMES[:3], range(3)),
}


@pytest.mark.parametrize("name", LISTED)
def test_listed_images_are_ordered_by_name(tmp_path: Path, name: str) -> None:
    ids, names, expected = LISTED[name]
    images = [{"id": i} | ({} if n is None else {"file_name": n}) for i, n in zip(ids, names, strict=True)]
    # The left edge of a box identifies its image.
    boxes = [RESULT | {"image_id": i, "bbox": [place, 0, 9, 9]} for place, i in enumerate(ids)]
    log = read_any_detections(written(tmp_path / "coco.json", {"images": images, "annotations": boxes}))
    places = [int(frame.boxes_px[0, 0]) for frame in log.frames]
    taken = dict(zip(places, (log.stamps_ns // 10**8).tolist(), strict=True))
    assert [taken[place] for place in range(len(ids))] == [*expected]


NO_ORDER = [("0a1f", "93bc"), ("left_1", "right_1"), (-1, -2), (1700000000000000000, 1700000000100000000)]


@pytest.mark.parametrize("ids", NO_ORDER)
def test_ids_without_an_order_are_refused_with_a_remedy(tmp_path: Path, ids: tuple[object, ...]) -> None:
    boxes = [RESULT | {"image_id": i} for i in ids]
    for document in (boxes, {"images": [{"id": i} for i in ids], "annotations": boxes}):
        with pytest.raises(InputFileError, match=r'"file_name"|"stamp_ns"'):
            read_any_detections(written(tmp_path / "c.json", document))


def test_results_may_name_their_images_and_lack_scores(tmp_path, caplog) -> None:
    named = [RESULT | {"image_id": f"street_{i}"} for i in (3, 0, 13)]
    log = read_any_detections(written(tmp_path / "c.json", named), 10.0)
    assert [i for i, frame in enumerate(log.frames) if len(frame)] == [0, 3, 13]
    unscored = {key: value for key, value in RESULT.items() if key != "score"}
    boxes = written(tmp_path / "c.json", [unscored, unscored | {"score": 0.25}, unscored | {"score": None}])
    assert read_any_detections(boxes).frames[0].scores.tolist() == [1.0, 0.25, 1.0]
    assert "2 boxes without a score count with 1.0" in caplog.text


@given(stamps=st.lists(st.integers(0, 9), min_size=1, max_size=12))
def test_images_and_odometry_are_sorted_and_the_last_duplicate_counts(stamps, tmp_path_factory) -> None:
    folder = tmp_path_factory.getbasetemp()
    rows = [GOOD | {"scores": [k / 100], "stamp_ns": stamp * 10**8} for k, stamp in enumerate(stamps)]
    (folder / "d.json").write_text(frames(*rows))
    lines = (f"{stamp / 10},{place}\n" for place, stamp in enumerate(stamps))
    (folder / "o.csv").write_text("time_s,speed_mps\n" + "".join(lines))
    last = {stamp: place for place, stamp in enumerate(stamps)}
    log, told = read_any_detections(folder / "d.json"), read_odometry(folder / "o.csv").told
    assert (log.stamps_ns // 10**8).tolist() == sorted(last) == [one.stamp_ns // 10**8 for one in told]
    assert [round(100 * frame.scores[0]) for frame in log.frames] == [last[stamp] for stamp in sorted(last)]
    assert [one.speed_mps for one in told] == [last[stamp] for stamp in sorted(last)]
