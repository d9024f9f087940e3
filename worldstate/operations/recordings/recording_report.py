"""Run one recording through the whole chain: how its advisories stood to line-of-sight entry, its health."""

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from worldstate.adapters.files.checkpoint_file import Checkpoint
from worldstate.adapters.listener import Step, listen_steps
from worldstate.adapters.source import Source
from worldstate.adapters.state_log import states_writer
from worldstate.ground.values import seconds

from .channel_report import HealthLog, RecordingHealth
from .warning import WarningMeter, WarningSummary


@dataclass(frozen=True, slots=True)
class RecordingReport:
    """Outcome of one recording.

    Parameters
    ----------
    warning : WarningSummary
        Advisories against line-of-sight entry.
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

    >>> report.to_dict()["lead_time_s"], report.hops
    (None, 3)
    """

    warning: WarningSummary
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
    states_path: Path | None = None,
    on_hop: Callable[[Step], None] = lambda step: None,
) -> RecordingReport:
    """Listen to `source` to its end.

    Parameters
    ----------
    source : Source
        From `open_source`.
    states_path : Path, optional
        Where to write one snapshot a line; nothing half-written is left on an error.
    on_hop : callable
        Called after each hop, for progress.

    Returns
    -------
    RecordingReport
        Warnings and health.

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
    meter, health = WarningMeter(source.t0_s, source.hazard_free), HealthLog()
    started, end = time.perf_counter(), None
    with states_writer(states_path) as write:
        for step in listen_steps(source):
            write(step.state.to_json())
            meter.update(step.state)
            health.add(step.frame)
            on_hop(step)
            end = step.checkpoint
    elapsed_s, last_ns = time.perf_counter() - started, max(meter.last_ns, source.start_ns)
    return RecordingReport(
        warning=meter.summary(),
        hops=meter.states,
        peak_risk=meter.peak_risk,
        realtime_factor=seconds(last_ns - source.start_ns) / elapsed_s,
        health=health.summary(),
        end=end,
    )
