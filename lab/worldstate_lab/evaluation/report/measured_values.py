"""Every figure of an evaluation as a value with its interval and the paper's, by place in the report."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from worldstate.frontend.array.microphone_array import roof_array_56
from worldstate.operations.arrays.array_bounds import array_bounds
from worldstate.operations.recordings.bearing_gating import PUBLISHED_COVERAGE
from worldstate_lab.evaluation.evaluation import Evaluation
from worldstate_lab.evaluation.front_end_study import FrontEndStudy
from worldstate_lab.evaluation.paper_values import PAPER_VALUES, paper_value
from worldstate_lab.evaluation.protocols import RETRAINED, STATIC
from worldstate_lab.evaluation.scores import Score
from worldstate_lab.methods.line_of_sight import seen_early_s
from worldstate_lab.metrics.intervals import middle, ratio
from worldstate_lab.report.table import Value

Place = tuple[str, str, str]  # Group, row and figure, as in `PAPER_VALUES`
Values = Mapping[Place, Value]

# Decimals that the numbers of recordings at hand can bear; two where nothing is said.
_DIGITS = {
    "false_alarms_per_hour": 0, "false_alarms_per_hour_draws": 0, "hazard_free_hours": 3,
    "quantum_per_hour": 1, "auroc_all": 3, "auroc_2s": 3, "auroc_1s": 3, "ece": 3, "ece_raw": 3,
    "ece_floor": 3, "brier_skill": 3, "hazard_share": 3, "advisory_share": 3, "bearing_deg": 1,
    "bearing_gated_deg": 1, "bearing_music_deg": 1, "bearing_best_site_deg": 1, "bearing_worst_site_deg": 1,
    "gospa_deg": 1, "azimuth_error_deg": 1, "looming_auroc": 3, "frames": 0, "recordings": 0,
    "approaches": 0, "hazard_free_recordings": 0, "dynamic_recordings": 0, "junctions": 0, "folds": 0,
    "doppler_usable": 0, "pass_bys": 0, "microphones": 0, "alias_hz": 0, "sigma_deg": 2,
    "mean_spacing_m": 4, "approaches_with_early_box": 0, "false_onsets": 1,
}  # fmt: skip
# Names of the front-end study, where the paper's list has another.
_FRONT_END = {
    "bearing_srp_deg": ("front-end", "bearing in view", "bearing_deg"),
    "bearing_music_deg": ("front-end", "bearing in view", "bearing_music_deg"),
    "bearing_gated_deg": ("front-end", "bearing in view", "bearing_gated_deg"),
    "prominence_in_view": ("front-end", "bearing in view", "prominence_in_view"),
    "prominence_in_silence": ("front-end", "bearing in view", "prominence_in_silence"),
    "doppler_usable": ("approach rate", "Doppler", "doppler_usable"),
    "looming_auroc": ("approach rate", "looming", "looming_auroc"),
    "looming_correlation": ("approach rate", "looming", "looming_correlation"),
}


def measured_values(found: Evaluation, others: Values) -> dict[Place, Value]:
    """Return the values of all protocols and methods, the front-end, the array and the data, and others."""
    values = dict(others) | dict(_data_values(found)) | dict(_array_values())
    for protocol, scores in found.scores.items():
        for method, score in scores.items():
            if not method.startswith("curve"):
                values |= dict(_score_values(protocol, method, score, found))
    if found.front_end is not None:
        values |= dict(_front_end_values(found.front_end))
    values |= dict(_derived_values(values, found))
    return {place: _beside_paper(place, value) for place, value in values.items()}


def score_values(score: Score, found: Evaluation, protocol: str) -> dict[str, Value]:
    """Return every figure of one score with its interval; false alarms with the exact one."""
    figures, intervals = score.figures(), score.intervals(found.draws[protocol])
    # The exact interval covers what drawing recordings again cannot: that no alarm was seen at all.
    intervals["false_alarms_per_hour_draws"] = intervals["false_alarms_per_hour"]
    figures["false_alarms_per_hour_draws"] = figures["false_alarms_per_hour"]
    intervals["false_alarms_per_hour"] = intervals["false_alarms_per_hour_poisson"]
    # A draw repeats recordings, and so its ECE lies above that of all: only the value is stated.
    intervals |= dict.fromkeys(("ece", "ece_raw", "ece_floor"), (math.nan, math.nan))
    notes = _worst_notes(score)
    return {
        name: Value(value, *intervals[name], figure_digits(name), notes.get(name, ""))
        for name, value in figures.items()
    }


def _worst_notes(score: Score) -> dict[str, str]:
    """Say of every figure which junction is the worst; nothing where there is one alone."""
    if len({one.site for one in score.recordings}) < 2:
        return {}
    return {
        name: f"worst {site} {Value(value, digits=figure_digits(name)).number}"
        for name, (site, value) in score.worst_sites().items()
        if math.isfinite(value)
    }


def site_values(score: Score, found: Evaluation, protocol: str) -> dict[str, dict[str, Value]]:
    """Return the figures of each junction with intervals over its recordings."""
    sites: dict[str, list[int]] = {}
    for row, one in enumerate(score.recordings):
        sites.setdefault(one.site, []).append(row)
    values = {}
    for site, rows in sorted(sites.items()):
        # Place i of every draw holds a recording of the stratum of i, so its junction is that of i.
        drawn, figures = score.draws(found.draws[protocol][:, rows]), score.figures(np.array(rows))
        values[site] = {
            name: Value(value, *middle(drawn[name]), figure_digits(name))
            for name, value in figures.items()
            if math.isfinite(value)
        }
    return values


def figure_digits(name: str) -> int:
    """Return the decimals with which a figure is printed."""
    return _DIGITS.get(name, 2)


def _plain(name: str, value: float) -> Value:
    return Value(value, digits=figure_digits(name))


def _score_values(
    protocol: str, method: str, score: Score, found: Evaluation
) -> Iterator[tuple[Place, Value]]:
    for name, value in score_values(score, found, protocol).items():
        yield (protocol, method, name), value


def _data_values(found: Evaluation) -> Iterator[tuple[Place, Value]]:
    standing = [trial for trial in found.trials if not trial.hops.about["moving"]]
    approaches = [trial for trial in standing if not trial.hazard_free]
    counts = {
        "recordings": len(standing),
        "approaches": len(approaches),
        "hazard_free_recordings": len(standing) - len(approaches),
        "dynamic_recordings": len(found.trials) - len(standing),
        "junctions": len({trial.site for trial in standing}),
    }
    for one in PAPER_VALUES:
        if one.group == "data" and one.figure in counts:
            yield ("data", one.row, one.figure), _plain(one.figure, counts[one.figure])


def _array_values() -> Iterator[tuple[Place, Value]]:
    bounds = array_bounds(roof_array_56(), 1000.0, (0.0,))
    _, width_m, height_m = bounds.aperture_m
    figures = {
        "horizontal_moment_m2": bounds.horizontal_moment_m2,
        "sigma_deg": bounds.sigma_deg[0.0] or math.nan,
        "mean_spacing_m": bounds.mean_spacing_m,
        "alias_hz": bounds.alias_hz,
        "aperture_width_m": width_m,
        "aperture_height_m": height_m,
        "microphones": bounds.microphones,
    }
    for one in PAPER_VALUES:
        if one.group == "array bounds":
            yield (one.group, one.row, one.figure), _plain(one.figure, figures[one.figure])


def _front_end_values(study: FrontEndStudy) -> Iterator[tuple[Place, Value]]:
    for name, place in _FRONT_END.items():
        yield place, Value(study.figures[name], *study.intervals[name], figure_digits(name))
    medians = sorted(
        (Value(one.median_deg, *one.interval_deg, 1, site) for site, one in study.by_site.items()),
        key=lambda one: one.value,
    )
    ends = ("bearing_best_site_deg", "bearing_worst_site_deg")
    for name, median in zip(ends, (*medians[:1], *medians[-1:]), strict=False):
        yield ("front-end", "bearing in view", name), median
    counts = {
        "frames": study.frames,
        "recordings": study.approaches,
        "gated_coverage": PUBLISHED_COVERAGE,
    }
    for name, value in counts.items():
        yield ("front-end", "bearing in view", name), _plain(name, value)
    yield ("approach rate", "Doppler", "pass_bys"), _plain("pass_bys", study.approaches)


def _derived_values(values: Values, found: Evaluation) -> Iterator[tuple[Place, Value]]:
    """Values that the paper states as differences, worst cases or counts over the figures."""
    if STATIC.name in found.runs:
        yield ("static", "against the sustained rule", "fewer_false_alarms"), _fewer(found)
        early = seen_early_s(found.runs[STATIC.name].trials)
        count = Value(float((early > 0.0).sum()), digits=0, note=f"of {early.size}")
        yield ("static", "Vision-only", "approaches_with_early_box"), count
        yield from _seed_range(found)
    if RETRAINED.name in found.scores:
        sites = site_values(found.scores[RETRAINED.name]["proposed .02"], found, RETRAINED.name)
        shares = [replace(one["detection"], note=site) for site, one in sites.items() if "detection" in one]
        shares.sort(key=lambda one: one.value)
        for name, share in (("detection_worst", shares[0]), ("detection_best", shares[-1])):
            yield (RETRAINED.name, "proposed .02", name), share
    for row, figure in (("raw statistic", "ece_raw"), ("calibrated risk", "ece")):
        value = values.get(("static", "proposed .02", figure))
        if value:
            yield ("ablations", row, "ece"), value


def _fewer(found: Evaluation) -> Value:
    """Return the share of false alarms that the proposed method saves, on the same draws of recordings."""
    every = np.vstack([np.arange(len(found.runs[STATIC.name].trials)), found.draws[STATIC.name]])
    ours, others = (
        found.scores[STATIC.name][method].draws(every)["false_alarms_per_hour"]
        for method in ("proposed .02", "published, sustained")
    )
    fewer = 1.0 - ratio(ours, others)
    return Value(float(fewer[0]), *middle(fewer[1:]))


def _seed_range(found: Evaluation) -> Iterator[tuple[Place, Value]]:
    counts = found.scores[STATIC.name]["proposed .02"].counts
    shares = counts["detected"].sum(axis=1) / counts["approaches"].sum(axis=1)
    seeds = len(found.runs[STATIC.name].seeds)
    for name, share in (("detection_least", shares.min()), ("detection_most", shares.max())):
        row = "proposed .02, least and most over five seeds"
        yield (
            ("static", row, name),
            Value(float(share), note="" if seeds > 1 else "one seed; --full draws five"),
        )


def _beside_paper(place: Place, value: Value) -> Value:
    stated = paper_value(*place)
    if stated is None:
        return value
    paper = Value(stated.value, stated.low, stated.high, stated.digits)
    return Value(value.value, value.low, value.high, value.digits, value.note, paper)
