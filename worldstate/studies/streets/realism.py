"""How far simulated windows are from real ones, and what a classifier learned on one makes of the other.

Medians of level and shape per junction type and class, transfer both ways (published classifier, with the
untrained peak as the scalar to beat, on the same bootstrap samples of recordings), and a boosted classifier's
ability to tell the two apart (C2ST).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.ensemble import HistGradientBoostingClassifier
from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

from worldstate.abduction.signature.published_signature import hazard_statistic
from worldstate.abduction.signature.published_training import PublishedClassifier
from worldstate.adapters.datasets.feature_table import FeatureTable
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.serialisation import encode
from worldstate.ground.typing import FloatArray, IndexArray, TextArray
from worldstate.operations.metrics.recording_draws import middle
from worldstate.operations.metrics.roc import auroc
from worldstate.operations.training.splits import folds_by_recording
from worldstate.studies.features.bootstrap import recording_draws

Interval = tuple[float, float]

DESCRIPTORS = ("level", "peak", "width_deg", "prominence", "change")
CLASS_GROUPS = {"none": ("none",), "hazard": ("left", "right"), "front": ("front",)}
TYPES = {"A": "SA", "B": "SB", "moving A": "DA", "moving B": "DB"}
# Real junctions of one type agree with one another within this in 18 to 24 of 30 rows.
TOLERANCE = 0.15
# The published feature has 30 azimuths over half a circle, for either half of its window.
AZIMUTH_STEP_DEG = 180.0 / 29.0
SEGMENTS = 2
DRAWS = 500
# A median of fewer windows is chance.
LEAST_WINDOWS = 5


@dataclass(frozen=True, slots=True)
class MedianRow:
    """One statistic of one class at one type of junction, real beside simulated."""

    junctions: str
    windows: str
    statistic: str
    real: float
    simulated: float

    @property
    def within(self) -> bool:
        """Whether the simulated median is within 15 % of the real one."""
        return abs(self.simulated - self.real) <= TOLERANCE * abs(self.real)


@dataclass(frozen=True, slots=True)
class Transfer:
    """Hazard against hazard-free windows of one set, by a classifier trained on the other."""

    trained_on: str
    tested_on: str
    windows: int
    auroc: float  # Area of the classifier and of the loudest direction on the same windows
    scalar: float
    gain: Interval  # Middle 95 % of their difference over bootstrap samples of recordings


@dataclass(frozen=True, slots=True)
class Realism:
    """The comparison: medians, transfers and C2ST (0.5 would be indistinguishable)."""

    medians: tuple[MedianRow, ...]
    transfers: tuple[Transfer, ...]
    c2st: dict[str, float]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON; every median says whether it is within 15 %."""
        rows = [encode(row) | {"within": row.within} for row in self.medians]
        return {**encode(self), "medians": rows}

    def table(self) -> str:
        """Return the comparison for people."""
        lines = [f"{'type':<9}{'windows':<9}{'statistic':<12}{'real':>8}{'simulated':>11}{'within 15 %':>13}"]
        for row in self.medians:
            lines.append(
                f"{row.junctions:<9}{row.windows:<9}{row.statistic:<12}{row.real:>8.3f}{row.simulated:>11.3f}"
                f"{'yes' if row.within else 'no':>13}"
            )
        for one in self.transfers:
            low, high = one.gain
            lines.append(
                f"{one.trained_on} -> {one.tested_on}: AUROC {one.auroc:.3f}, scalar {one.scalar:.3f}, "
                f"gain [{low:+.3f}, {high:+.3f}], {one.windows} windows"
            )
        lines += [f"C2ST {name}: {area:.3f}" for name, area in self.c2st.items()]
        return "\n".join(lines)


def describe_windows(features: FloatArray) -> dict[str, FloatArray]:
    """Return level and shape of windows, raw features (n, 60) -> (n,) for each of `DESCRIPTORS`."""
    # level is the mean, peak the largest value, prominence the ratio of each segment's peak to its median
    # (mean over segments), width_deg the azimuths above half way from median to peak, change the Euclidean
    # distance of the segments.
    segments = features.reshape(len(features), SEGMENTS, -1)
    spectrum = segments.mean(axis=1)
    half = 0.5 * (spectrum.max(axis=1) + np.median(spectrum, axis=1))
    return {
        "level": features.mean(axis=1),
        "peak": features.max(axis=1),
        "width_deg": AZIMUTH_STEP_DEG * (spectrum > half[:, None]).sum(axis=1),
        "prominence": (segments.max(axis=2) / np.median(segments, axis=2)).mean(axis=1),
        "change": np.linalg.norm(segments[:, 0] - segments[:, 1], axis=1),
    }


def compare_windows(
    real: FeatureTable, simulated: FeatureTable, rng: np.random.Generator, *, draws: int = DRAWS
) -> Realism:
    """Compare real with simulated windows."""
    for name, table in (("real", real), ("simulated", simulated)):
        if not table.hazards.any() or not table.hazard_free.any():
            raise InvalidArgumentError(f"{name}: expected hazard and hazard-free windows")
    transfers = [_transfer("simulated", simulated, "real", real, rng, draws)]
    for junctions, part in _by_type(simulated):
        transfers.append(_transfer("real", real, f"simulated {junctions}", part, rng, draws))
    return Realism(tuple(_medians(real, simulated)), tuple(transfers), _c2st(real, simulated, rng))


def _by_type(table: FeatureTable) -> list[tuple[str, FeatureTable]]:
    parts = [(name, table.environments.astype("U2") == prefix) for name, prefix in TYPES.items()]
    chosen = [(name, table.select(rows)) for name, rows in parts if rows.any()]
    return [(name, part) for name, part in chosen if part.hazards.any() and part.hazard_free.any()]


def _medians(real: FeatureTable, simulated: FeatureTable) -> list[MedianRow]:
    ours = dict(_by_type(simulated))
    rows = []
    for junctions, table in _by_type(real):
        for windows, labels in CLASS_GROUPS.items():
            pair = [_described(one, labels) for one in (table, ours.get(junctions)) if one is not None]
            if len(pair) == 2 and min(len(one["level"]) for one in pair) >= LEAST_WINDOWS:
                for name in DESCRIPTORS:
                    middle = [float(np.median(one[name])) for one in pair]
                    rows.append(MedianRow(junctions, windows, name, *middle))
    return rows


def _described(table: FeatureTable, labels: tuple[str, ...]) -> dict[str, FloatArray]:
    return describe_windows(table.features[np.isin(table.labels, labels)])


def _transfer(
    trained_on: str,
    train: FeatureTable,
    tested_on: str,
    test: FeatureTable,
    rng: np.random.Generator,
    draws: int,
) -> Transfer:
    classifier = PublishedClassifier(rng).fit(np.log(train.features), train.labels)
    score = hazard_statistic(classifier.predict_proba(np.log(test.features)), miss_rate=0.0)
    loudest = test.features.max(axis=1)
    gains = [
        _area(score, test, rows) - _area(loudest, test, rows) for rows in recording_draws(test, rng, draws)
    ]
    rows = np.arange(len(test))
    used = int((test.hazards | test.hazard_free).sum())
    return Transfer(
        trained_on,
        tested_on,
        used,
        _area(score, test, rows),
        _area(loudest, test, rows),
        middle(np.array(gains)),
    )


def _area(score: FloatArray, table: FeatureTable, rows: IndexArray) -> float:
    scored = rows[(table.hazards | table.hazard_free)[rows]]
    area = auroc(score[scored], table.hazards[scored])
    return float("nan") if area is None else area


def _c2st(real: FeatureTable, simulated: FeatureTable, rng: np.random.Generator) -> dict[str, float]:
    """Areas of a boosted classifier on descriptors and normalised shape, real against simulated."""
    folds = [folds_by_recording(table, rng) for table in (real, simulated)]
    inputs = np.concatenate([_c2st_input(table.features) for table in (real, simulated)])
    fold, origin = np.concatenate(folds), np.repeat([0, 1], [len(real), len(simulated)])
    seed = int(rng.integers(2**31))
    score = np.empty(len(origin))
    with threadpool_limits(1):  # a few hundred rows: threads cost more than they save
        for held_out in np.unique(fold):
            test = fold == held_out
            model = HistGradientBoostingClassifier(max_iter=100, random_state=seed)
            score[test] = model.fit(inputs[~test], origin[~test]).predict_proba(inputs[test])[:, 1]
    labels = np.concatenate([real.labels, simulated.labels])
    return {"all": auroc(score, origin) or 0.5} | _c2st_by_class(score, origin, labels)


def _c2st_by_class(score: FloatArray, origin: NDArray[np.int_], labels: TextArray) -> dict[str, float]:
    areas = {name: np.isin(labels, group) for name, group in CLASS_GROUPS.items()}
    found = {name: auroc(score[rows], origin[rows]) for name, rows in areas.items()}
    return {name: area for name, area in found.items() if area is not None}


def _c2st_input(features: FloatArray) -> FloatArray:
    described = describe_windows(features)
    return np.column_stack([described[name] for name in DESCRIPTORS] + [np.log(features)])


def realism_over_seeds(
    real: FeatureTable, simulate: Callable[[int], FeatureTable], seeds: tuple[int, ...] = (1, 2, 3)
) -> dict[int, Realism]:
    """Compare the real windows with those that `simulate` returns for each of several seeds.

    Parameters
    ----------
    real : FeatureTable
        Released windows.
    simulate : callable
        From a seed to windows of the same classes and junctions.
    seeds : tuple of int
        Of the simulation.

    Returns
    -------
    dict of int to Realism
        Medians, transfer both ways and the two-sample test, for each seed.

    Examples
    --------
    >>> def windows(seed):
    ...     rng = np.random.default_rng(seed)
    ...     labels, keys = np.repeat(["left", "none", "right", "front"], 12), np.arange(48).astype(str)
    ...     loud = np.where(labels == "none", 0.1, 0.2)[:, None]
    ...     features = loud * rng.lognormal(0.0, 0.2, (48, 60))
    ...     return FeatureTable(features, labels, keys, np.tile(["SA1", "SB1"], 24), keys, (None,) * 48)
    >>> found = realism_over_seeds(windows(0), windows, seeds=(1,))
    >>> found[1].c2st["all"] < 0.9
    True
    """
    return {seed: compare_windows(real, simulate(seed), np.random.default_rng(seed)) for seed in seeds}
