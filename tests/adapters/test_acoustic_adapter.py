"""The acoustic adapter combines sound, camera and signature at one stamp."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike

from worldstate.abduction.co_evidence import Absent, Present, Unqueried
from worldstate.abduction.evidence import SignatureEvidence
from worldstate.adapters import acoustic
from worldstate.adapters.acoustic import AcousticAdapter
from worldstate.adapters.camera.detections import DetectionFrame, DetectionLog
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.vision_query import VisionQuery
from worldstate.core.filter import WorldFilter
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.values import NotUsable, nanoseconds
from worldstate.measurement.measurement import Approach, Bearing, Heard, Measurement, MeasurementAdapter

RATE_HZ = 16_000
SPEED_OF_SOUND_M_S = 343.0
ARRAY = MicrophoneArray(
    np.column_stack([np.zeros(12), np.linspace(0.4, -0.4, 12), np.tile([0.0, 0.1, 0.25], 4)])
)


class Level:
    """A model with fixed hidden likelihoods and the mean of the feature as the none likelihood."""

    def __init__(self, left: float = 0.0, right: float = 0.0) -> None:
        self.hidden = (left, right)

    def evidence(self, feature: ArrayLike, /) -> SignatureEvidence:
        return SignatureEvidence(("left", "right"), self.hidden, 0.0, float(np.mean(feature)))


def plane_wave(azimuth_rad: float, seconds: float, gain_per_s: float = 0.0, seed: int = 3) -> np.ndarray:
    """Broadband sound from far away, shape (n, M), with a little noise of every microphone's own."""
    rng = np.random.default_rng(seed)
    n = int(seconds * RATE_HZ)
    direction = np.array([math.cos(azimuth_rad), math.sin(azimuth_rad), 0.0])
    advance_s = ARRAY.positions_m @ direction / SPEED_OF_SOUND_M_S
    frequencies = np.fft.rfftfreq(n, 1 / RATE_HZ)
    spectrum = np.fft.rfft(rng.standard_normal(n))
    turns = np.exp(2j * np.pi * frequencies[:, None] * advance_s)
    shifted = np.fft.irfft(spectrum[:, None] * turns, n, axis=0)
    grows = np.exp(gain_per_s * np.arange(n) / RATE_HZ)[:, None]
    return (0.05 * (shifted * grows + 0.05 * rng.standard_normal((n, 12)))).astype(np.float32)


def camera_log(azimuth_rad: float | None) -> DetectionLog:
    """Return boxes of a car that moves slightly around an azimuth, or empty images."""
    frames = []
    columns = [] if azimuth_rad is None else [float(PinholeCamera.ovad().column(azimuth_rad))]
    for i in range(40):
        boxes = [[c + 8.0 * (i % 3) - 60, 500, c + 8.0 * (i % 3) + 60, 650] for c in columns]
        labels = ("car",) * len(boxes)
        frames.append(DetectionFrame(np.array(boxes, float).reshape(-1, 4), np.full(len(boxes), 0.9), labels))
    return DetectionLog.at_rate(frames, 10.0)


def same(one: Measurement, other: Measurement) -> bool:
    assert isinstance(one.bearing, Bearing)
    assert isinstance(other.bearing, Bearing)
    return (
        one.stamp_ns == other.stamp_ns
        and np.allclose(one.signature.log_likelihoods, other.signature.log_likelihoods, rtol=1e-5)
        and math.isclose(one.bearing.azimuth_rad, other.bearing.azimuth_rad, rel_tol=1e-5, abs_tol=1e-6)
    )


def test_is_a_measurement_adapter() -> None:
    adapter: MeasurementAdapter[np.ndarray] = AcousticAdapter(ARRAY, RATE_HZ, Level())
    assert adapter.source == "acoustic"
    assert adapter.measure(np.zeros((0, 12), np.float32)) == []


@pytest.mark.parametrize("start_ns", [0, 1_700_000_000_000_000_000])
def test_a_measurement_every_hop_after_the_first_second(start_ns: int) -> None:
    measured = AcousticAdapter(ARRAY, RATE_HZ, Level(), start_ns=start_ns).measure(plane_wave(0.3, 1.3))
    assert [m.stamp_ns - start_ns for m in measured] == [nanoseconds(t) for t in (1.0, 1.1, 1.2, 1.3)]
    assert all(m.source == "acoustic" for m in measured)


@pytest.mark.parametrize("azimuth_rad", [-0.5, 0.0, 0.5])
def test_the_camera_is_queried_at_the_bearing(azimuth_rad: float) -> None:
    sound = plane_wave(azimuth_rad, 1.5)
    seen = VisionQuery(PinholeCamera.ovad(), camera_log(azimuth_rad))
    empty = VisionQuery(PinholeCamera.ovad(), camera_log(None))
    elsewhere = VisionQuery(PinholeCamera.ovad(), camera_log(-0.5 if azimuth_rad >= 0 else 0.5))
    for vision, answer in ((seen, Present), (empty, Absent), (elsewhere, Absent)):
        measured = AcousticAdapter(ARRAY, RATE_HZ, Level(), vision).measure(sound)
        assert [type(m.co_evidence) for m in measured] == [answer] * 6
        for m in measured:
            assert isinstance(m.bearing, Bearing)
            assert m.bearing.azimuth_rad == pytest.approx(azimuth_rad, abs=0.03)
            assert len(m.sightings) == (vision is not empty)


def test_a_bearing_outside_the_view_is_unqueried() -> None:
    vision = VisionQuery(PinholeCamera.ovad(), camera_log(None))
    answers = AcousticAdapter(ARRAY, RATE_HZ, Level(), vision).measure(plane_wave(1.1, 1.2))
    assert {m.co_evidence for m in answers} == {Unqueried("sector outside the field of view")}


def test_a_coarse_bearing_takes_its_side_from_the_signature(monkeypatch: pytest.MonkeyPatch) -> None:
    vision = VisionQuery(PinholeCamera.ovad(), camera_log(0.4))
    monkeypatch.setattr(acoustic, "_COARSE_STD_RAD", 0.0)
    # Two equally strong waves count as reflected sound, so the bearing has no vote.
    sound = plane_wave(-0.3, 1.0) + plane_wave(-1.1, 1.0, seed=4)
    for model, answer in ((Level(left=1.0), Present), (Level(right=1.0), Absent), (Level(), Present)):
        (measured,) = AcousticAdapter(ARRAY, RATE_HZ, model, vision).measure(sound)
        assert isinstance(measured.co_evidence, answer)


@pytest.mark.parametrize("azimuth_rad", [-1.0, -0.5, 0.5, 1.0])
def test_direct_sound_has_the_side_of_its_bearing(azimuth_rad: float) -> None:
    """The model gives the wrong side for a source in line of sight."""
    wrong = Level(right=5.0, left=-2.0) if azimuth_rad > 0 else Level(left=5.0, right=-2.0)
    for measured in AcousticAdapter(ARRAY, RATE_HZ, wrong).measure(plane_wave(azimuth_rad, 1.3)):
        left, right = measured.signature.hidden
        assert (left - right) * azimuth_rad > 0.0
        # Direct sound is no evidence of a hidden vehicle.
        assert max(left, right) < 1.0


def test_reflected_sound_has_the_side_of_the_signature() -> None:
    sound = plane_wave(0.5, 1.3) + plane_wave(-0.7, 1.3, seed=4)
    for measured in AcousticAdapter(ARRAY, RATE_HZ, Level(right=5.0, left=-2.0)).measure(sound):
        assert measured.signature.hidden == (-2.0, 5.0)


def test_without_prominence_there_is_no_bearing() -> None:
    adapter = AcousticAdapter(ARRAY, RATE_HZ, Level())
    (frame,) = adapter.front_end.process(plane_wave(0.3, 1.0))
    measured = adapter.interpret(replace(frame, least_prominence=1e6))
    assert isinstance(measured.bearing, NotUsable)
    assert "1000000.00" in measured.bearing.reason


def test_silence_has_neither_bearing_nor_approach() -> None:
    measured = AcousticAdapter(ARRAY, RATE_HZ, Level()).measure(np.zeros((20_000, 12), np.float32))
    assert measured
    assert all(isinstance(m.bearing, NotUsable) and isinstance(m.approach, NotUsable) for m in measured)


def test_growing_sound_approaches() -> None:
    for gain_per_s in (0.8, -0.8):
        measured = AcousticAdapter(ARRAY, RATE_HZ, Level()).measure(plane_wave(0.2, 2.0, gain_per_s))
        rates = [m.approach.inverse_tta_hz for m in measured if isinstance(m.approach, Approach)]
        assert len(rates) > 5
        assert all(np.sign(rate) == np.sign(gain_per_s) for rate in rates)


def test_microphone_faults_are_published() -> None:
    sound = plane_wave(0.2, 1.3)
    whole = AcousticAdapter(ARRAY, RATE_HZ, Level()).measure(sound)[-1]
    sound[:, [2, 5]] = 0.0
    measured = AcousticAdapter(ARRAY, RATE_HZ, Level()).measure(sound)[-1]
    assert (whole.fault, measured.fault) == (None, "microphones: 2 dead")
    (told,) = WorldFilter().update(measured).state.sensors
    assert (told.condition, told.reason) == ("impaired", measured.fault)


def heard_well(heard: Heard) -> bool:
    return (heard.share, heard.reason) == (1.0, None)


def hurt(sound: np.ndarray, fault: str) -> np.ndarray:
    """Add a fault to the second of sound from 2.5 s on."""
    second, rng = slice(5 * RATE_HZ // 2, 7 * RATE_HZ // 2), np.random.default_rng(0)
    if fault == "lost samples":
        sound[second] = 0.0
    elif fault == "dead channels":
        sound[second, 1:] = 0.0
    elif fault == "wind":
        spectrum = np.fft.rfft(rng.standard_normal((RATE_HZ, 12)), axis=0)
        spectrum[300:] = 0.0
        sound[second] += 5.0 * np.fft.irfft(spectrum, RATE_HZ, axis=0)
    else:
        sound[second] += 0.9 * rng.standard_normal((RATE_HZ, 1 if "same" in fault else 12))
    return sound


@pytest.mark.parametrize(
    "fault", ["lost samples", "dead channels", "wind", "noise", "noise that is the same in all"]
)
def test_unusable_sound_has_its_reason_and_no_evidence(fault: str) -> None:
    hurt_sound = hurt(plane_wave(0.3, 5.0), fault)
    measured = AcousticAdapter(ARRAY, RATE_HZ, Level(left=3.0)).measure(hurt_sound)
    unheard = [m for m in measured if not m.heard.usable]
    covered = [m for m in measured if 2.65 < m.stamp_ns / 1e9 <= 3.501]
    assert all(m in unheard for m in covered)
    # A failed microphone stays masked for five more seconds.
    assert fault == "dead channels" or all(2.5 < m.stamp_ns / 1e9 < 4.05 for m in unheard)
    reason = "noise far above this place's usual" if "noise" in fault else fault
    assert {m.heard.reason for m in covered} == {reason}
    for one in unheard:
        assert isinstance(one.bearing, NotUsable) and isinstance(one.approach, NotUsable)
        assert set(one.signature.log_likelihoods) == {0.0}
    assert fault == "dead channels" or heard_well(measured[-1].heard)
    assert all(heard_well(m.heard) for m in measured if m.stamp_ns / 1e9 <= 2.5)


def test_sound_with_half_of_its_samples_clipped_is_unusable() -> None:
    sound = 20.0 * plane_wave(0.3, 5.0)
    sound *= np.exp(np.minimum(np.arange(len(sound)) / RATE_HZ - 4.0, 0.0))[:, None]
    half = np.quantile(np.abs(sound[-RATE_HZ:]), 0.4)
    measured = AcousticAdapter(ARRAY, RATE_HZ, Level()).measure(np.clip(sound, -half, half))
    assert measured[0].heard.share > 0.9
    assert (measured[-1].heard.share, measured[-1].heard.reason) == (0.0, "clipped")


def test_a_loud_visible_source_lowers_the_share_heard() -> None:
    sound = plane_wave(0.3, 6.0)
    sound *= np.exp(np.clip(np.arange(len(sound)) / RATE_HZ - 2.0, 0.0, 2.5))[:, None]
    measured = AcousticAdapter(ARRAY, RATE_HZ, Level()).measure(sound)
    assert heard_well(measured[5].heard)
    assert measured[-1].heard.reason == "loud source in view"
    assert measured[-1].heard.usable and measured[-1].heard.share < 0.5


def test_keeps_the_last_frame_for_plots() -> None:
    adapter = AcousticAdapter(ARRAY, RATE_HZ, Level())
    assert adapter.last_frame is None
    measured = adapter.measure(plane_wave(0.3, 1.2))
    assert adapter.last_frame is not None
    assert adapter.last_frame.stamp_ns == measured[-1].stamp_ns
