"""What enters a filter is checked once, at its boundary; what is inside is trusted."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest

from worldstate.abduction.co_evidence import Absent
from worldstate.abduction.evidence import SignatureEvidence
from worldstate.abduction.signature.site_estimate import SiteSignature
from worldstate.adapters.acoustic import AcousticAdapter
from worldstate.adapters.camera.detections import DetectionFrame, DetectionLog
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.vision_query import VisionQuery
from worldstate.adapters.files.model_file import read_model
from worldstate.core.filter import WorldFilter
from worldstate.frontend.array.microphone_array import ovad_array
from worldstate.ground import checks
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.values import NotUsable
from worldstate.measurement.measurement import Approach, Bearing, Measurement, Sighting

RATE_HZ = 48_000
CAR = Sighting(0.1, 0.02, "car", 0.9)


def measured(hop, hidden=(4.0, 0.0), **changes):
    heard = SignatureEvidence(("left", "right"), hidden, 2.0, 0.0)
    look = Measurement(hop * 10**8, heard, Absent(0.04), Bearing(0.3, 0.1), Approach(0.2, 0.1), (CAR,))
    return replace(look, **changes)


def street(rng, seconds):
    """A source from the left in noise: there is a peak, so the camera is asked about a sector."""
    noise = rng.standard_normal((seconds * RATE_HZ, 56), dtype=np.float32)
    return (0.02 * noise + 0.2 * rng.standard_normal((seconds * RATE_HZ, 1), dtype=np.float32)).astype(
        np.float32
    )


def test_a_hop_of_the_whole_chain_makes_at_most_ten_checks():
    boxes = DetectionFrame(np.array([[900.0, 500.0, 1100.0, 650.0]]), np.array([0.9]), ("car",))
    vision = VisionQuery(PinholeCamera(), DetectionLog.at_rate([boxes] * 60, frame_rate_hz=10.0))
    signature = SiteSignature(read_model().signature)
    adapter = AcousticAdapter(ovad_array(), RATE_HZ, signature, vision=vision)
    calls, hops, world = 0, 0, WorldFilter()

    def count(frame, event, _):
        nonlocal calls
        code = frame.f_code
        calls += event == "call" and code.co_filename == checks.__file__ and code.co_name != "<genexpr>"

    sound = street(np.random.default_rng(0), 3)
    for measurement in adapter.measure(sound[: 2 * RATE_HZ]):
        world = world.predict_to(measurement.stamp_ns).update(measurement)
    sys.setprofile(count)
    try:
        for block in np.array_split(sound[2 * RATE_HZ :], 20):
            for measurement in adapter.measure(block):
                world = world.predict_to(measurement.stamp_ns).update(measurement)
                hops += 1
    finally:
        sys.setprofile(None)
    assert hops == 10
    assert world.state.entities
    assert calls / hops <= 10


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"stamp_ns": 2.0e8}, "stamp_ns: expected integer"),
        ({"stamp_ns": None}, "stamp_ns: expected integer"),
        ({"signature": None}, "signature: expected SignatureEvidence"),
        ({"co_evidence": None}, "co_evidence: expected"),
        ({"bearing": None}, "bearing: expected"),
        ({"approach": 0.3}, "approach: expected"),
        ({"bearing": Bearing(None, 0.1)}, r"bearing\.azimuth_rad: expected"),
        ({"approach": Approach(0.2, -1.0)}, r"approach\.std_hz: expected"),
        ({"sightings": (CAR, replace(CAR, score="high"))}, r"sightings\[1\]\.score: expected"),
    ],
)
def test_what_is_no_measurement_is_refused_by_name(change, words):
    world = WorldFilter().update(measured(1))
    with pytest.raises(InvalidArgumentError, match=words):
        world.update(measured(2, **change))


@pytest.mark.parametrize("bad", [(None, 0.0), ("a", 0.0), (np.nan, 0.0), (0.0,), 1.0])
def test_likelihoods_that_are_none_are_refused(bad):
    with pytest.raises(InvalidArgumentError, match="hidden"):
        SignatureEvidence(("left", "right"), bad, 0.0, 0.0)


def test_whole_numbers_and_numpy_numbers_are_taken_as_what_they_say():
    plain, other = WorldFilter(), WorldFilter()
    for hop in range(1, 30):
        numbers = {
            "stamp_ns": np.int64(hop * 10**8),
            "signature": SignatureEvidence(("left", "right"), (4, np.float32(0)), np.int64(2), 0),
            "co_evidence": Absent(np.float64(0.04)),
            "sightings": (replace(CAR, score=np.float64(0.9)),) if hop > 20 else (),
        }
        plain = plain.update(measured(hop, sightings=(CAR,) if hop > 20 else ()))
        other = other.update(measured(hop, **numbers))
    assert other.state.to_json() == plain.state.to_json()
    assert json.dumps(other.to_dict()) == json.dumps(plain.to_dict())


def test_a_filter_that_is_certain_leaves_a_checkpoint_that_reads():
    world, rng = WorldFilter(), np.random.default_rng(4)
    for hop in range(1, 200):
        hidden = (27.7 + rng.normal(), 0.0)
        heard = SignatureEvidence(("left", "right"), hidden, rng.normal(), -23.2)
        answer = Absent(10.0 ** -rng.uniform(1, 12))
        look = Measurement(hop * 10**8, heard, answer, NotUsable("-"), NotUsable("-"))
        world = world.predict(0.1).update(look)
        assert WorldFilter.from_dict(world.to_dict()).state == world.state
