"""What is made of every hop once it was heard, part by part, beside scikit-learn on the same rows.

The window model is the one that ships. Trees and guard are made up, of the sizes that `worldstate model make`
trains: what they cost does not depend on what they have learned.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, cast

import numpy as np
from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

from worldstate.abduction.sequence.boosted_trees import BoostedTrees
from worldstate.abduction.sequence.sequence_inputs import INPUTS
from worldstate.abduction.sequence.sequence_model import GROUPS, SequenceModel
from worldstate.abduction.sequence.sequence_reader import LEAST_HOPS, SequenceReader
from worldstate.abduction.signature.domain_guard import DomainGuard
from worldstate.abduction.signature.ensemble import EnsembleModel
from worldstate.abduction.signature.site_estimate import SiteSignature
from worldstate.adapters.acoustic import AcousticAdapter
from worldstate.adapters.acoustic_sequence import read_hop
from worldstate.adapters.files.model_file import read_model
from worldstate.frontend.array.microphone_array import roof_array_56
from worldstate.frontend.frame import AcousticFrame
from worldstate.frontend.spectra.sound_character import MEASURES
from worldstate.ground.typing import FloatArray

from .cost_of_peers import REPEATS
from .cost_of_stages import RATE_HZ
from .stopwatch import Milliseconds, elapsed_ms

PARTS = ("window_evidence", "domain_guard", "sequence_reader")
"""Parts of `evidence`, which also asks no camera and weighs the bearing."""
ROUNDS, LEAVES = 60, 8  # A round is a tree for each group
_FOREIGN, _SIGNALS, _CENTRES = 8, 4, 5
_ROWS, _WINDOWS = 150, 40  # Few: the peers' cost does not depend on them either


def evidence_times(frames: Sequence[AcousticFrame]) -> dict[str, Milliseconds]:
    """Time every part of the evidence on every frame, and two peers, keys beginning with ``peer_``."""
    # A limit holds for libraries that are loaded. On a busy machine two threads wait for one another at every
    # one of 900 small trees, for minutes.
    import sklearn.ensemble  # noqa: F401

    with threadpool_limits(1):
        rng = np.random.default_rng(1)
        trees, rows = _peer_trees(rng), rng.normal(size=(REPEATS, 2, len(INPUTS)))
        times = _own_times(frames, _sequence(rng), _guard(rng), rng.normal(size=len(MEASURES)))
        classify, window = _peer_classifier(rng).decision_function, frames[-1].feature[None]
        times["peer_scikit_learn_trees"] = [elapsed_ms(partial(trees.predict_proba, two)) for two in rows]
        times["peer_scikit_learn_classifier"] = [elapsed_ms(partial(classify, window)) for _ in rows]
    return times


def _own_times(
    frames: Sequence[AcousticFrame], sequence: SequenceModel, guard: DomainGuard, measures: FloatArray
) -> dict[str, Milliseconds]:
    windows = _windows()
    adapter = _adapter(windows, guard, sequence)
    signature, reader = SiteSignature(windows), SequenceReader(sequence)
    times: dict[str, Milliseconds] = {}
    for frame in frames:
        heard = signature.evidence(frame.feature)
        calls: dict[str, Callable[[], object]] = {
            "window_evidence": partial(signature.evidence, frame.feature),
            "domain_guard": partial(guard.judge, measures),
            "sequence_reader": partial(read_hop, reader, heard, frame),
            "evidence": partial(adapter.interpret, frame),
        }
        for name, call in calls.items():
            times.setdefault(name, []).append(elapsed_ms(call))
    # Before, trees are not asked.
    return {name: spent[LEAST_HOPS:] for name, spent in times.items()}


def _windows() -> EnsembleModel:
    return cast(EnsembleModel, read_model().signature)


def _sequence(rng: np.random.Generator) -> SequenceModel:
    """Grow trees leaf by leaf as boosting does: the deepest decides what a walk takes."""
    trees, nodes = ROUNDS * len(GROUPS), 2 * LEAVES - 1
    yes, no = np.tile(np.arange(nodes), (2, trees, 1))
    for tree in range(trees):
        leaves = [0]
        for child in range(1, nodes, 2):
            node = leaves.pop(int(rng.integers(len(leaves))))
            yes[tree, node], no[tree, node] = child, child + 1
            leaves += [child, child + 1]
    split = rng.integers(len(INPUTS), size=yes.shape)
    threshold, value = rng.normal(size=(2, *yes.shape))
    classes = np.arange(trees) % len(GROUPS)
    grown = BoostedTrees(split, threshold, yes, no, value, classes, np.zeros(len(GROUPS)))
    return SequenceModel(grown, np.full(len(GROUPS), 1.0 / len(GROUPS)))


def _adapter(windows: EnsembleModel, guard: DomainGuard, sequence: SequenceModel) -> AcousticAdapter:
    array, signature, reader = roof_array_56(), SiteSignature(windows), SequenceReader(sequence)
    return AcousticAdapter(array, RATE_HZ, signature, guard=guard, sequence=reader, uncalibrated=True)


def _peer_trees(rng: np.random.Generator) -> Any:
    from sklearn.ensemble import HistGradientBoostingClassifier

    machine = HistGradientBoostingClassifier(
        max_iter=ROUNDS, max_leaf_nodes=LEAVES, min_samples_leaf=2, early_stopping=False, random_state=0
    )
    return machine.fit(rng.normal(size=(_ROWS, len(INPUTS))), np.arange(_ROWS) % len(GROUPS))


def _peer_classifier(rng: np.random.Generator) -> Any:
    """Return the published pipeline: standardised, linear machines pair by pair."""
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler
    from sklearn.svm import SVC

    pipeline = make_pipeline(StandardScaler(), SVC(kernel="linear", decision_function_shape="ovo"))
    return pipeline.fit(rng.normal(size=(_WINDOWS, 60)), np.arange(_WINDOWS) % 4)


def _guard(rng: np.random.Generator) -> DomainGuard:
    inputs = len(MEASURES)
    classes = 1 + _FOREIGN + _SIGNALS
    return DomainGuard(
        measures=MEASURES,
        foreign=tuple(f"foreign {i}" for i in range(_FOREIGN)),
        signals=tuple(f"signal {i}" for i in range(_SIGNALS)),
        weights=0.01 * rng.normal(size=(classes, inputs)),
        biases=np.zeros(classes),
        # Everything is looked at more closely, which costs most.
        threshold=-1e3,
        kinds_of_signals=("signal 0",) * _CENTRES,
        centres=rng.normal(size=(_CENTRES, inputs)),
        whitening=np.eye(inputs),
    )
