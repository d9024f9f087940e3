"""The paper's figures of the front-end (section IX) on real recordings of street corners."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from worldstate.frontend.approach.doppler import radial_speed
from worldstate.frontend.approach.engine_line import track_fundamental
from worldstate.frontend.array.microphone_array import ovad_array
from worldstate.ground.typing import BoolArray, IndexArray
from worldstate.ground.values import NotUsable
from worldstate.operations.recordings.hop_table import HOP_S
from worldstate_lab.evaluation.front_end_study import IMMINENT_S, front_end_study
from worldstate_lab.metrics.intervals import middle, stratified_draws
from worldstate_lab.trials.listening import LEAST_PARTIALS, SIDES, pass_time_s
from worldstate_lab.trials.trial import Trial

from .recordings import CornerRecording, seven_microphones

# By figure of `front_end_study`. MUSIC is missing: it needs the raw channels, which spectra do not contain.
PAPER: Mapping[str, float] = {
    "bearing_srp_deg": 3.4,
    "bearing_gated_deg": 2.4,
    "prominence_in_view": 1.60,
    "prominence_in_silence": 1.18,
    "looming_auroc": 0.735,
    "looming_correlation": 0.07,
    "doppler_usable": 1.0,  # One of 41 approaches
}
DRAWS, DELAY_DRAWS = 500, 200
# In these recordings a spectrum shows the azimuth at which the camera detects a vehicle 0.4 to 0.5 s later.
DELAYS_HOPS = range(8)


def front_end_figures(
    trials: Sequence[Trial], recordings: Sequence[CornerRecording], rng: np.random.Generator
) -> dict[str, Any]:
    """Return each figure with its interval over recordings, and the paper's value.

    The trials are those of `hearing.heard` with a camera, whose boxes are the reference for the acoustic
    bearings. The tone of a pass is searched for in the first channel of the sound.
    """
    told = [_with_pass(*one) for one in zip(trials, recordings, strict=True)]
    study = front_end_study(told, rng, DRAWS)
    figures = {
        name: {"value": study.figures[name], "interval": study.intervals[name], "paper": paper}
        for name, paper in PAPER.items()
    }
    of = {"frames": study.frames, "approaches": study.approaches, "bearing_by_junction": study.by_site}
    delayed = {f"{hops * HOP_S:g}": _with_reference_after(told, hops, rng) for hops in DELAYS_HOPS}
    of |= {"bearing_by_delay_s": delayed, "hidden_sign": hidden_sign(trials, rng), "bound": _bound()}
    return figures | of


def _with_reference_after(trials: Sequence[Trial], hops: int, rng: np.random.Generator) -> dict[str, Any]:
    """Return the bearing errors against the boxes of a number of hops later, also by junction."""
    later = [_delayed(one, hops) for one in trials]
    study = front_end_study(later, rng, DELAY_DRAWS)
    figures = {name: study.figures[name] for name in ("bearing_srp_deg", "bearing_gated_deg")}
    sites = {site: one.median_deg for site, one in study.by_site.items()}
    return {**figures, "interval": study.intervals["bearing_srp_deg"], "by_junction": sites}


def _delayed(trial: Trial, hops: int) -> Trial:
    table = trial.hops
    reference = np.append(table.reference_rad, np.full(hops, np.nan))[hops:]
    return replace(trial, hops=table.replace(reference_rad=reference, srp_rad=table.bearing_rad))


def _with_pass(trial: Trial, recording: CornerRecording) -> Trial:
    """Add the time of the pass, the reason if its tone cannot be used, and missing MUSIC bearings."""
    about = {**trial.hops.about, "pass_s": None, "doppler": "no vehicle"}
    if not trial.hazard_free:
        about |= {"pass_s": pass_time_s(trial.truth), "doppler": _doppler(recording)}
    return replace(trial, hops=trial.hops.replace(music_rad=np.full(len(trial.hops), np.nan), about=about))


def _doppler(recording: CornerRecording) -> str:
    samples, rate_hz = recording.samples()
    track = track_fundamental(np.ascontiguousarray(samples[:, 0]), rate_hz)
    found = radial_speed(track, min_partials=LEAST_PARTIALS)
    return found.reason if isinstance(found, NotUsable) else ""


def hidden_sign(trials: Sequence[Trial], rng: np.random.Generator) -> dict[str, Any]:
    """Return how often a bearing has the sign of the majority at its junction, and of the vehicle's side.

    It uses the hops of the last three seconds before T0, and also returns the share of bearings to the left
    by junction.

    Examples
    --------
    >>> from worldstate.operations.recordings.hop_table import HopTable
    >>> columns = {"time_s": np.array([1.0, 1.1, 1.2]), "bearing_rad": np.array([0.7, 0.6, -0.7])}
    >>> trials = [Trial(HopTable(columns, side, side, 1.2, {"site": "SA1"})) for side in ("left", "right")]
    >>> found = hidden_sign(trials, np.random.default_rng(0))
    >>> [round(found[name]["value"], 2) for name in ("junction", "side")]
    [0.67, 0.5]
    """
    approaches = [one for one in trials if not one.hazard_free]
    left = [one.hops.bearing_rad[one.hops.before_sight(IMMINENT_S)] > 0.0 for one in approaches]
    drawn = stratified_draws([(one.label, one.site) for one in approaches], rng, DRAWS)
    samples = [_signs(approaches, left, rows) for rows in drawn]
    found = _signs(approaches, left, np.arange(len(approaches)))
    told = {
        name: {"value": value, "interval": middle(np.array([one[name] for one in samples]))}
        for name, value in found.items()
    }
    sites = sorted({one.site for one in approaches})
    shares = {site: float(_pooled(approaches, left, site).mean()) for site in sites}
    return {**told, "left_by_junction": shares, "hops": sum(map(len, left))}


def _signs(approaches: Sequence[Trial], left: Sequence[BoolArray], rows: IndexArray) -> dict[str, float]:
    chosen = [(approaches[i], left[i]) for i in rows.tolist()]
    some, signs = [one for one, _ in chosen], [sign for _, sign in chosen]
    by_site = [_pooled(some, signs, site) for site in sorted({one.site for one in some})]
    own = np.concatenate([sign == (SIDES[one.label] > 0) for one, sign in chosen])
    of_most = np.concatenate([sign == (sign.mean() >= 0.5) for sign in by_site])
    return {"junction": float(of_most.mean()), "side": float(own.mean())}


def _pooled(approaches: Sequence[Trial], left: Sequence[BoolArray], site: str) -> BoolArray:
    return np.concatenate([sign for one, sign in zip(approaches, left, strict=True) if one.site == site])


def _bound() -> dict[str, float]:
    """Return the spread of the seven microphones across the street, and how much it widens bearings."""
    moments = [one.horizontal_moment_m2 for one in (seven_microphones(), ovad_array())]
    return {"moment_m2": moments[0], "times_as_wide": float(np.sqrt(moments[1] / moments[0]))}
