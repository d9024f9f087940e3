"""Two-sample tests: how well a classifier, or one measure alone, tells two sets of windows apart."""

import numpy as np
from numpy.typing import NDArray
from sklearn.ensemble import HistGradientBoostingClassifier
from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

from worldstate.adapters.datasets.feature_table import FeatureTable
from worldstate.ground.typing import FloatArray
from worldstate.operations.metrics.roc import auroc
from worldstate.operations.training.folds import folds_by_recording

from .measures import CLASS_GROUPS, DESCRIPTORS, MEASURES, describe_windows, of_class
from .set_figures import FigureKey


def two_sample_areas(one: FeatureTable, other: FeatureTable, rng: np.random.Generator) -> dict[str, float]:
    """Return the areas of a boosted classifier on descriptors and log features, for all and by class."""
    # By recording: the hidden and the front window of one vehicle are alike.
    folds = [folds_by_recording(table, rng) for table in (one, other)]
    inputs = np.concatenate([_inputs(table.features) for table in (one, other)])
    fold, origin = np.concatenate(folds), np.repeat([0, 1], [len(one), len(other)])
    seed = int(rng.integers(2**31))
    score = np.empty(len(origin))
    with threadpool_limits(1):  # a few hundred rows: threads cost more than they save
        for held_out in np.unique(fold):
            test = fold == held_out
            # A linear classifier finds less (.79 for .92). Fewer iterations would do, but figures of earlier
            # streets were measured with these.
            model = HistGradientBoostingClassifier(max_iter=100, random_state=seed)
            score[test] = model.fit(inputs[~test], origin[~test]).predict_proba(inputs[test])[:, 1]
    return {"all": auroc(score, origin) or 0.5} | _by_class(score, origin, one, other)


def _by_class(
    score: FloatArray, origin: NDArray[np.int_], one: FeatureTable, other: FeatureTable
) -> dict[str, float]:
    rows = {name: np.concatenate([of_class(t, name) for t in (one, other)]) for name in CLASS_GROUPS}
    found = {name: auroc(score[chosen], origin[chosen]) for name, chosen in rows.items()}
    return {name: area for name, area in found.items() if area is not None}


def _inputs(features: FloatArray) -> FloatArray:
    described = describe_windows(features)
    return np.column_stack([described[name] for name in DESCRIPTORS] + [np.log(features)])


def measure_areas(one: FeatureTable, other: FeatureTable) -> dict[FigureKey, float]:
    r"""Return how well each measure alone tells the sets apart, whichever way: max(a, 1 - a), by class.

    Examples
    --------
    >>> words = np.array(["none", "none"])
    >>> quiet = FeatureTable(np.ones((2, 60)), words, words, words, words, (None, None))
    >>> loud = FeatureTable(3.0 * quiet.features, words, words, words, words, (None, None))
    >>> areas = measure_areas(quiet, loud)
    >>> areas["level", "none"], areas["prominence", "none"]
    (1.0, 0.5)
    """
    areas: dict[FigureKey, float] = {}
    for windows in CLASS_GROUPS:
        chosen = [table.features[of_class(table, windows)] for table in (one, other)]
        if min(map(len, chosen)):
            first, second = map(describe_windows, chosen)
            origin = np.repeat([False, True], list(map(len, chosen)))
            for name in MEASURES:
                area = auroc(np.concatenate([first[name], second[name]]), origin) or 0.0
                areas[name, windows] = max(area, 1.0 - area)
    return areas
