"""Sections behind the warnings: front-end, junctions, ablations, signatures, the paper's list."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from worldstate_lab.evaluation.evaluation import Evaluation
from worldstate_lab.evaluation.paper_values import COMMANDS, PAPER_VALUES, PaperValue
from worldstate_lab.evaluation.protocols import FIXED, RETRAINED, STATIC
from worldstate_lab.methods.table_rows import GROUNDED
from worldstate_lab.report.document import Section
from worldstate_lab.report.table import Cell, Table, Value
from worldstate_lab.signatures.signature_study import SignatureRow, SignatureStudy

from .measured_values import Place, Values, site_values
from .method_table import method_table, methods_of, stands_on
from .recording_panels import bearing_gating_figure, junction_figure
from .warning_sections import PROPOSED

_NOT_MEASURED = Value(np.nan, note="not measured")
_TRANSFER = (
    ("detected (share)", "detection"),
    ("lead (s)", "lead_s"),
    ("false alarms (1/h)", "false_alarms_per_hour"),
    ("random alarms detect (share)", "random_detection"),
    ("AUROC, all before T0", "auroc_all"),
    ("ECE", "ece"),
    ("right side (share)", "side_correct"),
)
_BY_SITE = {
    "hazard_free_hours": "hazard-free (h)",
    "detection": "detected (share)",
    "random_detection": "random alarms detect (share)",
    "lead_s": "lead (s)",
    "false_alarms_per_hour": "false alarms (1/h)",
    "auroc_all": "AUROC",
}
# Part taken away, and the row that shows it.
_ABLATIONS = (
    ("everything on", "with absence .02", "ece"),
    ("(a) without absence", PROPOSED, "ece"),
    ("(b) raw statistic read as risk", "with absence .02", "ece_raw"),
    ("with looming, weight from the calibration folds", "with absence .02 + looming", "ece"),
)
_ABLATED = ("detection", "random_detection", "lead_s", "false_alarms_per_hour", "auroc_all")

_WORDS = {
    "lead_s": "lead",
    "detection": "detected",
    "false_alarms_per_hour": "false alarms",
    "ece": "ECE",
    "ece_raw": "ECE of the raw statistic",
    "auroc_all": "AUROC, all before T0",
    "auroc_2s": "AUROC, last 2 s",
    "auroc_1s": "AUROC, last 1 s",
    "hazard_free_hours": "hazard-free time",
    "quantum_per_hour": "one alarm onset",
    "bearing_deg": "median error",
    "bearing_best_site_deg": "median error, best junction",
    "bearing_worst_site_deg": "median error, worst junction",
    "bearing_music_deg": "median error of MUSIC",
    "bearing_gated_deg": "median error, gated",
    "gated_coverage": "share kept by the gate",
    "prominence_in_view": "prominence in view",
    "prominence_in_silence": "prominence, hazard-free",
    "detection_least": "detected, least",
    "detection_most": "detected, most",
    "detection_worst": "detected, worst junction",
    "detection_best": "detected, best junction",
    "approaches_with_early_box": "approaches with a box before T0",
    "t0_s": "T0",
    "fewer_false_alarms": "false alarms saved",
    "pass_bys": "approaches",
    "doppler_usable": "with a usable tone",
    "doppler_speed_km_h": "speed read from it",
    "looming_correlation": "correlation with the true time",
    "looming_auroc": "AUROC, last 3 s",
    "beta_boresight_clean": "clean, at boresight",
    "beta_20_30_deg": "clean, 20 to 30 deg",
    "beta_harshest": "harshest noise",
    "beta_clean": "clean, all angles",
    "beta_clean_large": "clean, all angles, other detector",
    "awareness_least": "least hazard awareness",
    "vision_least": "least of vision alone",
}


def group_table(name: str, title: str, values: Values, groups: Sequence[str], caption: str = "") -> Table:
    """Return the paper's values of some groups beside ours, a row each."""
    rows = tuple(
        (_label(one), _ours(one, values), _paper(one), one.unit)
        for one in PAPER_VALUES
        if one.group in groups and one.basis != "stated"
    )
    return Table(name, title, ("figure", "here", "paper", "unit"), rows, caption)


def _label(one: PaperValue) -> str:
    """Condition and figure in words; where the row names the figure already, the row alone."""
    if one.group in ("array bounds", "signature study", "data", "real time"):
        return one.row
    return f"{one.row}: {_WORDS.get(one.figure, one.figure.replace('_', ' '))}"


def _ours(one: PaperValue, values: Values) -> Value:
    # With the digits of what was measured: the paper rounds 0.0883 m to 0.088.
    found = values.get((one.group, one.row, one.figure), _NOT_MEASURED)
    return Value(found.value, found.low, found.high, found.digits, found.note)


def _paper(one: PaperValue) -> Value:
    return Value(one.value, one.low, one.high, one.digits)


def front_end_section(found: Evaluation, values: Values) -> Section:
    """Return bearings against the camera, and the bounds of the array."""
    array = group_table(
        "array",
        "What the 56-microphone array allows",
        values,
        ("array bounds",),
        "Computed from the positions of the microphones; no sound is needed.",
    )
    bounds = Section("Bounds of the array", (), (array,))
    if found.front_end is None:
        return Section("Front-end accuracy", ("No recording has a camera reference.",), (), (bounds,))
    study = found.front_end
    sites = tuple(
        (site, Value(one.median_deg, *one.interval_deg, digits=1), str(one.frames))
        for site, one in study.by_site.items()
    )
    blocks = (
        group_table(
            "front_end",
            "Bearings in view, and prominence",
            values,
            ("front-end",),
            "SRP-PHAT bearing against the nearest moving box of the camera, hops after T0; MUSIC on the "
            "same hops; gated: the 16 % of the bearings whose peak stands out most.",
        ),
        Table(
            "bearing_by_junction",
            "Bearing error by junction",
            ("junction", "median error (deg)", "hops"),
            sites,
            "The paper's medians of junctions lie between 2.5 and 5.8 degrees.",
        ),
        bearing_gating_figure(study.checked),
    )
    return Section("Front-end accuracy", (), blocks, (bounds,))


def approach_rate_section(values: Values) -> Section:
    """Return looming and tonal Doppler."""
    table = group_table(
        "approach_rate",
        "Approach rate in the wild",
        values,
        ("approach rate",),
        "Looming AUROC: energy slope of the last 3 s before the pass against hazard-free sound. "
        "Correlation: time to arrival read from the slope, with the true time until the pass. Doppler: "
        "approaches with a usable tone.",
    )
    return Section("Approach rate", (), (table,))


def transfer_section(found: Evaluation, values: Values) -> Section:
    """Return the protocols beyond the static folds, and every junction of all of them."""
    parts = []
    for name, run in found.runs.items():
        if name != STATIC.name:
            table = method_table(
                found,
                values,
                name,
                methods_of(found, name),
                _TRANSFER,
                name=f"protocol_{name}",
                title=run.protocol.title,
                caption=f"Published classifier trained on: {run.trained_on}. Intervals as in Table I.",
            )
            parts.append(Section(run.protocol.title, (), (table,)))
    return Section("Generalisation", (), (), (*parts, _junctions(found)))


def _junctions(found: Evaluation) -> Section:
    """Show the proposed method at every junction, by protocol."""
    names = [name for name in (STATIC.name, FIXED.name, RETRAINED.name) if name in found.scores]
    sites = {name: site_values(scores[PROPOSED], found, name) for name, scores in found.scores.items()}

    def chosen(figure: str) -> dict[str, dict[str, Value]]:
        return {
            found.runs[name].protocol.title: {
                site: one[figure] for site, one in sites[name].items() if figure in one
            }
            for name in names
        }

    figures = (
        junction_figure(
            "junction_detection", "Detection by junction", "detected (share)", chosen("detection"), "low"
        ),
        junction_figure(
            "junction_false_alarms",
            "False alarms by junction",
            "false alarms per hazard-free hour",
            chosen("false_alarms_per_hour"),
            "high",
        ),
    )
    return Section("By junction", (), (*figures, _junction_table(found, sites)))


def _junction_table(found: Evaluation, sites: Mapping[str, Mapping[str, Mapping[str, Value]]]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for name, by_site in sites.items():
        run = found.runs[name]
        counts = Counter(trial.site for trial in run.trials)
        for site, one in by_site.items():
            figures = (one.get(figure, Value(np.nan)) for figure in _BY_SITE)
            rows.append((run.protocol.title, site, str(counts[site]), *figures))
    return Table(
        "junctions",
        f"Every junction, {PROPOSED}",
        ("protocol", "junction", "recordings", *_BY_SITE.values()),
        tuple(rows),
        "Intervals over the recordings of the junction. A junction has few: one alarm is many an hour.",
    )


def ablation_section(found: Evaluation, values: Values) -> Section:
    """Return ablations (a) and (b), looming, and the approach rate in the grounded likelihood."""

    def cell(row: str, figure: str) -> Value:
        # Beside the paper's value stands the row of Table I, not what is left of it here.
        return replace(values.get((STATIC.name, row, figure), _NOT_MEASURED), paper=None)

    rows: tuple[tuple[Cell, ...], ...] = tuple(
        (part, *(cell(row, figure) for figure in (*_ABLATED, error, "hazard_awareness")))
        for part, row, error in _ABLATIONS
    )
    heads = (
        "detected (share)",
        "random alarms detect (share)",
        "lead (s)",
        "false alarms (1/h)",
        "AUROC",
        "ECE",
        "awareness (share)",
    )
    vision = cell("Vision-only", "hazard_awareness")
    table = Table(
        "ablations",
        "Ablations, standing ego",
        ("part", *heads),
        rows,
        f"{stands_on(found, STATIC.name)}. One part off at a time, same folds; vision alone is aware in "
        f"{vision.text}. Paper: (a) changes no entry of Table I with a clean camera; (b) ECE 0.167 raw, "
        "0.034 calibrated; (c) is the section on degradation.",
    )
    grounded = method_table(
        found,
        values,
        STATIC.name,
        [name for name in methods_of(found, STATIC.name) if name in {one.name for one in GROUNDED}],
        _TRANSFER,
        name="grounded",
        title="Bearing and approach rate in the likelihood, eq. (5)",
        caption="The shipped scores alone, weighed by bearing and approach rate, and without the rate. The "
        "paper calls the last ablation vacuous, as tonal Doppler is rarely usable.",
    )
    return Section("Ablations", (), (table, grounded))


def signature_values(study: SignatureStudy) -> dict[Place, Value]:
    """Return what was measured of the paper's numbers on signatures; of its range the least and the most."""
    values: dict[Place, Value] = {}
    wanted = [one for one in PAPER_VALUES if one.group == "signature study"]
    for row in study.rows:
        for one in wanted:
            place, found = (one.group, one.row, one.figure), _signature(row)
            if row.paper is None or row.value is None or one.value not in row.paper:
                continue
            # The paper's range spans several rows: its lower end is the least of ours, the upper the most.
            least = min(row.paper) < max(row.paper) and one.value == min(row.paper)
            before = values.get(place)
            if before is None or (found.value < before.value) == least:
                values[place] = found
    return values


def signature_section(study: SignatureStudy | None) -> Section:
    """Return the separability of single clips, or what would fill it."""
    if study is None:
        return Section("Signature study", (f"Not part of this run: {COMMANDS['corpora']} fills it.",))
    rows = tuple(
        (row.name, row.corpus, row.figure, _signature(row), str(row.n_clips), row.note) for row in study.rows
    )
    table = Table(
        "signatures",
        "Separability of single clips",
        ("row", "corpus", "figure", "value", "clips", "how"),
        rows,
    )
    text = "SIMULATED clips stand for the corpora." if study.simulated else "Published corpora."
    return Section("Signature study", (text,), (table,))


def _signature(row: SignatureRow) -> Value:
    value, low, high = (np.nan if one is None else one for one in (row.value, row.low, row.high))
    digits = 0 if row.figure == "Hz" else 3
    ends = dict.fromkeys(row.paper or ())
    paper = Value(min(ends), min(ends), max(ends), digits) if len(ends) > 1 else None
    if len(ends) == 1:
        paper = Value(next(iter(ends)), digits=digits)
    return Value(value, low, high, digits, paper=paper)


def paper_section(found: Evaluation, values: Values) -> Section:
    """Return every number of the paper beside ours, and the command that fills it on what it stands on."""
    simulated = found.takes.simulated
    rows = tuple(
        (
            one.section,
            one.group,
            _label(one),
            _paper(one),
            one.unit,
            _ours(one, values),
            _filled(one, simulated),
        )
        for one in PAPER_VALUES
    )
    text = (
        "The recordings here are SIMULATED: where the last column names a command, the paper's number "
        "stands on real sound or video, and what is printed here is its simulated counterpart."
        if simulated
        else "Numbers of real sound stand on the recordings that were given."
    )
    table = Table(
        "paper",
        "Every number of sections IV, VII, VIII and IX",
        ("section", "about", "figure", "paper", "unit", "here", "filled by"),
        rows,
    )
    return Section("The paper's numbers, and what they need", (text,), (table,))


def _filled(one: PaperValue, simulated: bool) -> str:
    if one.basis == "ovad" and not simulated:
        return "this run"
    return {"array": "this run", "stated": "stated of the data"}.get(one.basis, one.command)
