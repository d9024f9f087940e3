"""`worldstate twin`: the published figures on simulated recordings, beside the paper's."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from worldstate.cli.output import print_summary
from worldstate.cli.progress import progress_bar

if TYPE_CHECKING:
    from worldstate.evaluation.twin_recording import TwinRecording
    from worldstate.evaluation.twin_score import TwinScore

DESCRIPTION = """\
Simulate occluded approaches and hazard-free recordings of a standing ego, listen to them with the classifier
that was trained on the real windows, and print every published figure beside the paper's. The sound itself is
not kept. Recordings already in OUT are not made again, so an interrupted run goes on where it stopped.

False alarms depend on a free knob, the rate of distant vehicles. It is part of the preset, set once so that
the published rule comes to the paper's 350 an hour; --far-rate tries another.

OUT/twin.json is the report, OUT/twin.png the figure: ROC, reliability, detection against false alarms."""

EXAMPLE = """\
examples:
  worldstate twin --static 83 --jobs 2 --out twin
  worldstate twin --static 8 --seed 3 --json"""


def add_parser(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Declare the command and its options."""
    parser = subparsers.add_parser(
        "twin",
        help="published figures on simulated recordings, beside the paper's",
        description=DESCRIPTION,
        epilog=EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--static", type=int, default=83, metavar="N", help="recordings (default: 83)")
    parser.add_argument("--jobs", type=int, default=1, help="processes (default: 1)")
    parser.add_argument("--seed", type=int, default=1, help="another seed, another data set (default: 1)")
    parser.add_argument("--duration", type=float, default=10.0, help="seconds each (default: %(default)g)")
    parser.add_argument("--preset", metavar="NAME", help="levels of the simulation (default: the newest)")
    parser.add_argument("--far-rate", type=float, metavar="N", help="distant vehicles a recording")
    parser.add_argument("--model", type=Path, help="classifier (default: the one that ships)")
    parser.add_argument(
        "--out", type=Path, default=Path("twin"), metavar="DIR", help="(default: %(default)s)"
    )
    parser.add_argument("--keep", action="store_true", help="keep the recordings too, 80 MB each")
    parser.add_argument("--json", action="store_true", help="print the report as one JSON object")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Run the command; return its exit code."""
    import json

    import numpy as np

    from worldstate.adapters.atomic import write_text
    from worldstate.evaluation.twin_figures import twin_figures, twin_intervals
    from worldstate.evaluation.twin_plot import write_twin_figure
    from worldstate.evaluation.twin_report import twin_report, twin_table
    from worldstate.evaluation.twin_score import score_twins

    recordings = _listen(arguments)
    # Folds and bootstrap are drawn apart from the recordings, from the same seed.
    folds, draws = np.random.default_rng(arguments.seed).spawn(2)
    score = score_twins(recordings, folds)
    origin = _origin(arguments, score)
    report = origin | twin_report(twin_figures(score), twin_intervals(score, draws))
    write_text(arguments.out / "twin.json", json.dumps(report, allow_nan=False, indent=1) + "\n")
    write_twin_figure(score, arguments.out / "twin.png")
    if arguments.json:
        print_summary(report, as_json=True)
        return 0
    print_summary(
        {k: v for k, v in report.items() if k not in ("figures", "agreeing", "judged")}, as_json=False
    )
    print(twin_table(report))
    return 0


def _listen(arguments: argparse.Namespace) -> "list[TwinRecording]":
    from dataclasses import replace

    from worldstate.adapters.simulation import DEFAULT_PRESET, preset
    from worldstate.adapters.simulation.dataset import plan_static
    from worldstate.checks import in_range
    from worldstate.evaluation.twin_simulation import TwinSettings, listen_twins

    in_range("--static", arguments.static, 4, 10_000)
    in_range("--jobs", arguments.jobs, 1, 256)
    in_range("--duration", arguments.duration, 1.5, 60.0)
    levels = preset(arguments.preset or DEFAULT_PRESET)
    if arguments.far_rate is not None:
        levels = replace(levels, far_rate=arguments.far_rate)
    plans = plan_static(arguments.static, arguments.seed)
    heard = arguments.out / "heard"
    heard.mkdir(parents=True, exist_ok=True)
    keep = arguments.out / "recordings" if arguments.keep else None
    settings = TwinSettings(levels, arguments.duration, arguments.model, keep)
    recordings = []
    with progress_bar("simulating and listening", len(plans)) as bar:
        for recording in listen_twins(heard, plans, settings, arguments.jobs):
            recordings.append(recording)
            bar.advance()
    return recordings


def _origin(arguments: argparse.Namespace, score: "TwinScore") -> dict[str, object]:
    from worldstate.adapters.simulation import DEFAULT_PRESET, preset
    from worldstate.evaluation.hop_stream import HOP_S

    levels = preset(arguments.preset or DEFAULT_PRESET)
    calm = [recording for recording in score.recordings if recording.hazard_free]
    return {
        "out": str(arguments.out),
        "recordings": len(score.recordings),
        "approaches": len(score.recordings) - len(calm),
        "hazard_free_hours": sum(len(recording.time_s) for recording in calm) * HOP_S / 3600.0,
        "seed": arguments.seed,
        "preset": levels.name,
        "far_rate": levels.far_rate if arguments.far_rate is None else arguments.far_rate,
        "sustain_hops": list(score.sustain_hops),
    }
