"""Run one recording through the whole chain and keep what the figures need, hop by hop."""

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from worldstate.adapters.files.checkpoint_file import Checkpoint
from worldstate.adapters.listener import Step, listen_steps
from worldstate.adapters.source import Source
from worldstate.adapters.state_log import states_writer
from worldstate.ground.values import seconds

from .channel_report import HealthLog, RecordingHealth
from .hop_table import HopTable
from .timeline import Timeline
from .true_track import read_true_tracks
from .warning import WarningMeter, WarningSummary

# An entity is drawn where it more likely exists than not.
LIKELY = 0.5
SIDES = ("left", "right")
# The sides' columns: whether an advisory of that side is on.
_COLUMNS = ("time_s", "statistic", "risk", *SIDES, "srp")


@dataclass(frozen=True, slots=True)
class RecordingReport:
    """Outcome of one recording.

    Parameters
    ----------
    warning : WarningSummary
        Advisories against line-of-sight entry.
    timeline : Timeline
        What the figure draws.
    hops : int
        Decisions taken.
    peak_risk : float
        Largest risk of all hops.
    realtime_factor : float
        Seconds of audio per second of wall time, the whole chain.
    health : RecordingHealth
        What was wrong with the microphones.
    end : Checkpoint or None
        Belief and site after the last hop, to go on from; None where there was none.

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

    >>> report.to_dict()["lead_time_s"], report.timeline.hops.time_s.tolist()
    (None, [1.0, 1.1, 1.2])
    """

    warning: WarningSummary
    timeline: Timeline
    hops: int
    peak_risk: float
    realtime_factor: float
    health: RecordingHealth
    end: Checkpoint | None = None

    def to_dict(self) -> dict[str, object]:
        """Return the summary as JSON-able values; unknown is None, microphones are counted from 1."""
        figures = {"hops": self.hops, "peak_risk": self.peak_risk, "realtime_factor": self.realtime_factor}
        masked = {"masked_microphones": [channel + 1 for channel in self.health.masked_channels]}
        return asdict(self.warning) | figures | masked


def run_recording(
    source: Source,
    *,
    title: str = "",
    states_path: Path | None = None,
    on_hop: Callable[[Step], None] = lambda step: None,
) -> RecordingReport:
    """Listen to `source` to its end.

    Parameters
    ----------
    source : Source
        From `open_source`.
    title : str
        Heading of the timeline.
    states_path : Path, optional
        Where to write one snapshot a line; nothing half-written is left on an error.
    on_hop : callable
        Called after each hop, for progress.

    Returns
    -------
    RecordingReport
        Warnings, timeline and health.

    Raises
    ------
    InputFileError
        If a file of the source is damaged.

    Examples
    --------
    A second and a fifth of noise:

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
    log = _HopLog(WarningMeter(source.t0_s, source.hazard_free))
    started, end = time.perf_counter(), None
    with states_writer(states_path) as write:
        for step in listen_steps(source):
            write(step.state.to_json())
            log.add(step)
            on_hop(step)
            end = step.checkpoint
    elapsed_s, last_ns = time.perf_counter() - started, max(log.meter.last_ns, source.start_ns)
    return RecordingReport(
        warning=log.meter.summary(),
        timeline=log.timeline(source, title),
        hops=log.meter.states,
        peak_risk=log.meter.peak_risk,
        realtime_factor=seconds(last_ns - source.start_ns) / elapsed_s,
        health=log.health.summary(),
        end=end,
    )


@dataclass(slots=True)
class _HopLog:
    """A few numbers a hop: an hour of audio stays within some ten megabytes."""

    meter: WarningMeter
    health: HealthLog = field(default_factory=HealthLog)
    rows: list[tuple[Any, ...]] = field(default_factory=list)
    entities: dict[str, list[tuple[float, float, float, bool]]] = field(default_factory=dict)
    boxes: list[tuple[float, float]] = field(default_factory=list)
    azimuths_rad: np.ndarray = field(default_factory=lambda: np.empty(0))

    def add(self, step: Step) -> None:
        state, frame, now_s = step.state, step.frame, seconds(step.state.stamp_ns)
        self.meter.update(state)
        self.health.add(frame)
        statistic = max((cue.statistic for cue in state.cues), default=0.0)
        raised = [cue.direction for cue in state.cues if cue.advisory]
        sides = [side in raised for side in SIDES]
        self.rows.append((now_s, statistic, state.risk, *sides, frame.srp.astype(np.float32)))
        self.azimuths_rad = frame.azimuths_rad
        for entity in state.entities:
            if entity.moving and entity.existence_probability >= LIKELY:
                row = now_s, entity.azimuth_rad, entity.azimuth_std_rad, entity.status == "hidden"
                self.entities.setdefault(entity.id, []).append(row)
        self.boxes += [(now_s, seen.azimuth_rad) for seen in step.measurement.sightings if seen.moving]

    def timeline(self, source: Source, title: str) -> Timeline:
        return Timeline(
            hops=HopTable.of_rows(_COLUMNS, self.rows),
            threshold=source.policy.gamma,
            alpha=source.policy.alpha,
            azimuths_rad=self.azimuths_rad,
            entities=tuple(np.array(rows, dtype=np.float64) for rows in self.entities.values()),
            sightings=np.array(self.boxes, dtype=np.float64).reshape(-1, 2),
            t0_s=source.t0_s,
            truth=read_true_tracks(source.audio_path.parent),
            title=title,
        )
