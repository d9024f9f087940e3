"""One approach end to end: three camera images above, statistic, threshold, advisory and camera below."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.video import VIDEO_NAME, open_video
from worldstate.ground.errors import WorldstateError
from worldstate.ground.extras import optional
from worldstate.ground.typing import FloatArray, ImageArray
from worldstate.operations.figure_style import BLUE, GREEN, PURPLE, RED
from worldstate.operations.metrics.approach_table import onset_outcome, rising_edges
from worldstate.operations.recordings.hop_table import HopTable
from worldstate_lab.evaluation.evaluation import ALPHA, Evaluation
from worldstate_lab.evaluation.protocols import STANDING
from worldstate_lab.report.table import Figure, Section
from worldstate_lab.trials.trial import Decisions, Trial

from .measured_values import PROPOSED
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


def approach_section(found: Evaluation) -> Section:
    """Return the timeline of the detected approach whose lead is the median one, filmed ones preferred."""
    title, run = "One approach end to end", found.runs[STANDING]
    answers = run.decisions[PROPOSED][0]
    leads = leads_s(run.trials, [answers])
    pairs = [(t, s) for t, s in zip(run.trials, answers, strict=True) if not t.hazard_free]
    detected = np.flatnonzero(np.isfinite(leads))
    videos = {take.name: take.path / VIDEO_NAME for take in found.takes.static}
    filmed = np.array([i for i in detected if videos[pairs[i][0].name].is_file()], np.intp)
    chosen = filmed if filmed.size else detected
    if not chosen.size:
        return Section(title, ("No approach was detected by the proposed method.",))
    middle = chosen[np.argsort(leads[chosen], kind="stable")[(chosen.size - 1) // 2]]
    trial, said = pairs[middle]
    # Without OpenCV, or with a video that cannot be read, the rest of the figure stays.
    images: tuple[ApproachImage, ...] = ()
    with suppress(WorldstateError):
        images = _approach_images(videos[trial.name], trial)
    name = f"Approach {trial.name} at {trial.site}, from the {trial.label}"
    figure = approach_figure(f"{name}: lead {leads[middle]:.1f} s (paper's: 2.3 s)", trial, said, images)
    text = f"The approach with the median lead of the {detected.size} that {PROPOSED} detects."
    return Section(title, (text,), (figure,))


def leads_s(trials: Sequence[Trial], passes: Sequence[Sequence[Decisions]]) -> FloatArray:
    """Return the lead of every approach and seed, NaN where it was not detected."""
    leads = [
        onset_outcome(said.time_s[rising_edges(said.alarm)], trial.t0_s).lead_s
        for answers in passes
        for trial, said in zip(trials, answers, strict=True)
        if not trial.hazard_free
    ]
    return np.array([lead or np.nan for lead in leads])


def approach_figure(
    title: str, trial: Trial, said: Decisions, images: Sequence[ApproachImage] = ()
) -> Figure:
    """Draw an approach as the paper's timeline figure does; without images their row is left out."""
    # Before the first hop a parked car cannot be told from a moving one.
    moving = trial.boxes.moving.astype(bool) & (trial.boxes.time_s >= said.time_s[0])
    seen_s = trial.boxes.time_s[moving]

    def draw(canvas: "Canvas") -> None:
        rows = 2 if images else 1
        grid = canvas.add_gridspec(rows, max(len(images), 1), height_ratios=(0.62, 1.0)[-rows:])
        for i, image in enumerate(images):
            _draw_image(canvas.add_subplot(grid[0, i]), image)
        _draw_statistic(canvas.add_subplot(grid[rows - 1, :]), trial.t0_s, said, seen_s)
        legend_below(canvas, columns=5)

    # A box that came between two hops belongs to the later one, which is the first to have it.
    at = np.searchsorted(said.time_s - 1e-6, seen_s)
    boxes = np.bincount(at, minlength=said.time_s.size + 1)[: said.time_s.size]
    camera = (
        "Above: camera images; the dashed box is the vehicle as the camera reports it, the dotted line the "
        "direction in which it is hidden. "
        if images
        else "The recording has no video that could be read, so the row of camera images is left out. "
    )
    return Figure(
        "approach_timeline",
        title,
        f"{camera}Below: hazard statistic at the end of each 1-s window, threshold, advisory, moving boxes "
        "of the camera, and line-of-sight entry T0.",
        draw,
        ("time_s", "statistic", "advisory", "moving_boxes"),
        [
            (float(t), float(s), int(on), int(n))
            for t, s, on, n in zip(said.time_s, said.score, said.alarm, boxes, strict=True)
        ],
        size_in=(9.0, 5.4 if images else 3.4),
    )


def _approach_images(video: Path, trial: Trial) -> tuple[ApproachImage, ...]:
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


def _draw_statistic(axes: "Axes", t0_s: float, said: Decisions, seen_s: FloatArray) -> None:
    axes.plot(said.time_s, said.score, color=BLUE, label="statistic $s(t)$")
    label = rf"$\gamma(\alpha={ALPHA:g})$"
    if np.isfinite(said.threshold).all():
        axes.axhline(float(said.threshold[0]), color=BLUE, linestyle=":", label=label)
    # Advisory and boxes stand above the range of the statistic, where they cover nothing of it.
    top = max(1.0, float(np.nanmax(said.score, initial=0.0)))
    bars = [(t, _HOP_S) for t in said.time_s[said.alarm]]
    axes.broken_barh(bars, (1.05 * top, 0.1 * top), color=GREEN, lw=0, label="advisory")
    axes.plot(
        seen_s, np.full(seen_s.size, 1.22 * top), "|", color=PURPLE, ms=9, label="moving box of the camera"
    )
    axes.axvline(t0_s, color="black", linestyle="--", linewidth=1.2, label="$T_0$")
    axes.set(xlabel="time (s)", ylabel="statistic", ylim=(-0.03 * top, 1.32 * top))
    axes.set_yticks(np.linspace(0.0, top, 5))
    axes.set_xlim(0.0, float(said.time_s[-1]) + _HOP_S)
