"""What is computed for every hop, part by part, with a clock between: front-end, evidence, and their peers.

The window model is the one that ships. Trees and guard are made up, of the sizes that `worldstate model make`
trains: what they cost does not depend on what they have learned. `published_chain` restates the chain of the
published acoustic baseline in its amortised form: scipy's STFT of the whole file, channel by channel, its
cost shared among the hops; then for every hop two segments of half a second through pyroomacoustics' SRP,
thirty azimuths, 50-1500 Hz. `published_chain_per_call` is the same where the sound comes as a stream, so that
every hop transforms its own second.
"""

import time
from collections.abc import Callable, Sequence
from functools import partial
from importlib.util import find_spec
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

from worldstate.abduction.sequence.sequence_inputs import INPUTS
from worldstate.abduction.sequence.sequence_model import GROUPS, BoostedTrees, SequenceModel
from worldstate.abduction.sequence.sequence_reader import LEAST_HOPS, SequenceReader
from worldstate.abduction.signature.domain_guard import DomainGuard
from worldstate.abduction.signature.ensemble import EnsembleModel
from worldstate.abduction.signature.site_estimate import SiteSignature
from worldstate.adapters.acoustic import AcousticAdapter
from worldstate.adapters.acoustic_sequence import read_hop
from worldstate.adapters.files.model_file import read_model
from worldstate.frontend.approach.looming import looming
from worldstate.frontend.approach.tone import ENGINE_BAND_HZ, ToneStage
from worldstate.frontend.array.microphone_array import ChannelMask, roof_array_56
from worldstate.frontend.array.steering import Steering, cross_spectra
from worldstate.frontend.direction.bearing import find_peaks
from worldstate.frontend.direction.feature import feature_steering, pair_sum_of, segment_feature
from worldstate.frontend.direction.music import MusicStage
from worldstate.frontend.direction.srp import normalised, steered_power
from worldstate.frontend.frame import AcousticFrame
from worldstate.frontend.health.channel_monitor import ChannelMonitor
from worldstate.frontend.levels import LevelMeter
from worldstate.frontend.settings import FrontEndSettings
from worldstate.frontend.spectra.sound_character import MEASURES
from worldstate.frontend.spectra.stft import StreamingStft, bin_frequencies_hz, power, whiten
from worldstate.ground.typing import Complex64Array, Float32Array, FloatArray

Milliseconds = list[float]


def elapsed_ms(call: Callable[[], object], clock: Callable[[], float] = time.perf_counter) -> float:
    """Return how long `call` took, milliseconds: by the wall, or by the processor (`time.process_time`).

    Examples
    --------
    >>> elapsed_ms(lambda: None) < 1000.0
    True
    """
    start = clock()
    call()
    return 1e3 * (clock() - start)


RATE_HZ, NFFT = 47_998, 512
SRP_BINS, FEATURE_BINS = range(3, 19), range(1, 16)
AZIMUTHS_RAD = np.radians(np.arange(-90.0, 91.0))
GOAL = ("stft", "phat", "srp181_new_frames", "srp181_running_second", "feature")
"""Stages of the first goal, in milliseconds."""
MORE = ("peaks", "bands", "looming", "tone", "music", "channel_watching")
"""Stages that `everything` adds to them."""


def srp_beams() -> Steering:
    """Beams of the search grid, 300-1800 Hz.

    Examples
    --------
    >>> srp_beams().n_directions
    181
    """
    return Steering.towards(roof_array_56(), bin_frequencies_hz(SRP_BINS, RATE_HZ, NFFT), AZIMUTHS_RAD)


def stage_times(hops: list[Float32Array]) -> dict[str, Milliseconds]:
    """Time every stage on every hop, in turn, as the stream does them.

    Shapes: hops (n, 56).
    """
    stages = _Stages()
    times: dict[str, Milliseconds] = {name: [] for name in (*GOAL, *MORE, "goal")}
    for samples in hops:
        for name, stage in stages.of(samples):
            times[name].append(elapsed_ms(stage))
        times["goal"].append(sum(times[name][-1] for name in GOAL))
    return times


class _Stages:
    """The state of every stage, and what one hands to the next."""

    def __init__(self) -> None:
        array, everyone = roof_array_56(), ChannelMask.all_of(56)
        self._mask = everyone
        self._stft = StreamingStft(56, NFFT, range(1, 19))
        self._beams, self._feature_beams = srp_beams(), feature_steering(array, FEATURE_BINS, RATE_HZ)
        self._meter = LevelMeter(56, RATE_HZ, FrontEndSettings())
        self._tone = ToneStage(array, RATE_HZ, ENGINE_BAND_HZ)
        self._music = MusicStage([self._beams], AZIMUTHS_RAD, 1, 56, window_hops=10)
        self._monitor = ChannelMonitor(array, bin_frequencies_hz(FEATURE_BINS, RATE_HZ, NFFT), RATE_HZ)
        self._powers: list[NDArray[Any]] = []
        self._pairs: list[NDArray[Any]] = []
        self._energies: list[NDArray[Any]] = []

    def of(self, samples: Float32Array) -> list[tuple[str, Callable[[], object]]]:
        """Return the stages of one hop, to be called in this order."""
        return [
            ("stft", partial(self._transform, samples)),
            ("phat", self._whiten),
            ("srp181_new_frames", self._steer),
            ("srp181_running_second", self._sum),
            ("feature", self._feature),
            ("peaks", lambda: find_peaks(self._srp, AZIMUTHS_RAD)),
            ("bands", lambda: self._meter.push(samples)),
            ("looming", self._loom),
            ("tone", partial(self._fit_tone, samples)),
            ("music", self._score),
            ("channel_watching", partial(self._watch, samples)),
        ]

    def _transform(self, samples: Float32Array) -> None:
        self._spectra = self._stft.push(samples)

    def _whiten(self) -> None:
        self._power = power(self._spectra)
        self._whitened = whiten(self._spectra, self._power)

    def _steer(self) -> None:
        self._powers = [*self._powers[-9:], steered_power(self._whitened[:, 2:18], self._beams)]

    def _sum(self) -> None:
        self._srp = normalised(np.sum(self._powers, axis=0), 187, len(SRP_BINS), 56)

    def _feature(self) -> None:
        self._matrices = cross_spectra(self._whitened[:, 0:15].transpose(1, 0, 2))
        self._pairs = [*self._pairs[-9:], pair_sum_of(self._matrices, self._feature_beams)]
        halves = self._pairs[:5], self._pairs[-5:]
        np.concatenate([segment_feature(half, 94, len(FEATURE_BINS), 56) for half in halves])

    def _loom(self) -> None:
        self._energies = [*self._energies[-9:], self._power[:, 2:18].sum(axis=1, dtype=np.float64)]
        means = np.array([energies.mean() for energies in self._energies])
        if len(means) == 10:
            looming(np.arange(-0.95, 0.0, 0.1), np.log(means), floor_std=0.08)

    def _fit_tone(self, samples: Float32Array) -> None:
        self._tone.push(samples, self._mask)
        self._tone.read()

    def _score(self) -> None:
        self._music.push(self._spectra[:, 2:18])
        self._music.read(self._mask)

    def _watch(self, samples: Float32Array) -> None:
        self._monitor.push(samples, self._energies[-1], self._power, self._matrices)


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
