"""`worldstate-lab bench`: what the front-end costs on this machine, beside its peers.

56 channels, 47,998 Hz, nfft 512, half overlap, BLAS pinned to one thread. Milliseconds are the median over
rounds of the median (and 99th percentile) over hops. The sound is a broadband source and an engine line in
noise as loud as the source.
"""

import argparse
import os
from collections.abc import Callable, Mapping
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from threadpoolctl import threadpool_info, threadpool_limits  # type: ignore[import-untyped]

from worldstate.cli.common.output import CommandResult
from worldstate.cli.common.progress import progress_bar
from worldstate.frontend.approach.tone import ENGINE_BAND_HZ
from worldstate.frontend.array.microphone_array import roof_array_56
from worldstate.frontend.array.steering import Steering
from worldstate.frontend.direction.music import music_spectrum, signal_subspace
from worldstate.frontend.direction.srp import srp_phat
from worldstate.frontend.frame import AcousticFrame
from worldstate.frontend.settings import FrontEndSettings
from worldstate.frontend.spectra.stft import StreamingStft, bin_frequencies_hz
from worldstate.frontend.stream import FrontEnd
from worldstate.ground.checks import in_range
from worldstate.ground.typing import Complex64Array, Float32Array
from worldstate_lab.benchmarks.hop_costs import (
    FRONT_END,
    GOAL,
    NFFT,
    RATE_HZ,
    Milliseconds,
    elapsed_ms,
    evidence_times,
    peer_times,
    stage_times,
)

EXAMPLE = "example: worldstate-lab bench"

SECONDS = 6
SRP_BINS, AZIMUTHS_RAD = range(3, 19), np.radians(np.arange(-90.0, 91.0))
# Running seconds are full after ten hops, and caches warm.
WARM_UP_HOPS = 11
EVERYTHING = FrontEndSettings(tone_band_hz=ENGINE_BAND_HZ, character=True)
SETTINGS = {
    "stages": "56 channels, 47,998 Hz, Hann 512, hop 256, 18 or 19 new frames a hop; STFT bins 1-18; SRP "
    "bins 3-18, 181 azimuths; feature bins 1-15, 30 azimuths x 2 halves; "
    "tone 20-400 Hz, 1 s at 1231 Hz, every hop",
    "published_chain": "per hop: scipy.signal.stft of the file, channel by channel, its cost shared among "
    "the hops; pyroomacoustics SRP, 30 azimuths, 50-1500 Hz (bins 1-15), on each half of one second; against "
    "stft + phat + feature",
    "published_chain_per_call": "the same with the STFT of the second computed on every hop",
    "pyroomacoustics_srp": "the same 19 frames of a tenth of a second, 181 azimuths, 300-1800 Hz (bins "
    "3-18); against srp181_on_a_tenth",
    "pyroomacoustics_music": "the same 19 frames, azimuths and bins, 1 source; against music_on_a_tenth",
    "scikit_learn_trees": "the two rows of a hop through 60 rounds of 15 trees of 8 leaves, as a histogram "
    "classifier; against sequence_reader, its inputs included",
    "scikit_learn_classifier": "the published linear machines on one window, without probabilities; against "
    "window_evidence: five experts, each on the window and its mirror image, the site learned",
}
"""Frame-exact settings of the stages and of every comparison."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--rounds", type=int, default=5, help="medians over so many (default: %(default)s)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Measure the front-end and the peers that are installed, in turn, `--rounds` times."""
    rounds = int(in_range("rounds", arguments.rounds, 1, 1000))
    rng = np.random.default_rng(0)
    street = rng.standard_normal((SECONDS * RATE_HZ, 56), dtype=np.float32)
    street += np.tile(_source(rng), (SECONDS // 2, 1))
    runs: list[Mapping[str, Milliseconds]] = []
    with threadpool_limits(1), progress_bar("timing", rounds, quiet=arguments.json) as bar:
        kernels = tuple(_kernel(info) for info in threadpool_info())
        for _ in range(rounds):
            runs.append(_one_round(street))
            bar.advance()
    report = _report(runs, kernels)
    return CommandResult(report, table={}, lines=report_lines(report))


def report_lines(report: Mapping[str, Any]) -> list[str]:
    """Return the report for people."""
    blas, threads, rounds = ", ".join(report["blas"]), report["threads"], report["rounds"]
    total = {"median_ms": report["total_ms"], "p99_ms": report["p99_ms"]}
    rows = report["stages"] | {"STFT + PHAT + SRP181 + feature": total}
    return [
        f"BLAS {blas}; {threads} thread; median of {rounds} rounds; load {report['load']:.1f}; ms per hop",
        *(f"  {name:32s} {one['median_ms']:9.3f}   p99 {one['p99_ms']:9.3f}" for name, one in rows.items()),
        *(f"  peer {name:27s} {median:9.3f}" for name, median in report["peers"].items()),
        *(f"  ratio {name:26s} {ratio:9.1f}" for name, ratio in report["ratios"].items()),
        *(f"{name}: {setting}" for name, setting in report["settings"].items()),
    ]


def _source(rng: np.random.Generator) -> Float32Array:
    """Make a plane wave of unit power and an engine line of a tenth of that, (n, 56): 2 s."""
    n = 2 * RATE_HZ
    frequencies = np.fft.rfftfreq(n, 1.0 / RATE_HZ)
    wave = np.fft.rfft(rng.standard_normal(n))
    line = np.sqrt(0.2) * np.cos(2.0 * np.pi * 61.0 / RATE_HZ * np.arange(n))
    sound = np.empty((n, 56), np.float32)
    for m, delay_s in enumerate(roof_array_56().delays_s(np.radians(25.0)).ravel()):
        sound[:, m] = np.fft.irfft(wave * np.exp(-2j * np.pi * frequencies * delay_s), n) + line
    return sound


def _kernel(info: Mapping[str, Any]) -> str:
    return " ".join(str(info.get(key) or "-") for key in ("internal_api", "version", "architecture"))


def _one_round(street: Float32Array) -> Mapping[str, Milliseconds]:
    hops = _hops(street)
    spectra = StreamingStft(56, NFFT, range(NFFT // 2 + 1)).push(street[:5000])[:19]
    plain, _ = processed(hops, FrontEndSettings())
    everything, heard = processed(hops, EVERYTHING)
    ours = stage_times(FRONT_END, processed(hops, EVERYTHING)[0])
    ours["goal"] = [sum(parts) for parts in zip(*(ours[name] for name in GOAL), strict=True)]
    whole = {"front_end": plain, "everything": everything}
    ours |= {name: [elapsed_ms(hop) for hop in calls] for name, calls in whole.items()}
    ours = {name: times[WARM_UP_HOPS:] for name, times in ours.items()}
    ours |= _on_a_tenth(spectra) | evidence_times(heard)
    return ours | peer_times(street, spectra, AZIMUTHS_RAD)


def _hops(sound: Float32Array) -> list[Float32Array]:
    ends = np.floor(np.arange(len(sound) * 10 // RATE_HZ + 1) * RATE_HZ / 10 + 0.5).astype(int)
    return [sound[a:b] for a, b in pairwise(ends)]


def processed(
    hops: list[Float32Array], settings: FrontEndSettings
) -> tuple[list[Callable[[], object]], list[AcousticFrame]]:
    """Return calls of `FrontEnd.process`, what a user gets, every check included, and what they will hear."""
    front_end, heard = FrontEnd(roof_array_56(), RATE_HZ, settings), list[AcousticFrame]()

    def process(samples: Float32Array) -> None:
        heard.extend(front_end.process(samples))

    return [partial(process, samples) for samples in hops], heard


def _on_a_tenth(frames: Complex64Array) -> dict[str, Milliseconds]:
    """Time SRP and MUSIC on exactly the frames that the peers get."""
    used = np.ascontiguousarray(frames[:, SRP_BINS.start : SRP_BINS.stop])
    frequencies = bin_frequencies_hz(SRP_BINS, RATE_HZ, NFFT)
    beams = Steering.towards(roof_array_56(), frequencies, AZIMUTHS_RAD)
    responses = roof_array_56().steering(frequencies, AZIMUTHS_RAD).astype(np.complex64)
    calls: dict[str, Callable[[], object]] = {
        "srp181_on_a_tenth": lambda: srp_phat(used, beams),
        "music_on_a_tenth": lambda: music_spectrum(signal_subspace(used, 1), responses),
    }
    return {name: [elapsed_ms(call) for _ in range(40)] for name, call in calls.items()}


def _report(runs: list[Mapping[str, Milliseconds]], kernels: tuple[str, ...]) -> dict[str, Any]:
    medians = {name: float(np.median([np.median(run[name]) for run in runs])) for name in runs[0]}
    p99 = {name: float(np.median([np.percentile(run[name], 99) for run in runs])) for name in runs[0]}
    ours = {name for name in medians if not name.startswith("peer_")}
    peers = {name.removeprefix("peer_"): ms for name, ms in medians.items() if name not in ours}
    chain_ms = sum(medians[name] for name in GOAL if name != "srp181")
    work_ms = {
        "published_chain": chain_ms,
        "published_chain_per_call": chain_ms,
        "pyroomacoustics_srp": medians["srp181_on_a_tenth"],
        "pyroomacoustics_music": medians["music_on_a_tenth"],
        "scikit_learn_trees": medians["sequence_reader"],
        "scikit_learn_classifier": medians["window_evidence"],
    }
    shown = {name: {"median_ms": medians[name], "p99_ms": p99[name]} for name in medians if name in ours}
    total = shown.pop("goal")
    return {
        "blas": kernels,
        "threads": 1,
        "rounds": len(runs),
        "load": os.getloadavg()[0],  # Of the machine over the last minute, at the end
        "settings": SETTINGS,
        "stages": shown,
        "total_ms": total["median_ms"],
        "p99_ms": total["p99_ms"],
        "peers": peers,
        "ratios": {name: peers[name] / ms for name, ms in work_ms.items() if name in peers},
    }
