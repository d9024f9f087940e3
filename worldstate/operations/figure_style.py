"""Common style of all figures: fonts, colours by meaning, legends beside the data, rows of bars."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from worldstate.adapters.files.file_io import atomic_path
from worldstate.ground.errors import InputFileError
from worldstate.ground.extras import check_extra
from worldstate.ground.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SUFFIXES = (".png", ".svg", ".pdf")
ANIMATION, PAGE = ((".gif",), "an animation's name"), ((".html", ".htm"), "a page's name")
# Hops farther apart than this are not joined by a line, because one may be missing.
HOP_S = 0.1
GAP_S = 2.5 * HOP_S
# At 150 dots per inch a figure 9 inches wide has 1350 pixels, and is still sharp at the 830 of a README page.
_DPI = 150
# Each colour has one meaning in all figures. The palette is that of Okabe and Ito with an indigo. In
# simulations of the three colour vision deficiencies any two colours differ by at least 17 in CIELAB, and
# each has a contrast of 3 on paper.
HIDDEN, IN_VIEW, SEARCHED = "#D55E00", "#0072B2", "#009E73"
HEARD, TRUTH, DECISION = "#CC79A7", "black", "#332288"
# Sides differ by line style, in the order of the context's directions, never by colour.
SIDE_DASHES = ("-", "--", "-.", ":")
# Colours for everything else, such as methods and faults; any two differ by at least 22.
CATEGORIES = ("#4D4D4D", "#E69F00", "#56B4E9", "#AA4499", "#997700", "#A6A6A6")
# An SVG is dark on a dark page: lightness is inverted, hues stay.
_DARK = " @media (prefers-color-scheme: dark) { svg { filter: invert(0.91) hue-rotate(180deg) } }"
_STYLE = {
    "font.size": 10.0,
    "axes.titlesize": 10.0,
    "figure.titlesize": 11.0,
    "legend.fontsize": 9.0,
    "legend.frameon": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "lines.linewidth": 1.5,
    "svg.hashsalt": "worldstate",  # otherwise equal figures give different SVG files
}


def check_suffix(path: Path, suffixes: Sequence[str] = SUFFIXES, what: str = "a figure name") -> Path:
    """Return `path` if its name ends in one of `suffixes`; commands check it before their work.

    Examples
    --------
    >>> check_suffix(Path("timeline.svg")).name
    'timeline.svg'
    """
    if path.suffix.lower() not in suffixes:
        raise InputFileError(path, f"expected {what} ending in {', '.join(suffixes)}")
    return path


@contextmanager
def figure_style() -> Iterator[None]:
    """Draw in the style of the library without changing the caller's matplotlib settings."""
    check_extra("matplotlib")
    import matplotlib
    from cycler import cycler

    style: dict[Any, Any] = {**_STYLE, "axes.prop_cycle": cycler(color=CATEGORIES)}
    with matplotlib.rc_context(style):
        yield


@contextmanager
def figure_file(path: Path, width_in: float, height_in: float) -> Iterator["Figure"]:
    """Yield an empty figure, which is written atomically if the block ends without an error."""
    check_suffix(path)
    check_extra("matplotlib")
    from matplotlib.figure import Figure

    with figure_style():
        figure = Figure(figsize=(width_in, height_in), layout="constrained")
        yield figure
        with atomic_path(path) as temporary:
            figure.savefig(temporary, dpi=_DPI, format=path.suffix[1:].lower())
            if path.suffix.lower() == ".svg":
                text = Path(temporary).read_text("utf-8")
                Path(temporary).write_text(text.replace("</style>", f"{_DARK}</style>", 1), "utf-8")


def legend_beside(axes: "Axes", title: str | None = None) -> None:
    """Put the legend to the right of the axes, where it hides no data, with one entry per label."""
    handles, labels = axes.get_legend_handles_labels()
    once = dict(zip(labels, handles, strict=True))
    beside: dict[str, Any] = {"loc": "upper left", "bbox_to_anchor": (1.0, 1.0), "alignment": "left"}
    axes.legend(once.values(), once.keys(), title=title, **beside)


def draw_power(
    axes: "Axes", time_s: FloatArray, azimuths_rad: FloatArray, power: FloatArray, label: str
) -> None:
    """Draw power over azimuth, relative to its median, in grey, with a scale above it.

    Shapes: time_s (n,), azimuths_rad (a,), power (n, a).
    """
    level = power / np.median(power, axis=1, keepdims=True)
    azimuths_deg = np.degrees(azimuths_rad)
    mesh = axes.pcolormesh(time_s, azimuths_deg, level.T, shading="nearest", cmap="Greys", rasterized=True)
    bar = axes.figure.colorbar(mesh, ax=axes, location="top", aspect=60, pad=0.02, fraction=0.05)
    bar.set_label(label)


def draw_bars(
    axes: "Axes", time_s: ArrayLike, on: ArrayLike, row: int, color: str, height: float = 0.8
) -> None:
    """Draw a bar for every run of hops in one row; each decision is valid until the next one.

    Shapes: time_s, on (n,).
    """
    held = np.asarray(time_s, dtype=np.float64)[np.asarray(on, dtype=np.bool_)]
    if held.size:
        parts = np.split(held, np.flatnonzero(np.diff(held) > GAP_S) + 1)
        bars = [(part[0], part[-1] - part[0] + HOP_S) for part in parts]
        axes.broken_barh(bars, (row - height / 2.0, height), color=color, lw=0)


def name_rows(axes: "Axes", names: Sequence[str]) -> None:
    """Label the rows of bars and marks, the first one lowest."""
    axes.set(yticks=range(len(names)), yticklabels=names, ylim=(-0.6, len(names) - 0.4))
    axes.tick_params(axis="y", length=0)


def with_gaps(rows: FloatArray) -> FloatArray:
    """Insert a row of NaN where rows are far apart in time, so that no line is drawn across the gap.

    Shapes: rows (n, columns), the first column the time, seconds.
    """
    return np.insert(rows, np.flatnonzero(np.diff(rows[:, 0]) > GAP_S) + 1, np.nan, axis=0)
