"""Cost of the acoustic front-end per 0.1-s hop, stage by stage, beside its peers in the same run.

56 channels, 47,998 Hz, nfft 512, half overlap, synthetic noise, BLAS pinned to one thread. Milliseconds are
the median over rounds of the median (and 99th percentile) over hops.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_info, threadpool_limits  # type: ignore[import-untyped]

from worldstate.evaluation.bench_peers import peer_times
from worldstate.evaluation.stopwatch import Milliseconds, elapsed_ms, marks_to_ms, now
from worldstate.frontend.array import roof_array_56
from worldstate.frontend.bins import bin_frequencies_hz
from worldstate.frontend.feature import feature_steering, pair_sum, segment_feature
from worldstate.frontend.phat import power, whiten
from worldstate.frontend.settings import FrontEndSettings
from worldstate.frontend.srp import normalised, srp_phat, steered_power
from worldstate.frontend.steering import Steering
from worldstate.frontend.stft import StreamingStft
from worldstate.frontend.stream import FrontEnd
from worldstate.frontend.tone import estimate_tone

RATE_HZ, NFFT, SECONDS = 47_998, 512, 6
SRP_BINS, FEATURE_BINS = range(3, 19), range(1, 16)
AZIMUTHS_RAD = np.radians(np.arange(-90.0, 91.0))
WARM_UP_HOPS = 11
STAGES = ("stft", "phat", "srp181_new_frames", "srp181_running_second", "feature")

Samples = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class BenchReport:
    """What `run_bench` measured; all times in milliseconds per 0.1-s hop.

    Parameters
    ----------
    blas : tuple of str
        Kernel and version of every BLAS in the process.
    threads : int
        Threads that BLAS was pinned to.
    rounds : int
        Rounds that medians were taken over.
    stages : mapping of str to (float, float)
        Median and 99th percentile of each stage of the goal, and of the whole front-end.
    total_ms, p99_ms : float
        STFT, phase transform, SRP181 of new frames and running second, and published feature together.
    peers : mapping of str to float
        Median of each peer that is installed; empty where none is.
    ratios : mapping of str to float
        Cost of the peer over ours on the same work: `published_chain`, `pyroomacoustics_srp`, and
        `pyroomacoustics_music` where they were measured.
    """

    blas: tuple[str, ...]
    threads: int
    rounds: int
    stages: Mapping[str, tuple[float, float]]
    total_ms: float
    p99_ms: float
    peers: Mapping[str, float]
    ratios: Mapping[str, float]

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-able values."""
        stages = {name: {"median_ms": median, "p99_ms": p99} for name, (median, p99) in self.stages.items()}
        return {
            "blas": list(self.blas),
            "threads": self.threads,
            "rounds": self.rounds,
            "stages": stages,
            "total_ms": self.total_ms,
            "p99_ms": self.p99_ms,
            "peers": dict(self.peers),
            "ratios": dict(self.ratios),
        }


def run_bench(rounds: int = 5, on_round: Callable[[], None] = lambda: None) -> BenchReport:
    """Measure the front-end and the peers that are installed, in turn, `rounds` times.

    Parameters
    ----------
    rounds : int
        At least one; medians are taken over them.
    on_round : callable
        Called after each round, for progress.
    """
    sound = np.random.default_rng(0).standard_normal((SECONDS * RATE_HZ, 56), dtype=np.float32)
    runs: list[Mapping[str, Milliseconds]] = []
    with threadpool_limits(1):
        kernels = tuple(_kernel(info) for info in threadpool_info())
        for _ in range(rounds):
            runs.append(_one_round(sound))
            on_round()
    return _report(runs, kernels)


def _kernel(info: Mapping[str, Any]) -> str:
    return " ".join(str(info.get(key) or "-") for key in ("internal_api", "version", "architecture"))


def _one_round(sound: Samples) -> Mapping[str, Milliseconds]:
    ends = np.floor(np.arange(SECONDS * 10 + 1) * RATE_HZ / 10 + 0.5).astype(int)
    hops = [sound[a:b] for a, b in pairwise(ends)]
    frames = StreamingStft(56, NFFT, range(NFFT // 2 + 1)).push(sound[:5000])[:19]
    everything = FrontEndSettings(music_sources=1)
    ours = {name: times[WARM_UP_HOPS:] for name, times in _stage_times(hops).items()}
    ours["front_end"] = _front_end_times(hops, FrontEndSettings())
    ours["front_end_with_music_and_tone"] = _front_end_times(hops, everything, tone=True)
    ours["srp181_on_a_tenth"] = _srp_on_a_tenth(frames)
    return ours | peer_times(sound, frames, RATE_HZ, AZIMUTHS_RAD)


def _stage_times(hops: list[Samples]) -> dict[str, Milliseconds]:
    """Time what the front-end does for every hop, with a clock between."""
    stft = StreamingStft(56, NFFT, range(1, 19))
    beams = Steering.towards(roof_array_56(), bin_frequencies_hz(SRP_BINS, RATE_HZ, NFFT), AZIMUTHS_RAD)
    feature_beams = feature_steering(roof_array_56(), FEATURE_BINS, RATE_HZ)
    times: dict[str, Milliseconds] = {name: [] for name in (*STAGES, "goal")}
    powers: list[NDArray[Any]] = []
    pairs: list[NDArray[Any]] = []
    for samples in hops:
        marks = [now()]
        spectra = stft.push(samples)
        marks.append(now())
        whitened = whiten(spectra, power(spectra))
        marks.append(now())
        powers = [*powers[-9:], steered_power(whitened[:, 2:18], beams)]
        marks.append(now())
        normalised(np.sum(powers, axis=0), 187, len(SRP_BINS), 56)
        marks.append(now())
        pairs = [*pairs[-9:], pair_sum(whitened[:, 0:15], feature_beams)]
        np.concatenate([segment_feature(half, 94, 15, 56) for half in (pairs[:5], pairs[-5:])])
        marks.append(now())
        for name, spent_ms in zip(times, [*marks_to_ms(marks), sum(marks_to_ms(marks))], strict=True):
            times[name].append(spent_ms)
    return times


def _front_end_times(hops: list[Samples], settings: FrontEndSettings, tone: bool = False) -> Milliseconds:
    """Time `FrontEnd.process`, everything included: checks, channel health, bands, looming, bearing."""
    front_end = FrontEnd(roof_array_56(), RATE_HZ, settings)
    second = np.concatenate([samples[:, 0] for samples in hops[:10]])

    def one_hop(samples: Samples) -> None:
        front_end.process(samples)
        if tone:
            estimate_tone(second, RATE_HZ, low_hz=20.0, high_hz=400.0)

    return [elapsed_ms(partial(one_hop, samples)) for samples in hops][WARM_UP_HOPS:]


def _srp_on_a_tenth(frames: NDArray[np.complex64]) -> Milliseconds:
    beams = Steering.towards(roof_array_56(), bin_frequencies_hz(SRP_BINS, RATE_HZ, NFFT), AZIMUTHS_RAD)
    used = np.ascontiguousarray(frames[:, SRP_BINS.start : SRP_BINS.stop])
    return [elapsed_ms(lambda: srp_phat(used, beams)) for _ in range(40)]


def _report(runs: list[Mapping[str, Milliseconds]], kernels: tuple[str, ...]) -> BenchReport:
    medians = {name: float(np.median([np.median(run[name]) for run in runs])) for name in runs[0]}
    p99 = {name: float(np.median([np.percentile(run[name], 99) for run in runs])) for name in runs[0]}
    ours = {name for name in medians if not name.startswith("peer_")}
    peers = {name.removeprefix("peer_"): ms for name, ms in medians.items() if name not in ours}
    chain_ms = medians["stft"] + medians["phat"] + medians["feature"]
    work_ms = {"published_chain": chain_ms, "pyroomacoustics_srp": medians["srp181_on_a_tenth"]}
    return BenchReport(
        blas=kernels,
        threads=1,
        rounds=len(runs),
        stages={name: (medians[name], p99[name]) for name in medians if name in ours and name != "goal"},
        total_ms=medians["goal"],
        p99_ms=p99["goal"],
        peers=peers,
        ratios={name: peers[name] / ms for name, ms in work_ms.items() if name in peers},
    )
