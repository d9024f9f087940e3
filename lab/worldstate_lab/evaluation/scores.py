"""Figures of every method and protocol, with intervals over recordings.

They include false alarms at equal detection: two alarm rules are compared at thresholds with equal detection.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.abduction.cueing.cueing_policy import sustained_alarm
from worldstate.abduction.cueing.risk_map import BINS
from worldstate.commissioning.alarm_curve import raised_at
from worldstate.ground.checks import check_shape
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import BoolArray, FloatArray, IndexArray
from worldstate.ground.values import SECONDS_PER_HOUR
from worldstate.operations.metrics.approach_table import poisson_interval, rank_wins
from worldstate.operations.recordings.hop_table import HOP_S, HopTable, joined
from worldstate_lab.evaluation import reduction
from worldstate_lab.evaluation.figures import FIGURES
from worldstate_lab.methods.acoustic_rules import SUSTAIN_CHOICES
from worldstate_lab.metrics.intervals import (
    Interval,
    draw_weights,
    highest_share,
    known_mean,
    middle,
    poisson_upper,
    random_detection,
    ratio,
    weighted_areas,
    weighted_median,
    worst_group,
)
from worldstate_lab.metrics.track_measures import PUBLISHED_COVERAGE
from worldstate_lab.trials.trial import Decisions, Trial

from .reduction import alarm_counts

_HOURS = HOP_S / SECONDS_PER_HOUR
_RATIOS = {name: (*kind.counts, kind.unit) for name, kind in FIGURES.items() if any(kind.counts)}
# Sums per recording; a missing count is zero.
COUNTS = (
    *dict.fromkeys(name for ratio in _RATIOS.values() for name in ratio[:2]),
    *("onsets_before", "window_s", "before_s"),
    *(f"windows_{horizon}" for horizon in reduction.HORIZONS_S),
    *("squared_error", "visible_hops", "visible_squared", "visible_true", "visible_true_squared"),
)
_RISK, _RAW = 0, 1


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """The score of one method under one protocol, once for every seed that changes its decisions.

    There are S seeds and R recordings: P approaches and Q hazard-free ones.

    Parameters
    ----------
    strata : tuple of (str, str)
        Label and site of every recording, in the order of the rows; the strata of `stratified_draws`.
    counts : mapping of str to ndarray, shape (S, R)
        Sums over the hops of each recording.
    wins : ndarray, shape (S, horizons, P, Q)
        How often a window of an approach scores above a window of a hazard-free recording.
    bins : ndarray, shape (S, 2, R, bins, 3)
        Number of windows, summed probability and summed label variance by bin, for the risk and the score.
    bearings : tuple of HopTable, length S
        Bearing errors in view with the prominence of their peaks.

    Examples
    --------
    >>> times = 1.0 + 0.1 * np.arange(20)
    >>> near = HopTable(
    ...     {"time_s": times, "reference_rad": np.full(20, np.nan), "prominence": np.ones(20)},
    ...     "a", "left", 2.5, {"site": "SA1"},
    ... )
    >>> said = Decisions.of(times, alarm=times > 1.95, side=np.ones(20, int))
    >>> score = Score.of([Trial(near), Trial(near.replace(name="b", label="none"))], [[said, said]])
    >>> figures = score.figures()
    >>> figures["detection"], round(figures["lead_s"], 2), round(figures["false_alarms_per_hour"])
    (1.0, 0.5, 1800)
    """

    strata: tuple[tuple[str, str], ...]
    counts: Mapping[str, FloatArray]
    wins: FloatArray
    bins: FloatArray
    bearings: tuple[HopTable, ...]

    @classmethod
    def of(cls, trials: Sequence[Trial], passes: Sequence[Sequence[Decisions]]) -> "Score":
        """Score the decisions on the trials: one pass per seed, each with one element per trial, in order."""
        if not (trials and passes):
            raise InvalidArgumentError("trials: expected at least one recording and one pass over them")
        for said in passes:
            check_shape("decisions of a pass", (len(said),), (len(trials),))
            for trial, one in zip(trials, said, strict=True):
                reduction.check_decisions(trial, one)
        # Decisions that no seed changes are scored once: a fixed chain returns the same objects for each
        # seed.
        if all(one is first for said in passes for one, first in zip(said, passes[0], strict=True)):
            passes = passes[:1]
        rows = [_counts(trials, said) for said in passes]
        return cls(
            strata=tuple((trial.label, trial.site) for trial in trials),
            counts={name: np.array([[one[name] for one in row] for row in rows]) for name in COUNTS},
            wins=np.array([_wins(trials, said) for said in passes]),
            bins=np.array([_bins(trials, said) for said in passes]),
            bearings=tuple(_bearings(trials, said) for said in passes),
        )

    def figures(self, rows: IndexArray | None = None) -> dict[str, float]:
        """Return every figure on the chosen recordings, mean over seeds; NaN if there is nothing to count."""
        chosen = np.arange(len(self.strata)) if rows is None else rows
        return {name: float(values[0]) for name, values in self.draws(chosen[None]).items()}

    def draws(self, draws: IndexArray) -> dict[str, FloatArray]:
        """Return every figure on each draw of recordings, mean over seeds, shape (D,); draws (D, n)."""
        return self._values(draw_weights(draws, len(self.strata)))

    def intervals(self, draws: IndexArray) -> dict[str, Interval]:
        """Return the central 95 % of every figure over draws, and the exact interval of the false alarms."""
        # The ECE of a draw is higher than that of the recordings: only the width of its interval is
        # meaningful.
        exact = {"false_alarms_per_hour_poisson": self.poisson()}
        return {name: middle(values) for name, values in self.draws(draws).items()} | exact

    def poisson(self) -> Interval:
        """Return the exact interval of the false alarms per hour over all recordings."""
        onsets, hours = self._false_onsets()
        return poisson_interval(onsets, hours) if hours else (float("nan"), float("nan"))

    def poisson_upper(self) -> float:
        """Return the upper bound of the false alarms per hour at a confidence of 0.9."""
        onsets, hours = self._false_onsets()
        return poisson_upper(onsets, hours) if hours else float("nan")

    def _false_onsets(self) -> tuple[int, float]:
        """Return the number of alarms and the hours of hazard-free time."""
        hours = float(self.counts["free_hops"].mean(axis=0).sum()) * _HOURS
        # All seeds use the same hours, so their mean is one count and not a count over S times the hours.
        return round(float(self.counts["free_onsets"].mean(axis=0).sum())), hours

    def by_site(self) -> dict[str, dict[str, float]]:
        """Return the figures of each junction, by name."""
        sites = sorted({site for _, site in self.strata})
        inside = np.array([[one == site for _, one in self.strata] for site in sites], np.float64)
        found = self._values(inside)
        return {
            site: {name: float(values[i]) for name, values in found.items()} for i, site in enumerate(sites)
        }

    def worst_sites(self) -> dict[str, tuple[str, float]]:
        """Return the worst junction and its value for each figure that has a better and a worse end."""
        sites = self.by_site()
        return {
            name: worst_group({site: one[name] for site, one in sites.items()}, worse)
            for worse in ("low", "high")
            for name, kind in FIGURES.items()
            if kind.worse == worse
        }

    @property
    def _free(self) -> BoolArray:
        return np.array([label == "none" for label, _ in self.strata])

    def _values(self, weights: FloatArray) -> dict[str, FloatArray]:
        """Return every figure with weight weights[d, r] for recording r, shape (D,)."""
        names = list(self.counts)
        sums = dict(zip(names, np.array([self.counts[name] for name in names]) @ weights.T, strict=True))
        figures = {
            name: unit * ratio(sums[above], sums[below]) for name, (above, below, unit) in _RATIOS.items()
        }
        hours = sums["free_hops"] * _HOURS
        figures |= {
            "false_onsets": sums["free_onsets"],
            "hazard_free_hours": hours,
            "quantum_per_hour": ratio(np.ones_like(hours), hours),
            "random_detection": self._random_detection(weights, sums),
        }
        areas = {
            f"auroc_{horizon}": weighted_areas(
                self.wins[:, i], self.counts[f"windows_{horizon}"], ~self._free, weights
            )
            for i, horizon in enumerate(reduction.HORIZONS_S)
        }
        figures |= areas | self._calibration(weights, sums) | _visible_figures(sums)
        samples = [_bearing_figures(table, weights) for table in self.bearings]
        figures |= {name: np.array([one[name] for one in samples]) for name in samples[0]}
        return {name: known_mean(values) for name, values in figures.items()}

    def _calibration(self, weights: FloatArray, sums: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        shape = (*self.bins.shape[:2], len(weights), BINS, 3)
        flat = self.bins.reshape(*self.bins.shape[:3], BINS * 3)
        total = (weights @ flat).reshape(shape)
        hazards = ((weights * ~self._free) @ flat).reshape(shape)[..., 0]
        windows = total[..., 0].sum(axis=-1)
        ece = ratio(np.abs(total[..., 1] - hazards).sum(axis=-1), windows)
        share = ratio(hazards.sum(axis=-1), windows)[:, _RISK]
        # The sum of labels drawn from the risks differs from its mean by a normal deviate of variance V, and
        # by less than 2 V in expectation; the latter holds in bins with few or nearly certain windows.
        variance = total[:, _RISK, ..., 2]
        floor = np.minimum(np.sqrt(2.0 / np.pi * variance), 2.0 * variance).sum(axis=-1)
        brier = ratio(sums["squared_error"], windows[:, _RISK])
        return {
            "ece": ece[:, _RISK],
            "ece_raw": ece[:, _RAW],
            "ece_floor": ratio(floor, windows[:, _RISK]),
            "brier_skill": 1.0 - ratio(brier, share * (1.0 - share)),
            "hazard_share": share,
        }

    def _random_detection(self, weights: FloatArray, sums: Mapping[str, FloatArray]) -> FloatArray:
        """Return the share of approaches that as many random onsets before T0 would detect, shape (S, D)."""
        rates = np.full(sums["before_s"].shape, np.nan)
        times = weights * ~self._free
        for s, before_s in enumerate(sums["before_s"]):
            scored = before_s > 0.0
            onsets, windows_s = np.floor(sums["onsets_before"][s]), self.counts["window_s"][s]
            rates[s, scored] = random_detection(windows_s, onsets[scored], before_s[scored], times[scored])
        return rates


def _counts(trials: Sequence[Trial], said: Sequence[Decisions]) -> list[dict[str, float]]:
    """Return the counts of every recording; a quantity that a method never returns is not scored."""
    sides, tracks = any(one.side.any() for one in said), any(len(one.tracks) for one in said)
    bearings = any(np.isfinite(one.bearing_rad).any() for one in said)
    rows = []
    for trial, one in zip(trials, said, strict=True):
        row = dict.fromkeys(COUNTS, 0.0) | reduction.alarm_counts(trial, one)
        row |= reduction.awareness_counts(trial, one) | reduction.window_counts(trial, one)
        row |= reduction.visible_counts(trial, one)
        row |= reduction.gospa_counts(trial, one, tracks) if tracks or bearings else {}
        rows.append(row | {"sided": row["detected"] * sides})
    return rows


def _wins(trials: Sequence[Trial], said: Sequence[Decisions]) -> FloatArray:
    """Return how often windows of approaches rank above hazard-free ones, shape (horizons, P, Q)."""
    pairs = list(zip(trials, said, strict=True))
    calm = [reduction.scored_windows(trial, one.score) for trial, one in pairs if trial.hazard_free]
    near = [(trial, one.score) for trial, one in pairs if not trial.hazard_free]
    horizons_s = reduction.HORIZONS_S.values()
    hazards = [[reduction.scored_windows(trial, score, h) for trial, score in near] for h in horizons_s]
    return np.array([rank_wins(some, calm) for some in hazards])


def _bins(trials: Sequence[Trial], said: Sequence[Decisions]) -> FloatArray:
    """Return probability bins of risk and score, shape (2, R, BINS, 3)."""
    pairs = list(zip(trials, said, strict=True))
    risks = [reduction.scored_windows(trial, one.risk) for trial, one in pairs]
    raw = [reduction.scored_windows(trial, one.score) for trial, one in pairs]
    # Log-odds and ratios are valid scores but not probabilities.
    if any(((score < 0.0) | (score > 1.0)).any() for score in raw):
        raw = [np.zeros(0)] * len(raw)
    return np.array([[reduction.probability_bins(one) for one in some] for some in (risks, raw)])


def _bearings(trials: Sequence[Trial], said: Sequence[Decisions]) -> HopTable:
    pairs = enumerate(zip(trials, said, strict=True))
    return joined(reduction.bearing_samples(trial, one, row) for row, (trial, one) in pairs)


def _visible_figures(sums: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """Return the RMSE of the predicted time to visible, and that of the constant that fits the truth best."""
    hops = sums["visible_hops"]
    spread = ratio(sums["visible_true_squared"], hops) - ratio(sums["visible_true"], hops) ** 2
    return {
        "visible_error_s": np.sqrt(ratio(sums["visible_squared"], hops)),
        # The difference of two means may be -1e-16 if all truths are equal.
        "visible_error_constant_s": np.sqrt(np.maximum(spread, 0.0)),
    }


def _bearing_figures(samples: HopTable, weights: FloatArray) -> dict[str, FloatArray]:
    """Return the median error of all bearings and of the most prominent ones, shape (D,) each."""
    times = weights[:, samples.recording.astype(np.intp)]
    # The prominence threshold is set on each draw, as it would be on those recordings.
    gated = times * highest_share(samples.prominence, times, PUBLISHED_COVERAGE)
    kinds = {"bearing_deg": times, "bearing_gated_deg": gated}
    return {name: np.degrees(weighted_median(samples.error_rad, kept)) for name, kept in kinds.items()}


BASELINE, OURS = "published, sustained", "world-state advisory"
DETECTED = (0.8, 0.85, 0.9, 0.95)
# Quantiles used as thresholds. Those of hazard-free hops are dense where few alarms remain. Those before T0
# include the highest score of each approach, above which the approach is missed.
_CALM_SHARES, _NEAR_SHARES = np.geomspace(1e-5, 0.5, 60), np.linspace(0.0, 1.0, 30)
_COUNTS = ("approaches", "detected", "free_hops", "free_onsets")
# Maps a score and a threshold to the alarm of a recording.
Rule = Callable[[FloatArray, float], BoolArray]


@dataclass(frozen=True, slots=True, eq=False)
class OperatingCurve:
    """Counts of the alarms at every threshold on every recording, shape (thresholds, R) each."""

    counts: Mapping[str, FloatArray]

    def alarms_per_hour(self, detected: float, weights: FloatArray) -> FloatArray:
        """Return the lowest false-alarm rate of any threshold that detects this share, per hour, shape (D,).

        Recording r has weight weights[d, r]; the result is infinite if no threshold detects the share.
        """
        sums = {name: weights @ count.T for name, count in self.counts.items()}
        share = ratio(sums["detected"], sums["approaches"])
        rate = ratio(sums["free_onsets"], sums["free_hops"] * HOP_S / SECONDS_PER_HOUR)
        return np.asarray(np.where(share >= detected - 1e-9, rate, np.inf).min(axis=1))


@dataclass(frozen=True, slots=True)
class EqualDetection:
    """False alarms of two alarm rules at equal detection."""

    detected: float
    ours: float  # False alarms per hour; infinite if no threshold detects this share
    baseline: float
    ratio: float  # Ours divided by the baseline's, with the central 95 % over draws of recordings
    low: float
    high: float


def operating_curve(
    trials: Sequence[Trial], said: Sequence[Decisions], rules: Iterable[Rule]
) -> OperatingCurve:
    """Return the operating curve of several rules over all thresholds of their score."""
    levels = _levels(trials, said)
    rows = [
        [_counted(trial, one, rule(one.score, level)) for trial, one in zip(trials, said, strict=True)]
        for rule in rules
        for level in levels
    ]
    return OperatingCurve({name: np.array([[one[name] for one in row] for row in rows]) for name in _COUNTS})


def _levels(trials: Sequence[Trial], said: Sequence[Decisions]) -> list[float]:
    """Return thresholds from the median of the hazard-free scores to a value above all of them."""
    pairs = list(zip(trials, said, strict=True))
    calm = np.concatenate([one.score for trial, one in pairs if trial.hazard_free])
    near = [one.score[trial.hops.before_sight()] for trial, one in pairs if not trial.hazard_free]
    found = [np.quantile(calm, 1.0 - _CALM_SHARES, method="higher"), [np.nextafter(calm.max(), np.inf)]]
    found += [[one.max() for one in near if one.size]]
    found += [np.quantile(np.concatenate(near), 1.0 - _NEAR_SHARES, method="higher")]
    return [float(level) for level in np.unique(np.concatenate(found))]


def equal_detection(
    trials: Sequence[Trial], decisions: Mapping[str, Sequence[Sequence[Decisions]]], draws: IndexArray
) -> list[EqualDetection]:
    """Compare the world-state's alarm with the sustained baseline, each at its best threshold.

    The baseline's sustained hops are chosen together with its threshold. The result is empty if a method is
    missing.
    """
    if BASELINE not in decisions or OURS not in decisions:
        return []
    sustained = [_sustained(hops) for hops in SUSTAIN_CHOICES]
    baseline = operating_curve(trials, decisions[BASELINE][0], sustained)
    ours = operating_curve(trials, decisions[OURS][0], [_held])
    weights = np.vstack([np.ones(len(trials)), draw_weights(draws, len(trials))])
    return [_compared(share, ours, baseline, weights) for share in DETECTED]


def _compared(
    detected: float, ours: OperatingCurve, baseline: OperatingCurve, weights: FloatArray
) -> EqualDetection:
    a, b = (curve.alarms_per_hour(detected, weights) for curve in (ours, baseline))
    # A draw may have no alarms or too few detected approaches for either rule: such a draw has no ratio.
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = a / b
    shares[1:][np.isinf(shares[1:])] = np.nan
    return EqualDetection(detected, float(a[0]), float(b[0]), float(shares[0]), *middle(shares[1:]))


def _counted(trial: Trial, said: Decisions, alarm: BoolArray) -> dict[str, float]:
    found = alarm_counts(trial, Decisions.of(said.time_s, alarm))
    return {name: found.get(name, 0.0) for name in _COUNTS}


def _held(score: FloatArray, threshold: float) -> BoolArray:
    """Return a sequence model's alarm: its score is averaged over 0.3 s, and the alarm lasts 1 s longer."""
    return raised_at((score >= threshold).astype(float), 1.0)


def _sustained(hops: int) -> Rule:
    return lambda score, threshold: sustained_alarm(score >= threshold, hops)
