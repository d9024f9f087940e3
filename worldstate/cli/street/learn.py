"""`worldstate street learn`: learn a street from passing vehicles.

Join the camera's boxes into passes, smooth them, and learn from each vehicle that came out of hiding: the
edge behind which it came into view, its pace there, the sound of either arm before, and the rate of arrivals
per side. The ego must stand.

INPUT is a recording with boxes of a camera, as for `worldstate street label`. --known continues from an
earlier file. `worldstate run --context` takes the file of --out.

If vehicles no longer come out from behind an edge, it is learned again after two or three vehicles. Older
passes lose their weight slowly.

Examples
--------
  worldstate street learn monday.wav --array mics.csv --detections boxes.json --out street.json
  worldstate street learn ovad_dataset/SB1/left/* --out street.json --figure street.png
  worldstate street learn tuesday.wav --detections boxes.json --known street.json --days 1 --out street.json
  worldstate run ovad_dataset/SB1/left/2_00_0005 --context street.json
"""

import argparse
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from worldstate import adapters, ground
from worldstate.cli.common import inputs, output, progress

if TYPE_CHECKING:
    from worldstate.operations.labelling.street_passes import WatchedRecording
    from worldstate.smoothing.learned_street import LearnedArm, LearnedStreet

# Numbers of passes that are drawn beside the result of all passes.
STAGES = (1, 3, 10)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    inputs.add_sensor_options(parser)
    add = parser.add_argument
    add("input", type=Path, nargs="+", metavar="INPUT", help="recordings of one place, in order")
    add("--known", type=Path, metavar="JSON", help="file of an earlier run")
    add("--days", type=float, default=0.0, metavar="D", help="days since then (default: %(default)g)")
    add("--site", metavar="NAME", help="name of the place (default: the known street's)")
    add("--model", type=Path, help="model that is used (default: the shipped one)")
    told = "learn the sound of either arm, which needs the whole recording (default: on)"
    add("--sides", action=argparse.BooleanOptionalAction, default=True, help=told)
    add = parser.add_argument_group("output").add_argument
    add("--out", type=Path, required=True, metavar="JSON", help="file to write")
    told = "draw the street from above, after 1, 3, 10 and all passes"
    add("--figure", type=Path, metavar="PNG", help=told)


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return its result."""
    from worldstate.operations.labelling.street_passes import streets_after, write_street

    ground.in_range("--days", arguments.days, 0.0, 1e5)
    inputs.check_boxes(arguments, len(arguments.input))
    # --out may replace the file of --known, because that file is read first.
    apart = argparse.Namespace(**{name: value for name, value in vars(arguments).items() if name != "known"})
    output.check_outputs(apart, "out", figures=("figure",))
    before = street = _known(arguments)
    stages: list[LearnedStreet] = []
    for one in progress.track(arguments.input, "learning", len(arguments.input)):
        *passed, street = streets_after(street, _seen(arguments, one))
        stages += passed
    write_street(arguments.out, street)
    if arguments.figure is not None:
        _draw(arguments, [before, *stages], street)
    arms, heard = {arm.direction: _figures(arm) for arm in street.arms}, street.patterns.sides() is not None
    found = {"out": str(arguments.out), "n_passes": len(stages), "arms": arms, "sides_heard": heard}
    lines = [*(_line(arm) for arm in street.arms), _heard(street)]
    return output.CommandResult(found, {key: found[key] for key in ("out", "n_passes")}, lines)


def _known(arguments: argparse.Namespace) -> "LearnedStreet":
    from worldstate.operations.labelling.street_passes import read_street
    from worldstate.smoothing.learned_street import DAY_S, LearnedStreet, forgotten

    street = LearnedStreet() if arguments.known is None else read_street(arguments.known)
    return replace(forgotten(street, arguments.days * DAY_S), site=arguments.site or street.site)


def _seen(arguments: argparse.Namespace, path: Path) -> "WatchedRecording":
    """Return the passes of a recording."""
    from worldstate.adapters.audio.sound_file import open_sound
    from worldstate.operations.labelling.street_passes import heard_street, watched_recording

    source, detections = inputs.camera_source(arguments, [path])
    model = adapters.read_model(arguments.model, array=source.array)
    with open_sound(source.sound, channels=source.array.channels) as audio:
        duration_s = audio.duration_s
    watched = watched_recording(detections, source.camera, source.settings.boxes, duration_s)
    return replace(watched, heard=heard_street(source, model)) if arguments.sides else watched


def _draw(arguments: argparse.Namespace, stages: "list[LearnedStreet]", street: "LearnedStreet") -> None:
    from worldstate.operations.labelling.street_figure import write_street_figure

    last = len(stages) - 1
    every = [(f"after {n} pass{'es' * (n > 1)}", stages[n]) for n in STAGES if n < last]
    write_street_figure([*every, (f"after {last} passes", street)], arguments.figure)


def _figures(arm: "LearnedArm") -> dict[str, float | int]:
    return {
        "edge_deg": math.degrees(arm.edge.mean_rad),
        "edge_std_deg": math.degrees(arm.edge.std_rad),
        "changes": arm.edge.changes,
        "pace_hz": arm.pace_hz,
        "pace_factor": math.exp(arm.pace_spread),
        "arrivals": arm.arrivals,
        "rate_per_minute": 60.0 * arm.rate_hz,
    }


def _line(arm: "LearnedArm") -> str:
    told = _figures(arm)
    return (
        f"{arm.direction:5}  edge {told['edge_deg']:.1f} +- {told['edge_std_deg']:.1f} degrees, "
        f"pace {arm.pace_hz:.2f} /s within a factor of {told['pace_factor']:.2f}, "
        f"{told['rate_per_minute']:.1f} a minute"
    )


def _heard(street: "LearnedStreet") -> str:
    left, right = street.patterns.weights
    told = "told apart by sound" if street.patterns.sides() is not None else "not told apart by sound"
    return f"sides  {told}; heard of {left:.1f} and {right:.1f} passes"
