"""Cost of the acoustic front-end per 0.1-s hop, stage by stage, beside its peers in the same run.

Run: python benchmarks/bench_frontend.py [--json] [--rounds 5]

56 channels, 47,998 Hz, nfft 512, half overlap, synthetic noise; BLAS pinned to one thread. The published
chain is restated in its amortised form: scipy's STFT of the whole file, one channel after the other, its
cost shared among the hops; then for every hop two segments of half a second through pyroomacoustics' SRP,
thirty azimuths, 50-1500 Hz.
"""

import argparse
import json
import time
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pyroomacoustics
import scipy.signal
from threadpoolctl import threadpool_info, threadpool_limits

from worldstate.frontend.array import roof_array_56
from worldstate.frontend.bins import bin_frequencies_hz
from worldstate.frontend.feature import feature_steering, pair_sum, segment_feature
from worldstate.frontend.phat import power, whiten
from worldstate.frontend.srp import normalised, srp_phat, steered_power
from worldstate.frontend.steering import Steering
from worldstate.frontend.stft import StreamingStft
from worldstate.frontend.stream import FrontEnd

RATE, NFFT, SECONDS = 47_998, 512, 6
SRP_BINS, FEATURE_BINS = range(3, 19), range(1, 16)
AZIMUTHS = np.radians(np.arange(-90.0, 91.0))
ARRAY = roof_array_56()

Samples = list[float]


def hop_samples(sound: np.ndarray) -> list[np.ndarray]:
    ends = np.floor(np.arange(SECONDS * 10 + 1) * RATE / 10 + 0.5).astype(int)
    return [sound[a:b] for a, b in pairwise(ends)]


def stage_times(hops: list[np.ndarray]) -> dict[str, Samples]:
    """Milliseconds of every stage for every hop: what `Listener` does, with a clock between."""
    stft = StreamingStft(56, NFFT, range(1, 19))
    beams = Steering.towards(ARRAY, bin_frequencies_hz(SRP_BINS, RATE, NFFT), AZIMUTHS)
    feature_beams = feature_steering(ARRAY, FEATURE_BINS, RATE)
    names = ("stft", "phat", "srp181_new_frames", "srp181_running_second", "feature", "goal")
    times: dict[str, Samples] = {name: [] for name in names}
    powers: list[np.ndarray] = []
    pairs: list[np.ndarray] = []
    for samples in hops:
        marks = [time.perf_counter()]
        spectra = stft.push(samples)
        marks.append(time.perf_counter())
        whitened = whiten(spectra, power(spectra))
        marks.append(time.perf_counter())
        powers = [*powers[-9:], steered_power(whitened[:, 2:18], beams)]
        marks.append(time.perf_counter())
        normalised(np.sum(powers, axis=0), 187, 16, 56)
        marks.append(time.perf_counter())
        pairs = [*pairs[-9:], pair_sum(whitened[:, 0:15], feature_beams)]
        np.concatenate([segment_feature(half, 94, 15, 56) for half in (pairs[:5], pairs[-5:])])
        marks.append(time.perf_counter())
        for name, spent in zip(names, [*np.diff(marks), marks[-1] - marks[0]], strict=True):
            times[name].append(1e3 * spent)
    return times


def whole_times(hops: list[np.ndarray]) -> Samples:
    """Milliseconds of `FrontEnd.process` a hop, everything included (checks, bands, looming, bearing)."""
    front_end = FrontEnd(ARRAY, RATE)
    return [timed(lambda samples=samples: front_end.process(samples)) for samples in hops][11:]


def ours_on_a_tenth(frames: np.ndarray) -> Samples:
    beams = Steering.towards(ARRAY, bin_frequencies_hz(SRP_BINS, RATE, NFFT), AZIMUTHS)
    used = np.ascontiguousarray(frames[:, SRP_BINS.start : SRP_BINS.stop])
    return [timed(lambda: srp_phat(used, beams)) for _ in range(40)]


def peer_on_a_tenth(frames: np.ndarray) -> Samples:
    peer = pyroomacoustics.doa.SRP(ARRAY.positions_m.T, RATE, NFFT, azimuth=AZIMUTHS)
    spectra = np.ascontiguousarray(frames.transpose(2, 1, 0))
    return [timed(lambda: peer.locate_sources(spectra, freq_range=[300.0, 1800.0])) for _ in range(9)]


def published_chain(sound: np.ndarray) -> Samples:
    """Milliseconds per hop of the published chain, the file's STFT computed once."""
    stft_ms = timed(lambda: [scipy.signal.stft(channel, RATE, nperseg=NFFT) for channel in sound.T])
    second = np.stack([scipy.signal.stft(channel, RATE, nperseg=NFFT)[2] for channel in sound[:RATE].T])
    peer = pyroomacoustics.doa.SRP(
        ARRAY.positions_m.T, RATE, NFFT, azimuth=np.radians(np.linspace(-90, 90, 30))
    )
    half = second.shape[2] // 2

    def hop() -> None:
        for segment in (second[..., :half], second[..., half : 2 * half]):
            peer.locate_sources(segment, freq_range=[50.0, 1500.0])

    return [timed(hop) + stft_ms / (SECONDS * 10) for _ in range(9)]


def timed(call: Callable[[], object]) -> float:
    start = time.perf_counter()
    call()
    return 1e3 * (time.perf_counter() - start)


def one_round(sound: np.ndarray) -> dict[str, Samples]:
    hops = hop_samples(sound)
    frames = StreamingStft(56, NFFT, range(257)).push(sound[:5000])[:19]
    rounds = {name: spent[11:] for name, spent in stage_times(hops).items()}
    rounds["front_end_process"] = whole_times(hops)
    rounds["ours_srp181_tenth"] = ours_on_a_tenth(frames)
    rounds["pyroomacoustics_srp181_tenth"] = peer_on_a_tenth(frames)
    rounds["published_chain"] = published_chain(sound)
    return rounds


def report(rounds: list[dict[str, Samples]]) -> dict[str, object]:
    medians = {name: float(np.median([np.median(r[name]) for r in rounds])) for name in rounds[0]}
    p99 = {name: float(np.median([np.percentile(r[name], 99) for r in rounds])) for name in rounds[0]}
    ours = medians["stft"] + medians["phat"] + medians["feature"]
    return {
        "blas": [f"{i['internal_api']} {i['version']} {i['architecture']}" for i in threadpool_info()],
        "threads": [i["num_threads"] for i in threadpool_info()],
        "rounds": len(rounds),
        "median_ms": medians,
        "p99_ms": p99,
        "ratios": {
            "published_chain": medians["published_chain"] / ours,
            "pyroomacoustics_srp": medians["pyroomacoustics_srp181_tenth"] / medians["ours_srp181_tenth"],
        },
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--rounds", type=int, default=5, help="the median of so many runs is reported")
    options = parser.parse_args()
    sound = np.random.default_rng(0).standard_normal((SECONDS * RATE, 56), dtype=np.float32)
    with threadpool_limits(1):
        result = report([one_round(sound) for _ in range(options.rounds)])
    if options.json:
        print(json.dumps(result, indent=2))
        return
    print(
        f"BLAS {result['blas']}, threads {result['threads']}, median of {result['rounds']} runs, ms per hop"
    )
    for name, median in result["median_ms"].items():
        print(f"  {name:32s} {median:8.3f}   p99 {result['p99_ms'][name]:8.3f}")
    for name, ratio in result["ratios"].items():
        print(f"  ratio {name:26s} {ratio:8.1f}")


if __name__ == "__main__":
    main()
