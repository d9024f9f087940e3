"""What a method said of one recording, reduced to sums and samples from which every figure follows."""

import numpy as np

from worldstate.abduction.cueing.calibration_error import BINS
from worldstate.ground.checks import check_shape, in_range
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import BoolArray, FloatArray, IndexArray
from worldstate.ground.values import wrap_angle
from worldstate.operations.recordings.advisories import LONGEST_LEAD_S, detection, rising_edges
from worldstate.operations.recordings.hop_stream import HOP_S
from worldstate.operations.recordings.hop_table import HopTable

from .trial import LEFT, NO_SIDE, RIGHT, Decisions, Trial

# Stamps are whole nanoseconds and T0 is a camera frame: a lead is exact to this many digits of a second.
_DIGITS = 6
HORIZONS_S = {"all": np.inf, "2s": 2.0, "1s": 1.0}
BEARING_COLUMNS = ("recording", "error_rad", "prominence")
VISIBLE_COLUMNS = ("recording", "low_s", "best_s", "high_s", "true_s")
_SIDES = {"left": LEFT, "right": RIGHT}


def alarm_counts(trial: Trial, said: Decisions) -> dict[str, float]:
    """Count what the alarms of one recording say, before T0 or in hazard-free time."""
    onsets = rising_edges(said.alarm)
    if trial.hazard_free:
        spent = {
            "free_onsets": onsets.size,
            "free_alarm_hops": said.alarm.sum(),
            "free_hops": said.alarm.size,
        }
        return {name: float(count) for name, count in spent.items()}
    t0_s = in_range(f"{trial.name}: line-of-sight entry", trial.t0_s, -np.inf, np.inf)
    lead_s = np.round(t0_s - said.time_s, _DIGITS)
    outcome = detection((-lead_s[onsets]).tolist(), 0.0)
    first = onsets[lead_s[onsets] == outcome.lead_time_s]
    named = int(said.side[first[0]]) if outcome.detected else NO_SIDE
    return {
        "approaches": 1.0,
        "detected": float(outcome.detected),
        "lead_s": outcome.lead_time_s or 0.0,
        "early_onsets": float(outcome.false_advisories_before),
        "side_right": float(named != NO_SIDE and named == _SIDES.get(trial.label)),
        "onsets_before": float((lead_s[onsets] > 0.0).sum()),
        # Hops at which an onset would be counted: an alarm at random has one of them with equal chances.
        "window_s": float(((lead_s > 0.0) & (lead_s <= LONGEST_LEAD_S)).sum()) * HOP_S,
        "before_s": float((lead_s > 0.0).sum()) * HOP_S,
    }


def awareness_counts(trial: Trial, said: Decisions) -> dict[str, float]:
    """Count hops after T0 with a vehicle in view, and those with an alarm or any moving box."""
    clear = in_view(trial, said)
    seen = np.zeros(len(said.time_s), bool)
    at = hop_of(trial.boxes.time_s, said.time_s)
    seen[at[(at >= 0) & np.asarray(trial.boxes.moving, bool)]] = True
    return {"clear_hops": float(clear.sum()), "aware_hops": float((clear & (said.alarm | seen)).sum())}


def in_view(trial: Trial, said: Decisions) -> BoolArray:
    """Hops of an approach after T0 with a moving reference box in view, shape (n,)."""
    after = (not trial.hazard_free) & ~trial.hops.before_sight()
    return np.asarray(after & np.isfinite(trial.hops.reference_rad))


def hop_of(time_s: FloatArray, hops_s: FloatArray) -> IndexArray:
    """Return the nearest hop of each time, -1 where it is more than half a hop away, shape (n,).

    Examples
    --------
    >>> hop_of(np.array([0.9, 1.04, 1.2]), np.array([1.0, 1.1]))
    array([-1,  0, -1])
    """
    middles = (hops_s[1:] + hops_s[:-1]) / 2.0
    nearest = np.searchsorted(middles, time_s)
    far = np.abs(hops_s[nearest] - time_s) > HOP_S / 2.0 + 10.0**-_DIGITS
    return np.where(far, -1, nearest)


def scored_windows(
    trial: Trial, said: Decisions, values: FloatArray, horizon_s: float = np.inf
) -> FloatArray:
    """Return the known values of hazard-free time, or of the last `horizon_s` before T0, shape (m,)."""
    used = np.isfinite(values)
    if not trial.hazard_free:
        used &= trial.hops.before_sight(horizon_s)
    return values[used]


def probability_bins(risk: FloatArray) -> FloatArray:
    """Return windows, summed risk and summed variance of its labels in each bin, shape (BINS, 3)."""
    index = np.minimum((risk * BINS).astype(np.intp), BINS - 1)
    sums = (None, risk, risk * (1.0 - risk))
    return np.stack([np.bincount(index, weights, BINS).astype(np.float64) for weights in sums], axis=-1)


def bearing_samples(trial: Trial, said: Decisions, recording: int) -> HopTable:
    """Return absolute errors beside the prominence of their peaks, while a reference box is in view."""
    use = in_view(trial, said) & np.isfinite(said.bearing_rad)
    error_rad = np.abs(wrap_angle(said.bearing_rad[use] - trial.hops.reference_rad[use]))
    columns = (np.full(error_rad.size, recording), error_rad, trial.hops.prominence[use])
    return HopTable(dict(zip(BEARING_COLUMNS, columns, strict=True)))


def visible_samples(trial: Trial, said: Decisions, recording: int) -> HopTable:
    """Return stated and true time to visible of the hops before T0 at which it is stated."""
    use = trial.hops.before_sight() & np.isfinite(said.visible_s[:, 1])
    true_s = np.round(trial.t0_s - said.time_s[use], _DIGITS)
    columns = (np.full(true_s.size, recording), *said.visible_s[use].T, true_s)
    return HopTable(dict(zip(VISIBLE_COLUMNS, columns, strict=True)))


def check_decisions(trial: Trial, said: Decisions) -> None:
    """Refuse an answer of other hops than those of the recording, and a risk that is no probability."""
    check_shape(f"{trial.name}: time_s of the decisions", said.time_s.shape, trial.hops.time_s.shape)
    if ((said.risk < 0.0) | (said.risk > 1.0)).any():
        raise InvalidArgumentError(f"{trial.name}: risk: expected numbers in [0, 1]")
