"""What simulated streets are asked to reach, narrower than the range between real junctions."""

from .set_figures import FigureKey

Span = tuple[float, float]

# Beside each, the figure of the released windows, or of real against real.
_ASKED: dict[FigureKey, Span] = {
    ("C2ST", "all"): (0.0, 0.96),  # .925 to .963 between groupings of real junctions
    ("between-site share of pattern", "hidden"): (0.45, 1.0),  # .57
    ("iqr of log prominence", "none"): (0.0, 0.20),  # .131
    ("share of peaks at 40 to 65 deg", "hidden"): (0.75, 0.95),  # .89
    ("area of the second half's peak", "hidden, none"): (0.85, 1.0),  # .945
    ("transfer, simulated to real", "hidden, none"): (0.93, 1.0),  # .909 to .993
    ("side, real to simulated", "mean"): (0.75, 1.0),  # .95
    ("side, simulated to real", "mean"): (0.75, 1.0),
}
# No site may be told worse than by chance, and no classifier may rank as well with wrong positions.
_ASKED_BY_FIGURE: dict[str, Span] = {
    "side, real to simulated": (0.5, 1.0),
    "side, simulated to real": (0.5, 1.0),
    "loss by permuted positions: published, of simulated": (0.10, 1.0),
    "loss by permuted positions: shipped model": (0.10, 1.0),
}
# The spread of the level within each class, of the real one.
_LEVEL_TOLERANCE = 0.25
# A moving ego covers distant vehicles by its own noise: the published classifier loses most of its area.
_MOVING_TRANSFER = (0.70, 1.0)


def asked_of(figure: str, windows: str, real: float | None, *, moving: bool = False) -> Span | None:
    """Return the span in which a simulated figure is asked to be, None where nothing is asked.

    Examples
    --------
    >>> asked_of("sd of log level", "none", 0.2)
    (0.15000000000000002, 0.25)
    """
    if moving:
        return _MOVING_TRANSFER if figure.startswith("transfer") else None
    if figure == "sd of log level" and real is not None:
        return (1.0 - _LEVEL_TOLERANCE) * real, (1.0 + _LEVEL_TOLERANCE) * real
    return _ASKED.get((figure, windows), _ASKED_BY_FIGURE.get(figure))
