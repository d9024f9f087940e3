"""What became of every vehicle of a stream in the world-state: warned of, followed, lost, confused.

An advisory belongs to an approach from five seconds before the first T0 on. Identity is kept where the entity
that was hidden on the vehicle's side at T0 is the one seen at its place a second later.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from worldstate.abduction.cueing.calibration_error import brier_skill, expected_calibration_error
from worldstate.abduction.sequence.sequence_model import HORIZONS_S, LONGEST_S
from worldstate.ground.typing import BoolArray, FloatArray
from worldstate.ground.values import wrap_angle
from worldstate.operations.commissioning.heard_stream import HeardStream
from worldstate.operations.commissioning.stream_exam import AFTER_S, StreamApproach, approaches
from worldstate.operations.commissioning.stream_labels import StreamTruth
from worldstate.operations.metrics.time_to_visible import visible_errors
from worldstate.operations.recordings.advisories import (
    LONGEST_LEAD_S,
    SECONDS_PER_HOUR,
    SLACK_S,
    rising_edges,
)
from worldstate.operations.recordings.hop_stream import HOP_S
from worldstate.state import Entity

from .followed_stream import FollowedStream

EXISTS, NEAR_RAD, SEEN_AFTER_S = 0.5, np.radians(10.0), 1.0


@dataclass(frozen=True, slots=True, eq=False)
class PassedStream:
    """A stream, its truth, and what the filter believed of it."""

    heard: HeardStream
    truth: StreamTruth
    followed: FollowedStream

    @property
    def hazard_free(self) -> bool:
        """Whether nobody comes out of a hidden arm."""
        return not self.heard.vehicles.hazard.any()


@dataclass(frozen=True, slots=True)
class PassOutcome:
    """One approach."""

    approach: StreamApproach
    lead_s: float  # 0 where no advisory came before T0
    onsets: int  # Of advisories, from five seconds before T0 to T0
    own_side: bool
    other_side: bool
    every_side: bool
    hidden_before: int  # Different entities believed hidden before T0
    identity: bool | None  # None where nobody was believed there, or nobody was seen
    onsets_after: int


def outcomes(stream: PassedStream) -> list[PassOutcome]:
    """Return the outcome of every approach that lies whole within the stream."""
    time_s, alarms = stream.followed.time_s, stream.followed.advisory
    any_side = np.asarray(alarms.any(axis=1))
    onsets_s = time_s[rising_edges(any_side)]
    found = []
    for one in approaches(stream.heard):
        first, last = one.entries_s[0], max(one.entries_s)
        if first - LONGEST_LEAD_S < time_s[0] or last + AFTER_S > time_s[-1]:
            continue
        before = _before(time_s, first)
        alarmed_s = time_s[before & any_side]
        by_side = np.asarray(alarms[before].any(axis=0))
        hidden = {
            entity.id
            for hop in np.flatnonzero(_before(time_s, last))
            for side in (0, 1)
            for entity in stream.followed.hidden(int(hop), side, EXISTS)
        }
        found.append(
            PassOutcome(
                approach=one,
                lead_s=first - float(alarmed_s[0]) if alarmed_s.size else 0.0,
                onsets=int(((onsets_s > first - LONGEST_LEAD_S) & (onsets_s < first)).sum()),
                own_side=bool(by_side[one.sides[0]]),
                other_side=bool(by_side[1 - one.sides[0]]),
                every_side=all(
                    alarms[_before(time_s, entry), side].any()
                    for entry, side in zip(one.entries_s, one.sides, strict=True)
                ),
                hidden_before=len(hidden),
                identity=_identity(stream, one),
                onsets_after=int(((onsets_s >= last) & (onsets_s < last + AFTER_S)).sum()),
            )
        )
    return found


def _before(time_s: FloatArray, entry_s: float) -> BoolArray:
    return np.asarray((time_s > entry_s - LONGEST_LEAD_S) & (time_s < entry_s - SLACK_S))


def _identity(stream: PassedStream, one: StreamApproach) -> bool | None:
    """Tell whether the entity hidden on the first vehicle's side at T0 is the one seen in its place later."""
    followed, entry_s = stream.followed, one.entries_s[0]
    hop = int(np.searchsorted(followed.time_s, entry_s - SLACK_S)) - 1
    hidden = followed.hidden(hop, one.sides[0])
    later = int(np.searchsorted(followed.time_s, entry_s + SEEN_AFTER_S))
    seen = _seen_at(stream, _vehicle(stream.heard, entry_s), later)
    if not hidden or seen is None:
        return None
    return seen.id in {entity.id for entity in hidden}


def _vehicle(heard: HeardStream, entry_s: float) -> int:
    """Return the number of the vehicle that came into view at a time."""
    return int(heard.vehicles.vehicle[np.nanargmin(np.abs(heard.vehicles.entry_s - entry_s))])


def true_azimuth(heard: HeardStream, vehicle: int, time_s: float) -> float | None:
    """Return the azimuth of a vehicle, None where it is not there."""
    rows = heard.rows
    at = np.flatnonzero((rows.vehicle == vehicle) & (np.abs(rows.time_s - time_s) < 0.5 * HOP_S + SLACK_S))
    return None if not at.size else float(np.arctan2(rows.y_m[at[0]], rows.x_m[at[0]]))


def _seen_at(stream: PassedStream, vehicle: int, hop: int) -> Entity | None:
    azimuth = true_azimuth(stream.heard, vehicle, float(stream.followed.time_s[hop]))
    if azimuth is None:
        return None
    near = [
        (abs(wrap_angle(one.azimuth_rad - azimuth)), one.id, one)
        for one in stream.followed.entities[hop]
        if one.status == "visible" and one.existence_probability >= EXISTS
    ]
    distance, _, nearest = min(near, default=(np.inf, "", None))
    return nearest if distance <= NEAR_RAD else None


def pass_figures(streams: Sequence[PassedStream]) -> dict[str, float | int | None]:
    """Return the figures of some streams together, ready for a table and for JSON."""
    told = [one for stream in streams for one in outcomes(stream)]
    loud = [one for one in told if not one.approach.quiet]
    flows = {flow: [one for one in loud if one.approach.flow == flow] for flow in ("single", "both", "queue")}
    judged = [one.identity for one in loud if one.identity is not None]
    found: dict[str, float | int | None] = {
        "approaches": len(loud),
        "detected": _mean([one.lead_s > 0.0 for one in loud]),
        "lead_missed_as_0_s": _mean([one.lead_s for one in loud]),
        "onsets_per_approach": _mean([one.onsets for one in loud if one.lead_s > 0.0]),
        "both_sides_found": _mean([one.every_side for one in flows["both"]]),
        "other_side_too": _mean([one.other_side for one in flows["single"]]),
        "wrong_side_only": _mean([one.other_side and not one.own_side for one in flows["single"]]),
        "phantom_third": _mean([one.hidden_before > 2 for one in flows["both"]]),
        "identity_judged": len(judged),
        "identity_kept": _mean(judged),
        "onset_after_pass": _mean([one.onsets_after > 0 for one in flows["single"]]),
    }
    return found | _false_alarms(streams) | _ahead(streams) | _forecast(streams) | _bearing(streams)


def _false_alarms(streams: Sequence[PassedStream]) -> dict[str, float | None]:
    quiet = [np.asarray(one.followed.advisory.any(axis=1)) for one in streams if one.hazard_free]
    hours = sum(map(len, quiet)) * HOP_S / SECONDS_PER_HOUR
    if not hours:
        return {"hazard_free_hours": 0.0, "onsets_per_hour": None, "hazard_free_share": None}
    onsets = sum(rising_edges(one).size for one in quiet) / hours
    share = _mean(np.concatenate(quiet))
    return {"hazard_free_hours": hours, "onsets_per_hour": onsets, "hazard_free_share": share}


def _ahead(streams: Sequence[PassedStream]) -> dict[str, float | int | None]:
    """Return how often a vehicle first seen straight ahead takes the identity of a hidden one."""
    taken = []
    for stream in streams:
        vehicles = stream.heard.vehicles
        for number in vehicles.vehicle[~vehicles.hazard].tolist():
            rows = stream.heard.rows
            seen_s = rows.time_s[(rows.vehicle == number) & rows.in_view]
            if not seen_s.size:
                continue
            first = int(np.searchsorted(stream.followed.time_s, seen_s[0] - SLACK_S))
            later = int(np.searchsorted(stream.followed.time_s, seen_s[0] + SEEN_AFTER_S))
            if first < 1 or later >= len(stream.followed.time_s):
                continue
            entity = _seen_at(stream, number, later)
            before = {one.id for side in (0, 1) for one in stream.followed.hidden(first - 1, side)}
            if entity is not None:
                taken.append(entity.id in before)
    return {"seen_ahead": len(taken), "took_hidden_identity": _mean(taken)}


def _forecast(streams: Sequence[PassedStream]) -> dict[str, float | None]:
    within = np.concatenate([one.followed.within[:, :, HORIZONS_S.index(2.0)].ravel() for one in streams])
    coming_s = np.concatenate([one.truth.coming_s.ravel() for one in streams])
    said = np.isfinite(within)
    stated = np.concatenate([one.followed.time_to_visible_s.reshape(-1, 3) for one in streams])
    comes = coming_s <= LONGEST_S
    errors = visible_errors(stated[comes], coming_s[comes])
    return {
        "skill_2s": brier_skill(within[said], coming_s[said] <= 2.0),
        "ece_2s": expected_calibration_error(within[said], coming_s[said] <= 2.0),
        "time_rmse_of_constant": errors.rmse_s / errors.constant_rmse_s,
        "time_coverage": errors.coverage,
        "time_width_s": errors.width_s,
        "times_stated": _mean(np.isfinite(stated[comes][:, 1])),
    }


def _bearing(streams: Sequence[PassedStream]) -> dict[str, float | int | None]:
    """Return the squared error of hidden azimuths over their variance, in the three seconds before T0."""
    squares = []
    for stream in streams:
        for one in approaches(stream.heard):
            if one.quiet:
                continue
            vehicle = _vehicle(stream.heard, one.entries_s[0])
            lead = stream.followed.time_s - one.entries_s[0]
            for hop in np.flatnonzero((lead > -3.0) & (lead < -SLACK_S)).tolist():
                azimuth = true_azimuth(stream.heard, vehicle, float(stream.followed.time_s[hop]))
                for entity in stream.followed.hidden(hop, one.sides[0], EXISTS)[:1]:
                    if azimuth is not None:
                        error = wrap_angle(entity.azimuth_rad - azimuth)
                        squares.append(error**2 / entity.azimuth_std_rad**2)
    return {"hidden_hops": len(squares), "hidden_nees": _mean(squares)}


def _mean(values: Sequence[float] | Sequence[bool] | FloatArray | BoolArray) -> float | None:
    return float(np.mean(values)) if len(values) else None
