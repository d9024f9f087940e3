"""`worldstate-lab reach`: the limit of any detector with an array and on a data set.

Print bounds that no method can exceed ("Evidence of Absence", section VI).

For an array: the smallest standard deviation of a bearing over azimuth, for a noise-like source in --band
with --snr-db at each microphone and --snapshots independent snapshots, alone and with a camera of
--camera-std. "share" is the bearing information relative to the best direction; it vanishes towards
endfire, while presence and approach speed remain identifiable.

For --features, a table of labelled feature windows: the entropy of the class (front, left, none, right), the
information of the features about it by three estimates, and Fano's bound on the error of any classifier,
beside the error of the classifier of --method on recordings outside its training.

For --recordings, a data set in the OVAD layout: the Fisher ratio of each band between windows with and
without a vehicle, by level and by the shape of the spectrum alone, and the range in which shape is most
informative.

Examples
--------
  worldstate-lab reach --array mics.xml --snr-db -5
  worldstate-lab reach --features features.csv --json
  worldstate sim make --out sim --static 40 && worldstate-lab reach --recordings sim
"""

import argparse
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path

import numpy as np

from worldstate.adapters.datasets.feature_extraction import read_windows, sample_windows
from worldstate.adapters.datasets.feature_table import read_features
from worldstate.cli.common.command import add_choice
from worldstate.cli.common.inputs import add_array_options, given_array
from worldstate.cli.common.output import CommandResult
from worldstate.cli.common.progress import track
from worldstate.cli.model.fit import add_group
from worldstate.frontend.array.microphone_array import roof_array_56
from worldstate.ground.checks import in_range
from worldstate_lab.paper.identifiability import ReachOfArray, reach_of_array, reach_on_table
from worldstate_lab.report.table import Table, json_values
from worldstate_lab.signatures.clip_signatures import BandProfile, band_profile

# Up to endfire of a transverse array, at which the bound diverges.
AZIMUTHS_DEG = tuple(range(-90, 91, 15))


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add_array_options(parser, "the 56-microphone roof array")
    add("--features", type=Path, metavar="CSV", help="labelled feature windows")
    add_group(parser, "of them")
    add_choice(parser, "--method", "", "worldstate", "baseline")
    add("--recordings", type=Path, metavar="DATASET", help="labelled recordings")
    add("--band", type=float, nargs=2, default=[300.0, 1800.0], metavar="HZ", help="(default: 300 1800)")
    add("--snr-db", type=float, default=-10.0, metavar="DB", help="SNR in each bin (default: %(default)g)")
    add("--snapshots", type=int, default=20, metavar="N", help="number of snapshots (default: %(default)s)")
    add("--camera-std", type=float, default=1.0, metavar="DEG", help="of its bearings (default: %(default)g)")
    add("--seed", type=int, default=0, help="seed of folds and bootstrap (default: %(default)s)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return its result."""
    array, bands, data = _array(arguments), _bands(arguments), None
    if arguments.features is not None:
        table = read_features(arguments.features).group(arguments.group)
        data = reach_on_table(table, arguments.method, np.random.default_rng(arguments.seed))
    found = {"array": array, "features": data, "bands": bands}
    report = {name: json_values(one) for name, one in found.items() if one is not None}
    columns = np.degrees([array.azimuths_rad, array.std_rad, array.with_vision_rad]).tolist()
    heads = ("azimuth (deg)", "std (deg)", "with camera", "share")
    rows = list(zip(*columns, array.endfire.tolist(), strict=True))
    lines = Table("array", "Smallest deviation of a bearing", heads, rows).lines()
    if data is not None:
        lines += ["", *(f"{name:24} {value:.4g}" for name, value in asdict(data).items())]
    if bands is not None:
        edges = [f"{low:.0f} - {high:.0f}" for low, high in pairwise(bands.edges_hz)]
        ratios = zip(edges, bands.by_level.tolist(), bands.by_shape.tolist(), strict=True)
        lines += [
            "",
            *Table("bands", "Fisher ratios", ("band (Hz)", "by level", "by shape"), [*ratios]).lines(),
        ]
        lines.append("shape is most informative from {:.0f} to {:.0f} Hz".format(*bands.range_hz))
    return CommandResult(report, table={}, lines=lines)


def _array(arguments: argparse.Namespace) -> ReachOfArray:
    array = given_array(arguments) or roof_array_56()
    low, high = arguments.band
    in_range("--band", low, 1.0, high)
    in_range("--snr-db", arguments.snr_db, -100.0, 100.0)
    in_range("--snapshots", arguments.snapshots, 1, 1e6)
    frequencies = np.linspace(low, high, 16)
    snr = np.full(frequencies.size, 10.0 ** (arguments.snr_db / 10.0))
    camera_rad = np.radians(in_range("--camera-std", arguments.camera_std, 0.0, 180.0, open_low=True))
    return reach_of_array(
        array, np.radians(AZIMUTHS_DEG), frequencies, snr, arguments.snapshots, vision_std_rad=camera_rad
    )


def _bands(arguments: argparse.Namespace) -> BandProfile | None:
    if arguments.recordings is None:
        return None
    windows = sample_windows(arguments.recordings)[0]
    vehicle = np.array([window.label != "none" for window in windows], dtype=bool)
    return band_profile(track(read_windows(windows), "reading", len(windows)), vehicle)
