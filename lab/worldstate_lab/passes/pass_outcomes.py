"""What became of every vehicle of a stream in the world-state: warned of, followed, lost, confused.

An advisory belongs to an approach from the risk's horizon, eight seconds, before the first T0 on. Identity is
kept where the entity that was hidden on the vehicle's side at T0 is the one seen at its place a second later.

Where vehicles mask each other, 300 Hz to 2 kHz, half a second: one of power p2 beside others of p1 adds
10 log10(1 + p2 / (p1 + background)) decibels; the background is the level that a fifth of the stream's hops
stays below.
"""

import math
from bisect import insort
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter, sosfilt

from worldstate.abduction.cueing.calibration_error import brier_skill, expected_calibration_error
from worldstate.abduction.sequence.sequence_model import HORIZONS_S, LONGEST_S, held
from worldstate.commissioning.heard_stream import HeardStream
from worldstate.commissioning.stream_exam import (
    alarm_outcomes,
    approach_table,
    approaches,
    chance_figures,
    threshold_for,
    time_figures,
)
from worldstate.commissioning.stream_outcomes import HORIZON_S, shortly_before
from worldstate.ground.typing import AnyArray, FloatArray
from worldstate.ground.values import wrap_angle
from worldstate.operations.metrics.approach_table import (
    LONGEST_LEAD_S,
    SLACK_S,
    ApproachOutcome,
    ApproachTable,
    Figures,
    StreamApproach,
    mean_of,
)
from worldstate.operations.recordings.hop_table import HOP_S
from worldstate.simulation.dataset.recording import FULL_SCALE_PA
from worldstate.simulation.scene.octave_bands import REFERENCE_PA
from worldstate.simulation.stream.rendering import SILENCE_PA2, band_filter
from worldstate.state import Entity

from .followed_stream import PassedStream

QUIET_SHARE, MEAN_HOPS = 0.2, 5
_PASCAL = FULL_SCALE_PA / 32767.0  # Of one step of 16 bit


def level_db(heard: HeardStream) -> FloatArray:
    """Return the level of one microphone in the half second that ends with every hop, shape (n,)."""
    sections = band_filter(float(heard.hops.about["sample_rate_hz"]))
    sound = sosfilt(sections, heard.hops.middle.ravel() * _PASCAL)
    power = np.square(sound).reshape(len(heard.hops), -1).mean(axis=1)
    return np.asarray(10.0 * np.log10(_half_second(power) / REFERENCE_PA**2 + 1e-9))


def above_place_db(heard: HeardStream) -> FloatArray:
    """Return how far the level lies above its 20 % quantile of the stream so far, shape (n,)."""
    level, past, place = level_db(heard), list[float](), list[float]()
    for one in level.tolist():
        insort(past, one)
        place.append(past[int(QUIET_SHARE * len(past))])
    return np.asarray(level - np.array(place))


def added_db(heard: HeardStream) -> FloatArray:
    """Return what every vehicle adds to the level at every hop, shape (vehicles, n)."""
    rows, number = heard.rows, {name: i for i, name in enumerate(heard.vehicles.vehicle.tolist())}
    power = np.full((len(number), len(heard.hops)), SILENCE_PA2 / REFERENCE_PA**2)
    hop, inside = heard.row_hops()
    vehicle = np.array([number[one] for one in rows.vehicle.tolist()], np.intp)
    power[vehicle[inside], hop[inside]] = 10.0 ** (rows.band_db[inside] / 10.0)
    own = _half_second(power)
    background = 10.0 ** (np.quantile(level_db(heard), QUIET_SHARE) / 10.0)
    return np.asarray(10.0 * np.log10(1.0 + own / (own.sum(axis=0) - own + background)))


def _half_second(power: AnyArray) -> FloatArray:
    return np.asarray(lfilter(np.full(MEAN_HOPS, 1.0 / MEAN_HOPS), 1.0, power))


EXISTS, NEAR_RAD, SEEN_AFTER_S = 0.5, np.radians(10.0), 1.0
RISKS = (0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7)
HIDDEN_S, KEPT_S, KEPT_RAD = 3.0, 3.0, np.radians(20.0)


@dataclass(frozen=True, slots=True)
class PassOutcome:
    """One approach: what the advisories made of it, and the entities."""

    alarm: ApproachOutcome
    hidden_before: int  # Different entities believed hidden before T0
    identity: bool | None  # None where no entity was believed or seen there


def outcomes(stream: PassedStream) -> list[PassOutcome]:
    """Return the outcome of every approach that lies whole within the stream."""
    followed = stream.followed
    found = []
    for alarm in alarm_outcomes(stream.heard, followed.time_s, followed.advisory):
        last = max(alarm.approach.entries_s)
        hidden = {
            entity.id
            for hop in np.flatnonzero(shortly_before(followed.time_s, last))
            for side in (0, 1)
            for entity in followed.hidden(int(hop), side, EXISTS)
        }
        found.append(PassOutcome(alarm, len(hidden), _identity(stream, alarm.approach)))
    return found


def _identity(stream: PassedStream, one: StreamApproach) -> bool | None:
    """Tell whether the entity hidden on the first vehicle's side at T0 is the one seen in its place later."""
    followed, entry_s = stream.followed, one.entries_s[0]
    hop = int(np.searchsorted(followed.time_s, entry_s - SLACK_S)) - 1
    hidden = followed.hidden(hop, one.sides[0])
    later = int(np.searchsorted(followed.time_s, entry_s + SEEN_AFTER_S))
    seen = seen_at(stream, vehicle_at(stream.heard, entry_s), later)
    if not hidden or seen is None:
        return None
    return seen.id in {entity.id for entity in hidden}


def vehicle_at(heard: HeardStream, entry_s: float) -> int:
    """Return the number of the vehicle that came into view at a time."""
    return int(heard.vehicles.vehicle[np.nanargmin(np.abs(heard.vehicles.entry_s - entry_s))])


def _true_azimuth(heard: HeardStream, vehicle: int, time_s: float) -> float | None:
    """Return the azimuth of a vehicle, None where it is not there."""
    rows = heard.rows
    at = np.flatnonzero((rows.vehicle == vehicle) & (np.abs(rows.time_s - time_s) < 0.5 * HOP_S + SLACK_S))
    return None if not at.size else float(np.arctan2(rows.y_m[at[0]], rows.x_m[at[0]]))


def seen_at(stream: PassedStream, vehicle: int, hop: int) -> Entity | None:
    """Return the entity in view at the place of a vehicle; None where none is."""
    azimuth = _true_azimuth(stream.heard, vehicle, float(stream.followed.time_s[hop]))
    if azimuth is None:
        return None
    near = [
        (abs(wrap_angle(one.azimuth_rad - azimuth)), one.id, one)
        for one in stream.followed.entities[hop]
        if one.status == "visible" and one.existence_probability >= EXISTS
    ]
    distance, _, nearest = min(near, default=(np.inf, "", None))
    return nearest if distance <= NEAR_RAD else None


def pass_figures(streams: Sequence[PassedStream]) -> Figures:
    """Return the figures of some streams together, ready for a table and for JSON."""
    advised = [(one.heard, one.followed.advisory) for one in streams]
    table, short = (approach_table(advised, longest_s).loud() for longest_s in (HORIZON_S, LONGEST_LEAD_S))
    figures, former = (one.detections() | one.sides() for one in (table, short))
    named = ("approaches", "detected", "lead_missed_as_0_s", *table.sides())
    false = table.false_alarms()
    return {
        **{name: figures[name] for name in named},
        **{f"{name}_5s": former[name] for name in named if name in _OF_FIVE_SECONDS},
        **_entities(streams, table),
        **{name: false[name] for name in ("hazard_free_hours", "onsets_per_hour", "hazard_free_share")},
        **_ahead(streams) | _forecast(streams) | _bearing(streams) | _kept(streams),
        **_meter(streams, false["onsets_per_hour"]),
    }


# What was printed before alarms counted from the risk's horizon on.
_OF_FIVE_SECONDS = ("detected", "lead_missed_as_0_s", "other_side_too", "both_sides_found")


def _entities(streams: Sequence[PassedStream], table: ApproachTable) -> Figures:
    """Return how many advisories and entities there were of loud approaches, and which were kept."""
    loud = [one for stream in streams for one in outcomes(stream) if not one.alarm.approach.quiet]
    judged = [one.identity for one in loud if one.identity is not None]
    both = [one.hidden_before for one in loud if one.alarm.approach.flow == "both"]
    return {
        "onsets_per_approach": mean_of([one.onsets for one in table.outcomes if one.detected]),
        "phantom_third": mean_of([hidden > 2 for hidden in both]),
        "identity_judged": len(judged),
        "identity_kept": mean_of(judged),
        "onset_after_pass": mean_of([one.onsets_after > 0 for one in table.of_flow("single").outcomes]),
    }


def sides_by_risk(streams: Sequence[PassedStream]) -> Mapping[str, Figures]:
    """Return how often the other side of a single, too, and both of two reach a risk before T0."""
    names = ("other_side_too", "both_sides_found", "both_near_found")
    found = {}
    for least in RISKS:
        table = approach_table([(one.heard, one.followed.risk >= least) for one in streams]).loud()
        found[f"risk {least:g}"] = {name: table.sides()[name] for name in names}
    return found


def _meter(streams: Sequence[PassedStream], onsets_per_hour: float | None) -> Figures:
    """Return what "louder than the place was" reaches at as many onsets an hour."""
    quiet = [above_place_db(one.heard) for one in streams if one.heard.hazard_free]
    if onsets_per_hour is None:
        return dict.fromkeys(("meter_detected", "meter_lead_missed_as_0_s", "meter_onsets_per_hour"))
    least_db = threshold_for(quiet, onsets_per_hour)
    louder = ((one.heard, held(above_place_db(one.heard) >= least_db)) for one in streams)
    figures = approach_table([(heard, np.stack([on, on], axis=1)) for heard, on in louder]).loud().figures()
    return {f"meter_{name}": figures[name] for name in ("detected", "lead_missed_as_0_s", "onsets_per_hour")}


def _ahead(streams: Sequence[PassedStream]) -> Figures:
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
            entity = seen_at(stream, number, later)
            before = {one.id for side in (0, 1) for one in stream.followed.hidden(first - 1, side)}
            if entity is not None:
                taken.append(entity.id in before)
    return {"seen_ahead": len(taken), "took_hidden_identity": mean_of(taken)}


def _hops_beside(
    streams: Sequence[PassedStream], first_s: float, end_s: float
) -> Iterator[tuple[PassedStream, StreamApproach, int, float]]:
    """Yield the hops so long after the T0 of loud approaches, with the azimuth of the first vehicle then."""
    for stream in streams:
        for one in approaches(stream.heard):
            vehicle = vehicle_at(stream.heard, one.entries_s[0])
            since_s = stream.followed.time_s - one.entries_s[0]
            within = () if one.quiet else np.flatnonzero((since_s >= first_s) & (since_s < end_s)).tolist()
            for hop in within:
                azimuth = _true_azimuth(stream.heard, vehicle, float(stream.followed.time_s[hop]))
                if azimuth is not None:
                    yield stream, one, hop, azimuth


def _kept(streams: Sequence[PassedStream]) -> Figures:
    """Return how often an entity stands near a vehicle in the three seconds after T0, and how many do."""
    near = []
    for stream, one, hop, azimuth in _hops_beside(streams, 0.0, KEPT_S):
        if one.flow == "single":
            there = [e for e in stream.followed.entities[hop] if e.existence_probability >= EXISTS]
            near.append(sum(abs(wrap_angle(e.azimuth_rad - azimuth)) <= KEPT_RAD for e in there))
    counts = np.array(near)
    return {"kept_after_t0": mean_of(counts > 0), "entities_after_t0": mean_of(counts[counts > 0])}


def _forecast(streams: Sequence[PassedStream]) -> Figures:
    within = np.concatenate([one.followed.within.reshape(-1, len(HORIZONS_S)) for one in streams])
    coming_s = np.concatenate([one.truth.coming_s.ravel() for one in streams])
    risk = np.concatenate([one.followed.risk.ravel() for one in streams])
    said = np.isfinite(within).all(axis=1)
    stated = np.concatenate([one.followed.time_to_visible_s.reshape(-1, 3) for one in streams])
    return {
        **chance_figures(within[said], coming_s[said]),
        # The risk is of a hidden vehicle that comes into view within the time that the sequence foresees.
        "risk_skill": brier_skill(risk, coming_s <= HORIZON_S),
        "risk_ece": expected_calibration_error(risk, coming_s <= HORIZON_S),
        **time_figures(stated, coming_s),
        "times_stated": mean_of(np.isfinite(stated[coming_s <= LONGEST_S][:, 1])),
    }


def _bearing(streams: Sequence[PassedStream]) -> Figures:
    """Return how far hidden azimuths are off, and the same over their variance, in the 3 s before T0."""
    errors_rad, stds_rad = [], []
    for stream, one, hop, azimuth in _hops_beside(streams, np.nextafter(-HIDDEN_S, 0.0), -SLACK_S):
        for entity in stream.followed.hidden(hop, one.sides[0], EXISTS)[:1]:
            errors_rad.append(wrap_angle(entity.azimuth_rad - azimuth))
            stds_rad.append(entity.azimuth_std_rad)
    errors, stds = np.array(errors_rad), np.array(stds_rad)
    found = errors.size > 0
    return {
        "hidden_hops": errors.size,
        "hidden_rms_deg": math.degrees(np.sqrt(np.mean(errors**2))) if found else None,
        "hidden_nees": float(np.mean(errors**2 / stds**2)) if found else None,
    }
