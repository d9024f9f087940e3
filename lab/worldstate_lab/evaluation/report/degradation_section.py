"""The section on degraded cameras: miss rates, awareness by family and level, and rain as a common cause."""

import math
from dataclasses import asdict, replace
from typing import Any

from worldstate.adapters.camera.camera_health import LEVELS
from worldstate_lab.degradation.awareness import AwarenessRow
from worldstate_lab.degradation.beta_curves import Band
from worldstate_lab.degradation.conditions import FAMILIES, OFF
from worldstate_lab.degradation.degradation_study import DegradationStudy, DetectorSweep
from worldstate_lab.evaluation.figures import COMMANDS, paper_value
from worldstate_lab.report.table import Cell, Figure, Section, Table, Value, json_values

from .measured_values import Place
from .panels import awareness_figure

_RATES, _AWARE = "miss rate of the camera", "after line-of-sight entry"
_CONDITION = (
    *("condition", "estimated d", "beta", "vision alone (share)", "awareness (share)"),
    *("awareness where unseen (share)", "detected before T0 (share)", "lead (s)", "false alarms (1/h)"),
    *("false awareness (1/h)", "false awareness (share)"),
)
_RAIN = ("level", "noise (dB)", "lens alone", "roof alone", "rain", "if effects added up", "optimism of (A1)")


def sweep_values(study: DegradationStudy) -> dict[Place, Value]:
    """Return measured values for the paper's sweep: of the first detector, and one of the last."""
    first, last = study.sweeps[0], study.sweeps[-1]
    beta, clean = first.beta, (0, 0)
    values = {
        "beta_boresight_clean": _at(beta.by_azimuth, (0, 0, 0)),
        "beta_harshest": _at(beta.overall, (FAMILIES.index("noise"), -1)),
        "beta_clean": _at(beta.overall, clean),
        "beta_clean_large": replace(_at(last.beta.overall, clean), note=last.detector),
    }
    if 20.0 in beta.azimuth_deg[:-1]:
        values["beta_20_30_deg"] = _at(beta.by_azimuth, (0, beta.azimuth_deg.index(20.0), 0))
    least = {"awareness_least": first.least_awareness.awareness, "vision_least": first.least_vision.vision}
    rates = {("degradation", _RATES, name): value for name, value in values.items()}
    return rates | {("degradation", _AWARE, name): Value(*one) for name, one in least.items()}


def awareness_figures(study: DegradationStudy) -> tuple[Figure, ...]:
    """Return panel (d) for every detector, with the paper's lowest awareness."""
    paper = paper_value("degradation", _AWARE, "awareness_least")
    figures = []
    for number, sweep in enumerate(study.sweeps, start=1):
        # A condition without a camera belongs to no family: its line would have one point.
        names = dict.fromkeys(row.condition.family for row in sweep.awareness.rows[1:])
        families = {
            name: [(Value(1.0 - row.vision.value), Value(*row.awareness)) for row in sweep.family(name)]
            for name in names
            if name != OFF
        }
        figure = awareness_figure(families, paper.value if paper else math.nan)
        title = f"{figure.title}, {sweep.detector}"
        figures.append(replace(figure, name=f"{figure.name}_{number}", title=title))
    return tuple(figures)


def degradation_section(study: DegradationStudy | None, lacking: str) -> Section:
    """Return miss rates and awareness of every detector, or what is missing and how to obtain it."""
    title = "Vision degradation"
    if study is None:
        told = f"Not run: {lacking}. On recordings with video, {COMMANDS['ovad']} computes it."
        return Section(title, (told,))
    names = " and ".join(sweep.detector for sweep in study.sweeps)
    model = study.settings.model
    heard = "the shipped model" if model is None else f"the model {model.name}"
    text = [
        f"{len(study.approaches)} approaches and {len(study.hazard_free)} hazard-free recordings, detectors: "
        f"{names}; sound processed with {heard}. Ablation (c) is this sweep.",
        *(f"{one}." for one in study.missing),
        *(f"Left out: {name}, {why}." for name, why in study.skipped.items()),
    ]
    # With one detector there is no difference to report.
    if len(study.sweeps) > 1:
        text.append(
            "Between the first and the last detector, awareness differs by at most "
            f"{study.largest_awareness_difference:.3f}, and beta by {study.beta_shift:+.3f} on average."
        )
    return Section(title, tuple(text), tuple(sweep_tables(study)))


def sweep_tables(study: DegradationStudy) -> list[Table]:
    """Return the tables of awareness by condition and of rain as a common cause, for every detector."""
    parts = enumerate(study.sweeps, start=1)
    return [table for number, sweep in parts for table in (_conditions(sweep, number), _rain(sweep, number))]


def degradation_record(study: DegradationStudy) -> dict[str, Any]:
    """Return all results ready for JSON; unknown values are null."""
    record: dict[str, Any] = json_values(
        {
            **{name: getattr(study, name) for name in ("approaches", "hazard_free", "skipped", "missing")},
            "beta_shift": study.beta_shift,
            "largest_awareness_difference": study.largest_awareness_difference,
            "detectors": {sweep.detector: _sweep_record(sweep) for sweep in study.sweeps},
        }
    )
    return record


def _sweep_record(sweep: DetectorSweep) -> dict[str, object]:
    bands = {"by_azimuth": sweep.beta.by_azimuth._asdict(), "overall": sweep.beta.overall._asdict()}
    return {
        **asdict(sweep.awareness),
        "rows": [{"name": row.condition.name, **asdict(row)} for row in sweep.awareness.rows],
        "least_awareness": sweep.least_awareness.awareness,
        "least_vision": sweep.least_vision.vision,
        "beta": {"families": FAMILIES, "levels": LEVELS, **asdict(sweep.beta), **bands},
    }


def _conditions(sweep: DetectorSweep, number: int) -> Table:
    return Table(
        f"degradation_{number}",
        f"Awareness by condition, {sweep.detector}",
        _CONDITION,
        [_condition(row) for row in sweep.awareness.rows],
        f"On {sweep.awareness.hops_in_view} hops in view and {sweep.awareness.hazard_free_hours:.3f} h of "
        "hazard-free time. Thresholds are those of the clean camera. Paper: awareness at least 0.87 while "
        "vision falls to 0.03.",
    )


def _condition(row: AwarenessRow) -> tuple[Cell, ...]:
    known = [Value(math.nan if one is None else one) for one in (row.degradation, row.miss_rate)]
    before = row.unseen_awareness, row.detected, row.lead_time_s
    return (
        row.condition.name,
        *known,
        *(Value(*one) for one in (row.vision, row.awareness)),
        *(Value(math.nan if one is None else one) for one in before),
        *(Value(*one, digits=0) for one in (row.false_alarms_per_hour, row.false_awareness_per_hour)),
        Value(row.false_awareness),
    )


def _rain(sweep: DetectorSweep, number: int) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for one in sweep.awareness.common_cause:
        shares = one.lens, one.roof, one.rain, one.additive, one.optimism
        rows.append((str(one.level), Value(one.noise_db, digits=0), *(Value(*share) for share in shares)))
    return Table(
        f"rain_{number}",
        f"Rain as a common cause: awareness (share), {sweep.detector}",
        _RAIN,
        rows,
        "Rain degrades the image and adds noise on the roof at the same time; the noise level is relative to "
        "the recording. Optimism: awareness if the effects were independent, minus awareness in rain.",
    )


def _at(band: Band, place: tuple[int, ...]) -> Value:
    return Value(float(band.value[place]), float(band.low[place]), float(band.high[place]))
