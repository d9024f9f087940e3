"""Every figure of an evaluation with its interval and the paper's value, by place in the report."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from worldstate.frontend.array.microphone_array import roof_array_56
from worldstate.operations.arrays.array_bounds import array_bounds
from worldstate_lab.evaluation.evaluation import Evaluation
from worldstate_lab.evaluation.figures import FIGURES, PAPER_VALUES, PaperValue, paper_value, titles
from worldstate_lab.evaluation.front_end_study import FrontEndStudy
from worldstate_lab.evaluation.protocols import RETRAINED, STANDING
from worldstate_lab.evaluation.scores import Score
from worldstate_lab.methods.line_of_sight import seen_early_s
from worldstate_lab.metrics.intervals import middle, ratio
from worldstate_lab.metrics.track_measures import PUBLISHED_COVERAGE
from worldstate_lab.report.table import Cell, Table, Value

Place = tuple[str, str, str]  # Group, row and figure, as in `PAPER_VALUES`

PROPOSED = "proposed .02"
_FRONT_END, _LOOMING = ("front-end", "bearing in view"), ("approach rate", "looming")
# The front-end study's figures, by place in the paper's list.
_STUDIED = {
    "bearing_srp_deg": (*_FRONT_END, "bearing_deg"),
    "doppler_usable": ("approach rate", "Doppler", "doppler_usable"),
    **{name: (*_LOOMING, name) for name in ("looming_auroc", "looming_correlation")},
    **{name: (*_FRONT_END, name) for name in ("bearing_music_deg", "bearing_gated_deg")},
    **{name: (*_FRONT_END, name) for name in ("prominence_in_view", "prominence_in_silence")},
}
_UNSTATED = {
    **dict.fromkeys(("bearing_deg", "side_correct", "gospa_deg"), "states none"),
    "lead_s": "none detected",
}
_REFUSED = Value(math.nan, note="not scored: the model was not made for this sound")


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredValues:
    """An evaluation with all of its values, from which the sections of the report are built."""

    found: Evaluation
    values: Mapping[Place, Value]

    @classmethod
    def of(cls, found: Evaluation, others: Mapping[Place, Value]) -> "MeasuredValues":
        """Return the values of protocols, methods, front-end, array and data, and `others`."""
        values = dict(others) | dict(_data_values(found)) | dict(_array_values())
        for protocol, scores in found.scores.items():
            for method, score in scores.items():
                figures = score_values(score, found, protocol)
                values |= {(protocol, method, name): value for name, value in figures.items()}
        if found.front_end is not None:
            values |= dict(_front_end_values(found.front_end))
        values |= dict(_derived_values(values, found))
        return cls(found, {place: _beside_paper(place, value) for place, value in values.items()})

    def at(self, *place: str, note: str = "") -> Value:
        """Return the value at a place, or NaN with a note if there is none."""
        group, row, figure = place
        return self.values.get((group, row, figure), Value(math.nan, note=note))

    def methods(self, protocol: str, figures: Iterable[str] = ()) -> list[str]:
        """Return the methods with a row in the report; given figures, only methods with any of them."""
        every = [*self.found.scores[protocol], *self.found.refused.get(protocol, {})]
        if not figures:
            return every
        return [m for m in every if any(math.isfinite(self.at(protocol, m, one).value) for one in figures)]

    def table(
        self,
        protocol: str,
        methods: Sequence[str],
        figures: Sequence[str],
        name: str,
        title: str,
        caption: str,
    ) -> Table:
        """Return a table with one row per method and one column per figure."""
        refused = self.found.refused.get(protocol, {})
        reasons = [f"Not scored: {refused[method]}." for method in methods if method in refused]
        rows = [(method, *self._cells(protocol, method, figures)) for method in methods]
        told = " ".join((self.found.runs[protocol].basis, caption, *dict.fromkeys(reasons)))
        return Table(name, title, ("method", *titles(figures)), rows, told)

    def _cells(self, protocol: str, method: str, figures: Sequence[str]) -> list[Cell]:
        if method in self.found.refused.get(protocol, {}):
            return [_REFUSED, *[None] * (len(figures) - 1)]
        cells = [(self.at(protocol, method, figure), figure) for figure in figures]
        return [v if math.isfinite(v.value) else replace(v, note=_UNSTATED.get(f, "")) for v, f in cells]


def score_values(score: Score, found: Evaluation, protocol: str) -> dict[str, Value]:
    """Return every figure of one score with its interval; false alarms have the exact Poisson interval."""
    intervals = score.intervals(found.draws[protocol])
    # If no alarm occurred, resampling gives an interval of zero width; the exact one remains valid.
    intervals["false_alarms_per_hour"] = intervals["false_alarms_per_hour_poisson"]
    # A resample contains recordings twice, which raises its ECE: only the value itself is printed.
    intervals |= dict.fromkeys(("ece", "ece_raw", "ece_floor"), (math.nan, math.nan))
    notes = _worst_notes(score)
    return {
        name: Value(value, *intervals[name], FIGURES[name].digits, notes.get(name, ""))
        for name, value in score.figures().items()
    }


def _worst_notes(score: Score) -> dict[str, str]:
    """Return the worst junction of every figure, or nothing if there is only one junction."""
    if len({site for _, site in score.strata}) < 2:
        return {}
    return {
        name: f"worst {site} {Value(value, digits=FIGURES[name].digits).number}"
        for name, (site, value) in score.worst_sites().items()
        if math.isfinite(value)
    }


def site_values(score: Score, found: Evaluation, protocol: str) -> dict[str, dict[str, Value]]:
    """Return the figures of each junction with intervals over its recordings."""
    sites: dict[str, list[int]] = {}
    for row, (_, site) in enumerate(score.strata):
        sites.setdefault(site, []).append(row)
    values = {}
    for site, rows in sorted(sites.items()):
        # Element i of every draw comes from the stratum of recording i, so it has the junction of recording
        # i.
        drawn, figures = score.draws(found.draws[protocol][:, rows]), score.figures(np.array(rows))
        values[site] = {
            name: Value(value, *middle(drawn[name]), FIGURES[name].digits)
            for name, value in figures.items()
            if math.isfinite(value)
        }
    return values


def _stated(group: str, figures: Mapping[str, Value]) -> Iterator[tuple[Place, Value]]:
    """Yield the places at which the paper states figures of a group, with our measured values."""
    for one in PAPER_VALUES:
        if one.group == group and one.figure in figures:
            yield (group, one.row, one.figure), figures[one.figure]


def _data_values(found: Evaluation) -> Iterator[tuple[Place, Value]]:
    standing = [trial for trial in found.trials if not trial.hops.about["moving"]]
    approaches = sum(not trial.hazard_free for trial in standing)
    counts = {
        "recordings": len(standing),
        "approaches": approaches,
        "hazard_free_recordings": len(standing) - approaches,
        "dynamic_recordings": len(found.trials) - len(standing),
        "junctions": len({trial.site for trial in standing}),
    }
    return _stated("data", {name: Value(count, digits=0) for name, count in counts.items()})


def _array_values() -> Iterator[tuple[Place, Value]]:
    bounds = array_bounds(roof_array_56(), 1000.0, (0.0,))
    _, width_m, height_m = bounds.aperture_m
    figures = {
        "horizontal_moment_m2": Value(bounds.horizontal_moment_m2),
        "sigma_deg": Value(bounds.sigma_deg[0.0] or math.nan),
        "mean_spacing_m": Value(bounds.mean_spacing_m, digits=4),
        "alias_hz": Value(bounds.alias_hz, digits=0),
        "aperture_width_m": Value(width_m),
        "aperture_height_m": Value(height_m),
        "microphones": Value(bounds.microphones, digits=0),
    }
    return _stated("array bounds", figures)


def _front_end_values(study: FrontEndStudy) -> Iterator[tuple[Place, Value]]:
    for name, place in _STUDIED.items():
        yield place, Value(study.figures[name], *study.intervals[name], FIGURES[place[2]].digits)
    medians = sorted(
        (Value(one.median_deg, *one.interval_deg, 1, site) for site, one in study.by_site.items()),
        key=lambda one: one.value,
    )
    ends = ("bearing_best_site_deg", "bearing_worst_site_deg")
    for name, median in zip(ends, (*medians[:1], *medians[-1:]), strict=False):
        yield (*_FRONT_END, name), median
    yield (*_FRONT_END, "frames"), Value(study.frames, digits=0)
    yield (*_FRONT_END, "recordings"), Value(study.approaches, digits=0)
    yield (*_FRONT_END, "gated_coverage"), Value(PUBLISHED_COVERAGE)
    yield ("approach rate", "Doppler", "pass_bys"), Value(study.approaches, digits=0)


def _derived_values(values: Mapping[Place, Value], found: Evaluation) -> Iterator[tuple[Place, Value]]:
    """Yield values that the paper states as differences, worst cases or counts of figures."""
    if STANDING in found.runs:
        yield ("static", "against the sustained rule", "fewer_false_alarms"), _fewer(found)
        early = seen_early_s(found.runs[STANDING].trials)
        count = Value(float((early > 0.0).sum()), digits=0, note=f"of {early.size}")
        yield ("static", "Vision-only", "approaches_with_early_box"), count
        yield from _seed_range(found)
    if RETRAINED.name in found.scores:
        sites = site_values(found.scores[RETRAINED.name][PROPOSED], found, RETRAINED.name)
        shares = [replace(one["detection"], note=site) for site, one in sites.items() if "detection" in one]
        shares.sort(key=lambda one: one.value)
        yield (RETRAINED.name, PROPOSED, "detection_worst"), shares[0]
        yield (RETRAINED.name, PROPOSED, "detection_best"), shares[-1]
    for row, figure in (("raw statistic", "ece_raw"), ("calibrated risk", "ece")):
        if (place := ("static", PROPOSED, figure)) in values:
            yield ("ablations", row, "ece"), values[place]


def _fewer(found: Evaluation) -> Value:
    """Return the share of false alarms that the proposed method avoids, on the same draws of recordings."""
    every = np.vstack([np.arange(len(found.runs[STANDING].trials)), found.draws[STANDING]])
    ours, others = (
        found.scores[STANDING][method].draws(every)["false_alarms_per_hour"]
        for method in (PROPOSED, "published, sustained")
    )
    fewer = 1.0 - ratio(ours, others)
    return Value(float(fewer[0]), *middle(fewer[1:]))


def _seed_range(found: Evaluation) -> Iterator[tuple[Place, Value]]:
    counts = found.scores[STANDING][PROPOSED].counts
    shares = counts["detected"].sum(axis=1) / counts["approaches"].sum(axis=1)
    note = "" if len(found.runs[STANDING].seeds) > 1 else "one seed; --full uses five"
    for name, share in (("detection_least", shares.min()), ("detection_most", shares.max())):
        yield ("static", f"{PROPOSED}, least and most over five seeds", name), Value(float(share), note=note)


def _beside_paper(place: Place, value: Value) -> Value:
    stated = paper_value(*place)
    return value if stated is None else replace(value, paper=printed(stated))


def printed(one: PaperValue) -> Value:
    """Return a number of the paper with the paper's rounding."""
    return Value(one.value, one.low, one.high, one.digits)
