"""The report of an evaluation: its sections in order, the sections after the warnings, and the data used."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from worldstate.ground.version import __version__
from worldstate_lab.evaluation.evaluation import Evaluation
from worldstate_lab.evaluation.figures import COMMANDS, FIGURES, PAPER_VALUES, PaperValue, titles
from worldstate_lab.evaluation.protocols import PROTOCOLS, STANDING, Protocol
from worldstate_lab.report.table import Cell, Document, Section, Table, Value

from .degradation_section import awareness_figures, degradation_section, sweep_values
from .measured_values import PROPOSED, MeasuredValues, printed, site_values
from .warning_sections import cueing_section, table_i, tracking_section

_TRANSFER = (
    *("detection", "lead_s", "false_alarms_per_hour", "random_detection", "auroc_all", "ece"),
    "side_correct",
)
_BY_SITE = (
    *("hazard_free_hours", "detection", "random_detection", "lead_s", "false_alarms_per_hour", "auroc_all"),
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


def front_end_section(measured: MeasuredValues) -> Section:
    """Return the section on bearing errors against the camera by junction."""
    study = measured.found.front_end
    if study is None:
        return Section("Front-end accuracy", ("No recording has a camera reference.",))
    sites = Table(
        "bearing_by_junction",
        "Bearing error by junction",
        ("junction", "median error (deg)", "hops"),
        [
            (site, Value(one.median_deg, *one.interval_deg, digits=1), str(one.frames))
            for site, one in study.by_site.items()
        ],
        "SRP-PHAT bearing against the nearest moving box of the camera, hops after T0. The paper's medians "
        "lie between 2.5 and 5.8 degrees.",
    )
    return Section("Front-end accuracy", (), (sites,))


def transfer_section(measured: MeasuredValues) -> Section:
    """Return the section on protocols other than the static folds, with every junction of all protocols."""
    tables = []
    for name, run in measured.found.runs.items():
        if name != STANDING:
            told = f"Published classifier trained on: {run.trained_on}. Intervals as in Table I."
            of = f"protocol_{name}", run.protocol.title, told
            tables.append(measured.table(name, measured.methods(name), _TRANSFER, *of))
    return Section("Generalisation", (), (*tables, _junction_table(measured.found)))


def _junction_table(found: Evaluation) -> Table:
    """Return the results of the proposed method at every junction, by protocol."""
    rows: list[tuple[Cell, ...]] = []
    for name, run in found.runs.items():
        counts = Counter(trial.site for trial in run.trials)
        for site, one in site_values(found.scores[name][PROPOSED], found, name).items():
            rows.append((run.protocol.title, site, str(counts[site]), *map(one.get, _BY_SITE)))
    return Table(
        "junctions",
        f"Every junction, {PROPOSED}",
        ("protocol", "junction", "recordings", *titles(_BY_SITE)),
        rows,
        "Intervals over the recordings of the junction. A junction has few recordings, so one alarm is a "
        "high rate per hour.",
    )


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
        front_end_section(measured),
        transfer_section(measured),
        degradation_section(found.degradation, found.lacking.get("degradation sweep", "not requested")),
        *((tracking_section(measured),) if static else ()),
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
