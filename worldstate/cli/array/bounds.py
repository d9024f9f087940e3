"""`worldstate array bounds`: print the limits of an array.

Print the second moment S_xx, the aperture and the alias frequency of an array, and the Cramer-Rao bound of a
bearing at several azimuths: the least standard deviation of an unbiased estimator. The SNR is per microphone
and snapshot, for N independent snapshots.

Examples
--------
  worldstate array bounds
  worldstate array bounds --array mics.xml --frequency 800 --snr-db 0 10 20
"""

import argparse

from worldstate import frontend, ground, operations
from worldstate.cli.common import inputs, output

AZIMUTHS_DEG = (0.0, 20.0, 40.0, 60.0, 80.0)
# From below the threshold SNR, at which estimators fail, to well above it.
SNR_DB = (-15.0, -10.0, -5.0, 0.0, 5.0, 10.0, 15.0, 20.0, 30.0)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    inputs.add_array_options(parser, "the 56-microphone roof array")
    add = parser.add_argument
    source = "frequency of the source (default: %(default)g)"
    add("--frequency", type=float, default=1000.0, metavar="HZ", help=source)
    ratios = "signal-to-noise ratios (default: -15 to 30)"
    add("--snr-db", type=float, nargs="+", default=list(SNR_DB), metavar="DB", help=ratios)
    add("--snapshots", type=int, default=20, metavar="N", help="independent snapshots (default: %(default)s)")


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return its result."""
    ground.in_range("--frequency", arguments.frequency, 0.0, 1e6, open_low=True)
    ground.in_range("--snapshots", arguments.snapshots, 1, 1e6)
    for level in arguments.snr_db:
        ground.in_range("--snr-db", level, -100.0, 100.0)
    array = inputs.given_array(arguments) or frontend.roof_array_56()
    bounds = operations.array_bounds(array, arguments.frequency, AZIMUTHS_DEG)
    report = bounds.to_dict() | {"snapshots": arguments.snapshots, "snr_db": arguments.snr_db}
    return output.CommandResult(report, table=_as_table(bounds, array, arguments))


def _as_table(
    bounds: "operations.ArrayBounds", array: "frontend.MicrophoneArray", arguments: argparse.Namespace
) -> dict[str, object]:
    """Return a readable table with one line per quantity and per azimuth."""
    N, levels = arguments.snapshots, arguments.snr_db
    table: dict[str, object] = {
        "array": inputs.stance(array),
        "S_xx": f"{bounds.horizontal_moment_m2:.4g} m^2",
        "alias-free to": f"{bounds.alias_hz:.0f} Hz (mean spacing {100 * bounds.mean_spacing_m:.1f} cm)",
        "indistinguishable": bounds.ambiguity,
        "broadside": f"azimuth {bounds.broadside_deg:.3g} deg",
        "bearing": f"standard deviation in degrees at {bounds.frequency_hz:g} Hz, and for N = {N} "
        f"and SNR {', '.join(f'{level:g}' for level in levels)} dB",
    }
    for azimuth, constant in bounds.sigma_deg.items():
        if constant is None:
            table[f"  azimuth {azimuth:g} deg"] = "none: endfire"
            continue
        each = "  ".join(f"{bounds.at(azimuth, level, N):.3g}" for level in levels)
        table[f"  azimuth {azimuth:g} deg"] = f">= {constant:.3g} / sqrt(2 N SNR)   {each}"
    speeds = "  ".join(f"{bounds.radial_speed_std_m_s(level):.3g}" for level in levels)
    table["radial speed"] = f"m/s, from a tone of {bounds.frequency_hz:g} Hz measured for a second   {speeds}"
    return table
