"""Training of a sequence model on streams: boosted trees from scikit-learn, stored as arrays."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

from worldstate.abduction.sequence.sequence_inputs import SIDES
from worldstate.abduction.sequence.sequence_model import (
    COMING_S,
    GROUPS,
    LONGEST_S,
    BoostedTrees,
    SequenceModel,
    SequencePosterior,
)
from worldstate.ground.errors import WorldstateError
from worldstate.ground.typing import BoolArray, FloatArray, IndexArray
from worldstate.ground.values import significant

from .heard_stream import ROW_S, HeardStream

# Hardly audible before they are visible: "hidden" and "empty" would both be wrong labels for their windows.
SILENT_KINDS = ("bicycle", "scooter")
# Electric cars are used for training, but their tyres are audible later than engines, so an exam reports
# these kinds separately.
QUIET_KINDS = (*SILENT_KINDS, "electric")
# Below this level a vehicle is inaudible in the background of a simulated street, about 50 dB at the array; a
# stream with another background shifts the level accordingly.
AUDIBLE_DB = 48.0
OTHER_SIDE_S = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class StreamTruth:
    """Vehicles at every hop of a stream; sides are left and right."""

    coming_s: FloatArray  # shape (n, 2): Seconds until the next vehicle comes into view, infinite without one
    seen: BoolArray  # shape (n,): Whether any vehicle is in view
    past_db: FloatArray  # shape (n, 2): Level of the loudest vehicle that has left the view to this side
    far_db: FloatArray  # shape (n, 2): Level of the loudest that never comes into view, or has not yet
    far_rises: BoolArray  # shape (n, 2): Whether that vehicle becomes louder
    audible_db: float = AUDIBLE_DB

    def groups(self) -> IndexArray:
        """Return the group number of every hop and side, shape (n, 2)."""
        nearest = np.searchsorted(COMING_S, self.coming_s, side="left")
        coming = self.coming_s <= COMING_S[-1]
        # In order of precedence: a vehicle that comes has precedence over one in view.
        conditions = {
            "seen": np.broadcast_to(self.seen[:, None], coming.shape),
            "other": self.coming_s[:, ::-1] <= OTHER_SIDE_S,
            "past": self.past_db >= np.maximum(self.far_db, self.audible_db),
            "rising": (self.far_db >= self.audible_db) & self.far_rises,
            "falling": self.far_db >= self.audible_db,
        }
        numbers = [GROUPS.index(name) for name in conditions]
        rest = np.select(list(conditions.values()), numbers, GROUPS.index("none"))
        return np.where(coming, nearest, rest)


def stream_truth(heard: HeardStream) -> StreamTruth:
    """Combine the rows of all vehicles at the hops of a stream."""
    time_s, n = heard.hops.time_s, len(heard.hops)
    coming_s = np.full((n, len(SIDES)), np.inf)
    past_db, far_db = np.full((2, n, len(SIDES)), -np.inf)
    rises, seen = np.zeros((n, len(SIDES)), bool), np.zeros(n, bool)
    vehicles, rows = heard.vehicles, heard.rows
    hop_of, inside = heard.row_hops()
    for i, number in enumerate(vehicles.vehicle):
        mine = inside & (rows.vehicle == number)
        hop, loudness = hop_of[mine], rows.loudness_db[mine]
        if not hop.size:
            continue
        arm, entry_s = SIDES.index(vehicles.arm[i]), vehicles.entry_s[i]
        louder = np.diff(loudness, prepend=loudness[0]) > 0
        before, in_view = ~(time_s[hop] > entry_s + ROW_S / 100), rows.in_view[mine]
        seen[hop[in_view]] = True
        if vehicles.hazard[i]:
            left_s = entry_s - time_s[hop[before]]
            coming_s[hop[before], arm] = np.minimum(coming_s[hop[before], arm], left_s)
        gone = ~in_view & ~before
        into = (rows.y_m[mine][gone] < 0.0).astype(np.intp)
        np.maximum.at(past_db, (hop[gone], into), loudness[gone])
        elsewhere = ~in_view & before
        at = hop[elsewhere]
        wins = loudness[elsewhere] > far_db[at, arm]
        far_db[at[wins], arm], rises[at[wins], arm] = loudness[elsewhere][wins], louder[elsewhere][wins]
    audible_db = AUDIBLE_DB + heard.hops.about.get("background_db", 0.0)
    return StreamTruth(coming_s, seen, past_db, far_db, rises, audible_db)


# Few and shallow trees with a third of the inputs each, because deep trees overfit to their renderer. Of 324
# approaches in streets of the first renderer, outside the training, 100 rounds of 4 leaves at a rate of 0.1
# detect 70 % at 30 onsets per hour; 270 rounds of 16 leaves at 0.2 detect 54 %.
RIDGE, INPUTS_EACH = 20.0, 0.3
# Interval of the hops for training, and smallest number of hops in a leaf. Neighbours share most of their
# sound, and the training time grows with the rows. Trained on half of ten junctions and tested on the others,
# both ways, the log-loss with every third, fifth and eighth hop, and leaves of the same duration, is 1.43,
# 1.40, 1.38 and 1.60, 1.57, 1.59.
EVERY_HOPS, SMALLEST_LEAF = 5, 180
COVERAGE = 0.9
_FIGURES = 7  # Significant figures, which halve the length of the file; no input is more precise


@dataclass(frozen=True, slots=True)
class Growth:
    """Number of trees per group, their size, and their learning rate."""

    rounds: int
    leaves: int
    rate: float


# Scores of several sizes are averaged.
STANDING = (Growth(100, 4, 0.1), Growth(150, 8, 0.1))
MOVING = (Growth(120, 8, 0.2),)


@dataclass(frozen=True, slots=True, eq=False)
class LabelledStream:
    """Training hops of one stream, with evidence from a window model not trained on this stream."""

    inputs: FloatArray  # shape (n, 2, inputs)
    groups: IndexArray  # shape (n, 2)
    weight: float = 1.0  # Weight of each hop

    @classmethod
    def of(cls, inputs: FloatArray, truth: StreamTruth, weight: float = 1.0) -> "LabelledStream":
        """Return one in `EVERY_HOPS` hops of a stream."""
        return cls(inputs[::EVERY_HOPS], truth.groups()[::EVERY_HOPS], weight)


def train_sequence(
    streams: Sequence[LabelledStream],
    seed: int,
    sizes: Sequence[Growth] = STANDING,
    threads: int | None = None,
) -> SequenceModel:
    """Train on the hops of streams, weighted so that hazards are as frequent as in use."""
    from sklearn.ensemble import HistGradientBoostingClassifier

    inputs = np.concatenate([one.inputs.reshape(-1, one.inputs.shape[-1]) for one in streams])
    groups = np.concatenate([one.groups.reshape(-1) for one in streams])
    weights = np.repeat([one.weight for one in streams], [one.groups.size for one in streams])
    # A few minutes have too few hops for such leaves.
    leaf = min(SMALLEST_LEAF, max(len(inputs) // 100, 1))
    machines = [
        HistGradientBoostingClassifier(
            max_iter=growth.rounds,
            max_leaf_nodes=growth.leaves,
            learning_rate=growth.rate,
            l2_regularization=RIDGE,
            max_features=INPUTS_EACH,
            min_samples_leaf=leaf,
            early_stopping=False,
            random_state=seed,
        )
        for growth in sizes
    ]
    # Each of several parallel processes has one core.
    with threadpool_limits(threads):
        for machine in machines:
            machine.fit(inputs, groups, sample_weight=weights)
    share = np.bincount(groups, weights, len(GROUPS)) / weights.sum()
    trees = exported(machines, inputs[:: max(len(inputs) // 100, 1)])
    return SequenceModel(trees, np.maximum(share, 1e-6))


def exported(machines: Sequence[Any], check: FloatArray) -> BoostedTrees:
    """Return the trees of classifiers with averaged scores, checked on some rows."""
    # scikit-learn has no public access to its histogram trees, so a change there must be detected here.
    rounds = [round_ for machine in machines for round_ in machine._predictors]
    found = [(k, one.nodes) for round_ in rounds for k, one in enumerate(round_)]
    classes = machines[0].classes_.astype(np.intp)
    grid = len(found), max(len(nodes) for _, nodes in found)
    here = np.broadcast_to(np.arange(grid[1]), grid)
    split, yes, no = np.zeros(grid, np.intp), here.copy(), here.copy()
    threshold, value = np.zeros(grid), np.zeros(grid)
    for row, (_, nodes) in enumerate(found):
        inner = ~nodes["is_leaf"].astype(bool)
        at = np.flatnonzero(inner)
        split[row, at], threshold[row, at] = nodes["feature_idx"][at], nodes["num_threshold"][at]
        yes[row, at], no[row, at] = nodes["left"][at], nodes["right"][at]
        value[row, : len(nodes)] = np.where(inner, 0.0, nodes["value"] / len(machines))
    # Groups without hops get a probability near zero.
    baseline = np.full(len(GROUPS), -30.0)
    baseline[classes] = np.mean([np.ravel(one._baseline_prediction) for one in machines], axis=0)
    trees = BoostedTrees(split, threshold, yes, no, value, classes[[k for k, _ in found]], baseline)
    own = np.mean([one.decision_function(check) for one in machines], axis=0)
    if not np.allclose(trees.scores(check)[:, classes], own, atol=1e-6):
        raise WorldstateError("trees not exported: this scikit-learn stores them differently from 1.5 to 1.9")
    threshold, value = (significant(one, _FIGURES) for one in (trees.threshold, trees.value))
    return replace(trees, threshold=threshold, value=value)


def calibrated_margin_s(said: Sequence[tuple[SequencePosterior, StreamTruth]]) -> float:
    """Return how far intervals of the time to visible must be widened, from streams outside the training.

    Source: Y. Romano, E. Patterson and E. Candes, "Conformalized quantile regression", NeurIPS 2019.
    """
    misses = []
    for posterior, truth in said:
        times, coming = posterior.time_to_visible_s(), truth.coming_s <= LONGEST_S
        true = truth.coming_s[coming]
        misses.append(np.maximum(times[coming][:, 0] - true, true - times[coming][:, 2]))
    every = np.concatenate(misses)
    return float(np.quantile(every, min(COVERAGE * (1.0 + 1.0 / every.size), 1.0)))
