"""`worldstate-lab bench ego-noise`: cost of ego-noise cancellation per 0.1-s hop, beside the transform.

56 channels, 47,998 Hz, nfft 512, half overlap, SRP bins only; BLAS pinned to one thread. The sound is white
noise and a wave from below, so that it is whitened. What is timed is the processor time of `EgoNoise.process`
and `levelled` less the phase transform that they replace, with the gate open and shut after learning.
"""

import argparse
import time
from functools import partial

import numpy as np

from worldstate.cli.common.output import CommandResult
from worldstate.frontend.array.microphone_array import roof_array_56
from worldstate.frontend.array.steering import Steering
from worldstate.frontend.ego_noise.ego_noise import EgoNoise, ElevationSplit
from worldstate.frontend.spectra.stft import StreamingStft, bin_frequencies_hz, whiten
from worldstate.ground.blas_threads import one_blas_thread
from worldstate.ground.typing import Complex64Array, Float32Array
from worldstate_lab.benchmarks.hop_costs import Milliseconds, elapsed_ms

EXAMPLE = "example: worldstate-lab bench ego-noise --rounds 5"

RATE, NFFT, HOPS, WARM_UP = 47_998, 512, 120, 60
BINS, SRP = range(1, 19), slice(2, 18)
DIRECTIONS = np.ones(181)


def ego_noise_times(seed: int) -> dict[str, Milliseconds]:
    """Milliseconds of processor time per hop: the transform, and what each state of cancelling adds."""
    sound = _sound(np.random.default_rng(seed))
    stft = StreamingStft(56, NFFT, BINS)
    stft.push(sound)
    spectra = [stft.push(np.roll(sound, 977 * k, axis=0)) for k in range(HOPS)]
    times = {"stft": [elapsed_ms(partial(stft.push, sound), time.process_time) for _ in spectra]}
    plain = [elapsed_ms(partial(whiten, heard[:, SRP]), time.process_time) for heard in spectra]
    for name in ("learning", "shut"):
        ego = _ego_noise()
        spent = []
        for k, heard in enumerate(spectra):
            if name == "shut" and k == WARM_UP - 10:
                ego.weight = 0.0
            spent.append(elapsed_ms(partial(_processed, ego, heard), time.process_time))
        times[f"ego_noise_{name}"] = [a - b for a, b in zip(spent, plain, strict=True)]
    return {name: spent[WARM_UP:] for name, spent in times.items()}


def _sound(rng: np.random.Generator) -> Float32Array:
    """Draw white noise and a wave of the same power from 40 degrees below the horizon, (4800, 56)."""
    late = np.round(roof_array_56().delays_s(0.3, np.radians(-40.0)) * RATE).astype(int)
    wave = rng.standard_normal(4800)
    heard = np.stack([np.roll(wave, k) for k in late], axis=1) + rng.standard_normal((4800, 56))
    return heard.astype(np.float32)


def _ego_noise() -> EgoNoise:
    array = roof_array_56()
    frequencies = bin_frequencies_hz(BINS, RATE, NFFT)[SRP]
    beams = Steering.towards(array, frequencies, np.radians(np.arange(-90.0, 91.0)))
    ego = EgoNoise(2.0 * RATE / NFFT, 56, [(beams, SRP)], ElevationSplit.of(array, frequencies))
    ego.weight = 1.0
    return ego


def _processed(ego: EgoNoise, heard: Complex64Array) -> None:
    ego.process(heard)
    ego.levelled(DIRECTIONS, len(heard))


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--rounds", type=int, default=5, help="medians over so many (default: %(default)s)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the benchmark; return what it found."""
    with one_blas_thread():
        rounds = [ego_noise_times(seed) for seed in range(arguments.rounds)]
    # The mean: one hop in four carries the eigendecomposition.
    mean = {name: float(np.median([np.mean(r[name]) for r in rounds])) for name in rounds[0]}
    p99 = {name: float(np.median([np.percentile(r[name], 99) for r in rounds])) for name in rounds[0]}
    ratios = {name: spent / mean["stft"] for name, spent in mean.items()}
    lines = [
        f"  {name:20s} {spent:7.3f} ms   p99 {p99[name]:7.3f}   {ratios[name]:5.2f} of the transform"
        for name, spent in mean.items()
    ]
    return CommandResult({"mean_ms": mean, "p99_ms": p99, "of_stft": ratios}, table={}, lines=lines)
