"""One style for all figures: fonts, colours, legends beside the data, and a checked file suffix."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from worldstate.adapters.files.atomic import atomic_path
from worldstate.ground.errors import InputFileError
from worldstate.ground.extras import check_extra

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SUFFIXES = (".png", ".svg", ".pdf")
# 150 dots an inch: a figure 9 inches wide is 1350 pixels, and still sharp at the 830 of a README page.
_DPI = 150
# The palette of Okabe and Ito, told apart with any colour vision; black is left to axes and bounds.
BLUE, ORANGE, GREEN, RED, SKY, PURPLE, YELLOW = (
    "#0072B2", "#E69F00", "#009E73", "#D55E00", "#56B4E9", "#CC79A7", "#F0E442",
)  # fmt: skip
_CYCLE = [BLUE, RED, GREEN, ORANGE, PURPLE, SKY]
_STYLE = {
    "font.size": 10.0,
    "axes.titlesize": 10.0,
    "figure.titlesize": 11.0,
    "legend.fontsize": 9.0,
    "legend.frameon": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "lines.linewidth": 1.5,
    "svg.hashsalt": "worldstate",  # else every SVG of the same figure is another file
}


def check_suffix(path: Path) -> Path:
    """Return `path` if a figure can be written under this name; commands call it before their work.

    Examples
    --------
    >>> check_suffix(Path("timeline.svg")).name
    'timeline.svg'
    """
    if path.suffix.lower() not in SUFFIXES:
        raise InputFileError(path, f"expected a figure name ending in {', '.join(SUFFIXES)}")
    check_extra("matplotlib")
    return path


@contextmanager
def figure_style() -> Iterator[None]:
    """Draw in the style of the library, and leave the caller's own matplotlib settings alone."""
    check_extra("matplotlib")
    import matplotlib
    from cycler import cycler

    style: dict[Any, Any] = {**_STYLE, "axes.prop_cycle": cycler(color=_CYCLE)}
    with matplotlib.rc_context(style):
        yield


@contextmanager
def figure_file(path: Path, width_in: float, height_in: float) -> Iterator["Figure"]:
    """Lend an empty figure, and write it to `path` when the block ends without an error."""
    check_suffix(path)
    from matplotlib.figure import Figure

    with figure_style():
        figure = Figure(figsize=(width_in, height_in), layout="constrained")
        yield figure
        save_figure(figure, path)


def save_figure(figure: "Figure", path: Path) -> None:
    """Write a figure whole or not at all, in the format that the suffix names."""
    with atomic_path(check_suffix(path)) as temporary:
        figure.savefig(temporary, dpi=_DPI, format=path.suffix[1:].lower())


def legend_beside(axes: "Axes", title: str | None = None) -> None:
    """Put the legend to the right of the axes, where it hides no data; one entry a label."""
    handles, labels = axes.get_legend_handles_labels()
    once = dict(zip(labels, handles, strict=True))
    axes.legend(
        once.values(), once.keys(), title=title, loc="upper left", bbox_to_anchor=(1.0, 1.0), alignment="left"
    )
