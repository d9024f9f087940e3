"""`worldstate-lab corpora`: separation of vehicles from background in single clips, and its limits.

Reproduce the signature study of "Evidence of Absence", section IX: 16 log-energies per clip, a logistic
regression, and the area under the ROC curve of vehicle against background with an interval over recordings.

  by level   the energies themselves, which change with gain and distance
  by shape   the energies without their mean, which do not

Every row is measured on recordings outside the training: the official split if the corpus has one, else folds
by recording; or training on one corpus and scoring on the other. Electric cars, bicycles and trams are
separate rows, with models that were trained without them.

  --idmt      the folder of IDMT-Traffic, with audio/ and annotation/ (doi:10.5281/zenodo.7551553)
  --melaudis  a folder with MELAUDIS_Vehicles/ and MELAUDIS_BG/ (doi:10.6084/m9.figshare.27115870)

Examples
--------
  worldstate-lab corpora --idmt IDMT_Traffic --json
  worldstate-lab corpora --idmt IDMT_Traffic --melaudis MELAUDIS --jobs 4 --out signatures
"""

import argparse
from pathlib import Path

import numpy as np

from worldstate.adapters.files.file_io import write_text
from worldstate.cli.common.output import CommandResult, output_folder, write_report
from worldstate.cli.common.progress import progress_bar
from worldstate.ground.errors import InvalidArgumentError
from worldstate_lab.report.table import Cell, Table, Value, json_values
from worldstate_lab.signatures.clip_signatures import ClipSignatures, hear_clips
from worldstate_lab.signatures.signature_study import (
    IDMT,
    MELAUDIS,
    QUESTIONS,
    SignatureStudy,
    signature_study,
)
from worldstate_lab.signatures.traffic_clips import TrafficClip, idmt_traffic, melaudis


def study_lines(study: SignatureStudy) -> list[str]:
    """Return a table of the measured rows, the worst first, and of the requirements of the others."""
    rows: list[tuple[Cell, ...]] = []
    for row in study.rows:
        if row.value is not None:
            value, low, high = np.array([row.value, row.low, row.high], float).tolist()
            cell = Value(value, low, high, 0 if row.figure == "Hz" else 3)
            paper = " - ".join(f"{one:g}" for one in dict.fromkeys(row.paper or ()))
            rows.append((f"{row.name} ({row.figure})", cell, paper, row.n_clips, f"{row.corpus}; {row.note}"))
    heads = ("row", "value", "paper", "clips", "corpus; how")
    lines = Table("signatures", "Vehicles against background", heads, rows).lines()
    for note in dict.fromkeys(row.note for row in study.rows if row.value is None):
        needed = [row for row in study.rows if row.value is None and row.note == note]
        lines += ["", f"open: {note}", *(f"  {row.name} ({row.figure}, {row.corpus})" for row in needed)]
    return lines


NAMES = ("signatures.json", "signatures.txt")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("--idmt", type=Path, metavar="DIR", help="IDMT-Traffic")
    add("--melaudis", type=Path, metavar="DIR", help="MELAUDIS, both archives unpacked")
    add("--out", type=Path, metavar="DIR", help=f"write {', '.join(NAMES)}")
    add("--jobs", type=int, default=1, help="processes (default: 1)")
    add("--seed", type=int, default=0, help="seed of folds and bootstrap (default: %(default)s)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return its result."""
    if arguments.idmt is None and arguments.melaudis is None:
        raise InvalidArgumentError("expected --idmt, --melaudis or both: folders of the published corpora")
    if arguments.out is not None:
        output_folder(arguments.out, *NAMES)
    # The second generator of two, as when the first simulated clips: folds and draws stay the same.
    _, draws = np.random.default_rng(arguments.seed).spawn(2)
    # Both folders are checked before the first clip is processed.
    roadside = None if arguments.idmt is None else idmt_traffic(arguments.idmt)
    city = None if arguments.melaudis is None else melaudis(arguments.melaudis)
    corpora = _heard(IDMT, roadside, arguments.jobs), _heard(MELAUDIS, city, arguments.jobs)
    with progress_bar("measuring", len(QUESTIONS)) as bar:
        study = signature_study(*corpora, draws, bar.advance)
    report, lines = json_values(study), study_lines(study)
    if study.left_out:
        lines += ["", f"left out: {len(study.left_out)} clips; the first: {study.left_out[0]}"]
    if arguments.out is not None:
        write_report(arguments.out / NAMES[0], report)
        write_text(arguments.out / NAMES[1], "\n".join(lines) + "\n")
    return CommandResult(report, table={}, lines=lines)


def _heard(name: str, clips: list[TrafficClip] | None, jobs: int) -> ClipSignatures | None:
    if clips is None:
        return None
    with progress_bar(f"processing {name}", len(clips)) as bar:
        return hear_clips(name, clips, jobs, bar.advance)
