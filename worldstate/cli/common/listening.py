"""How a recording or microphones are listened to: the call checked, model, place, memory; and with a bar."""

import argparse
import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from worldstate import adapters, frontend, operations
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.extras import check_extra

from .exports import needed_extras
from .inputs import search_of
from .output import NO_STREET, say
from .progress import progress_bar, track
from .sensors import MOVING, GivenSensors, given_sensors

if TYPE_CHECKING:
    from worldstate.adapters.audio.sound_file import SoundInput
    from worldstate.adapters.files.odometry_file import OdometryLog
    from worldstate.adapters.live.live_sound import LiveSound

# A signature is a line of a model file; no model that `save_model` writes has a longer one.
_LONGEST_LINE = 1 << 20
_EXTRAS = {"figure": "matplotlib", "camera_device": "cv2", "view": "rich"}


def add_listen_options(parser: argparse.ArgumentParser) -> None:
    """Declare --model, --budget, --alpha, --site-memory, --uncalibrated, --grounded and the place."""
    add = parser.add_argument
    add("--model", type=Path, help="model file (default: that of --car, or the one that ships)")
    add_budget_options(parser)
    memory = "time constant with which the site is learned while listening, 0 for not at all (default: 300)"
    add("--site-memory", type=float, metavar="S", help=memory)
    add(
        "--uncalibrated", action="store_true",
        help="go on where the model was made for another array or rate; no cue states an alpha then",
    )  # fmt: skip
    grounded = "weigh windows with bearing and approach, eq. (5), not the sequence (default: off)"
    add("--grounded", action="store_true", help=grounded)
    usual = "default: a usual blind junction, and states say so"
    told = f"corners, lanes and rates of this place, JSON ({usual})"
    add("--context", type=Path, metavar="FILE", help=told)
    street = "edges, pace and sides of this place as `street learn` wrote them, in place of --context"
    add("--street", type=Path, metavar="JSON", help=street)


def add_budget_options(parser: argparse.ArgumentParser) -> None:
    """Declare --budget and --alpha, which set the threshold of the alarm."""
    add = parser.add_mutually_exclusive_group().add_argument
    add("--budget", type=float, metavar="ONSETS", help="false alarms an hour (default: the model's own)")
    add("--alpha", type=float, metavar="SHARE", help="or the share of hazard-free time in alarm")


def add_memory_options(parser: argparse.ArgumentParser, start: str) -> None:
    """Declare --resume, --start and --save-state; `start` says what counts without --start."""
    add = parser.add_argument
    add("--resume", type=Path, metavar="STATE", help="go on from what --save-state wrote")
    first = f"time of the first sample on the states' clock (default: {start})"
    add("--start", type=float, metavar="S", help=first)
    add("--save-state", type=Path, metavar="STATE", help="keep belief and site for --resume")


def checked_sensors(arguments: argparse.Namespace, sound: list[Path]) -> GivenSensors:
    """Return the sensors of a call of which options and headers of files say that it can be heard.

    It takes some .5 s of processor time less than to import what listens and to read a model.

    Raises
    ------
    MissingExtraError, InputFileError, OutOfDomainError
        On a missing extra, no array for a sound file, not the model's array.
    """
    given = given_sensors(arguments)
    asked = {option: getattr(arguments, option, None) for option in _EXTRAS}
    wanted = {_EXTRAS[option] for option, value in asked.items() if value is not None and value is not False}
    looks = arguments.detector in MOVING and "camera_device" not in arguments
    check_extra(*wanted, *needed_extras(arguments), *(["cv2"] if looks else []))
    # Without a model that is named, any array is listened to.
    checks = given.model is not None or given.car.array is None
    if checks and (made_for := array_of_model(given.model)) is not None:
        _check_array(given, made_for, sound)
    return given


def _check_array(given: "GivenSensors", made_for: "frontend.MicrophoneArray", sound: list[Path]) -> None:
    from worldstate.adapters.datasets.ovad import check_channels, named_array
    from worldstate.adapters.files.array_file import named_arrays
    from worldstate.adapters.files.array_match import WAY_OUT, matched_order

    if any(named_array(path) is not None for path in sound):
        return
    array = given.car.array
    if array is None:
        if len(sound) == 1 and sound[0].is_file():
            check_channels(sound[0], made_for)
        return
    # The bag of a `run`, whose INPUT is then no sound, may turn a board by name: it has to be read for that.
    turned = "input" in given.arguments and not sound and array.name in named_arrays()
    if not (given.arguments.uncalibrated or turned):
        matched_order(made_for, array, WAY_OUT)


def array_of_model(path: Path | None = None) -> "frontend.MicrophoneArray | None":
    """Return the array that the first lines of a model file name, None where they are of another form.

    Examples
    --------
    >>> array_of_model().n_microphones
    56
    """
    from worldstate.adapters.files.array_file import file_of_model
    from worldstate.adapters.files.file_io import UNREADABLE, unpacked_file

    try:
        with unpacked_file(file_of_model(path), "a model file") as file:
            lines = iter(lambda: file.readline(_LONGEST_LINE).decode(), "")
            line = next(one for one in lines if one.startswith('"signature": {'))
        domain = json.loads(f"{{{line.rstrip().rstrip(',')}}}")["signature"]["domain"]
        return frontend.MicrophoneArray(domain["positions_m"], domain["array"])
    except (StopIteration, ValueError, LookupError, TypeError, InvalidArgumentError, *UNREADABLE):
        return None  # what reads the whole file says what is wrong with it


def place_and_settings(
    arguments: argparse.Namespace, boxes: "adapters.DetectionFilter", mask_dead: bool
) -> dict[str, Any]:
    """Return context, sides and settings of `open_source`, as the options of a command name them."""
    from dataclasses import replace

    from worldstate.adapters.files.context_file import read_context

    if None not in (arguments.street, arguments.context):
        raise InvalidArgumentError("--street: expected it without --context, both say what stands there")
    context, street = None if arguments.context is None else read_context(arguments.context), None
    if arguments.street is not None:  # Imported here: it takes a tenth of the start of a run without one
        from worldstate.operations.labelling.street_passes import read_street
        from worldstate.smoothing.learned_street import context_of

        street = read_street(arguments.street)
        context = context_of(street)
    settings = replace(
        search_of(arguments),
        budget=arguments.budget,
        alpha=arguments.alpha,
        site_adaptation=arguments.site_memory != 0.0,
        forgetting_s=arguments.site_memory or None,
        grounding=adapters.Grounding() if arguments.grounded else None,
        uncalibrated=arguments.uncalibrated,
        boxes=boxes,
        mask_dead=mask_dead,
    )
    return {"context": context, "sides": None if street is None else street.patterns, "settings": settings}


def open_given(
    given: GivenSensors,
    sound: "SoundInput | LiveSound",
    *,
    boxes: "adapters.DetectionFilter",
    mask_dead: bool,
    ego: "OdometryLog | None" = None,
    moving_ego: bool = False,
    **own: Any,
) -> "adapters.Source":
    """Return what is listened to, as the options say; `own` are further arguments of `open_source`."""
    parts = place_and_settings(given.arguments, boxes, mask_dead)
    if given.model is None and (moving_ego or (ego is not None and ego.moves)):
        say("the model of a moving ego is used, as odometry is given")
    source = adapters.open_source(
        sound,
        ego=ego,
        moving_ego=moving_ego,
        camera=given.camera,
        miss_rates=given.miss_rates,
        model=given.model,
        **parts,
        **own,
    )
    if source.street is None:
        say(NO_STREET)
    return source


def listen_with_progress(
    source: "adapters.Source",
    *,
    states_path: Path | None,
    on_hop: "Callable[[adapters.Step], None]" = lambda step: None,
) -> "operations.RecordingReport":
    """Listen to `source` to its end while a bar on standard error counts seconds of audio."""
    from worldstate.adapters.audio.sound_file import open_sound

    hops = None
    if not isinstance(source.sound, adapters.RawPcm):
        array, strict = source.array, not source.settings.mask_dead
        with open_sound(source.sound, array.n_microphones, channels=array.channels, strict=strict) as audio:
            hops = 10.0 * audio.duration_s
    with progress_bar(f"listening to {source.audio_path.name}", hops) as bar:

        def follow(step: "adapters.Step") -> None:
            on_hop(step)
            bar.advance()

        return operations.run_recording(source, states_path=states_path, on_hop=follow)


def read_streams(
    inputs: Iterable[Path], array: "frontend.MicrophoneArray | None", model: Path | None
) -> "list[operations.HopTable]":
    """Return the hop streams of data sets, recordings, sound files and what --save-streams wrote."""
    from worldstate.operations.calibration.cueing_calibration import find_inputs, read_input

    found = [item for path in inputs for item in find_inputs(path)]
    read = track(found, "listening", len(found))
    return [stream for path in read for stream in read_input(path, array=array, model=model)]
