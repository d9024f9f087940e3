"""`worldstate-lab bench`: costs of front-end and filter on this machine, beside their peers.

56 channels, 47,998 Hz, nfft 512, half overlap, one BLAS thread. Milliseconds are the median over rounds of
the median (and 99th percentile) over hops. The sound is a broadband source and an engine line in noise of the
same level as the source. --files prints the files of the library that one hop of the whole chain executes,
and its number of calls.

example: worldstate-lab bench
"""

import argparse
import io
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib.util import find_spec
from itertools import pairwise
from types import FrameType
from typing import Any

import numpy as np
from rich.console import Console
from threadpoolctl import threadpool_info, threadpool_limits  # type: ignore[import-untyped]

from worldstate.adapters.camera.detections import DetectionFrame
from worldstate.adapters.camera.detectors import MotionDetector
from worldstate.adapters.listener import Listener
from worldstate.adapters.live.live_listening import LiveStep
from worldstate.adapters.live.live_sound import block_samples
from worldstate.adapters.source import ListenSettings, open_source
from worldstate.cli.common.live_view import view_of
from worldstate.cli.common.output import CommandResult
from worldstate.cli.common.progress import progress_bar
from worldstate.frontend.approach.tone import ENGINE_BAND_HZ
from worldstate.frontend.array.microphone_array import MicrophoneArray, ovad_array, roof_array_56
from worldstate.frontend.settings import FrontEndSettings
from worldstate.frontend.stream import AcousticFrame, FrontEnd
from worldstate.ground.checks import in_range
from worldstate.ground.typing import Float32Array, ImageArray
from worldstate.ground.values import nanoseconds
from worldstate_lab.benchmarks.hop_costs import (
    FRONT_END,
    RATE_HZ,
    Milliseconds,
    elapsed_ms,
    evidence_times,
    published_chain_times,
    stage_times,
)
from worldstate_lab.benchmarks.tracker_costs import tracker_times

SECONDS = 6
# Running seconds are full after ten hops, and caches are warm.
WARM_UP_HOPS = 11
EIGHT = slice(None, None, 7)  # Microphones of the roof array
EVERYTHING = FrontEndSettings(tone_band_hz=ENGINE_BAND_HZ, character=True)
FEATURE_CHAIN = ("stft", "phat", "feature")
AGAINST = {
    "published_chain": "feature_chain",
    "listener_hop": "published_chain",
    "listener_hop_8": "published_chain_8",
    "scikit_learn_trees": "sequence_reader",
    "scikit_learn_classifier": "window_evidence",
    "jpda_1": "update_1",
    "update_20": "numpy_batch_20",
    "update_600": "update_64",
    "state_20": "update_20",
}
"""Our row that does the same work as a peer; for our rows, the reference."""
SETTINGS = {
    "stages": "56 channels, 47,998 Hz, Hann 512, hop 256, 18 or 19 new frames per hop; STFT bins 1-18; SRP "
    "bins 3-18, 181 azimuths; feature bins 1-15, 30 azimuths x 2 halves; "
    "tone 20-400 Hz, 1 s at 1231 Hz, every hop",
    "sound_to_state": "the whole chain from the last 25 ms of a hop to its snapshot as JSON, with an image "
    "of 968 x 304 px with a moving car, by background subtraction, and the terminal output",
    "published_chain": "per hop: scipy.signal.stft of the file, channel by channel, its time shared among "
    "the hops; pyroomacoustics SRP, 30 azimuths, 50-1500 Hz (bins 1-15), on each half of one second; against "
    "stft + phat + feature",
    "listener_hop": "the same sound through a listener, hop by hop, to its snapshot as JSON, with the models "
    "of the roof array and no camera; against published_chain; _8: eight of the microphones in both",
    "scikit_learn_trees": "the two rows of a hop through as many trees as training produces, as a "
    "histogram classifier; against sequence_reader, its inputs included",
    "scikit_learn_classifier": "the published linear machines on one window, without probabilities; against "
    "window_evidence: five experts, each on the window and its mirror image, with a learned site reference",
    "jpda_1": "Stone Soup's JPDA on one vehicle in view; against the whole filter on the same boxes",
    "update_20": "boxes of twenty vehicles; against predict and update of as many Kalman filters with four "
    "states by einsum, with known association",
    "update_600": "boxes of 600 objects per image, of which 64 are accepted; against 64",
    "state_20": "a snapshot of twenty vehicles; against their update",
}
"""Frame-exact settings of the stages and of every comparison."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--rounds", type=int, default=5, help="rounds per median (default: %(default)s)")
    parser.add_argument("--files", action="store_true", help="list the files of one hop and count its calls")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Measure the front-end and the peers that are installed, in turn, `--rounds` times."""
    rounds = int(in_range("rounds", arguments.rounds, 1, 1000))
    rng = np.random.default_rng(0)
    street = rng.standard_normal((SECONDS * RATE_HZ, 56), dtype=np.float32)
    street += np.tile(_source(rng), (SECONDS // 2, 1))
    if arguments.files:
        files, calls = executed_files(street)
        told = {"n_files": len(files), "n_calls": calls, "files": files}
        return CommandResult(told, table={}, lines=[f"{len(files)} files, {calls} calls", *files])
    runs: list[Mapping[str, Milliseconds]] = []
    with threadpool_limits(1), progress_bar("timing", rounds, quiet=arguments.json) as bar:
        kernels = tuple(_kernel(info) for info in threadpool_info())
        for _ in range(rounds):
            runs.append(_one_round(street))
            bar.advance()
    report = _report(runs, kernels)
    return CommandResult(report, table={}, lines=report_lines(report))


def report_lines(report: Mapping[str, Any]) -> list[str]:
    """Return the report as text."""
    blas, rounds = ", ".join(report["blas"]), report["rounds"]
    lines = [f"BLAS {blas}; 1 thread; median of {rounds} rounds; load {report['load']:.1f}; ms per hop"]
    for name, one in report["costs"].items():
        ratio = f"   {report['ratios'][name]:6.2f} of {AGAINST[name]}" if name in report["ratios"] else ""
        lines.append(f"  {name:32s} {one['median_ms']:9.3f}   p99 {one['p99_ms']:9.3f}{ratio}")
    return lines + [f"{name}: {setting}" for name, setting in report["settings"].items()]


def _source(rng: np.random.Generator) -> Float32Array:
    """Return a plane wave of unit power and an engine line of a tenth of it, (n, 56): 2 s."""
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
    plain, _ = processed(hops, FrontEndSettings())
    everything, heard = processed(hops, EVERYTHING)
    ours = stage_times(FRONT_END, processed(hops, EVERYTHING)[0])
    ours["feature_chain"] = [sum(parts) for parts in zip(*map(ours.get, FEATURE_CHAIN), strict=True)]
    for name, calls in (("front_end", plain), ("everything", everything)):
        ours[name] = [elapsed_ms(hop) for hop in calls]
    ours = {name: times[WARM_UP_HOPS:] for name, times in ours.items()}
    installed = find_spec("pyroomacoustics") is not None
    roof = roof_array_56()
    whole = {"sound_to_state": live_times(hops)}
    for name, array in (("", roof), ("_8", MicrophoneArray(roof.positions_m[EIGHT]))):
        sound = np.ascontiguousarray(street[:, EIGHT]) if name else street
        whole["listener_hop" + name] = listener_times(_hops(sound), array)
        if installed:
            whole["published_chain" + name] = published_chain_times(sound, array)
    return ours | evidence_times(heard) | whole | tracker_times(np.random.default_rng(1))


def _hops(sound: Float32Array) -> list[Float32Array]:
    ends = np.floor(np.arange(len(sound) * 10 // RATE_HZ + 1) * RATE_HZ / 10 + 0.5).astype(int)
    return [sound[a:b] for a, b in pairwise(ends)]


def processed(
    hops: list[Float32Array], settings: FrontEndSettings
) -> tuple[list[Callable[[], object]], list[AcousticFrame]]:
    """Return calls of `FrontEnd.process` with every check, and their input."""
    front_end, heard = FrontEnd(roof_array_56(), RATE_HZ, settings), list[AcousticFrame]()

    def process(samples: Float32Array) -> None:
        heard.extend(front_end.process(samples))

    return [partial(process, samples) for samples in hops], heard


def listener_times(hops: Sequence[Float32Array], array: MicrophoneArray) -> Milliseconds:
    """Time a hop of a listener, sound to JSON, with the models of the roof array."""
    listener = Listener(array, RATE_HZ, settings=ListenSettings(uncalibrated=True))

    def one_hop(hop: Float32Array) -> None:
        for state in listener.push(hop):
            state.to_json()

    return [elapsed_ms(partial(one_hop, hop)) for hop in hops][WARM_UP_HOPS:]


def live_times(hops: Sequence[Float32Array]) -> Milliseconds:
    """Time `worldstate live` with a camera and the terminal view, from the last block of a hop on."""
    listener, detector = Listener(open_source("microphones", array=ovad_array()), RATE_HZ), MotionDetector()
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
    return times[WARM_UP_HOPS:]


def executed_files(street: Float32Array) -> tuple[list[str], int]:
    """Return the files of the library that a hop executes, and its number of Python and C calls.

    Files are the maximum over the last ten hops and calls their median, sound to JSON, with a box in view.
    """
    listener = Listener(open_source("microphones", array=ovad_array()), RATE_HZ)
    box = DetectionFrame(np.array([[700.0, 500.0, 900.0, 700.0]]), np.array([0.9]), ("car",))
    passed, calls = [set[str]() for _ in range(10)], [0] * 10

    def follow(frame: FrameType, event: str, _: object) -> None:
        calls[0] += event in ("call", "c_call")
        module = str(frame.f_globals.get("__name__"))
        # Generated code, such as that of dataclasses, has no file.
        if event == "call" and module.startswith("worldstate.") and frame.f_code.co_filename.endswith(".py"):
            passed[0].add(module.replace(".", "/") + ".py")

    for number, hop in enumerate(_hops(street), start=1):
        passed, calls = [set(), *passed[:-1]], [0, *calls[:-1]]
        listener.look(nanoseconds(0.1 * number - 0.05), box)
        sys.setprofile(follow)
        for state in listener.push(hop):
            state.to_json()
        sys.setprofile(None)
    fullest = max(passed, key=len)
    return sorted(fullest), int(np.median(calls))


def _report(runs: list[Mapping[str, Milliseconds]], kernels: tuple[str, ...]) -> dict[str, Any]:
    costs = {
        name: {
            "median_ms": float(np.median([np.median(run[name]) for run in runs])),
            "p99_ms": float(np.median([np.percentile(run[name], 99) for run in runs])),
        }
        for name in runs[0]
    }
    pairs = [(peer, one) for peer, one in AGAINST.items() if {peer, one} <= {*costs}]
    return {
        "blas": kernels,
        "rounds": len(runs),
        "load": os.getloadavg()[0],  # Load of the machine over the last minute, at the end
        "settings": SETTINGS,
        "costs": costs,
        "ratios": {peer: costs[peer]["median_ms"] / costs[one]["median_ms"] for peer, one in pairs},
    }
