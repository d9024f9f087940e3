"""Panels over recordings, junctions and camera states: lead times, bearings, miss rates, awareness."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.video import VIDEO_NAME, open_video
from worldstate.ground.errors import WorldstateError
from worldstate.ground.extras import optional
from worldstate.ground.typing import FloatArray, ImageArray, IntArray
from worldstate.ground.values import NotUsable
from worldstate.operations.figure_style import CATEGORIES, DECISION, HIDDEN, IN_VIEW, SEARCHED, TRUTH
from worldstate.operations.metrics.approach_table import onset_outcome, rising_edges
from worldstate.operations.recordings.hop_table import HopTable
from worldstate_lab.evaluation.evaluation import ALPHA, Evaluation
from worldstate_lab.evaluation.protocols import STANDING
from worldstate_lab.metrics.intervals import worst_group
from worldstate_lab.metrics.track_measures import PUBLISHED, bearing_curve
from worldstate_lab.report.table import Figure, Section, Value
from worldstate_lab.trials.trial import Decisions, Trial

from .measured_values import PROPOSED
from .panels import GREY, MARKS, legend_below

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

# Smallest number of bearings for which a median is drawn.
FEWEST = 10


def lead_figure(leads_s: Mapping[str, FloatArray], paper_s: Mapping[str, float]) -> Figure:
    """Draw the lead time of every detected approach, one row per method; NaN is an undetected approach."""
    names = [name for name, leads in leads_s.items() if np.isfinite(leads).any()]

    def draw(canvas: "Canvas") -> None:
        axes = canvas.subplots()
        for row, name in enumerate(names):
            leads = np.sort(leads_s[name][np.isfinite(leads_s[name])])
            # Spread by rank and not at random, so that equal numbers give the same picture.
            spread = row + 0.28 * (np.arange(leads.size) % 5 - 2) / 2
            axes.plot(leads, spread, ".", color=CATEGORIES[0], alpha=0.55, ms=4)
            axes.plot(leads.mean(), row, "|", color="black", ms=17, mew=2.0, label="mean of the detected")
            if name in paper_s:
                axes.plot(paper_s[name], row, "D", color=CATEGORIES[3], fillstyle="none", ms=6, label="paper")
        counts = [f"{name}\n{np.isfinite(leads_s[name]).sum()} of {leads_s[name].size}" for name in names]
        axes.set_yticks(range(len(names)), counts, fontsize=8.5)
        axes.set(xlabel="lead time (s)", ylim=(len(names) - 0.5, -0.5))
        axes.axvline(0.0, color="0.8", linewidth=0.8, zorder=0)
        legend_below(canvas)

    rows = [(name, float(lead)) for name, leads in leads_s.items() for lead in leads]
    return Figure(
        "lead_times",
        "Lead time of every detected approach",
        "One dot per approach and seed of the folds: line-of-sight entry minus the first alarm in the 5 s "
        "before it. The number of detected approaches is below the name; methods that detect none are "
        "left out. An empty cell of the CSV is an approach that was not detected.",
        draw,
        ("method", "lead_s"),
        rows,
        size_in=(4.8, 1.6 + 0.52 * max(len(names), 1)),
    )


def junction_figure(
    name: str,
    title: str,
    unit: str,
    values: Mapping[str, Mapping[str, Value]],
    worst: Literal["low", "high"],
) -> Figure:
    """Draw a figure by junction, one colour per method, with a ring around the worst junction of each method.

    `values` maps method and junction to a value; `worst` is "low" or "high", the worse end.
    """
    sites = sorted({site for one in values.values() for site in one})
    # Marks are side by side within the row of a junction, offset by at most 0.3 rows.
    offsets = np.linspace(-0.3, 0.3, len(values)) if len(values) > 1 else np.zeros(1)

    def draw(canvas: "Canvas") -> None:
        axes = canvas.subplots()
        for (method, by_site), offset, colour, mark in zip(
            values.items(), offsets, CATEGORIES, MARKS, strict=False
        ):
            for site, value in by_site.items():
                row = sites.index(site) + offset
                axes.plot([value.low, value.high], [row, row], color=colour, linewidth=1.0, alpha=0.6)
                axes.plot(value.value, row, mark, color=colour, ms=5, label=method, linestyle="none")
            marked, _ = worst_group({site: value.value for site, value in by_site.items()}, worst)
            if marked:
                place = by_site[marked].value, sites.index(marked) + offset
                axes.plot(*place, "ko", ms=11, fillstyle="none", label="worst junction")
        axes.set_yticks(range(len(sites)), sites)
        axes.set(xlabel=unit, ylim=(len(sites) - 0.5, -0.5))
        legend_below(canvas, columns=1)

    rows = [(method, *row) for method, by_site in values.items() for row in by_site.items()]
    return Figure(
        name,
        title,
        "Bars are 95 % intervals over the recordings of the junction; the ring marks the worst junction of "
        "a method.",
        draw,
        ("method", "junction", "figure"),
        rows,
        size_in=(4.4, 1.6 + 0.18 * len(values) + 0.5 * max(len(sites), 1)),
    )


def bearing_gating_figure(checks: HopTable) -> Figure:
    """Draw the median bearing error over the share of bearings with the highest prominence."""
    curve, n = bearing_curve(checks), int(np.isfinite(checks.error_rad).sum())
    points: tuple[FloatArray, ...] = ()
    if not isinstance(curve, NotUsable):
        points = curve.coverage, np.degrees(curve.median_error_rad), curve.threshold

    def draw(canvas: "Canvas") -> None:
        axes = canvas.subplots()
        if points:
            enough = points[0] * n >= min(FEWEST, n)
            axes.plot(points[0][enough], points[1][enough], label=f"{n} bearings")
        axes.plot(*np.transpose(PUBLISHED), "o", color="black", fillstyle="none", label="paper")
        axes.set(xlabel="share kept by prominence", ylabel="median bearing error (deg)", xlim=(1.03, 0.0))
        axes.set_ylim(bottom=0.0)
        legend_below(canvas)

    return Figure(
        "bearing_gating",
        "Bearing error, gated by prominence",
        "Median absolute error of the bearings with the highest prominence, over the share kept; windows "
        "with a moving box in view. Open circles: the paper's 3.4 degrees for all bearings and 2.4 degrees "
        "for 16 % of them.",
        draw,
        ("share_kept", "median_error_deg", "prominence"),
        [tuple(map(float, row)) for row in zip(*points, strict=True)],
    )


def miss_rate_level_figure(families: Mapping[str, Sequence[tuple[str, Value]]]) -> Figure:
    """Draw beta over the level, one line per family; `families` contains (d as text, beta), clean first."""
    levels = [level for level, _ in next(iter(families.values()), ())]

    def draw(canvas: "Canvas") -> None:
        axes = canvas.subplots()
        rates = {name: [value for _, value in one] for name, one in families.items()}
        _bands(axes, {name: (np.arange(len(one)), one) for name, one in rates.items()})
        axes.set_xticks(range(len(levels)), levels)
        axes.set(xlabel="staged degradation d", ylabel=r"miss rate $\beta$", ylim=(-0.02, 1.02))
        legend_below(canvas, columns=3)

    return Figure(
        "miss_rate_level",
        "Miss rate of the camera by degradation",
        "Share of the hops with a vehicle in view in which the detector reports none, with its 95 % interval "
        "over recordings. The paper: 0.04 clean at boresight, 0.97 in the harshest noise.",
        draw,
        ("family", "level", "miss_rate"),
        [(name, level, value) for name, one in families.items() for level, value in one],
    )


def miss_rate_angle_figure(states: Mapping[str, Sequence[Value]], edges_deg: Sequence[float]) -> Figure:
    """Draw beta over |azimuth|, one line per camera state; each value is for one interval of angles."""
    middle = 0.5 * (np.asarray(edges_deg)[1:] + np.asarray(edges_deg)[:-1])

    def draw(canvas: "Canvas") -> None:
        axes = canvas.subplots()
        _bands(axes, {name: (middle, values) for name, values in states.items()})
        axes.set(xlabel="angle off boresight |azimuth| (deg)", ylabel=r"miss rate $\beta$")
        axes.set(ylim=(-0.02, 1.02), xlim=(edges_deg[0], edges_deg[-1]))
        # The last edge is that of the field of view, such as 35.19 degrees.
        axes.set_xticks(list(edges_deg), [f"{edge:.0f}" for edge in edges_deg])
        legend_below(canvas)

    return Figure(
        "miss_rate_angle",
        "Miss rate of the camera by angle",
        "The same share by the angle between the vehicle and the optical axis. The paper, clean camera: 0.04 "
        "at boresight, 0.14 at 20 to 30 degrees.",
        draw,
        ("state", "from_deg", "to_deg", "miss_rate"),
        [
            (name, *row)
            for name, values in states.items()
            for row in zip(edges_deg[:-1], edges_deg[1:], values, strict=True)
        ],
    )


def awareness_figure(families: Mapping[str, Sequence[tuple[Value, Value]]], paper_least: float) -> Figure:
    """Draw hazard awareness over the measured miss rate beta, one line per family of degradations.

    `families` contains (beta, awareness) by level, the clean camera first.
    """

    def draw(canvas: "Canvas") -> None:
        axes = canvas.subplots()
        axes.plot([0.0, 1.0], [1.0, 0.0], color=GREY, linestyle="--", label=r"vision alone, $1-\beta$")
        pairs = {name: tuple(zip(*levels, strict=True)) for name, levels in families.items()}
        _bands(
            axes, {name: (np.array([b.value for b in beta]), aware) for name, (beta, aware) in pairs.items()}
        )
        axes.axhline(paper_least, color="black", linewidth=0.9, linestyle=":", label="paper, least")
        axes.set(xlabel=r"measured miss rate $\beta$ of the camera", ylabel="hazard awareness after $T_0$")
        axes.set(xlim=(-0.02, 1.02), ylim=(0.0, 1.03))
        legend_below(canvas)

    return Figure(
        "cueing_awareness",
        "(d) Hazard awareness with a degraded camera",
        "Share of the hops after T0 in which the vehicle is detected or announced, over the share that the "
        "camera misses; level 0 is the clean camera. Bands are 95 % intervals over recordings.",
        draw,
        ("family", "level", "miss_rate", "awareness"),
        [
            (name, level, beta.value, aware)
            for name, levels in families.items()
            for level, (beta, aware) in enumerate(levels)
        ],
        size_in=(4.4, 4.2),
    )


def _bands(axes: "Axes", lines: Mapping[str, tuple[FloatArray | IntArray, Sequence[Value]]]) -> None:
    """Draw a line with a band of intervals for each name."""
    for (name, (x, values)), mark in zip(lines.items(), MARKS, strict=False):
        (line,) = axes.plot(x, [v.value for v in values], marker=mark, ms=4, label=name)
        low, high = [v.low for v in values], [v.high for v in values]
        axes.fill_between(x, low, high, color=line.get_color(), alpha=0.13, lw=0)


if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

# The paper's first image is 2.5 s before line-of-sight entry, when the vehicle is still behind the corner.
HIDDEN_S = 2.5
# Three images side by side at 150 dots per inch are 440 pixels wide each; a higher resolution is not visible.
_IMAGE_PX = 480
# An advisory lasts until the next decision.
_HOP_S = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class ApproachImage:
    """One camera image, its caption, and the place of the vehicle: a box, or a column if it is hidden."""

    title: str
    image: ImageArray  # shape (height, width, 3), red first
    box_px: FloatArray | None = None  # shape (4,), in pixels of this image
    column_px: float | None = None


def approach_section(found: Evaluation) -> Section:
    """Return the timeline of the detected approach with the median lead time, with video if possible."""
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
    # If OpenCV is not installed or the video cannot be read, the rest of the figure is drawn.
    images: tuple[ApproachImage, ...] = ()
    with suppress(WorldstateError):
        images = approach_images(videos[trial.name], trial)
    name = f"Approach {trial.name} at {trial.site}, from the {trial.label}"
    figure = approach_figure(f"{name}: lead {leads[middle]:.1f} s (paper's: 2.3 s)", trial, said, images)
    text = f"The approach with the median lead time of the {detected.size} that {PROPOSED} detects."
    return Section(title, (text,), (figure,))


def leads_s(trials: Sequence[Trial], passes: Sequence[Sequence[Decisions]]) -> FloatArray:
    """Return the lead time of every approach and seed, NaN if it was not detected."""
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
    """Draw an approach like the paper's timeline figure; without images their row is omitted."""
    # Before the first hop, parked and moving cars cannot be distinguished.
    moving = trial.boxes.moving.astype(bool) & (trial.boxes.time_s >= said.time_s[0])
    seen_s = trial.boxes.time_s[moving]

    def draw(canvas: "Canvas") -> None:
        rows = 2 if images else 1
        grid = canvas.add_gridspec(rows, max(len(images), 1), height_ratios=(0.62, 1.0)[-rows:])
        for i, image in enumerate(images):
            _draw_image(canvas.add_subplot(grid[0, i]), image)
        _draw_statistic(canvas.add_subplot(grid[rows - 1, :]), trial.t0_s, said, seen_s)
        legend_below(canvas, columns=5)

    # A box between two hops belongs to the later one, which is the first that can use it.
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
        # A rule has one threshold for all hops; the threshold of the shipped model changes between hops.
        label = rf"$\gamma(\alpha={ALPHA:g})$" if said.threshold.size == 1 else "threshold"
        level = np.broadcast_to(said.threshold, said.time_s.shape)
        axes.plot(said.time_s, level, color=DECISION, linestyle=":", label=label)
    # Advisory and boxes are drawn above the range of the statistic, so that they do not cover it.
    top = max(1.0, float(np.nanmax(said.score, initial=0.0)))
    bars = [(t, _HOP_S) for t in said.time_s[said.alarm]]
    axes.broken_barh(bars, (1.05 * top, 0.1 * top), color=DECISION, lw=0, label="advisory")
    axes.plot(
        seen_s, np.full(seen_s.size, 1.22 * top), "|", color=SEARCHED, ms=9, label="moving box of the camera"
    )
    axes.axvline(t0_s, color=TRUTH, linestyle="--", linewidth=1.2, label="$T_0$")
    axes.set(xlabel="time (s)", ylabel="statistic", ylim=(-0.03 * top, 1.32 * top))
    axes.set_yticks(np.linspace(0.0, top, 5))
    axes.set_xlim(0.0, float(said.time_s[-1]) + _HOP_S)
