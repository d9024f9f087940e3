"""Report of the advisories of a run, and of the evidence for those in a snapshot."""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from typing import Literal, TypeAlias

from worldstate.abduction.road_users import Foreign, WarningSignal
from worldstate.ground.values import seconds
from worldstate.state import Budget, Entity, RiskCue, WorldState
from worldstate.state.cue import WhyNot

Standing: TypeAlias = Literal["raised", "held", "above", "below"]
_SAID = {
    "raised": "raised: not below the threshold now",
    "held": "held: below the threshold now, it ends without news",
    "above": "none, though above the threshold: the risk denies it, or there is no second of sound yet",
    "below": "none: below the threshold",
}
_SAME_NS = 50_000_000  # half a hop
WHY_NOT: dict[WhyNot, str] = {
    "uncalibrated": "no budget of false alarms was measured for this alarm",
    "unheard": "the sound is not usable",
    "unknown sound": "the model was not made for this sound",
    "too little sound": "less than a second of sound so far",
    "budget broken": "a camera contradicts the stated rate of false alarms or the probabilities",
    "expired": "no measurement for a second",
    "masked": "a vehicle in view covers the sound",
}
_OF = {
    "coming": "a vehicle comes into view within 3 s",
    "hidden": "a vehicle is hidden on any side, by this window alone",
    "announced": "a vehicle is hidden, by messages alone",
}


@dataclass(frozen=True, slots=True)
class ToldAdvisory:
    """An advisory of one side, from its onset to the last snapshot that contains it.

    Examples
    --------
    >>> ToldAdvisory("left", 700_000_000, 1_500_000_000).line()
    'left   0.70 to 1.50 s'
    """

    direction: str
    since_ns: int
    last_ns: int

    def line(self) -> str:
        """Return the advisory as a line of text."""
        return f"{self.direction:6s} {seconds(self.since_ns):.2f} to {seconds(self.last_ns):.2f} s"


def told_advisories(states: Iterable[WorldState], side: str | None = None) -> tuple[list[ToldAdvisory], int]:
    """Return the advisories (all, or of one side) by onset, and the first onset.

    Without an advisory, the second value is the time of the highest risk. If the first advisory began before
    the first snapshot, it is the time of that snapshot.
    """
    last_ns: dict[tuple[int, str], int] = {}
    highest, riskiest_ns, first_ns = -1.0, 0, None
    for state in states:
        first_ns = state.stamp_ns if first_ns is None else first_ns
        cues = [cue for cue in state.cues if side in (None, cue.direction)]
        for cue in cues:
            if cue.advisory is not None and cue.direction is not None:
                last_ns[cue.advisory.since_ns, cue.direction] = state.stamp_ns
        risk = max((cue.risk for cue in cues if cue.risk is not None), default=0.0)
        if risk > highest:
            highest, riskiest_ns = risk, state.stamp_ns
    told = [ToldAdvisory(direction, since, last) for (since, direction), last in sorted(last_ns.items())]
    return told, max(told[0].since_ns, first_ns or 0) if told else riskiest_ns


@dataclass(frozen=True, slots=True)
class SideEvidenceReport:
    """State of one side's advisory at a time and at its onset.

    Examples
    --------
    >>> from worldstate.state import EvidenceTerms, Priors
    >>> terms = EvidenceTerms("coming", {"prior": -3.0, "sequence": 2.0}, -1.0, -0.4)
    >>> cue = RiskCue("left", 0.9, 0.3, 0.1, 0.5, 0.2, 0.0, Priors(0.1, 0.1, 0.8), evidence=terms)
    >>> SideEvidenceReport(cue, None, None).standing
    'below'
    """

    cue: RiskCue
    onset: RiskCue | None  # Cue at the start of the advisory; None without one, or if the file begins later
    entity: Entity | None
    calibrated: bool = True

    @property
    def standing(self) -> Standing:
        """State of the advisory now: raised, held, or the reason for none."""
        evidence = self.cue.evidence
        above = evidence is not None and evidence.compared_nats >= evidence.threshold_nats
        if self.cue.advisory is None:
            return "above" if above else "below"
        return "raised" if self.cue.held is None else "held"

    def to_dict(self) -> dict[str, object]:
        """Return the report as values for JSON."""
        onset = self.onset.evidence if self.onset is not None else None
        return {
            "standing": self.standing,
            "cue": asdict(self.cue),
            "evidence_at_onset": None if onset is None else asdict(onset),
            "entity": None if self.entity is None else asdict(self.entity),
        }

    def lines(self, now_s: float) -> Iterator[str]:
        """Yield the lines of the report."""
        cue, told = self.cue, self.cue.advisory
        said = _SAID[self.standing] if self.calibrated else _SAID[self.standing].partition(":")[0]
        yield f"{cue.direction or 'side unknown'}: advisory {said}"
        yield from (f"  usable: no, {one}: {WHY_NOT[one]}" for one in cue.why_not)
        yield from ["  usable: yes"] * cue.usable
        if told is not None:
            since_s, until_s = seconds(told.since_ns), seconds(told.valid_until_ns)
            rests = ", ".join(f"{one.sensor} ({one.condition})" for one in told.sensors)
            yield f"  since {since_s:.2f} s, valid until {until_s:.2f} s, rests on {rests or 'no sensor'}"
        if cue.not_advised is not None:
            yield f"  although the risk is high: {cue.not_advised}"
        yield from self._terms(now_s)
        if cue.confidence is not None and cue.risk is not None:
            yield f"  side: {cue.confidence:.2f} of P(hidden); risk {cue.risk:.2f}"
        if cue.within is not None:
            chances = ", ".join(f"{chance:.2f} in {after_s} s" for after_s, chance in cue.within.items())
            yield f"  comes into view: {chances}{_time(cue)}"
        yield f"  entity: {'none' if self.entity is None else _described(self.entity)}"

    def _terms(self, now_s: float) -> Iterator[str]:
        evidence = self.cue.evidence
        if evidence is None:
            return
        both, times_s, told = [evidence], [now_s], self.cue.advisory
        if told is not None and self.onset not in (None, self.cue) and self.onset.evidence is not None:
            both, times_s = [self.onset.evidence, evidence], [seconds(told.since_ns), now_s]
        yield f"  log-odds that {_OF[evidence.hypothesis]}, nats:"
        yield f"    {'at, s':16s}{''.join(f'{time_s:14.2f}' for time_s in times_s)}"
        names = dict.fromkeys(name for one in both for name in one.terms_nats)
        yield from (_row(name, *(one.terms_nats.get(name, 0.0) for one in both)) for name in names)
        yield _row("together", *(sum(one.terms_nats.values()) for one in both))
        if evidence.hypothesis == "coming":
            yield _row("mean over 0.3 s", *(one.compared_nats for one in both))
        if self.calibrated:
            yield _row("threshold", *(one.threshold_nats for one in both))


def evidence_report(
    state: WorldState, read: Callable[[int], WorldState], side: str | None = None
) -> dict[str, SideEvidenceReport]:
    """Return the report of every side, or one; `read` returns the state at the onset of an advisory."""
    entities = {entity.id: entity for entity in state.entities}
    reports = {}
    for cue in state.cues:
        if side in (None, cue.direction):
            began = () if cue.advisory is None else _cues_at(read, cue.advisory.since_ns)
            first = next((one for one in began if one.direction == cue.direction), None)
            entity = entities.get(cue.entity_id or "")
            reports[cue.direction or "unknown"] = SideEvidenceReport(cue, first, entity, state.calibrated)
    return reports


def _cues_at(read: Callable[[int], WorldState], stamp_ns: int) -> tuple[RiskCue, ...]:
    """Return the cues at a time; none if the log begins later."""
    state = read(stamp_ns)
    return state.cues if state.stamp_ns - stamp_ns <= _SAME_NS else ()


def common_lines(state: WorldState) -> Iterator[str]:
    """Yield lines that are common to all sides: sound, looks, state of the sensors, latest events."""
    if state.calibrated and state.budget is not None:
        yield f"budget: {_promised(state.budget)}"
    if isinstance(state.domain, Foreign):
        yield f"sound: {state.domain.reason}: the evidence of this hop has little weight"
    elif isinstance(state.domain, WarningSignal):
        yield f"sound: a warning signal ({state.domain.signal})"
    if state.no_sequence is not None:
        yield f"sequence: not used, {state.no_sequence.reason}"
    for hearing in state.heard or ():
        if hearing.reason is not None:
            since = f"{hearing.reason} since {seconds(hearing.since_ns):.2f} s"
            yield f"{hearing.sensor}: {hearing.share:.2f} of hidden vehicles would be detected, {since}"
        if hearing.kinds is not None:
            kinds = ", ".join(f"{kind} {share:.2f}" for kind, share in hearing.kinds.items())
            yield f"{hearing.sensor}, detected by kind (simulated exam): {kinds}"
    for one in state.sensors:
        yield f"sensor {one.sensor}: {one.condition}{f' ({one.reason})' if one.reason else ''}"
    for view in state.searched:
        right, left = (f"{math.degrees(end_rad):.0f}" for end_rad in view.sector_rad)
        found = f"{'something' if view.found else 'nothing'} from {right} to {left} deg"
        yield f"look of {view.sensor} at {seconds(view.stamp_ns):.2f} s: {found}, misses {view.miss_rate:.2f}"
    yield from (f"event: {event.entity_id[:8]} {event.kind.replace('_', ' ')}" for event in state.events)


def _promised(budget: Budget) -> str:
    """Return the requested budget of the alarm, and the rates that its curve predicts for it."""
    asked, promise = f"{budget.onsets_per_hour:g} onsets per hour", budget.promise
    if budget.asked_alpha is not None:
        asked = f"{budget.asked_alpha:.2%} of the time without hazards"
    if promise is None:
        return f"{asked}; the model file has no curve for other budgets"
    between = f"{promise.onsets_low:.1f} to {promise.onsets_high:.1f} at other junctions"
    promised = f"{promise.onsets_per_hour:.1f} per hour ({between}) and {promise.alpha:.1%} of the time"
    return f"{asked} requested; the curve predicts {promised}"


def _row(name: str, *nats: float) -> str:
    # Adding 0.0 removes the sign of a value that rounds to zero.
    return f"    {name:16s}{''.join(f'{round(value, 2) + 0.0:+14.2f}' for value in nats)}"


def _time(cue: RiskCue) -> str:
    if cue.time_to_visible_s is None:
        return ""
    low, best, high = cue.time_to_visible_s
    return f"; {best:.1f} s from now ({low:.1f} to {high:.1f})"


def _described(entity: Entity) -> str:
    place = f"{math.degrees(entity.azimuth_rad):+.0f} deg (std {math.degrees(entity.azimuth_std_rad):.0f})"
    found = {"visible": "found it", "absent": "did not find it", "unqueried": "did not search there"}
    status = entity.status or "heard"
    return (
        f"{entity.id[:8]} {status} at {place}, exists with {entity.existence_probability:.2f}, "
        f"by {', '.join(entity.sources)}; the last look {found[entity.visibility.answer]}"
    )
