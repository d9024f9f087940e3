"""Sections on warnings: Table I, calibrated cueing, tracks."""

from collections.abc import Sequence

import numpy as np

from worldstate_lab.evaluation.evaluation import Evaluation
from worldstate_lab.evaluation.protocols import STANDING
from worldstate_lab.evaluation.reduction import HORIZONS_S, scored_windows
from worldstate_lab.report.table import Cell, Figure, Section, Table, Value
from worldstate_lab.trials.trial import Decisions, Trial

from .measured_values import PROPOSED, MeasuredValues
from .panels import OperatingPoint, operating_figure, reliability_figure, roc_figure

_BUDGETS = {f"proposed {text}": float(text) for text in (".01", ".02", ".05")}
# Columns of the tables of methods.
_WARNING = (
    *("lead_s", "detection", "random_detection", "false_alarms_per_hour", "advisory_share", "side_correct"),
    *("bearing_deg", "hazard_awareness", "lead_missed_zero_s", "early_onsets_per_approach"),
)
_AREAS = ("auroc_all", "auroc_2s", "auroc_1s")
_CALIBRATION = (*_AREAS, "ece", "ece_floor", "ece_raw", "brier_skill", "hazard_share")
_TRACKING = ("gospa_deg", "visible_error_s", "visible_error_constant_s", "visible_coverage")


def table_i(measured: MeasuredValues) -> Section:
    """Return the section of Table I."""
    early = measured.at(STANDING, "Vision-only", "approaches_with_early_box")
    hours = measured.at(STANDING, PROPOSED, "hazard_free_hours")
    quantum = measured.at(STANDING, PROPOSED, "quantum_per_hour")
    table = measured.table(
        STANDING,
        measured.methods(STANDING),
        _WARNING,
        "table_i",
        "Table I: warning performance, standing ego",
        "Each cell: value, 95 % interval over recordings (for false alarms the exact Poisson interval), the "
        "worst junction and its value, the paper's value. Lead: mean of line-of-sight entry T0 minus the "
        "first alarm in the 5 s before it, detected approaches only. Random alarms: the share that as many "
        "alarms at random moments would detect. The folds are those of the protocol; thresholds are set on "
        "the other folds.",
    )
    text = (
        f"False alarms are counted on {hours.number} h of hazard-free time, so one alarm onset is "
        f"{quantum.number} per hour (paper: 0.103 h, 9.7 per hour).",
        f"Vision only: a moving box precedes T0 in {early.number} {early.note} approaches (paper: 3 of 42, "
        "attributed to the tolerance of the T0 annotation and printed as 0).",
    )
    return Section("Table I", text, (table, equal_table(measured.found, STANDING)))


def equal_table(found: Evaluation, protocol: str) -> Table:
    """Return the false alarms of the world-state and the sustained baseline at equal detection."""
    rows: list[tuple[Cell, ...]] = []
    for one in found.equal.get(protocol, ()):
        rates = (Value(rate, digits=0) for rate in (one.ours, one.baseline))
        rows.append((Value(one.detected), *rates, Value(one.ratio, one.low, one.high)))
    return Table(
        "equal_detection",
        "False alarms at equal detection",
        ("detected (share)", "world-state (1/h)", "published, sustained (1/h)", "ratio"),
        rows,
        f"{found.runs[protocol].basis} The lowest false-alarm rate at which each method detects this share, "
        "over all thresholds, which are chosen on these recordings; for the baseline also over its "
        "sustained hops.",
    )


def cueing_section(measured: MeasuredValues, awareness: Sequence[Figure]) -> Section:
    """Return the four panels on calibrated cueing; the last one needs the degradation study."""
    run = measured.found.runs[STANDING]
    pairs = [
        (trial, said)
        for answers in run.decisions[PROPOSED]
        for trial, said in zip(run.trials, answers, strict=True)
    ]
    free = np.concatenate([scored_windows(t, s.score) for t, s in pairs if t.hazard_free])
    titles = {"all": "all before $T_0$", "2s": "last 2 s", "1s": "last 1 s"}
    hazards = {
        titles[name]: np.concatenate(
            [scored_windows(t, s.score, horizon) for t, s in pairs if not t.hazard_free]
        )
        for name, horizon in HORIZONS_S.items()
    }
    areas = {title: measured.at(STANDING, PROPOSED, f"auroc_{name}") for name, title in titles.items()}
    table = measured.table(
        STANDING,
        measured.methods(STANDING, _AREAS[:1]),
        _CALIBRATION,
        "calibration",
        "Discrimination and calibration of windows",
        "ECE over ten equal bins at the recordings' own share of hazard windows, with the value that "
        "perfectly calibrated labels would have with as many windows; it has no interval, because "
        "resampling recordings only raises it. Raw: the statistic taken as a probability, if it is between "
        "0 and 1.",
    )
    operating = operating_figure(_points(measured), measured.at(STANDING, PROPOSED, "quantum_per_hour").value)
    return Section(
        "Calibrated cueing",
        ("The panels are those of the paper's figure on calibrated cueing; proposed method, standing ego.",),
        (roc_figure(hazards, free, areas), _reliability(pairs, measured), operating, *awareness, table),
    )


def _reliability(pairs: Sequence[tuple[Trial, Decisions]], measured: MeasuredValues) -> Figure:
    labels = np.concatenate([np.full(scored_windows(t, s.risk).size, not t.hazard_free) for t, s in pairs])
    risks = {
        "raw statistic": np.concatenate([scored_windows(t, s.score) for t, s in pairs]),
        "calibrated risk": np.concatenate([scored_windows(t, s.risk) for t, s in pairs]),
    }
    errors = {name: measured.at("ablations", name, "ece") for name in risks}
    return reliability_figure(risks, labels, errors)


def _points(measured: MeasuredValues) -> list[OperatingPoint]:
    shown = [*_BUDGETS, "Vision-only", "Radar field-of-view model", "OC-SORT recovery (coasting)"]
    shown += ["published", "published, sustained", "shipped model", "world-state advisory"]
    return [
        OperatingPoint(
            method,
            measured.at(STANDING, method, "false_alarms_per_hour"),
            measured.at(STANDING, method, "detection"),
            _BUDGETS.get(method),
        )
        for method in shown
        if method in measured.found.scores[STANDING]
    ]


def tracking_section(measured: MeasuredValues) -> Section:
    """Return GOSPA and time to visible of the methods that have any."""
    table = measured.table(
        STANDING,
        measured.methods(STANDING, _TRACKING),
        _TRACKING,
        "tracking",
        "Tracks and time to visible, standing ego",
        "GOSPA on bearing with a cut-off of 60 degrees, mean over hops with a vehicle. Time to visible: "
        "compared with the constant that fits best, which is computed from these approaches.",
    )
    return Section("Tracking measures", (), (table,))
