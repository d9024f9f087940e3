"""What a front-end does where it is asked: elevations, several peaks, MUSIC; the twin of a bearing."""

import numpy as np
import pytest

from worldstate.frontend.array.geometry import mirror_azimuth_rad, mirror_reflection
from worldstate.frontend.array.microphone_array import MicrophoneArray, roof_array_56
from worldstate.frontend.direction.music import MusicReading, covariance, covariance_subspace, music_spectrum
from worldstate.frontend.ego_noise.ego_noise import EgoNoiseSettings
from worldstate.frontend.settings import FrontEndSettings
from worldstate.frontend.spectra.stft import StreamingStft, band_bins, bin_frequencies_hz
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


def test_music_is_that_of_the_whole_window() -> None:
    chosen = FrontEndSettings(music_sources=2)
    sound = waves(ARRAY, [(-40.0, 0.0), (25.0, 0.0)], seconds=2.4)
    frames = FrontEnd(ARRAY, RATE, chosen).process(sound)
    bins = band_bins(chosen.srp_band_hz, RATE, chosen.nfft)
    spectra = StreamingStft(19, chosen.nfft, bins).push(sound)
    ends = chosen.nfft + chosen.nfft // 2 * np.arange(len(spectra))
    steering = ARRAY.steering(bin_frequencies_hz(bins, RATE, chosen.nfft), frames[0].azimuths_rad)
    for frame in frames[:: len(frames) // 3]:
        within = (ends > frame.sample_index - RATE) & (ends <= frame.sample_index)
        subspace = covariance_subspace(covariance(spectra[within]), 2)
        assert isinstance(frame.music, MusicReading)
        expected = music_spectrum(subspace, steering, normalised=True)
        assert np.corrcoef(frame.music.spectrum, expected)[0, 1] > 0.9999
        assert np.degrees(frame.music.azimuth_rad) == pytest.approx(
            min((-40.0, 25.0), key=lambda a: abs(a - np.degrees(frame.music.azimuth_rad))), abs=1.0
        )


def test_music_hears_a_quiet_source_after_a_loud_one_has_gone() -> None:
    loud, quiet = waves(ARRAY, [(-40.0, 0.0)], 1.5), 1e-5 * waves(ARRAY, [(25.0, 0.0)], 2.0)
    frames = FrontEnd(ARRAY, RATE, FrontEndSettings(music_sources=1)).process(
        np.concatenate([1e3 * loud, quiet])
    )
    assert isinstance(frames[-1].music, MusicReading)
    assert np.degrees(frames[-1].music.azimuth_rad) == pytest.approx(25.0, abs=1.0)


def test_music_is_off_by_default_and_says_so() -> None:
    sound = waves(ARRAY, [(10.0, 0.0)])
    assert isinstance(FrontEnd(ARRAY, RATE).process(sound)[-1].music, NotUsable)
    quiet = FrontEnd(ARRAY, RATE, FrontEndSettings(music_sources=1)).process(np.zeros_like(sound))[-1]
    assert isinstance(quiet.music, NotUsable)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"music_sources": 19}, "music_sources"),
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


EGO = FrontEndSettings(music_sources=1, ego_noise=EgoNoiseSettings(guard_hops=0, only_below_horizon=False))


def test_prewhitened_music_hears_past_the_own_noise() -> None:
    """Own noise from below, learned while alone, no longer owns the MUSIC peak when a weaker source joins."""
    own, source = waves(ARRAY, [(-40.0, -50.0)], 6.0, 1), waves(ARRAY, [(25.0, 0.0)], 2.0, 2)
    sound = 2.0 * own
    sound[-len(source) :] += source
    learning, plain = FrontEnd(ARRAY, RATE, EGO), FrontEnd(ARRAY, RATE, FrontEndSettings(music_sources=1))
    learning.learn_ego_noise(1.0)
    learning.process(sound[: -len(source)])
    learning.learn_ego_noise(0.0)
    heard = learning.process(sound[-len(source) :])[-1].music
    deaf = plain.process(sound)[-1].music
    assert isinstance(heard, MusicReading)
    assert isinstance(deaf, MusicReading)
    assert abs(np.degrees(deaf.azimuth_rad) - 25.0) > 10.0
    assert np.degrees(heard.azimuth_rad) == pytest.approx(25.0, abs=1.0)


def test_music_is_what_it_was_until_ego_noise_is_learned() -> None:
    sound = waves(ARRAY, [(25.0, 0.0)])
    shut = FrontEnd(ARRAY, RATE, EGO).process(sound)
    plain = FrontEnd(ARRAY, RATE, FrontEndSettings(music_sources=1)).process(sound)
    for ours, theirs in zip(shut, plain, strict=True):
        assert isinstance(ours.music, MusicReading)
        assert isinstance(theirs.music, MusicReading)
        np.testing.assert_array_equal(ours.music.spectrum, theirs.music.spectrum)


@pytest.mark.parametrize("dead", [(), (3, 7, 11)])
def test_prewhitened_music_does_no_harm_in_white_noise(dead: tuple[int, ...]) -> None:
    noise = np.random.default_rng(3).standard_normal((4 * RATE, 19)).astype(np.float32)
    sound = np.concatenate([noise, waves(ARRAY, [(25.0, 0.0)])])
    sound[:, list(dead)] = 0.0
    front_end = FrontEnd(ARRAY, RATE, EGO)
    front_end.learn_ego_noise(1.0)
    front_end.process(sound[: len(noise)])
    front_end.learn_ego_noise(0.0)
    frame = front_end.process(sound[len(noise) :])[-1]
    assert isinstance(frame.music, MusicReading)
    assert np.degrees(frame.music.azimuth_rad) == pytest.approx(25.0, abs=1.0)
