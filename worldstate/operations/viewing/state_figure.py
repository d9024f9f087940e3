"""Figures of the snapshots of a run: over time, from above, and as an animation."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from worldstate.abduction.road_users import Foreign
from worldstate.adapters.audio.sound_file import Audio
from worldstate.adapters.datasets.ovad import TrueTrack, read_true_tracks
from worldstate.adapters.export.scene import CUE_M, SEARCHED_M, SECTOR_M, hidden_sector, label_of, sector_of
from worldstate.adapters.files.file_io import atomic_path
from worldstate.adapters.listener import Step
from worldstate.adapters.source import Source
from worldstate.frontend.settings import HOP_RATE_HZ, WINDOW_HOPS
from worldstate.frontend.stream import FrontEnd
from worldstate.ground import LEAST_HEARD, seconds
from worldstate.ground.typing import Float32Array, FloatArray
from worldstate.operations import figure_style as style
from worldstate.operations.recordings.recording_report import calibration_words
from worldstate.state import Entity, RiskCue, WorldState

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_WINDOW_S = WINDOW_HOPS / HOP_RATE_HZ
# Longest title that fits on one line above a figure of this width.
_TITLE_CHARACTERS = 100
# No threshold is below this (odds of one to a thousand); the first windows of a run reach -20.
_LOWEST_NATS = -7.0
# An entity is drawn if it exists with at least this probability.
_LIKELY = 0.5
# The GIF has 576 x 416 pixels, so that labels of 9 points are readable in a browser.
_SIZE_IN, _MOVING_DPI = (7.2, 5.2), 80
# A less likely entity is drawn without its label.
_LABELLED = 0.2
# Opacity of a searched sector in which nothing or something was found.
_NOTHING, _FOUND = 0.15, 0.4
_LEGEND = (
    ("hidden vehicle and its risk", style.HIDDEN, 0.4),
    ("vehicle in view", style.IN_VIEW, 0.35),
    ("advisory", style.DECISION, 1.0),
    ("searched, no vehicle", style.SEARCHED, _NOTHING),
    ("searched, vehicle found", style.SEARCHED, _FOUND),
    ("behind an occluder", "0.5", 0.2),
)


@dataclass(frozen=True, slots=True, eq=False)
class SoundPower:
    """Steered response power of a recording, one row per hop."""

    time_s: FloatArray  # Middle of the window of each row, on the clock of the recording
    azimuths_rad: FloatArray
    power: FloatArray  # shape (hops, azimuths)


def sound_power(
    audio: Audio,
    front_end: FrontEnd,
    states: Sequence[WorldState],
    on_second: Callable[[], None] = lambda: None,
) -> SoundPower:
    """Return the power over azimuth of every hop of an open recording, on the clock of its states."""
    rows = []
    for block in audio.blocks(audio.sample_rate_hz):
        rows += [(seconds(one.stamp_ns), one.srp.astype(np.float32)) for one in front_end.process(block)]
        on_second()
    rows += [(seconds(one.stamp_ns), one.srp.astype(np.float32)) for one in front_end.finish()]
    ends_s, times_s = np.array([end_s for end_s, _ in rows]), _times(states)
    # With --start, or for a bag, times counted in samples differ from the clock of the states: the first hops
    # are aligned.
    if times_s[-1] > ends_s[-1]:
        ends_s += times_s[0] - ends_s[0]
    return _power(ends_s.tolist(), front_end.settings.azimuths_rad(), [row for _, row in rows])


def _power(ends_s: Sequence[float], azimuths_rad: FloatArray, rows: Sequence[Float32Array]) -> SoundPower:
    # A window of 1 s is drawn at its middle, because at its end it would lag the camera by 0.5 s.
    return SoundPower(np.array(ends_s) - 0.5 * _WINDOW_S, azimuths_rad, np.array(rows))


@contextmanager
def drawn_run(path: Path | None, source: Source, title: str) -> Iterator[Callable[[Step], None]]:
    """Yield a function that collects hops; they are drawn to `path`, if given, when the block ends."""
    states, power, azimuths_rad = list[WorldState](), list[Float32Array](), np.empty(0)

    def keep(step: Step) -> None:
        nonlocal azimuths_rad
        states.append(step.state)
        power.append(step.frame.srp.astype(np.float32))
        azimuths_rad = step.frame.azimuths_rad

    yield (lambda step: None) if path is None else keep
    if path is not None and states:
        sound, truth = _power(_times(states), azimuths_rad, power), read_true_tracks(source.audio_path.parent)
        write_state_figure(states, path, title=title, sound=sound, t0_s=source.t0_s, truth=truth)


def write_state_figure(
    states: Sequence[WorldState],
    path: Path,
    *,
    title: str = "",
    sound: SoundPower | None = None,
    t0_s: float | None = None,
    truth: Sequence[TrueTrack] = (),
) -> None:
    """Draw azimuths, advisories and looks, the decision values and the probabilities over time.

    The figure shows no threshold for a state that is not calibrated, and its title states this.

    Parameters
    ----------
    states : sequence of WorldState
        At least one, of one run.
    path : Path
        The file to write.
    title : str
        Heading of the figure.
    sound : SoundPower, optional
        Background of the azimuths.
    t0_s : float, optional
        Time of line-of-sight entry, seconds.
    truth : sequence of TrueTrack
        True tracks of the vehicles of a simulated recording.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     write_state_figure([WorldState(0, 0)], Path(folder) / "quiet.png")
    ...     (Path(folder) / "quiet.png").stat().st_size > 10_000
    True
    """
    with style.figure_file(path, 10.0, 8.6 if sound is None else 9.6) as figure:
        heights = (1.0 if sound is None else 1.4, 0.42, 0.7, 0.6)
        azimuths, rows, decision, probabilities = figure.subplots(4, 1, sharex=True, height_ratios=heights)
        if sound is not None:
            label = "sound power divided by its median over azimuth"
            style.draw_power(azimuths, sound.time_s, sound.azimuths_rad, sound.power, label)
        _draw_truth(azimuths, truth)
        _draw_azimuths(azimuths, states)
        _draw_rows(rows, states)
        _draw_decision(decision, states)
        _draw_probabilities(probabilities, states)
        for axes in (azimuths, rows, decision, probabilities) if t0_s is not None else ():
            entry = axes.axvline(t0_s, color=style.TRUTH, lw=1.2, ls="--")
            entry.set_label("line-of-sight entry $T_0$" if axes is azimuths else "")
        for axes in (azimuths, decision, probabilities):
            style.legend_beside(axes)
        # The first window begins 1 s before its decision.
        span_s = _times(states)[0] - _WINDOW_S, _times(states)[-1] + style.HOP_S
        probabilities.set(xlabel="time (s), end of the decision window", xlim=span_s)
        shown = title if len(title) <= _TITLE_CHARACTERS else "..." + title[-_TITLE_CHARACTERS:]
        figure.suptitle(f"{shown}{_uncalibrated(states)}")


def _draw_truth(axes: "Axes", truth: Sequence[TrueTrack]) -> None:
    for track in truth:
        for shown, dashes, name in ((~track.in_view, ":", "out of sight"), (track.in_view, "-", "in sight")):
            line = np.where(shown, np.degrees(track.azimuth_rad), np.nan)
            axes.plot(track.time_s, line, dashes, color=style.TRUTH, lw=2.0, label=f"true vehicle, {name}")


def _draw_azimuths(axes: "Axes", states: Sequence[WorldState]) -> None:
    """Draw the 90 % interval of every entity's azimuth, and the measured bearings."""
    heard = [(state.time_s, state.bearing.azimuth_rad) for state in states if state.bearing]
    if heard:
        time_s, azimuth_rad = np.array(heard).T
        axes.plot(time_s, np.degrees(azimuth_rad), ".", color=style.HEARD, ms=4, label="measured bearing")
    tracks: dict[tuple[str, bool], list[tuple[float, ...]]] = {}
    for state in states:
        for one in (part for known in state.entities for part in known.on_each_side()):
            if one.moving and one.existence_probability >= _LIKELY:
                sector = sector_of(one.azimuth_rad, one.azimuth_std_rad, one.sector_rad)
                row = state.time_s, *np.degrees([one.azimuth_rad, *sector]).tolist()
                tracks.setdefault((one.id, one.status == "hidden"), []).append(row)
    for (_, hidden), rows in tracks.items():
        color, label = (style.HIDDEN, "hidden entity") if hidden else (style.IN_VIEW, "entity in view")
        time_s, azimuth, low, high = style.with_gaps(np.array(rows)).T
        axes.fill_between(time_s, low, high, color=color, alpha=0.25, lw=0)
        axes.plot(time_s, azimuth, color=color, label=f"{label}, 90 % interval")
    axes.set(ylabel="azimuth (deg)\nleft positive", ylim=(-95, 95), yticks=range(-90, 91, 45))


def _draw_rows(axes: "Axes", states: Sequence[WorldState]) -> None:
    """Draw a bar during each advisory, and a mark for each look of a camera."""
    names = [f"advisory {side}" for side in _sides(states)]
    for row, side in enumerate(_sides(states)):
        on = [any(c.direction == side and c.advisory for c in state.cues) for state in states]
        style.draw_bars(axes, _times(states), on, row, style.DECISION)
    # A look is part of every snapshot until the next look.
    looks = {(one.sensor, one.stamp_ns, one.found) for state in states for one in state.searched}
    for sensor in sorted({sensor for sensor, _, _ in looks}):
        row = len(names)
        for found, height in ((True, 10), (False, 4)):
            at_s = [seconds(stamp_ns) for name, stamp_ns, was in looks if name == sensor and was == found]
            axes.plot(at_s, [row] * len(at_s), "|", color=style.SEARCHED, ms=height)
        names.append(f"{sensor} (tall: found)")
    foreign = [isinstance(state.domain, Foreign) for state in states]
    deaf = [any(one.share < LEAST_HEARD for one in state.heard or ()) for state in states]
    for on, color, name in ((foreign, style.HEARD, "foreign sound"), (deaf, "0.5", "sound not usable")):
        if any(on):
            style.draw_bars(axes, _times(states), on, len(names), color, height=0.6)
            names.append(name)
    style.name_rows(axes, names)


def _draw_decision(axes: "Axes", states: Sequence[WorldState]) -> None:
    """Draw the log-odds of each side, the threshold of calibrated states, and every onset."""
    tables = {side: np.array([_decided(state, side) for state in states]) for side in _sides(states)}
    for dashes, (side, rows) in zip(style.SIDE_DASHES, tables.items(), strict=False):
        time_s, compared, *_ = style.with_gaps(rows).T
        axes.plot(time_s, compared, dashes, color=style.HIDDEN, label=f"log-odds, {side}")
    for dashes, rows in zip(style.SIDE_DASHES, tables.values(), strict=False):
        time_s, _, threshold, _ = style.with_gaps(rows).T
        if np.isfinite(threshold).any():
            axes.plot(time_s, threshold, dashes, color=style.DECISION, label="threshold")
        onsets = rows[np.diff(rows[:, 3], prepend=0.0) > 0.0]
        if len(onsets):
            axes.plot(onsets[:, 0], onsets[:, 1], "v", color=style.DECISION, ms=8, label="onset")
    axes.set(ylabel="decision\n(nats)")
    axes.set_ylim(bottom=max(axes.get_ylim()[0], _LOWEST_NATS))


def _decided(state: WorldState, side: str) -> tuple[float, float, float, bool]:
    """Return time, log-odds, threshold (NaN if not calibrated) and whether there is an advisory."""
    cue = next((one for one in state.cues if one.direction == side), None)
    if cue is None or cue.evidence is None:
        compared, threshold = math.nan, math.nan
    else:
        compared, threshold = cue.evidence.compared_nats, cue.evidence.threshold_nats
    raised = cue is not None and cue.advisory is not None
    return state.time_s, compared, threshold if state.calibrated else math.nan, raised


def _draw_probabilities(axes: "Axes", states: Sequence[WorldState]) -> None:
    rows = [(state.time_s, *_probabilities(state, _sides(states))) for state in states]
    time_s, in_view, *risks = style.with_gaps(np.array(rows)).T
    for side, dashes, risk in zip(_sides(states), style.SIDE_DASHES, risks, strict=False):
        axes.plot(time_s, risk, dashes, color=style.HIDDEN, label=f"risk, {side}")
    axes.plot(time_s, in_view, color=style.IN_VIEW, label="a vehicle in view")
    axes.set(ylabel="probability", ylim=(-0.02, 1.02))


def _probabilities(state: WorldState, sides: Sequence[str]) -> list[float]:
    """Return the existence probability of the likeliest vehicle in view, and the risk of each side."""
    in_view = [one.existence_probability for one in state.entities if one.moving and one.status != "hidden"]
    risks = {cue.direction: cue.risk for cue in state.cues if cue.risk is not None}
    return [max(in_view, default=0.0), *(risks.get(side, math.nan) for side in sides)]


def _sides(states: Sequence[WorldState]) -> tuple[str, ...]:
    return states[0].context.directions[: len(style.SIDE_DASHES)]


def _uncalibrated(states: Sequence[WorldState]) -> str:
    """Return the end of the title if states are not calibrated."""
    number = sum(not state.calibrated for state in states)
    return f" ({calibration_words(number, len(states))})" if number else ""


def _times(states: Sequence[WorldState]) -> list[float]:
    return [state.time_s for state in states]


def write_birds_eye(state: WorldState, path: Path, *, title: str = "") -> None:
    """Draw one snapshot from above, with the ego at the bottom and its left on the left."""
    with style.figure_file(path, *_SIZE_IN) as figure:
        _draw(figure.subplots(), state, title)


def write_animation(
    states: Sequence[WorldState], path: Path, *, title: str = "", on_frame: Callable[[], None] = lambda: None
) -> None:
    """Write a GIF of all snapshots from above; it plays at the speed of the recording."""
    style.check_suffix(path, *style.ANIMATION)
    from matplotlib.animation import PillowWriter
    from matplotlib.figure import Figure

    span_s = seconds(states[-1].stamp_ns - states[0].stamp_ns)
    writer = PillowWriter(fps=max(round((len(states) - 1) / span_s), 1) if span_s > 0.0 else 1)
    with style.figure_style(), atomic_path(path) as temporary:
        figure = Figure(figsize=_SIZE_IN, layout="constrained")
        with writer.saving(figure, str(temporary), dpi=_MOVING_DPI):
            for state in states:
                figure.clear()
                _draw(figure.subplots(), state, title)
                writer.grab_frame()
                on_frame()


def draw_state(state: WorldState, axes: "Axes | None" = None) -> "Axes":
    """Draw a snapshot from above on axes, by default of a new figure of pyplot; return the axes."""
    with style.figure_style():
        if axes is None:
            from matplotlib import pyplot

            axes = pyplot.figure(figsize=_SIZE_IN, layout="constrained").subplots()
        _draw(axes, state, "")
    return axes


def _draw(axes: "Axes", state: WorldState, title: str) -> None:
    for occluder in state.context.occluders:
        _wedge(axes, hidden_sector(occluder), SECTOR_M, "0.5", 0.13)
        ends = (_at(occluder.edge_azimuth_rad, distance_m) for distance_m in (4.0, SECTOR_M))
        axes.plot(*zip(*ends, strict=True), color="0.3", lw=2)
    for view in state.searched:
        _wedge(axes, view.sector_rad, SEARCHED_M, style.SEARCHED, _FOUND if view.found else _NOTHING)
    for cue in state.cues:
        _draw_cue(axes, cue)
    for entity in (part for one in state.entities if one.moving for part in one.on_each_side()):
        _draw_entity(axes, entity)
    axes.plot(0.0, 0.0, "^", color="black", ms=12)
    behind = any(abs(view.sector_rad[0]) > 0.6 * math.pi for view in state.searched)
    axes.set(xlim=(-38, 38), ylim=(-41 if behind else -11, 37), aspect="equal", xticks=(), yticks=())
    axes.spines[:].set_visible(False)
    words = f"{state.time_s:.1f} s   {title}{_uncalibrated([state])}"
    axes.set_title(words, loc="left")
    _draw_legend(axes)


def _draw_cue(axes: "Axes", cue: RiskCue) -> None:
    """Draw the risk, and write it below the ego on the cue's side, where there is no sector."""
    raised = cue.advisory is not None
    sector = sector_of(cue.azimuth_rad, cue.azimuth_std_rad, cue.sector_rad)
    if cue.risk is not None:
        _wedge(axes, sector, CUE_M, style.HIDDEN, 0.05 + 0.5 * cue.risk)
    if raised:
        _wedge(axes, sector, CUE_M, style.DECISION, 1.0, fill=False, lw=3.0, zorder=1.5)
    words = f"{cue.direction or 'side unknown'}{': ADVISORY' if raised else ''}"
    words += "" if cue.risk is None else f"\nrisk {cue.risk:.2f}"
    words += "" if cue.within is None or "3" not in cue.within else f"\nin 3 s {cue.within['3']:.2f}"
    words += "".join(f"\nnot usable: {reason}" for reason in cue.why_not)
    x, side = (-37, "left") if cue.azimuth_rad > 0.0 else (37, "right")
    color, weight = (style.DECISION, "bold") if raised else ("0.2", "normal")
    axes.text(x, -2.5, words, color=color, ha=side, va="top", weight=weight)


def _draw_entity(axes: "Axes", entity: Entity) -> None:
    hidden = entity.status == "hidden"
    color, density = style.HIDDEN if hidden else style.IN_VIEW, entity.existence_probability
    sector = sector_of(entity.azimuth_rad, entity.azimuth_std_rad, entity.sector_rad)
    _wedge(axes, sector, SECTOR_M, color, 0.05 + 0.3 * density)
    axes.plot(*zip((0.0, 0.0), _at(entity.azimuth_rad, SECTOR_M), strict=True), color=color, alpha=density)
    for ahead in (entity.forecast or {}).values():
        low, high = sector_of(*ahead, None)
        arc = [_at(low + (high - low) * step / 8, SECTOR_M + 1.0) for step in range(9)]
        axes.plot(*zip(*arc, strict=True), color=color, lw=3, alpha=0.6)
    if entity.position_m is not None:
        axes.plot(-entity.position_m[1], entity.position_m[0], "s", color=color, ms=9)
    if density >= _LABELLED:
        x, y = _at(entity.azimuth_rad, SECTOR_M + 5.0)
        text = {"color": color, "fontsize": 9, "ha": "center", "va": "bottom"}
        axes.text(min(max(x, -31.0), 31.0), y, label_of(entity), text)


def _draw_legend(axes: "Axes") -> None:
    from matplotlib.patches import Patch

    patches = [Patch(color=color, alpha=alpha, lw=0, label=label) for label, color, alpha in _LEGEND]
    axes.legend(handles=patches, loc="upper center", bbox_to_anchor=(0.5, 0.0), ncol=3)


def _wedge(
    axes: "Axes", sector_rad: tuple[float, float], radius_m: float, color: str, alpha: float, **drawn: Any
) -> None:
    from matplotlib.patches import Wedge

    # Ahead is up in the figure. Angles of matplotlib begin on the right and are left positive as well.
    first, last = (math.degrees(azimuth) + 90.0 for azimuth in sector_rad)
    drawn = {"color": color, "alpha": min(alpha, 1.0), "lw": 0, **drawn}
    axes.add_patch(Wedge((0.0, 0.0), radius_m, first, last, **drawn))


def _at(azimuth_rad: float, radius_m: float) -> tuple[float, float]:
    return -radius_m * math.sin(azimuth_rad), radius_m * math.cos(azimuth_rad)
