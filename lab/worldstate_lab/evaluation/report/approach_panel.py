"""One approach end to end, like the paper's timeline figure."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.video import open_video
from worldstate.ground.extras import optional
from worldstate.ground.typing import FloatArray, ImageArray
from worldstate.operations.figure_style import DECISION, HIDDEN, IN_VIEW, SEARCHED, TRUTH
from worldstate.operations.recordings.hop_table import HOP_S, HopTable
from worldstate_lab.report.table import Figure
from worldstate_lab.trials.trial import Decisions, Trial

from .panels import legend_below

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

# The paper's first image is 2.5 s before line-of-sight entry, when the vehicle is still behind the corner.
HIDDEN_S = 2.5
# Three images side by side at 150 dots per inch are 440 pixels wide each; a higher resolution is not visible.
_IMAGE_PX = 480


@dataclass(frozen=True, slots=True, eq=False)
class ApproachImage:
    """One camera image, its caption, and the place of the vehicle: a box, or a column if it is hidden."""

    title: str
    image: ImageArray  # shape (height, width, 3), red first
    box_px: FloatArray | None = None  # shape (4,), in pixels of this image
    column_px: float | None = None


def approach_figure(title: str, trial: Trial, said: Decisions, images: Sequence[ApproachImage]) -> Figure:
    """Draw an approach like the paper's timeline figure."""
    # Before the first hop, parked and moving cars cannot be distinguished.
    moving = trial.boxes.moving.astype(bool) & (trial.boxes.time_s >= said.time_s[0])
    seen_s = trial.boxes.time_s[moving]

    def draw(canvas: "Canvas") -> None:
        grid = canvas.add_gridspec(2, len(images), height_ratios=(0.62, 1.0))
        for i, image in enumerate(images):
            _draw_image(canvas.add_subplot(grid[0, i]), image)
        _draw_statistic(canvas.add_subplot(grid[1, :]), trial.t0_s, said, seen_s)
        legend_below(canvas, columns=5)

    # A box between two hops belongs to the later one, which is the first that can use it.
    at = np.searchsorted(said.time_s - 1e-6, seen_s)
    boxes = np.bincount(at, minlength=said.time_s.size + 1)[: said.time_s.size]
    return Figure(
        "approach_timeline",
        title,
        "Above: camera images; the dashed box is the vehicle as the camera reports it, the dotted line the "
        "direction in which it is hidden. Below: hazard statistic at the end of each 1-s window, threshold, "
        "advisory, moving boxes of the camera, and line-of-sight entry T0.",
        draw,
        ("time_s", "statistic", "advisory", "moving_boxes"),
        [
            (float(t), float(s), int(on), int(n))
            for t, s, on, n in zip(said.time_s, said.score, said.alarm, boxes, strict=True)
        ],
        size_in=(9.0, 5.4),
    )


def approach_images(video: Path, trial: Trial) -> tuple[ApproachImage, ...]:
    """Read the three images of an approach: hidden, just after T0, and at the pass.

    The pass is the image with the highest moving box.
    """
    boxes, t0_s = trial.boxes, trial.t0_s
    rows = np.flatnonzero(boxes.moving.astype(bool) & (boxes.time_s >= t0_s))
    first_s, pass_s, first = t0_s + 0.3, t0_s + 1.0, "after $T_0$"
    if rows.size:
        highest = rows[(boxes.box_px[rows, 3] - boxes.box_px[rows, 1]).argmax()]
        first_s, pass_s, first = float(boxes.time_s[rows[0]]), float(boxes.time_s[highest]), "first seen"
    moments = {max(t0_s - HIDDEN_S, 0.0): "hidden", first_s: first, pass_s: "at the pass"}
    opened = open_video(video)
    wanted = {round(time_s * opened.frame_rate_hz): (time_s, what) for time_s, what in moments.items()}
    found = []
    for number, image in enumerate(opened.frames()):
        if number in wanted:
            found.append(_image(image, *wanted[number], boxes, trial.truth))
        if number >= max(wanted):
            break
    return tuple(found)


def _image(image: ImageArray, time_s: float, what: str, boxes: HopTable, truth: HopTable) -> ApproachImage:
    height, width = image.shape[:2]
    scale = min(_IMAGE_PX / width, 1.0)
    size = (round(width * scale), round(height * scale))
    small = optional("cv2").resize(image, size, interpolation=optional("cv2").INTER_AREA)
    box = _box_at(boxes, time_s)
    column = (
        None
        if box is not None
        else _column_at(truth, time_s, PinholeCamera.ovad(width_px=width, height_px=height))
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
    """Return the image column of the true direction, or None if it is outside the view or unknown."""
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
        # Two strokes make the box visible on dark and on bright images.
        for colour, style in (("white", "-"), (IN_VIEW, (0, (3, 2)))):
            box = Rectangle(
                (x1, y1), x2 - x1, y2 - y1, fill=False, edgecolor=colour, linestyle=style, linewidth=1.6
            )
            axes.add_patch(box)
    if shown.column_px is not None:
        axes.axvline(shown.column_px, color="white", linewidth=1.4)
        axes.axvline(shown.column_px, color=HIDDEN, linewidth=1.4, linestyle=":")
    axes.set_title(shown.title, fontsize=9)
    axes.set(xticks=[], yticks=[])


def _draw_statistic(axes: "Axes", t0_s: float, said: Decisions, seen_s: FloatArray) -> None:
    axes.plot(said.time_s, said.score, color=HIDDEN, label="statistic $s(t)$")
    if said.threshold.size and np.isfinite(said.threshold).all():
        level = np.broadcast_to(said.threshold, said.time_s.shape)
        axes.plot(said.time_s, level, color=DECISION, linestyle=":", label="threshold")
    # Advisory and boxes are drawn above the range of the statistic, so that they do not cover it.
    top = max(1.0, float(np.nanmax(said.score, initial=0.0)))
    # An advisory lasts until the next decision.
    bars = [(t, HOP_S) for t in said.time_s[said.alarm]]
    axes.broken_barh(bars, (1.05 * top, 0.1 * top), color=DECISION, lw=0, label="advisory")
    axes.plot(
        seen_s, np.full(seen_s.size, 1.22 * top), "|", color=SEARCHED, ms=9, label="moving box of the camera"
    )
    axes.axvline(t0_s, color=TRUTH, linestyle="--", linewidth=1.2, label="$T_0$")
    axes.set(xlabel="time (s)", ylabel="statistic", ylim=(-0.03 * top, 1.32 * top))
    axes.set_yticks(np.linspace(0.0, top, 5))
    axes.set_xlim(0.0, float(said.time_s[-1]) + HOP_S)
