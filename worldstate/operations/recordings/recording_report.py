"""Processing of one recording: its advisories relative to line-of-sight entry, and microphone health."""

import math
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from worldstate.adapters.datasets.ovad import TrueTrack
from worldstate.adapters.files.checkpoint_file import Checkpoint
from worldstate.adapters.files.file_io import line_writer
from worldstate.adapters.listener import Step, listen_steps
from worldstate.adapters.source import Source
from worldstate.ground.values import seconds
from worldstate.operations.metrics.approach_table import LONGEST_LEAD_S, onset_outcome
from worldstate.state import WorldState

from .channel_report import HealthLog, RecordingHealth
from .evidence_report import told_advisories


@dataclass(frozen=True, slots=True)
class WarningSummary:
    """Advisories of one recording relative to line-of-sight entry."""

    # Line-of-sight entry, seconds from the start; None if unknown or nothing approaches.
    t0_s: float | None
    # First onset from 5 s before `t0_s` on; without a `t0_s` the first onset of all.
    first_advisory_s: float | None
    lead_time_s: float | None  # `t0_s - first_advisory_s` if that onset is before line-of-sight entry
    # Onsets more than 5 s before `t0_s`, or all onsets of a hazard-free recording; None if neither is known.
    false_advisories_before: int | None
    # Onsets at or after `t0_s`, when the vehicle is in view or has just left it; None without a `t0_s`.
    advisories_after_t0: int | None
    advisory_onsets_s: tuple[float, ...]  # All rising edges of the advisory
    # The entity of the last advisory before `t0_s`; without a `t0_s` or such an advisory, that of the first
    # advisory from 5 s before `t0_s` on.
    hidden_entity_id: str | None
    visible_entity_id: str | None  # The first moving entity that came into view


def calibration_words(uncalibrated: int, hops: int) -> str:
    """Describe in words in how many hops the cues met a false-alarm budget.

    Examples
    --------
    >>> [calibration_words(n, 91) for n in (0, 3, 91)]
    ['calibrated', 'uncalibrated in 3 of 91 hops', 'uncalibrated']
    """
    if not uncalibrated:
        return "calibrated"
    return "uncalibrated" if uncalibrated == hops else f"uncalibrated in {uncalibrated} of {hops} hops"


@dataclass(slots=True)
class WarningMeter:
    """Counts states and advisories of a recording without storing them."""

    t0_s: float | None  # Line-of-sight entry on the clock of the states, seconds
    hazard_free: bool = False  # Whether the recording is known to contain no vehicle
    states: int = 0
    first_ns: int = 0
    last_ns: int = 0
    peak_risk: float | None = None  # Largest risk so far; None before the first state with a risk
    uncalibrated: int = 0  # Number of states without a budget
    unusable: int = 0  # Number of states with a cue that is not usable
    reasons: Counter[str] = field(default_factory=Counter)  # Number of states by reason
    sounds: set[str] = field(default_factory=set)  # Tracks of sound without a model
    _onsets: list[tuple[float, str | None]] = field(default_factory=list)
    _raised: bool = False
    _hidden_id: str | None = None
    _visible_id: str | None = None

    def update(self, state: WorldState) -> None:
        """Process the next state of the recording."""
        self.first_ns, self.last_ns = self.first_ns if self.states else state.stamp_ns, state.stamp_ns
        self.states += 1
        self.peak_risk = max((one for one in (self.peak_risk, state.risk) if one is not None), default=None)
        self.uncalibrated += not state.calibrated
        why_not = {str(one) for cue in state.cues for one in cue.why_not}
        if state.no_model is not None:
            why_not = {"no model"}
            self.sounds |= {one.id for one in state.entities if one.status is None}
        self.unusable += bool(why_not)
        self.reasons.update(why_not)
        raised = [cue for cue in state.cues if cue.advisory]
        if raised:
            now_s, told = state.time_s, max(raised, key=lambda cue: cue.risk or 0.0).entity_id
            if not self._raised:
                # The first advisory of a log may have begun before the log.
                since_ns = min(cue.advisory.since_ns for cue in raised if cue.advisory is not None)
                self._onsets.append((seconds(since_ns) if self.states == 1 else now_s, told))
            if self.t0_s is not None and now_s < self.t0_s:
                self._hidden_id = told or self._hidden_id
        self._raised = bool(raised)
        if self._visible_id is None:
            in_view = (one.id for one in state.entities if one.status == "visible" and one.moving)
            self._visible_id = next(in_view, None)

    @property
    def usable(self) -> str:
        """The number of states with usable cues, and of those with each reason against use, in words."""
        if not self.unusable:
            return "in every hop"
        given = ", ".join(f"{reason} {number}" for reason, number in self.reasons.items())
        return f"in {self.states - self.unusable} of {self.states} hops ({given})"

    @property
    def words(self) -> dict[str, object]:
        """Calibration and usability of the cues in words, and without a model the number of sound tracks."""
        stated = {"calibration": calibration_words(self.uncalibrated, self.states), "usable": self.usable}
        return stated | ({"sounds": len(self.sounds)} if "no model" in self.reasons else {})

    def summary(self) -> WarningSummary:
        """Return the summary of all states so far."""
        onsets_s = tuple(time_s for time_s, _ in self._onsets)
        found = None if self.t0_s is None else onset_outcome(onsets_s, self.t0_s)
        false = found.onsets_earlier if found else len(onsets_s) if self.hazard_free else None
        after = None if self.t0_s is None else sum(time_s >= self.t0_s for time_s in onsets_s)
        earliest_s = -math.inf if self.t0_s is None else self.t0_s - LONGEST_LEAD_S
        first_s, hidden_id = next((one for one in self._onsets if one[0] >= earliest_s), (None, None))
        return WarningSummary(
            t0_s=self.t0_s,
            first_advisory_s=first_s,
            lead_time_s=(found.lead_s or None) if found else None,
            false_advisories_before=false,
            advisories_after_t0=after,
            advisory_onsets_s=onsets_s,
            hidden_entity_id=self._hidden_id or hidden_id,
            visible_entity_id=self._visible_id,
        )


@dataclass(frozen=True, slots=True)
class RecordingReport:
    """Results of one recording.

    Parameters
    ----------
    warning : WarningSummary
        Advisories relative to line-of-sight entry.
    hops : int
        Number of decisions.
    peak_risk : float or None
        Largest risk of all hops; None if no hop has one.
    realtime_factor : float
        Seconds of audio per second of wall time, for the whole chain.
    health : RecordingHealth
        Faults of the microphones.
    words : mapping of str to object
        Whether the cues met a false-alarm budget, in how many hops they were usable, and without a model the
        number of tracked sounds.
    end : Checkpoint or None
        Belief and site after the last hop, to continue from; None without one.

    Examples
    --------
    >>> import numpy as np
    >>> import soundfile
    >>> from tempfile import TemporaryDirectory
    >>> from worldstate.adapters import open_source
    >>> noise = np.random.default_rng(0).uniform(-0.01, 0.01, (57_600, 56))
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "noise.wav"
    ...     soundfile.write(path, noise, 48_000)
    ...     report = run_recording(open_source(path))

    >>> report.to_dict()["lead_time_s"], report.hops
    (None, 3)
    """

    warning: WarningSummary
    hops: int
    peak_risk: float | None
    realtime_factor: float
    health: RecordingHealth
    words: Mapping[str, object]
    end: Checkpoint | None = None

    def to_dict(self) -> dict[str, object]:
        """Return the summary as values for JSON; unknown values are None, microphones are counted from 1."""
        figures = {"hops": self.hops, "peak_risk": self.peak_risk, "realtime_factor": self.realtime_factor}
        masked = {"masked_microphones": [channel + 1 for channel in self.health.masked_channels]}
        return asdict(self.warning) | figures | masked | {**self.words}


def run_recording(
    source: Source, *, states_path: Path | None = None, on_hop: Callable[[Step], None] = lambda step: None
) -> RecordingReport:
    """Process `source` to its end.

    Parameters
    ----------
    source : Source
        From `open_source`.
    states_path : Path, optional
        File for one snapshot per line; after an error no partial file remains.
    on_hop : callable
        Called after each hop, for progress.

    Raises
    ------
    InputFileError
        If a file of the source is damaged.

    Examples
    --------
    1.2 s of noise:

    >>> import numpy as np
    >>> import soundfile
    >>> from tempfile import TemporaryDirectory
    >>> from worldstate.adapters import open_source
    >>> noise = np.random.default_rng(0).uniform(-0.01, 0.01, (57_600, 56))
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "noise.wav"
    ...     soundfile.write(path, noise, 48_000)
    ...     report = run_recording(open_source(path))

    >>> report.hops, report.warning.first_advisory_s
    (3, None)
    """
    meter, health = WarningMeter(source.t0_s, source.hazard_free), HealthLog()
    started, end = time.perf_counter(), None
    with line_writer(states_path) as write:
        for step in listen_steps(source):
            write(step.state.to_json())
            meter.update(step.state)
            health.add(step.frame)
            on_hop(step)
            end = step.checkpoint
    elapsed_s, last_ns = time.perf_counter() - started, max(meter.last_ns, source.start_ns)
    factor = seconds(last_ns - source.start_ns) / elapsed_s
    figures = meter.states, meter.peak_risk, factor
    return RecordingReport(meter.summary(), *figures, health.summary(), meter.words, end)


def announcement(states: Iterable[WorldState], truth: Sequence[TrueTrack], vehicle: str = "a vehicle") -> str:
    """Return in one sentence how long each vehicle was announced before it came into sight.

    Parameters
    ----------
    states : iterable of WorldState
        States of one recording.
    truth : sequence of TrueTrack
        Its vehicles; those in sight from the start, or never, are skipped.
    vehicle : str
        Term for a vehicle.

    Examples
    --------
    >>> announcement([], [])
    'no vehicle came into sight, and none was announced'
    """
    onsets = defaultdict[str, list[float]](list)
    for one in told_advisories(states)[0]:
        onsets[one.direction].append(seconds(one.since_ns))
    came = sorted((*one.visible_s, _side(one)) for one in truth if one.visible_s and not one.in_view[0])
    if not came:
        told = ", and none was announced" if not onsets else ", although one was announced"
        return f"no vehicle came into sight{told}"
    sentences, before_s = [], dict[str, float]()
    for first_s, last_s, side in came:
        # An earlier announcement belongs to the previous vehicle and ended with its hand-over.
        own_s = [time_s for time_s in onsets[side] if time_s > before_s.get(side, -math.inf)]
        sentences.append(f"{vehicle} from the {side} was {_announced(own_s, first_s, last_s)}")
        before_s[side] = first_s
    return "; ".join(sentences)


def _side(track: TrueTrack) -> str:
    return "left" if track.azimuth_rad[track.in_view][0] > 0.0 else "right"


def _announced(onsets_s: Sequence[float], first_s: float, last_s: float) -> str:
    """Describe the onsets of a vehicle's side relative to the time in which it was in sight."""
    found = onset_outcome(onsets_s, first_s)
    if found.lead_s:
        return f"announced {found.lead_s:.1f} s before it came into sight"
    if found.onsets_earlier:
        return f"announced more than {LONGEST_LEAD_S:.0f} s before it came into sight"
    late_s = next((time_s - first_s for time_s in onsets_s if first_s <= time_s <= last_s), None)
    return "not announced" if late_s is None else f"announced {late_s:.1f} s after it came into sight"
