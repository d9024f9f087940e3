"""Kinds of road users in the chain: sound, camera query and entity."""

from collections.abc import Collection
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from numpy.typing import ArrayLike

from worldstate.abduction.co_evidence import Absent, CoEvidence, Unqueried
from worldstate.abduction.evidence import SignatureEvidence
from worldstate.abduction.road_users import (
    Foreign,
    RoadUserModel,
    WarningSignal,
    expected_labels,
    heard_kinds,
)
from worldstate.adapters.acoustic import AcousticAdapter, asked_again
from worldstate.adapters.camera.detections import DetectionFilter, DetectionFrame, DetectionLog
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.vision_query import VisionQuery
from worldstate.belief.street_model import StreetModel
from worldstate.belief.track import Tracks, heard_as
from worldstate.core.filter import WorldFilter
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.direction.feature import feature_nfft
from worldstate.frontend.settings import FrontEndSettings
from worldstate.frontend.spectra.sound_character import BANDS, MEASURES
from worldstate.ground.errors import OutOfDomainError
from worldstate.ground.values import NotUsable
from worldstate.measurement.measurement import Bearing, Measurement, Side, Sighting

RATE_HZ = 6000
ARRAY = MicrophoneArray([[0.0, 0.2, 0.0], [0.0, 0.0, 0.0], [0.0, -0.3, 0.0]])
# Independent noise is unusable if channels are watched.
UNWATCHED = FrontEndSettings(nfft=feature_nfft(RATE_HZ), watch_channels=False)
unwatched = partial(AcousticAdapter, ARRAY, RATE_HZ, front_end_settings=UNWATCHED)
CLASSES = ("car", "truck", "unknown", "van")
NAMES = (*MEASURES, *BANDS)


def by_colour() -> RoadUserModel:
    """Return a model in which low sound is a truck and high sound a car."""
    weights = np.zeros((4, len(NAMES)))
    low, high = NAMES.index("band 80"), NAMES.index("band 1850")
    weights[1, low], weights[1, high], weights[0, low], weights[0, high] = 3.0, -3.0, -3.0, 3.0
    return RoadUserModel(NAMES, CLASSES, weights, np.array([0.0, 0.0, 0.0, 0.0]))


def coloured(deep: bool) -> np.ndarray:
    noise = np.random.default_rng(1).standard_normal((3 * RATE_HZ, 3))
    spectrum, hz = np.fft.rfft(noise, axis=0), np.fft.rfftfreq(len(noise), 1.0 / RATE_HZ)
    tilt = (np.maximum(hz, 50.0) / 500.0) ** (-1.0 if deep else 1.0)
    return np.asarray(0.02 * np.fft.irfft(spectrum * tilt[:, None], len(noise), axis=0), np.float32)


class Alarmed:
    def evidence(self, feature: ArrayLike, /) -> SignatureEvidence:
        return SignatureEvidence(("left", "right"), (6.0, 0.0), -2.0, -1.0)


class Asked:
    """A channel that records its queries."""

    def __init__(self) -> None:
        self.labels: list[Collection[str] | None] = []

    def ask(
        self,
        stamp_ns: int,
        bearing: Bearing | NotUsable,
        expected_labels: Collection[str] | None = None,
        side: Side | None = None,
    ) -> CoEvidence:
        self.labels.append(expected_labels)
        return Absent(0.1)

    def sightings(self, stamp_ns: int) -> tuple[Sighting, ...]:
        return ()

    def last_look(self, stamp_ns):
        return None


@pytest.mark.parametrize(
    ("deep", "name", "labels"), [(True, "truck", {"truck", "bus"}), (False, "car", {"car"})]
)
def test_the_acoustic_kind_sets_the_camera_query_and_the_entity(
    deep: bool, name: str, labels: set[str]
) -> None:
    camera = Asked()
    measured = unwatched(Alarmed(), camera, road_users=by_colour()).measure(coloured(deep))
    assert [one.kinds for one in measured[:11]] == [()] * 11
    assert camera.labels[:11] == [None] * 11
    assert max(measured[-1].kinds, key=lambda one: one[1])[0] == name
    assert camera.labels[-1] == labels
    asked_again(measured[-1], camera)
    assert camera.labels[-1] == labels
    world, said = WorldFilter(), []
    for one in measured:
        world = world.update(one)
        (entity,) = world.state.entities
        said.append({kind.label: kind.probability for kind in entity.classification})
        assert sum(said[-1].values()) <= 1.0 + 1e-9
    assert said[0] == {"unknown": 1.0}
    assert said[-1][name] > 0.8
    # After a detection the label of the detector is kept.
    assert world.memory is not None
    (track,) = world.memory.tracks.rows()
    seen = Tracks.of([replace(track, last_seen_ns=1, labels=(("car", 0.9),))])
    assert heard_as(seen, 0, measured[-1].kinds, StreetModel()) == (("car", 0.9),)


def test_a_foreign_sound_has_no_kind_and_a_siren_its_own() -> None:
    model, silence = by_colour(), np.zeros(len(NAMES))
    assert heard_kinds(model, silence, Foreign("sounds like music", 3.0)) == ()
    siren = dict(heard_kinds(model, silence, WarningSignal("siren", 9.0)))
    assert siren["siren"] > 0.99
    assert "siren" not in dict(heard_kinds(model, silence, WarningSignal("horn", 9.0)))
    assert expected_labels(tuple(siren.items())) is None
    with pytest.raises(OutOfDomainError, match="road users"):
        other = replace(model, measures=("loudness", *NAMES[1:]))
        unwatched(Alarmed(), road_users=other)


def query(*boxes: str, keep: frozenset[str] = frozenset({"car", "truck"})) -> VisionQuery:
    """Return a camera with earlier detections of these classes and an empty image now."""
    box = np.array([[600.0, 300.0, 800.0, 600.0]])
    frames = [DetectionFrame(box, np.array([0.9]), (name,)) for name in boxes]
    empty = DetectionFrame(np.empty((0, 4)), np.empty(0), ())
    log = DetectionLog.at_rate([*frames, empty], frame_rate_hz=10.0)
    return VisionQuery(PinholeCamera.ovad(), log, keep=DetectionFilter(keep))


def test_an_excluded_class_raises_the_miss_rate_or_is_unqueried() -> None:
    camera, ahead, now = query("car", "truck"), Bearing(0.0, 0.05), 200_000_000
    car, either = (camera.ask(now, ahead, labels) for labels in ({"car"}, {"car", "bus"}))
    assert isinstance(car, Absent)
    assert isinstance(either, Absent)
    assert either.miss_rate == pytest.approx(0.5 * (1.0 + car.miss_rate))
    assert isinstance(camera.ask(now, ahead, {"bicycle"}), Unqueried)


def test_a_detector_with_one_class_is_queried_for_any_class() -> None:
    ahead, now = Bearing(0.0, 0.05), 200_000_000
    one_class = query("car", "car")
    assert (
        one_class.ask(now, ahead, {"truck"})
        == one_class.ask(now, ahead)
        != query("car", "truck").ask(now, ahead, {"train"})
    )


def test_without_kinds_an_entity_is_unknown() -> None:
    evidence, unknown = Alarmed().evidence(()), NotUsable("-")
    world = WorldFilter()
    for hop in range(1, 6):
        world = world.update(Measurement(hop * 100_000_000, evidence, Unqueried("-"), unknown, unknown))
    assert [(one.label, one.probability) for one in world.state.entities[0].classification] == [
        ("unknown", 1.0)
    ]
