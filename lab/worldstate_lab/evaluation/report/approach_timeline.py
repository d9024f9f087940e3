"""One approach end to end: three camera images above, statistic, threshold, advisory and camera below."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.video import open_video, opencv
from worldstate.ground.typing import BoolArray, FloatArray, ImageArray
from worldstate.operations.figure_style import BLUE, GREEN, PURPLE, RED
from worldstate.operations.recordings.hop_table import HopTable
from worldstate_lab.report.table import Figure

from .panels import legend_below

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

# The paper's first image is 2.5 s before line-of-sight entry, with the vehicle still behind the corner.
HIDDEN_S = 2.5
# Three images side by side at 150 dots an inch are 440 pixels wide each; more is not seen.
_IMAGE_PX = 480
# An advisory holds until the next decision.
_HOP_S = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class ApproachImage:
    """One camera image, what it shows, and where the vehicle is: a box, or the column of a hidden one."""

    title: str
    image: ImageArray  # shape (height, width, 3), red first
    box_px: FloatArray | None = None  # shape (4,), in pixels of this image
    column_px: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ApproachTimeline:
    """What the figure shows of one recording, one row a hop; `seen_s` are the times of moving boxes."""

    title: str
    time_s: FloatArray
    statistic: FloatArray
    threshold: float
    alpha: float
    alarm: BoolArray
    seen_s: FloatArray
    t0_s: float
    images: tuple[ApproachImage, ...] = ()


def approach_figure(approach: ApproachTimeline) -> Figure:
    """Draw an approach as the paper's timeline figure does; without images their row is left out."""

    def draw(canvas: "Canvas") -> None:
        rows = 2 if approach.images else 1
        grid = canvas.add_gridspec(rows, max(len(approach.images), 1), height_ratios=(0.62, 1.0)[-rows:])
        for i, image in enumerate(approach.images):
            _draw_image(canvas.add_subplot(grid[0, i]), image)
        _draw_statistic(canvas.add_subplot(grid[rows - 1, :]), approach)
        legend_below(canvas, columns=5)

    # A box that came between two hops belongs to the later one, which is the first to know of it.
    seen = np.bincount(
        np.searchsorted(approach.time_s - 1e-6, approach.seen_s), minlength=approach.time_s.size + 1
    )
    columns = approach.time_s, approach.statistic, approach.alarm, seen[: approach.time_s.size]
    camera = (
        "Above: camera images; the dashed box is the vehicle as the camera reports it, the dotted line the "
        "direction in which it is hidden. "
        if approach.images
        else "The recording has no video that could be read, so the row of camera images is left out. "
    )
    return Figure(
        "approach_timeline",
        approach.title,
        f"{camera}Below: hazard statistic at the end of each 1-s window, threshold, advisory, moving boxes "
        "of the camera, and line-of-sight entry T0.",
        draw,
        ("time_s", "statistic", "advisory", "moving_boxes"),
        [(float(t), float(s), int(on), int(n)) for t, s, on, n in zip(*columns, strict=True)],
        size_in=(9.0, 5.4 if approach.images else 3.4),
    )


def approach_images(video: Path, boxes: HopTable, truth: HopTable, t0_s: float) -> tuple[ApproachImage, ...]:
    """Read the three images of an approach: hidden, just after T0, and at the pass.

    `boxes` and `truth` are those of a `Trial`. The pass is the image with the highest moving box.
    """
    moving = boxes.moving.astype(bool) & (boxes.time_s >= t0_s) if len(boxes) else np.zeros(0, bool)
    rows = np.flatnonzero(moving)
    heights = boxes.box_px[rows, 3] - boxes.box_px[rows, 1] if rows.size else np.zeros(0)
    first_s, pass_s = (
        (float(boxes.time_s[rows[0]]), float(boxes.time_s[rows[heights.argmax()]]))
        if rows.size
        else (t0_s + 0.3, t0_s + 1.0)
    )
    moments = {
        max(t0_s - HIDDEN_S, 0.0): "hidden",
        first_s: "first seen" if rows.size else "after $T_0$",
        pass_s: "at the pass",
    }
    opened = open_video(video)
    wanted = {round(time_s * opened.frame_rate_hz): (time_s, what) for time_s, what in moments.items()}
    found = []
    for number, image in enumerate(opened.frames()):
        if number in wanted:
            found.append(_image(image, *wanted[number], boxes, truth))
        if number >= max(wanted):
            break
    return tuple(found)


def _image(image: ImageArray, time_s: float, what: str, boxes: HopTable, truth: HopTable) -> ApproachImage:
    height, width = image.shape[:2]
    scale = min(_IMAGE_PX / width, 1.0)
    size = (round(width * scale), round(height * scale))
    small = opencv().resize(image, size, interpolation=opencv().INTER_AREA)
    box = _box_at(boxes, time_s)
    column = (
        None
        if box is not None
        else _column_at(truth, time_s, PinholeCamera(width_px=width, height_px=height))
    )
    return ApproachImage(
        f"{time_s:.1f} s, {what}",
        np.ascontiguousarray(small[..., ::-1]),
        None if box is None else box * scale,
        None if column is None else column * scale,
    )


def _box_at(boxes: HopTable, time_s: float) -> FloatArray | None:
    """Return the highest moving box of the image at this time."""
    if not len(boxes):
        return None
    rows = np.flatnonzero(boxes.moving.astype(bool) & (np.abs(boxes.time_s - time_s) < 0.05))
    if not rows.size:
        return None
    heights = boxes.box_px[rows, 3] - boxes.box_px[rows, 1]
    return np.asarray(boxes.box_px[rows[heights.argmax()]], np.float64)


def _column_at(truth: HopTable, time_s: float, camera: PinholeCamera) -> float | None:
    """Return the column of the true direction, None where it is outside the view or unknown."""
    if not len(truth):
        return None
    row = int(np.abs(truth.time_s - time_s).argmin())
    azimuth = float(truth.azimuth_rad[row])
    return float(camera.column(azimuth)) if bool(camera.sees(azimuth)) else None


def _draw_image(axes: "Axes", shown: ApproachImage) -> None:
    from matplotlib.patches import Rectangle

    axes.imshow(shown.image)
    if shown.box_px is not None:
        x1, y1, x2, y2 = shown.box_px
        # Two strokes, so that the box shows on dark and on bright images.
        for colour, style in (("white", "-"), (RED, (0, (3, 2)))):
            box = Rectangle(
                (x1, y1), x2 - x1, y2 - y1, fill=False, edgecolor=colour, linestyle=style, linewidth=1.6
            )
            axes.add_patch(box)
    if shown.column_px is not None:
        axes.axvline(shown.column_px, color="white", linewidth=1.4)
        axes.axvline(shown.column_px, color=RED, linewidth=1.4, linestyle=":")
    axes.set_title(shown.title, fontsize=9)
    axes.set(xticks=[], yticks=[])


def _draw_statistic(axes: "Axes", approach: ApproachTimeline) -> None:
    axes.plot(approach.time_s, approach.statistic, color=BLUE, label="statistic $s(t)$")
    label = rf"$\gamma(\alpha={approach.alpha:g})$"
    if np.isfinite(approach.threshold):
        axes.axhline(approach.threshold, color=BLUE, linestyle=":", label=label)
    # Advisory and boxes stand above the range of the statistic, where they cover nothing of it.
    top = max(1.0, float(np.nanmax(approach.statistic, initial=0.0)))
    bars = [(t, _HOP_S) for t in approach.time_s[approach.alarm]]
    axes.broken_barh(bars, (1.05 * top, 0.1 * top), color=GREEN, lw=0, label="advisory")
    heights = np.full(approach.seen_s.size, 1.22 * top)
    axes.plot(approach.seen_s, heights, "|", color=PURPLE, ms=9, label="moving box of the camera")
    axes.axvline(approach.t0_s, color="black", linestyle="--", linewidth=1.2, label="$T_0$")
    axes.set(xlabel="time (s)", ylabel="statistic", ylim=(-0.03 * top, 1.32 * top))
    axes.set_yticks(np.linspace(0.0, top, 5))
    axes.set_xlim(0.0, float(approach.time_s[-1]) + _HOP_S)
