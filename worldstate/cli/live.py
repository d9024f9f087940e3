"""`worldstate live`: compute the states from running microphones, one per hop.

Compute the world-state from the microphones of this machine, or from a recording that is played back.

The sound is not stored without --keep-sound, because microphones in public record people. If the machine is
too slow, sound is lost (an overrun) and replaced by silence. Ctrl-C ends the run with complete files. Logs
and sound can be read while they grow; after a kill half a second is missing. An earlier file of the same name
becomes NAME.N.SUFFIX. If a log cannot be written, a notice on standard error follows and the run continues.

--detections HOST:PORT receives the detections of your own detector, one UDP datagram per image:
  {"boxes": [[x1, y1, x2, y2], ...], "scores": [...], "classes_str": [...], "age_s": 0.04}
"age_s" is the time from the capture of the image to the sending. Send images without boxes as well. For
several cameras of --car, repeat NAME=HOST:PORT.

--odometry HOST:PORT receives the motion of the vehicle in the same way:
  {"speed_mps": 5.0, "yaw_rate_rad_s": 0.1, "age_s": 0.01}
optionally with "x_m", "y_m" and "yaw_rad" in a map. It selects the model for a moving ego vehicle.

A port accepts one sender until that sender is silent for ten seconds, or all hosts of --allow. With --key,
the file of a secret, a datagram ends in a line with its HMAC-SHA256 and has a rising "number", the "port"
that it is for (odometry, detections or detections/NAME) and "sent_s", the Unix time of sending.

--save-state writes the belief, the site and the last datagram numbers every minute and at the end. --resume
continues from them, at their time or at --start.

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
from worldstate.cli.common import command, exports, inputs, output, progress
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.extras import check_extra

if TYPE_CHECKING:
    from worldstate.adapters.listener import Listener
    from worldstate.adapters.live.live_listening import LiveStep
    from worldstate.adapters.live.live_sensors import DatagramSocket, Trust
    from worldstate.adapters.live.live_sound import LiveSound, SoundFeed
    from worldstate.adapters.source import SourceSensors

    Show = Callable[[LiveStep], None]

Port = TypeVar("Port", bound="DatagramSocket[Any]")

# Shortest time between two notices of lost sound.
SAID_EVERY_NS = 1_000_000_000
# A run that is killed loses at most this much of the learned site and belief.
SAVED_EVERY_NS = 60_000_000_000
# Shorter secrets, in bytes, can be guessed.
SHORTEST_KEY = 16
WEB_PORT = 8766


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    inputs.add_array_options(parser)
    inputs.add_car_options(parser)
    add = parser.add_argument_group("sound").add_argument
    add("--device", metavar="NAME", help="number or name of the input device (default: the system's)")
    add("--rate", type=int, default=48_000, metavar="HZ", help="samples per second (default: %(default)s)")
    add("--play", type=Path, metavar="RECORDING", help="sound file or recording folder to play instead")
    add("--speed", type=float, default=1.0, metavar="X", help="factor of the playback speed (default: 1)")
    ends = "end after this length of sound, seconds; a shorter recording is repeated"
    add("--duration", type=float, metavar="S", help=ends)
    inputs.add_listen_options(parser)
    inputs.add_memory_options(parser, "the end of STATE")
    parser.add_argument("--odometry", metavar="HOST:PORT", help="receive the motion of the vehicle there")
    add = parser.add_argument_group("ports").add_argument
    text = "accept datagrams of this host only; may be repeated (default: the first sender)"
    add("--allow", action="append", default=[], metavar="HOST", help=text)
    add("--key", type=Path, metavar="FILE", help="accept only datagrams that are signed with this secret")
    which = parser.add_argument_group("camera").add_mutually_exclusive_group()
    which.add_argument("--camera-device", type=int, metavar="N", help="number of a camera of this machine")
    text = "receive the detections of your own detector there; NAME=HOST:PORT for a camera of --car"
    which.add_argument("--detections", action="append", default=[], metavar="HOST:PORT", help=text)
    inputs.add_detector_option(parser)
    parser.set_defaults(detector=None)
    add = exports.add_output_options(parser).add_argument
    add("--keep-sound", type=Path, metavar="WAV", help="store the raw sound (RF64, 24 bits)")
    text = "begin new logs at this size, and keep the earlier ones as NAME.N.SUFFIX"
    add("--rotate-mib", type=int, metavar="N", help=text)
    view = "show bearing, risk and entities (default: if standard error is a terminal)"
    text = "show the run in a browser of this machine, http://127.0.0.1:PORT (default: %(const)s)"
    add("--web", type=int, nargs="?", const=WEB_PORT, metavar="PORT", help=text)
    add("--view", action=argparse.BooleanOptionalAction, default=None, help=view)


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return its result."""
    from worldstate.adapters.listener import PUSHED
    from worldstate.adapters.live.live_listening import live_steps
    from worldstate.adapters.live.live_sound import LiveSound, kept_sound
    from worldstate.adapters.source import SourceSensors

    output.check_outputs(arguments, "out", "keep_sound", "save_state")
    command.check_beside(arguments, detector="camera_device")
    arguments.detector = arguments.detector or "motion"
    check_extra(*exports.needed_extras(arguments))
    sensors = SourceSensors.of(arguments.array, arguments.car, arguments.camera)
    if arguments.play is None and sensors.car.array is None:
        problem = "expected the positions of the microphones, or --car, or --play RECORDING"
        raise InvalidArgumentError(f"--array: {problem}")
    with ExitStack() as opened:
        # A model for another array is refused before a device is opened.
        source = _source(arguments, sensors, arguments.play or Path(PUSHED))
        feed = _microphones(arguments, source) if arguments.play is None else _played(arguments, source)
        keep = opened.enter_context(kept_sound(arguments.keep_sound, feed.sample_rate_hz, feed.channels))
        sound = LiveSound(feed, keep)
        source = replace(source, sound=sound)
        sound.start_ns = source.start_ns
        ports = _Ports(_trust(arguments, source.before), sound, opened)
        source = _with_cameras(arguments, sensors, source, ports)
        _open_odometry(arguments, ports)
        figures = _listen(arguments, source, ports, live_steps(source, *ports.hand_in))
        for losses in ports.losses:
            figures |= losses()
        return output.CommandResult(figures | {"array": inputs.stance(source.array)})


def _source(arguments: argparse.Namespace, sensors: "SourceSensors", sound: Path) -> "adapters.Source":
    from worldstate.adapters.files.odometry_file import read_odometry

    before = None if arguments.resume is None else adapters.read_checkpoint(arguments.resume)
    # With live sound, the odometry file of the car only shows that it moves; its motion is used for a played
    # recording.
    car = sensors.car
    path = None if arguments.odometry is not None else car.odometry
    drive = None if path is None else read_odometry(path)
    ended_s = 0.0 if before is None else ground.seconds(before.world.stamp_ns)
    detector = None if arguments.camera_device is None else arguments.detector
    source = adapters.open_source(
        sound,
        car.array,
        camera=sensors.camera,
        miss_rates=sensors.setup.miss_rates,
        odometry=drive if arguments.play is not None else None,
        moving_ego=arguments.odometry is not None or (drive is not None and drive.moves),
        resume=before,
        start_s=ended_s if arguments.start is None else arguments.start,
        **inputs.listen_parts(arguments) | {"model": arguments.model or car.model},
        settings=sensors.boxes_in(adapters.ListenSettings(), detector),
    )
    return replace(source, crossing_m=car.crossing_m)


def _microphones(arguments: argparse.Namespace, source: "adapters.Source") -> "SoundFeed":
    from worldstate.adapters.live.live_sound import PortAudioInput

    array, device = source.array, arguments.device
    number = int(device) if device is not None and device.isdecimal() else device
    rate_hz = int(ground.in_range("--rate", arguments.rate, 1000, 1_000_000))
    return PortAudioInput(max(array.channels, default=array.n_microphones), rate_hz, number)


def _played(arguments: argparse.Namespace, recorded: "adapters.Source") -> "SoundFeed":
    from worldstate.adapters.audio.sound_file import open_sound
    from worldstate.adapters.live.live_sound import Playback

    audio = open_sound(recorded.sound, strict=False)  # With all channels of the sound card
    return Playback(audio, arguments.speed, arguments.duration)


@dataclass(frozen=True, slots=True, eq=False)
class _Ports:
    """Open ports of detectors and odometry, and a camera of this machine; `opened` closes them."""

    trust: "Trust"
    sound: "LiveSound"
    opened: ExitStack
    sockets: "list[DatagramSocket[Any]]" = field(default_factory=list)
    hand_in: "list[Callable[[Listener], int]]" = field(default_factory=list)  # Pass data to the listener
    losses: list[Callable[[], dict[str, object]]] = field(default_factory=list)  # Figures for the report

    def open(self, kind: "Callable[..., Port]", address: str, *camera: str) -> "Port":
        """Open a port; `camera` is the name of its camera if there are several."""
        port = kind(address, self.sound.stamp_ns, self.trust, *camera)
        self.opened.enter_context(port)
        self.sockets.append(port)
        return port

    def report(self, sockets: "Collection[DatagramSocket[Any]]", name: str, last: str = "") -> None:
        """Add the losses of some sockets to the report."""
        self.losses.append(
            lambda: {
                f"{name}_dropped": sum(one.dropped for one in sockets),
                f"{name}_refused": sum(one.refused for one in sockets),
                f"last_{last}refusal": next((one.problem for one in sockets if one.problem), None),
            }
        )

    def kept(self, last: "adapters.Step") -> "adapters.Checkpoint":
        """Return the checkpoint of a hop, with the last number of each port."""
        from worldstate.adapters.files.checkpoint_file import PortNumbers

        numbers = dict(self.trust.numbers)
        for one in self.sockets:
            numbers |= one.numbers
        return replace(last.checkpoint, ports=PortNumbers(numbers) if numbers else None)


def _with_cameras(
    arguments: argparse.Namespace, sensors: "SourceSensors", source: "adapters.Source", ports: _Ports
) -> "adapters.Source":
    """Return the source with its cameras."""
    from worldstate.adapters.camera.vision_query import NO_LOOKS, SENSOR
    from worldstate.adapters.live.live_sensors import DetectionSocket
    from worldstate.adapters.source import with_cameras

    if arguments.camera_device is not None:
        return _with_device(arguments, sensors, source, ports)
    given = inputs.reported(arguments)
    if isinstance(given, dict):
        if sensors.chosen:
            raise InvalidArgumentError("--detections: expected those of several cameras without --camera")
        sockets = {name: ports.open(DetectionSocket, address, name) for name, address in given.items()}
        source = with_cameras(source, sensors.car, dict.fromkeys(given, NO_LOOKS))
    elif given is None:
        return source
    else:
        sockets = {SENSOR: ports.open(DetectionSocket, given)}
        source = replace(source, detections=NO_LOOKS)

    def hand_in(listener: "Listener") -> int:
        return sum(one.deliver(partial(listener.look, camera=name)) for name, one in sockets.items())

    ports.hand_in.append(hand_in)
    ports.report(sockets.values(), "detections")
    return source


def _with_device(
    arguments: argparse.Namespace, sensors: "SourceSensors", source: "adapters.Source", ports: _Ports
) -> "adapters.Source":
    """Return the source with a camera of this machine."""
    from worldstate.adapters.camera.vision_query import NO_LOOKS
    from worldstate.adapters.live.live_sensors import CameraFeed, ImageLooks, image_channel
    from worldstate.adapters.own_parts import detector_maker

    images, detector = image_channel(), detector_maker(arguments.detector, sensors.setup.labels)()
    size = source.camera.width_px, source.camera.height_px
    looks = ImageLooks(images, detector, ports.sound.stamp_ns, size, source.miss_rates)
    ports.opened.enter_context(CameraFeed(arguments.camera_device, images))

    def losses() -> dict[str, object]:
        refused, last = looks.refused, looks.problem or None
        return {"images_dropped": images.dropped, "images_refused": refused, "last_refusal": last}

    ports.hand_in.append(lambda to: looks.deliver(to.look))
    ports.losses.append(losses)
    return replace(source, detections=NO_LOOKS, degradation=looks.degradation)


def _open_odometry(arguments: argparse.Namespace, ports: _Ports) -> None:
    from worldstate.adapters.live.live_sensors import OdometrySocket

    if arguments.odometry is None:
        return
    told = ports.open(OdometrySocket, arguments.odometry)
    ports.hand_in.append(lambda to: told.deliver(lambda stamp_ns, record: to.add(record.at(stamp_ns))))
    ports.report([told], "odometry", "odometry_")


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


def _listen(
    arguments: argparse.Namespace,
    source: "adapters.Source",
    ports: _Ports,
    steps: "Iterator[LiveStep]",
) -> dict[str, object]:
    """Listen until the sound ends; return the figures of the run."""
    from worldstate.adapters.files.file_io import GrowingFile, line_writer
    from worldstate.adapters.live.live_listening import CostMeter, LatencyMeter
    from worldstate.operations.recordings.recording_report import WarningMeter

    warnings, latency, cost = WarningMeter(source.t0_s, source.hazard_free), LatencyMeter(), CostMeter()
    notice, shown, sound = _loss_notices(), _shown(arguments, ports.opened), ports.sound
    start_s = ground.seconds(source.start_ns)
    longest_s = math.inf if arguments.duration is None else arguments.duration
    with (
        _kept(arguments, ports) as keep,
        line_writer(arguments.out, partial(GrowingFile, most_bytes=exports.most_bytes(arguments))) as write,
        exports.exported_hops(arguments, source, live=True) as export,
        command.stopped_by_signals(sound.close),
    ):
        for live in steps:
            write(live.step.state.to_json())
            export(live.step)
            warnings.update(live.step.state)
            latency.add(live.latency_s)
            for show in shown:
                show(live)
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
    """Yield a function that writes --save-state once per minute, and write it at the end."""
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
            except (ground.WorldstateError, OSError) as error:  # The disk may have room at the next save
                output.say(str(error))

    try:
        yield keep
    except BaseException:
        with suppress(ground.WorldstateError, OSError):  # The first error is reported
            save()
        raise
    save()


def _shown(arguments: argparse.Namespace, opened: ExitStack) -> "list[Show]":
    """Return functions that show a hop: in the terminal, by default if there is one, and by --web."""
    found: list[Show] = []
    if progress.can_draw() if arguments.view is None else arguments.view:
        from worldstate.cli.common.live_view import live_view

        found.append(opened.enter_context(live_view()))
    if arguments.web is not None:
        from worldstate.operations.viewing.live_page import LivePage

        page = opened.enter_context(LivePage(arguments.web))
        output.say(f"open {page.url}")
        found.append(page.show)
    return found


def _loss_notices() -> "Show":
    """Return a function that prints a notice of lost sound, at most once per second."""
    said, said_ns = 0, -SAID_EVERY_NS

    def notice(live: "LiveStep") -> None:
        nonlocal said, said_ns
        stamp_ns = live.step.state.stamp_ns
        if live.overruns > said and stamp_ns - said_ns >= SAID_EVERY_NS:
            said, said_ns = live.overruns, stamp_ns
            lost = f"{live.overruns} overruns, {live.lost_s:.2f} s of sound lost"
            output.say(f"{ground.seconds(stamp_ns):.1f} s: {lost}")

    return notice
