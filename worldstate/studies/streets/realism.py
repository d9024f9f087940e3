"""How far simulated windows are from real ones, beside how far real junctions are from one another.

Every figure of simulated against real stands beside the same figure of real against real, and is inside where
it is no worse than some real junctions are to others. Absolute figures mislead: real junctions are told from
one another by boosting at .92 to .96.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import chain
from typing import Any, Literal

import numpy as np

from worldstate.adapters.datasets.feature_table import FeatureTable
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.serialisation import encode

from .groupings import Grouping, halves, within_types
from .pair_figures import TOLERANCE, median_rows, pair_figures
from .set_figures import FigureKey, set_figures
from .side import odd_profiles, side_accuracy
from .transfer import DRAWS, Transfer, published_transfer

Span = tuple[float, float]
Better = Literal["low", "high", "near"]

# A figure of two sets is worse in one direction only.
_BETTER: dict[str, Better] = {"C2ST": "low", "AUROC of": "low", "share of medians": "high", "side": "high"}
_WAYS = ("real to simulated", "simulated to real", "simulated to simulated")
_NO_VERDICT = ("loudest direction",)


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

    @property
    def inside(self) -> dict[str, bool | None]:
        """Whether the simulated figures are inside, None where there is nothing to hold them against."""
        return {name: None if self.allowed is None else self._inside(v) for name, v in self.simulated.items()}

    def _inside(self, value: float) -> bool:
        assert self.allowed is not None
        return self.allowed[0] <= value <= self.allowed[1]


@dataclass(frozen=True, slots=True, eq=False)
class Realism:
    """The comparison: figures, transfers with intervals, and what follows the side at each junction."""

    groupings: tuple[str, ...]
    rows: tuple[RealismRow, ...]
    transfers: Mapping[str, Transfer]
    profiles: Mapping[
        str, Mapping[str, tuple[tuple[float, ...], ...]]
    ]  # By set and junction: halves x far azimuths

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON; every row says what is inside."""
        rows = [encode(row) | {"inside": row.inside} for row in self.rows]
        return {**encode(self), "rows": rows}


def measure_realism(
    real: FeatureTable, simulated: Mapping[str, FeatureTable], rng: np.random.Generator, *, draws: int = DRAWS
) -> Realism:
    """Hold sets of simulated windows against real ones, and real junctions against one another.

    Parameters
    ----------
    real : FeatureTable
        Released windows.
    simulated : mapping of str to FeatureTable
        Simulated windows by the name of their set, such as a seed; none for real against real alone.
    rng : numpy.random.Generator
        Folds and bootstrap.
    draws : int
        Bootstrap samples of recordings for the intervals of the transfers.

    Returns
    -------
    Realism
        Every figure beside the same one of real against real.

    Raises
    ------
    InvalidArgumentError
        If a set lacks hazard or hazard-free windows.

    Examples
    --------
    >>> def windows(seed):
    ...     rng = np.random.default_rng(seed)
    ...     labels, keys = np.repeat(["left", "none", "right", "front"], 24), np.arange(96).astype(str)
    ...     loud = np.where(labels == "none", 0.1, 0.2)[:, None]
    ...     features = loud * rng.lognormal(0.0, 0.2, (96, 60))
    ...     where = np.tile(["SA1", "SA2", "SB1", "SB2"], 24)
    ...     return FeatureTable(features, labels, keys, where, keys, (None,) * 96)
    >>> found = measure_realism(windows(0), {"1": windows(1)}, np.random.default_rng(0), draws=20)
    >>> [row.inside["1"] for row in found.rows if (row.figure, row.windows) == ("AUROC of level", "none")]
    [True]
    """
    for name, table in {"real": real, **simulated}.items():
        if not table.hazards.any() or not table.hazard_free.any():
            raise InvalidArgumentError(f"{name}: expected hazard and hazard-free windows")
    sites = sorted(set(real.environments.tolist()))
    groupings = halves(sites) if len(sites) > 1 else ()
    rows = [*_pair_rows(real, simulated, groupings, within_types(sites), rng)]
    rows += _median_rows(real, simulated)
    rows += _set_rows(real, simulated, groupings)
    rows += _side_rows(real, simulated)
    transfers = {}
    for name, table in simulated.items():
        transfers[f"{name} -> real"] = published_transfer(table, real, rng, draws)
        transfers[f"real -> {name}"] = published_transfer(real, table, rng, draws)
    profiles = {
        name: {site: tuple(map(tuple, profile.tolist())) for site, profile in odd_profiles(table).items()}
        for name, table in {"real": real, **simulated}.items()
    }
    return Realism(tuple(map(str, groupings)), tuple(rows), transfers, profiles)


def _pair_rows(
    real: FeatureTable,
    simulated: Mapping[str, FeatureTable],
    groupings: Iterable[Grouping],
    junctions: Iterable[Grouping],
    rng: np.random.Generator,
) -> list[RealismRow]:
    by_halves = _spans(chain(*(pair_figures(*one.tables(real), rng) for one in groupings)))
    by_junction = _spans(chain(*(pair_figures(*one.tables(real), rng) for one in junctions)))
    ours: dict[FigureKey, dict[str, float]] = {}
    for name, table in simulated.items():
        # The medians are those of the simulated windows beside the real ones: trained on real.
        from_real, to_real = pair_figures(real, table, rng)
        for (figure, windows), value in from_real.items():
            if figure in ("transfer", "loudest direction"):
                there, back = f"{figure}, real to simulated", f"{figure}, simulated to real"
                ours.setdefault((there, windows), {})[name] = value
                ours.setdefault((back, windows), {})[name] = to_real[figure, windows]
            else:
                ours.setdefault((figure, windows), {})[name] = value
    rows = []
    for key in ours or by_halves:
        figure, windows = key
        of_real = figure.partition(",")[0], windows
        between, within = by_halves.get(of_real), by_junction.get(of_real)
        # A single measure may be as far off as between any two real junctions; the rest as between groupings.
        both = [span for span in (between, within if figure.startswith("AUROC of") else None) if span]
        allowed = None if figure.startswith(_NO_VERDICT) else _allowed(figure, both)
        rows.append(RealismRow(figure, windows, None, between, within, allowed, ours.get(key, {})))
    return rows


def _spans(found: Iterable[Mapping[FigureKey, float]]) -> dict[FigureKey, Span]:
    gathered: dict[FigureKey, list[float]] = {}
    for figures in found:
        for key, value in figures.items():
            gathered.setdefault(key, []).append(value)
    return {key: (min(values), max(values)) for key, values in gathered.items()}


def _allowed(figure: str, spans: list[Span]) -> Span | None:
    if not spans:
        return None
    low, high = min(span[0] for span in spans), max(span[1] for span in spans)
    better = next((how for name, how in _BETTER.items() if figure.startswith(name)), "near")
    if figure.startswith("transfer"):
        better = "high"
    return (0.0 if better == "low" else low), (1.0 if better == "high" else high)


def _median_rows(real: FeatureTable, simulated: Mapping[str, FeatureTable]) -> list[RealismRow]:
    ours = {name: median_rows(real, table) for name, table in simulated.items()}
    rows = []
    for key, (middle, _) in median_rows(real, real).items():
        found = {name: medians[key][1] for name, medians in ours.items() if key in medians}
        allowed = (1.0 - TOLERANCE) * middle, (1.0 + TOLERANCE) * middle
        rows.append(RealismRow(*key, middle, None, None, allowed, found))
    return rows


def _set_rows(
    real: FeatureTable, simulated: Mapping[str, FeatureTable], groupings: Iterable[Grouping]
) -> list[RealismRow]:
    # A share between sites needs two of them.
    tables = chain(*(one.tables(real) for one in groupings))
    spans = _spans(set_figures(part) for part in tables if len(set(part.environments.tolist())) > 1)
    ours = {name: set_figures(table) for name, table in simulated.items()}
    rows = []
    for key, value in set_figures(real).items():
        found = {name: figures[key] for name, figures in ours.items() if key in figures}
        rows.append(RealismRow(*key, value, spans.get(key), None, spans.get(key), found))
    return rows


def _side_rows(real: FeatureTable, simulated: Mapping[str, FeatureTable]) -> list[RealismRow]:
    rows = []
    for adapted, said in ((False, ""), (True, ", site's mean removed")):
        known = _with_mean(side_accuracy(real, real, without_site_mean=adapted))
        span = (min(known.values()), max(known.values())) if known else None
        allowed = _allowed("side", [span] if span else [])
        for way in _WAYS if simulated else ("real to real",):
            ours = {
                name: _with_mean(side_accuracy(*_in_order(way, real, table), without_site_mean=adapted))
                for name, table in simulated.items()
            }
            for site in known:
                found = {name: by_site[site] for name, by_site in ours.items() if site in by_site}
                rows.append(RealismRow(f"side, {way}{said}", site, known[site], span, None, allowed, found))
    return rows


def _in_order(way: str, real: FeatureTable, simulated: FeatureTable) -> tuple[FeatureTable, FeatureTable]:
    train, test = ({"real": real, "simulated": simulated}[word] for word in way.split(" to "))
    return train, test


def _with_mean(by_site: Mapping[str, float]) -> dict[str, float]:
    return {**by_site, "mean": float(np.mean(list(by_site.values())))} if by_site else {}
