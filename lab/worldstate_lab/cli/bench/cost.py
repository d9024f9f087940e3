"""`worldstate-lab bench`: what the front-end costs on this machine, beside its peers.

56 channels, 47,998 Hz, nfft 512, half overlap, BLAS pinned to one thread. Milliseconds are the median over
rounds of the median (and 99th percentile) over hops. The sound is a broadband source and an engine line in
noise as loud as the source; noise alone, the worst case for MUSIC, is a row of its own.
"""

import argparse
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from threadpoolctl import threadpool_info, threadpool_limits  # type: ignore[import-untyped]

from worldstate.cli.common.output import CommandResult
from worldstate.cli.common.progress import progress_bar
from worldstate.frontend.approach.tone import ENGINE_BAND_HZ
from worldstate.frontend.array.microphone_array import roof_array_56
from worldstate.frontend.direction.music import music_spectrum, signal_subspace
from worldstate.frontend.direction.srp import srp_phat
from worldstate.frontend.ego_noise.ego_noise import EgoNoiseSettings
from worldstate.frontend.frame import AcousticFrame
from worldstate.frontend.settings import FrontEndSettings
from worldstate.frontend.spectra.stft import StreamingStft, bin_frequencies_hz
from worldstate.frontend.stream import FrontEnd
from worldstate.ground.checks import in_range
from worldstate.ground.serialisation import encode
from worldstate.ground.typing import Complex64Array, Float32Array
from worldstate_lab.benchmarks.hop_costs import (
    AZIMUTHS_RAD,
    GOAL,
    NFFT,
    RATE_HZ,
    SRP_BINS,
    Milliseconds,
    elapsed_ms,
    evidence_times,
    peer_times,
    srp_beams,
    stage_times,
)

EXAMPLE = "example: worldstate-lab bench"

SECONDS = 6
# Running seconds are full after ten hops, and caches warm.
WARM_UP_HOPS = 11
EVERYTHING = FrontEndSettings(music_sources=1, tone_band_hz=ENGINE_BAND_HZ, character=True)
EGO_NOISE = EgoNoiseSettings()
SETTINGS = {
    "stages": "56 channels, 47,998 Hz, Hann 512, hop 256, 18 or 19 new frames a hop; STFT bins 1-18; SRP "
    "bins 3-18, 181 azimuths; feature bins 1-15, 30 azimuths x 2 halves; MUSIC bins 3-18, 1 source, running "
    "second; tone 20-400 Hz, 1 s at 1231 Hz, every hop",
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


@dataclass(frozen=True, slots=True)
class BenchReport:
    """What was measured; all times in milliseconds per 0.1-s hop."""

    blas: tuple[str, ...]  # Kernel and version of every BLAS in the process
    threads: int  # Threads that BLAS was pinned to
    rounds: int  # Rounds that medians were taken over
    load: float  # Load average of the machine over the last minute, at the end
    settings: Mapping[str, str]  # What is computed, frame by frame: the stages, and each comparison
    # Median and 99th percentile of each stage; of the whole front-end by default (`front_end`); of all that
    # it can do (`everything`: with MUSIC, bands, looming, tone and the character of the sound), also without
    # channel watching, with ego-noise learned and cancelled, and in noise without any source. `evidence` is
    # what follows, with its parts.
    stages: Mapping[str, tuple[float, float]]
    # STFT, phase transform, SRP181 of new frames and running second, and published feature together.
    total_ms: float
    p99_ms: float
    peers: Mapping[str, float]  # Median of each peer that is installed; empty where none is
    ratios: Mapping[str, float]  # Cost of the peer over ours on the same work: see `settings`


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--rounds", type=int, default=5, help="medians over so many (default: %(default)s)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Measure the front-end and the peers that are installed, in turn, `--rounds` times."""
    rounds = int(in_range("rounds", arguments.rounds, 1, 1000))
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((SECONDS * RATE_HZ, 56), dtype=np.float32)
    street = noise + np.tile(_source(rng), (SECONDS // 2, 1))
    runs: list[Mapping[str, Milliseconds]] = []
    with threadpool_limits(1), progress_bar("timing", rounds, quiet=arguments.json) as bar:
        kernels = tuple(_kernel(info) for info in threadpool_info())
        for _ in range(rounds):
            runs.append(_one_round(street, noise))
            bar.advance()
    report = _report(runs, kernels)
    stages = {name: {"median_ms": median, "p99_ms": p99} for name, (median, p99) in report.stages.items()}
    return CommandResult({**encode(report), "stages": stages}, table={}, lines=report_lines(report))


def report_lines(report: BenchReport) -> list[str]:
    """Return the report for people."""
    head = f"BLAS {', '.join(report.blas)}; {report.threads} thread; median of {report.rounds} rounds"
    rows = [*report.stages.items(), ("STFT + SRP181 + feature", (report.total_ms, report.p99_ms))]
    return [
        f"{head}; load {report.load:.1f}; ms per hop",
        *(f"  {name:32s} {median:9.3f}   p99 {p99:9.3f}" for name, (median, p99) in rows),
        *(f"  peer {name:27s} {median:9.3f}" for name, median in report.peers.items()),
        *(f"  ratio {name:26s} {ratio:9.1f}" for name, ratio in report.ratios.items()),
        *(f"{name}: {setting}" for name, setting in report.settings.items()),
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


def _one_round(street: Float32Array, noise: Float32Array) -> Mapping[str, Milliseconds]:
    hops = _hops(street)
    frames = StreamingStft(56, NFFT, range(NFFT // 2 + 1)).push(street[:5000])[:19]
    ours = {name: times[WARM_UP_HOPS:] for name, times in stage_times(hops).items()}
    ours["front_end"], _ = _front_end_times(hops, FrontEndSettings())
    ours["everything"], heard = _front_end_times(hops, EVERYTHING)
    ours["everything_unwatched"], _ = _front_end_times(hops, replace(EVERYTHING, watch_channels=False))
    ours["everything_and_ego_noise"], _ = _front_end_times(hops, replace(EVERYTHING, ego_noise=EGO_NOISE))
    ours["everything_in_noise_alone"], _ = _front_end_times(_hops(noise), EVERYTHING)
    ours |= _on_a_tenth(frames) | evidence_times(heard)
    return ours | peer_times(street, frames, RATE_HZ, AZIMUTHS_RAD)


def _hops(sound: Float32Array) -> list[Float32Array]:
    ends = np.floor(np.arange(len(sound) * 10 // RATE_HZ + 1) * RATE_HZ / 10 + 0.5).astype(int)
    return [sound[a:b] for a, b in pairwise(ends)]


def _front_end_times(
    hops: list[Float32Array], settings: FrontEndSettings
) -> tuple[Milliseconds, list[AcousticFrame]]:
    """Time `FrontEnd.process`, what a user gets, every check included; return also what it heard."""
    front_end, heard = FrontEnd(roof_array_56(), RATE_HZ, settings), list[AcousticFrame]()

    def process(samples: Float32Array) -> None:
        heard.extend(front_end.process(samples))
        if settings.ego_noise is not None:
            front_end.learn_ego_noise(1.0)

    return [elapsed_ms(partial(process, samples)) for samples in hops][WARM_UP_HOPS:], heard


def _on_a_tenth(frames: Complex64Array) -> dict[str, Milliseconds]:
    """Time SRP and MUSIC on exactly the frames that the peers get."""
    beams = srp_beams()
    used = np.ascontiguousarray(frames[:, SRP_BINS.start : SRP_BINS.stop])
    frequencies = bin_frequencies_hz(SRP_BINS, RATE_HZ, NFFT)
    responses = roof_array_56().steering(frequencies, AZIMUTHS_RAD).astype(np.complex64)
    calls: dict[str, Callable[[], object]] = {
        "srp181_on_a_tenth": lambda: srp_phat(used, beams),
        "music_on_a_tenth": lambda: music_spectrum(signal_subspace(used, 1), responses),
    }
    return {name: [elapsed_ms(call) for _ in range(40)] for name, call in calls.items()}


def _report(runs: list[Mapping[str, Milliseconds]], kernels: tuple[str, ...]) -> BenchReport:
    medians = {name: float(np.median([np.median(run[name]) for run in runs])) for name in runs[0]}
    p99 = {name: float(np.median([np.percentile(run[name], 99) for run in runs])) for name in runs[0]}
    ours = {name for name in medians if not name.startswith("peer_")}
    peers = {name.removeprefix("peer_"): ms for name, ms in medians.items() if name not in ours}
    chain_ms = sum(medians[name] for name in GOAL if not name.startswith("srp181"))
    work_ms = {
        "published_chain": chain_ms,
        "published_chain_per_call": chain_ms,
        "pyroomacoustics_srp": medians["srp181_on_a_tenth"],
        "pyroomacoustics_music": medians["music_on_a_tenth"],
        "scikit_learn_trees": medians["sequence_reader"],
        "scikit_learn_classifier": medians["window_evidence"],
    }
    return BenchReport(
        blas=kernels,
        threads=1,
        rounds=len(runs),
        load=os.getloadavg()[0],
        settings=SETTINGS,
        stages={name: (medians[name], p99[name]) for name in medians if name in ours and name != "goal"},
        total_ms=medians["goal"],
        p99_ms=p99["goal"],
        peers=peers,
        ratios={name: peers[name] / ms for name, ms in work_ms.items() if name in peers},
    )
