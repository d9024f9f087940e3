"""Sections on warnings: Table I, budgets and false alarms, calibrated cueing, one approach, differences."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from worldstate.adapters.camera.video import VIDEO_NAME
from worldstate.ground.errors import WorldstateError
from worldstate.ground.typing import FloatArray
from worldstate.operations.metrics.approach_table import alarm_outcome
from worldstate_lab.evaluation.evaluation import ALPHA, Evaluation
from worldstate_lab.evaluation.paper_values import paper_value
from worldstate_lab.evaluation.protocols import STATIC
from worldstate_lab.evaluation.reduction import HORIZONS_S, scored_windows
from worldstate_lab.evaluation.scores import paired
from worldstate_lab.methods.table_rows import CURVE_ALPHAS
from worldstate_lab.report.document import Section
from worldstate_lab.report.table import Cell, Figure, Table, Value
from worldstate_lab.trials.trial import Decisions, Trial

from .approach_timeline import ApproachImage, ApproachTimeline, approach_figure, approach_images
from .cueing_panels import OperatingPoint, operating_figure, reliability_figure, roc_figure
from .measured_values import Values, figure_digits, score_values
from .method_table import method_table, methods_of, stands_on
from .recording_panels import lead_figure

PROPOSED = "proposed .02"
_BUDGETS = {f"proposed {text}": float(text) for text in (".01", ".02", ".05")}
# What a table shows of a method: title of the column, name of the figure.
_WARNING = (
    ("lead (s)", "lead_s"),
    ("detected (share)", "detection"),
    ("random alarms detect (share)", "random_detection"),
    ("false alarms (1/h)", "false_alarms_per_hour"),
    ("hazard-free time in advisory (share)", "advisory_share"),
    ("right side (share)", "side_correct"),
    ("bearing in view (deg)", "bearing_deg"),
    ("lead, missed = 0 (s)", "lead_missed_zero_s"),
    ("onsets > 5 s early (per approach)", "early_onsets_per_approach"),
)
_CALIBRATION = (
    ("AUROC, all before T0", "auroc_all"),
    ("AUROC, last 2 s", "auroc_2s"),
    ("AUROC, last 1 s", "auroc_1s"),
    ("ECE", "ece"),
    ("its sampling floor", "ece_floor"),
    ("ECE, raw", "ece_raw"),
    ("Brier skill", "brier_skill"),
    ("hazard windows (share)", "hazard_share"),
)
_TRACKING = (
    ("identity switches (per recording)", "id_switches_per_recording"),
    ("fragmentations (per recording)", "fragmentations_per_recording"),
    ("swap rate (1/s)", "swap_rate_hz"),
    ("fragmentation rate (1/s)", "fragmentation_rate_hz"),
    ("track latency (s)", "track_latency_s"),
    ("azimuth error (deg)", "azimuth_error_deg"),
    ("GOSPA, 60 deg (deg)", "gospa_deg"),
    ("time to visible, RMSE (s)", "visible_error_s"),
    ("best constant (s)", "visible_error_constant_s"),
    ("its interval covers (share)", "visible_coverage"),
)
# By condition of the paper's section VIII: clear is after T0 with the vehicle in view, occluded before T0.
_STRATA = (
    ("clear: hazard awareness (share)", "hazard_awareness"),
    ("clear: bearing (deg)", "bearing_deg"),
    ("occluded: detected (share)", "detection"),
    ("occluded: random alarms detect (share)", "random_detection"),
    ("occluded: AUROC, all windows", "auroc_all"),
    ("occluded: AUROC, last 2 s", "auroc_2s"),
    ("occluded: AUROC, last 1 s", "auroc_1s"),
)
_PAIRS = (
    (PROPOSED, "published, sustained"),
    (PROPOSED, "published"),
    ("proposed .02 + looming", PROPOSED),
    ("with absence .02", PROPOSED),
    ("ensemble .02", "with absence .02"),
    ("shipped model", PROPOSED),
    ("+ site adaptation", "shipped model"),
    ("world-state advisory", "+ site adaptation"),
    ("+ ego-noise cancellation", "world-state advisory"),
)
_COMPARED = ("detection", "lead_s", "false_alarms_per_hour", "auroc_all", "ece", "gospa_deg")


def table_i(found: Evaluation, values: Values) -> Section:
    """Return the section of Table I."""
    early = values["static", "Vision-only", "approaches_with_early_box"]
    hours, quantum = (values["static", PROPOSED, name] for name in ("hazard_free_hours", "quantum_per_hour"))
    table = method_table(
        found,
        values,
        STATIC.name,
        methods_of(found, STATIC.name),
        _WARNING,
        name="table_i",
        title="Table I: warning performance, standing ego",
        caption="Each cell: value, 95 % interval over recordings (of false alarms the exact Poisson "
        "interval), the worst junction and its value, the paper's value. Lead: mean of line-of-sight entry "
        "T0 minus the first alarm in the 5 s before it, detected approaches only. Random alarms: what as "
        "many alarms at random moments would detect. The folds are those of the protocol; thresholds are "
        "set on the other folds.",
    )
    leads = {
        method: lead
        for method, passes in found.runs[STATIC.name].decisions.items()
        if method in _LEADS and np.isfinite(lead := _leads_s(found.runs[STATIC.name].trials, passes)).any()
    }
    stated = {method: paper_value(STATIC.name, method, "lead_s") for method in leads}
    return Section(
        "Table I",
        (
            f"False alarms are counted on {hours.number} h of hazard-free time, so one alarm onset is "
            f"{quantum.number} an hour (paper: 0.103 h, 9.7 an hour).",
            f"Vision only: a moving box precedes T0 in {early.number} {early.note} approaches (paper: 3 of "
            "42, put down to the tolerance of the T0 annotation and printed as 0).",
        ),
        (table, lead_figure(leads, {method: one.value for method, one in stated.items() if one})),
    )


_LEADS = (
    "published",
    "published, sustained",
    *_BUDGETS,
    "proposed .02 + looming",
    "with absence .02",
    "shipped model",
    "+ site adaptation",
    "world-state advisory",
)


def _leads_s(trials: Sequence[Trial], passes: Sequence[Sequence[Decisions]]) -> FloatArray:
    """Lead of every approach and seed, NaN where it was not detected."""
    leads = [
        alarm_outcome(said.time_s, said.alarm, trial.t0_s).lead_s
        for answers in passes
        for trial, said in zip(trials, answers, strict=True)
        if not trial.hazard_free
    ]
    return np.array([lead or np.nan for lead in leads])


def budget_section(found: Evaluation, values: Values) -> Section:
    """Return the map from alpha to false alarms an hour, of section VII."""
    rows: list[tuple[Cell, ...]] = []
    for alpha in CURVE_ALPHAS:
        score = found.scores[STATIC.name].get(f"curve {alpha:g}")
        if score is None:
            continue
        method = next((name for name, budget in _BUDGETS.items() if budget == alpha), None)
        curve = score_values(score, found, STATIC.name)
        names = ("false_alarms_per_hour", "detection", "random_detection", "lead_s")
        cells = [values[STATIC.name, method, name] if method else curve[name] for name in names]
        rows.append((f"{alpha:g}", *cells))
    table = Table(
        "alpha",
        "Budget and achieved false alarms, proposed method",
        (
            "alpha (share of windows)",
            "false alarms (1/h)",
            "detected (share)",
            "random alarms detect (share)",
            "lead (s)",
        ),
        tuple(rows),
        f"{stands_on(found, STATIC.name)}. alpha bounds the share of hazard-free windows in alarm on the "
        "calibration folds; the alarms an hour are counted on the folds that were not used. Intervals as in "
        "Table I.",
    )
    return Section("Budget and false alarms", (), (table, _equal_table(found)))


def _equal_table(found: Evaluation) -> Table:
    """Return what the world-state and the sustained baseline cost where both detect as much."""
    rows = tuple(
        (
            Value(one.detected),
            Value(one.ours, digits=0),
            Value(one.baseline, digits=0),
            Value(one.ratio, one.low, one.high),
        )
        for one in found.equal.get(STATIC.name, ())
    )
    return Table(
        "equal_detection",
        "False alarms at equal detection",
        ("detected (share)", "world-state (1/h)", "published, sustained (1/h)", "ratio"),
        rows,
        f"{stands_on(found, STATIC.name)}. The least false alarms at which each detects so much, over all "
        "thresholds, which are read from these recordings, and for the baseline over its sustained hops.",
    )


def cueing_section(found: Evaluation, values: Values, awareness: Sequence[Figure]) -> Section:
    """Return the four panels of calibrated cueing; the last one comes with the degradation study."""
    run = found.runs[STATIC.name]
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
    areas = {title: values[STATIC.name, PROPOSED, f"auroc_{name}"] for name, title in titles.items()}
    quantum = values[STATIC.name, PROPOSED, "quantum_per_hour"].value
    return Section(
        "Calibrated cueing",
        ("The panels are those of the paper's figure on calibrated cueing; proposed method, standing ego.",),
        (
            roc_figure(hazards, free, areas),
            _reliability(pairs, values),
            operating_figure(_points(found, values), quantum),
            *awareness,
            method_table(
                found,
                values,
                STATIC.name,
                [name for name in methods_of(found, STATIC.name) if _known(values, name, "auroc_all")],
                _CALIBRATION,
                name="calibration",
                title="Discrimination and calibration of windows",
                caption="ECE over ten equal bins at the recordings' own share of hazard windows, beside what "
                "perfectly calibrated labels would score with as many windows; it has no interval, as "
                "drawing recordings again only raises it. Raw: the statistic read as a probability, where "
                "it is between 0 and 1.",
            ),
        ),
    )


def _known(values: Values, method: str, figure: str) -> bool:
    value = values.get((STATIC.name, method, figure))
    return value is not None and math.isfinite(value.value)


def _reliability(pairs: Sequence[tuple[Trial, Decisions]], values: Values) -> Figure:
    labels = np.concatenate([np.full(scored_windows(t, s.risk).size, not t.hazard_free) for t, s in pairs])
    risks = {
        "raw statistic": np.concatenate([scored_windows(t, s.score) for t, s in pairs]),
        "calibrated risk": np.concatenate([scored_windows(t, s.risk) for t, s in pairs]),
    }
    errors = {name: values["ablations", name, "ece"] for name in risks}
    return reliability_figure(risks, labels, errors)


def _points(found: Evaluation, values: Values) -> list[OperatingPoint]:
    shown = [*_BUDGETS, "Vision-only", "Radar field-of-view model", "OC-SORT recovery (coasting)"]
    shown += ["published", "published, sustained", "shipped model", "world-state advisory"]
    return [
        OperatingPoint(
            method,
            values[STATIC.name, method, "false_alarms_per_hour"],
            values[STATIC.name, method, "detection"],
            _BUDGETS.get(method),
        )
        for method in shown
        if method in found.scores[STATIC.name]
    ]


def approach_section(found: Evaluation) -> Section:
    """Return the timeline of the detected approach whose lead is the median one, filmed ones preferred."""
    run = found.runs[STATIC.name]
    answers = run.decisions[PROPOSED][0]
    leads = _leads_s(run.trials, [answers])
    pairs = [(t, s) for t, s in zip(run.trials, answers, strict=True) if not t.hazard_free]
    detected = np.flatnonzero(np.isfinite(leads))
    filmed = np.array([i for i in detected if _video(found, pairs[i][0]).is_file()], np.intp)
    chosen = filmed if filmed.size else detected
    if not chosen.size:
        return Section("One approach end to end", ("No approach was detected by the proposed method.",))
    middle = chosen[np.argsort(leads[chosen], kind="stable")[(chosen.size - 1) // 2]]
    trial, said = pairs[middle]
    # Before the first hop a parked car cannot be told from a moving one.
    moving = trial.boxes.moving.astype(bool) & (trial.boxes.time_s >= said.time_s[0])
    timeline = ApproachTimeline(
        f"Approach {trial.name} at {trial.site}, from the {trial.label}: lead {leads[middle]:.1f} s "
        "(paper's: 2.3 s)",
        said.time_s,
        said.score,
        float(said.threshold[0]),
        ALPHA,
        said.alarm,
        trial.boxes.time_s[moving],
        trial.t0_s,
        _images(found, trial),
    )
    text = f"The approach with the median lead of the {detected.size} that {PROPOSED} detects."
    return Section("One approach end to end", (text,), (approach_figure(timeline),))


def _video(found: Evaluation, trial: Trial) -> Path:
    return next(take.path for take in found.takes.static if take.name == trial.name) / VIDEO_NAME


def _images(found: Evaluation, trial: Trial) -> tuple[ApproachImage, ...]:
    # Without OpenCV, or with a video that cannot be read, the rest of the figure still says what it says.
    try:
        return approach_images(_video(found, trial), trial.boxes, trial.truth, trial.t0_s)
    except WorldstateError:
        return ()


def tracking_section(found: Evaluation, values: Values) -> Section:
    """Return identities, LOCATA's measures, GOSPA and time to visible of the methods that state any."""
    methods = [
        name
        for name in methods_of(found, STATIC.name)
        if any(_known(values, name, figure) for _, figure in _TRACKING)
    ]
    table = method_table(
        found,
        values,
        STATIC.name,
        methods,
        _TRACKING,
        name="tracking",
        title="Tracks and time to visible, standing ego",
        caption="GOSPA on bearing with a cut-off of 60 degrees, mean over hops with a vehicle. Time to "
        "visible beside the constant that fits these approaches best, which knows the answer.",
    )
    return Section("Tracking measures", (), (table,))


def strata_section(found: Evaluation, values: Values) -> Section:
    """Return the figures by condition: clear, occluded, and where the degraded camera is told of."""
    table = method_table(
        found,
        values,
        STATIC.name,
        methods_of(found, STATIC.name),
        _STRATA,
        name="strata",
        title="Clear and occluded, standing ego",
        caption="Clear: after T0 with the vehicle in view; awareness is an alarm or a moving box. Occluded: "
        "before T0. The third condition, a degraded camera, is the section on vision degradation.",
    )
    return Section("Conditions", (), (table,))


def difference_section(found: Evaluation) -> Section:
    """Return paired differences between methods, on the same draws of recordings."""
    rows: list[tuple[Cell, ...]] = []
    for protocol, scores in found.scores.items():
        for ours, other in _PAIRS:
            if ours in scores and other in scores:
                gains = paired(scores[ours], scores[other], found.draws[protocol])
                cells = [Value(*gains[figure], figure_digits(figure)) for figure in _COMPARED]
                run = found.runs[protocol]
                rows.append((run.protocol.title, str(len(run.trials)), f"{ours} less {other}", *cells))
    heads = ("detected (share)", "lead (s)", "false alarms (1/h)", "AUROC", "ECE", "GOSPA (deg)")
    table = Table(
        "differences",
        "Differences between methods",
        ("protocol", "recordings", "difference", *heads),
        tuple(rows),
        "First method less the second on the same recordings, with the middle 95 % over the same draws of "
        "them: an interval that leaves out 0 is a difference that these recordings show.",
    )
    return Section("Paired differences", (), (table,))
