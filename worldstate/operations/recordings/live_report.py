"""What came of a run on running sensors, and what it cost: a few numbers, however long it lasts."""

from worldstate.adapters.live.live_listening import CostMeter, LatencyMeter, LiveStep
from worldstate.adapters.live.live_sound import LiveSound
from worldstate.adapters.source import Source

from .warning import WarningMeter


class LiveReport:
    """Take every hop of a run; say at its end how late states were, what was lost, and what was warned of."""

    def __init__(self, source: Source) -> None:
        self._warnings = WarningMeter(source.t0_s, source.hazard_free)
        self._latency, self._cost = LatencyMeter(), CostMeter()
        self._states, self._peak_risk = 0, 0.0

    def add(self, live: LiveStep) -> None:
        """Take a hop."""
        state = live.step.state
        self._latency.add(live.latency_s)
        self._warnings.update(state)
        self._states, self._peak_risk = self._states + 1, max(self._peak_risk, state.risk)

    def to_dict(self, sound: LiveSound) -> dict[str, object]:
        """Return the summary as JSON-able values; unknown is None."""
        latency_s = self._latency.quantile_s
        return {
            "states": self._states,
            "sound_s": sound.frames / sound.sample_rate_hz,
            "overruns": sound.overruns,
            "lost_s": sound.lost_s,
            "latency_median_s": latency_s(0.5),
            "latency_p99_s": latency_s(0.99),
            "latency_largest_s": latency_s(1.0),
            **self._cost.read(),
            "peak_risk": self._peak_risk,
            "advisory_onsets_s": list(self._warnings.summary().advisory_onsets_s),
        }
