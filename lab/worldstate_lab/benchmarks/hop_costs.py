"""Processing time of a hop, stage by stage, in the real front-end and evidence, and that of peers.

Every stage is timed in place: its function is wrapped with a clock, so that the chain is not repeated here.
The window model is the shipped one. Trees and guard are random, with the sizes that `worldstate model make`
trains, because their time does not depend on the training. `published_chain` implements the published
acoustic baseline in its amortised form. It computes scipy's STFT of the whole file, channel by channel, and
its time is shared among the hops. For every hop it then computes two segments of half a second by
pyroomacoustics' SRP with thirty azimuths, 50-1500 Hz.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial, wraps
from typing import Any
from unittest.mock import patch

import numpy as np
from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

from worldstate.abduction.road_users import DomainGuard
from worldstate.abduction.sequence.sequence_inputs import INPUTS
from worldstate.abduction.sequence.sequence_model import GROUPS, BoostedTrees, SequenceModel
from worldstate.abduction.sequence.sequence_reader import LEAST_HOPS, SequenceReader
from worldstate.abduction.signature.site_estimate import SiteSignature
from worldstate.adapters import acoustic
from worldstate.adapters.acoustic import AcousticAdapter
from worldstate.adapters.files.model_file import read_model
from worldstate.commissioning.sequence_training import STANDING
from worldstate.frontend import hop_spectra, stream
from worldstate.frontend.approach.tone import ToneStage
from worldstate.frontend.array.microphone_array import MicrophoneArray, roof_array_56
from worldstate.frontend.health.channel_monitor import ChannelMonitor
from worldstate.frontend.hop_spectra import LevelMeter
from worldstate.frontend.spectra.sound_character import MEASURES
from worldstate.frontend.spectra.stft import StreamingStft
from worldstate.frontend.stream import AcousticFrame, FrontEnd
from worldstate.ground.typing import Float32Array

Milliseconds = list[float]
Stages = Mapping[str, tuple[tuple[Any, str], ...]]

RATE_HZ, NFFT = 47_998, 512
FRONT_END: Stages = {
    "stft": ((StreamingStft, "push"),),
    "phat": ((hop_spectra, "power"), (hop_spectra, "whiten")),
    "srp181": ((hop_spectra, "steered_power"), (FrontEnd, "_srp")),
    "feature": ((hop_spectra, "cross_spectra"), (hop_spectra, "pair_sum_of"), (FrontEnd, "_feature")),
    "peaks": ((stream, "find_peaks"),),
    "bands": ((LevelMeter, "push"),),
    "looming": ((FrontEnd, "_looming"),),
    "tone": ((ToneStage, "push"), (ToneStage, "read")),
    "channel_watching": ((ChannelMonitor, "push"),),
}
EVIDENCE: Stages = {
    "window_evidence": ((SiteSignature, "evidence"),),
    "domain_guard": ((DomainGuard, "judge"),),
    "sequence_reader": ((acoustic, "read_hop"),),
}
"""Parts of `evidence`, which also includes the (empty) camera query and the weighting by bearing."""


def elapsed_ms(call: Callable[[], object], clock: Callable[[], float] = time.perf_counter) -> float:
    """Return the duration of `call` in milliseconds, wall time or processor time (`time.process_time`).

    Examples
    --------
    >>> elapsed_ms(lambda: None) < 1000.0
    True
    """
    start = clock()
    call()
    return 1e3 * (clock() - start)


def stage_times(stages: Stages, calls: Sequence[Callable[[], object]]) -> dict[str, Milliseconds]:
    """Return the time of every stage within each call, in milliseconds.

    Examples
    --------
    >>> len(stage_times({"power": ((np, "square"),)}, [lambda: np.square(2.0)] * 3)["power"])
    3
    """
    spent = dict.fromkeys(stages, 0.0)
    times: dict[str, Milliseconds] = {name: [] for name in stages}
    with _clocks(stages, spent):
        for call in calls:
            spent.update(dict.fromkeys(stages, 0.0))
            call()
            for name, ms in spent.items():
                times[name].append(ms)
    return times


@contextmanager
def _clocks(stages: Stages, spent: dict[str, float]) -> Iterator[None]:
    """Make every stage add its milliseconds to `spent`."""
    with ExitStack() as patches:
        for name, functions in stages.items():
            for owner, function in functions:
                clocked = _clocked(getattr(owner, function), name, spent)
                patches.enter_context(patch.object(owner, function, clocked))
        yield


def _clocked(stage: Callable[..., Any], name: str, spent: dict[str, float]) -> Callable[..., Any]:
    @wraps(stage)
    def call(*arguments: Any, **options: Any) -> Any:
        start = time.perf_counter()
        try:
            return stage(*arguments, **options)
        finally:
            spent[name] += 1e3 * (time.perf_counter() - start)

    return call


REPEATS = 9


def published_chain_times(sound: Float32Array, array: MicrophoneArray) -> Milliseconds:
    """Return milliseconds per hop of the published chain on sound of an array, shape (n, M)."""
    import pyroomacoustics
    from scipy.signal import stft

    def transform(part: Float32Array) -> list[Any]:
        return [stft(channel, RATE_HZ, nperseg=NFFT)[2] for channel in part.T]

    shared_ms = 0.1 * elapsed_ms(partial(transform, sound)) * RATE_HZ / len(sound)
    second = np.stack(transform(sound[:RATE_HZ]))
    azimuths = np.radians(np.linspace(-90.0, 90.0, 30))
    peer = pyroomacoustics.doa.SRP(array.positions_m.T, RATE_HZ, NFFT, azimuth=azimuths)
    half = second.shape[2] // 2

    def one_hop() -> None:
        for segment in (second[..., :half], second[..., half : 2 * half]):
            peer.locate_sources(segment, freq_range=[50.0, 1500.0])

    return [elapsed_ms(one_hop) + shared_ms for _ in range(REPEATS)]


_FOREIGN, _SIGNALS = 9, 4
_ROWS, _WINDOWS = 150, 40  # Few rows are enough: the peers' time does not depend on them either


def evidence_times(frames: Sequence[AcousticFrame]) -> dict[str, Milliseconds]:
    """Time the evidence and its parts on every frame, and two peers."""
    # A thread limit applies only to loaded libraries. On a busy machine, two threads would wait for one
    # another at each of 900 small trees, for minutes.
    import sklearn.ensemble  # noqa: F401

    with threadpool_limits(1):
        rng = np.random.default_rng(1)
        trees, rows = _peer_trees(rng), rng.normal(size=(REPEATS, 2, len(INPUTS)))
        whole, interpret = [elapsed_ms(one) for one in _interpreted(frames, rng)], _interpreted(frames, rng)
        times = stage_times(EVIDENCE, interpret) | {"evidence": whole}
        # Before these hops the trees are not evaluated.
        times = {name: spent[LEAST_HOPS:] for name, spent in times.items()}
        classify, window = _peer_classifier(rng).decision_function, frames[-1].feature[None]
        times["scikit_learn_trees"] = [elapsed_ms(partial(trees.predict_proba, two)) for two in rows]
        times["scikit_learn_classifier"] = [elapsed_ms(partial(classify, window)) for _ in rows]
    return times


def _interpreted(frames: Sequence[AcousticFrame], rng: np.random.Generator) -> list[Callable[[], object]]:
    interpret = made_up_adapter(rng).interpret
    return [partial(interpret, frame) for frame in frames]


def made_up_adapter(rng: np.random.Generator) -> AcousticAdapter:
    """Return an adapter with the shipped window model, random trees and a random guard."""
    signature = SiteSignature(read_model().signature)  # type: ignore[arg-type]
    reader = SequenceReader(_sequence(rng))
    return AcousticAdapter(
        roof_array_56(), RATE_HZ, signature, guard=_guard(rng), sequence=reader, uncalibrated=True
    )


# The number of trees is that of a model for a standing ego, and each has the size of its largest tree.
_ROUNDS, _LEAVES = sum(one.rounds for one in STANDING), max(one.leaves for one in STANDING)


def _sequence(rng: np.random.Generator) -> SequenceModel:
    """Grow trees leaf by leaf as in boosting: the deepest path determines the time."""
    # A round has one tree per group.
    trees, nodes = _ROUNDS * len(GROUPS), 2 * _LEAVES - 1
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


def _peer_trees(rng: np.random.Generator) -> Any:
    from sklearn.ensemble import HistGradientBoostingClassifier

    machine = HistGradientBoostingClassifier(
        max_iter=_ROUNDS,
        max_leaf_nodes=_LEAVES,
        min_samples_leaf=2,
        early_stopping=False,
        random_state=0,
    )
    return machine.fit(rng.normal(size=(_ROWS, len(INPUTS))), np.arange(_ROWS) % len(GROUPS))


def _peer_classifier(rng: np.random.Generator) -> Any:
    """Return the published pipeline: standardisation, then linear machines for all pairs."""
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
        # Every hop gets the closer analysis, which is the most expensive case.
        threshold=-1e3,
    )
