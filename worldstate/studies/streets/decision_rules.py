"""The decision rules of Table I over simulated recordings, thresholds set on other folds."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.abduction.cueing.cueing_policy import sustained_alarm
from worldstate.abduction.cueing.neyman_pearson import neyman_pearson_threshold
from worldstate.abduction.cueing.risk_map import fit_isotonic
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import BoolArray, FloatArray, IndexArray
from worldstate.operations.recordings.advisories import detection, rising_edges
from worldstate.operations.recordings.hop_table import HopTable

# By recording, as in the paper.
FOLDS = 5
# k is chosen among these on the calibration folds; every hop of it costs a tenth of a second of lead.
SUSTAIN_CHOICES = (2, 3, 4, 5)
# Budgets of the operating curve; the paper's 0.02 and 0.05 among them.
ALPHAS = (0.0, 0.005, 0.01, 0.02, 0.035, 0.05, 0.075, 0.1, 0.15, 0.2)
ALPHA, ALPHA_LOOSE = 0.02, 0.05


@dataclass(frozen=True, slots=True, eq=False)
class RuleOutcome:
    """What one rule did in each of R recordings."""

    detected: BoolArray  # shape (R,): An onset within 5 s before T0; False without a vehicle
    lead_s: FloatArray  # shape (R,): From that onset to T0; NaN where there is none
    false_onsets: IndexArray  # shape (R,): Onsets in a hazard-free recording; 0 in the others


@dataclass(frozen=True, slots=True, eq=False)
class RuleScores:
    """All rules over all recordings."""

    recordings: tuple[HopTable, ...]  # Scored ones
    vision: RuleOutcome  # The camera alone: something that moves is detected
    published: RuleOutcome  # The argmax is left or right, at any window and over k windows
    sustained: RuleOutcome
    ours: dict[float, RuleOutcome]  # Eq. (6) at or above gamma(alpha) over k windows, for every budget
    sustain_hops: tuple[int, ...]  # k of each fold
    risk: tuple[FloatArray, ...]  # Calibrated risk of each window of each recording, by the other folds


def score_rules(recordings: Sequence[HopTable], rng: np.random.Generator) -> RuleScores:
    """Set k, gamma(alpha) and the risk map on four folds, apply them to the fifth, five times."""
    # k maximises the share of approaches detected less the share of hazard-free recordings with an alarm,
    # both on the calibration folds; the smaller k of equals.
    fold_of = deal(recordings, rng)
    n = len(recordings)
    sustained: list[BoolArray] = [np.zeros(0, bool)] * n
    ours = {alpha: list(sustained) for alpha in ALPHAS}
    risk: list[FloatArray] = [np.zeros(0)] * n
    chosen = []
    for fold in range(int(fold_of.max()) + 1):
        calibration = [r for r, f in zip(recordings, fold_of, strict=True) if f != fold]
        hops = _best_sustain(calibration)
        chosen.append(hops)
        gammas = {alpha: _gamma(calibration, alpha, hops) for alpha in ALPHAS}
        risk_map = fit_isotonic(*labelled_windows(calibration))
        for i in np.flatnonzero(fold_of == fold).tolist():
            sustained[i] = sustained_alarm(recordings[i].argmax_is_side, hops)
            risk[i] = risk_map(recordings[i].statistic)
            for alpha, gamma in gammas.items():
                ours[alpha][i] = sustained_alarm(recordings[i].statistic >= gamma, hops)
    return RuleScores(
        recordings=tuple(recordings),
        vision=_outcome(recordings, [np.isfinite(r.reference_rad) for r in recordings]),
        published=_outcome(recordings, [r.argmax_is_side for r in recordings]),
        sustained=_outcome(recordings, sustained),
        ours={alpha: _outcome(recordings, alarms) for alpha, alarms in ours.items()},
        sustain_hops=tuple(chosen),
        risk=tuple(risk),
    )


def deal(recordings: Sequence[HopTable], rng: np.random.Generator, folds: int = FOLDS) -> IndexArray:
    """Deal recordings to folds so that each holds its share of every approach at every site, shape (R,)."""
    free = np.array([recording.hazard_free for recording in recordings])
    most = min(int(free.sum()), int((~free).sum()), folds)
    if most < 2:
        got = f"{(~free).sum()} approaches and {free.sum()} without a vehicle"
        raise InvalidArgumentError(f"recordings: expected two of each kind or more, got {got}")
    fold_of = np.zeros(len(recordings), np.intp)
    for kind in (free, ~free):
        members = np.flatnonzero(kind).tolist()
        keys = [(recordings[i].label, recordings[i].about["site"], rng.random()) for i in members]
        # Dealing goes on where the last stratum stopped, so that no fold collects the remainders.
        order = sorted(range(len(members)), key=keys.__getitem__)
        fold_of[[members[i] for i in order]] = np.arange(len(members)) % most
    return fold_of


def labelled_windows(recordings: Sequence[HopTable]) -> tuple[FloatArray, BoolArray]:
    """Statistic and hazard label of all windows up to T0 and all hazard-free ones, shape (n,) each."""
    scores, labels = [], []
    for recording in recordings:
        used = recording.statistic if recording.hazard_free else recording.statistic[recording.before_sight()]
        scores.append(used)
        labels.append(np.full(used.size, not recording.hazard_free))
    return np.concatenate(scores), np.concatenate(labels)


def _gamma(calibration: Sequence[HopTable], alpha: float, sustain_hops: int) -> float:
    calm = [recording.statistic for recording in calibration if recording.hazard_free]
    return neyman_pearson_threshold(calm, alpha, sustain_hops)


def _best_sustain(calibration: Sequence[HopTable]) -> int:
    free = np.array([recording.hazard_free for recording in calibration])
    gain = {}
    for hops in SUSTAIN_CHOICES:
        done = _outcome(calibration, [sustained_alarm(r.argmax_is_side, hops) for r in calibration])
        gain[hops] = float(done.detected[~free].mean() - (done.false_onsets[free] > 0).mean())
    return max(SUSTAIN_CHOICES, key=lambda hops: (gain[hops], -hops))


def _outcome(recordings: Sequence[HopTable], alarms: Sequence[BoolArray]) -> RuleOutcome:
    leads, false = np.full(len(recordings), np.nan), np.zeros(len(recordings), np.intp)
    for i, (recording, alarm) in enumerate(zip(recordings, alarms, strict=True)):
        onsets = rising_edges(alarm)
        if recording.hazard_free:
            false[i] = onsets.size
            continue
        lead = detection(recording.time_s[onsets].tolist(), recording.t0_s).lead_time_s
        leads[i] = np.nan if lead is None else lead
    return RuleOutcome(np.isfinite(leads), leads, false)
