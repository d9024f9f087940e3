"""`worldstate-lab bench`: what the front-end costs on this machine, beside its peers.

Time the acoustic front-end per 0.1-s hop, stage by stage: 56 channels at 47,998 Hz, one BLAS thread. Peers
that are installed (pyroomacoustics, and the published chain built on it) are timed in the same run.
"""

import argparse
from typing import TYPE_CHECKING

from worldstate.cli.common.output import CommandResult
from worldstate.cli.common.progress import progress_bar

if TYPE_CHECKING:
    from worldstate_lab.benchmarks.bench import BenchReport

EXAMPLE = "example: worldstate-lab bench --rounds 5"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--rounds", type=int, default=5, help="medians over so many (default: %(default)s)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return what it found."""
    from worldstate.ground.checks import in_range
    from worldstate_lab.benchmarks.bench import run_bench

    rounds = int(in_range("rounds", arguments.rounds, 1, 1000))
    with progress_bar("timing", rounds, quiet=arguments.json) as bar:
        report = run_bench(rounds, on_round=bar.advance)
    return CommandResult(report.to_dict(), table={}, lines=_lines(report))


def _lines(report: "BenchReport") -> list[str]:
    head = f"BLAS {', '.join(report.blas)}; {report.threads} thread; median of {report.rounds} rounds"
    rows = [*report.stages.items(), ("STFT + SRP181 + feature", (report.total_ms, report.p99_ms))]
    return [
        f"{head}; load {report.load:.1f}; ms per hop",
        *(f"  {name:32s} {median:9.3f}   p99 {p99:9.3f}" for name, (median, p99) in rows),
        *(f"  peer {name:27s} {median:9.3f}" for name, median in report.peers.items()),
        *(f"  ratio {name:26s} {ratio:9.1f}" for name, ratio in report.ratios.items()),
        *(f"{name}: {setting}" for name, setting in report.settings.items()),
    ]
