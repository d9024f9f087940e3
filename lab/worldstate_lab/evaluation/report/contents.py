"""The report of an evaluation: its sections in order, what was evaluated, and on which versions."""

import platform
from collections import Counter
from collections.abc import Sequence

import numpy as np
import scipy
import sklearn

from worldstate.ground.version import __version__
from worldstate_lab.evaluation.evaluation import Evaluation
from worldstate_lab.evaluation.protocols import PROTOCOLS, STATIC, Protocol
from worldstate_lab.evaluation.report import study_sections as study
from worldstate_lab.evaluation.report import warning_sections as warning
from worldstate_lab.report.pages import Document, Section
from worldstate_lab.report.table import Cell, Table
from worldstate_lab.signatures.signature_study import SignatureStudy
from worldstate_lab.trials.hearing import data_fingerprint

from .approach_timeline import approach_section
from .degradation_section import awareness_figures, degradation_section, sweep_values
from .measured_values import MeasuredValues


def evaluation_document(
    found: Evaluation,
    signatures: SignatureStudy | None = None,
    configuration: Sequence[tuple[str, str]] = (),
) -> Document:
    """Return the whole report; sections that nothing was measured for say so, and the options end it."""
    others = {} if found.degradation is None else sweep_values(found.degradation)
    others |= {} if signatures is None else study.signature_values(signatures)
    measured = MeasuredValues.of(found, others)
    panels = () if found.degradation is None else awareness_figures(found.degradation)
    static = STATIC.name in found.runs
    sections = [
        _data_section(found),
        *((warning.table_i(measured), warning.budget_section(measured)) if static else ()),
        *((warning.cueing_section(measured, panels), approach_section(found)) if static else ()),
        study.front_end_section(measured),
        study.approach_rate_section(measured),
        study.transfer_section(measured),
        degradation_section(
            found.degradation, found.lacking.get("degradation sweep", "not asked for"), found.staged
        ),
        *((study.ablation_section(measured),) if static else ()),
        study.signature_section(signatures),
        *((warning.tracking_section(measured), warning.strata_section(measured)) if static else ()),
        warning.difference_section(found),
        study.paper_section(measured),
    ]
    return Document(
        "Evaluation of hidden-hazard warnings from sound",
        f"{found.takes.origin}: {len(found.trials)} recordings, {_hours(found):.3f} h of them hazard-free.",
        tuple(sections),
        (*_facts(found), *configuration),
    )


def _hours(found: Evaluation) -> float:
    return sum(len(trial.hops) for trial in found.trials if trial.hazard_free) * 0.1 / 3600.0


def _data_section(found: Evaluation) -> Section:
    heads = ("protocol", "recordings", "approaches", "hazard-free (h)", "published classifier trained on")
    blocks = [
        Table("protocols", "Protocols", (*heads, "state"), [_protocol_row(found, p) for p in PROTOCOLS])
    ]
    if found.failed:
        failed = [(one.name, one.problem) for one in found.failed]
        blocks.append(
            Table("skipped", "Recordings that could not be heard", ("recording", "problem"), failed)
        )
    sound = (
        "Every recording is simulated: no figure of this report is a measurement on real sound, and "
        "agreement with the paper is agreement of the simulator with the paper's recordings."
        if found.takes.simulated
        else "The figures are measured on the sound that was given."
    )
    # A stratum of one is the same in every draw; nothing in the interval itself shows that.
    strata = Counter((trial.label, trial.site) for trial in found.trials)
    single = sum(count == 1 for count in strata.values())
    intervals = (
        f"{single} of {len(strata)} such strata hold a single recording, which every draw repeats, so "
        "intervals are too narrow by what it would add."
        if single
        else "Every such stratum holds several."
    )
    intervals = f"Intervals draw recordings again within side and junction. {intervals}"
    skipped = f"{len(found.failed)} recordings could not be heard and are left out of every figure."
    return Section("What was evaluated", (sound, intervals, skipped), tuple(blocks))


def _protocol_row(found: Evaluation, protocol: Protocol) -> tuple[Cell, ...]:
    run = found.runs.get(protocol.name)
    if run is None:
        return protocol.title, "0", "0", None, "", f"not run: {found.lacking[protocol.name]}"
    of = run.stands_on
    counts = str(of["recordings"]), str(of["approaches"]), of["hazard_free_hours"]
    return protocol.title, *counts, run.trained_on, "; ".join(run.cautions) or "run"


def _facts(found: Evaluation) -> tuple[tuple[str, str], ...]:
    settings = found.settings
    versions: Sequence[tuple[str, str]] = (
        ("worldstate", __version__),
        ("Python", platform.python_version()),
        ("numpy", np.__version__),
        ("scipy", scipy.__version__),
        ("scikit-learn", sklearn.__version__),
    )
    return (
        *versions,
        ("data", found.takes.origin),
        ("fingerprint of the data", data_fingerprint(found.trials) if found.trials else "none"),
        ("seeds of the folds", ", ".join(map(str, settings.seeds))),
        ("hazard-free hours asked for", str(settings.hazard_free_hours or "all")),
        ("draws of recordings for intervals", str(settings.draws)),
    )
