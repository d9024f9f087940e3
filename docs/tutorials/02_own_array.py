"""An array of your own: what its geometry allows, and what the front-end makes of sound from everywhere."""

from pathlib import Path

import numpy as np
from tutorial_options import tutorial_options

from worldstate import MicrophoneArray
from worldstate.adapters import read_array
from worldstate.frontend import FrontEnd
from worldstate.operations import array_bounds
from worldstate.operations.figure_style import figure_file

RATE_HZ, SNR_DB, TURNED = 16_000, -12.0, 2.0 * np.pi * np.arange(8) / 8
ARRAYS = {
    "ring of 8": [(0.15 * np.cos(one), 0.15 * np.sin(one), 0.0) for one in TURNED],
    "line of 8 across": [(0.0, 0.05 * (3.5 - i), 0.0) for i in range(8)],
    "4 corners of a roof": [(x, y, 0.0) for x in (0.7, -0.7) for y in (0.5, -0.5)],
}


def heard(array: MicrophoneArray, azimuth_rad: float, rng: np.random.Generator) -> float:
    """Return the error, degrees, of the bearing of 1.1 s of noise below 3 kHz from a far source."""
    n = round(1.1 * RATE_HZ)
    hz = np.fft.rfftfreq(n, 1.0 / RATE_HZ)
    source = (np.fft.rfft(rng.normal(size=n)) * (hz < 3000.0))[:, None]
    wave = np.fft.irfft(source * np.exp(-2j * np.pi * hz[:, None] * array.delays_s(azimuth_rad)), n, axis=0)
    noise = wave.std() * 10.0 ** (-SNR_DB / 20.0) * rng.normal(size=wave.shape)
    frame = FrontEnd(array, RATE_HZ).process((0.01 * (wave + noise)).astype(np.float32))[-1]
    return abs(float(np.degrees(frame.bearing_rad - azimuth_rad)))


def main(out: Path, size: str = "full") -> None:
    """Draw bound and measured error over azimuth for three arrays."""
    rng, azimuths = np.random.default_rng(1), np.arange(-80.0, 81.0, 40.0 if size == "small" else 10.0)
    with figure_file(out / "02_own_array.png", 8.0, 3.6) as figure:
        bound, error = figure.subplots(1, 2)
        for name, positions in ARRAYS.items():
            path = out / f"{name}.csv"  # a line a microphone, in the order of the channels
            np.savetxt(path, positions, delimiter=",", header="x,y,z", comments="", fmt="%.4f")
            array = read_array(path)
            told = array_bounds(array, 1000.0, azimuths.tolist())
            errors = [heard(array, np.radians(one), rng) for one in azimuths]
            bound.semilogy(azimuths, [told.at(one, SNR_DB, 20) for one in azimuths], label=name)
            error.plot(azimuths, errors, marker=".", label=name)
            print(f"{name}: cannot tell {told.ambiguity}, alias from {told.alias_hz:.0f} Hz, ", end="")
            print(f"median error {np.median(errors):.1f} degrees, worst {max(errors):.0f}")
        bound.set(title="bound, 1 kHz, 20 snapshots, -12 dB", ylabel="standard deviation, degrees")
        bound.set_yticks([1, 3, 10, 30], ["1", "3", "10", "30"], minor=False)
        bound.minorticks_off()
        error.set(title="one bearing of the front-end each, -12 dB", ylabel="error, degrees")
        figure.supxlabel("azimuth of the source, degrees (left positive)", fontsize=10)
        bound.legend(loc="upper center")


if __name__ == "__main__":
    main(*tutorial_options(__doc__))
