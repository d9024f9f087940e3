"""What a front-end does where it is asked: elevations, several peaks; the twin of a bearing."""

import numpy as np

from worldstate.frontend.array.microphone_array import MicrophoneArray, roof_array_56
from worldstate.frontend.stream import FrontEnd

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


def test_several_sources_are_several_peaks() -> None:
    truth = [(-50.0, 0.0), (-5.0, 0.0), (40.0, 0.0)]
    frame = FrontEnd(ARRAY, RATE).process(waves(ARRAY, truth))[-1]
    found = sorted(np.degrees(peak.azimuth_rad) for peak in frame.peaks[:3])
    np.testing.assert_allclose(found, [azimuth for azimuth, _ in truth], atol=2.5)
    assert frame.peaks[0].azimuth_rad == frame.bearing_rad
    assert frame.peaks[0].prominence == frame.prominence
    assert sorted(frame.peaks, key=lambda peak: -peak.value) == list(frame.peaks)
    assert len(frame.peaks) <= 4
