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

from .asked import Span, asked_of
from .groupings import halves, within_types
from .realism_rows import RealismRow, median_figures, pair_rows, position_rows, set_rows, side_rows
from .side import odd_profiles
from .transfer import DRAWS, Transfer, published_transfer
from .wrong_positions import position_figures


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
    asked = [asked_of(row.figure, row.windows, row.real, moving=moving) for row in rows]
    profiles = {
        name: {site: tuple(map(tuple, profile.tolist())) for site, profile in odd_profiles(table).items()}
        for name, table in {"real": real, **simulated}.items()
    }
    return Realism(tuple(map(str, groupings[0])), tuple(map(_with_asked, rows, asked)), transfers, profiles)


def _with_asked(row: RealismRow, asked: Span | None) -> RealismRow:
    return replace(row, asked=asked)
