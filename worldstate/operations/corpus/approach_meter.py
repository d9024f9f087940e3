"""Summary of one recording's states: its approaches, and its hours by state of the sensors."""

from collections import Counter
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime

from worldstate.abduction.sequence.sequence_model import COMING_S, SequenceAlarm
from worldstate.ground.typing import BoolArray
from worldstate.ground.values import LEAST_HEARD, nanoseconds, seconds
from worldstate.operations.recordings.hop_table import HOP_S
from worldstate.state import Entity, RiskCue, WorldState

from .corpus_tables import SINCE_1970_S, HeardApproach, HeardRecording, StateHours

# An advisory predicts that a vehicle comes into view within the risk's horizon.
_HORIZON_S = COMING_S[-1]
LEFT_OUT = "left out by the cascade"
_LOOKED_NS = nanoseconds(0.5)  # Maximum age of a look at a hop


@dataclass(slots=True)
class ApproachMeter:
    """Counts states and collects a row per approach, without storing the states.

    Examples
    --------
    >>> meter = ApproachMeter("a.wav", "elm street")
    >>> meter.update(WorldState(stamp_ns=1_000_000_000, seq=1))
    >>> meter.recording("").hops, [one.unheard for one in meter.hours()], meter.approaches
    (1, [None], [])
    """

    name: str
    site: str
    first_ns: int | None = None
    last_ns: int | None = None
    looked: int = 0
    usable: int = 0
    budget: float | None = None
    _raised: bool = False
    _hops: Counter[tuple[str, str | None]] = field(default_factory=Counter)
    _onsets: Counter[tuple[str, str | None]] = field(default_factory=Counter)
    approaches: list[HeardApproach] = field(default_factory=list)  # In the order of their starts
    _standing: dict[str | None, int] = field(default_factory=dict)  # Rows of active advisories, by side
    _in_view: dict[str, int] = field(default_factory=dict)  # Rows of vehicles that came into view

    def update(self, state: WorldState) -> None:
        """Process the next state."""
        self.first_ns = state.stamp_ns if self.first_ns is None else self.first_ns
        self.last_ns = state.stamp_ns
        self.usable += bool(state.cues) and all(cue.usable for cue in state.cues)
        self.budget = None if state.budget is None else state.budget.onsets_per_hour
        raised = [cue for cue in state.cues if cue.advisory is not None]
        key = sensor_words(state), _unheard(state)
        self._hops[key] += 1
        self._onsets[key] += bool(raised) and not self._raised
        self._raised = bool(raised)
        looked = any(state.stamp_ns - one.stamp_ns <= _LOOKED_NS for one in state.searched)
        self.looked += looked
        self._advise(state, raised, looked)
        for entity in state.entities:
            if entity.status == "visible" and entity.moving:
                self._see(entity, state.time_s)

    def _advise(self, state: WorldState, raised: list[RiskCue], looked: bool) -> None:
        now_s, before, self._standing = state.time_s, self._standing, {}
        for cue in raised:
            at = before.get(cue.direction, len(self.approaches))
            if at == len(self.approaches):
                expected_s = None if cue.time_to_visible_s is None else cue.time_to_visible_s[1]
                begun = HeardApproach(self.name, self.site, cue.direction, now_s, chance=cue.risk)
                self.approaches.append(replace(begun, expected_s=expected_s, usable=cue.usable))
            self._standing[cue.direction], row = at, self.approaches[at]
            self.approaches[at] = replace(row, end_s=now_s, seen=bool(row.seen) if looked else row.seen)

    def _see(self, entity: Entity, now_s: float) -> None:
        if (at := self._in_view.get(entity.id)) is None:
            at = self._in_view[entity.id] = self._announced(entity.direction, now_s)
            began_s = self.approaches[at].time_s
            lead_s = None if began_s is None else now_s - began_s
            self.approaches[at] = replace(self.approaches[at], seen=True, seen_s=now_s, lead_s=lead_s)
        likeliest = max(entity.classification or (), key=lambda one: one.probability, default=None)
        label = self.approaches[at].label if likeliest is None else likeliest.label
        self.approaches[at] = replace(self.approaches[at], gone_s=now_s, label=label)

    def _announced(self, side: str | None, now_s: float) -> int:
        """Return the row of the advisory that announced a vehicle from this side, or a new row."""
        for at, one in reversed([*enumerate(self.approaches)]):
            if one.side == side and one.seen_s is None and one.end_s is not None:
                if now_s - one.end_s <= _HORIZON_S:
                    return at
                break
        self.approaches.append(HeardApproach(self.name, self.site, side))
        return len(self.approaches) - 1

    def cascaded(self, kept: BoolArray, sampled: bool) -> None:
        """Count the skipped hops of a cascade; if all were processed, mark the approaches that it keeps."""
        if not sampled:
            self._hops["", LEFT_OUT] += round(float((~kept).sum()) / HOP_S)
            return
        for at, row in enumerate(self.approaches):
            if row.time_s is not None:
                second = min(int(row.time_s - seconds(self.first_ns or 0) + 1.0), len(kept) - 1)
                self.approaches[at] = replace(row, kept=bool(kept[second]))

    def recording(self, content: str) -> HeardRecording:
        """Return the row of the recording."""
        first_s, last_s = (None if ns is None else seconds(ns) for ns in (self.first_ns, self.last_ns))
        heard = sum(hops for (_, unheard), hops in self._hops.items() if unheard is None)
        counts = self._hops.total(), heard, self.looked, self.usable, self._onsets.total()
        return HeardRecording(self.name, self.site, content, first_s, last_s, *counts, self.budget)

    def hours(self) -> list[StateHours]:
        """Return the hops by state of the sensors."""
        day = None
        if self.first_ns is not None and seconds(self.first_ns) >= SINCE_1970_S:
            day = datetime.fromtimestamp(seconds(self.first_ns), UTC).date().isoformat()
        return [
            StateHours(self.name, self.site, day, *key, hops, self._onsets[key])
            for key, hops in sorted(self._hops.items(), key=lambda one: (one[0][0], one[0][1] or ""))
        ]


def sensor_words(state: WorldState) -> str:
    """Describe the condition of every sensor in words.

    Examples
    --------
    >>> from worldstate.state import SensorHealth
    >>> sensor_words(WorldState(0, 1, sensors=(SensorHealth("acoustic", "working", 0),)))
    'acoustic working'
    """
    return ", ".join(f"{one.sensor} {one.condition}" for one in state.sensors)


def _unheard(state: WorldState) -> str | None:
    """Return the reason why sound could raise no advisory; None if it could, or if no source gives one."""
    if state.no_model is not None:
        return "no model"
    if not state.heard or any(one.share >= LEAST_HEARD for one in state.heard):
        return None
    return state.heard[0].reason or "unheard"


def alarm_level(state: WorldState, side: str, denied: float, alarm: SequenceAlarm) -> float | None:
    """Return the highest threshold at which the alarm of a side would be raised; None if there is none.

    It is the value that the filter compares with its threshold, minus the current increase of that threshold.
    It is None below the risk `denied`, or if there was too little sound.
    """
    own = (cue for cue in state.cues if cue.direction == side)
    cue = next((cue for cue in own if (cue.risk or 0.0) >= denied), None)
    terms = None if cue is None or state.no_sequence is not None else cue.evidence
    if terms is None or terms.hypothesis != "coming":
        return None
    return terms.compared_nats - terms.threshold_nats + alarm.threshold_nats
