"""`worldstate twin`: the published figures on simulated recordings, beside the paper's.

Simulate occluded approaches and hazard-free recordings of a standing ego, listen to them with the published
classifier, and print every published figure beside the paper's. As in the paper, the classifier is trained on
other recordings of the same junctions, simulated too: OUT/training-*.csv holds their windows, and
--method worldstate trains the ensemble on them instead. --model takes any model file, "default" the one that
ships, which knows the real junctions only. The sound itself is not kept. Recordings already in OUT are not
made again, so an interrupted run goes on where it stopped, and another classifier costs nothing.

False alarms depend on a free knob, the rate of distant vehicles. It is part of the preset, set once so that
the published rule comes to the paper's 350 an hour; --far-rate tries another.

--realism compares simulated windows with the real ones of a feature table, over three seeds: medians,
transfer both ways, and how well a classifier tells them apart.

OUT/twin.json is the report, OUT/twin.png the figure: ROC, reliability, detection against false alarms.
"""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from worldstate.cli.common.command import add_choice
from worldstate.cli.common.output import CommandResult, write_report
from worldstate.cli.common.outputs import output_folder
from worldstate.cli.common.progress import progress_bar, track

if TYPE_CHECKING:
    from worldstate.abduction.signature.signature_io import AnySignature
    from worldstate.adapters.simulation.scene.presets import Preset
    from worldstate.operations.recordings.hop_table import HopTable
    from worldstate.studies.streets.decision_rules import RuleScores
    from worldstate.studies.streets.realism import Realism

# Windows from either side at every site, and the seeds, of the comparison with real ones.
WINDOWS = 10
REALISM_SEEDS = (1, 2, 3)
# A word and no path: a file of this name is given as ./default.
DEFAULT_MODEL = "default"

EXAMPLE = """\
examples:
  worldstate twin --static 83 --jobs 2 --out twin
  worldstate twin --static 83 --jobs 2 --out twin --method worldstate
  worldstate twin --static 8 --seed 3 --model default --json
  worldstate twin --realism features.csv --out twin"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("--static", type=int, default=83, metavar="N", help="recordings (default: 83)")
    add("--jobs", type=int, default=1, help="processes (default: 1)")
    add("--seed", type=int, default=1, help="another seed, another data set (default: 1)")
    add("--duration", type=float, default=10.0, help="seconds each (default: %(default)g)")
    add("--preset", metavar="NAME", help="levels of the simulation (default: the newest)")
    add("--far-rate", type=float, metavar="N", help="distant vehicles a recording")
    trained = "what is trained: the published classifier or the ensemble"
    add_choice(parser, "--method", trained, "baseline", "worldstate")
    add("--model", metavar="FILE", help='classifier: a model file, or "default"')
    add("--out", type=Path, default=Path("twin"), metavar="DIR", help="(default: %(default)s)")
    add("--realism", type=Path, metavar="CSV", help="real windows to compare with")
    ego = "of the real windows: standing or moving ego"
    add_choice(parser, "--realism-group", ego, "static", "dynamic")
    add("--keep", action="store_true", help="keep the recordings too, 80 MB each")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return what it found."""
    import numpy as np

    from worldstate.studies.streets.decision_rules import score_rules
    from worldstate.studies.streets.figure import write_comparison_figure
    from worldstate.studies.streets.published_figures import figure_intervals, published_figures
    from worldstate.studies.streets.recording_features import classified
    from worldstate.studies.streets.report import comparison_report, comparison_table

    output_folder(arguments.out, "twin.json", "twin.png")
    realism = _realism(arguments)
    given = None if arguments.model is None else _given(arguments.model)
    hops = _simulate(arguments)
    signature = given or _trained(arguments)
    recordings = [classified(recording, signature) for recording in hops]
    # Folds and bootstrap are drawn apart from the recordings, from the same seed.
    folds, draws = np.random.default_rng(arguments.seed).spawn(2)
    score = score_rules(recordings, folds)
    origin = _origin(arguments, score)
    report = origin | comparison_report(published_figures(score), figure_intervals(score, draws))
    if realism:
        report["realism"] = {str(seed): one.to_dict() for seed, one in realism.items()}
    write_report(arguments.out / "twin.json", report)
    write_comparison_figure(score, arguments.out / "twin.png")
    tables = [f"\nrealism, seed {seed}\n{one.table()}" for seed, one in realism.items()]
    shown = origin | {"outside": report["outside"]}
    return CommandResult(report, table=shown, lines=[comparison_table(report), *tables])


def _simulate(arguments: argparse.Namespace) -> "list[HopTable]":
    from worldstate.adapters.simulation.dataset.plan import plan_static
    from worldstate.ground.checks import in_range
    from worldstate.studies.streets.simulated_streets import StreetSettings, simulated_hops

    in_range("--static", arguments.static, 4, 10_000)
    in_range("--jobs", arguments.jobs, 1, 256)
    in_range("--duration", arguments.duration, 1.5, 60.0)
    plans = plan_static(arguments.static, arguments.seed)
    folder = arguments.out / "hops"
    folder.mkdir(parents=True, exist_ok=True)
    keep = arguments.out / "recordings" if arguments.keep else None
    settings = StreetSettings(_levels(arguments), arguments.duration, keep)
    made = simulated_hops(folder, plans, settings, arguments.jobs)
    return list(track(made, "simulating and listening", len(plans)))


def _given(model: str) -> "AnySignature":
    """Read a model's signature; one that was made for another array than the simulator's is refused."""
    from worldstate.adapters.files.acoustic_domain import check_tables, ovad_domain
    from worldstate.adapters.files.model_file import load_model

    signature, _ = load_model(None if model == DEFAULT_MODEL else model)
    if signature.domain is not None:
        check_tables(signature.domain, ovad_domain(["SA1"]))
    return signature


def _trained(arguments: argparse.Namespace) -> "AnySignature":
    from worldstate.studies.streets.street_training import N_RECORDINGS, train_on_simulation

    with progress_bar("simulating the training windows", N_RECORDINGS) as bar:
        return train_on_simulation(
            arguments.out,
            _levels(arguments),
            arguments.seed,
            method=arguments.method,
            jobs=arguments.jobs,
            progress=bar.advance,
        )


def _levels(arguments: argparse.Namespace) -> "Preset":
    from dataclasses import replace

    from worldstate.adapters.simulation.scene.presets import DEFAULT_PRESET, preset

    levels = preset(arguments.preset or DEFAULT_PRESET)
    return levels if arguments.far_rate is None else replace(levels, far_rate=arguments.far_rate)


def _realism(arguments: argparse.Namespace) -> "dict[int, Realism]":
    if arguments.realism is None:
        return {}
    from functools import partial

    from worldstate.adapters.datasets.feature_table import read_features
    from worldstate.studies.streets.realism import realism_over_seeds
    from worldstate.studies.streets.simulated_windows import simulated_windows

    real = read_features(arguments.realism).group(arguments.realism_group)
    # A moving ego's junctions come as they are in the table; a site that it lacks has nothing to be held to.
    sites = sorted(set(real.environments.tolist()))
    with progress_bar("simulating windows", 4 * WINDOWS * len(sites) * len(REALISM_SEEDS)) as bar:
        simulate = partial(
            simulated_windows,
            WINDOWS,
            sites=sites,
            jobs=arguments.jobs,
            levels=_levels(arguments),
            progress=bar.advance,
        )
        return realism_over_seeds(real, simulate, REALISM_SEEDS)


def _origin(arguments: argparse.Namespace, score: "RuleScores") -> dict[str, object]:
    from worldstate.operations.recordings.advisories import caution
    from worldstate.operations.recordings.hop_stream import HOP_S

    levels = _levels(arguments)
    calm = [recording for recording in score.recordings if recording.hazard_free]
    return {
        "out": str(arguments.out),
        "recordings": len(score.recordings),
        "caution": caution(len(score.recordings)),
        "approaches": len(score.recordings) - len(calm),
        "hazard_free_hours": sum(len(recording.time_s) for recording in calm) * HOP_S / 3600.0,
        "seed": arguments.seed,
        "classifier": arguments.model or f"{arguments.method}, on other recordings of these junctions",
        "preset": levels.name,
        "far_rate": levels.far_rate,
        "sustain_hops": list(score.sustain_hops),
    }
