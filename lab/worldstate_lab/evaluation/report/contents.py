"""The report of an evaluation: its sections in order, the sections after the warnings, and the data used."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from worldstate.ground.version import __version__
from worldstate_lab.evaluation.evaluation import Evaluation
from worldstate_lab.evaluation.figures import COMMANDS, FIGURES, PAPER_VALUES, PaperValue
from worldstate_lab.evaluation.protocols import PROTOCOLS, STANDING, Protocol
from worldstate_lab.report.table import Cell, Document, Section, Table

from .degradation_section import awareness_figures, degradation_section, sweep_values
from .measured_values import MeasuredValues, printed
from .warning_sections import cueing_section, table_i

_TRANSFER = (
    *("detection", "lead_s", "false_alarms_per_hour", "random_detection", "auroc_all", "ece"),
    "side_correct",
)
# Groups of the paper's values whose row names are complete labels.
_NAMED_BY_ROW = ("array bounds", "signature study", "data", "real time")


def _label(one: PaperValue) -> str:
    """Return condition and figure as a label."""
    if one.group in _NAMED_BY_ROW:
        return one.row
    # Without the unit.
    title = FIGURES[one.figure].title if one.figure in FIGURES else one.figure.replace("_", " ")
    return f"{one.row}: {title.partition(' (')[0]}"


def transfer_section(measured: MeasuredValues) -> Section:
    """Return the section on protocols other than the static folds."""
    tables = []
    for name, run in measured.found.runs.items():
        if name != STANDING:
            told = f"Published classifier trained on: {run.trained_on}. Intervals as in Table I."
            of = f"protocol_{name}", run.protocol.title, told
            tables.append(measured.table(name, measured.methods(name), _TRANSFER, *of))
    return Section("Generalisation", (), tuple(tables))


def paper_section(measured: MeasuredValues) -> Section:
    """Return every number of the paper beside ours, with the command and the data that compute it."""
    simulated = measured.found.takes.simulated
    rows: list[tuple[Cell, ...]] = []
    for one in PAPER_VALUES:
        # With the decimals of the measured value: the paper rounds 0.0883 m to 0.088.
        ours = replace(measured.at(one.group, one.row, one.figure, note="not measured"), paper=None)
        of = one.section, one.group, _label(one), printed(one), one.unit
        rows.append((*of, ours, _filled(one, simulated)))
    text = (
        "The recordings here are SIMULATED: if the last column contains a command, the paper's number comes "
        "from real sound or video, and the number printed here is its simulated counterpart."
        if simulated
        else "Numbers on real sound come from the given recordings."
    )
    table = Table(
        "paper",
        "Every number of sections IV, VII, VIII and IX",
        ("section", "about", "figure", "paper", "unit", "here", "filled by"),
        rows,
    )
    return Section("The paper's numbers, and the data that they require", (text,), (table,))


def _filled(one: PaperValue, simulated: bool) -> str:
    if one.basis == "ovad" and not simulated:
        return "this run"
    return {"array": "this run", "stated": "stated of the data"}.get(one.basis, COMMANDS[one.basis])


def evaluation_document(found: Evaluation, configuration: Sequence[tuple[str, str]] = ()) -> Document:
    """Return the whole report; sections without measured values state this, and the options come last."""
    others = {} if found.degradation is None else sweep_values(found.degradation)
    measured = MeasuredValues.of(found, others)
    panels = () if found.degradation is None else awareness_figures(found.degradation)
    static = STANDING in found.runs
    sections = [
        _data_section(found),
        *((table_i(measured), cueing_section(measured, panels)) if static else ()),
        transfer_section(measured),
        degradation_section(found.degradation, found.lacking.get("degradation sweep", "not requested")),
        paper_section(measured),
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
            Table("skipped", "Recordings that could not be processed", ("recording", "problem"), failed)
        )
    sound = (
        "Every recording is simulated: no figure of this report is a measurement on real sound, and "
        "agreement with the paper is agreement of the simulator with the paper's recordings."
        if found.takes.simulated
        else "The figures are measured on the given recordings."
    )
    # A stratum of one recording is the same in every draw, so the interval does not contain its variation.
    strata = Counter((trial.label, trial.site) for trial in found.trials)
    single = sum(count == 1 for count in strata.values())
    intervals = (
        f"{single} of {len(strata)} such strata contain a single recording, which is the same in every draw, "
        "so the intervals are too narrow."
        if single
        else "Every such stratum contains several."
    )
    intervals = f"For the intervals, recordings are resampled within side and junction. {intervals}"
    skipped = f"{len(found.failed)} recordings could not be processed and are left out of every figure."
    return Section("What was evaluated", (sound, intervals, skipped), tuple(blocks))


def _protocol_row(found: Evaluation, protocol: Protocol) -> tuple[Cell, ...]:
    run = found.runs.get(protocol.name)
    if run is None:
        return protocol.title, "0", "0", None, "", f"not run: {found.lacking[protocol.name]}"
    of = run.stands_on
    counts = str(of["recordings"]), str(of["approaches"]), of["hazard_free_hours"]
    return protocol.title, *counts, run.trained_on, "; ".join(run.cautions) or "run"


def _facts(found: Evaluation) -> tuple[tuple[str, str], ...]:
    return (
        ("worldstate", __version__),
        ("data", found.takes.origin),
        ("seeds of the folds", ", ".join(map(str, found.settings.seeds))),
        ("draws of recordings for intervals", str(found.settings.draws)),
    )
