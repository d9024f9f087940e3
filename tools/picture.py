"""Draw the moving picture of README.md from the recording that `worldstate demo` leaves: `make picture`.

Three panels: the street from above, the camera's view, and the risk of both sides over time.
Arguments: the folder of the demo, and the animated WebP file to write.
"""

import json
import math
import sys
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Circle, Polygon, Rectangle, Wedge
from PIL import Image

import worldstate
from worldstate.adapters.datasets.ovad import TrueTrack, read_true_tracks
from worldstate.state import WorldState

# A dark card with its own background can be read on light and on dark pages.
CARD, STREET, HOUSE, TEXT, MUTED = "#101820", "#1b2733", "#3a4a5a", "#e8eef4", "#93a1af"
HIDDEN, IN_VIEW, SEARCHED = "#ff8a3d", "#55aaff", "#35c08e"
WIDTH_PX, HEIGHT_PX, DPI = 860, 540, 100
# The picture begins before the first risk and ends while the vehicle is in view; the last image is held.
FIRST_S, LAST_S, HELD_MS = 1.5, 7.6, 2500
# Metres shown to both sides and ahead of the ego.
BESIDE_M, BEHIND_M, AHEAD_M = 30.5, 3.5, 13.5
VAN_M = (5.0, 1.9, 2.2)  # length, width, height
EYE_M, BEHIND_ARRAY_M, HALF_VIEW = 1.5, 0.57, math.tan(0.6)


def picture(folder: Path, path: Path) -> None:
    """Write one frame for every state between `FIRST_S` and `LAST_S`."""
    (truth_file,) = (folder / "recording").rglob("truth.json")
    site = json.loads(truth_file.read_text("utf-8"))["settings"]["site"]
    (track,) = read_true_tracks(truth_file.parent)
    states = worldstate.read(folder / "states.jsonl")
    shown = [state for state in states if FIRST_S <= state.time_s <= LAST_S]
    frames = [frame(state, shown, site, track) for state in shown]
    times_ms = [*[100] * (len(frames) - 1), HELD_MS]
    frames[0].save(
        path, save_all=True, append_images=frames[1:], duration=times_ms, loop=0, quality=75, method=4
    )


def frame(state: WorldState, shown: list[WorldState], site: dict, track: TrueTrack) -> Image.Image:
    """Draw the three panels at the time of one state."""
    figure = Figure((WIDTH_PX / DPI, HEIGHT_PX / DPI), DPI, facecolor=CARD)
    canvas = FigureCanvasAgg(figure)
    time_s = state.time_s
    at = int(np.argmin(np.abs(track.time_s - time_s)))
    words, color = sentence(state, shown, track)
    figure.text(0.02, 0.95, f"{time_s:.1f} s", color=TEXT, size=16, weight="bold", va="center")
    figure.text(0.105, 0.95, words, color=color, size=14.5, weight="bold", va="center")
    above(figure.add_axes((0.02, 0.465, 0.96, 0.426)), state, site, track, at)
    camera(figure.add_axes((0.02, 0.03, 0.36, 0.362)), state, site, track, at)
    chart(figure.add_axes((0.46, 0.1, 0.485, 0.292)), state, shown, track)
    for x, y, text in (
        (0.02, 0.41, "Camera"),
        (0.425, 0.41, "Probability that a vehicle comes into view within 8 s"),
    ):
        figure.text(x, y, text, color=MUTED, size=10.5)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")


def sentence(state: WorldState, shown: list[WorldState], track: TrueTrack) -> tuple[str, str]:
    """Return what the state means, in one sentence, and its colour."""
    raised = [one for one in shown if any(cue.advisory for cue in one.cues)]
    entry_s = float(track.time_s[track.in_view][0])
    if state.time_s >= entry_s:
        early_s = entry_s - raised[0].time_s
        return f"The vehicle is in view, {early_s:.1f} s after the advisory began.", IN_VIEW
    sides = [f"{cue.direction} ({100 * cue.risk:.0f} %)" for cue in state.cues if cue.advisory]
    if sides:
        return f"Advisory: a hidden vehicle on the {' and '.join(sides)}.", HIDDEN
    return "The camera shows an empty street. There is no advisory.", TEXT


def above(axes: Axes, state: WorldState, site: dict, track: TrueTrack, at: int) -> None:
    """Draw the street with the ego's heading upwards, and what the state holds of both sides."""
    axes.set(xlim=(-BESIDE_M, BESIDE_M), ylim=(-BEHIND_M, AHEAD_M), aspect="equal", facecolor=STREET)
    hide(axes)
    left, right, ahead = (site[f"corner_{name}_m"] for name in ("left", "right", "ahead"))
    far = ahead + site["verge_m"] + site["street_width_m"]
    for x, width in ((-BESIDE_M, BESIDE_M - left), (right, BESIDE_M - right)):
        axes.add_patch(Rectangle((x, -BEHIND_M), width, BEHIND_M + ahead, color=HOUSE, lw=0))
    axes.add_patch(Rectangle((-BESIDE_M, far), 2 * BESIDE_M, AHEAD_M, color=HOUSE, lw=0, alpha=0.45))
    axes.axhline(far - site["street_width_m"] / 2, color=MUTED, lw=0.8, ls=(0, (6, 6)), alpha=0.6)
    # The camera's view ends at the corners.
    eye, reach = (0.0, -BEHIND_ARRAY_M), far + BEHIND_ARRAY_M
    slopes = [min(HALF_VIEW, corner / (ahead + BEHIND_ARRAY_M)) for corner in (left, right)]
    seen = [eye, (-slopes[0] * reach, far), (slopes[1] * reach, far)]
    found = any(view.found for view in state.searched)
    axes.add_patch(Polygon(seen, color=IN_VIEW if found else SEARCHED, alpha=0.3, lw=0))
    for cue in state.cues:
        side = -1 if cue.direction == "left" else 1
        low, high = cue.sector_rad or (cue.azimuth_rad - 0.3, cue.azimuth_rad + 0.3)
        # Without sound of its own, or while a louder vehicle masks it, a side has no usable risk.
        risk = cue.risk or 0.0 if cue.usable else 0.0
        first, last = math.degrees(low) + 90.0, math.degrees(high) + 90.0
        axes.add_patch(Wedge((0, 0), 60.0, first, last, color=HIDDEN, alpha=0.55 * risk, lw=0))
        weight, color = ("bold", HIDDEN) if cue.advisory else ("normal", TEXT if cue.usable else MUTED)
        words = f"{cue.direction}: {100 * risk:.0f} %" if cue.usable else f"{cue.direction}: {cue.why_not[0]}"
        axes.text(side * 14.0, -1.6, words, color=color, size=13, weight=weight, ha="center", va="center")
    front_x, front_y = -track.position_m[at][1], track.position_m[at][0]
    heading = -1 if track.position_m[at + 1][1] > track.position_m[at][1] else 1
    length, width, _ = VAN_M
    color = IN_VIEW if track.in_view[at] else HIDDEN
    corner = (front_x if heading < 0 else front_x - length, front_y - width / 2)
    if abs(front_x) > BESIDE_M:
        side = math.copysign(BESIDE_M - 0.6, front_x)
        style = {"color": HIDDEN, "size": 11, "ha": "right" if side > 0 else "left", "va": "center"}
        axes.text(side, front_y, f"vehicle, {abs(front_x):.0f} m", **style)
    axes.add_patch(Rectangle(corner, length, width, facecolor=color, edgecolor=TEXT, lw=1.2))
    phase = at % 5 / 5
    for radius in (2.0 + 2.0 * (ring + phase) for ring in range(3)):
        fade = max(0.0, 0.75 - radius / 10.0)
        middle = corner[0] + length / 2, front_y
        axes.add_patch(Circle(middle, radius, fill=False, edgecolor=TEXT, lw=1.0, alpha=fade))
    axes.add_patch(Rectangle((-0.95, -3.6), 1.9, 4.0, facecolor=TEXT, lw=0))
    axes.add_patch(Arc((0, 0.4), 2.4, 2.4, theta1=20, theta2=160, color=TEXT, lw=1.2))


def camera(axes: Axes, state: WorldState, site: dict, track: TrueTrack, at: int) -> None:
    """Draw the view of a camera that stands behind the array: two house corners, road, sky, the vehicle."""
    axes.set(xlim=(-HALF_VIEW, HALF_VIEW), ylim=(-0.36, 0.36), facecolor="#24384c")
    hide(axes)
    left, right, ahead = (site[f"corner_{name}_m"] for name in ("left", "right", "ahead"))
    ahead += BEHIND_ARRAY_M
    axes.add_patch(Rectangle((-1, -1), 2, 1 - 0.035, color="#3b434b", lw=0))
    found = any(view.found for view in state.searched)
    if track.in_view[at]:
        x, y = track.position_m[at]
        depth, length, height = x + BEHIND_ARRAY_M, VAN_M[0], VAN_M[2]
        heading = 1 if track.position_m[at + 1][1] > y else -1
        first = -y / depth if heading > 0 else -(y - heading * length) / depth
        box = (first, -EYE_M / depth), length / depth, height / depth
        axes.add_patch(Rectangle(*box, facecolor=IN_VIEW, edgecolor=TEXT, lw=1.0))
        for wheel in (0.2, 0.8):
            axes.add_patch(Circle((first + wheel * length / depth, box[0][1]), 0.04, color=CARD))
    for side, corner in ((-1, left), (1, right)):
        edge, foot, roof = side * corner / ahead, -EYE_M / ahead, 6.0 / ahead
        wall = [(edge, foot), (edge, roof), (side * 1.0, 1.6), (side * 1.0, -0.45)]
        axes.add_patch(Polygon(wall, facecolor=HOUSE, edgecolor=MUTED, lw=0.8))
    words, color = ("vehicle found", IN_VIEW) if found else ("no vehicle found", SEARCHED)
    axes.text(0, 0.29, words, color=color, size=11.5, weight="bold", ha="center", va="center")


def chart(axes: Axes, state: WorldState, shown: list[WorldState], track: TrueTrack) -> None:
    """Draw the risk of both sides up to the state."""
    axes.set(xlim=(FIRST_S, LAST_S), ylim=(0, 1.0), facecolor=CARD, yticks=(0, 0.5, 1.0))
    axes.set_yticklabels(("0", "50 %", "100 %"))
    axes.tick_params(colors=MUTED, labelsize=9.5, length=0)
    axes.set_xlabel("time (s)", color=MUTED, size=9.5, labelpad=1)
    axes.spines[:].set_visible(False)
    axes.grid(axis="y", color=HOUSE, lw=0.7)
    past = [one for one in shown if one.stamp_ns <= state.stamp_ns]
    time_s = [one.time_s for one in past]
    own = "right" if track.azimuth_rad[0] < 0 else "left"
    risks = {cue.direction: [risk_of(one, cue.direction) for one in past] for cue in state.cues}
    highest = max(risks, key=lambda side: risks[side][-1])
    for side, risk in risks.items():
        style = {"lw": 2.6} if side == own else {"lw": 1.4, "ls": (0, (4, 2))}
        axes.plot(time_s, risk, color=HIDDEN, **style)
        place = {"va": "bottom" if side == highest else "top", "size": 10, "color": HIDDEN}
        if not math.isnan(risk[-1]):
            axes.text(time_s[-1], risk[-1], f" {side}", **place)
    raised = [when for when, one in zip(time_s, past, strict=True) if any(cue.advisory for cue in one.cues)]
    if raised:
        axes.axvspan(raised[0], raised[-1] + 0.1, color=HIDDEN, alpha=0.14, lw=0)
        axes.text(raised[0] + 0.08, 0.02, "advisory", color=HIDDEN, size=10, va="bottom")
    entry_s = float(track.time_s[track.in_view][0])
    if time_s[-1] >= entry_s:
        axes.axvline(entry_s, color=IN_VIEW, lw=1.6)
        axes.text(entry_s + 0.08, 0.98, "in view", color=IN_VIEW, size=10, va="top")


def risk_of(state: WorldState, side: str | None) -> float:
    """Return the risk of one side, NaN while it is not usable."""
    return next((cue.risk for cue in state.cues if cue.direction == side and cue.usable), None) or math.nan


def hide(axes: Axes) -> None:
    """Take ticks and frame away."""
    axes.set(xticks=(), yticks=())
    axes.spines[:].set_visible(False)


if __name__ == "__main__":
    picture(Path(sys.argv[1]), Path(sys.argv[2]))
