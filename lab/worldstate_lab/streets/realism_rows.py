"""Every figure of simulated against real, with the range of real against real beside it."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.adapters.datasets.feature_table import FeatureTable

from .asked import Span
from .groupings import Grouping
from .pair_figures import TOLERANCE, agreeing_medians, distance_figures, median_rows
from .set_figures import FigureKey, set_figures
from .side import side_accuracy
from .transfer import Transfer, published_transfer

# Figures of which only one end of the range can be missed; the rest may be neither lower nor higher.
LOWER_IS_NEARER = ("C2ST", "AUROC of")
HIGHER_IS_NEARER = ("share of medians", "side", "transfer")
# The untrained scalar is there to be beaten, not to be reached.
_NO_VERDICT = "loudest direction"
_WAYS = ("real to simulated", "simulated to real", "simulated to simulated")


@dataclass(frozen=True, slots=True)
class RealismRow:
    """One figure of real windows, of real against real, and of simulated ones."""

    figure: str
    windows: str
    real: float | None  # Of all real windows
    halves: Span | None  # Smallest and largest of real against real: groupings, junctions of a type
    junctions: Span | None
    allowed: Span | None  # Where a simulated figure is inside
    simulated: Mapping[str, float]
    asked: Span | None = None

    @property
    def inside(self) -> dict[str, bool | None]:
        """Whether each simulated figure is in the range of real against real, None where there is none."""
        return _within(self.simulated, self.allowed)

    @property
    def met(self) -> dict[str, bool | None]:
        """Whether each simulated figure is where it is asked to be, None where nothing is asked."""
        return _within(self.simulated, self.asked)


def _within(values: Mapping[str, float], span: Span | None) -> dict[str, bool | None]:
    return {name: None if span is None else span[0] <= value <= span[1] for name, value in values.items()}


def pair_rows(
    real: FeatureTable,
    simulated: Mapping[str, FeatureTable],
    transfers: Mapping[str, Transfer],
    groupings: tuple[Sequence[Grouping], Sequence[Grouping]],
    rngs: tuple[np.random.Generator, np.random.Generator] | None,
) -> list[RealismRow]:
    """Return what tells two sets apart, what a classifier of one makes of the other, and agreeing medians.

    Without generators no classifier is trained; the single measures are left.
    """
    of_real, of_simulated = rngs or (None, None)
    by_halves, by_junction = (_spans(_real_pairs(real, some, of_real)) for some in groupings)
    ours = {}
    for name, table in simulated.items():
        ours[name] = distance_figures(real, table, of_simulated) | agreeing_medians(real, table)
        ways = {f"real -> {name}": ", real to simulated", f"{name} -> real": ", simulated to real"}
        for which, way in ways.items() if transfers else ():
            ours[name] |= _transfer_figures(transfers[which], way)
    known: Iterable[Iterable[FigureKey]] = ours.values() if ours else [by_halves]
    keys = dict.fromkeys(key for figures in known for key in figures)
    rows = []
    for figure, windows in keys:
        undirected = figure.partition(",")[0], windows
        between, within = by_halves.get(undirected), by_junction.get(undirected)
        # A single measure may be as far off as between any two real junctions; the rest as between groupings.
        spans = [span for span in (between, within if figure.startswith("AUROC of") else None) if span]
        key = figure, windows
        found = {name: figures[key] for name, figures in ours.items() if key in figures}
        rows.append(RealismRow(figure, windows, None, between, within, allowed_span(figure, spans), found))
    return rows


def _real_pairs(
    real: FeatureTable, groupings: Iterable[Grouping], rng: np.random.Generator | None
) -> Iterator[dict[FigureKey, float]]:
    for grouping in groupings:
        one, other = grouping.tables(real)
        yield distance_figures(one, other, rng)
        for train, test in ((one, other), (other, one)):
            yield agreeing_medians(train, test)
            if rng and all(table.hazards.any() and table.hazard_free.any() for table in (train, test)):
                yield _transfer_figures(published_transfer(train, test, rng))


def _transfer_figures(found: Transfer, way: str = "") -> dict[FigureKey, float]:
    named = {f"transfer{way}": found.auroc, f"{_NO_VERDICT}{way}": found.scalar}
    return {(name, "hidden, none"): value for name, value in named.items()}


def _spans(found: Iterable[Mapping[FigureKey, float]]) -> dict[FigureKey, Span]:
    gathered: dict[FigureKey, list[float]] = {}
    for figures in found:
        for key, value in figures.items():
            gathered.setdefault(key, []).append(value)
    return {key: (min(values), max(values)) for key, values in gathered.items()}


def allowed_span(figure: str, spans: Sequence[Span]) -> Span | None:
    """Return the range that holds all spans, open to the side on which a figure is nearer.

    Examples
    --------
    >>> allowed_span("C2ST", [(0.92, 0.96)]), allowed_span("sd of width_deg", [(6.0, 9.0), (7.0, 10.0)])
    ((0.0, 0.96), (6.0, 10.0))
    """
    if not spans or figure.startswith(_NO_VERDICT):
        return None
    low, high = min(span[0] for span in spans), max(span[1] for span in spans)
    return 0.0 if figure.startswith(LOWER_IS_NEARER) else low, 1.0 if figure.startswith(
        HIGHER_IS_NEARER
    ) else high


def median_figures(real: FeatureTable, simulated: Mapping[str, FeatureTable]) -> list[RealismRow]:
    """Return the medians by type of junction and class, inside where they are within 15 %."""
    ours = {name: median_rows(real, table) for name, table in simulated.items()}
    rows = []
    for key, (middle, _) in median_rows(real, real).items():
        found = {name: medians[key][1] for name, medians in ours.items() if key in medians}
        allowed = (1.0 - TOLERANCE) * middle, (1.0 + TOLERANCE) * middle
        rows.append(RealismRow(*key, middle, None, None, allowed, found))
    return rows


def set_rows(
    real: FeatureTable, simulated: Mapping[str, FeatureTable], groupings: Iterable[Grouping]
) -> list[RealismRow]:
    """Return what one set has by itself, beside the halves of the real junctions."""
    # Halves stand for streets of which only so many were recorded: spreads of two or three junctions.
    parts = [part for grouping in groupings for part in grouping.tables(real)]
    # A share between sites needs two of them.
    spans = _spans(set_figures(part) for part in parts if len(set(part.environments.tolist())) > 1)
    ours = {name: set_figures(table) for name, table in simulated.items()}
    rows = []
    for key, value in set_figures(real).items():
        found = {name: figures[key] for name, figures in ours.items() if key in figures}
        rows.append(RealismRow(*key, value, spans.get(key), None, spans.get(key), found))
    return rows


def side_rows(real: FeatureTable, simulated: Mapping[str, FeatureTable]) -> list[RealismRow]:
    """Return how often left is told from right, real on real beside either way, at each junction."""
    rows = []
    for adapted, said in ((False, ""), (True, ", site's mean removed")):
        known = _with_mean(side_accuracy(real, real, without_site_mean=adapted))
        span = (min(known.values()), max(known.values())) if known else None
        allowed = allowed_span("side", [span] if span else [])
        for way in _WAYS if simulated else ("real to real",):
            ours = {
                name: _with_mean(side_accuracy(*_in_order(way, real, table), without_site_mean=adapted))
                for name, table in simulated.items()
            }
            for site in known:
                figure = f"side, {way}{said}"
                found = {name: by_site[site] for name, by_site in ours.items() if site in by_site}
                rows.append(RealismRow(figure, site, known[site], span, None, allowed, found))
    return rows


def _in_order(way: str, real: FeatureTable, simulated: FeatureTable) -> tuple[FeatureTable, FeatureTable]:
    train, test = ({"real": real, "simulated": simulated}[word] for word in way.split(" to "))
    return train, test


def _with_mean(by_site: Mapping[str, float]) -> dict[str, float]:
    return {**by_site, "mean": float(np.mean(list(by_site.values())))} if by_site else {}


def position_rows(figures: Mapping[str, Mapping[FigureKey, float]]) -> list[RealismRow]:
    """Return what is lost with permuted positions; there is no real sound to compute the same from."""
    keys = dict.fromkeys(key for one in figures.values() for key in one)
    return [
        RealismRow(*key, None, None, None, None, {name: one[key] for name, one in figures.items()})
        for key in keys
    ]
