"""Let the whole world-state follow streams that were listened to, with a camera or without."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from worldstate.abduction.sequence.street_hearing import StreetListener
from worldstate.abduction.sequence.street_sides import arrival_pattern, somebody_comes
from worldstate.adapters.acoustic_sequence import street_listener
from worldstate.adapters.camera.detections import DetectionFilter
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.vision_query import VisionQuery, VisionSettings
from worldstate.adapters.files.acoustic_domain import heard_with
from worldstate.adapters.files.model_file import Model
from worldstate.commissioning.commission import parts_of, stream_evidence
from worldstate.commissioning.heard_stream import HeardStream
from worldstate.commissioning.sequence_training import stream_truth
from worldstate.core.filter import WorldFilter
from worldstate.measurement.measurement import Measurement
from worldstate.operations.labelling.street_passes import WatchedRecording, watched_recording
from worldstate.operations.labelling.street_sound import HeardStreet
from worldstate.simulation.scene.junction import site
from worldstate.state.context import Context, corner_at

from .followed_stream import followed, measurements
from .pass_outcomes import PassedStream
from .stream_camera import stream_detections, with_mover, without_passes

CameraKind = Literal["all", "cars", "none", "dies", "mover"]
# Everything that drives, however small its box; of OVAD's boxes its authors keep cars above 100 px.
EVERYBODY = DetectionFilter(frozenset({"car", "truck", "bus", "train", "motorcycle", "bicycle"}), 0.5, 20.0)


def passed_stream(
    path: Path,
    model: Model,
    camera: CameraKind = "all",
    seed: int = 0,
    alpha: float = 0.02,
    *,
    known_place: bool = False,
    learns: bool = True,
) -> PassedStream:
    """Return a stream with what the filter believed at every hop; `seed` draws the camera's misses.

    Where the place is known, the filter has its corners and lanes as a context file would say them. Unless
    told not to, it learns what either arm sounds like from whoever comes into view.

    Raises
    ------
    InvalidArgumentError
        If the model has no sequence, as `commission` makes one.
    """
    street = street_listener(model.domain, None, None) if learns else None
    heard, measured = stream_measurements(path, model, camera, seed, street)
    context = known_context(heard.site) if known_place else Context()
    world = WorldFilter(context, model.policies.for_alpha(alpha))
    return PassedStream(heard, stream_truth(heard), followed(world, measured, street))


def stream_measurements(
    path: Path, model: Model, camera: CameraKind, seed: int, street: StreetListener | None = None
) -> tuple[HeardStream, Iterator[Measurement]]:
    """Return a stream with what microphones and camera measure of it, hop by hop."""
    windows, sequence = parts_of(model)
    heard, vision = HeardStream.load(path), None
    if camera != "none":
        boxes = DetectionFilter() if camera == "cars" else EVERYBODY
        detections = stream_detections(heard, np.random.default_rng(seed))
        if camera == "dies":
            detections = without_passes(detections, heard)
        if camera == "mover":
            detections = with_mover(detections, heard)
        vision = VisionQuery(PinholeCamera(), detections, settings=VisionSettings(keep=boxes))
    evidence = stream_evidence(windows, heard)
    return heard, measurements(heard, windows, sequence, evidence, vision, street)


def watched_stream(path: Path, seed: int, model: Model) -> WatchedRecording:
    """Return the passes of a stream before a camera and what was heard; `seed` draws the camera's misses."""
    heard, camera = HeardStream.load(path), PinholeCamera()
    detections = stream_detections(heard, np.random.default_rng(seed), camera)
    seen = watched_recording(detections, camera, EVERYBODY, float(heard.hops.time_s[-1]))
    if model.domain is None:
        return seen
    windows, sequence = parts_of(model)
    groups = sequence.posterior(stream_evidence(windows, heard)).groups
    patterns, heard_by = arrival_pattern(heard.hops.feature), heard_with(model.domain)
    return replace(seen, heard=HeardStreet(heard.hops.time_s, patterns, somebody_comes(groups), heard_by))


def known_context(name: str) -> Context:
    """Return corners and lanes of a simulated site; who comes from the left drives in the nearer lane.

    Examples
    --------
    >>> [round(one.edge_azimuth_rad, 2) for one in known_context("SB1").occluders]
    [0.42, -0.52]
    """
    plan = site(name)
    near_m, far_m = plan.lanes_m
    left_m, right_m = (plan.corner_ahead_m, plan.corner_left_m), (plan.corner_ahead_m, -plan.corner_right_m)
    return Context(
        occluders=(corner_at("left", left_m, near_m), corner_at("right", right_m, far_m)), site=name
    )
