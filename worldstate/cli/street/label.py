"""`worldstate street label`: compute trajectories and labelled windows of a recording with a camera.

Join the camera's boxes into passes and smooth each pass together with the seconds before it. The result is
the trajectory with its covariance, including the hidden phase, and T0, the first line of sight, with its
standard deviation. The ego must stand.

--out is JSON in the layout of ASAM OpenLABEL. --windows is a list of labelled seconds for `model features
--labels` and `model fit --labels`, so that your own recordings become training data without manual labels. It
must be in the folder of the recording or above it.

INPUT may also be a folder of `hear`. Then --windows lists all its recordings with a camera, by the times at
which vehicles were handed over to it (about 0.2 s late), without reading the recordings again. It must be in
the folder of the recordings.

Examples
--------
  worldstate street label street.wav --detections boxes.json --camera camera.json --out labels.json
  worldstate street label ovad_dataset/SA1/left/1_00_0002 --out labels.json --windows ovad_dataset/labels.csv
  worldstate street label heard --windows drives/labels.csv
  worldstate model fit features.csv --labels ovad_dataset/labels.csv --out model.json
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from worldstate import adapters
from worldstate.cli.common import inputs, output, progress
from worldstate.ground.errors import InvalidArgumentError
from worldstate.operations.corpus.corpus_inputs import CARD_NAME

if TYPE_CHECKING:
    from worldstate.operations.labelling.pass_labels import BoxTrack, PassLabel


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    inputs.add_sound_options(parser)
    inputs.add_sensor_options(parser)
    add = parser.add_argument_group("output").add_argument
    add("--out", type=Path, metavar="JSON", help="trajectories and T0, OpenLABEL; required for a recording")
    add("--windows", type=Path, metavar="CSV", help="labelled seconds for `model fit --labels`")
    add("--figure", type=Path, metavar="PNG", help="draw the passes as seen from above")
    site = "name of the place, S.. (default: S and the name of the folder)"
    add("--environment", metavar="NAME", help=site)


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return its result."""
    from worldstate.adapters.audio.sound_file import SoundStream
    from worldstate.adapters.datasets.ovad import read_true_tracks
    from worldstate.adapters.files.file_io import write_json, write_rows
    from worldstate.operations.labelling import label_files, pass_labels, street_figure

    output.check_outputs(arguments, "out", "windows", figures=("figure",))
    if (arguments.input[0] / CARD_NAME).is_file():
        return _of_corpus(arguments)
    if arguments.out is None:
        raise InvalidArgumentError("--out: expected it for a recording")
    source, detections = inputs.camera_source(arguments, arguments.input)
    if arguments.windows is not None and isinstance(source.sound, SoundStream):
        raise InvalidArgumentError("--windows: expected none for a bag, which `model features` does not read")
    file = None if arguments.windows is None else label_files.file_below(source.audio_path, arguments.windows)
    tracks = pass_labels.box_tracks(detections, source.camera, source.settings.boxes)
    with progress.progress_bar("smoothing", len(tracks)) as bar:
        passes = pass_labels.label_passes(tracks, source.camera.position_m[0], on_pass=bar.advance)
    write_json(arguments.out, label_files.open_label(source.audio_path.name, passes))
    if arguments.figure is not None:
        truth = read_true_tracks(source.audio_path.parent)
        street_figure.write_pass_figure(passes, arguments.figure, source.audio_path.name, truth)
    summary: dict[str, object] = {"out": str(arguments.out), "n_tracks": len(tracks), "n_passes": len(passes)}
    if passes:
        summary["t0_std_s"] = float(np.median([one.t0.std_s for one in passes]))
    if file is not None:
        rows = _windows(arguments, source, tracks, passes, file)
        write_rows(arguments.windows, label_files.COLUMNS, rows)
        summary |= {"windows": str(arguments.windows), "n_windows": len(rows)}
    lines = [
        f"{one.t0.time_s:9.2f} s +- {one.t0.std_s:.2f}  {one.arm:5}  {one.label}, {one.track.smoother}"
        for one in passes
    ]
    return output.CommandResult(summary, lines=lines)


def _of_corpus(arguments: argparse.Namespace) -> output.CommandResult:
    """List the windows of a folder of `hear`."""
    from worldstate.adapters.files.file_io import write_rows
    from worldstate.operations.labelling.label_files import COLUMNS, corpus_windows

    if arguments.windows is None or arguments.out is not None or len(arguments.input) > 1:
        raise InvalidArgumentError("--windows: expected it for a folder of `hear`, without --out")
    rows = list(corpus_windows(arguments.input[0]))
    write_rows(arguments.windows, COLUMNS, rows)
    return output.CommandResult({"windows": str(arguments.windows), "n_windows": len(rows)})


def _windows(
    arguments: argparse.Namespace,
    source: "adapters.Source",
    tracks: Sequence["BoxTrack"],
    passes: Sequence["PassLabel"],
    file: str,
) -> list[tuple[object, ...]]:
    from worldstate.adapters.audio.sound_file import open_sound
    from worldstate.operations.labelling.label_files import pass_windows

    with open_sound(source.sound, channels=source.array.channels) as audio:
        time_s = np.arange(10, int(10.0 * audio.duration_s) + 1) / 10.0
    seen = np.zeros(len(time_s), np.bool_)
    for one in tracks:
        seen |= (time_s >= one.time_s[0] - 0.05) & (time_s <= one.time_s[-1] + 0.05)
    environment = arguments.environment or f"S{source.audio_path.parent.name}"
    return pass_windows(passes, seen, time_s, environment, file)
