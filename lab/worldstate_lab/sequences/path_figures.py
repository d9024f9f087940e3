"""Every figure of one path over the recordings of street corners, with the camera and with sound alone."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from worldstate.abduction.cueing.cueing_policy import neyman_pearson_threshold
from worldstate.abduction.sequence.sequence_model import HORIZONS_S, SequencePosterior
from worldstate.adapters.datasets.feature_table import read_features, read_ids
from worldstate.adapters.files.file_io import read_json
from worldstate.frontend.settings import HOP_RATE_HZ
from worldstate.ground.typing import FloatArray
from worldstate.simulation.dataset.recording import FULL_SCALE_PA
from worldstate_lab.evaluation.front_end_study import front_end_study
from worldstate_lab.evaluation.protocols import METHODS, STATIC, ProtocolRun, run_protocol
from worldstate_lab.evaluation.reduction import HORIZONS_S as WINDOWS_S
from worldstate_lab.evaluation.scores import Score
from worldstate_lab.methods.acoustic_rules import CalibratedCue, ShippedChain
from worldstate_lab.methods.line_of_sight import OcSortRecovery, RadarFieldOfView, VisionOnly
from worldstate_lab.metrics.intervals import stratified_draws
from worldstate_lab.passes.pass_outcomes import above_quiet_db, sound_level_db
from worldstate_lab.trials.classification import SIDE_COLUMNS, Classifiers, posteriors
from worldstate_lab.trials.listening import pass_time_s, tone_refusal
from worldstate_lab.trials.trial import Decide, Decisions, Method, Trial

from .hearing import Chain, heard
from .recordings import NANODET_BOXES, CornerRecording
from .scores import LIMITS, Row, alarm_row, calibration, curve, leads, log_odds, smoothed, with_intervals
from .tracking import Tracked, tracked

SEEDS = 5  # The same number as in `table --full`


@dataclass(frozen=True, slots=True, eq=False)
class PathRun:
    """Recordings processed on one path; all sequences have the same order."""

    recordings: Sequence[CornerRecording]
    seen: Sequence[Trial]  # Trials with the camera, if there is one
    alone: Sequence[Trial]  # Trials with sound alone
    followed: Sequence[Tracked | None]  # None without a camera, because no vehicle in view is known


def heard_every_way(chain: Chain, recording: CornerRecording) -> tuple[Trial, Trial, Tracked | None]:
    """Return a recording processed with the camera and with sound alone, and its tracking, if filmed."""
    seen = _with_meter(heard(chain, recording), recording)
    if chain.boxes is None:
        return seen, seen, None
    alone = _with_meter(heard(replace(chain, boxes=None), recording), recording)
    return seen, alone, tracked(chain, recording)


def _with_meter(trial: Trial, recording: CornerRecording) -> Trial:
    """Add `meter_db`, the level of channel 1 above its quiet level so far, and `leads_from_s`."""
    sound, rate_hz = recording.samples()
    hops = int(len(sound) / rate_hz * HOP_RATE_HZ)
    pressure_pa = FULL_SCALE_PA * sound[: round(hops * rate_hz / HOP_RATE_HZ), 0].astype(np.float64)
    above = above_quiet_db(sound_level_db(pressure_pa, rate_hz, hops))
    at = np.round(trial.hops.time_s * HOP_RATE_HZ).astype(np.intp) - 1
    about = {**trial.hops.about, "leads_from_s": recording.t0_s}
    return replace(trial, hops=trial.hops.replace(meter_db=above[np.minimum(at, hops - 1)], about=about))


@dataclass(frozen=True, slots=True)
class LoudnessMeter:
    """Alarm rule: the sound level exceeds the earlier level of the place by a threshold."""

    name: str = "loudness meter .02"
    alpha: float = 0.02

    def fit(self, calibration: Sequence[Trial], rng: np.random.Generator, /) -> Decide:
        """Set the threshold in decibels on hazard-free calibration recordings."""
        calm = [one.hops.meter_db for one in calibration if one.hazard_free]
        least_db = neyman_pearson_threshold(calm, self.alpha)

        def decide(trial: Trial) -> Decisions:
            above = trial.hops.meter_db
            return Decisions.of(trial.hops.time_s, above >= least_db, score=above)

        return decide


_SHIPPED, _PUBLISHED = "shipped window .02", "proposed .02"
_OWN: tuple[Method, ...] = (
    ShippedChain("world-state advisory", "filtered"),
    ShippedChain("shipped model", "shipped"),
    CalibratedCue(_SHIPPED, 0.02, evidence="shipped"),
    LoudnessMeter(),
)
_SIGHT: tuple[Method, ...] = (
    VisionOnly(),
    RadarFieldOfView(),
    # The filter of OVAD's authors would reject nearly every box of NanoDet.
    *(OcSortRecovery(reading, keep=NANODET_BOXES) for reading in ("stock", "coasting")),
)
_TABLE = tuple(
    one
    for one in METHODS
    if getattr(one, "evidence", "") == "published" and not getattr(one, "absence", False)
)


def classifiers_of(features: Path, lists: Sequence[Path]) -> Classifiers:
    """Return the published classifier, trained on released windows except those of the listed recordings."""
    # All listed recordings, present or not: withheld recordings must remain usable for tests too.
    return Classifiers(read_features(features).without(frozenset().union(*map(read_ids, lists))))


BySide = Callable[[Trial], FloatArray]


@dataclass(frozen=True, slots=True)
class HopScore:
    """A score per hop. Of two sides the larger value is used, and their difference gives the side."""

    name: str
    seen: bool  # Whether it uses the trials with the camera
    of: BySide  # shape (n,) or (n, 2)
    sides: BySide | None = None  # shape (n, 2): Values that give the side if the score itself has no sides

    def figures(self, path: PathRun, rng: np.random.Generator) -> dict[str, Any]:
        """Return the figures of the score, and of right minus left if it has sides."""
        trials = path.seen if self.seen else path.alone
        found, sides = (list(map(of, trials)) for of in (self.of, self.sides or self.of))
        right = None if sides[0].ndim == 1 else [one[:, 1] - one[:, 0] for one in sides]
        scores = [one if one.ndim == 1 else one.max(axis=1) for one in found]
        return score_figures(trials, scores, right, rng)


def score_figures(
    trials: Sequence[Trial],
    scores: Sequence[FloatArray],
    right: Sequence[FloatArray] | None,
    rng: np.random.Generator,
) -> dict[str, Any]:
    """Return the lead times of a score, shape (n,) per trial, and the curves over its thresholds."""
    return {
        "leads": leads(trials, scores, right, rng),
        **{f"at_{limited}": curve(trials, scores, limited, rng) for limited in LIMITS},
    }


_MEAN_HOPS = 20  # Two seconds
_LEAST_NATS = -20.0  # Value if the window gives no sides


def _window(trial: Trial) -> FloatArray:
    return np.asarray(posteriors(trial, "shipped")[:, SIDE_COLUMNS].sum(axis=1))


def _unseen(trial: Trial) -> FloatArray:
    """Return P(hidden), given that a camera has ruled out a vehicle in view."""
    hidden, none = _window(trial), posteriors(trial, "shipped")[:, -1]
    return hidden / (hidden + none)


def _ratios(trial: Trial) -> FloatArray:
    return np.nan_to_num(trial.hops.side_nats, nan=_LEAST_NATS)


def _mean_ratios(trial: Trial) -> FloatArray:
    sums = np.cumsum(_ratios(trial), axis=0)
    sums[_MEAN_HOPS:] -= sums[:-_MEAN_HOPS].copy()
    return np.asarray(sums / np.minimum(np.arange(1, len(sums) + 1), _MEAN_HOPS)[:, None])


def _sequence(trial: Trial) -> FloatArray:
    within = SequencePosterior(trial.hops.groups, 0.0).within()
    return np.nan_to_num(within[..., HORIZONS_S.index(3.0)])


def _decision(trial: Trial) -> FloatArray:
    """Return the mean over 0.3 s of the log-odds of the published chance to come into view within 3 s."""
    # `compared_nats`, which the alarm compares with its threshold, has another scale in the first second of
    # every recording, before the sequence model has input. In the curves those hops would count as early
    # warnings.
    return smoothed(log_odds(np.nan_to_num(trial.hops.within[..., HORIZONS_S.index(3.0)])))


_risk, _compared = attrgetter("hops.risk"), attrgetter("hops.compared_nats")
PRODUCT = "product, with camera"
DECISION = "decision value, sound alone"
SCORES = (
    HopScore("window alone", False, _window, _ratios),
    HopScore("window and absence", True, _unseen, _ratios),
    HopScore("sequence by itself", False, _sequence),
    HopScore("product, sound alone", False, _risk),
    HopScore(PRODUCT, True, _risk),
    HopScore(DECISION, False, _decision),
    HopScore("decision value, with camera", True, _decision),
    HopScore("compared value, sound alone", False, _compared),
    HopScore("compared value, with camera", True, _compared),
    HopScore("side ratio", False, _ratios),
    HopScore("side ratio, mean of 2 s", False, _mean_ratios),
    HopScore("loudness meter", False, attrgetter("hops.meter_db")),
)


def path_figures(path: PathRun, classifiers: Classifiers | None, seed: int) -> dict[str, Any]:
    """Return every figure of a path; without classifiers, rows of the published classifier are missing."""
    rng = np.random.default_rng(seed)
    methods = (*_OWN, *_SIGHT, *(_TABLE if classifiers else ()))
    run = run_protocol(STATIC, path.seen, methods, classifiers, range(seed, seed + SEEDS))
    scores = {one.name: one.figures(path, rng) for one in SCORES}
    return {
        "recordings": len(path.seen),
        "stands_on": run.stands_on,
        "camera": any(one.hops.about["camera"] for one in path.seen),
        "rows": _rows(run, path, rng),
        "leads": scores[PRODUCT]["leads"],
        "at_onsets": scores[DECISION]["at_onsets"],
        **_window_figures(run, _SHIPPED, rng),
        "published": _window_figures(run, _PUBLISHED, rng) if _PUBLISHED in run.decisions else None,
        "calibration": calibration(path.seen, rng),
        "calibration_sound_alone": calibration(path.alone, rng),
        "scores": scores,
    }


def _rows(run: ProtocolRun, path: PathRun, rng: np.random.Generator) -> dict[str, Row]:
    """Return the row of every method, and of the shipped alarm with sound alone."""
    alone = [[one.chains["filtered"].alarm for one in path.alone]]
    rows = {"world-state advisory, sound alone": alarm_row(path.alone, alone, rng)}
    for name, passes in run.decisions.items():
        rows[name] = alarm_row(run.trials, [[one.alarm for one in said] for said in passes], rng)
    return rows


def _window_figures(run: ProtocolRun, method: str, rng: np.random.Generator) -> dict[str, Row]:
    """Return AUROC by horizon before T0, and ECE of the raw score and of the risk over five folds."""
    score = Score.of(run.trials, run.decisions[method])
    draws = stratified_draws(score.strata, rng)
    drawn = score.draws(np.vstack([np.arange(len(run.trials)), draws]))
    horizons = with_intervals({name: drawn[f"auroc_{name}"] for name in WINDOWS_S})
    return {"horizons": horizons, "risk": with_intervals({name: drawn[name] for name in ("ece_raw", "ece")})}


# By name in a path's figures: the name of the same figure in the simulated exam of a model.
_EXAM = {
    **{f"auroc_{lead}": f"auroc_{lead}s_before" for lead in ("1", "2", "3")},
    "warned": "detected",
    "lead_s_missed_0": "lead_missed_as_0_s",
    "alarms_per_hour": "onsets_per_hour",
    "brier_skill": "skill_2s",
    "ece": "ece_2s",
}


def simulated_exam(path: Path) -> dict[str, float | None]:
    """Return those figures of a path that the simulated exam of a model contains too."""
    exam: Any = read_json(path, "exam of a model")
    return {name: exam.get(other) for name, other in _EXAM.items()}


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
DRAWS = 500


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
    return figures | of


def _with_pass(trial: Trial, recording: CornerRecording) -> Trial:
    """Add the time of the pass, the reason if its tone cannot be used, and missing MUSIC bearings."""
    about = {**trial.hops.about, "pass_s": None, "doppler": "no vehicle"}
    if not trial.hazard_free:
        samples, rate_hz = recording.samples()
        about |= {"pass_s": pass_time_s(trial.truth), "doppler": tone_refusal(samples[:, 0], rate_hz)}
    return replace(trial, hops=trial.hops.replace(music_rad=np.full(len(trial.hops), np.nan), about=about))
