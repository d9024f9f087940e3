r"""Distance between sequence inputs in simulated streams and in real recordings, by column.

Streams are cut into excerpts as long as recordings, with T0 at the same time, and both are processed alike:
approaches from the right are mirrored, and levels are dB above the 20 % quantile of the excerpt so far, as in
the sequence model. The distance of two junctions in a column is the energy distance,

.. math:: D^2 = \overline{|X - Y|} - \tfrac12 \overline{|X - X'|} - \tfrac12 \overline{|Y - Y'|},

divided by the interquartile range of real recordings and averaged over the statistics of the column. Means
are over pairs of different excerpts, so that two samples of one street have an expected distance of zero for
any sample size.

References
----------
G. J. Szekely and M. L. Rizzo, "Energy statistics: a class of statistics based on distances", J. Statistical
Planning and Inference 143, 2013.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.abduction.sequence.sequence_inputs import COLUMNS, QUIET_SHARE
from worldstate.commissioning.heard_stream import HeardStream
from worldstate.ground.typing import FloatArray
from worldstate_lab.metrics.intervals import draw_weights, known_mean, middle, ratio, stratified_draws
from worldstate_lab.report.table import Value

# Approach rate and its deviation are left out: whether a rate exists depends on the duration of the quiet
# sound before, which is a second in a recording and minutes in a stream.
COMPARED = ("this", "other", *(name for name in COLUMNS[2:] if name not in ("rate", "spread")))
_READ = [COLUMNS.index({"this": "left", "other": "right"}.get(name, name)) for name in COMPARED]
_LEVELS = [i for i, name in enumerate(COMPARED) if name.startswith(("level", "loudness", "band"))]
_BEARING = COMPARED.index("bearing")
BEFORE_S, CHANGES_S, LAGS_S = (0.5, 1.0, 2.0, 3.0, 4.0, 5.0), (1.0, 2.0, 3.0), (0.3, 1.0, 2.0)
# T0 of a recording, its length, and the time from which the quiet level is roughly known.
T0_S, LENGTH_S, KNOWN_S = 7.0, 10.0, 2.0
# Interval between rows of a hazard-free excerpt, because adjacent rows are similar
_HOP_S, _APART_S = 0.1, 0.9
_ALONE_S = 1.5  # Minimum time after T0 without another vehicle
DB = 10.0 / np.log(10.0)
DRAWS = 200
_LEAST = 1e-4  # Lower bound of a squared distance in a denominator: a hundredth of the spread is negligible


@dataclass(frozen=True, slots=True, eq=False)
class Excerpt:
    """Ten seconds at one junction, from a real recording or a stream."""

    junction: str
    hazard: bool
    statistics: Mapping[str, FloatArray]  # Each shape (rows, 11), columns as in `COMPARED`

    @classmethod
    def of(cls, junction: str, side: str, t0_s: float, time_s: FloatArray, columns: FloatArray) -> "Excerpt":
        """Return the compared statistics of the hops of an excerpt.

        Times are relative to the start of the excerpt; `side` is left, right or none; columns (n, 13) are
        those of `COLUMNS`, NaN if the guard rejected the sound.
        """
        known = np.isfinite(columns).all(axis=1)
        rows = _over_quiet(_as_from_the_left(columns[known], side))
        table = np.full((round(LENGTH_S / _HOP_S) + 2, len(COMPARED)), np.nan)
        table[np.round(time_s[known] / _HOP_S).astype(np.intp)] = rows

        def at(times_s: FloatArray) -> FloatArray:
            hops = np.round(times_s / _HOP_S).astype(np.intp)
            return np.where(hops[:, None] < 0, np.nan, table[hops])

        if side != "none":
            end, when = np.array([t0_s - BEFORE_S[0]]), "before T0"
            found = {f"{s:g} s before T0": at(np.array([t0_s - s])) for s in BEFORE_S}
        else:
            end, when = np.arange(KNOWN_S, LENGTH_S, _APART_S), "no hazard"
            quiet, found = table[round(KNOWN_S / _HOP_S) :], {when: at(end)}
            found |= {f"autocorrelation, {s:g} s": _autocorrelation(quiet, s) for s in LAGS_S}
        found |= {f"change in {s:g} s, {when}": at(end) - at(end - s) for s in CHANGES_S}
        return cls(junction, side != "none", {k: v[np.isfinite(v).all(axis=1)] for k, v in found.items()})


def _as_from_the_left(columns: FloatArray, side: str) -> FloatArray:
    read = columns[:, _READ]
    if side == "right":
        read[:, :2], read[:, _BEARING] = read[:, [1, 0]], -read[:, _BEARING]
    return read


def _over_quiet(rows: FloatArray) -> FloatArray:
    """Return the rows with their levels in dB above the 20 % quantile of the rows so far."""
    levels, ends = DB * rows[:, _LEVELS], range(1, len(rows) + 1)
    quiet = [np.quantile(levels[:end], QUIET_SHARE, axis=0, method="lower") for end in ends]
    rows[:, _LEVELS] = levels - np.reshape(quiet, levels.shape)
    return rows


def _autocorrelation(rows: FloatArray, lag_s: float) -> FloatArray:
    """Return the correlation with the values of `lag_s` before, shape (1, 11)."""
    lag, off = round(lag_s / _HOP_S), rows - known_mean(rows)
    return ratio(known_mean(off[lag:] * off[:-lag]), known_mean(off**2))[None]


def stream_excerpts(heard: HeardStream, columns: FloatArray) -> list[Excerpt]:
    """Cut a stream into excerpts: approaches without an earlier vehicle in view, or all of a hazard-free one.

    Shapes: columns (n, 13), one row per hop.
    """
    time_s, vehicles, rows = heard.hops.time_s, heard.vehicles, heard.rows
    first, last = time_s[0] - 1.0, time_s[-1] - LENGTH_S
    if heard.hazard_free:
        begins = [(begin, "none") for begin in np.arange(first, last, LENGTH_S)]
    else:
        in_view, entries = rows.time_s[rows.in_view], vehicles.entry_s
        begins = []
        for entry_s, arm in zip(entries[vehicles.hazard], vehicles.arm[vehicles.hazard], strict=True):
            begin, before = entry_s - T0_S, in_view[in_view < entry_s - 2.0 * _HOP_S]
            others = np.concatenate([before, entries[entries != entry_s]])
            alone = not ((others > begin) & (others < entry_s + _ALONE_S)).any()
            if alone and first <= begin <= last:
                begins.append((begin, str(arm)))
    found = []
    for begin, side in begins:
        # The first hop of a recording is at one second.
        inside = (time_s > begin + 1.0 - _HOP_S / 2.0) & (time_s <= begin + LENGTH_S)
        found.append(Excerpt.of(heard.site, side, T0_S, time_s[inside] - begin, columns[inside]))
    return found


@dataclass(frozen=True, slots=True, eq=False)
class Distances:
    """Squared distances of every column, shape (11,) each, and ratios of simulated to real distances."""

    real: FloatArray  # Distances between real junctions
    halves: FloatArray  # Distances between halves of one real junction, zero except for chance
    simulated: FloatArray  # Distances between simulated and real junctions
    ratios: tuple[Value, ...]  # sqrt(simulated / real) with its interval over recordings
    median: Value  # Median of these ratios
    # The same ratio for the means of the squared distances over columns, which is less affected by chance
    mean: Value


def column_distances(
    real: Sequence[Excerpt], simulated: Sequence[Excerpt], rng: np.random.Generator, draws: int = DRAWS
) -> Distances:
    """Measure the distances of simulated junctions from real ones, and of real ones from one another."""
    every = [*real, *simulated]
    pairwise = np.array([_pairwise(every, name, width) for name, width in _scales(real).items()])
    # A simulated junction may have the name of a real one.
    strata = [(i >= len(real), one.junction, one.hazard) for i, one in enumerate(every)]
    parts = sorted({one[:2] for one in strata})
    inside = np.array([[one[:2] == part for one in strata] for part in parts], np.float64)
    n = sum(not simulated_too for simulated_too, _ in parts)

    def squared(times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the squared distances between real junctions and from simulated to real ones, in a draw."""
        some = _squared(pairwise, inside * times)
        return known_mean(some[np.triu_indices(n, 1)]), known_mean(some[n:, :n].reshape(-1, len(COMPARED)))

    between, across = squared(np.ones(len(every)))
    times = draw_weights(stratified_draws(strata, rng, draws), len(every))
    drawn = np.array([squared(one) for one in times])
    halves = known_mean(np.array([_halves(strata[: len(real)], pairwise, rng) for _ in range(draws)]))
    once, spread = _ratios(across, between), _ratios(drawn[:, 1], drawn[:, 0])
    ratios = tuple(Value(float(one), *middle(many)) for one, many in zip(once, spread.T, strict=True))
    median = Value(float(np.median(once)), *middle(np.median(spread, axis=1)))
    mean = Value(float(_ratios(across.mean(), between.mean())), *middle(_ratios(*drawn.mean(axis=2).T[::-1])))
    return Distances(between, halves, across, ratios, median, mean)


def _ratios(simulated: FloatArray | float, real: FloatArray | float) -> FloatArray:
    """Return ratios of distances from squared ones, which may be negative by chance."""
    return np.asarray(np.sqrt(np.maximum(simulated, 0.0) / np.maximum(real, _LEAST)))


def _halves(
    strata: Sequence[tuple[bool, str, bool]], pairwise: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Return the mean squared distance between two random halves of each real junction, shape (11,)."""
    number, dealt = len(strata), np.zeros((2, len(strata)))
    # In the order of the excerpts: a set of names has another order, and so other draws, in every run.
    for one in dict.fromkeys(strata):
        some = rng.permutation([i for i in range(number) if strata[i] == one])
        dealt[0, some[::2]] = dealt[1, some[1::2]] = 1.0
    junctions = sorted({name for _, name, _ in strata})
    masks = np.concatenate([dealt * [one[1] == name for one in strata] for name in junctions])
    found = _squared(pairwise[:, :number, :number], masks)
    return known_mean(np.array([found[i, i + 1] for i in range(0, len(masks), 2)]))


def _scales(real: Sequence[Excerpt]) -> dict[str, FloatArray]:
    """Return the interquartile range of every statistic that occurs in any recording, shape (11,) each."""
    names = dict.fromkeys(name for one in real for name, rows in one.statistics.items() if len(rows))
    rows = {name: [one.statistics[name] for one in real if name in one.statistics] for name in names}
    ends = {name: np.quantile(np.concatenate(some), (0.25, 0.75), axis=0) for name, some in rows.items()}
    widths = {name: np.ptp(both, axis=0) for name, both in ends.items()}
    # A value that is equal in all real recordings separates no junctions.
    return {name: np.where(width > 0.0, width, np.inf) for name, width in widths.items()}


def _pairwise(every: Sequence[Excerpt], name: str, width: FloatArray) -> FloatArray:
    """Return the mean absolute difference of each pair of excerpts, shape (n, n, 11); NaN without rows."""
    found = np.full((len(every), len(every), len(COMPARED)), np.nan)
    having = [i for i, one in enumerate(every) if len(one.statistics.get(name, ()))]
    rows = {i: every[i].statistics[name] / width for i in having}
    for i, mine in rows.items():
        for j, other in rows.items():
            if j > i:
                found[i, j] = found[j, i] = np.abs(mine[:, None] - other).mean(axis=(0, 1))
    return found


def _squared(pairwise: FloatArray, times: FloatArray) -> FloatArray:
    """Return the squared distance of each pair of parts; `times` is how often a part contains an excerpt.

    Shapes: pairwise (statistics, n, n, 11), times (parts, n), returns (parts, parts, 11).
    """
    number = len(pairwise), len(times), *pairwise.shape[2:]
    pairs = times @ np.isfinite(pairwise[..., 0]) @ times.T
    total = times @ (times @ np.nan_to_num(pairwise).reshape(*pairwise.shape[:2], -1)).reshape(number)
    mean = ratio(total, np.broadcast_to(pairs[..., None], total.shape))
    within = np.diagonal(mean, axis1=1, axis2=2).swapaxes(1, 2)
    return known_mean(mean - 0.5 * within[:, :, None] - 0.5 * within[:, None])
