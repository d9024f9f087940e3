"""`worldstate-lab corpora`: how well single clips tell vehicles from background, and where they fail.

Reproduce the signature study of "Evidence of Absence", section IX: 16 log-energies a clip, a logistic
regression, area under the ROC curve of vehicle against background with an interval over recordings.

  by level   the energies themselves, which another gain or distance moves
  by shape   the energies without their mean, which it does not

Every row is measured on recordings that were not learned from: the official split where the corpus has one,
else folds by recording; or everything of one corpus is learned and the other is scored. Electric cars,
bicycles and trams are rows of their own, by models that never heard them.

  --idmt      the folder of IDMT-Traffic, with audio/ and annotation/ (doi:10.5281/zenodo.7551553)
  --melaudis  a folder with MELAUDIS_Vehicles/ and MELAUDIS_BG/ (doi:10.6084/m9.figshare.27115870)

Without either, two stand-ins are made from the simulator's emission models, --recordings each: a passage of
every kind of road user (on the roads: of cars and trucks) and three clips without one a recording. Their rows
say SIMULATED, and the rows of the published corpora are listed with the command that would fill them.
"""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from worldstate.cli.common.output import CommandResult, write_report
from worldstate.cli.common.outputs import output_folder
from worldstate.cli.common.progress import progress_bar

if TYPE_CHECKING:
    import numpy as np

    from worldstate.adapters.datasets.traffic_clips import TrafficClip
    from worldstate_lab.signatures.clip_signatures import ClipSignatures

    Corpora = tuple["ClipSignatures | None", "ClipSignatures | None"]

NAMES = ("signatures.json", "signatures.txt", "signatures.png")

EXAMPLE = """\
examples:
  worldstate-lab corpora --out signatures
  worldstate-lab corpora --idmt IDMT_Traffic --melaudis MELAUDIS --jobs 4 --out signatures"""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("--idmt", type=Path, metavar="DIR", help="IDMT-Traffic")
    add("--melaudis", type=Path, metavar="DIR", help="MELAUDIS, both archives unpacked")
    add("--out", type=Path, metavar="DIR", help=f"write {', '.join(NAMES)}")
    recordings = "simulated ones of each corpus, 1 s of work each (default: %(default)s)"
    add("--recordings", type=int, default=12, metavar="N", help=recordings)
    add("--jobs", type=int, default=1, help="processes (default: 1)")
    add("--seed", type=int, default=0, help="simulation, folds and bootstrap (default: %(default)s)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return what it found."""
    import numpy as np

    from worldstate.adapters.files.atomic import write_text
    from worldstate.ground.checks import in_range
    from worldstate_lab.signatures.signature_report import (
        study_lines,
        study_values,
        write_signature_figure,
    )
    from worldstate_lab.signatures.signature_study import QUESTIONS, signature_study

    in_range("--jobs", arguments.jobs, 1, 256)
    # Two for training and two for the test: fewer cannot fill a row.
    in_range("--recordings", arguments.recordings, 4, 10_000)
    if arguments.out is not None:
        output_folder(arguments.out, *NAMES)
    # Apart, so that more recordings leave the folds and draws of a row as they are.
    simulation, draws = np.random.default_rng(arguments.seed).spawn(2)
    given = arguments.idmt is not None or arguments.melaudis is not None
    corpora, stated = (published_corpora(arguments), []) if given else _simulated(arguments, simulation)
    with progress_bar("measuring", len(QUESTIONS)) as bar:
        study = signature_study(*corpora, draws, bar.advance)
    report = study_values(study) | {"assumptions": stated}
    lines = [*stated, *study_lines(study), *_left_out(study.left_out)]
    if arguments.out is not None:
        write_report(arguments.out / NAMES[0], report)
        write_text(arguments.out / NAMES[1], "\n".join(lines) + "\n")
        write_signature_figure(arguments.out / NAMES[2], study)
    return CommandResult(report, table={}, lines=lines)


def published_corpora(arguments: argparse.Namespace) -> "Corpora":
    """Read the corpora of --idmt and --melaudis; None stands for one that was not given."""
    from worldstate.adapters.datasets.idmt_traffic import idmt_traffic
    from worldstate.adapters.datasets.melaudis import melaudis
    from worldstate_lab.signatures.signature_study import IDMT, MELAUDIS

    # Both folders are looked through before the first clip is heard.
    roadside = None if arguments.idmt is None else idmt_traffic(arguments.idmt)
    city = None if arguments.melaudis is None else melaudis(arguments.melaudis)
    return _heard(IDMT, roadside, arguments.jobs), _heard(MELAUDIS, city, arguments.jobs)


def _heard(name: str, clips: "list[TrafficClip] | None", jobs: int) -> "ClipSignatures | None":
    from worldstate_lab.signatures.clip_signatures import hear_clips

    if clips is None:
        return None
    with progress_bar(f"listening to {name}", len(clips)) as bar:
        return hear_clips(name, clips, jobs, bar.advance)


def _simulated(arguments: argparse.Namespace, rng: "np.random.Generator") -> "tuple[Corpora, list[str]]":
    from worldstate_lab.signatures.simulated_corpora import STREETS, simulated_corpora

    with progress_bar("simulating passages", arguments.recordings * len(STREETS)) as bar:
        corpora = simulated_corpora(arguments.recordings, rng, arguments.jobs, bar.advance)
    stated = ["SIMULATED sound: no published corpus was given", *(one.assumptions() for one in STREETS)]
    return corpora, stated


def _left_out(problems: tuple[str, ...]) -> list[str]:
    if not problems:
        return []
    return ["", f"left out: {len(problems)} clips; the first: {problems[0]}"]
