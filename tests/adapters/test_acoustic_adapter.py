"""The acoustic adapter combines sound, camera and signature at one stamp, with a guard and road users."""

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from camera_boxes import EMPTY, boxed, crossing
from made_up_sound import Fixed, plane_wave
from street_measurements import after, run

from worldstate import MicrophoneArray, NotUsable, WorldFilter, WorldState
from worldstate.abduction import DomainGuard, Familiar, Foreign
from worldstate.abduction.co_evidence import Absent, Present, Unqueried
from worldstate.abduction.road_users import RoadUserModel, WarningSignal, expected_labels, heard_kinds
from worldstate.adapters import DetectionFilter, DetectionLog, PinholeCamera, VisionQuery, acoustic
from worldstate.adapters.acoustic import FOREIGN, AcousticAdapter, asked_again
from worldstate.adapters.camera.detections import DetectionFrame
from worldstate.frontend.direction.feature import feature_nfft
from worldstate.frontend.settings import FrontEndSettings
from worldstate.frontend.spectra.sound_character import BANDS, MEASURES
from worldstate.ground.errors import OutOfDomainError
from worldstate.measurement.measurement import Approach, Bearing, Heard, Measurement

RATE_HZ = 16_000
ARRAY = MicrophoneArray(
    np.column_stack([np.zeros(12), np.linspace(0.4, -0.4, 12), np.tile([0.0, 0.1, 0.25], 4)])
)
wave = partial(plane_wave, ARRAY, RATE_HZ)


def measured(sound: np.ndarray, model: Fixed | None = None, **more: Any) -> list[Measurement]:
    return AcousticAdapter(ARRAY, RATE_HZ, model or Fixed(), **more).measure(sound)


def camera(azimuth_rad: float | None) -> VisionQuery:
    """Return a camera with boxes of a car that moves slightly around an azimuth, or with empty images."""
    frames = [EMPTY] * 40
    if azimuth_rad is not None:
        column = float(PinholeCamera.ovad().column(azimuth_rad))
        lefts = [column - 60.0 + 8.0 * (i % 3) for i in range(40)]
        frames = [boxed((left, 500.0, left + 120.0, 650.0)) for left in lefts]
    return VisionQuery(PinholeCamera.ovad(), DetectionLog.at_rate(frames, 10.0))


@pytest.mark.parametrize("azimuth_rad", [-0.5, 0.0, 0.5])
def test_the_camera_is_queried_at_the_bearing(azimuth_rad: float) -> None:
    elsewhere = -0.5 if azimuth_rad >= 0 else 0.5
    for box_rad, answer in ((azimuth_rad, Present), (None, Absent), (elsewhere, Absent)):
        found = measured(wave(azimuth_rad, 1.5), vision=camera(box_rad))
        assert [type(m.co_evidence) for m in found] == [answer] * 6
        for m in found:
            assert isinstance(m.bearing, Bearing)
            assert m.bearing.azimuth_rad == pytest.approx(azimuth_rad, abs=0.03)
            assert len(m.sightings) == (box_rad is not None)


def test_a_coarse_bearing_takes_its_side_from_the_signature(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(acoustic, "_COARSE_STD_RAD", 0.0)
    # Two equally strong waves count as reflected sound, so the bearing has no vote.
    sound = wave(-0.3, 1.0) + wave(-1.1, 1.0, seed=4)
    for model, answer in ((Fixed(1.0, 0.0), Present), (Fixed(0.0, 1.0), Absent), (Fixed(), Present)):
        (found,) = measured(sound, model, vision=camera(0.4))
        assert isinstance(found.co_evidence, answer)


@pytest.mark.parametrize("azimuth_rad", [-1.0, -0.5, 0.5, 1.0])
def test_direct_sound_has_the_side_of_its_bearing(azimuth_rad: float) -> None:
    """The model gives the wrong side for a source in line of sight."""
    wrong = Fixed(-2.0, 5.0) if azimuth_rad > 0 else Fixed(5.0, -2.0)
    for found in measured(wave(azimuth_rad, 1.3), wrong):
        left, right = found.signature.hidden
        assert (left - right) * azimuth_rad > 0.0
        # Direct sound is no evidence of a hidden vehicle.
        assert max(left, right) < 1.0


def test_reflected_sound_has_the_side_of_the_signature() -> None:
    for found in measured(wave(0.5, 1.3) + wave(-0.7, 1.3, seed=4), Fixed(-2.0, 5.0)):
        assert found.signature.hidden == (-2.0, 5.0)


def test_without_a_prominent_peak_there_is_no_bearing() -> None:
    adapter = AcousticAdapter(ARRAY, RATE_HZ, Fixed())
    (frame,) = adapter.front_end.process(wave(0.3, 1.0))
    bearing = adapter.interpret(replace(frame, least_prominence=1e6)).bearing
    assert isinstance(bearing, NotUsable) and "1000000.00" in bearing.reason
    silent = measured(np.zeros((20_000, 12), np.float32))
    assert silent
    assert all(isinstance(m.bearing, NotUsable) and isinstance(m.approach, NotUsable) for m in silent)


def test_growing_sound_approaches() -> None:
    for gain_per_s in (0.8, -0.8):
        sound = wave(0.2, 2.0) * np.exp(gain_per_s * np.arange(2 * RATE_HZ) / RATE_HZ)[:, None]
        rates = [m.approach.inverse_tta_hz for m in measured(sound) if isinstance(m.approach, Approach)]
        assert len(rates) > 5 and set(np.sign(rates)) == {np.sign(gain_per_s)}


def test_microphone_faults_are_published() -> None:
    sound = wave(0.2, 1.3)
    assert measured(sound)[-1].fault is None
    sound[:, [2, 5]] = 0.0
    found = measured(sound)[-1]
    (told,) = WorldFilter().update(found).state.sensors
    assert (told.condition, told.reason) == ("impaired", found.fault) == ("impaired", "microphones: 2 dead")


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


FAULTS = ["lost samples", "dead channels", "wind", "noise", "noise that is the same in all"]


@pytest.mark.parametrize("fault", FAULTS)
def test_unusable_sound_has_its_reason_and_no_evidence(fault: str) -> None:
    found = measured(hurt(wave(0.3, 5.0), fault), Fixed(3.0, 0.0))
    unheard = [m for m in found if not m.heard.usable]
    covered = [m for m in found if 2.65 < m.stamp_ns / 1e9 <= 3.501]
    assert all(m in unheard for m in covered)
    # A failed microphone stays masked for five more seconds.
    assert fault == "dead channels" or all(2.5 < m.stamp_ns / 1e9 < 4.05 for m in unheard)
    reason = "noise far above this place's usual" if "noise" in fault else fault
    assert {m.heard.reason for m in covered} == {reason}
    for one in unheard:
        assert isinstance(one.bearing, NotUsable) and isinstance(one.approach, NotUsable)
        assert set(one.signature.log_likelihoods) == {0.0}
    assert fault == "dead channels" or heard_well(found[-1].heard)
    assert all(heard_well(m.heard) for m in found if m.stamp_ns / 1e9 <= 2.5)


def test_sound_with_half_of_its_samples_clipped_is_unusable() -> None:
    sound = 20.0 * wave(0.3, 5.0)
    sound *= np.exp(np.minimum(np.arange(len(sound)) / RATE_HZ - 4.0, 0.0))[:, None]
    half = np.quantile(np.abs(sound[-RATE_HZ:]), 0.4)
    first, *_, last = measured(np.clip(sound, -half, half))
    assert first.heard.share > 0.9 and (last.heard.share, last.heard.reason) == (0.0, "clipped")


def test_a_loud_visible_source_lowers_the_share_heard() -> None:
    sound = wave(0.3, 6.0)
    sound *= np.exp(np.clip(np.arange(len(sound)) / RATE_HZ - 2.0, 0.0, 2.5))[:, None]
    *found, last = measured(sound)
    assert heard_well(found[5].heard)
    assert last.heard.reason == "loud source in view" and last.heard.usable and last.heard.share < 0.5


# A guard reduces the evidence of foreign sounds, not of warning signals; road users set the camera query.

SLOW_HZ = 6000
# Independent noise is unusable if channels are watched.
UNWATCHED = FrontEndSettings(nfft=feature_nfft(SLOW_HZ), watch_channels=False)
LINE = MicrophoneArray([[0.0, 0.2, 0.0], [0.0, 0.0, 0.0], [0.0, -0.3, 0.0]])
unwatched = partial(AcousticAdapter, LINE, SLOW_HZ, front_end_settings=UNWATCHED)
ALARMED = Fixed(3.0, 0.0, visible=-2.0, none=-1.0)
SURE = Fixed(6.0, 0.0, visible=-2.0, none=-1.0)
# Evidence of no vehicle, beyond the margin of any guard.
SILENT = Fixed(-6.0, -6.0, visible=-2.0)
STEADY, SHARED = MEASURES.index("line holds"), MEASURES.index("together 2.2")
NAMES = (*MEASURES, *BANDS)


def guard() -> DomainGuard:
    """Return a guard for common modulation (foreign) and a steady line (signal)."""
    weights = np.zeros((3, len(MEASURES)))
    weights[1, SHARED], weights[2, STEADY] = 12.0, 20.0
    return DomainGuard(MEASURES, ("speech",), ("siren",), weights, np.array([12.0, 0.0, 0.0]), threshold=0.0)


def sounds() -> dict[type, np.ndarray]:
    """Return three seconds of noise, of noise modulated at 4 Hz, and of a tone."""
    rng, time = np.random.default_rng(1), np.arange(3 * SLOW_HZ) / SLOW_HZ
    noise = 0.02 * rng.standard_normal((len(time), 3))
    swelling = noise * (1.05 + np.sin(8.0 * np.pi * time))[:, None]
    tone = noise + 0.2 * np.sin(2.0 * np.pi * 700.0 * time)[:, None]
    return {Familiar: noise, Foreign: swelling, WarningSignal: tone}


@pytest.mark.parametrize("kind", [Familiar, Foreign, WarningSignal])
def test_only_foreign_sounds_lose_evidence(kind: type) -> None:
    found = unwatched(ALARMED, guard=guard()).measure(sounds()[kind])
    assert [one.domain for one in found[:11]] == [None] * 11
    last, plain = found[-1], unwatched(ALARMED).measure(sounds()[kind])[-1]
    assert isinstance(last.domain, kind)
    said = [value - plain.signature.none for value in plain.signature.hidden]
    heard = [value - last.signature.none for value in last.signature.hidden]
    assert min(said) >= 0.0
    assert heard == pytest.approx([max(one - 2.0, 0.0) if kind is Foreign else one for one in said], abs=1e-6)
    unknown = 1.0 / (1.0 + np.exp(last.domain.log_odds)) if isinstance(last.domain, Foreign) else 1.0
    assert last.heard.share == pytest.approx(plain.heard.share * unknown)
    assert (last.heard.reason == FOREIGN) == isinstance(last.domain, Foreign)
    again = WorldState.from_json(after(*found).state.to_json())
    assert again.domain == last.domain
    assert kind is not Foreign or again.to_dict()["domain"]["reason"] == "sounds like speech"


def test_a_foreign_sound_is_not_taken_for_silence() -> None:
    heard = unwatched(SILENT, guard=guard()).measure(sounds()[Foreign])
    foreign = [one for one in heard if isinstance(one.domain, Foreign)]
    warned = after(*unwatched(ALARMED).measure(sounds()[Familiar]))
    later = [replace(one, stamp_ns=warned.stamp_ns + 10**8 * (i + 1)) for i, one in enumerate(foreign[:5])]
    silent = after(*(replace(one, heard=Heard()) for one in later), world=warned)
    ends = silent, after(*later, world=warned), warned.predict_to(later[-1].stamp_ns)
    left = [one.belief.hypotheses[0] for one in ends]
    assert left[0] < 0.5 * left[2]
    assert left[1] == pytest.approx(left[2], rel=0.2)


def by_colour() -> RoadUserModel:
    """Return a model in which low sound is a truck and high sound a car."""
    weights = np.zeros((4, len(NAMES)))
    low, high = NAMES.index("band 80"), NAMES.index("band 1850")
    weights[1, low], weights[1, high], weights[0, low], weights[0, high] = 3.0, -3.0, -3.0, 3.0
    return RoadUserModel(NAMES, ("car", "truck", "unknown", "van"), weights, np.zeros(4))


def test_models_of_other_measures_are_refused() -> None:
    others, users = ("loudness", *MEASURES[1:]), ("loudness", *NAMES[1:])
    with pytest.raises(OutOfDomainError, match="guard"):
        unwatched(ALARMED, guard=replace(guard(), measures=others))
    with pytest.raises(OutOfDomainError, match="road users"):
        unwatched(ALARMED, road_users=replace(by_colour(), measures=users))


def coloured(deep: bool) -> np.ndarray:
    noise = np.random.default_rng(1).standard_normal((3 * SLOW_HZ, 3))
    spectrum, hz = np.fft.rfft(noise, axis=0), np.fft.rfftfreq(len(noise), 1.0 / SLOW_HZ)
    tilt = (np.maximum(hz, 50.0) / 500.0) ** (-1.0 if deep else 1.0)
    return np.asarray(0.02 * np.fft.irfft(spectrum * tilt[:, None], len(noise), axis=0), np.float32)


def watched(frames: Iterable[DetectionFrame]) -> VisionQuery:
    keep = DetectionFilter(frozenset({"car", "truck"}))
    return VisionQuery(PinholeCamera.ovad(), DetectionLog.at_rate(frames, 10.0), keep=keep)


@pytest.mark.parametrize(("deep", "name", "answer"), [(True, "truck", Present), (False, "car", Absent)])
def test_the_acoustic_kind_sets_the_camera_query_and_the_entity(deep, name, answer) -> None:
    truck = watched(crossing(300.0, 10.0, label="truck").frames)
    found = unwatched(SURE, truck, road_users=by_colour()).measure(coloured(deep))
    # Before a kind is heard, any class counts.
    assert [(one.kinds, type(one.co_evidence)) for one in found[:11]] == [((), Present)] * 11
    assert max(found[-1].kinds, key=lambda one: one[1])[0] == name
    for last in (found[-1], asked_again(found[-1], truck)):
        assert isinstance(last.co_evidence, answer)
    (seen,) = (one for one in after(*found).state.entities if one.status == "visible")
    assert seen.classification[0].label == "truck", "the label of the detector is kept"
    worlds = run(WorldFilter(), unwatched(SURE, road_users=by_colour()).measure(coloured(deep)))
    said = [{kind.label: kind.probability for kind in one.state.entities[0].classification} for one in worlds]
    assert said[0] == {"unknown": 1.0} and said[-1][name] > 0.8
    assert all(sum(one.values()) <= 1.0 + 1e-9 for one in said)


def test_a_foreign_sound_has_no_kind_and_a_siren_its_own() -> None:
    model, silence = by_colour(), np.zeros(len(NAMES))
    assert heard_kinds(model, silence, Foreign("sounds like music", 3.0)) == ()
    siren = heard_kinds(model, silence, WarningSignal("siren", 9.0))
    assert dict(siren)["siren"] > 0.99 and expected_labels(siren) is None
    assert "siren" not in dict(heard_kinds(model, silence, WarningSignal("horn", 9.0)))


def test_an_excluded_class_raises_the_miss_rate_or_is_unqueried() -> None:
    """Earlier images show the classes that the detector has; the latest image is empty."""
    car_px, at = (600.0, 300.0, 800.0, 600.0), (200_000_000, Bearing(0.0, 0.05))
    ask, one = (
        partial(watched([boxed(car_px), boxed(car_px, label=other), EMPTY]).ask, *at)
        for other in ("truck", "car")
    )
    car, either = ask({"car"}), ask({"car", "bus"})
    assert isinstance(car, Absent) and isinstance(either, Absent)
    assert either.miss_rate == pytest.approx(0.5 * (1.0 + car.miss_rate))
    assert isinstance(ask({"bicycle"}), Unqueried)
    # A detector with one class is queried for any class.
    assert one({"truck"}) == one() != ask({"train"})
