"""`worldstate simulate`: blind-junction recordings in the OVAD layout."""

import argparse
from pathlib import Path

from worldstate.cli.output import print_summary
from worldstate.cli.progress import progress_bar

DESCRIPTION = """\
Simulate recordings of a vehicle with a roof array that stands at blind junctions, in the OVAD layout:
D/DataLog.csv and D/<environment>/<class>/<ID>/ with out_multi.wav, camera_baseline_results.json, truth.json.
Every other recording is an approach, from the left and from the right in turn; the others are hazard-free.
The same seed gives the same bytes, whatever the number of jobs. --video adds what the camera sees,
ueye_stereo_vid.mp4 at the size of OVAD's camera, from the extra `vision`; sound and boxes stay the same."""

EXAMPLE = """\
examples:
  worldstate simulate --out sim --static 4 --seed 1
  worldstate run sim/SA1/left/1_00_0000"""


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Declare the command and its options."""
    parser = subparsers.add_parser(
        "simulate",
        help="write simulated recordings in the OVAD layout",
        description=DESCRIPTION,
        epilog=EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--out", type=Path, required=True, metavar="D", help="folder of the data set")
    parser.add_argument(
        "--static", type=int, default=4, metavar="N", help="recordings (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=1, help="another seed, another data set (default: 1)")
    parser.add_argument("--jobs", type=int, default=1, help="processes (default: 1)")
    parser.add_argument("--duration", type=float, default=10.0, help="seconds each (default: %(default)g)")
    parser.add_argument("--video", action="store_true", help="render the camera's video, too")
    parser.add_argument("--json", action="store_true", help="print the summary as one JSON object")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Run the command; return its exit code."""
    from worldstate.adapters.simulation import write_dataset

    with progress_bar("simulating", arguments.static) as bar:
        rows = write_dataset(
            arguments.out,
            arguments.static,
            arguments.seed,
            jobs=arguments.jobs,
            duration_s=arguments.duration,
            video=arguments.video,
            progress=lambda row: bar.advance(),
        )
    summary = {
        "out": str(arguments.out),
        "recordings": len(rows),
        "approaches": sum(row.approach != "none" for row in rows),
        "seed": arguments.seed,
        "folders": [row.folder.as_posix() for row in rows],
    }
    print_summary(summary, as_json=arguments.json)
    return 0
