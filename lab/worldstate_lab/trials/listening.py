"""Passes over the sound of one recording: values of the front-end, and decisions of the whole chain."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from worldstate.abduction.cueing.cueing_policy import CueingPolicy, sustained_alarm
from worldstate.abduction.evidence import SignatureEvidence
from worldstate.abduction.grounding.grounded_likelihood import GroundedSettings
from worldstate.adapters.acoustic import Grounding, observe
from worldstate.adapters.audio.sound_file import AudioSource, open_audio
from worldstate.adapters.camera.detections import DetectionLog, kept_and_parked
from worldstate.adapters.camera.vision_query import VisionQuery
from worldstate.adapters.datasets.ovad import read_true_tracks
from worldstate.adapters.files.acoustic_domain import feature_order
from worldstate.adapters.files.array_match import TRAIN
from worldstate.adapters.files.model_file import Model
from worldstate.adapters.listener import Step, listen_steps, measure_steps
from worldstate.adapters.source import ListenSettings, Source, open_source
from worldstate.frontend.approach.doppler import radial_speed
from worldstate.frontend.approach.engine_line import track_fundamental
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.array.steering import one_blas_thread
from worldstate.frontend.direction.feature import feature_nfft
from worldstate.frontend.direction.music import music_spectrum, signal_subspace
from worldstate.frontend.settings import BEARING_HOPS, HOP_RATE_HZ, FrontEndSettings
from worldstate.frontend.spectra.stft import StreamingStft, band_bins, bin_frequencies_hz
from worldstate.frontend.stream import AcousticFrame
from worldstate.ground.errors import OutOfDomainError
from worldstate.ground.typing import AnyArray, BoolArray, Float32Array, FloatArray
from worldstate.ground.values import NotUsable, nanoseconds, seconds, wrap_angle
from worldstate.operations.recordings.hop_table import HOP_S, HopTable, hop_stream
from worldstate.state import Entity, WorldState
from worldstate_lab.metrics.stream_statistic import stream_statistic

from .trial import (
    BOX_COLUMNS,
    DECISION_COLUMNS,
    LEFT,
    NO_SIDE,
    RIGHT,
    TRACK_COLUMNS,
    TRUTH_COLUMNS,
    Decisions,
    Take,
)

# Increased whenever a pass over the same recording would give different numbers.
VERSION = 6
# Two settings of the library: with the initial reference of the site, and with a reference that is learned.
CHAINS = {"plain": ListenSettings(site_adaptation=False), "adapted": ListenSettings()}
# The grounded likelihood without its approach rate, for an ablation.
RATELESS = Grounding(settings=GroundedSettings(without=frozenset({"radial_speed_m_s", "inverse_tta_hz"})))
SIDES = {"left": LEFT, "right": RIGHT}
# An entity counts as a track if its existence probability is above this value.
LIKELY = 0.5
# In the paper a usable tone needs harmonics that agree; a single line is not sufficient.
LEAST_PARTIALS = 2
# The tone of a pass-by is searched for within this time of line-of-sight entry, so that a stream of one hour
# is not read into memory.
AROUND_S = 15.0
# Speed is nearly constant over a second: the tangent of the azimuth is linear in time over this many images.
LAST_IMAGES, LONGEST_FORECAST_S = 10, 5.0


class _Silent:
    """A classifier with constant output: the features are classified later."""

    def evidence(self, feature: ArrayLike, /) -> SignatureEvidence:
        return SignatureEvidence(("left", "right"), (0.0, 0.0), 0.0, 0.0)


def front_end_tables(take: Take) -> dict[str, HopTable]:
    """Return `hops`, `boxes` and `truth` of a recording in the format of a `Trial`; no model is used.

    `hops` has an `approach` score, `log_slope_hz` of looming, and `srp_rad` and `music_rad` with the
    `reference_rad` of the camera's moving box. `about` contains the time of the pass and, if the tone of the
    pass-by cannot be used, the reason.
    """
    source = open_source(take.path, settings=ListenSettings(uncalibrated=True))
    vision = source.camera_channel()
    boxes = box_table(source, vision)
    truth = _truth(take, boxes)
    pairs = list(measure_steps(replace(source, model=_Silent())))
    frames = [frame for frame, _ in pairs]
    columns = columns_of(hop_stream((m for _, m in pairs), name=take.name), frames, vision)
    with open_audio(source.audio_path, strict=False) as audio:
        columns["music_rad"] = _music(audio, source.array, frames, np.isfinite(columns["reference_rad"]))
        doppler = "no vehicle" if take.t0_s is None else _tone_of_pass(audio, source.array, take.t0_s)
    about = {
        "site": take.site,
        "moving": take.moving,
        "camera": source.detections is not None,
        "pass_s": None if take.t0_s is None else pass_time_s(truth),
        "doppler": doppler,
    }
    t0_s = np.nan if take.t0_s is None else take.t0_s
    hops = HopTable(columns, take.name, take.label, t0_s, about)
    return {"hops": hops, "boxes": boxes, "truth": truth}


def columns_of(stream: HopTable, frames: Sequence[AcousticFrame], vision: VisionQuery) -> dict[str, AnyArray]:
    """Return the columns of a trial that need no model, from a hop stream, its frames and moving boxes."""
    measured = ("time_s", "answer", "miss_rate", "clutter_rate", "approach", "seen")
    named = ("features", "prominence", "log_slope_hz", "bearing_rad")
    heard = HopTable.of_rows(named, map(frame_row, frames)).columns
    reference = np.array([reference_rad(frame, vision) for frame in frames])
    srp = np.where(np.isfinite(reference), heard["bearing_rad"], np.nan)
    measures = {name: stream.columns[name] for name in measured}
    return {**measures, **heard, "reference_rad": reference, "srp_rad": srp}


def with_scores(hops: HopTable, stream: HopTable, model: Model) -> HopTable:
    """Return the hops of a trial with the scores of a model, and its prior for each of them."""
    scores = {"shipped": stream.log_likelihoods, "grounded": stream.grounded, "rateless": stream.rateless}
    prior = {key: list(model.signature.reference_prior) for key in scores}
    return hops.replace(**scores, about={**hops.about, "prior": prior})


def model_refusal(take: Take, model: Model) -> str | None:
    """Return why a model does not fit the sound of a recording; None if it fits or has no array."""
    # An uncalibrated chain has no sequence model, but it raises no error before the reason is returned here.
    source = open_source(take.path, model=model, settings=replace(CHAINS["plain"], uncalibrated=True))
    domain = model.domain
    if domain is None:
        return None
    with open_audio(source.audio_path, strict=False) as audio:
        rate_hz = audio.sample_rate_hz
    try:
        feature_order(domain, source.array, rate_hz, source.settings.front_end(source.array, rate_hz), TRAIN)
    except OutOfDomainError as error:
        return str(error)
    return None


def chain_tables(take: Take, chain: str, model: Path | None = None) -> dict[str, HopTable]:
    """Return the results of the whole chain on a recording: `decisions`, `tracks` and its hop `stream`."""
    source = open_source(take.path, model=model, settings=CHAINS[chain])
    return tables_of_steps(take.name, listen_steps(source))


def tables_of_steps(name: str, steps: Iterable[Step]) -> dict[str, HopTable]:
    """Return `decisions`, `tracks` and the hop `stream` of the steps of a recording."""
    rows, tracks, measured, grounded = [], [], [], []
    identities: dict[str, int] = {}
    for step in steps:
        measured.append(step.measurement)
        grounded.append([_grounded(step, grounding) for grounding in (Grounding(), RATELESS)])
        rows.append(_decided(step.state))
        for entity in likely_movers(step.state):
            number = identities.setdefault(entity.id, len(identities))
            tracks.append((step.state.time_s, number, entity.azimuth_rad))
    stream = hop_stream(measured, name=name)
    return {
        "decisions": HopTable.of_rows(DECISION_COLUMNS, rows),
        "tracks": HopTable.of_rows(TRACK_COLUMNS, tracks),
        "stream": stream.replace(**HopTable.of_rows(("grounded", "rateless"), grounded).columns),
    }


def _grounded(step: Step, grounding: Grounding) -> FloatArray:
    """Weight the model's scores with bearing, approach rate and engine line, eq. (5)."""
    heard = step.measurement
    observation = observe(step.frame, heard.bearing, heard.approach)
    return grounding.answer(heard.signature, observation).evidence.log_likelihoods


def filtered_decisions(tables: Mapping[str, HopTable]) -> Decisions:
    """Convert the filter's results in `chain_tables` to the decisions format of all methods."""
    return Decisions(**tables["decisions"].columns, tracks=tables["tracks"])


def unfiltered_decisions(tables: Mapping[str, HopTable], policy: CueingPolicy) -> Decisions:
    """Return the decisions of the model's scores and its policy, hop by hop, without the filter."""
    stream = tables["stream"]
    score = stream_statistic(stream, policy.reference_prior)
    left, right = stream.log_likelihoods[:, 0], stream.log_likelihoods[:, 1]
    return Decisions.of(
        stream.time_s,
        sustained_alarm(score >= policy.gamma, policy.sustain_hops),
        side=np.where(left >= right, LEFT, RIGHT),
        score=score,
        risk=policy.risk_map(score),
    )


def pass_time_s(truth: HopTable) -> float | None:
    """Return when the first vehicle crosses the ego's axis; None if it cannot be determined.

    After the last image, the tangent of its azimuth, which is linear in time at constant speed, is
    extrapolated.
    """
    chosen = truth.vehicle == 0 if len(truth) else np.zeros(0, bool)
    time_s, azimuth = truth.time_s[chosen], truth.azimuth_rad[chosen]
    crossed = np.flatnonzero(np.diff(np.sign(azimuth)) != 0)
    if crossed.size:
        i = int(crossed[0])
        share = azimuth[i] / (azimuth[i] - azimuth[i + 1])
        return float(time_s[i] + share * (time_s[i + 1] - time_s[i]))
    late = slice(-LAST_IMAGES, None)
    if time_s[late].size < 3:
        return None
    slope, offset = np.polyfit(time_s[late], np.tan(azimuth[late]), 1)
    when = -offset / slope if slope else np.inf
    return float(when) if 0.0 < when - time_s[-1] < LONGEST_FORECAST_S else None


def frame_row(frame: AcousticFrame) -> tuple[Any, ...]:
    """Return the values of a hop that methods use, so that an hour of sound needs only about 10 MB."""
    slope = np.nan if isinstance(frame.looming, NotUsable) else frame.looming.log_slope_hz
    # The paper's prominence is that of the decision window, not of the shorter window of the bearing.
    median = float(np.median(frame.srp))
    prominence = float(frame.srp.max()) / median if median else 1.0  # No sound
    return frame.feature, prominence, slope, frame.bearing_rad


def _decided(state: WorldState) -> tuple[Any, ...]:
    raised = [cue for cue in state.cues if cue.advisory]
    told = max(raised or state.cues, key=lambda cue: cue.risk, default=None)
    # The score is the value that the alarm compares with its threshold, as a probability, so that other
    # thresholds can be applied to it.
    nats = max((cue.evidence.compared_nats for cue in state.cues if cue.evidence), default=np.nan)
    score = 1.0 / (1.0 + np.exp(-nats))
    side = SIDES.get(told.direction or "", NO_SIDE) if raised and told is not None else NO_SIDE
    horizon_s = np.nan if told is None or told.horizon_s is None else told.horizon_s
    visible_s = np.nan, horizon_s, np.nan
    return state.time_s, bool(raised), side, _bearing(state), score, state.risk, visible_s


def _bearing(state: WorldState) -> float:
    """Return the azimuth of the moving entity with the highest existence probability, NaN if none exists."""
    # The azimuth of a cue is not used: with a vehicle in view, both hidden sides have a negligible risk, at
    # 55 degrees.
    strongest = max(likely_movers(state), key=lambda one: one.existence_probability, default=None)
    return np.nan if strongest is None else strongest.azimuth_rad


def likely_movers(state: WorldState) -> list[Entity]:
    """Return the moving entities that probably exist."""
    return [one for one in state.entities if one.moving and one.existence_probability >= LIKELY]


def nearest_entity(entities: Iterable[Entity], azimuth_rad: float, most_rad: float) -> Entity | None:
    """Return the entity nearest to an azimuth, None if all are farther than a limit."""
    apart = [(abs(wrap_angle(one.azimuth_rad - azimuth_rad)), one.id, one) for one in entities]
    distance, _, nearest = min(apart, default=(np.inf, "", None))
    return nearest if distance <= most_rad else None


def box_table(source: Source, vision: VisionQuery) -> HopTable:
    """Return the boxes of a camera with the columns of a trial."""
    log = source.detections or DetectionLog((), np.empty(0, np.int64))
    rows: list[tuple[Any, ...]] = []
    for number, frame in enumerate(log.frames):
        kept, still = kept_and_parked(log, number, vision.keep)
        moving = set(kept[~still].tolist())
        for i, box in enumerate(frame.boxes_px):
            sighting = source.camera.sighting(box, frame.labels[i], float(frame.scores[i]))
            time_s = seconds(int(log.stamps_ns[number]))
            found = frame.scores[i], frame.labels[i], sighting.azimuth_rad, i in moving
            rows.append((number, time_s, box, *found))
    if not rows:
        return HopTable.of_rows(BOX_COLUMNS, ()).replace(
            box_px=np.empty((0, 4)), class_name=np.empty(0, "U1")
        )
    return HopTable.of_rows(BOX_COLUMNS, rows)


def _truth(take: Take, boxes: HopTable) -> HopTable:
    """Return the simulation's tracks, or the widest moving box of each image if there is no other truth."""
    rows: list[tuple[float, int, float, bool]] = []
    for vehicle, track in enumerate(read_true_tracks(take.path)):
        moments = zip(track.time_s, track.azimuth_rad, track.in_view, strict=True)
        rows += [(time_s, vehicle, azimuth, seen) for time_s, azimuth, seen in moments]
    if not rows and take.t0_s is not None:
        rows = widest_moving(boxes)
    return HopTable.of_rows(TRUTH_COLUMNS, rows)


def widest_moving(boxes: HopTable) -> list[tuple[float, int, float, bool]]:
    """Return the azimuth of the widest moving box of each image, as rows of the truth of a trial."""
    widest: dict[float, tuple[float, float]] = {}
    for i in np.flatnonzero(boxes.moving):
        width = float(boxes.box_px[i, 2] - boxes.box_px[i, 0])
        known = widest.get(float(boxes.time_s[i]), (0.0, 0.0))
        widest[float(boxes.time_s[i])] = max(known, (width, float(boxes.azimuth_rad[i])))
    return [(time_s, 0, azimuth, True) for time_s, (_, azimuth) in sorted(widest.items())]


def reference_rad(frame: AcousticFrame, vision: VisionQuery) -> float:
    """Return the azimuth of the moving box nearest to the acoustic bearing, NaN if there is none."""
    # Half a camera period is added, so that the latest image is the one nearest in time to the centre of the
    # bearing's window.
    stamp = nanoseconds(seconds(frame.stamp_ns) - frame.bearing_age_s + 0.5 * HOP_S)
    moving = [seen.azimuth_rad for seen in vision.sightings(stamp) if seen.moving]
    return min(moving, key=lambda azimuth: abs(azimuth - frame.bearing_rad), default=np.nan)


def _tone_of_pass(audio: AudioSource, array: MicrophoneArray, t0_s: float) -> str:
    """Return why the tone of the pass-by cannot be used at the microphone nearest to the centre, or ""."""
    middle = int(np.argmin(np.linalg.norm(array.centred_m, axis=1)))
    rate = audio.sample_rate_hz
    first = round(max(t0_s - AROUND_S, 0.0) * rate)
    count = min(round(2.0 * AROUND_S * rate), audio.frames - first)
    return tone_refusal(audio.span(first, count)[:, middle], rate)


def tone_refusal(samples: Float32Array, rate_hz: float) -> str:
    """Return why the tone of a pass-by cannot be used, or ""."""
    track = track_fundamental(np.ascontiguousarray(samples), rate_hz)
    found = radial_speed(track, min_partials=LEAST_PARTIALS)
    return found.reason if isinstance(found, NotUsable) else ""


def _music(
    audio: AudioSource, array: MicrophoneArray, frames: Iterable[AcousticFrame], wanted: BoolArray
) -> FloatArray:
    """Return MUSIC bearings from the samples of the SRP bearings, NaN for hops without a request."""
    rate = audio.sample_rate_hz
    chosen = FrontEndSettings(nfft=feature_nfft(rate))
    bins = band_bins(chosen.srp_band_hz, rate, chosen.nfft)
    azimuths = chosen.azimuths_rad()
    steering = array.steering(bin_frequencies_hz(bins, rate, chosen.nfft), azimuths).astype(np.complex64)
    length = round(BEARING_HOPS * rate / HOP_RATE_HZ)
    bearings = np.full(wanted.size, np.nan)
    with one_blas_thread():
        for i, frame in enumerate(frames):
            if wanted[i]:
                start = max(frame.sample_index - length, 0)
                stft = StreamingStft(array.n_microphones, chosen.nfft, bins)
                spectra = stft.push(audio.span(start, frame.sample_index - start))
                bearings[i] = azimuths[music_spectrum(signal_subspace(spectra, 1), steering).argmax()]
    return bearings
