"""`worldstate live`: microphones that run in, one snapshot a hop out.

Listen to the microphones of this machine, or to a recording played as if they heard it, and keep the
world-state; --help-all shows every option.

States are kept where asked for. The sound is not, unless --keep-sound says so: microphones in public hear
people. What the machine was too slow for is counted as an overrun, said when it happens, and heard as
silence. Ctrl-C ends the run, and what it wrote is complete. Snapshots, MCAP and sound grow under their own
name, and read at any time: a killed run loses half a second. What was there before becomes NAME.N.SUFFIX, the
first number that is free; two runs cannot write one file. A log that cannot be written, or was removed, does
not end the run: a notice on standard error names it.

--detections HOST:PORT takes what a detector of your own reports, a UDP datagram an image:
  {"boxes": [[x1, y1, x2, y2], ...], "scores": [...], "classes_str": [...], "age_s": 0.04}
with "age_s" from the capture of the image to the sending; an image without boxes is sent, too. Several
cameras of --car have an address each: NAME=HOST:PORT, repeated.

--odometry HOST:PORT takes how the car moves in the same way, as often as it is known:
  {"speed_mps": 5.0, "yaw_rate_rad_s": 0.1, "age_s": 0.01}
with "x_m", "y_m" and "yaw_rad" in a map where a localiser tells them. With it, or with the odometry of --car,
the model of a moving ego is taken where --model names none.

A port takes its first sender until that one is silent for ten seconds, or all of --allow. With --key, the
file of a secret, a datagram ends in a line with its HMAC-SHA256, and has a "number" that rises, the "port"
that it is for (odometry, detections or detections/NAME) and "sent_s", the Unix time of sending.

--save-state keeps belief, site and the numbers taken last every minute and at the end, --resume goes on from
them: from the time at which they end, or by --start from a later one.

Examples
--------
  worldstate live --array mics.csv --device 2 --model mine.json --out states.jsonl
  worldstate live --array mics.csv --model mine.json --camera-device 0 --camera camera.json
  worldstate live --array mics.csv --model mine.json --detections 127.0.0.1:9100
  worldstate live --play ovad_dataset/SA1/left/1_00_0002
  worldstate live --array uma-8 --device 2 --web
  worldstate live --play some.wav --array mics.csv --uncalibrated --speed 4
"""

import argparse
import math
import socket
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from worldstate import adapters, ground
from worldstate.cli.common import command, exports, inputs, listening, output, progress, sensors
from worldstate.ground.errors import InvalidArgumentError

if TYPE_CHECKING:
    from worldstate.adapters.listener import Listener
    from worldstate.adapters.live.live_listening import LiveStep
    from worldstate.adapters.live.live_sensors import DatagramSocket, Trust
    from worldstate.adapters.live.live_sound import LiveSound, SoundFeed

    HandIn = Callable[[Listener], int]
    Losses = Callable[[], dict[str, object]]

Port = TypeVar("Port", bound="DatagramSocket[Any]")


# Lost sound is said at most so often.
SAID_EVERY_NS = 1_000_000_000
# What a killed run has learned of the site and the belief since is lost.
SAVED_EVERY_NS = 60_000_000_000
# Bytes of a secret: fewer are guessed.
SHORTEST_KEY = 16
WEB_PORT = 8766
# What a first user needs.
FIRST_OPTIONS = (
    *("--array", "--car", "--model", "--budget", "--alpha", "--uncalibrated", "--context", "--street"),
    *("--device", "--play", "--camera-device", "--detections", "--camera", "--odometry"),
    *("--out", "--export", "--web"),
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    inputs.add_array_options(parser)
    inputs.add_channel_option(parser)
    sensors.add_car_option(parser)
    add = parser.add_argument_group("sound").add_argument
    add("--device", metavar="NAME", help="number or name of the input device (default: the system's)")
    add("--rate", type=int, default=48_000, metavar="HZ", help="samples a second (default: %(default)s)")
    add("--play", type=Path, metavar="RECORDING", help="a sound file or recording folder instead")
    add("--speed", type=float, default=1.0, metavar="X", help="play so many times as fast (default: 1)")
    ends = "end after so many seconds of sound; a shorter recording is played again"
    add("--duration", type=float, metavar="S", help=ends)
    inputs.add_search_options(parser)
    listening.add_listen_options(parser)
    listening.add_memory_options(parser, "the end of STATE")
    told = "listen there to how the car moves"
    parser.add_argument("--odometry", metavar="HOST:PORT", help=told)
    add = parser.add_argument_group("ports").add_argument
    told = "take datagrams of this address only; repeated (default: the first sender)"
    add("--allow", action="append", default=[], metavar="HOST", help=told)
    add("--key", type=Path, metavar="FILE", help="take datagrams only that prove to know this secret")
    group = parser.add_argument_group("camera")
    which = group.add_mutually_exclusive_group()
    which.add_argument("--camera-device", type=int, metavar="N", help="number of a camera of this machine")
    told = "listen there to a detector of your own; NAME=HOST:PORT of a camera of --car, repeated"
    which.add_argument("--detections", action="append", default=[], metavar="HOST:PORT", help=told)
    sensors.add_lens_options(parser, group)
    sensors.add_detector_option(parser)
    parser.set_defaults(detector=None)
    add = exports.add_output_options(parser).add_argument
    add("--keep-sound", type=Path, metavar="WAV", help="keep the raw sound, too (RF64, 24 bits)")
    told = "begin a new JSONL and MCAP at so many MiB, and keep the one before as NAME.N.SUFFIX"
    add("--rotate-mib", type=int, metavar="N", help=told)
    view = "show bearing, risk and entities (default: where standard error is a terminal)"
    told = "serve a page that shows the run on this machine, http://127.0.0.1:PORT (default: %(const)s)"
    add("--web", type=int, nargs="?", const=WEB_PORT, metavar="PORT", help=told)
    add("--view", action=argparse.BooleanOptionalAction, default=None, help=view)


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return what it found."""
    from worldstate.adapters.live.live_listening import live_steps
    from worldstate.adapters.live.live_sound import LiveSound, kept_sound

    output.check_outputs(arguments, "out", "keep_sound", "save_state")
    command.check_beside(arguments, detector="camera_device")
    arguments.detector = arguments.detector or "motion"
    given = listening.checked_sensors(arguments, [] if arguments.play is None else [arguments.play])
    with ExitStack() as opened:
        recorded = None if arguments.play is None else _source(arguments, given, arguments.play)
        feed = _microphones(arguments, given) if recorded is None else _played(arguments, recorded)
        keep = opened.enter_context(kept_sound(arguments.keep_sound, feed.sample_rate_hz, feed.channels))
        sound = LiveSound(feed, keep)
        source = _source(arguments, given, sound) if recorded is None else replace(recorded, sound=sound)
        sound.start_ns = source.start_ns
        ports = _Ports(_trust(arguments, source.before), sound, opened)
        source, look, looks_lost = _with_cameras(given, source, ports)
        tell, odometry_lost = _odometry(arguments, ports)
        steps = live_steps(source, look, tell)
        figures = _listen(arguments, given, source, ports, steps) | looks_lost() | odometry_lost()
        return output.CommandResult(figures | {"array": inputs.stance(source.array)})


def _source(
    arguments: argparse.Namespace, given: sensors.GivenSensors, sound: "LiveSound | Path"
) -> "adapters.Source":
    from worldstate.adapters.files.odometry_file import read_odometry

    before = None if arguments.resume is None else adapters.read_checkpoint(arguments.resume)
    # Of a running car the file tells that it moves, and where it was only of a recording that is played.
    path = None if arguments.odometry is not None else given.car.odometry
    drive = None if path is None else read_odometry(path)
    ended_s = 0.0 if before is None else ground.seconds(before.world.stamp_ns)
    return listening.open_given(
        given,
        sound,
        boxes=given.setup.boxes if arguments.camera_device is None else given.boxes(),
        mask_dead=True,  # a channel that is silent is told by the front-end, which leaves it out
        array=given.car.array,
        ego=drive if arguments.play is not None else None,
        moving_ego=arguments.odometry is not None or (drive is not None and drive.moves),
        resume=before,
        start_s=ended_s if arguments.start is None else arguments.start,
    )


def _microphones(arguments: argparse.Namespace, given: sensors.GivenSensors) -> "SoundFeed":
    from worldstate.adapters.live.live_sound import PortAudioInput

    array = given.car.array
    if array is None:
        problem = "expected the positions of the microphones, or --car, or --play RECORDING"
        raise InvalidArgumentError(f"--array: {problem}")
    device = arguments.device
    number = int(device) if device is not None and device.isdecimal() else device
    rate_hz = int(ground.in_range("--rate", arguments.rate, 1000, 1_000_000))
    return PortAudioInput(max(array.channels, default=array.n_microphones), rate_hz, number)


def _played(arguments: argparse.Namespace, recorded: "adapters.Source") -> "SoundFeed":
    from worldstate.adapters.audio.sound_file import open_sound
    from worldstate.adapters.live.live_sound import Playback

    audio = open_sound(recorded.sound, strict=False)  # with the channels of the card, as microphones give it
    return Playback(audio, arguments.speed, arguments.duration)


@dataclass(frozen=True, slots=True, eq=False)
class _Ports:
    """Ports that listen beside the microphones, until `opened` ends."""

    trust: "Trust"
    sound: "LiveSound"
    opened: ExitStack
    sockets: "list[DatagramSocket[Any]]" = field(default_factory=list)

    def open(self, kind: "Callable[..., Port]", address: str, *camera: str) -> "Port":
        """Open a port, of one of several cameras that of its name."""
        port = kind(address, self.sound.stamp_ns, self.trust, *camera)
        self.opened.enter_context(port)
        self.sockets.append(port)
        return port

    def kept(self, last: "adapters.Step") -> "adapters.Checkpoint":
        """Return what to go on from, with the numbers that were taken last."""
        from worldstate.adapters.files.checkpoint_file import PortNumbers

        numbers = dict(self.trust.numbers)
        for one in self.sockets:
            numbers |= one.numbers
        return replace(last.checkpoint, ports=PortNumbers(numbers) if numbers else None)


def _with_cameras(
    given: sensors.GivenSensors, source: "adapters.Source", ports: _Ports
) -> "tuple[adapters.Source, HandIn, Losses]":
    """Return the source with the cameras that were asked for, what hands their looks in, and their losses."""
    from worldstate.adapters.camera.vision_query import NO_LOOKS, SENSOR
    from worldstate.adapters.live.live_sensors import DetectionSocket
    from worldstate.operations.recordings.car_cameras import with_cameras

    if given.arguments.camera_device is not None:
        return _with_device(given, source, ports.sound, ports.opened)
    named = given.named()
    sockets = {name: ports.open(DetectionSocket, address, name) for name, address in named.items()}
    for address in () if named else given.arguments.detections:
        sockets[SENSOR] = ports.open(DetectionSocket, address)
    if named:
        source = with_cameras(source, given.car, dict.fromkeys(named, NO_LOOKS))
    elif sockets:
        source = replace(source, detections=NO_LOOKS)

    def hand_in(listener: "Listener") -> int:
        return sum(told.deliver(partial(listener.look, camera=name)) for name, told in sockets.items())

    return source, hand_in, _losses(sockets.values(), "detections")


def _with_device(
    given: sensors.GivenSensors, source: "adapters.Source", sound: "LiveSound", opened: ExitStack
) -> "tuple[adapters.Source, HandIn, Losses]":
    """Return the source with a camera of this machine."""
    from worldstate.adapters.camera.vision_query import NO_LOOKS
    from worldstate.adapters.live.live_sensors import CameraFeed, ImageLooks, image_channel

    arguments, images = given.arguments, image_channel()
    detector = sensors.detector_maker(arguments.detector, given.setup.labels)()
    size = source.camera.width_px, source.camera.height_px
    looks = ImageLooks(images, detector, sound.stamp_ns, size, source.miss_rates)
    opened.enter_context(CameraFeed(arguments.camera_device, images))
    seen = replace(source, detections=NO_LOOKS, degradation=looks.degradation)

    def losses() -> dict[str, object]:
        refused, last = looks.refused, looks.problem or None
        return {"images_dropped": images.dropped, "images_refused": refused, "last_refusal": last}

    return seen, lambda to: looks.deliver(to.look), losses


def _odometry(arguments: argparse.Namespace, ports: _Ports) -> "tuple[HandIn, Losses]":
    """Return what hands the odometry in that was asked for, and its losses."""
    from worldstate.adapters.live.live_sensors import OdometrySocket

    if arguments.odometry is None:
        return lambda to: 0, dict
    told = ports.open(OdometrySocket, arguments.odometry)

    def hand_in(listener: "Listener") -> int:
        return told.deliver(lambda stamp_ns, record: listener.add(record.at(stamp_ns)))

    return hand_in, _losses([told], "odometry", "odometry_")


def _trust(arguments: argparse.Namespace, before: "adapters.Checkpoint | None" = None) -> "Trust":
    from worldstate.adapters.files.file_io import read_bytes
    from worldstate.adapters.live.live_sensors import Trust

    key = None if arguments.key is None else read_bytes(arguments.key, "a secret", 1 << 12).strip()
    if key is not None and len(key) < SHORTEST_KEY:
        problem = f"expected a secret of at least {SHORTEST_KEY} bytes, got {len(key)}"
        raise ground.InputFileError(arguments.key, problem)
    try:
        allow = tuple(map(socket.gethostbyname, arguments.allow))
    except (OSError, UnicodeError) as error:
        raise InvalidArgumentError(f"--allow: expected hosts, got {arguments.allow} ({error})") from error
    return Trust(allow, key, {} if before is None or before.ports is None else before.ports.last)


def _losses(told: "Collection[DatagramSocket[Any]]", name: str, last: str = "") -> "Losses":
    if not told:
        return dict
    return lambda: {
        f"{name}_dropped": sum(one.dropped for one in told),
        f"{name}_refused": sum(one.refused for one in told),
        f"last_{last}refusal": next((one.problem for one in told if one.problem), None),
    }


def _listen(
    arguments: argparse.Namespace,
    given: sensors.GivenSensors,
    source: "adapters.Source",
    ports: _Ports,
    steps: "Iterator[LiveStep]",
) -> dict[str, object]:
    """Listen until the sound ends; return what came of it and what it cost."""
    from worldstate.adapters.files.file_io import GrowingFile, line_writer
    from worldstate.adapters.live.live_listening import CostMeter, LatencyMeter
    from worldstate.operations.recordings.recording_report import WarningMeter

    warnings, latency, cost = WarningMeter(source.t0_s, source.hazard_free), LatencyMeter(), CostMeter()
    notice, sound = _loss_notices(), ports.sound
    start_s = ground.seconds(source.start_ns)
    longest_s = math.inf if arguments.duration is None else arguments.duration
    with (
        _kept(arguments, ports) as keep,
        line_writer(arguments.out, partial(GrowingFile, most_bytes=exports.most_bytes(arguments))) as write,
        exports.exported_hops(arguments, source, given.car.crossing_m, live=True) as export,
        _view(arguments) as show,
        _web(arguments) as show_page,
        command.stopped_by_signals(sound.close),
    ):
        for live in steps:
            write(live.step.state.to_json())
            export(live.step)
            warnings.update(live.step.state)
            latency.add(live.latency_s)
            show(live)
            show_page(live)
            notice(live)
            keep(live.step)
            if ground.seconds(live.step.state.stamp_ns) - start_s >= longest_s:
                break
    return {
        "states": warnings.states,
        "sound_s": ground.seconds(sound.start_ns) - start_s + sound.frames / sound.sample_rate_hz,
        "overruns": sound.overruns,
        "lost_s": sound.lost_s,
        "latency_median_s": latency.quantile_s(0.5),
        "latency_p99_s": latency.quantile_s(0.99),
        "latency_largest_s": latency.quantile_s(1.0),
        **cost.read(),
        "peak_risk": warnings.peak_risk,
        **warnings.words,
        "advisory_onsets_s": list(warnings.summary().advisory_onsets_s),
    }


@contextmanager
def _kept(arguments: argparse.Namespace, ports: _Ports) -> "Iterator[Callable[[adapters.Step], None]]":
    """Lend a function that saves --save-state once a minute, and save it at the end, whatever ends it."""
    path, last, saved_ns = arguments.save_state, None, None

    def save() -> None:
        if path is not None and last is not None:
            adapters.save_checkpoint(path, ports.kept(last))

    def keep(step: "adapters.Step") -> None:
        nonlocal last, saved_ns
        last, stamp_ns = step, step.state.stamp_ns
        saved_ns = stamp_ns if saved_ns is None else saved_ns
        if stamp_ns - saved_ns >= SAVED_EVERY_NS:
            saved_ns = stamp_ns
            try:
                save()
            except (ground.WorldstateError, OSError) as error:  # the next minute may have room
                output.say(str(error))

    try:
        yield keep
    except BaseException:
        with suppress(ground.WorldstateError, OSError):  # what ended the run is told
            save()
        raise
    save()


@contextmanager
def _view(arguments: argparse.Namespace) -> "Iterator[Callable[[LiveStep], None]]":
    """Lend a function that shows a hop where --view or a terminal asks for it."""
    if not (progress.can_draw() if arguments.view is None else arguments.view):
        yield lambda live: None
        return
    from worldstate.cli.common.live_view import live_view

    with live_view() as show:
        yield show


@contextmanager
def _web(arguments: argparse.Namespace) -> "Iterator[Callable[[LiveStep], None]]":
    """Lend a function that passes a hop on to the page of --web."""
    if arguments.web is None:
        yield lambda live: None
        return
    from worldstate.operations.viewing.live_page import LivePage

    with LivePage(arguments.web) as page:
        output.say(f"open {page.url}")
        yield page.show


def _loss_notices() -> "Callable[[LiveStep], None]":
    """Return a function that says on standard error when sound was lost, at most once a second."""
    said, said_ns = 0, -SAID_EVERY_NS

    def notice(live: "LiveStep") -> None:
        nonlocal said, said_ns
        stamp_ns = live.step.state.stamp_ns
        if live.overruns > said and stamp_ns - said_ns >= SAID_EVERY_NS:
            said, said_ns = live.overruns, stamp_ns
            lost = f"{live.overruns} overruns, {live.lost_s:.2f} s of sound lost"
            output.say(f"{ground.seconds(stamp_ns):.1f} s: {lost}")

    return notice
