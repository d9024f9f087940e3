"""`worldstate array bounds`: what an array allows, and how near the estimators come to it.

Print the second moment S_xx, aperture and alias frequency of an array, and the Cramer-Rao bound of a bearing
at several azimuths: the standard deviation that no unbiased estimator can beat. The SNR is per microphone and
snapshot, N snapshots independent.

--out also tries the estimators (tone, delay, bearing) on random sound, beside their bounds:
OUT/efficiency.png, variance over bound against SNR; OUT/endfire.png, the bearing from broadside to 80 degrees
from it; OUT/bounds.json, the numbers.
"""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from worldstate.cli.common.inputs import add_array_options, given_array, stance
from worldstate.cli.common.output import CommandResult, output_folder, write_report
from worldstate.cli.common.progress import progress_bar

if TYPE_CHECKING:
    from worldstate.frontend.array.microphone_array import MicrophoneArray
    from worldstate.operations.arrays.array_bounds import ArrayBounds
    from worldstate.operations.arrays.efficiency import Efficiency

AZIMUTHS_DEG = (0.0, 20.0, 40.0, 60.0, 80.0)
ENDFIRE_DEG = tuple(float(azimuth) for azimuth in range(0, 81, 10))
ENDFIRE_SNR_DB = 10.0
# From below the threshold SNR, where estimators fail, to well above it.
SNR_DB = (-15.0, -10.0, -5.0, 0.0, 5.0, 10.0, 15.0, 20.0, 30.0)
# Every fourth microphone of the array beside all of them.
THINNING = 4

EXAMPLE = """\
examples:
  worldstate array bounds
  worldstate array bounds --array mics.xml --frequency 800 --snr-db 0 10 20 --out bounds"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_array_options(parser, "the 56-microphone roof array")
    add = parser.add_argument
    add("--frequency", type=float, default=1000.0, metavar="HZ", help="of the source (default: %(default)g)")
    add("--snr-db", type=float, nargs="+", default=list(SNR_DB), metavar="DB", help="(default: -15 to 30)")
    add("--snapshots", type=int, default=20, metavar="N", help="(default: %(default)s)")
    add("--trials", type=int, default=400, help="estimates a point (default: %(default)s)")
    add("--seed", type=int, default=1, help="of the random sound (default: %(default)s)")
    add("--out", type=Path, metavar="DIR", help="try the estimators and draw the figures")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return what it found."""
    from worldstate.frontend.array.microphone_array import roof_array_56
    from worldstate.ground.checks import in_range
    from worldstate.operations.arrays.array_bounds import array_bounds

    in_range("--frequency", arguments.frequency, 0.0, 1e6, open_low=True)
    in_range("--snapshots", arguments.snapshots, 1, 1e6)
    in_range("--trials", arguments.trials, 2, 1e6)
    in_range("--seed", arguments.seed, 0, 2**63)
    for level in arguments.snr_db:
        in_range("--snr-db", level, -100.0, 100.0)
    array = given_array(arguments) or roof_array_56()
    bounds = array_bounds(array, arguments.frequency, AZIMUTHS_DEG)
    found = {} if arguments.out is None else _try_estimators(array, arguments)
    report = bounds.to_dict() | {"snapshots": arguments.snapshots, "snr_db": arguments.snr_db} | found
    return CommandResult(report, table=_as_table(bounds, array, arguments))


def _as_table(
    bounds: "ArrayBounds", array: "MicrophoneArray", arguments: argparse.Namespace
) -> dict[str, object]:
    """One line a quantity, and one an azimuth, for people."""
    N, levels = arguments.snapshots, arguments.snr_db
    table: dict[str, object] = {
        "array": stance(array),
        "S_xx": f"{bounds.horizontal_moment_m2:.4g} m^2",
        "alias-free to": f"{bounds.alias_hz:.0f} Hz (mean spacing {100 * bounds.mean_spacing_m:.1f} cm)",
        "cannot tell apart": bounds.ambiguity,
        "broadside": f"azimuth {bounds.broadside_deg:.3g} deg",
        "bearing": f"standard deviation in degrees at {bounds.frequency_hz:g} Hz; beside it for N = {N} and "
        f"SNR {', '.join(f'{level:g}' for level in levels)} dB",
    }
    for azimuth, constant in bounds.sigma_deg.items():
        if constant is None:
            table[f"  azimuth {azimuth:g} deg"] = "none: endfire"
            continue
        each = "  ".join(f"{bounds.at(azimuth, level, N):.3g}" for level in levels)
        table[f"  azimuth {azimuth:g} deg"] = f">= {constant:.3g} / sqrt(2 N SNR)   {each}"
    speeds = "  ".join(f"{bounds.radial_speed_std_m_s(level):.3g}" for level in levels)
    table["radial speed"] = f"m/s, from a tone of {bounds.frequency_hz:g} Hz heard for a second   {speeds}"
    return table


def _try_estimators(array: "MicrophoneArray", arguments: argparse.Namespace) -> dict[str, object]:
    """Measure, draw, write; return the numbers."""
    from worldstate.operations.arrays.efficiency import write_efficiency_figure, write_endfire_figure

    output_folder(arguments.out, "efficiency.png", "endfire.png", "bounds.json")
    over_snr, endfire = _measure(array, arguments)
    write_efficiency_figure(over_snr, arguments.out / "efficiency.png")
    title = f"{arguments.frequency:g} Hz, SNR {ENDFIRE_SNR_DB:g} dB, N = {arguments.snapshots}"
    write_endfire_figure(endfire, array, title, arguments.out / "endfire.png")
    report: dict[str, object] = {
        "trials": arguments.trials,
        "seed": arguments.seed,
        "sampling_db": list(endfire.sampling_db()),
        "efficiency_db": {one.name: one.ratio_db.tolist() for one in over_snr},
        "endfire_snr_db": ENDFIRE_SNR_DB,
        "from_broadside_deg": list(ENDFIRE_DEG),
        "endfire_bound_rad2": endfire.bound.tolist(),
        "endfire_mean_square_rad2": endfire.mean_square.tolist(),
    }
    write_report(arguments.out / "bounds.json", report)
    return report


def _measure(
    array: "MicrophoneArray", arguments: argparse.Namespace
) -> "tuple[list[Efficiency], Efficiency]":
    import numpy as np

    from worldstate.frontend.array.microphone_array import MicrophoneArray
    from worldstate.operations.arrays.efficiency import (
        bearing_trial,
        delay_trial,
        measure_over_snr,
        measure_toward_endfire,
        tone_trial,
    )

    there = {"frequency_hz": arguments.frequency, "snapshots": arguments.snapshots}
    arrays = [array]
    if array.n_microphones >= 2 * THINNING:
        arrays.append(MicrophoneArray(array.positions_m[::THINNING]))
    tones = [tone_trial(complex_signal=kind) for kind in (False, True)]
    tasks = [*tones, delay_trial(), *(bearing_trial(one, **there) for one in arrays)]
    streams = np.random.default_rng(arguments.seed).spawn(len(tasks) + 1)
    azimuths = np.radians(ENDFIRE_DEG).tolist()
    points = len(tasks) * len(arguments.snr_db) + len(azimuths)
    with progress_bar("estimating", points, quiet=arguments.json) as bar:
        over_snr = [
            measure_over_snr(task, arguments.snr_db, arguments.trials, rng, bar.advance)
            for task, rng in zip(tasks, streams[1:], strict=True)
        ]
        endfire = measure_toward_endfire(
            array, azimuths, ENDFIRE_SNR_DB, arguments.trials, streams[0], on_point=bar.advance, **there
        )
    return over_snr, endfire
