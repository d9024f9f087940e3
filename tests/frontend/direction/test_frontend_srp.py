"""SRP-PHAT against pyroomacoustics on the same frames, and its laws."""

import numpy as np
import pyroomacoustics
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plane_waves import noise_from

from worldstate.frontend.array.microphone_array import MicrophoneArray, roof_array_56
from worldstate.frontend.array.steering import Steering
from worldstate.frontend.direction.bearing import find_peaks, srp_phat
from worldstate.frontend.spectra.stft import StreamingStft, band_bins, bin_frequencies_hz

AZIMUTHS = np.radians(np.arange(-90.0, 91.0))
BAND = (300.0, 1800.0)


def random_array(rng: np.random.Generator, n_microphones: int = 6) -> MicrophoneArray:
    return MicrophoneArray(rng.uniform(-0.3, 0.3, (n_microphones, 3)))


def beams(array: MicrophoneArray, rate: float = 48_000.0) -> Steering:
    return Steering.towards(array, bin_frequencies_hz(band_bins(BAND, rate, 512), rate, 512), AZIMUTHS)


@pytest.mark.parametrize("rate", [47_998.0, 16_000.0])
@pytest.mark.parametrize("layout", ["roof", "square", "line", "solid"])
def test_equals_pyroomacoustics_on_the_same_frames(layout: str, rate: float) -> None:
    layouts = {
        "roof": roof_array_56().positions_m,
        "square": [[0.1, 0.1, 0], [0.1, -0.1, 0], [-0.1, -0.1, 0], [-0.1, 0.1, 0]],
        "line": [[0, 0.1 * i, 0] for i in range(6)],
        "solid": np.random.default_rng(5).uniform(-0.3, 0.3, (9, 3)),
    }
    array = MicrophoneArray(layouts[layout])
    sound = noise_from(array, 0.3, rate, 4800 / rate)
    frames = StreamingStft(array.n_microphones, 512, range(0, 257)).push(sound)
    peer = pyroomacoustics.doa.SRP(array.positions_m.T, rate, 512, c=343.0, azimuth=AZIMUTHS)
    peer.locate_sources(frames.transpose(2, 1, 0).astype(np.complex128), freq_range=list(BAND))
    bins = band_bins(BAND, rate, 512)
    ours = srp_phat(frames[:, bins.start : bins.stop], beams(array, rate))
    assert np.corrcoef(ours, peer.grid.values)[0, 1] > 0.999999
    m = array.n_microphones
    np.testing.assert_allclose(ours * 2 * m / (m - 1), peer.grid.values, rtol=2e-5)


@given(st.floats(-1.4, 1.4), st.integers(0, 2**32 - 1))
@settings(deadline=None, max_examples=25)
def test_a_lone_plane_wave_scores_one_where_it_comes_from(azimuth: float, seed: int) -> None:
    array = random_array(np.random.default_rng(seed))
    frequencies = bin_frequencies_hz(band_bins(BAND, 48_000, 512), 48_000, 512)
    steering = Steering.towards(array, frequencies, [azimuth - 0.2, azimuth, azimuth + 0.2])
    wave = array.steering(frequencies, azimuth)[None, :, :, 0].astype(np.complex64)
    spectrum = srp_phat(wave, steering)
    assert spectrum[1] == pytest.approx(1.0, abs=1e-5)
    assert spectrum[1] >= spectrum.max()


@pytest.mark.parametrize("azimuth_deg", [-70.0, -20.4, 0.3, 33.7, 60.0])
def test_bearing_is_finer_than_the_grid(azimuth_deg: float) -> None:
    array = roof_array_56()
    sound = noise_from(array, np.radians(azimuth_deg), 47_998.0, 1.0, 3)
    bins = band_bins(BAND, 47_998, 512)
    spectrum = srp_phat(StreamingStft(56, 512, bins).push(sound), beams(array, 47_998.0))
    found_deg = np.degrees(find_peaks(spectrum, AZIMUTHS)[0].azimuth_rad)
    assert abs(found_deg - azimuth_deg) < 0.1 / np.cos(np.radians(azimuth_deg))
