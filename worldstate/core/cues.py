"""Advisories and risk cues per side, from the belief and from messages."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np

from worldstate.abduction.evidence import posterior_of
from worldstate.abduction.road_users import Foreign
from worldstate.abduction.sequence.sequence_model import HORIZONS_S, STATED, SequencePosterior
from worldstate.abduction.sequence.sequence_reader import TOO_FEW
from worldstate.belief.hidden_bearing import announced, time_to_visible
from worldstate.belief.kinematics.motion import AZIMUTH
from worldstate.belief.side_belief import SideBelief
from worldstate.belief.street_model import StreetModel
from worldstate.belief.track import Track
from worldstate.ground import LEAST_HEARD, TINY, falling, replaced
from worldstate.measurement import Heard, Measurement
from worldstate.state import Advisory, Entity, EvidenceTerms, Held, Priors, RiskCue, SensorHealth
from worldstate.state.sensor import MASKED

from .birth_death import hidden_on
from .memory import NEWS_HOLDS_NS, Instant, Memory, SourceState
from .site_model import FilterModel
from .snapshot_builder import hidden_azimuth, sector, time_to_arrival
from .street_belief import bounded_log_odds

_JUST_LEFT_NS = 2 * NEWS_HOLDS_NS  # A vehicle that has left the view is as loud as before for this long
_UNNAMED = "no source distinguishes this side: its risk is that of the prior"
_Times: TypeAlias = tuple[dict[str, float] | None, tuple[float, float, float] | None]


@dataclass(frozen=True, slots=True)
class SideAdvisory:
    """Advisory of a side, and its end if no new evidence arrives."""

    ends_ns: int
    held: bool = False  # The log-odds are below the threshold now
    announced: bool = False  # Raised by messages, not by sound


def heard_beside(memory: Memory, measurement: Measurement, street: StreetModel) -> Heard:
    r"""Return the audibility of hidden vehicles beside a vehicle that is in view or has just left it.

    .. math:: s = 1 - P(\text{in view})\, \big(1 - P(\text{noticed} \mid \text{level})\big)

    It is only published. The belief uses the sequence model, which was trained on vehicles that mask others.
    """
    heard, tracks = measurement.heard, memory.tracks
    near = tracks.moving & (tracks.last_seen_ns >= measurement.stamp_ns - _JUST_LEFT_NS)
    in_view = max(tracks.existence[near].tolist(), default=0.0)
    if memory.belief.has_times:
        in_view = max(in_view, memory.belief.joint.in_view)
    # P(a vehicle that comes into view within three seconds adds at least 1 dB from 300 Hz to 2 kHz); without
    # a vehicle in view it is 0.8 from 3 dB on.
    quiet = falling(heard.excess_db, (street.excess_low_db, street.excess_high_db))
    share = 1.0 - in_view * (1.0 - 0.5 * quiet)
    # A vehicle that is probably not in view is no reason.
    if in_view < 0.5 or share >= heard.share:
        return heard
    # The masking source itself is audible, so the share is not set below `LEAST_HEARD`.
    return replaced(heard, share=max(share, LEAST_HEARD), reason=MASKED)


def note_source(memory: Memory, measurement: Measurement, model: FilterModel) -> None:
    """Record the state of a source, and the posterior of its window at the policy's reference prior."""
    source, stamp_ns, domain = measurement.source, measurement.stamp_ns, measurement.domain
    heard = heard_beside(memory, measurement, model.site.street)
    fault = measurement.fault or (domain.reason if isinstance(domain, Foreign) else None)
    last = memory.sources.get(source)
    since_ns = last.heard_ns if last is not None and last.heard.reason == heard.reason else stamp_ns
    memory.sources[source] = SourceState(stamp_ns, fault, heard, since_ns)
    if not measurement.heard.usable:
        return
    # The paper's statistic uses the policy's own prior and no memory. Other sets of sides have a uniform
    # prior.
    prior, explanations = model.policy.reference_prior, len(measurement.signature.directions) + 2
    usual = prior if len(prior) == explanations else [1.0 / explanations] * explanations
    found = posterior_of(tuple(map(math.log, usual)), measurement.signature, measurement.co_evidence)
    ratio = found.log_lambda if math.isfinite(found.log_lambda) else None
    memory.last.instant = Instant(min(found.hidden_total, 1.0), ratio)


def sound_cues(sounds: Iterable[Entity]) -> tuple[RiskCue, ...]:
    """Return the directions of tracked sounds as cues without side, risk and advisory."""
    places = [(one.id, one.azimuth_rad, one.azimuth_std_rad) for one in sounds]
    return tuple(
        RiskCue(None, at, std, None, None, None, None, None, entity_id=name, sector_rad=sector(at, std))
        for name, at, std in places
    )


# No slots: derived values are computed once, on demand.
@dataclass(frozen=True, eq=False)
class SideAlarms:
    """Alarms of all sides at one time, with the belief over the sides as it is published."""

    memory: Memory
    model: FilterModel

    @cached_property
    def sides(self) -> SideBelief:
        r"""The belief over the sides with the policy's calibration, messages and tracks.

        .. math:: r_k = \min\big(P(hid),\ g(P(hid))\big)\, P(k \mid hid)

        holds without a sequence model; a sequence model is calibrated already. Not every hidden vehicle
        comes into view, so the policy's calibrated map g can only lower the risk. The map was fitted to
        window evidence. Before the first window the risk is that of the prior; the map would make a street
        without evidence look quieter than any real one.
        """
        belief, tracks = self.memory.belief, self.memory.tracks
        sides = belief.sides
        if belief.read_ns and not belief.has_times:
            hidden = sides.hypotheses[0]
            risk = min(float(self.model.policy.risk_map(hidden)), hidden)
            # The floor only matters if P(hidden) has underflowed; no direction has a share then.
            share = risk / max(hidden, TINY)
            sides = replaced(sides, risk=risk, risks=tuple(share * one for one in sides.hidden))
        # A vehicle behind the ego vehicle does not explain sound from ahead.
        ahead = tracks.seen & tracks.moving & (np.cos(tracks.mean[:, AZIMUTH]) > 0.0)
        unseen = 1.0 - tracks.existence[ahead] * (1.0 - tracks.behind[ahead])
        return sides.at_least(self._announced).beside(float(np.multiply.reduce(unseen)))

    @cached_property
    def _tracks(self) -> tuple[Track, ...]:
        return self.memory.tracks.rows()

    @cached_property
    def _announced(self) -> tuple[float, ...]:
        return announced(self.memory.tracks, self.model.site)

    @cached_property
    def _messages(self) -> list[tuple[float, int]]:
        """Log-odds that an announced road user comes into view, and the end of the announcement, by side."""
        memory, tracks = self.memory, self.memory.tracks
        placed, long_ago_ns = tracks.placed & ~tracks.seen, memory.stamp_ns - 2 * NEWS_HOLDS_NS
        updated_ns = [tracks.updated_ns[placed & (tracks.side == k)] for k in range(len(memory.history))]
        ends_ns = [max(ns.tolist(), default=long_ago_ns) for ns in updated_ns]
        latest_ns = [max(ns, long_ago_ns) + NEWS_HOLDS_NS for ns in ends_ns]
        return list(zip(map(bounded_log_odds, self._announced), latest_ns, strict=True))

    @cached_property
    def _threshold_nats(self) -> float:
        return self.memory.belief.threshold_nats(self.model.policy, self.model.site.street)

    def note_announced(self) -> None:
        """Record the sides on which messages reach the threshold now."""
        for side, (nats, ends_ns) in zip(self.memory.history, self._messages, strict=True):
            if nats >= self._threshold_nats and ends_ns >= self.memory.stamp_ns:
                side.announced_ns = self.memory.stamp_ns

    @cached_property
    def _raised(self) -> list[SideAdvisory | None]:
        """The advisory of each side before its risk is checked; messages raise one if sound does not.

        Sound raises none in the first second of a sequence, because the alarm budgets exclude this second.
        """
        memory, belief, stamp_ns = self.memory, self.memory.belief, self.memory.stamp_ns
        ends_ns = belief.alarm_ends_ns(stamp_ns)
        if memory.last.no_sequence == TOO_FEW:
            ends_ns = (None,) * len(ends_ns)
        raised = [
            None if end_ns is None else SideAdvisory(end_ns, decided < self._threshold_nats)
            for end_ns, decided in zip(ends_ns, belief.decided_at(stamp_ns), strict=True)
        ]
        for k, (nats, end_ns) in enumerate(self._messages):
            heard, since_ns, is_below = raised[k], memory.history[k].announced_ns, nats < self._threshold_nats
            stands = since_ns is not None and min(end_ns, since_ns + NEWS_HOLDS_NS) >= stamp_ns
            if stands and (heard is None or (heard.held and not is_below)):
                raised[k] = SideAdvisory(end_ns, is_below, announced=True)
        return raised

    @cached_property
    def advisories(self) -> list[SideAdvisory | None]:
        """The advisory of each side, or None; there is none at a risk below 0.1."""
        if not any(self._raised):
            return self._raised
        least, pairs = self.model.site.street.death, zip(self._raised, self.sides.risks, strict=True)
        return [one if risk >= least else None for one, risk in pairs]

    def cues(self, sensors: tuple[SensorHealth, ...]) -> tuple[RiskCue, ...]:
        """Return one risk cue per side, none before the first measurement."""
        if not self.memory.counts.measurements:
            return ()
        rested_on = tuple([one for one in sensors if one.condition != "silent"])
        # All sides together, so that arrays are converted once.
        pairs = zip(self._times(), self._evidence(), strict=True)
        return tuple([self._cue(k, times, evidence, rested_on) for k, (times, evidence) in enumerate(pairs)])

    def _cue(
        self, k: int, times: _Times, evidence: EvidenceTerms, sensors: tuple[SensorHealth, ...]
    ) -> RiskCue:
        memory, site, sides, told = self.memory, self.model.site, self.sides, self.advisories[k]
        row = hidden_on(memory.tracks, k)
        track = None if row is None else self._tracks[row]
        azimuth_rad, std_rad, source = hidden_azimuth(k, track, memory.belief, site)
        within, interval_s = times
        arrival_s = None
        if track is not None and track.approach_heard:
            arrival_s = time_to_arrival(track.motion.inverse_tta_hz, track.motion.inverse_tta_std_hz)
        # The distance and speed of an announced vehicle are more accurate than the sound.
        if track is not None and track.place is not None:
            interval_s = time_to_visible(track.place, site.sides[track.side], site)[1] or interval_s
        named = memory.last.named  # No sides before the first window
        is_named = told is not None or not named or site.sides[k].label in named
        since_ns, entity_id = memory.history[k].advised_ns, None if track is None else track.id
        advisory = held = None
        if told is not None:
            advisory = Advisory(memory.stamp_ns if since_ns is None else since_ns, told.ends_ns, sensors)
            held = Held(entity_id, told.ends_ns) if told.held else None
        return RiskCue(
            direction=site.sides[k].label,
            statistic=memory.last.instant.statistic,
            log_lambda=memory.last.instant.log_lambda,
            hypotheses=Priors(*sides.hypotheses),
            azimuth_rad=azimuth_rad,
            azimuth_std_rad=std_rad,
            azimuth_source=source,
            risk=sides.risks[k],
            confidence=sides.risks[k] / max(sum(sides.risks), TINY),
            advisory=advisory,
            alpha=self._alpha(evidence),
            entity_id=entity_id,
            horizon_s=arrival_s if interval_s is None else interval_s[1],
            within=within,
            time_to_visible_s=interval_s,
            sector_rad=sector(azimuth_rad, std_rad),
            evidence=evidence if is_named else None,
            held=held,
            not_advised=None if told is not None else self._why_none(k) if is_named else _UNNAMED,
        )

    def _why_none(self, side: int) -> str | None:
        """Return the reason for no advisory at a high risk; None if a vehicle is unlikely to come."""
        belief = self.memory.belief
        if self.sides.risks[side] <= self.model.site.street.birth:
            return None
        if self.memory.last.no_sequence == TOO_FEW:
            return "less than a second of sound: no alarm is raised yet"
        if not belief.has_news(self.memory.stamp_ns):
            return "nothing was measured for a second"
        if belief.alarm_nats[side] < belief.alarm_nats.max():
            return "one vehicle is likelier than two, and likelier on the other side"
        until = "come within three seconds" if belief.has_times else "be there"
        return f"it is not sure to {until}, or not for long enough"

    def _alpha(self, evidence: EvidenceTerms) -> float | None:
        """Return the share of hazard-free time in alarm, from the policy or the curve of a sequence model."""
        alpha, alarm = self.model.policy.alpha or None, self.memory.belief.alarm
        if evidence.hypothesis == "hidden" or alpha is None:
            return alpha
        return alarm.promise.alpha if evidence.hypothesis == "coming" and alarm and alarm.promise else None

    def _times(self) -> list[_Times]:
        """Return the chances by horizon, and the time to visible of an expected vehicle."""
        belief = self.memory.belief
        if not belief.has_times:
            return [(None, None)] * len(self.advisories)
        # In the form of a stream of one hop
        posterior = SequencePosterior(belief.coming[None], belief.margin_s)
        within = posterior.within()[0].tolist()
        soon = np.add.reduce(posterior.groups[0, :, :STATED], 1).tolist()
        # The times hold for a vehicle that comes; in an empty street they have no meaning.
        stated = [
            chance > (0.5 if told is None else 0.0)
            for told, chance in zip(self.advisories, soon, strict=True)
        ]
        intervals_s = posterior.time_to_visible_s()[0].tolist() if any(stated) else within
        names = [f"{end_s:g}" for end_s in HORIZONS_S]
        return [
            (dict(zip(names, chances, strict=True)), (row[0], row[1], row[2]) if is_stated else None)
            for chances, row, is_stated in zip(within, intervals_s, stated, strict=True)
        ]

    def _evidence(self) -> list[EvidenceTerms]:
        r"""Return the terms of each side's log-odds: of the belief, or of messages if only they raise it.

        With the log-odds :math:`L_j` after the prior, each source of sound, the looks, or messages,

        .. math:: t_j = L_j - L_{j-1}
        """
        belief, threshold = self.memory.belief, self._threshold_nats
        after = belief.log_odds(self.model.site.street)
        heard: Literal["coming", "hidden"] = "coming" if belief.has_times else "hidden"
        pieces = np.array(list(after.values()))
        pieces[1:] -= pieces[:-1].copy()
        terms = pieces.T.tolist()
        evidence = []
        for k, (own, decides) in enumerate(zip(terms, belief.decided_at(self.memory.stamp_ns), strict=True)):
            one, (nats, _) = self._raised[k], self._messages[k]
            if one is not None and one.announced:
                told = {"prior": own[0], "messages": nats - own[0]}
                evidence.append(EvidenceTerms("announced", told, nats, threshold))
            else:
                evidence.append(EvidenceTerms(heard, dict(zip(after, own, strict=True)), decides, threshold))
        return evidence
