"""Laws of a snapshot and of consecutive snapshots."""

import math
from collections.abc import Iterator

from worldstate import WorldState
from worldstate.abduction.sequence.sequence_reader import TOO_FEW

SLACK = 1e-9
LEAST_RISK, HIGH_RISK, HOLDS_NS = 0.1, 0.5, 1_005_000_000
_BUDGET_LOST = {"uncalibrated", "unheard", "budget broken"}


def broken_laws(state: WorldState, before: WorldState | None = None) -> list[str]:
    """Return the broken laws; `before` is the previous snapshot of the same filter."""
    state.to_json()  # Which raises an error for values that are not finite
    told = [*_chances(state), *_advisories(state)]
    # Late measurements or a set clock change the past in `before`.
    if before is not None and _past(before) == _past(state) and before.stamp_ns <= state.stamp_ns:
        told += _in_time(state, before)
    return told


def _past(state: WorldState) -> tuple[int, int, int]:
    return state.delivery.replayed, state.delivery.reanchored, state.delivery.held_back


def _chances(state: WorldState) -> Iterator[str]:
    """Yield invalid or inconsistent probabilities."""
    stated = [one.existence_probability for one in state.entities]
    stated += [one.probability for one in state.relations]
    stated += [chance for cue in state.cues for chance in (cue.risk, *(cue.within or {}).values())]
    if not all(0.0 <= one <= 1.0 for one in stated):
        yield "a chance outside of 0 to 1"
    if len({one.id for one in state.entities}) < len(state.entities):
        yield "two entities of one name"
    for one in state.entities:
        if not 0.0 <= (one.hidden_probability or 0.0) <= one.existence_probability:
            yield f"P(hidden) {one.hidden_probability} of an existence of {one.existence_probability}"
        azimuths_rad = one.azimuth_rad, *(later_rad for later_rad, _ in (one.forecast or {}).values())
        if max(map(abs, azimuths_rad)) > math.pi or one.azimuth_std_rad <= 0.0:
            yield f"azimuths of {azimuths_rad} +- {one.azimuth_std_rad}"
        if abs(math.fsum(kind.probability for kind in one.classification) - 1.0) > 1e-6:
            yield f"classes that do not sum to one: {one.classification}"
        hidden = one.status == "hidden"
        if (one.sector_rad is not None) != hidden:
            yield f"{one.status} with a sector of {one.sector_rad}"
        heard_only = hidden and one.sources == ("acoustic",) and one.last_seen_ns is None
        if (heard_only and one.forecast) or not (hidden or one.forecast):
            yield f"{one.status} with a forecast of {one.forecast}"
    if len(state.entities) > 128 or len(state.events) > 64:
        yield "more entities or events than a snapshot holds"
    names = {one.id for one in (*state.entities, *state.context.occluders)} | {"ego"}
    if any(not {one.src, one.dst} <= names for one in state.relations):
        yield "a relation of what the snapshot does not hold"
    if any(abs(end_rad) > math.pi for view in state.searched for end_rad in view.sector_rad or ()):
        yield f"sectors beyond half a turn: {state.searched}"
    for cue in state.cues:
        hidden, visible, none = cue.hypotheses.hidden, cue.hypotheses.visible, cue.hypotheses.none
        if abs(hidden + visible + none - 1.0) > SLACK:
            yield "explanations that do not sum to one"
        if hidden < state.risk - SLACK or none > 1.0 - state.risk + SLACK:
            yield f"P(hidden) {hidden} and P(none) {none} beside a risk of {state.risk}"
        chances = [*(cue.within or {}).values(), cue.risk + SLACK]
        if chances != sorted(chances):
            yield f"{cue.direction}: chances that do not rise up to the risk: {chances}"
        low_s, _, high_s = cue.time_to_visible_s or (0.0, 0.0, 0.0)
        if not 0.0 <= low_s <= high_s:
            yield f"{cue.direction}: times to visible of {cue.time_to_visible_s}"


def _advisories(state: WorldState) -> Iterator[str]:
    """Yield advisories that contradict the other fields."""
    for cue in state.cues:
        if cue.usable != (not cue.why_not):
            yield f"{cue.direction}: usable {cue.usable} beside {cue.why_not}"
        if state.calibrated != _BUDGET_LOST.isdisjoint(cue.why_not):
            yield f"{cue.direction}: why not {cue.why_not}, but calibrated {state.calibrated}"
        terms, told, where = cue.evidence, cue.advisory, f"{cue.direction}: "
        assert terms is not None
        over, allowed = terms.compared_nats >= terms.threshold_nats, cue.risk >= LEAST_RISK
        if told is not None and not allowed:
            yield where + f"an advisory beside a risk of {cue.risk}"
        if (cue.held is not None) != (told is not None and not over):
            yield where + f"{terms}, held {cue.held}, advisory {told}"
        # The rule applies to the likelier side only, and no alarm is raised within the first second.
        named = over and allowed and state.no_sequence != TOO_FEW
        if named and told is None and (terms.hypothesis != "hidden" or _nowhere(state)):
            yield where + f"no advisory above the threshold: {terms}, risk {cue.risk}"
        if (cue.not_advised is not None) != (told is None and cue.risk > HIGH_RISK):
            yield where + f"risk {cue.risk}, advisory {told}, and why not: {cue.not_advised}"
        if told is not None and not 0 <= told.valid_until_ns - state.stamp_ns <= HOLDS_NS:
            yield where + f"an advisory until {told.valid_until_ns} at {state.stamp_ns}"
        if told is not None and told.since_ns > state.stamp_ns:
            yield where + f"an advisory since {told.since_ns} at {state.stamp_ns}"
        if told is not None and not {one.sensor for one in told.sensors} <= {s.sensor for s in state.sensors}:
            yield where + f"an advisory of sensors that the snapshot does not list: {told.sensors}"
        if cue.held is not None and (told is None or cue.held.until_ns != told.valid_until_ns):
            yield where + f"held {cue.held}, advisory {told}"


def _nowhere(state: WorldState) -> bool:
    """Whether no side has an advisory while the likeliest one may have one."""
    return all(cue.advisory is None and cue.risk >= LEAST_RISK for cue in state.cues)


def _in_time(state: WorldState, before: WorldState) -> Iterator[str]:
    """Yield advisories that contradict time or hand-overs."""
    is_new = state.seq > before.seq
    gone = {one.entity_id for one in state.events if is_new and one.kind == "handed_over"}
    # If `before` was predicted beyond this snapshot, it is not its past.
    if is_new and max(one.stamp_ns for one in state.sensors) < before.stamp_ns:
        return
    last = {cue.direction: cue for cue in before.cues}
    for cue in state.cues:
        told, old = cue.advisory, last.get(cue.direction)
        if told is None:
            continue
        begins = is_new and told.since_ns >= before.stamp_ns
        if not begins and (old is None or old.advisory is None or old.advisory.since_ns != told.since_ns):
            yield f"{cue.direction}: {told} at {state.stamp_ns} after {old and old.advisory}"
        if cue.entity_id in gone or (old is not None and old.entity_id in gone and not begins):
            yield f"{cue.direction}: {told} outlives the hand-over of {old and old.entity_id}"
