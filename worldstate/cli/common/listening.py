"""How a recording or microphones are listened to: model, place, memory; and listening with a bar."""

import argparse
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from .inputs import search_of
from .progress import progress_bar, track

if TYPE_CHECKING:
    from worldstate.abduction.sequence.street_sides import SidePatterns
    from worldstate.adapters.listen import Step
    from worldstate.adapters.source import ListenSettings, Source
    from worldstate.frontend.array.microphone_array import MicrophoneArray
    from worldstate.operations.recordings.hop_table import HopTable
    from worldstate.operations.recordings.recording_report import RecordingReport
    from worldstate.state import Context


def add_listen_options(parser: argparse.ArgumentParser) -> None:
    """Declare --model, --alpha, --site-memory, --uncalibrated, --grounded, --ego-noise and the place."""
    add = parser.add_argument
    add("--model", type=Path, help="model file (default: that of --car, or the one that ships)")
    add("--alpha", type=float, default=0.02, help="false-positive budget (default: %(default)s)")
    memory = "time constant with which the site is learned while listening, 0 for not at all (default: 300)"
    add("--site-memory", type=float, metavar="S", help=memory)
    add(
        "--uncalibrated", action="store_true",
        help="go on where the model was made for another array or rate; no cue states an alpha then",
    )  # fmt: skip
    grounded = "weigh windows with bearing and approach, eq. (5), not the sequence (default: off)"
    add("--grounded", action="store_true", help=grounded)
    ego_noise = "learn the own vehicle's noise while nothing is there and hear past it (default: off)"
    add("--ego-noise", action="store_true", help=ego_noise)
    place = (
        "corners, lanes and rates of this place, JSON (default: a usual blind junction, and states say so)"
    )
    add("--context", type=Path, metavar="FILE", help=place)
    street = "edges, pace and sides of this place as `street learn` wrote them, in place of --context"
    add("--street", type=Path, metavar="JSON", help=street)


def add_memory_options(parser: argparse.ArgumentParser, start: str) -> None:
    """Declare --resume, --start and --save-state; `start` says what counts without --start."""
    add = parser.add_argument
    add("--resume", type=Path, metavar="STATE", help="go on from what --save-state wrote")
    first = f"time of the first sample on the states' clock (default: {start})"
    add("--start", type=float, metavar="S", help=first)
    add("--save-state", type=Path, metavar="STATE", help="keep belief and site for --resume")


def listen_settings(arguments: argparse.Namespace) -> "ListenSettings":
    """Return how it is listened to, boxes and silent channels by default."""
    from dataclasses import replace

    from worldstate.adapters.acoustic import Grounding

    return replace(
        search_of(arguments),
        alpha=arguments.alpha,
        site_adaptation=arguments.site_memory != 0.0,
        forgetting_s=arguments.site_memory or None,
        grounding=Grounding() if arguments.grounded else None,
        ego_noise=arguments.ego_noise,
        uncalibrated=arguments.uncalibrated,
    )


def given_place(arguments: argparse.Namespace) -> "tuple[Context | None, SidePatterns | None]":
    """Return the place that --context or --street names and what its arms sound like, None without them."""
    from worldstate.adapters.files.context_file import read_context
    from worldstate.ground.errors import InvalidArgumentError
    from worldstate.operations.labelling.street_file import read_street
    from worldstate.smoothing.learned_street import context_of

    if arguments.street is None:
        return (None if arguments.context is None else read_context(arguments.context)), None
    if arguments.context is not None:
        raise InvalidArgumentError("--street: expected it without --context, both say what stands there")
    street = read_street(arguments.street)
    return context_of(street), street.patterns


def listen_with_progress(
    source: "Source",
    *,
    title: str,
    states_path: Path | None,
    on_hop: "Callable[[Step], None]" = lambda step: None,
) -> "RecordingReport":
    """Listen to `source` to its end while a bar on standard error counts seconds of audio."""
    from worldstate.adapters.audio.open_sound import RawPcm, open_sound
    from worldstate.operations.recordings.recording_report import run_recording

    hops = None
    if not isinstance(source.sound, RawPcm):
        with open_sound(source.sound, strict=not source.settings.mask_dead) as audio:
            hops = 10.0 * audio.duration_s
    with progress_bar(f"listening to {source.audio_path.name}", hops) as bar:

        def follow(step: "Step") -> None:
            on_hop(step)
            bar.advance()

        return run_recording(source, title=title, states_path=states_path, on_hop=follow)


def read_streams(
    inputs: Iterable[Path], array: "MicrophoneArray | None", model: Path | None
) -> "list[HopTable]":
    """Return the hop streams of data sets, recordings, sound files and what --save-streams wrote."""
    from worldstate.operations.calibration.calibration_input import find_inputs, read_input

    found = [item for path in inputs for item in find_inputs(path)]
    read = track(found, "listening", len(found))
    return [stream for path in read for stream in read_input(path, array=array, model=model)]
