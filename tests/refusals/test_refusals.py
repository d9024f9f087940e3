"""Arguments that are refused, one row for each. Damaged files have their own tests."""

import io
import json
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hop_tables import blank_stream

from worldstate import Context, Listener, NotUsable, SignatureEvidence, WorldFilter, measurement, simulation
from worldstate.abduction.co_evidence import Absent, MissRateTable, default_miss_rates, isotonic_grid
from worldstate.abduction.cueing import risk_map
from worldstate.abduction.cueing.cueing_policy import CueingPolicy, neyman_pearson_threshold
from worldstate.abduction.evidence import SideEvidence, abduce, statistic
from worldstate.abduction.grounding import grounded_likelihood as grounding
from worldstate.abduction.road_users import DomainGuard
from worldstate.abduction.sequence.sequence_inputs import INPUTS
from worldstate.abduction.sequence.sequence_model import GROUPS, BoostedTrees
from worldstate.abduction.sequence.sequence_reader import SequenceReading
from worldstate.abduction.sequence.street_sides import SidePatterns
from worldstate.abduction.signature.ensemble_training import SiteEnsembleClassifier
from worldstate.abduction.signature.site_estimate import SiteEstimate
from worldstate.abduction.signature.window_classes import CLASSES, checked_classes
from worldstate.adapters import ListenSettings, PinholeCamera
from worldstate.adapters.audio.sound_file import RawPcm
from worldstate.adapters.camera import camera_health
from worldstate.adapters.camera.detections import DetectionFilter, DetectionFrame, DetectionLog
from worldstate.adapters.files.model_file import read_model
from worldstate.adapters.listener import listen_steps
from worldstate.adapters.live.live_sensors import DetectionSocket
from worldstate.adapters.source import open_source
from worldstate.core.budget_watch import RATES, BudgetWatch, Evidence
from worldstate.frontend import FrontEnd, FrontEndSettings, GivenSpectra, MicrophoneArray, ovad_array
from worldstate.frontend.approach.engine_line import track_fundamental
from worldstate.frontend.approach.looming import looming
from worldstate.frontend.approach.tone import estimate_tone
from worldstate.frontend.bounds import cramer_rao
from worldstate.frontend.direction.feature import published_feature
from worldstate.frontend.direction.gcc_phat import gcc_delays
from worldstate.frontend.direction.music import count_sources, covariance, music_spectrum, signal_subspace
from worldstate.frontend.given_spectra import SpectrumFrontEnd
from worldstate.frontend.spectra.stft import StreamingStft
from worldstate.ground.errors import InvalidArgumentError, WorldstateError
from worldstate.ground.serialisation import decode
from worldstate.ground.values import nanoseconds
from worldstate.operations.calibration.cueing_calibration import calibrate_cueing, correlation_time_hops
from worldstate.operations.recordings.channel_report import rate_from_duration
from worldstate.operations.recordings.hop_table import hop_stream
from worldstate.operations.viewing.log_page import page_data
from worldstate.simulation.scene.kinds import vehicle_kind
from worldstate.simulation.scene.occluders import OccludingBody
from worldstate.simulation.scene.settings import sound_kind
from worldstate.simulation.stream.settings import StreamSettings, Traffic
from worldstate.smoothing import FixedLagSmoother
from worldstate.smoothing.learned_street import LearnedStreet, forgotten

NAN, RNG = math.nan, np.random.default_rng(0)
SIDES, OFF, SHARE = ("left", "right"), NotUsable("-"), np.full(len(GROUPS), 1.0 / len(GROUPS))
ONE, TWO = (SignatureEvidence(sides, (0.0,) * len(sides), 0.0, 0.0) for sides in (SIDES[:1], SIDES))
MODEL, LISTENER = read_model(), Listener(ovad_array(), 48_000)
BETA = ((0.2, 0.3), (0.3, 0.4))
STUMP = {
    **{"split": [[0, 0, 0]], "threshold": [[0.5, 0.0, 0.0]], "yes": [[1, 1, 2]], "no": [[2, 1, 2]]},
    **{"value": [[0.0, -1.0, 1.0]], "tree_class": [0], "baseline": [0.0, 0.0]},
}
EMPTY, GREY = DetectionFrame(np.empty((0, 4)), np.empty(0), ()), np.full((40, 60, 3), 90, np.uint8)
CAR, LOOK = (
    measurement.Sighting(0.1, 0.02, "car", 0.9),
    measurement.Look("camera", 10**8, Absent(0.04), (-0.5, 0.5)),
)
READING = SequenceReading(np.stack([SHARE, SHARE]), SHARE)
HOP = measurement.Measurement(
    10**8, SignatureEvidence(SIDES, (4.0, 0.0), 2.0, 0.0), Absent(0.04), OFF, OFF, (CAR,)
)
LIKELIHOODS = {
    "a likelihood of None": (None, 0.0),
    "a likelihood that is no number": (NAN, 0.0),
    "a likelihood for one of two sides": (0.0,),
    "a likelihood of 1e30 nats": (1e30, 0.0),
}
SQUARE = MicrophoneArray([[0.1, 0.1, 0], [0.1, -0.1, 0], [-0.1, -0.1, 0], [-0.1, 0.1, 0]])
PAIR, POLE = MicrophoneArray([[0, 0.1, 0], [0, -0.1, 0]]), [[0, 0, 0], [0, 0, 1.0]]
SEVEN = MicrophoneArray(ovad_array().positions_m[::8])
TIMES_S, BAND_HZ = np.arange(-0.95, 0.0, 0.1), np.arange(300.0, 1800.0, 50.0)
AHEAD_RAD, QUIET = np.radians(np.linspace(-90.0, 90.0, 180)), np.full((3, 180), 0.2)
STREET = simulation.site("SA1")
STREAM = StreamSettings(STREET, 1.0)


def call_of(function, *given, **usual):
    """Return a function that prepares a call by its further arguments."""
    return partial(partial, function, *given, **usual)


misses = call_of(MissRateTable, azimuth_deg=(0, 30), degradation=(0, 1))
policy = call_of(replace, CueingPolicy(0.78, 3, 0.02, (0.25,) * 4, risk_map.PlattMap(-1.0, 0.0)))
threshold = call_of(neyman_pearson_threshold, alpha=0.1)
signature, window = call_of(replace, MODEL.signature), call_of(MODEL.signature.predict_proba)
prior = call_of(abduce, evidence=TWO, co_evidence=Absent(0.1))
camera, degraded = call_of(PinholeCamera.ovad), call_of(camera_health.degrade, rng=RNG)
trees, hop = call_of(BoostedTrees, **STUMP), call_of(replace, HOP)
grounded = call_of(grounding.ground, ONE, grounding.GroundedObservation())
position = call_of(measurement.Position, position_m=(1.0, 0.0), covariance=((1.0, 0.0), (0.0, 1.0)))
bearing_bound = call_of(cramer_rao.bearing_crb_rad2, frequencies_hz=1e3, snr=1.0, snapshots=1)
feature = call_of(published_feature, array=SEVEN, sample_rate_hz=47_998)
delays = call_of(gcc_delays, spectra=np.ones((3, 30, 2)), frequencies_hz=BAND_HZ, max_delay_s=1e-3)
spectra = call_of(GivenSpectra, values=QUIET, azimuths_rad=AHEAD_RAD, array=SEVEN)
scene = call_of(simulation.SimulationSettings, site=STREET, approach="left")
data_set, sound = call_of(simulation.DatasetSettings), call_of(simulation.SoundSettings)


def fitted(width, labels):
    return partial(SiteEnsembleClassifier().fit, RNG.random((8, width)), np.array(labels))


def checkpoint(change):
    """Return a call that reads a checkpoint after a change."""
    written = json.loads(json.dumps(WorldFilter().update(replace(HOP, sequence=READING)).to_dict()))
    change(written)
    return partial(WorldFilter.from_dict, written)


def watch(**changes):
    return lambda: replace(BudgetWatch(), **changes).check(2)


def heard_at(rate):
    noise = RNG.uniform(-0.1, 0.1, (2 * rate, 56)).astype("<f4")
    pipe = RawPcm(io.BytesIO(noise.tobytes()), rate, 56, "f32")
    return lambda: list(listen_steps(open_source(pipe, array=ovad_array())))


def searched(half_width_rad, range_m=10.0):
    return lambda: measurement.SearchedSector(measurement.Sector(0.0, half_width_rad), range_m, 0.5)


def front_end(rate_hz, array=SQUARE, **settings):
    return lambda: FrontEnd(array, rate_hz, FrontEndSettings(**settings))


def line(low_hz, high_hz):
    return front_end(8_000, PAIR, tone_band_hz=(low_hz, high_hz))


def block(samples):
    return lambda: FrontEnd(SQUARE, 16_000).process(samples)


def beside_spectra(samples):
    settings = FrontEndSettings(level_band_hz=(50.0, 2700.0))
    return lambda: SpectrumFrontEnd(spectra()(), 48_000, settings).process(samples)


def smooth(measured):
    smoother = FixedLagSmoother()
    smoother.update(0, {"car": [measured]})
    smoother.track("unknown")


REFUSALS: dict[str, tuple[Callable[[], object], str]] = {
    # Evidence, models and policies
    "miss rate that falls with degradation": (misses(beta=((0.2, 0.1), (0.3, 0.4))), "beta"),
    "miss rate that falls with azimuth": (misses(beta=((0.2, 0.3), (0.1, 0.4))), "beta"),
    "miss rate above one": (misses(beta=((0.2, 1.3), (0.3, 1.4))), "beta"),
    "miss rates without a row for each azimuth": (misses(beta=((0.2, 0.3),)), "beta"),
    "azimuths that do not begin at zero": (misses(beta=BETA, azimuth_deg=(5, 30)), "azimuth_deg"),
    "azimuths that fall": (misses(beta=BETA, azimuth_deg=(30, 0)), "azimuth_deg"),
    "degradation outside of the table": (partial(default_miss_rates(), 0.0, 1.2), "degradation"),
    "grid with a weight of zero": (partial(isotonic_grid, [[0.5]], [[0.0]]), "weights"),
    "grid with more weights than values": (partial(isotonic_grid, [[0.5]], [[1.0, 1.0]]), "weights"),
    "threshold without recordings": (threshold([]), "window"),
    "threshold of an empty recording": (threshold([[]]), ""),
    "threshold of a score that is no number": (threshold([[0.5, NAN]]), ""),
    "threshold for a budget of one": (threshold([[0.5]], alpha=1.0), "alpha"),
    "threshold for no hops": (threshold([[0.5]], sustain_hops=0), "hops"),
    "policy that is sustained for no hops": (policy(sustain_hops=0), "sustain_hops"),
    "policy with a budget of one": (policy(alpha=1.0), "alpha"),
    "policy with a prior of two classes": (policy(reference_prior=(0.5, 0.5)), "reference_prior"),
    "policy with a miss rate above one": (policy(miss_rate=2.0), "miss_rate"),
    "risk map that falls": (partial(risk_map.PlattMap, 1.0, 0.0), "slope"),
    "risk map of falling statistics": (partial(risk_map.IsotonicMap, (0.5, 0.1), (0.0, 1.0)), "do not fall"),
    "risk map with a risk above one": (partial(risk_map.IsotonicMap, (0.1, 0.5), (0.0, 1.5)), "risks"),
    "prior of two explanations for four": (prior([0.0, 0.0]), "log_prior"),
    "prior that is no number": (prior([0.0, 0.0, NAN, 0.0]), "log_prior"),
    "prior that excludes everything": (prior([-math.inf] * 4), "log_prior"),
    "observation that nothing explains": (
        prior([-math.inf, 0.0, -math.inf], evidence=ONE, co_evidence=Absent(0.0)), "co-evidence"),
    "negative prior of a statistic": (partial(statistic, ONE, Absent(0.0), (0.5, -0.1, 0.6)), "negative"),
    "no descriptors": (grounded([]), "descriptors"),
    "one descriptor twice": (grounded([grounding.car(), grounding.car()]), "descriptors"),
    "coupling with one speed twice": (
        partial(grounding.Coupling, "x", (1.0, 1.0), ((0.0, 1.0),), 1.0), "rising"),
    "descriptor with one observable twice": (
        partial(grounding.Descriptor, "car", (), 1.0, 8.0, 1.0, (grounding.engine_line(),) * 2),
        "each observable once"),
    "guard with one bias for three classes": (
        partial(DomainGuard, ("x",), ("speech",), ("siren",), np.zeros((3, 1)), np.zeros(1), 1.0, 1.0),
        "biases"),
    "tree with a cycle": (trees(yes=[[1, 0, 2]]), "yes"),
    "tree with one leaf as both answers": (trees(no=[[2, 2, 2]]), "leaf"),
    "tree with two ways to a node": (trees(no=[[1, 1, 2]]), "one way to every node"),
    "tree that splits by an unknown input": (trees(split=[[900, 0, 0]]), "split"),
    "tree of an unknown class": (trees(tree_class=[3]), "tree_class"),
    "sequence model with other inputs": (
        partial(replace, MODEL.sequence, inputs=INPUTS[1:]), "inputs: expected the first"),
    "side patterns with one sector": (partial(SidePatterns, sums=((0.0,), (0.0,))), "12 sectors"),
    "site estimate of a negative duration": (
        partial(decode, SiteEstimate, {"level": [0.0], "heard_s": -1.0}, "file"), "heard_s"),
    "site estimate of 30 features beside a model of 60": (
        partial(SiteEstimate.start(30).reference, MODEL.signature), "60"),
    "ensemble of too many experts": (signature(experts=MODEL.signature.experts * 20), "experts"),
    "ensemble with a short reference": (signature(home=MODEL.signature.home[:-6]), "home"),
    "expert of an unknown view": (partial(replace, MODEL.signature.experts[0], view="colour"), "view"),
    "window of 59 features": (window(np.zeros((3, 59))), "X"),
    "window without a row": (window(np.zeros(60)), "X"),
    "window that is no number": (window(np.full((1, 60), NAN)), "X"),
    "training without references": (fitted(61, (*CLASSES, *CLASSES)), "reference"),
    "training without a class": (fitted(240, ("left", "front", "right", "left") * 2), "classes"),
    "window classes without front and none": (partial(checked_classes, ("left", "right")), "classes"),
    "window classes in another order": (partial(checked_classes, (*CLASSES, "direct", "both")), "classes"),
    # Cameras, ports and sound
    "camera with a view of 180 degrees": (camera(half_angle_rad=1.6), "half_angle_rad"),
    "camera without columns": (camera(width_px=0), "width_px"),
    "camera with a nominal range of 0.5 m": (camera(nominal_range_m=0.5), "nominal_range_m"),
    "camera that looks up": (camera(pitch_rad=2.0), "pitch_rad"),
    "camera with a yaw that is no number": (camera(yaw_rad=NAN), "yaw_rad"),
    "camera with two coordinates": (camera(position_m=(0.0, 0.0)), "position_m"),
    "box outside of the image": (
        partial(PinholeCamera.ovad().sighting, (2000, 0, 2100, 200), "car", 0.9), "1936"),
    "filter with a score above one": (partial(DetectionFilter, min_score=1.5), "min_score"),
    "filter with a negative height": (partial(DetectionFilter, min_height_px=-1.0), "min_height_px"),
    "two stamps for one image": (partial(DetectionLog, (EMPTY,), np.array([1, 2])), "one per frame"),
    "health of no images": (partial(camera_health.learn_health, [], RNG), "image"),
    "health with sharpness that rises": (
        partial(camera_health.CameraHealth, 100.0, (1.0, 2.0, 1.0, 1.0, 1.0), (0.0,) * 5), "sharpness"),
    "degradation with one stamp twice": (
        partial(camera_health.DegradationLog, np.array([0, 0]), np.array([0.0, 0.0])), "stamps"),
    "quality of an image without colours": (
        partial(camera_health.image_quality, np.zeros((4, 4), np.uint8)), ""),
    "degradation by fog": (degraded(GREY, "fog", 0.5), ""),
    "degradation above one": (degraded(GREY, "blur", 1.5), ""),
    **{f"look at {stamp!r}": (partial(LISTENER.look, stamp, EMPTY), "stamp_ns")
       for stamp in (None, "0", 1.5e9, NAN, 10**40)},
    "look without an image": (partial(LISTENER.look, 0, None), "look: expected a DetectionFrame"),
    "measurement of None": (partial(LISTENER.add, None), "add: expected Measurement"),
    "forgetting time of zero": (partial(ListenSettings, forgetting_s=0.0), "forgetting_s"),
    **{f"address {one}": (partial(DetectionSocket, one, nanoseconds), "expected HOST:PORT")
       for one in ("9100", "127.0.0.1:x", "127.0.0.1:70000")},
    **{f"sound at {rate} Hz": (heard_at(rate), f"at least 6000 Hz, got {rate} Hz")
       for rate in (3_000, 5_800)},
    # Measurements, checkpoints and times of the filter
    "bearing with a spread of zero": (partial(measurement.Bearing, 0.1, 0.0), "std_rad: .* got 0.0"),
    "sighting of None": (hop(sightings=(CAR, None)), r"sightings\[1\]: expected Sighting"),
    "33 further cameras": (
        hop(look=LOOK, further=(measurement.CameraLook(LOOK),) * 33), "further: expected at most 32, got 33"),
    "box beyond half a turn": (partial(replace, CAR, azimuth_rad=4.0), "azimuth_rad"),
    **{f"{name} in evidence": (partial(SignatureEvidence, SIDES, bad, 0.0, 0.0), "hidden")
       for name, bad in LIKELIHOODS.items()},
    **{f"{name} in sides": (partial(SideEvidence, SIDES, bad, 0.0, 0.0, 0.0), "log_ratios")
       for name, bad in LIKELIHOODS.items()},
    "position 1,000 km away": (position(position_m=(1e6, 0.0)), r"position_m\[0\]: expected a number in"),
    "velocity without its covariance": (position(velocity_mps=(1.0, 0.0)), r"covariance: .* \(4, 4\)"),
    "indefinite covariance": (position(covariance=((1.0, 2.0), (2.0, 1.0))), "covariance: .* symmetric"),
    "asymmetric covariance": (position(covariance=((1.0, 0.5), (0.0, 1.0))), "covariance: .* symmetric"),
    "covariance of 10 km": (position(covariance=((1e8, 0.0), (0.0, 1.0))), "covariance: .* eigenvalues"),
    "certain position": (position(existence_probability=1.0), "existence_probability"),
    "class with a share of two": (position(classes=(("car", 2.0),)), "classes"),
    "search of more than a turn": (searched(9.0), "half_width_rad"),
    "search of a negative range": (searched(1.0, range_m=-1.0), "range_m"),
    "scan without a source": (partial(measurement.PositionScan, "", 0), "source: expected a name"),
    "129 positions": (partial(measurement.PositionScan, "a", 0, (position()(),) * 129), "positions: .* 128"),
    "ego speed that is no number": (partial(Context, ego_speed_mps=NAN), "ego_speed_mps"),
    "reading of one side": (partial(replace, READING, groups=READING.groups[:1]), "groups"),
    "number as a reading": (hop(sequence=0.5), "sequence: expected .*NotUsable"),
    **{f"update with {name}": (partial(WorldFilter().update, one), "measurement: expected")
       for name, one in {"None": None, "5": 5, "a filter": WorldFilter(), "a box": CAR}.items()},
    **{f"prediction to {stamp!r}": (partial(WorldFilter().predict_to, stamp), "stamp_ns")
       for stamp in (NAN, 1.5e9, "1500000000", None, True, 2**63, -(2**63), 10**30)},
    **{f"start at {stamp!r}": (partial(WorldFilter, start_ns=stamp), "start_ns")
       for stamp in (math.inf, "1500000000", None, True, 2**63)},
    "prediction into the past": (partial(WorldFilter(start_ns=10**9).predict_to, 0), "not before"),
    "prediction by a negative time": (partial(WorldFilter().predict, -0.1), "dt_s"),
    "checkpoint of another version": (
        checkpoint(lambda one: one["schema"].update(version="2.4.0")), "schema"),
    "checkpoint with a negative variance": (
        checkpoint(lambda one: one["memory"]["tracks"][0]["covariance"].__setitem__(0, -1.0)),
        r"tracks\[0\]\.covariance"),
    "checkpoint with a share of two": (
        checkpoint(lambda one: one["memory"]["belief"].update(share=[2.0] * len(GROUPS))), r"belief\.share"),
    "watch of one side": (watch(over_ns=(None,)), "watch"),
    "watch with one bet": (watch(bet=(0, (0.1,))), "watch"),
    "watch with evidence of one rate": (watch(within=Evidence((1.0,))), "watch"),
    "watch with evidence of zero": (watch(onsets=Evidence((0.0,) * len(RATES))), "watch"),
    # Front-end
    "band above half the recorded rate": (
        lambda: FrontEnd(SQUARE, 8_000, ListenSettings(band_hz=(300.0, 5000.0)).front_end(SQUARE, 8_000)),
        "less than half the sample rate of 8000"),
    "one microphone": (partial(MicrophoneArray, [[0, 0, 0]]), "2 to 1024"),
    "positions in a plane": (partial(MicrophoneArray, [[0, 0], [1, 1]]), r"shape \(any, 3\)"),
    "positions of different length": (partial(MicrophoneArray, [[0, 0, 0], [0, 1]]), "numbers"),
    "two pairs of microphones at one place": (
        partial(MicrophoneArray, [[0, 1, 0], [0, 2, 0], [0, 2, 0], [0, 1, 0]]),
        "microphones 1 and 4 0 m apart"),
    "sample rate below the band": (front_end(3_500, nfft=256), "half the sample rate"),
    "window that is too short for the band": (front_end(4_000), "nfft"),
    "sample rate of zero": (front_end(0), "sample_rate_hz"),
    "odd window": (front_end(48_000, nfft=511), "nfft"),
    "azimuths of half degrees": (front_end(48_000, azimuth_span_deg=(-10.0, 10.5)), "whole degrees"),
    "span that falls": (front_end(48_000, azimuth_span_deg=(10.0, 5.0)), "azimuth_span_deg"),
    "band that falls": (front_end(48_000, srp_band_hz=(1800.0, 300.0)), "srp_band_hz"),
    "engine line below the filter": (line(1.0, 400.0), "tone_band_hz"),
    "engine line above half the sample rate": (line(20.0, 4_000.0), "tone_band_hz"),
    "engine line in too narrow a band": (line(10.0, 20.0), "tone_band_hz: expected a filter"),
    "engine line in a band that falls": (line(400.0, 20.0), "tone_band_hz"),
    "block of three channels for four": (block(np.zeros((10, 3))), "block"),
    "block of text": (block("sound"), "block"),
    "block of None": (block([[None] * 4]), "block"),
    "samples beyond single precision": (block(np.full((2, 4), 1e300)), "block"),
    "transform of an odd window": (partial(StreamingStft, 2, 511, range(1, 9)), "nfft"),
    "transform of bins above half the rate": (partial(StreamingStft, 2, 512, range(1, 258)), "bins"),
    "transform of no bins": (partial(StreamingStft, 2, 512, range(5, 5)), "bins"),
    "transform of every second bin": (partial(StreamingStft, 2, 512, range(1, 9, 2)), "bins"),
    "feature of six channels for seven": (feature(np.zeros((48_000, 6))), "window"),
    "feature of a short window": (feature(np.zeros((511, 7))), "512 samples"),
    "feature of no number": (feature(np.full((600, 7), NAN)), "finite"),
    "looming of three hops": (partial(looming, TIMES_S[:3], np.zeros(3), 0.1), "times"),
    "looming with times that fall": (partial(looming, TIMES_S[::-1], np.zeros(10), 0.1), "times"),
    "looming without an energy for each time": (partial(looming, TIMES_S, np.zeros(9), 0.1), "energy"),
    "looming of no number": (partial(looming, TIMES_S, np.full(10, NAN), 0.1), "energy"),
    "looming without scatter": (partial(looming, TIMES_S, np.zeros(10), 0.0), "floor"),
    "fundamental of ten samples": (partial(track_fundamental, np.zeros(10), 4000.0), "samples"),
    "fundamental of no number": (partial(track_fundamental, np.full(8000, NAN), 4000.0), "samples"),
    "fundamental at a low sample rate": (partial(track_fundamental, np.zeros(8000), 2000.0), "sample_rate"),
    "tone of seven samples": (partial(estimate_tone, np.ones(7), 1000.0), "samples"),
    "tone of silence": (partial(estimate_tone, np.zeros(64), 1000.0), "samples"),
    "tone of no number": (partial(estimate_tone, np.full(64, NAN), 1000.0), "samples"),
    "tone of eight channels": (partial(estimate_tone, np.ones((8, 8)), 1000.0), "samples"),
    "tone at a sample rate of zero": (partial(estimate_tone, np.ones(64), 0.0), "sample_rate"),
    "delay beyond the resolution": (delays(max_delay_s=0.011), "max_delay_s"),
    "negative delay": (delays(max_delay_s=-1e-3), "max_delay_s"),
    "delay with frequencies that fall": (delays(frequencies_hz=BAND_HZ[::-1]), "frequencies_hz"),
    "delay of no number": (delays(spectra=np.full((3, 30, 2), NAN)), "spectra"),
    "covariance of no frames": (partial(covariance, np.zeros((0, 3, 4))), "spectra"),
    "covariance of no number": (partial(covariance, np.full((2, 3, 4), NAN)), "spectra"),
    "more sources than frames": (partial(signal_subspace, np.ones((2, 3, 4)), 3), "sources"),
    "as many sources as microphones": (partial(signal_subspace, np.ones((9, 3, 4)), 4), "sources"),
    "steering of another array": (
        partial(music_spectrum, signal_subspace(np.ones((2, 3, 4)), 1), np.ones((3, 5, 7))), "steering"),
    "sources in one frame": (partial(count_sources, [1.0, 2.0, 3.0], 1), "eigenvalues"),
    "negative eigenvalue": (partial(count_sources, [1.0, -2.0], 9), "eigenvalues"),
    "spectra with azimuths that fall": (spectra(azimuths_rad=AHEAD_RAD[::-1]), "ascending"),
    "spectra of half the view": (spectra(azimuths_rad=AHEAD_RAD / 2.0), "-90 to 90"),
    "spectra without a value for each azimuth": (spectra(values=np.full((3, 90), 0.2)), "values"),
    "spectra of zeros": (spectra(values=np.zeros((3, 180))), "pair sums"),
    "spectra above one": (spectra(values=np.full((3, 180), 1.2)), "pair sums"),
    "spectra of no number": (spectra(values=np.full((3, 180), NAN)), "values"),
    "two channels beside spectra": (beside_spectra(np.zeros((10, 2))), "block"),
    "no number beside spectra": (beside_spectra(np.full((10, 1), NAN)), "block"),
    "gap beside spectra": (
        partial(Listener(ovad_array(), 48_000, spectra=spectra()()).skip, 10**9), "uninterrupted sound"),
    "spectra at 16 kHz": (
        partial(SpectrumFrontEnd, spectra()(), 16_000, FrontEndSettings.heard_at(16_000)), "48 kHz"),
    "recording of no duration": (partial(rate_from_duration, 48_000, 0.0, 0.1, 48_000.0), "duration_s"),
    # Bounds, metrics and smoothing
    "bearing of one microphone": (bearing_bound(POLE[:1], 0.0), "2 microphones"),
    "bearing bound with a negative SNR": (bearing_bound(np.eye(3), 0.0, snr=-1.0), "snr"),
    "bearing bound without an azimuth": (bearing_bound(np.eye(3), NAN), "azimuth"),
    "tone bound without a signal": (partial(cramer_rao.tone_crb_hz2, 0.0, 100, 1e3), "snr"),
    "tone bound of one sample": (partial(cramer_rao.tone_crb_hz2, 1.0, 1, 1e3), "samples"),
    "speed bound at 0 Hz": (partial(cramer_rao.radial_speed_crb_m2_s2, 1.0, 0.0), "frequency"),
    "broadside of a vertical line": (partial(cramer_rao.broadside_rad, POLE), "horizontal extent"),
    "information of a vertical line": (
        partial(cramer_rao.endfire_information, POLE, 0.0), "horizontal extent"),
    "risk above one": (partial(risk_map.expected_calibration_error, [0.5, 1.2], [True, False]), "risk"),
    "no risks": (partial(risk_map.brier_score, [], []), "risk"),
    "risk map of hazards only": (partial(risk_map.fit_isotonic, [0.1, 0.2], [True, True]), "hazard"),
    "correlation time of no windows": (partial(correlation_time_hops, []), "window"),
    "stream without hops": (partial(hop_stream, [], name="a"), "hop"),
    "calibration on hazards only": (
        lambda: calibrate_cueing([blank_stream("a", 99).replace(label="left", t0_s=5.0)],
                                 (0.3, 0.3, 0.2, 0.2), MODEL.policies), "without a hazard"),
    "forgetting of a negative time": (partial(forgotten, LearnedStreet("Elm Street"), -1.0), "-1"),
    "page of no states": (partial(page_data, []), "at least one snapshot"),
    "smoothing from an approach": (partial(smooth, measurement.Approach(0.1, 0.1)), "bearing or position"),
    "track of an unknown entity": (partial(smooth, measurement.Bearing(0.1, 0.1)), "'unknown'"),
    # Simulation
    "unknown vehicle": (partial(vehicle_kind, "nowhere"), "nowhere"),
    "unknown place": (partial(simulation.place, "nowhere"), "nowhere"),
    "unknown site": (partial(simulation.site, "nowhere"), "nowhere"),
    "unknown sound": (partial(sound_kind, "vuvuzela"), "vuvuzela"),
    "outline of one corner": (partial(OccludingBody, ((0.0, 1.0),)), "corners_m"),
    "outline that is no number": (partial(OccludingBody, ((0.0, NAN),) * 2), "corners_m"),
    "gusts without channels": (sound(kind="gusts"), "channels"),
    "voice of no duration": (sound(kind="voice", duration_s=0.0), "duration_s"),
    "voice too far away": (sound(kind="voice", place_m=(1e4, 0.0)), "place_m"),
    "route of one point": (sound(kind="steps", route_m=((5.0, 0.0),)), "route_m"),
    "recording too short": (scene(duration_s=0.1), "duration_s"),
    "vehicle that stands": (scene(speed_mps=0.0), "speed_mps"),
    "approach from above": (scene(approach="above"), "approach"),
    "entry after the end": (scene(entry_s=11.0), "entry_s"),
    "approach that the place lacks": (partial(simulation.draw_settings, "SM1", "right", RNG), "approach"),
    "microphone below the road": (
        partial(simulation.simulate_recording, scene(approach="none", duration_s=0.5)(), RNG,
                MicrophoneArray([[0.0, 0.1, 0.0], [0.0, -0.1, 3.6]])), r"1\.80 m below"),
    "data set without recordings": (data_set(n_static=0), "n_static"),
    "drive at a merge": (data_set(scene="merge", n_dynamic=1), "n_dynamic"),
    "video of a drive": (data_set(n_dynamic=1, video=True), "video"),
    "background limits out of order": (partial(Traffic, "t", {}, background_db=(3.0, 2.0)), "background_db"),
    "rain share above one": (partial(Traffic, "t", {}, rain_share=1.5), "rain_share"),
    "unknown flow": (partial(Traffic, "t", {"up": 3.0}), "per_hour"),
    "drive of wrong duration": (partial(StreamSettings, simulation.site("DA1"), 1.1), "minutes"),
    "stream at a merge": (partial(StreamSettings, simulation.place("merge").site, 1.0), "junction"),
}  # fmt: skip


@pytest.mark.parametrize(("call", "words"), REFUSALS.values(), ids=REFUSALS)
def test_refuses(call, words):
    with pytest.raises(WorldstateError, match=words) as refused:
        call()
    # Files and sound have errors of their own.
    assert isinstance(refused.value, InvalidArgumentError) or words.startswith(("schema", "at least 6000 Hz"))
