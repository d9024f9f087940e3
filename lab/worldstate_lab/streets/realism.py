"""How far simulated windows are from real ones, beside how far real junctions are from one another.

Every figure of simulated against real stands beside the same figure of real against real, and is inside where
it is no worse than some real junctions are to others. Absolute figures mislead: real junctions are told from
one another by boosting at .92 to .96.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from worldstate.adapters.datasets.feature_table import FeatureTable
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.serialisation import encode
from worldstate_lab.metrics.intervals import DRAWS
from worldstate_lab.report.table import Cell, Table, cell_text

from .realism_rows import (
    RealismRow,
    Span,
    asked_of,
    halves,
    median_figures,
    pair_rows,
    position_rows,
    set_rows,
    side_rows,
    within_types,
)
from .set_classifiers import FAR_AZIMUTHS_DEG, Transfer, odd_profiles, position_figures, published_transfer

Profile = tuple[tuple[float, ...], ...]  # Halves x far azimuths


@dataclass(frozen=True, slots=True, eq=False)
class Realism:
    """The comparison: figures, transfers with intervals, and what follows the side at each junction."""

    groupings: tuple[str, ...]
    rows: tuple[RealismRow, ...]
    transfers: Mapping[str, Transfer]
    profiles: Mapping[str, Mapping[str, Profile]]  # By set and junction

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON; every row says what is inside, and met."""
        rows = [encode(row) | {"inside": row.inside, "met": row.met} for row in self.rows]
        return {**encode(self), "rows": rows}


def measure_realism(
    real: FeatureTable,
    simulated: Mapping[str, FeatureTable],
    rng: np.random.Generator,
    *,
    permuted: Mapping[str, FeatureTable] | None = None,
    classifiers: bool = True,
    draws: int = DRAWS,
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
    permuted : mapping of str to FeatureTable, optional
        The same simulated windows, row by row, with the microphones' positions permuted.
    classifiers : bool
        False leaves out whatever a classifier is trained for (C2ST, transfer, side, positions): streets are
        tuned on single measures alone.
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
    groupings = (halves(sites) if len(sites) > 1 else (), within_types(sites))
    # The figures of real against real are the same beside any simulation.
    of_real, of_simulated = rng.spawn(2)
    # Each way once, with its interval: the rows show the same areas.
    transfers = {}
    for name, table in simulated.items() if classifiers else ():
        transfers[f"{name} -> real"] = published_transfer(table, real, of_simulated, draws)
        transfers[f"real -> {name}"] = published_transfer(real, table, of_simulated, draws)
    rows = pair_rows(real, simulated, transfers, groupings, (of_real, of_simulated) if classifiers else None)
    rows += [*median_figures(real, simulated), *set_rows(real, simulated, groupings[0])]
    if classifiers:
        lost = {
            name: position_figures(real, simulated[name], table, of_simulated)
            for name, table in (permuted or {}).items()
        }
        rows += [*side_rows(real, simulated), *position_rows(lost)]
    moving = any(name.startswith("D") for name in sites)
    rows = [replace(row, asked=asked_of(row.figure, row.windows, row.real, moving=moving)) for row in rows]
    profiles = {
        name: {site: tuple(map(tuple, profile.tolist())) for site, profile in odd_profiles(table).items()}
        for name, table in {"real": real, **simulated}.items()
    }
    return Realism(tuple(map(str, groupings[0])), tuple(rows), transfers, profiles)


def realism_lines(found: Realism) -> list[str]:
    """Return figures, transfers and profiles; `!` marks what is outside, `x` what is not as asked."""
    names = list(dict.fromkeys(name for row in found.rows for name in row.simulated))
    spans = "real against real", "of a type", "asked"
    rows = [_row_cells(row, names) for row in found.rows]
    lines = Table("figures", "Figures", ("figure", "windows", "real", *spans, *names), rows).lines()
    for name in names:
        inside = [row.inside.get(name) for row in found.rows]
        met = [row.met.get(name) for row in found.rows]
        lines.append(
            f"{name}: inside {inside.count(True)}, outside {inside.count(False)}; "
            f"as asked {met.count(True)}, not {met.count(False)}"
        )
    gains = [
        (name, one.auroc, one.scalar, _span(one.gain), float(one.windows))
        for name, one in found.transfers.items()
    ]
    if gains:
        columns = "sets", "AUROC", "loudest direction", "gain", "windows"
        lines += ["", *Table("transfers", "Transfers", columns, gains).lines()]
    title = "Louder on the far side than on the vehicle's own (odd part, log), by azimuth in deg"
    azimuths = (f"{azimuth:.0f}" for azimuth in FAR_AZIMUTHS_DEG)
    by_site = _profile_rows(found.profiles)
    profiles = Table("profiles", title, ("junction", "half", "set", *azimuths), by_site)
    return [f"real against real: {'; '.join(found.groupings)}", *lines, "", *profiles.lines()]


def _row_cells(row: RealismRow, names: list[str]) -> tuple[Cell, ...]:
    inside, met = row.inside, row.met
    marks = {name: "!" * (inside.get(name) is False) + "x" * (met.get(name) is False) for name in names}
    values = (cell_text(row.simulated.get(name)) + marks[name].ljust(2) for name in names)
    return row.figure, row.windows, row.real, *map(_span, (row.halves, row.junctions, row.asked)), *values


def _span(span: Span | None) -> str | None:
    return None if span is None else f"{span[0]:.3f}-{span[1]:.3f}"


def _profile_rows(profiles: Mapping[str, Mapping[str, Profile]]) -> list[tuple[Cell, ...]]:
    sites = sorted({site for by_site in profiles.values() for site in by_site})
    return [
        (site, str(half + 1), name, *(f"{value:+.2f}" for value in by_site[site][half]))
        for site in sites
        for half in range(2)
        for name, by_site in profiles.items()
        if site in by_site
    ]
