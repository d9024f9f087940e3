"""Your own array: the limits of its geometry, and the errors of the front-end beside them."""

import numpy as np

from worldstate import MicrophoneArray
from worldstate.operations import array_bounds

turn = 2.0 * np.pi * np.arange(8) / 8
arrays = {
    "ring of 8": MicrophoneArray(0.15 * np.column_stack([np.cos(turn), np.sin(turn), 0.0 * turn])),
    "line of 8 across": MicrophoneArray([(0.0, 0.05 * (3.5 - i), 0.0) for i in range(8)]),
    "4 corners of a roof": MicrophoneArray([(x, y, 0.0) for x in (0.7, -0.7) for y in (0.5, -0.5)]),
}
for name, array in arrays.items():
    bounds = array_bounds(array, 1000.0, [0.0])
    print(f"{name}: ambiguous {bounds.ambiguity}, alias-free up to {bounds.alias_hz:.0f} Hz")

# The figure: the bound of eq. (4) for one frequency, and one bearing of the front-end per azimuth.
from tutorial_figures import tutorial_figure

from worldstate.frontend import FrontEnd

RATE_HZ, SNR_DB, AZIMUTHS_DEG = 16_000, -6.0, np.arange(-80.0, 81.0, 10.0)
rng = np.random.default_rng(1)


def error_deg(array: MicrophoneArray, azimuth_rad: float) -> float:
    """Return the error of a bearing from 1.1 s of noise below 3 kHz of a far source, degrees."""
    n = round(1.1 * RATE_HZ)
    hz = np.fft.rfftfreq(n, 1.0 / RATE_HZ)[:, None]
    source = np.fft.rfft(rng.normal(size=n))[:, None] * (hz < 3000.0)
    wave = np.fft.irfft(source * np.exp(-2j * np.pi * hz * array.delays_s(azimuth_rad)), n, axis=0)
    noise = wave.std() * 10.0 ** (-SNR_DB / 20.0) * rng.normal(size=wave.shape)
    frame = FrontEnd(array, RATE_HZ).process((0.01 * (wave + noise)).astype(np.float32))[-1]
    return abs(float(np.degrees(frame.bearing_rad - azimuth_rad)))


with tutorial_figure(__file__, 8.0, 3.6) as figure:
    bound, error = figure.subplots(1, 2)
    for name, array in arrays.items():
        bounds = array_bounds(array, 1000.0, AZIMUTHS_DEG.tolist())
        bound.semilogy(AZIMUTHS_DEG, [bounds.at(one, SNR_DB, 20) for one in AZIMUTHS_DEG], label=name)
        error.plot(AZIMUTHS_DEG, [error_deg(array, one) for one in np.radians(AZIMUTHS_DEG)], marker=".")
    bound.set(title="bound: 1 kHz, 20 snapshots, -6 dB", ylabel="standard deviation, degrees")
    bound.set_yticks([1, 3, 10, 30], ["1", "3", "10", "30"], minor=False)
    bound.minorticks_off()
    error.set(title="measured: noise below 3 kHz, -6 dB", ylabel="error, degrees")
    figure.supxlabel("azimuth of the source, degrees (left positive)", fontsize=10)
    bound.legend(loc="upper center")
