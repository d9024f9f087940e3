"""A method's decisions on one recording, reduced to sums and samples from which every figure is computed."""

from functools import lru_cache

import numpy as np

from worldstate.abduction.cueing.risk_map import BINS
from worldstate.commissioning.stream_exam import visible_errors
from worldstate.ground.checks import check_shape, in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import BoolArray, FloatArray, IndexArray
from worldstate.ground.values import wrap_angle
from worldstate.operations.metrics.approach_table import LONGEST_LEAD_S, SLACK_S, onset_outcome, rising_edges
from worldstate.operations.recordings.hop_table import HOP_S, HopTable
from worldstate_lab.metrics.track_measures import gospa_bearing
from worldstate_lab.trials.trial import LEFT, NO_SIDE, RIGHT, Decisions, Trial

# The paper's horizons before line-of-sight entry.
HORIZONS_S = {"all": np.inf, "2s": 2.0, "1s": 1.0}
BEARING_COLUMNS = ("recording", "error_rad", "prominence")
_SIDES = {"left": LEFT, "right": RIGHT}


def alarm_counts(trial: Trial, said: Decisions) -> dict[str, float]:
    """Count the alarms of one recording, before T0 or in hazard-free time."""
    onsets = rising_edges(said.alarm)
    if trial.hazard_free:
        spent = {
            "free_onsets": onsets.size,
            "free_alarm_hops": said.alarm.sum(),
            "free_hops": said.alarm.size,
        }
        return {name: float(count) for name, count in spent.items()}
    t0_s = in_range(f"{trial.name}: line-of-sight entry", trial.t0_s, -np.inf, np.inf)
    lead_s = t0_s - said.time_s
    before = lead_s > SLACK_S
    # Times are relative to T0, so that the lead is bit-identical and matches its hop.
    outcome = onset_outcome(-lead_s[onsets], 0.0)
    first = onsets[lead_s[onsets] == outcome.lead_s]
    named = int(said.side[first[0]]) if outcome.detected else NO_SIDE
    return {
        "approaches": 1.0,
        "detected": float(outcome.detected),
        "lead_s": outcome.lead_s,
        "early_onsets": float(outcome.onsets_earlier),
        "side_right": float(named != NO_SIDE and named == _SIDES.get(trial.label)),
        "onsets_before": float(before[onsets].sum()),
        # Hops at which an onset would be counted: a random alarm falls on each of them with equal
        # probability.
        "window_s": float((before & (lead_s <= LONGEST_LEAD_S + SLACK_S)).sum()) * HOP_S,
        "before_s": float(before.sum()) * HOP_S,
    }


def awareness_counts(trial: Trial, said: Decisions) -> dict[str, float]:
    """Count the hops after T0 with a vehicle in view, and those of them with an alarm or any moving box."""
    clear = hops_in_view(trial, said)
    # Any moving box: in real recordings it is not known which vehicle a box shows.
    seen = np.zeros(len(said.time_s), bool)
    at = hop_of(trial.boxes.time_s, said.time_s)
    seen[at[(at >= 0) & np.asarray(trial.boxes.moving, bool)]] = True
    return {"clear_hops": float(clear.sum()), "aware_hops": float((clear & (said.alarm | seen)).sum())}


def hops_in_view(trial: Trial, said: Decisions) -> BoolArray:
    """Return a mask of the hops after T0 with a moving reference box in view, shape (n,)."""
    after = (not trial.hazard_free) & ~trial.hops.before_sight()
    return np.asarray(after & np.isfinite(trial.hops.reference_rad))


def hop_of(time_s: FloatArray, hops_s: FloatArray) -> IndexArray:
    """Return the nearest hop of each time, or -1 if it is more than half a hop away, shape (n,).

    Examples
    --------
    >>> hop_of(np.array([0.9, 1.04, 1.2]), np.array([1.0, 1.1]))
    array([-1,  0, -1])
    """
    middles = (hops_s[1:] + hops_s[:-1]) / 2.0
    nearest = np.searchsorted(middles, time_s)
    far = np.abs(hops_s[nearest] - time_s) > HOP_S / 2.0 + SLACK_S
    return np.where(far, -1, nearest)


def scored_windows(trial: Trial, values: FloatArray, horizon_s: float = np.inf) -> FloatArray:
    """Return the finite values in hazard-free time, or in the last `horizon_s` before T0, shape (m,)."""
    used = np.isfinite(values)
    if not trial.hazard_free:
        used &= trial.hops.before_sight(horizon_s)
    return values[used]


def window_counts(trial: Trial, said: Decisions) -> dict[str, float]:
    """Count the windows in each horizon, and sum the squared errors of the risk."""
    risk = scored_windows(trial, said.risk)
    counts = {
        f"windows_{name}": float(scored_windows(trial, said.score, horizon_s).size)
        for name, horizon_s in HORIZONS_S.items()
    }
    return counts | {"squared_error": float(np.sum((risk - (not trial.hazard_free)) ** 2))}


def probability_bins(risk: FloatArray) -> FloatArray:
    """Return number of windows, summed risk and summed label variance in each bin, shape (BINS, 3)."""
    index = np.minimum((risk * BINS).astype(np.intp), BINS - 1)
    sums = (None, risk, risk * (1.0 - risk))
    return np.stack([np.bincount(index, weights, BINS).astype(np.float64) for weights in sums], axis=-1)


def bearing_samples(trial: Trial, said: Decisions, recording: int) -> HopTable:
    """Return absolute bearing errors and prominences of the peaks for hops with a reference box in view."""
    use = hops_in_view(trial, said) & np.isfinite(said.bearing_rad)
    error_rad = np.abs(wrap_angle(said.bearing_rad[use] - trial.hops.reference_rad[use]))
    columns = (np.full(error_rad.size, recording), error_rad, trial.hops.prominence[use])
    return HopTable(dict(zip(BEARING_COLUMNS, columns, strict=True)))


def visible_counts(trial: Trial, said: Decisions) -> dict[str, float]:
    """Sum the true times to visible and the errors of the predicted ones over the hops before T0."""
    true_s = np.where(trial.hops.before_sight(), trial.t0_s - said.time_s, np.nan)
    errors = visible_errors(said.visible_s, true_s)
    if not errors.count:
        return {}
    known = true_s[np.isfinite(true_s) & np.isfinite(said.visible_s[:, 1])]
    return {
        "visible_hops": float(errors.count),
        "visible_squared": errors.count * errors.rmse_s**2,
        "visible_intervals": float(errors.intervals),
        "visible_inside": errors.intervals * errors.coverage if errors.intervals else 0.0,
        "visible_true": float(known.sum()),
        "visible_true_squared": float((known**2).sum()),
    }


def gospa_counts(trial: Trial, said: Decisions, by_tracks: bool) -> dict[str, float]:
    """Sum the GOSPA over the hops with a vehicle in view: of the tracks, or of the bearing during alarms."""
    stated = said.alarm & np.isfinite(said.bearing_rad)
    rows = _track_rows(said) if by_tracks else (np.flatnonzero(stated), said.bearing_rad[stated])
    estimates, there = _by_hop(*rows), _by_hop(*_truth_rows(trial, said))
    costs = [_gospa(estimates.get(hop, ()), vehicles) for hop, vehicles in there.items()]
    return {"gospa_rad": sum(costs), "gospa_hops": float(len(costs))}


# A method's bearing does not depend on seed or threshold, so most pairs recur. Each assignment takes 0.1 ms.
@lru_cache(maxsize=1 << 16)
def _gospa(estimates_rad: tuple[float, ...], truths_rad: tuple[float, ...]) -> float:
    return gospa_bearing(estimates_rad, truths_rad).total_rad


def _by_hop(hop: IndexArray, azimuth_rad: FloatArray) -> dict[int, tuple[float, ...]]:
    angles: dict[int, tuple[float, ...]] = {}
    for number, angle in zip(hop.tolist(), azimuth_rad.tolist(), strict=True):
        angles[number] = (*angles.get(number, ()), angle)
    return angles


def _track_rows(said: Decisions) -> tuple[IndexArray, FloatArray]:
    """Return hop and azimuth of every track, shape (n,) each."""
    hop = hop_of(said.tracks.time_s, said.time_s)
    return hop[hop >= 0], said.tracks.azimuth_rad[hop >= 0]


def _truth_rows(trial: Trial, said: Decisions) -> tuple[IndexArray, FloatArray]:
    """Return hop and azimuth of every vehicle in view, shape (n,) each."""
    hop = hop_of(trial.truth.time_s, said.time_s)
    # A camera faster than the hop rate shows a vehicle several times per hop.
    _, first = np.unique(np.stack([hop, trial.truth.vehicle]), axis=1, return_index=True)
    use = np.sort(first[hop[first] >= 0])
    use = use[trial.truth.in_view[use].astype(bool)]
    return hop[use], trial.truth.azimuth_rad[use]


def check_decisions(trial: Trial, said: Decisions) -> None:
    """Raise an error if decisions have other hops than the recording, or a risk is not a probability."""
    check_shape(f"{trial.name}: time_s of the decisions", said.time_s.shape, trial.hops.time_s.shape)
    if ((said.risk < 0.0) | (said.risk > 1.0)).any():
        raise InvalidArgumentError(f"{trial.name}: risk: expected numbers in [0, 1]")
