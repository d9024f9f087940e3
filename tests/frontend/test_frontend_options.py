"""What a front-end does where it is asked: elevations, several peaks; the twin of a bearing."""

import numpy as np
import pytest

from worldstate.frontend.array.geometry import mirror_azimuth_rad, mirror_reflection
from worldstate.frontend.array.microphone_array import MicrophoneArray, roof_array_56
from worldstate.frontend.settings import FrontEndSettings
from worldstate.frontend.stream import FrontEnd
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.values import NotUsable

RATE = 16_000
ARRAY = MicrophoneArray(roof_array_56().positions_m[::3])
BLOCK = MicrophoneArray(ARRAY.positions_m + np.outer(np.arange(19) % 3, [0.15, 0, 0]))


def waves(
    array: MicrophoneArray, directions_deg: list[tuple[float, float]], seconds: float = 1.2, seed: int = 0
) -> np.ndarray:
    """White plane waves of equal power from (azimuth, elevation), in a tenth of noise, float32 (n, M)."""
    rng, n = np.random.default_rng(seed), round(seconds * RATE)
    frequencies = np.fft.rfftfreq(n, 1 / RATE)
    sound = np.zeros((n, array.n_microphones))
    for azimuth, elevation in np.radians(directions_deg):
        spectrum = np.fft.rfft(rng.standard_normal(n))
        spectrum[frequencies > 7000] = 0.0
        steering = array.steering(frequencies, azimuth, elevation)[:, :, 0]
        sound += np.fft.irfft(spectrum[:, None] * steering, n, axis=0)
    return np.asarray(sound + 0.1 * rng.standard_normal(sound.shape), np.float32)


@pytest.mark.parametrize(("azimuth", "elevation"), [(20.0, 12.0), (-35.0, -8.0), (0.0, 0.0)])
def test_azimuth_and_elevation(azimuth: float, elevation: float) -> None:
    chosen = FrontEndSettings(elevation_span_deg=(-20.0, 30.0), elevation_step_deg=5.0)
    frame = FrontEnd(ARRAY, RATE, chosen).process(waves(ARRAY, [(azimuth, elevation)]))[-1]
    assert frame.srp_map.shape == (11, 181)
    np.testing.assert_array_equal(frame.srp, frame.srp_map.max(axis=0))
    assert np.degrees(frame.bearing_rad) == pytest.approx(azimuth, abs=1.0)
    assert np.degrees(frame.elevation_rad) == pytest.approx(elevation, abs=2.0)


def test_the_horizon_and_the_street_below_are_the_default() -> None:
    sound = waves(ARRAY, [(20.0, 5.0)])
    wide = FrontEnd(ARRAY, RATE, FrontEndSettings(elevation_span_deg=(-12.0, 12.0))).process(sound)[-1]
    plain = FrontEnd(ARRAY, RATE).process(sound)[-1]
    np.testing.assert_allclose(wide.srp_map[:2], plain.srp_map, rtol=1e-4)
    assert plain.srp_map.shape == (2, 181)
    assert plain.elevation_rad == 0.0


def test_several_sources_are_several_peaks() -> None:
    truth = [(-50.0, 0.0), (-5.0, 0.0), (40.0, 0.0)]
    frame = FrontEnd(ARRAY, RATE).process(waves(ARRAY, truth))[-1]
    found = sorted(np.degrees(peak.azimuth_rad) for peak in frame.peaks[:3])
    np.testing.assert_allclose(found, [azimuth for azimuth, _ in truth], atol=2.5)
    assert frame.peaks[0].azimuth_rad == frame.bearing_rad
    assert frame.peaks[0].prominence == frame.prominence
    assert sorted(frame.peaks, key=lambda peak: -peak.value) == list(frame.peaks)
    few = FrontEnd(ARRAY, RATE, FrontEndSettings(max_peaks=2)).process(waves(ARRAY, truth))[-1]
    assert few.peaks == frame.peaks[:2]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"elevation_span_deg": (10.0, 5.0)}, "elevation_span_deg"),
        ({"elevation_span_deg": (0.0, 7.0)}, "elevation_step_deg"),
        ({"max_peaks": 0}, "max_peaks"),
    ],
)
def test_bad_settings_are_refused(settings: dict[str, object], message: str) -> None:
    with pytest.raises(InvalidArgumentError, match=message):
        FrontEnd(ARRAY, RATE, FrontEndSettings(**settings))  # type: ignore[arg-type]


@pytest.mark.parametrize("tilt_deg", [0.0, 20.0])
@pytest.mark.parametrize("azimuth_deg", [-70.0, -10.0, 35.0])
def test_the_twin_sounds_the_same(tilt_deg: float, azimuth_deg: float) -> None:
    """Yawing the array yaws the mirror; a direction and its twin have the same delays up to a constant."""
    c, s = np.cos(np.radians(tilt_deg)), np.sin(np.radians(tilt_deg))
    array = MicrophoneArray(ARRAY.positions_m @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]))
    bearing = np.radians(azimuth_deg)
    twin = mirror_azimuth_rad(mirror_reflection(array.positions_m), bearing)
    assert isinstance(twin, float)
    assert np.degrees(
        np.angle(np.exp(1j * (twin - np.pi - 2 * np.radians(tilt_deg) + bearing)))
    ) == pytest.approx(0)
    difference = array.delays_s(bearing) - array.delays_s(twin)
    np.testing.assert_allclose(difference, difference[0], atol=1e-9)


def test_twins_of_lines_and_solids() -> None:
    line = MicrophoneArray([[0, 0.1 * i, 0] for i in range(4)])
    assert mirror_azimuth_rad(mirror_reflection(line.positions_m), 0.3) == pytest.approx(np.pi - 0.3)
    lying = MicrophoneArray(ARRAY.positions_m[:, [2, 1, 0]])
    pole = MicrophoneArray([[0, 0, 0.1 * i] for i in range(4)])
    for array in (lying, pole, BLOCK):
        assert isinstance(mirror_azimuth_rad(mirror_reflection(array.positions_m), 0.3), NotUsable)


def test_the_frame_tells_the_twin_and_the_grid_shows_it() -> None:
    chosen = FrontEndSettings(azimuth_span_deg=(-180.0, 180.0))
    frame = FrontEnd(ARRAY, RATE, chosen).process(waves(ARRAY, [(30.0, 0.0)]))[-1]
    assert frame.ambiguity == "front-back"
    assert isinstance(frame.mirror_bearing_rad, float)
    both = sorted(np.degrees([frame.bearing_rad, frame.mirror_bearing_rad]))
    np.testing.assert_allclose(both, [30.0, 150.0], atol=1.0)
    heights = np.interp(np.radians(both), frame.azimuths_rad, frame.srp)
    assert heights[0] == pytest.approx(heights[1], rel=0.01)
    solid = FrontEnd(BLOCK, RATE, chosen).process(waves(BLOCK, [(30.0, 0.0)]))[-1]
    assert solid.ambiguity == "none"
    assert isinstance(solid.mirror_bearing_rad, NotUsable)
    assert np.degrees(solid.bearing_rad) == pytest.approx(30.0, abs=1.0)
