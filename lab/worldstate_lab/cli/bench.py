"""`worldstate-lab bench`: costs and accuracies of parts of the library, beside peers.

WHAT is one of these; options after it are its own (`worldstate-lab bench labels --help`).

  cost            the front-end per 0.1-s hop, stage by stage, and what follows it (the default)
  ego-noise       cancelling ego-noise per hop, beside the transform that it follows
  gospa           the world-state beside trackers, by GOSPA on bearing, on streams
  import          the imports, each in a fresh interpreter
  label-training  a model trained on labelled streams beside one trained on the truth
  labels          T0 and hidden places of smoothed passes on streams, beside the filter's
  smoothing       a step of the fixed-lag smoother, beside an RTS smoother over the same lag
  street          what ten passes tell of a street, and what the filter makes of it afterwards

Costs are of one BLAS thread. Peers that are installed (pyroomacoustics, and the published chain built on it)
are timed in the same run.
"""

import argparse

from worldstate.cli.common.output import CommandResult

BENCHES = ("cost", "ego-noise", "gospa", "import", "label-training", "labels", "smoothing", "street")

EXAMPLE = """\
examples:
  worldstate-lab bench --rounds 5
  worldstate-lab bench labels streams/*-approaches-*.npz --passes 12"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("what", nargs="?", choices=BENCHES, default="cost", metavar="WHAT", help="(default: cost)")
    add("words", nargs=argparse.REMAINDER, metavar="...", help="its options")
    add("--rounds", type=int, metavar="N", help="of `cost`: medians over so many (default: 5)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the benchmark; return what it found."""
    from worldstate_lab.benchmarks import (
        cost,
        ego_noise,
        gospa,
        import_time,
        label_training,
        labels,
        smoothing,
        street,
    )

    modules = cost, ego_noise, gospa, import_time, label_training, labels, smoothing, street
    module = dict(zip(BENCHES, modules, strict=True))[arguments.what]
    program = f"worldstate-lab bench {arguments.what}"
    parser = argparse.ArgumentParser(
        program, description=module.__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object")
    module.add_options(parser)
    if arguments.rounds is not None:
        parser.set_defaults(rounds=arguments.rounds)
    given = parser.parse_args(arguments.words)
    arguments.json |= given.json
    found: CommandResult = module.run(given)
    return found
