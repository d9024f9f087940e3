"""Parameters of the street model from streams with known geometry, rates and boxes."""

import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_up_corner import write_corner
from test_passes import CORNER_RAD, PACE_MPS, STREET_M, stream
from worldstate_lab.cli.main import main
from worldstate_lab.cli.street import Facts, _mixture, camera_numbers, vehicle_facts

from worldstate import Measurement, NotUsable, SignatureEvidence
from worldstate.abduction.co_evidence import Present
from worldstate.commissioning.heard_stream import StreamSettings, hear_stream, junction_named, traffic_named
from worldstate.frontend.array.microphone_array import ovad_array
from worldstate.measurement.measurement import Look, Sighting

SILENT = NotUsable("-")


@given(st.lists(st.floats(3.0, 9.0), min_size=2, max_size=5))
@settings(max_examples=10)
def test_distances_and_times_in_view_are_those_of_the_drawn_vehicles(gaps_s: list[float]) -> None:
    entries_s = np.round(9.0 + np.cumsum(gaps_s), 1).tolist()
    facts, heard = Facts(list), stream([("left", "left", one) for one in entries_s])
    hidden_rad, lone_rad = vehicle_facts(heard, facts)
    edge_m = STREET_M * math.tan(CORNER_RAD)
    assert np.mean(facts["view_s"]) == pytest.approx(2.0 * edge_m / PACE_MPS, abs=0.11)
    assert facts["gap_s"] == pytest.approx([*np.diff(entries_s), math.inf])
    # Along a street at a distance d a bearing turns by v / d times the square of its cosine.
    azimuth, turned = np.array(facts["log"]).imag, np.array(facts["rate"]).imag
    assert np.median(turned / np.cos(azimuth) ** 2) == pytest.approx(-PACE_MPS / STREET_M, rel=0.02)
    assert np.nanmin(hidden_rad[:, 0]) > CORNER_RAD > np.nanmax(lone_rad) and np.isnan(hidden_rad[:, 1]).all()


@given(st.floats(0.3, 0.95), st.floats(0.03, 0.2), st.integers(0, 99))
@settings(max_examples=10)
def test_share_and_spread_of_peaks_are_estimated_with_uniform_outliers(share, std, seed) -> None:
    rng = np.random.default_rng(seed)
    own = rng.random(4000) < share
    errors = np.where(own, std * rng.standard_normal(4000), rng.uniform(-0.5 * math.pi, 0.5 * math.pi, 4000))
    assert _mixture(errors, math.pi)[:2] == pytest.approx((share, std), rel=0.12)


@given(st.floats(0.02, 0.3), st.integers(2, 9), st.integers(0, 4))
@settings(max_examples=10)
def test_tracks_single_boxes_and_growth_are_counted(growth: float, vehicles: int, single: int) -> None:
    """Every vehicle has six images, then none for a second; single boxes are in images of their own."""
    quiet, look, hops = SignatureEvidence(("left", "right"), (0.0, 0.0), 0.0, 0.0), Present(0.05, 0.01), []
    for image in range(16 * (vehicles + single)):
        number, at = divmod(image, 16)
        is_there = at < (6 if number < vehicles else 1)
        box = Sighting(0.5 - 0.01 * at, 0.02, "car", 0.9, 0.05 * math.exp(growth * at))
        stamp_ns = 10**8 * (image + 1)
        seen = Look("camera", stamp_ns, look)
        sightings = (box,) if is_there else ()
        hops.append(Measurement(stamp_ns, quiet, look, SILENT, SILENT, look=seen, sightings=sightings))
    found = camera_numbers([hops])
    assert found["clutter"] == pytest.approx(single / len(hops))
    assert found["width_change"] == pytest.approx(growth) and found["size_spread"] == pytest.approx(
        0.0, abs=1e-9
    )


@pytest.mark.slow
def test_the_command_fits_streams_and_a_corner(tmp_path, capsys) -> None:
    street = StreamSettings(junction_named("SA1"), 1.2, 3, traffic_named("pairs"), sample_rate_hz=6000.0)
    (heard,) = hear_stream(street, [ovad_array()])
    heard.save(path := tmp_path / "stream.npz")
    corner = write_corner(tmp_path / "corner", np.random.default_rng(1))
    assert main(["street", str(path), "--sequences", str(corner), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["vehicles"] == heard.vehicles.hazard.sum() > 1
    assert report["fitted"].keys() == report["shipped"].keys()
    assert all(math.isfinite(one) for one in report["fitted"].values())
