"""`worldstate-lab bench`: costs of front-end, listener, filter and the published chain on this machine.

56 channels, 47,998 Hz, nfft 512, half overlap, one BLAS thread. Milliseconds are the median over rounds of
the median (and 99th percentile) over hops. The sound is a broadband source and an engine line in noise of the
same level as the source.

example: worldstate-lab bench
"""

import argparse
import io
import os
from collections.abc import Mapping, Sequence
from functools import partial
from importlib.util import find_spec
from itertools import pairwise

import numpy as np
from rich.console import Console
from threadpoolctl import threadpool_info, threadpool_limits  # type: ignore[import-untyped]

from worldstate.adapters.camera.detectors import MotionDetector
from worldstate.adapters.listener import Listener
from worldstate.adapters.live.live_listening import LiveStep
from worldstate.adapters.live.live_sound import block_samples
from worldstate.adapters.source import ListenSettings, open_source
from worldstate.cli.common.live_view import view_of
from worldstate.cli.common.output import CommandResult
from worldstate.cli.common.progress import progress_bar
from worldstate.frontend.approach.tone import ENGINE_BAND_HZ
from worldstate.frontend.array.microphone_array import MicrophoneArray, ovad_array
from worldstate.frontend.settings import FrontEndSettings
from worldstate.frontend.stream import FrontEnd
from worldstate.ground.checks import in_range
from worldstate.ground.typing import Float32Array, ImageArray
from worldstate.ground.values import nanoseconds
from worldstate_lab.benchmarks.hop_costs import (
    EVIDENCE,
    FRONT_END,
    RATE_HZ,
    Calls,
    Milliseconds,
    elapsed_ms,
    published_chain_times,
    stage_times,
    update_times,
)
from worldstate_lab.report.table import Cell, Table

SECONDS = 6
# Running seconds are full after ten hops, and caches are warm.
WARM_UP_HOPS = 11
EIGHT = slice(None, None, 7)  # Microphones of the roof array
EVERYTHING = FrontEndSettings(tone_band_hz=ENGINE_BAND_HZ, character=True)
SETTINGS = {
    "stages": "56 channels, 47,998 Hz, Hann 512, hop 256, 18 or 19 new frames per hop; STFT bins 1-18; SRP "
    "bins 3-18, 181 azimuths; feature bins 1-15, 30 azimuths x 2 halves; tone 20-400 Hz, 1 s at 1231 Hz, "
    "every hop; evidence of the shipped model",
    "everything": "the whole front-end with all of these stages",
    "sound_to_state": "the whole chain from the last 25 ms of a hop to its snapshot as JSON, with an image "
    "of 968 x 304 px with a moving car, by background subtraction, and the terminal output",
    "published_chain": "per hop: scipy.signal.stft of the file, channel by channel, its time shared among "
    "the hops; pyroomacoustics SRP, 30 azimuths, 50-1500 Hz (bins 1-15), on each half of one second",
    "listener_hop": "the same sound through a listener, hop by hop, to its snapshot as JSON, with the "
    "shipped model and no camera; _8: eight of the microphones, without a model of their own",
    "update_20, state_20": "boxes of twenty vehicles, and their snapshot",
}
"""Frame-exact settings of the stages and of every comparison."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--rounds", type=int, default=5, help="rounds per median (default: %(default)s)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Measure the chain, and the published one if pyroomacoustics is installed, `--rounds` times."""
    rounds = int(in_range("rounds", arguments.rounds, 1, 1000))
    rng = np.random.default_rng(0)
    street = rng.standard_normal((SECONDS * RATE_HZ, 56), dtype=np.float32)
    street += np.tile(plane_wave(rng), (SECONDS // 2, 1))
    runs: list[Mapping[str, Milliseconds]] = []
    with threadpool_limits(1), progress_bar("timing", rounds, quiet=arguments.json) as bar:
        kernels = [
            " ".join(str(info.get(key) or "-") for key in ("internal_api", "version", "architecture"))
            for info in threadpool_info()
        ]
        for _ in range(rounds):
            runs.append(_one_round(street))
            bar.advance()
    costs = {
        name: {
            "median_ms": float(np.median([np.median(run[name]) for run in runs])),
            "p99_ms": float(np.median([np.percentile(run[name], 99) for run in runs])),
        }
        for name in runs[0]
    }
    load = os.getloadavg()[0]  # Load of the machine over the last minute, at the end
    report = {"blas": kernels, "rounds": rounds, "load": load, "settings": SETTINGS, "costs": costs}
    title = f"BLAS {', '.join(kernels)}; 1 thread; median of {rounds} rounds; load {load:.1f}"
    rows: list[tuple[Cell, ...]] = [(name, *one.values()) for name, one in costs.items()]
    table = Table("costs", title, ("per hop", "median (ms)", "p99 (ms)"), rows)
    return CommandResult(
        report, table={}, lines=[*table.lines(), *(f"{name}: {one}" for name, one in SETTINGS.items())]
    )


def plane_wave(rng: np.random.Generator) -> Float32Array:
    """Return a plane wave of unit power and an engine line of a tenth of it, (n, 56): 2 s."""
    n = 2 * RATE_HZ
    frequencies = np.fft.rfftfreq(n, 1.0 / RATE_HZ)
    wave = np.fft.rfft(rng.standard_normal(n))
    line = np.sqrt(0.2) * np.cos(2.0 * np.pi * 61.0 / RATE_HZ * np.arange(n))
    sound = np.empty((n, 56), np.float32)
    for m, delay_s in enumerate(ovad_array().delays_s(np.radians(25.0)).ravel()):
        sound[:, m] = np.fft.irfft(wave * np.exp(-2j * np.pi * frequencies * delay_s), n) + line
    return sound


def _one_round(street: Float32Array) -> dict[str, Milliseconds]:
    hops, eight = _hops(street), MicrophoneArray(ovad_array().positions_m[EIGHT])
    few = _hops(np.ascontiguousarray(street[:, EIGHT]))
    other = Listener(eight, RATE_HZ, settings=ListenSettings(uncalibrated=True))
    times = stage_times(FRONT_END, _front_end_calls(hops))
    times |= stage_times(EVIDENCE, _listener_calls(hops, shipped_listener()))
    times["everything"] = list(map(elapsed_ms, _front_end_calls(hops)))
    times["sound_to_state"] = _live_times(hops)
    times["listener_hop"] = list(map(elapsed_ms, _listener_calls(hops, shipped_listener())))
    times["listener_hop_8"] = list(map(elapsed_ms, _listener_calls(few, other)))
    times = {name: spent[WARM_UP_HOPS:] for name, spent in times.items()}
    if find_spec("pyroomacoustics") is not None:
        times["published_chain"] = published_chain_times(street, ovad_array())
    return times | update_times(np.random.default_rng(1))


def _hops(sound: Float32Array) -> list[Float32Array]:
    ends = np.floor(np.arange(len(sound) * 10 // RATE_HZ + 1) * RATE_HZ / 10 + 0.5).astype(int)
    return [sound[a:b] for a, b in pairwise(ends)]


def _front_end_calls(hops: Sequence[Float32Array]) -> Calls:
    front_end = FrontEnd(ovad_array(), RATE_HZ, EVERYTHING)
    return [partial(front_end.process, hop) for hop in hops]


def shipped_listener() -> Listener:
    """Return a listener of the shipped model and its array."""
    return Listener(open_source("microphones", array=ovad_array()), RATE_HZ)


def _listener_calls(hops: Sequence[Float32Array], listener: Listener) -> Calls:
    """Return the hops of a listener, sound to JSON."""

    def one_hop(hop: Float32Array) -> None:
        for state in listener.push(hop):
            state.to_json()

    return [partial(one_hop, hop) for hop in hops]


def _live_times(hops: Sequence[Float32Array]) -> Milliseconds:
    """Time `worldstate live` with a camera and the terminal view, from the last block of a hop on."""
    listener, detector = shipped_listener(), MotionDetector()
    screen, street = Console(file=io.StringIO(), force_terminal=True), np.full((304, 968, 3), 90, np.uint8)
    times: Milliseconds = []
    for number, hop in enumerate(hops, start=1):
        early, last = np.split(hop, [-block_samples(RATE_HZ)])
        for _ in listener.steps(early):  # No hop ends in it
            pass
        image = street.copy()
        image[100:250, 10 * number % 800 :][:, :150] = 220

        def one_hop(number: int = number, last: Float32Array = last, image: ImageArray = image) -> None:
            listener.look(nanoseconds(0.1 * number - 0.05), detector.detect(image))
            for step in listener.steps(last):
                step.state.to_json()
                screen.print(view_of(LiveStep(step, 0.0, 0, 0.0)))

        times.append(elapsed_ms(one_hop))
    return times
