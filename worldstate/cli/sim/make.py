"""`worldstate sim make`: simulate recordings of blind junctions in the OVAD layout.

Simulate recordings of a vehicle with a roof array at blind junctions: D/DataLog.csv, D/array.xml with the
microphones, and D/<environment>/<class>/<ID>/ with out_multi.wav, camera_baseline_results.json and truth.json
(path, line of sight and time to visible of each vehicle). The ego stands (--static, SA1 to SB3) or approaches
the corner with its own noise (--dynamic, DA1 to DB3, without camera results as in OVAD). Every other
recording is an approach, alternately from the left and from the right; the others are hazard-free. One seed
gives the same bytes for any number of processes. --video adds the camera's video, ueye_stereo_vid.mp4 in the
size of OVAD's camera (extra `vision`); sound and boxes do not change.

--sounds adds sources that are not vehicles, at a drawn place in every recording: people, bells, tools, music,
birds, rain that may soil the lens, gusts. Sirens, horns and beepers belong to the vehicle, or to another
street if there is none. A folder in the list holds recordings of your own, one folder of WAV or FLAC files
per kind: excerpts of the files replace the synthesis, mono and at the level of the kind.

--scene places a standing ego elsewhere: behind a van, between piers at a ramp, at a wall before a merge, on
an open road, at a wide crossing, beside a house on one side only, behind a parked van; "all" alternates all
places and junctions. Half of their hazard-free recordings have a vehicle in plain view, or one that never
comes into view.

--bandwidth 2000 renders at 6 kHz, an eighth of the samples, which is enough for the feature and the bearings;
sound above the limit is missing.

--minutes M simulates one continuous stream at --site instead, with traffic as arrivals: D/<name>/ with the
sound, array.xml, camera results, truth.json, events.json (one entry per vehicle), vehicles.csv (one row per
vehicle and 0.1 s: position, speed, in view, time to visible, loudness at the array) and stream.png. With
--traffic no-hazard no vehicle comes out of a hidden arm, so that every alarm is false. Each kind of --sounds
occurs twelve times per hour, and each signal at a tenth of the vehicles.

Examples
--------
  worldstate sim make --out sim --static 4 --seed 1
  worldstate sim make --out sim --dynamic 10 --kind electric --jobs 2
  worldstate sim make --out sim --sounds my_sounds,rain
  worldstate sim make --out hours --minutes 60 --site SA1 --traffic busy --bandwidth 2000 --jobs 2
  worldstate run sim/SA1/left/1_00_0000
"""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from worldstate import adapters, ground, simulation
from worldstate.cli.common import command, inputs, output, progress
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.extras import check_extra

if TYPE_CHECKING:
    from worldstate.simulation.stream.settings import StreamSettings

JUNCTION = "junction"  # The default scene
# Options of recordings, not of streams, with their defaults.
OF_RECORDINGS = {
    **{"static": None, "dynamic": 0, "video": False, "duration": None},
    **{"scene": JUNCTION, "kind": next(iter(simulation.KINDS))},
}
FIGURE_NAME = "stream.png"
PER_HOUR = 12.0  # Occurrences of each kind of --sounds in a stream
SIGNAL_SHARE = 0.1  # Share of the vehicles with each signal of --sounds


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    from worldstate.simulation.stream.settings import TRAFFICS

    add = parser.add_argument
    add("--out", type=Path, required=True, metavar="D", help="folder of the data set")
    told = "recordings with a standing ego (default: 4, 0 with --dynamic)"
    add("--static", type=int, metavar="N", help=told)
    add("--dynamic", type=int, default=0, metavar="N", help="recordings with a moving ego (default: 0)")
    command.add_choice(parser, "--scene", "what hides the vehicle", JUNCTION, *simulation.PLACES, "all")
    command.add_choice(parser, "--kind", "vehicle", *simulation.KINDS)
    command.add_choice(parser, "--preset", "how busy the street is", *simulation.PRESETS)
    told = f"other sources, separated by commas: {', '.join(simulation.SOUNDS)}; or a folder of recordings"
    add("--sounds", type=_words, default=(), metavar="KINDS|FOLDER", help=told)
    inputs.add_array_options(parser, "OVAD's")
    add("--seed", type=int, default=1, help="seed of the data set (default: 1)")
    add("--jobs", type=int, default=1, help="number of processes (default: 1)")
    add("--duration", type=float, help="length of a recording, seconds (default: 10)")
    told = "highest frequency, 700 to 16,000 (default); the sample rate is three to six times as high"
    add("--bandwidth", type=float, metavar="HZ", help=told)
    add("--video", action="store_true", help="render the video of the camera as well")
    add("--video-width", type=int, metavar="PX", help="width of the images (default: 1936)")
    add = parser.add_argument_group("a continuous stream").add_argument
    add("--minutes", type=float, metavar="M", help="length of the stream")
    # The option has no choices, so that the library refuses a moving ego and gives the reason.
    sites = simulation.SITES
    add("--site", help=f"{', '.join(sites)}, or TA1, MB7, ... of the other renderers (default: {sites[0]})")
    add("--traffic", choices=[*TRAFFICS], help="density of the traffic (default: calm)")


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return its result."""
    command.check_beside(arguments, site="minutes", traffic="minutes", video_width="video")
    if arguments.minutes is not None:
        return _run_stream(arguments)
    settings = _settings(arguments)
    with progress.progress_bar("simulating", settings.n_static + settings.n_dynamic) as bar:
        array = inputs.given_array(arguments)
        rows = simulation.write_dataset(
            arguments.out, settings, array=array, jobs=arguments.jobs, progress=lambda row: bar.advance()
        )
    summary = {
        "out": str(arguments.out),
        "recordings": len(rows),
        "approaches": sum(row.approach != "none" for row in rows),
        **{name: getattr(settings, name) for name in ("scene", "kind", "sounds", "preset", "seed")},
        "folders": [row.folder.as_posix() for row in rows],
    }
    return output.CommandResult(summary)


def _run_stream(arguments: argparse.Namespace) -> output.CommandResult:
    from worldstate.commissioning.stream_figure import write_stream_figure
    from worldstate.simulation.stream.writing import write_stream

    given = [f"--{name}" for name, usual in OF_RECORDINGS.items() if getattr(arguments, name) != usual]
    if given:
        problem = f"expected without {', '.join(given)}, which apply to recordings only"
        raise InvalidArgumentError(f"--minutes: {problem}")
    check_extra("matplotlib")
    settings = _stream_settings(arguments)
    with progress.progress_bar("simulating", settings.duration_s) as bar:
        array, jobs = inputs.given_array(arguments), arguments.jobs
        stream = write_stream(arguments.out, settings, array=array, jobs=jobs, progress=bar.advance)
    write_stream_figure(stream, stream.folder / FIGURE_NAME)
    summary = {
        "out": str(stream.folder),
        "minutes": settings.minutes,
        "vehicles": len(stream.vehicles),
        "hazards": sum(one.hazard for one in stream.vehicles),
        "site": settings.site.name,
        "sample_rate_hz": settings.sample_rate_hz,
        "traffic": settings.traffic.name,
        "preset": arguments.preset,
        "seed": settings.seed,
    }
    return output.CommandResult(summary, lines=["", f"see {stream.folder / FIGURE_NAME}"])


def _stream_settings(arguments: argparse.Namespace) -> "StreamSettings":
    from worldstate.simulation.dataset.dataset import BANDWIDTHS_HZ
    from worldstate.simulation.scene.settings import SAMPLE_RATE_HZ, SIGNALS, rate_for
    from worldstate.simulation.stream.settings import StreamSettings, traffic_named

    (kinds, folder), traffic = _sounds(arguments.sounds), traffic_named(arguments.traffic or "calm")
    rate_hz, band = SAMPLE_RATE_HZ, arguments.bandwidth
    if band is not None:
        rate_hz = rate_for(ground.in_range("--bandwidth", band, *BANDWIDTHS_HZ))
    sounds = {**traffic.sounds, **{kind: PER_HOUR for kind in kinds if kind not in SIGNALS}}
    signals = {kind: SIGNAL_SHARE for kind in kinds if kind in SIGNALS}
    return StreamSettings(
        site=simulation.site(arguments.site or simulation.SITES[0]),
        minutes=arguments.minutes,
        seed=arguments.seed,
        traffic=replace(traffic, sounds=sounds, signals=signals),
        preset=replace(simulation.preset(arguments.preset), sounds_folder=folder),
        sample_rate_hz=rate_hz,
    )


def _settings(arguments: argparse.Namespace) -> "simulation.DatasetSettings":
    static, (kinds, folder) = arguments.static, _sounds(arguments.sounds)
    same = "seed", "scene", "kind", "video", "preset"
    return simulation.DatasetSettings(
        n_static=(0 if arguments.dynamic else 4) if static is None else static,
        n_dynamic=arguments.dynamic,
        duration_s=10.0 if arguments.duration is None else arguments.duration,
        video_width_px=arguments.video_width or adapters.PinholeCamera.ovad().width_px,
        bandwidth_hz=arguments.bandwidth,
        sounds=kinds,
        sounds_folder=folder,
        **{name: getattr(arguments, name) for name in same},
    )


def _sounds(words: tuple[str, ...]) -> tuple[tuple[str, ...], str]:
    """Return the kinds of sources, and the folder with recordings of some of them; empty without one."""
    from worldstate.simulation.emitters.emitter import recorded_kinds

    folders = [word for word in words if word not in simulation.SOUNDS and Path(word).is_dir()]
    if len(folders) > 1:
        raise InvalidArgumentError(f"--sounds: expected one folder at most, got {', '.join(folders)}")
    recorded = [kind for folder in folders for kind in recorded_kinds(folder)]
    named = [word for word in words if word not in (*folders, *recorded)]
    return (*named, *recorded), "".join(folders)


def _words(text: str) -> tuple[str, ...]:
    return tuple(word.strip() for word in text.split(","))
