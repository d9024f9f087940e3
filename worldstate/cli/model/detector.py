r"""`worldstate model detector`: measure the miss rates of a detector on degraded images.

Measure beta(theta, d), the probability that a visible road user is missed, over azimuth and degradation.
Blur, darkness, sensor noise and all three together are applied to clean video in four levels each, and a
detection must overlap a reference box (IoU >= 0.3). False detections are counted apart, as clutter.

INPUT is a video, or a data set or recording folder in the OVAD layout with ueye_stereo_vid.mp4 beside the
sound, whose detections are the reference. For a video, --reference takes OVAD's or COCO's JSON, MOTChallenge
text or a folder of YOLO text. Without a reference the detector's own boxes on clean images are used, so that
its miss rate on these is zero.

The file also holds the scale that converts images of this camera to d.

Examples
--------
  worldstate model detector sim --detector motion --out beta.json --figure beta.png
  worldstate model detector street.mp4 --reference boxes.json --detector m.onnx \
      --labels person bicycle car --out beta.json
"""

import argparse
import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from worldstate import adapters, operations
from worldstate.adapters import own_parts
from worldstate.cli.common import inputs, output, progress
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.version import __version__
from worldstate.operations.detectors import miss_rate_measurement as measurement


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("input", type=Path, metavar="INPUT", help="video, recording folder or data set")
    add("--reference", type=Path, metavar="PATH", help="true boxes of a video")
    inputs.add_detector_option(parser)
    add("--labels", nargs="+", default=["car"], metavar="NAME", help="classes of an ONNX model")
    add("--half-angle", type=float, metavar="DEG", help="half the horizontal view (default: OVAD's camera)")
    add("--seed", type=int, default=0, help="seed of the noise (default: %(default)s)")
    add("--out", type=Path, required=True, metavar="JSON", help="file to write")
    add("--figure", type=Path, metavar="PNG", help="draw beta over d")


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return its result."""
    output.check_outputs(arguments, "out", figures=("figure",))
    make = own_parts.detector_maker(arguments.detector, tuple(arguments.labels))
    videos = measurement.find_videos(arguments.input)
    if arguments.reference is not None and len(videos) > 1:
        raise InvalidArgumentError(f"--reference: expected one video with it, got {len(videos)}")
    scenes = [_scene(arguments, make, *one) for one in videos]
    with progress.progress_bar("measuring", sum(scene.video.count for scene in scenes)) as bar:
        rng, about = np.random.default_rng(arguments.seed), _provenance(arguments, len(scenes))
        rates = operations.measure_absence(scenes, make, rng, provenance=about, on_frame=bar.advance)
    adapters.save_miss_rates(arguments.out, rates)
    if arguments.figure is not None:
        measurement.write_absence_figure(rates, arguments.figure)
    return output.CommandResult(_summary(arguments, rates))


def _scene(
    arguments: argparse.Namespace, make: measurement.MakeDetector, path: Path, reference: Path | None
) -> measurement.LabelledVideo:
    video = adapters.open_video(path)
    camera = adapters.PinholeCamera.ovad(width_px=video.width_px, height_px=video.height_px)
    if arguments.half_angle is not None:
        camera = replace(camera, half_angle_rad=math.radians(arguments.half_angle))
    boxes = arguments.reference or reference
    if boxes is None:
        return measurement.LabelledVideo(video, measurement.reference_by(make(), video), camera)
    found = adapters.read_any_detections(boxes, video.frame_rate_hz, (video.width_px, video.height_px))
    return measurement.LabelledVideo(video, found, camera)


def _provenance(arguments: argparse.Namespace, videos: int) -> dict[str, str]:
    return {
        "data": arguments.input.name,
        "videos": str(videos),
        "detector": own_parts.detector_name(arguments.detector),
        "seed": str(arguments.seed),
        "worldstate": __version__,
    }


def _summary(arguments: argparse.Namespace, rates: "adapters.MissRates") -> dict[str, object]:
    table = rates.table
    summary: dict[str, object] = {
        "out": str(arguments.out),
        **rates.provenance,
        "looks": sum(sum(row[:1]) for row in next(iter(rates.families.values())).looks),
        "beta_clean_boresight": table(0.0, 0.0),
        "beta_harshest_boresight": table(0.0, 1.0),
        "clutter_clean": rates.clutter_rate(0.0),
    }
    for name, family in rates.tables.items():
        summary[f"beta_{name}_boresight"] = list(family.beta[0])
        summary[f"beta_{name}_edge"] = list(family.beta[-1])
    return summary
