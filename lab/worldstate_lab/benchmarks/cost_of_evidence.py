"""What is made of every hop once it was heard, part by part, beside scikit-learn on the same rows.

The window model is the one that ships. Trees and guard are made up, of the sizes that `worldstate model make`
trains: what they cost does not depend on what they have learned.
"""

from collections.abc import Callable, Sequence
from functools import partial
from importlib.util import find_spec
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
from worldstate.ground.typing import Complex64Array, Float32Array, FloatArray

from .cost_of_stages import RATE_HZ
from .stopwatch import Milliseconds, elapsed_ms

NFFT, REPEATS = 512, 9
SRP_BAND_HZ, FEATURE_BAND_HZ = [300.0, 1800.0], [50.0, 1500.0]


def peer_times(
    sound: Float32Array, frames: Complex64Array, sample_rate_hz: int, azimuths_rad: FloatArray
) -> dict[str, Milliseconds]:
    """Return milliseconds per hop of each peer, keys beginning with ``peer_``; empty where none is installed.

    Shapes: sound (n, M), frames (frames, bins, M), azimuths_rad (D,).
    """
    if find_spec("pyroomacoustics") is None:
        return {}
    import pyroomacoustics

    positions = roof_array_56().positions_m.T
    spectra = np.ascontiguousarray(frames.transpose(2, 1, 0))

    def on_a_tenth(method: Any) -> Milliseconds:
        peer = method(positions, sample_rate_hz, NFFT, azimuth=azimuths_rad)
        locate = partial(peer.locate_sources, spectra, freq_range=SRP_BAND_HZ)
        return [elapsed_ms(locate) for _ in range(REPEATS)]

    file_ms, halves_ms, second_ms = _published_chain(sound, sample_rate_hz, pyroomacoustics.doa.SRP)
    shared_ms = 0.1 * file_ms * sample_rate_hz / len(sound)
    return {
        "peer_pyroomacoustics_srp": on_a_tenth(pyroomacoustics.doa.SRP),
        "peer_pyroomacoustics_music": on_a_tenth(pyroomacoustics.doa.MUSIC),
        "peer_published_chain": [ms + shared_ms for ms in halves_ms],
        "peer_published_chain_per_call": [ms + second_ms for ms in halves_ms],
    }


def _published_chain(
    sound: Float32Array, sample_rate_hz: int, method: Any
) -> tuple[float, Milliseconds, float]:
    """Return the STFT of the file, SRP of two half seconds several times, and the STFT of one second."""
    from scipy.signal import stft

    def transform(part: Float32Array) -> list[Any]:
        return [stft(channel, sample_rate_hz, nperseg=NFFT)[2] for channel in part.T]

    file_ms = elapsed_ms(lambda: transform(sound))
    second_ms = elapsed_ms(lambda: transform(sound[:sample_rate_hz]))
    second = np.stack(transform(sound[:sample_rate_hz]))
    azimuths = np.radians(np.linspace(-90.0, 90.0, 30))
    peer = method(roof_array_56().positions_m.T, sample_rate_hz, NFFT, azimuth=azimuths)
    half = second.shape[2] // 2

    def one_hop() -> None:
        for segment in (second[..., :half], second[..., half : 2 * half]):
            peer.locate_sources(segment, freq_range=FEATURE_BAND_HZ)

    return file_ms, [elapsed_ms(one_hop) for _ in range(REPEATS)], second_ms


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
