"""Accuracy of the front-end and approach rate on the trials of a protocol (section IX of the paper)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.ground.typing import FloatArray, IndexArray
from worldstate.operations.metrics.approach_table import auroc
from worldstate.operations.recordings.hop_table import HopTable, joined
from worldstate_lab.metrics.intervals import Interval, middle, pooled_draws, stratified_draws
from worldstate_lab.metrics.track_measures import gated_median_deg
from worldstate_lab.trials.trial import Trial

# The paper computes its looming figures on the last three seconds before the pass.
IMMINENT_S = 3.0
# A slope is converted into a time of arrival; a longer time than this means that nothing approaches.
LONGEST_TTA_S = 30.0


@dataclass(frozen=True, slots=True)
class SiteError:
    """Median error of the SRP bearings in view at one site, with an interval over recordings."""

    median_deg: float
    interval_deg: Interval
    frames: int


@dataclass(frozen=True, slots=True, eq=False)
class FrontEndStudy:
    """Bearing errors against the camera, prominence, looming and Doppler, with intervals over recordings."""

    # `bearing_srp_deg`, `bearing_music_deg`, `bearing_gated_deg`, `prominence_in_view`,
    # `prominence_in_silence`, `looming_auroc`, `looming_correlation`, `doppler_usable` (count).
    figures: Mapping[str, float]
    intervals: Mapping[str, Interval]
    by_site: Mapping[str, SiteError]
    frames: int  # Line-of-sight frames with a moving reference box
    approaches: int


def front_end_study(trials: Sequence[Trial], rng: np.random.Generator, draws: int = 500) -> FrontEndStudy:
    """Compute the figures, and resample recordings for their intervals."""
    approaches = [trial for trial in trials if not trial.hazard_free]
    strata = [(trial.label, trial.site) for trial in trials]
    drawn = stratified_draws(strata, rng, draws)
    found = _figures(trials, np.arange(len(trials)))
    samples = [_figures(trials, rows) for rows in drawn]
    by_site = {
        site: _site_error([trial.hops for trial in approaches if trial.site == site], rng, draws)
        for site in sorted({trial.site for trial in approaches})
    }
    by_site = {site: error for site, error in by_site.items() if error.frames}
    return FrontEndStudy(
        found,
        {name: middle(np.array([one[name] for one in samples])) for name in found},
        by_site,
        sum(error.frames for error in by_site.values()),
        len(approaches),
    )


def _figures(trials: Sequence[Trial], rows: IndexArray) -> dict[str, float]:
    approaches = [trials[i].hops for i in rows.tolist() if not trials[i].hazard_free]
    calm = [trials[i].hops for i in rows.tolist() if trials[i].hazard_free]
    checked = [
        HopTable({"prominence": hops.prominence, "error_rad": hops.srp_rad - hops.reference_rad})
        for hops in approaches
    ]
    seen = [hops.prominence[np.isfinite(hops.reference_rad)] for hops in approaches]
    return {
        "bearing_srp_deg": float(np.degrees(_median([_error(hops, "srp_rad") for hops in approaches]))),
        "bearing_music_deg": float(np.degrees(_median([_error(hops, "music_rad") for hops in approaches]))),
        "bearing_gated_deg": gated_median_deg(joined(checked)) if checked else np.nan,
        "prominence_in_view": _median(seen),
        "prominence_in_silence": _median([hops.prominence for hops in calm]),
        "doppler_usable": float(sum(hops.about["doppler"] == "" for hops in approaches)),
        **_looming(approaches, calm),
    }


def _looming(approaches: Sequence[HopTable], calm: Sequence[HopTable]) -> dict[str, float]:
    """Return how well the slope separates the last seconds before the pass from silence."""
    imminent, read, true = [list[FloatArray]() for _ in range(3)]
    for hops in (one for one in approaches if one.about["pass_s"] is not None):
        left_s = float(hops.about["pass_s"]) - hops.time_s
        imminent.append(hops.log_slope_hz[(left_s > 0.0) & (left_s < IMMINENT_S)])
        hidden = hops.before_sight() & (hops.log_slope_hz > 2.0 / LONGEST_TTA_S)
        read.append(2.0 / hops.log_slope_hz[hidden])
        true.append(left_s[hidden])
    high, low = _known(imminent), _known([hops.log_slope_hz for hops in calm])
    area = auroc(np.concatenate([high, low]), np.arange(high.size + low.size) < high.size)
    enough = sum(map(len, read)) > 2
    agree = float(np.corrcoef(np.concatenate(read), np.concatenate(true))[0, 1]) if enough else np.nan
    return {"looming_auroc": np.nan if area is None else area, "looming_correlation": agree}


def _site_error(approaches: Sequence[HopTable], rng: np.random.Generator, draws: int) -> SiteError:
    errors = [_known([_error(hops, "srp_rad")]) for hops in approaches]
    medians = [_median([one]) for one in pooled_draws(errors, [0] * len(errors), rng, draws)]
    interval = middle(np.degrees(np.array(medians)))
    return SiteError(float(np.degrees(_median(errors))), interval, sum(map(len, errors)))


def _error(hops: HopTable, name: str) -> FloatArray:
    return np.asarray(np.abs(hops.columns[name] - hops.reference_rad))


def _known(parts: Sequence[FloatArray]) -> FloatArray:
    every: FloatArray = np.concatenate([np.empty(0), *parts])
    return every[np.isfinite(every)]


def _median(parts: Sequence[FloatArray]) -> float:
    known = _known(parts)
    return float(np.median(known)) if known.size else np.nan
