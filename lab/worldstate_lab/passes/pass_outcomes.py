"""Outcome of every vehicle of a stream in the world-state: warned, tracked, lost, confused.

An advisory is assigned to an approach if it is within the horizon of the risk, eight seconds, before the
first T0. Identity is kept if the entity hidden on the vehicle's side at T0 is the one that is visible at its
position a second later.

Masking between vehicles is computed in the band 300 Hz to 2 kHz over half a second: a vehicle of power p2
beside others of power p1 adds 10 log10(1 + p2 / (p1 + background)) decibels; the background is the 20 %
quantile of the level over the stream's hops.

The second vehicle of an approach is evaluated on its own side, at the hops from the first T0 to the second
T0, while the first vehicle is in view or has just left. These hops are compared with hops of sides without a
second vehicle at the same time after the first T0. The latter are distributed over the groups in proportion
to the hops with a second vehicle at that time, so that every group has the base rate of the street.
"""

import math
from bisect import insort
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, product

import numpy as np
from scipy.signal import lfilter, sosfilt

from worldstate.abduction.cueing.risk_map import expected_calibration_error
from worldstate.abduction.sequence.sequence_model import COMING_S, HORIZONS_S
from worldstate.commissioning.alarm_curve import measured_curve, raised_at
from worldstate.commissioning.heard_stream import HeardStream
from worldstate.commissioning.sequence_training import QUIET_KINDS
from worldstate.commissioning.stream_exam import (
    alarm_outcomes,
    approach_table,
    approaches,
    chance_figures,
    time_figures,
)
from worldstate.ground.typing import AnyArray, BoolArray, FloatArray
from worldstate.ground.values import wrap_angle
from worldstate.operations.metrics.approach_table import (
    HORIZON_S,
    SLACK_S,
    ApproachTable,
    Figures,
    StreamApproach,
    auroc,
    mean_of,
    shortly_before,
)
from worldstate.operations.recordings.hop_table import HOP_S, HopTable
from worldstate.simulation.dataset.recording import FULL_SCALE_PA
from worldstate.simulation.scene.octave_bands import REFERENCE_PA
from worldstate.simulation.stream.rendering import SILENCE_PA2, band_filter
from worldstate.state import Entity
from worldstate_lab.trials.listening import nearest_entity

from .followed_stream import PassedStream

QUIET_SHARE, MEAN_HOPS = 0.2, 5
_PASCAL = FULL_SCALE_PA / 32767.0  # Pressure of one step of 16 bit


def level_db(heard: HeardStream) -> FloatArray:
    """Return the level of one microphone in the half second before the end of each hop, shape (n,)."""
    pressure_pa = heard.hops.middle.ravel() * _PASCAL
    return sound_level_db(pressure_pa, float(heard.hops.about["sample_rate_hz"]), len(heard.hops))


def sound_level_db(pressure_pa: AnyArray, sample_rate_hz: float, hops: int) -> FloatArray:
    """Return the level of a sound with this many hops in the half second before the end of each hop."""
    sound = sosfilt(band_filter(sample_rate_hz), pressure_pa)
    power = np.square(sound).reshape(hops, -1).mean(axis=1)
    return np.asarray(10.0 * np.log10(_half_second(power) / REFERENCE_PA**2 + 1e-9))


def above_quiet_db(level: FloatArray) -> FloatArray:
    """Return the level above its 20 % quantile so far, shape (n,)."""
    past, place = list[float](), list[float]()
    for one in level.tolist():
        insort(past, one)
        place.append(past[int(QUIET_SHARE * len(past))])
    return np.asarray(level - np.array(place))


def added_db(heard: HeardStream) -> FloatArray:
    """Return the contribution of every vehicle to the level at every hop, shape (vehicles, n)."""
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
HIDDEN_S, KEPT_S, KEPT_RAD = 3.0, 3.0, np.radians(20.0)


def _identity(stream: PassedStream, one: StreamApproach) -> bool | None:
    """Return whether the entity hidden on the first vehicle's side at T0 is later visible at its position."""
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
    """Return the azimuth of a vehicle, None if it is not present."""
    rows = heard.rows
    at = np.flatnonzero((rows.vehicle == vehicle) & (np.abs(rows.time_s - time_s) < 0.5 * HOP_S + SLACK_S))
    return None if not at.size else float(np.arctan2(rows.y_m[at[0]], rows.x_m[at[0]]))


def seen_at(stream: PassedStream, vehicle: int, hop: int) -> Entity | None:
    """Return the entity in view at the position of a vehicle, None if there is none."""
    azimuth = _true_azimuth(stream.heard, vehicle, float(stream.followed.time_s[hop]))
    likely = (one for one in stream.followed.entities[hop] if one.existence_probability >= EXISTS)
    there = [one for one in likely if one.status == "visible"]
    return None if azimuth is None else nearest_entity(there, azimuth, NEAR_RAD)


def pass_figures(streams: Sequence[PassedStream]) -> Figures:
    """Return the figures of several streams together, for a table and for JSON."""
    advised = [(one.heard, one.followed.advisory) for one in streams]
    table = approach_table(advised, HORIZON_S).loud()
    figures = table.detections() | table.sides()
    named = ("approaches", "detected", "lead_missed_as_0_s", *table.sides())
    false = table.false_alarms()
    return {
        **{name: figures[name] for name in named},
        **table.standing(),
        **_entities(streams, table),
        **{name: false[name] for name in ("hazard_free_hours", "onsets_per_hour", "hazard_free_share")},
        **_ahead(streams) | _forecast(streams) | _bearing(streams) | _kept(streams),
        **_leaving(streams) | _certain(streams),
        **_meter(streams, false["onsets_per_hour"]),
    }


def _entities(streams: Sequence[PassedStream], table: ApproachTable) -> Figures:
    """Return the numbers of advisories and entities of loud approaches, and the share of kept identities."""
    kept, third = list[bool | None](), list[bool]()
    for stream in streams:
        followed = stream.followed
        for one in alarm_outcomes(stream.heard, followed.time_s, followed.advisory):
            if not one.approach.quiet:
                kept.append(_identity(stream, one.approach))
            if one.approach.flow == "both" and not one.approach.quiet:
                before = shortly_before(followed.time_s, max(one.approach.entries_s))
                sides = product(np.flatnonzero(before).tolist(), (0, 1))
                third.append(len({e.id for at in sides for e in followed.hidden(*at, EXISTS)}) > 2)
    judged = [one for one in kept if one is not None]
    return {
        "phantom_third": mean_of(third),
        "identity_judged": len(judged),
        "identity_kept": mean_of(judged),
        "onset_after_pass": mean_of([one.onsets_after > 0 for one in table.of_flow("single").outcomes]),
    }


def onsets_by_traffic(streams: Sequence[PassedStream]) -> Mapping[str, Figures]:
    """Return the onset rate on hazard-free streams, by traffic."""
    found: dict[str, list[tuple[HeardStream, BoolArray]]] = {}
    for one in (one for one in streams if one.heard.hazard_free):
        same = found.setdefault(str(one.heard.hops.about["traffic"]), [])
        same.append((one.heard, one.followed.advisory))
    return {name: approach_table(some).false_alarms() for name, some in sorted(found.items())}


def _meter(streams: Sequence[PassedStream], onsets_per_hour: float | None) -> Figures:
    """Return the detections of a level threshold at the same onset rate."""
    names = ("detected", "lead_missed_as_0_s", "onsets_per_hour")
    if onsets_per_hour is None:
        return {f"meter_{name}": None for name in names}
    above = [(one.heard, above_quiet_db(level_db(one.heard))) for one in streams]
    quiet = [("", db) for heard, db in above if heard.hazard_free]
    least_db = measured_curve(quiet).default(onsets_per_hour).threshold_nats
    louder = [(heard, np.repeat(raised_at(db, least_db)[:, None], 2, axis=1)) for heard, db in above]
    figures = approach_table(louder).loud().figures()
    return {f"meter_{name}": figures[name] for name in names}


def _ahead(streams: Sequence[PassedStream]) -> Figures:
    """Return how often a vehicle first detected straight ahead takes the identity of a hidden one."""
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
    """Yield the hops at a delay after the T0 of loud approaches, with the azimuth of the first vehicle."""
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
    """Return how often an entity is near a vehicle in the 3 s after T0."""
    near = list[bool]()
    for stream, one, hop, azimuth in _hops_beside(streams, 0.0, KEPT_S):
        if one.flow == "single":
            there = [e for e in stream.followed.entities[hop] if e.existence_probability >= EXISTS]
            near.append(any(abs(wrap_angle(e.azimuth_rad - azimuth)) <= KEPT_RAD for e in there))
    return {"kept_after_t0": mean_of(near)}


def _forecast(streams: Sequence[PassedStream]) -> Figures:
    within = np.concatenate([one.followed.within.reshape(-1, len(HORIZONS_S)) for one in streams])
    coming_s = np.concatenate([one.truth.coming_s.ravel() for one in streams])
    risk = np.concatenate([one.followed.risk.ravel() for one in streams])
    said = np.isfinite(within).all(axis=1)
    stated = np.concatenate([one.followed.time_to_visible_s.reshape(-1, 3) for one in streams])
    return {
        **chance_figures(within[said], coming_s[said]),
        # The risk is that of a hidden vehicle coming into view within the horizon of the sequence model.
        "risk_ece": expected_calibration_error(risk, coming_s <= HORIZON_S),
        **time_figures(stated, coming_s),
    }


# The risk of leaving vehicles is taken in an interval around their loudest moment. It is as long as the
# interval of approaching vehicles before T0, and no other vehicle may come near that time.
_COMPARED_S, _ALONE_S, CERTAIN = 3.0, 10.0, 0.8


def _leaving(streams: Sequence[PassedStream]) -> Figures:
    """Return how well the risk ranks loud approaching vehicles above those that leave behind the corner."""
    coming, leaving = [], []
    for stream in streams:
        time_s, most = stream.followed.time_s, stream.followed.risk.max(axis=1)
        vehicles, rows = stream.heard.vehicles, stream.heard.rows
        come = approaches(stream.heard)
        entries_s = np.array([entry_s for one in come for entry_s in one.entries_s])
        for entry_s in (entry_s for one in come if not one.quiet for entry_s in one.entries_s):
            coming.append(most[shortly_before(time_s, entry_s, _COMPARED_S)].max(initial=0.0))
        loud = ~np.isin(vehicles.kind, QUIET_KINDS)
        for number in vehicles.vehicle[loud & (vehicles.flow == "leaves")].tolist():
            mine = (rows.vehicle == number) & ~rows.in_view
            if not mine.any():
                continue
            at_s = rows.time_s[mine][rows.loudness_db[mine].argmax()]
            if not (np.abs(entries_s - at_s) < _ALONE_S).any():
                leaving.append(most[np.abs(time_s - at_s) <= 0.5 * _COMPARED_S].max(initial=0.0))
    positive = np.arange(len(coming) + len(leaving)) < len(coming)
    return {"leaving": len(leaving), "coming_leaving_auroc": auroc([*coming, *leaving], positive)}


def _certain(streams: Sequence[PassedStream]) -> Figures:
    """Return the precision and the frequency of chances above `CERTAIN` to come into view within 2 s."""
    at, right, said = HORIZONS_S.index(2.0), [], []
    for one in streams:
        certain = np.nan_to_num(one.followed.within[:, :, at]) > CERTAIN
        right.append((one.truth.coming_s <= HORIZONS_S[at])[certain])
        said.append((one.heard, certain))
    reached = approach_table(said, HORIZON_S).loud().detections()["detected"]
    return {"certain_right": mean_of(np.concatenate(right)), "certain_said": reached}


def _bearing(streams: Sequence[PassedStream]) -> Figures:
    """Return the errors of hidden azimuths, and squared errors over variance, in the 3 s before T0."""
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


WITHIN_S, NOTICED_DB, STATED = 3.0, 1.0, 0.3
JUST_LEFT_S = 2.0  # A vehicle that left the view remains loud, and masks others, for this long
SIDES_OF = ("other", "behind")
GAPS_S = {"below 1.5 s": (0.0, 1.5), "1.5 to 4 s": (1.5, 4.0)}
COLUMNS = ("behind", "since", "gap_s", "added_db", "chance", "comes", "masked")


def _loud(stream: PassedStream) -> list[StreamApproach]:
    return [one for one in approaches(stream.heard) if not one.quiet]


def second_hops(stream: PassedStream) -> Iterator[tuple[float, ...]]:
    """Yield hops of both sides after the first T0 until a second vehicle comes; gap NaN if none does."""
    if loud := _loud(stream):
        added = dict(zip(stream.heard.vehicles.vehicle.tolist(), added_db(stream.heard), strict=True))
        for one in loud:
            yield from _rows(stream, one, added[vehicle_at(stream.heard, one.entries_s[-1])])


def _rows(stream: PassedStream, one: StreamApproach, added: FloatArray) -> Iterator[tuple[float, ...]]:
    followed, rows = stream.followed, stream.heard.rows
    first = rows.in_view & (rows.vehicle == vehicle_at(stream.heard, one.entries_s[0]))
    since_s = followed.time_s - one.entries_s[0]
    end_s = rows.time_s[first].max(initial=one.entries_s[0]) + JUST_LEFT_S
    for behind in (False, True):
        side = one.sides[0] if behind else 1 - one.sides[0]
        coming_s = stream.truth.coming_s[:, side]
        gap_s = one.entries_s[-1] - one.entries_s[0] if one.sides[1:] == (side,) else np.nan
        still = since_s < gap_s - SLACK_S if gap_s >= 0.0 else coming_s > COMING_S[-1]
        chance = followed.within[:, side, HORIZONS_S.index(WITHIN_S)]
        there = (since_s > SLACK_S) & (followed.time_s <= end_s) & still & np.isfinite(chance)
        for hop in np.flatnonzero(there).tolist():
            told = chance[hop], coming_s[hop] <= WITHIN_S, followed.masked[hop]
            yield behind, round(since_s[hop] / HOP_S), gap_s, added[hop], *told


def second_figures(streams: Sequence[PassedStream]) -> Figures:
    """Return figures of the chances and the entities of second vehicles, by side and gap."""
    hops = HopTable.of_rows(COLUMNS, chain.from_iterable(map(second_hops, streams)))
    kept = [row for stream in streams for row in _kept_apart(stream)]
    heard = hops.added_db >= NOTICED_DB
    found: Figures = {}
    for (behind, side), (gap, (low, high)) in product(enumerate(SIDES_OF), GAPS_S.items()):
        here = (hops.behind == behind) & (hops.gap_s >= low) & (hops.gap_s < high)
        mine = [row[2:] for row in kept if row[0] == behind and low <= row[1] < high]
        same = [kept for apart, kept in mine if apart]
        figures = {"approaches": len(mine)} | _noticed(hops, here & heard)
        figures |= {"said masked": _said_masked(hops, here & ~heard)}
        figures |= {"stated apart": len(same), "identity kept": mean_of(same)}
        found |= {f"{side}, {gap}: {name}": value for name, value in figures.items()}
    return found


def _noticed(hops: HopTable, mine: BoolArray) -> Figures:
    """Return the Brier skill of the chance if the second vehicle adds a decibel or more."""
    weight = _with_empty(hops, mine)
    share = np.average(hops.comes, weights=weight) if mine.any() else 0.0
    constant = share * (1.0 - share)
    brier = np.average((hops.chance - hops.comes) ** 2, weights=weight) if mine.any() else 0.0
    return {"hops of 1 dB": int(mine.sum()), "skill": float(1.0 - brier / constant) if constant else None}


def _said_masked(hops: HopTable, mine: BoolArray) -> float | None:
    """Return how often `heard` gives a reason if the second vehicle adds less than a decibel."""
    if not mine.any():
        return None
    return float(np.average(hops.masked, weights=_with_empty(hops, mine)))


def _with_empty(hops: HopTable, mine: BoolArray) -> FloatArray:
    """Return weights: 1 for hops with a second vehicle, and for empty ones at the same delay their share."""
    pair = np.isfinite(hops.gap_s)
    key = 2 * hops.since.astype(np.intp) + hops.behind.astype(np.intp)
    some, every = (np.bincount(key[which], minlength=key.max(initial=0) + 1) for which in (mine, pair))
    return np.where(pair, mine, (some / np.maximum(every, 1))[key])


def _kept_apart(stream: PassedStream) -> Iterator[tuple[bool, float, bool, bool]]:
    """Yield side and gap of second vehicles, and two flags on the entity published before the first T0.

    The flags are: it existed, and it is visible at the vehicle's position.
    """
    followed = stream.followed
    for one in (one for one in _loud(stream) if len(one.entries_s) > 1):
        behind = one.sides[0] == one.sides[1]
        before = int(np.searchsorted(followed.time_s, one.entries_s[0] - SLACK_S)) - 1
        # Entities are chosen by their share of that side, because one of unknown side may be the first
        # vehicle's too. If both vehicles come from one side, the likeliest entity belongs to the first.
        hidden = sorted(followed.hidden(before, one.sides[1], STATED), key=lambda e: -e.existence_probability)
        stated = {e.id for e in hidden[behind:]}
        second = _seen_after(stream, one.entries_s[1])
        yield behind, one.entries_s[1] - one.entries_s[0], bool(stated), second in stated


def _seen_after(stream: PassedStream, entry_s: float) -> str | None:
    """Return the identifier of the entity at the vehicle's position one second after it came into view."""
    later = int(np.searchsorted(stream.followed.time_s, entry_s + SEEN_AFTER_S))
    found = seen_at(stream, vehicle_at(stream.heard, entry_s), min(later, len(stream.followed.time_s) - 1))
    return None if found is None else found.id
