"""Cost of ego-noise cancellation per 0.1-s hop, beside the transform it follows.

Run: python benchmarks/bench_ego_noise.py [--json] [--rounds 5]

56 channels, 47,998 Hz, nfft 512, half overlap, SRP bins only; BLAS pinned to one thread. What is timed is
the processor time of `EgoNoise.process` less the phase transform that it replaces, in three states: gate
open, gate shut after learning, and gate open with an engine whose lines are cancelled. `ego_noise_times` is
for other benchmarks to call.
"""

import argparse
import json
import time
from collections.abc import Callable

import numpy as np
from threadpoolctl import threadpool_limits

from worldstate.frontend.array import roof_array_56
from worldstate.frontend.bins import bin_frequencies_hz
from worldstate.frontend.ego_noise import EgoNoise, EgoNoiseSettings
from worldstate.frontend.harmonic_cancellation import HarmonicCanceller
from worldstate.frontend.phat import whiten
from worldstate.frontend.steering import Steering
from worldstate.frontend.stft import StreamingStft

RATE, NFFT, HOPS, WARM_UP = 47_998, 512, 80, 20
BINS, SRP = range(1, 19), slice(2, 18)


def ego_noise_times(hops: int = HOPS, seed: int = 0) -> dict[str, list[float]]:
    """Milliseconds of processor time per hop: the transform, and what each state of cancelling adds."""
    sound = np.random.default_rng(seed).standard_normal((4800, 56), dtype=np.float32)
    stft = StreamingStft(56, NFFT, BINS)
    stft.push(sound)
    spectra = [stft.push(np.roll(sound, 977 * k, axis=0)) for k in range(hops)]
    times = {"stft": [_spent(lambda: stft.push(sound)) for _ in spectra]}
    plain = [_spent(lambda heard=heard: whiten(heard[:, SRP])) for heard in spectra]
    for name, engine, shut in (("learning", False, False), ("shut", False, True), ("engine", True, False)):
        ego = _ego_noise(engine)
        spent = []
        for k, heard in enumerate(spectra):
            if shut and k == WARM_UP // 2:
                ego.weight = 0.0
            spent.append(_spent(lambda heard=heard, ego=ego: ego.process(heard)))
        times[f"ego_noise_{name}"] = [a - b for a, b in zip(spent, plain, strict=True)]
    return {name: spent[WARM_UP:] for name, spent in times.items()}


def _ego_noise(engine: bool) -> EgoNoise:
    array = roof_array_56()
    frequencies = bin_frequencies_hz(BINS, RATE, NFFT)[SRP]
    beams = Steering.towards(array, frequencies, np.radians(np.arange(-90.0, 91.0)))
    canceller = HarmonicCanceller(BINS, RATE, NFFT)
    if engine:
        canceller.follow(50.0)
    ego = EgoNoise(EgoNoiseSettings(), 2.0 * RATE / NFFT, 56, [(beams, SRP)], canceller)
    ego.weight = 1.0
    return ego


def _spent(call: Callable[[], object]) -> float:
    start = time.process_time()
    call()
    return 1e3 * (time.process_time() - start)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--rounds", type=int, default=5, help="the median of so many runs is reported")
    options = parser.parse_args()
    with threadpool_limits(1):
        rounds = [ego_noise_times(seed=seed) for seed in range(options.rounds)]
    # The mean: one hop in three carries the eigendecomposition.
    mean = {name: float(np.median([np.mean(r[name]) for r in rounds])) for name in rounds[0]}
    p99 = {name: float(np.median([np.percentile(r[name], 99) for r in rounds])) for name in rounds[0]}
    ratios = {name: spent / mean["stft"] for name, spent in mean.items()}
    if options.json:
        print(json.dumps({"mean_ms": mean, "p99_ms": p99, "of_stft": ratios}, indent=2))
        return
    for name, spent in mean.items():
        print(f"  {name:20s} {spent:7.3f} ms   p99 {p99[name]:7.3f}   {ratios[name]:5.2f} of the transform")


if __name__ == "__main__":
    main()
