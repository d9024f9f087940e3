"""`worldstate array bearings`: write the bearing of the loudest source at every hop.

Write the bearing of the loudest source every 0.1 s, for any array and without a model.

--out is a CSV file with the columns time_s (middle of the window), azimuth_deg (left positive), std_deg
(estimated standard deviation), prominence (peak over median of the spatial spectrum; 1 in silence) and
at_edge (1 at the edge of the searched sector, beyond which the source may be).

Examples
--------
  worldstate array bearings some.wav --array mics.csv --out bearings.csv --figure bearings.png
  worldstate array bearings mic1.wav mic2.wav --array pair.json --out bearings.csv
"""

import argparse
from pathlib import Path

from worldstate.cli.common import inputs, output, progress

_MUCH_AT_EDGE = 0.1  # Share of the hops; more of them at the edge mean a source outside the sector


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    inputs.add_sound_options(parser)
    inputs.add_array_options(parser)
    inputs.add_search_options(parser)
    parser.add_argument("--out", type=Path, required=True, metavar="CSV", help="file to write")
    parser.add_argument("--figure", type=Path, metavar="PNG", help="draw azimuth over time")


def run(arguments: argparse.Namespace) -> output.CommandResult:
    """Run the command; return its result."""
    from worldstate.operations.recordings import bearing_track

    output.check_outputs(arguments, "out", figures=("figure",))
    with inputs.opened_front_end(arguments) as (audio, front_end), progress.sound_bar(audio) as bar:
        track = bearing_track.track_bearings(audio, front_end, on_second=bar.advance)
        silent = list(audio.silent_channels)
    bearing_track.write_bearings(track, arguments.out)
    if arguments.figure is not None:
        bearing_track.write_bearings_figure(track, arguments.figure, audio.path.name)
    if (at_edge := float(track.at_edge.mean())) > _MUCH_AT_EDGE and arguments.azimuth_span is not None:
        told = f"{100 * at_edge:.0f} % of the bearings are at the edge of the searched sector"
        output.say(f"{told}: without --azimuth-span the array chooses the sector")
    summary = {
        "out": str(arguments.out),
        "array": inputs.stance(front_end.array),
        "band_hz": list(front_end.settings.srp_band_hz),
        "hops": len(track),
        "silent_channels": silent,
    }
    return output.CommandResult(summary)
