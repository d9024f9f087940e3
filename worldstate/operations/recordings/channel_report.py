"""Report of the microphone faults of a recording: table, text and figure."""

import itertools
import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from worldstate.adapters.audio.sound_file import Audio
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.health.channel_health import MASKED_FAULTS, ArrayHealth, ChannelFault, Dropout, Fault
from worldstate.frontend.health.common_sound import ARRAY_FAULTS, NOTHING_IN_COMMON, OUT_OF_PLACE
from worldstate.frontend.health.position_check import NOTHING_AGAINST, PositionVerdict
from worldstate.frontend.stream import AcousticFrame
from worldstate.ground.checks import in_range
from worldstate.ground.serialisation import Via, encode
from worldstate.ground.typing import BoolArray
from worldstate.ground.values import LEAST_HEARD, NotUsable, seconds
from worldstate.operations import figure_style as style

# For a rate by another clock: an error of 4 standard deviations is significant (one false report in 16,000).
_SIGNIFICANT = 4.0
# Crystals are off by about as much; a smaller error changes neither bearing nor level.
_TOLERATED = 1e-5
# Other faults that each fault explains: they may be reported before it, or in some hops.
_EXPLAINS = {
    Fault.GUSTS: {Fault.NOISY, Fault.INTERMITTENT, Fault.DEAD, Fault.DELAY, Fault.DRIFT},
    Fault.SWAPPED: {Fault.NOISY},
    Fault.DELAY: {Fault.NOISY},
    Fault.DRIFT: {Fault.NOISY},
}
# Each of these faults also misplaces the waves of other channels. The one seen in most hops is the cause, and
# the remaining faults show after it is fixed.
_MISPLACED = frozenset({Fault.SWAPPED, Fault.DELAY, Fault.DRIFT})
# The position of a channel with one of these faults cannot be checked, because it does not record waves
# correctly.
_DEAF = frozenset({Fault.DEAD, Fault.INTERMITTENT, Fault.NOISY, Fault.INVERTED, Fault.DELAY, Fault.DRIFT})
# Possible causes if the whole array is unusable.
_CAUSES = {
    NOTHING_IN_COMMON: "wind, sample format, leads",
    OUT_OF_PLACE: "order, leads and start of the channels, sample format",
}
# Dropouts beyond this number are counted, but not listed.
_LISTED_DROPOUTS = 100
# Eleven faults, distinguished by six colours and two markers.
_MARKS: dict[Fault, dict[str, Any]] = {
    fault: {"color": style.CATEGORIES[i % 6], "marker": "oD"[i // 6], "alpha": 0.8, "lw": 0}
    for i, fault in enumerate(Fault)
}
# Areas of markers in points squared, for a number of two digits and for a line of the legend; then the ratio
# of a second fault's area to the first.
_AREA, _LEGEND_AREA, _SMALLER = 240.0, 80.0, 0.55
_VIEWS = {
    (1, 2): "seen from behind",
    (0, 1): "seen from above, forward is to the right",
    (0, 2): "seen from the right, forward is to the right",
}


@dataclass(frozen=True, slots=True)
class ChannelVerdict:
    """One fault of one channel in a recording.

    Examples
    --------
    >>> ChannelVerdict(2, Fault.DEAD, 1.0, 1.0, 1.0).masked
    True
    """

    channel: int  # Channel number, from 0
    fault: Annotated[Fault, Via(str, str, Fault)]
    share: float  # Share of the hops in which it was detected
    first_s: float  # End of the first of these hops, seconds
    value: float  # Last size: see `worldstate.frontend.health.channel_health.ChannelFault`
    looks_like: int | None = None  # Swapped: the channel whose position it fits
    std: float | None = None  # Delayed and drifting: standard deviation of the value

    @property
    def masked(self) -> bool:
        """Whether the front-end excludes such a channel."""
        return self.fault in MASKED_FAULTS


@dataclass(frozen=True, slots=True)
class RateEstimate:
    """A measured sample rate.

    Examples
    --------
    >>> RateEstimate(47_998.0, 0.1, 48_000.0).is_wrong, RateEstimate(47_999.8, 0.1, 48_000.0).is_wrong
    (True, False)
    """

    rate_hz: float  # Estimate and standard deviation
    std_hz: float
    nominal_hz: float  # Rate in the header of the stream

    @property
    def error(self) -> float:
        """Relative error of the nominal rate."""
        return self.rate_hz / self.nominal_hz - 1.0

    @property
    def is_wrong(self) -> bool:
        """Whether the nominal rate is off by more than 10 ppm and four standard deviations."""
        return abs(self.error) > max(_SIGNIFICANT * self.std_hz / self.nominal_hz, _TOLERATED)


def rate_from_duration(
    n_samples: int, duration_s: float, duration_std_s: float, nominal_hz: float
) -> RateEstimate:
    r"""Estimate the sample rate from a recording's duration by another clock, such as that of a camera.

    .. math:: \hat f_s = n / T, \qquad \sigma_{\hat f} = \hat f_s\, \sigma_T / T
    """
    in_range("duration_s", duration_s, 0.0, math.inf, open_low=True, open_high=True)
    in_range("duration_std_s", duration_std_s, 0.0, math.inf, open_low=True, open_high=True)
    rate = n_samples / duration_s
    return RateEstimate(rate, rate * duration_std_s / duration_s, nominal_hz)


@dataclass(frozen=True, slots=True)
class RecordingHealth:
    """All faults of a recording.

    Examples
    --------
    >>> HealthLog().summary().is_healthy
    True
    """

    verdicts: tuple[ChannelVerdict, ...]  # Faults by channel; empty without a fault
    dropouts: tuple[Dropout, ...]  # The first hundred
    n_dropouts: int  # All of them
    coherence: float | NotUsable  # At the end: see `worldstate.frontend.health.channel_health.ArrayHealth`
    sample_rate: RateEstimate | None = None  # Sample rate measured with another clock
    positions: PositionVerdict = NOTHING_AGAINST
    unheard: str | None = None  # Reason why the array is unusable in most hops

    @property
    def is_healthy(self) -> bool:
        """Whether the recording has no fault."""
        rate_is_wrong = self.sample_rate is not None and self.sample_rate.is_wrong
        wrong = self.verdicts or self.n_dropouts or rate_is_wrong or self.unheard
        return self.positions.fits and not wrong

    def hears_waves(self, n_channels: int) -> BoolArray:
        """Return which channels share the sound of the others, at any position, shape (M,)."""
        deaf = {one.channel for one in self.verdicts if one.fault in _DEAF}
        return np.array([channel not in deaf for channel in range(n_channels)])

    @property
    def masked_channels(self) -> tuple[int, ...]:
        """Channels, from 0, that the front-end excluded at any time."""
        return tuple(sorted({verdict.channel for verdict in self.verdicts if verdict.masked}))


class HealthLog:
    """Collect the microphone faults of a recording from its frames.

    Examples
    --------
    >>> import numpy as np
    >>> from worldstate.frontend.array.microphone_array import MicrophoneArray
    >>> from worldstate.frontend.stream import FrontEnd
    >>> array = MicrophoneArray([[0, 0.1, 0], [0, 0.0, 0], [0, -0.1, 0]])
    >>> sound = np.random.default_rng(0).standard_normal((24_000, 1)) * [1.0, 1.0, 0.0]
    >>> log = HealthLog()
    >>> for frame in FrontEnd(array, 16_000).process(sound):
    ...     log.add(frame)
    >>> [(verdict.channel, verdict.fault.value) for verdict in log.summary().verdicts]
    [(2, 'dead')]
    """

    def __init__(self) -> None:
        self._n_hops = 0
        self._unheard: Counter[str | None] = Counter()
        # Number of hops of each fault of a channel, the end of the first one, and the latest report
        self._seen: dict[tuple[int, Fault], tuple[int, float, ChannelFault]] = {}
        self._dropouts: list[Dropout] = []
        self._latest: ArrayHealth | None = None

    def add(self, frame: AcousticFrame) -> None:
        """Process one hop; frames without a health report are taken as healthy."""
        self._n_hops += 1
        self._unheard[frame.unheard] += frame.heard is not None and frame.heard < LEAST_HEARD
        health = frame.health
        if isinstance(health, NotUsable):
            return
        n_new = health.n_dropouts - (self._latest.n_dropouts if self._latest else 0)
        if n_new and len(self._dropouts) < _LISTED_DROPOUTS:
            self._dropouts.extend(health.dropouts[-n_new:])
        self._latest = health
        for fault in health.faults:
            key = fault.channel, fault.fault
            hops, first_s, _ = self._seen.get(key, (0, seconds(frame.stamp_ns), fault))
            self._seen[key] = hops + 1, first_s, fault

    def summary(self) -> RecordingHealth:
        """Return the verdicts so far."""
        latest = self._latest
        dropouts, count = tuple(self._dropouts[:_LISTED_DROPOUTS]), latest.n_dropouts if latest else 0
        coherence = latest.coherence if latest else NotUsable("no sound so far")
        unheard = next((why for why in ARRAY_FAULTS if 2 * self._unheard[why] > self._n_hops), None)
        return RecordingHealth(self._verdicts(), dropouts, count, coherence, unheard=unheard)

    def _verdicts(self) -> tuple[ChannelVerdict, ...]:
        explained = {(channel, other) for channel, fault in self._seen for other in _EXPLAINS.get(fault, ())}
        verdicts = [
            ChannelVerdict(*key, hops / self._n_hops, first_s, last.value, last.looks_like, last.std)
            for key, (hops, first_s, last) in sorted(self._seen.items(), key=lambda item: item[0])
            if key not in explained and not self._is_other_half(*key)
        ]
        return _one_cause(verdicts)

    def _is_other_half(self, channel: int, fault: Fault) -> bool:
        """Return whether the channel has the other fault, dead or intermittent, in more hops."""
        others = {Fault.DEAD: Fault.INTERMITTENT, Fault.INTERMITTENT: Fault.DEAD}
        other = self._seen.get((channel, others.get(fault, fault)))
        return other is not None and other[0] > self._seen[channel, fault][0]


def _one_cause(verdicts: list[ChannelVerdict]) -> tuple[ChannelVerdict, ...]:
    """Keep the misplaced channels that have the main fault in at least half of its share of hops."""
    misplaced = [verdict for verdict in verdicts if verdict.fault in _MISPLACED]
    if any(verdict.fault is Fault.DRIFT for verdict in misplaced):
        # A drift begins as a delay.
        misplaced = [verdict for verdict in misplaced if verdict.fault is not Fault.DELAY]
    cause = max(misplaced, key=lambda verdict: verdict.share, default=None)
    return tuple(
        verdict
        for verdict in verdicts
        if verdict.fault not in _MISPLACED
        or (cause and verdict.fault is cause.fault and 2.0 * verdict.share >= cause.share)
    )


def write_array_figure(array: MicrophoneArray, health: RecordingHealth, path: Path) -> None:
    """Draw the microphones along their two widest axes, coloured by fault; channels are counted from 1."""
    across, up = sorted(np.argsort(array.aperture_m)[-2:].tolist())
    place = array.centred_m[:, [across, up]]
    with style.figure_file(path, 7.5, 6.0) as figure:
        axes = figure.add_subplot()
        well: dict[str, Any] = {"color": "white", "edgecolors": "0.6", "lw": 0.8}
        axes.scatter(place[:, 0], place[:, 1], s=_AREA, **well)
        axes.scatter([], [], s=_LEGEND_AREA, label="well", **well)
        drawn: Counter[int] = Counter()
        for fault in sorted({verdict.fault for verdict in health.verdicts}):
            channels = [verdict.channel for verdict in health.verdicts if verdict.fault == fault]
            areas = [_AREA * _SMALLER ** drawn[channel] for channel in channels]
            axes.scatter(place[channels, 0], place[channels, 1], s=areas, **_MARKS[fault])
            axes.scatter([], [], s=_LEGEND_AREA, **_MARKS[fault], label=fault.value)
            drawn.update(channels)
        for channel, point in enumerate(place):
            axes.annotate(str(channel + 1), point, ha="center", va="center", fontsize=7.5)
        for verdict in health.verdicts:
            if verdict.looks_like is not None:
                # Curved, so that the two arrows of a swapped pair do not overlap.
                arrow = {"arrowstyle": "->", "color": "black", "shrinkA": 9, "shrinkB": 9}
                arrow["connectionstyle"] = "arc3,rad=0.2"
                axes.annotate("", place[verdict.looks_like], place[verdict.channel], arrowprops=arrow)
        axes.set(xlabel=f"{'xyz'[across]} (m)", ylabel=f"{'xyz'[up]} (m)", aspect="equal")
        axes.margins(0.08)  # so that markers at the edge are complete
        if across == 1:
            axes.invert_xaxis()  # so that left is on the left
        axes.set_title(f"{array.n_microphones} microphones {_VIEWS[across, up]}; channels from 1")
        style.legend_beside(axes)


def as_json(health: RecordingHealth, audio: Audio, array: MicrophoneArray, stance: str) -> dict[str, object]:
    """Return the report as values for JSON; channels are counted from 1, and unknown values are None."""
    rate, positions = health.sample_rate, health.positions
    order = None if positions.order is None else [place + 1 for place in positions.order]
    return {
        "path": str(audio.path),
        "healthy": health.is_healthy,
        "channels": audio.channels,
        "sample_rate_hz": audio.sample_rate_hz,
        "duration_s": audio.duration_s,
        "array": stance,
        "ambiguity": array.ambiguity,
        "coherence": None if isinstance(health.coherence, NotUsable) else health.coherence,
        "masked_microphones": [channel + 1 for channel in health.masked_channels],
        "condition": "working" if health.is_healthy else "impaired",
        "unheard": health.unheard,
        "positions": encode(positions) | {"fit": positions.fits, "order": order},
        "faults": [_fault_json(verdict) for verdict in health.verdicts],
        "n_dropouts": health.n_dropouts,
        "dropouts": [encode(one) for one in health.dropouts],
        "measured_rate_hz": rate and rate.rate_hz,
        "measured_rate_std_hz": rate and rate.std_hz,
    }


def _fault_json(verdict: ChannelVerdict) -> dict[str, object]:
    other = None if verdict.looks_like is None else verdict.looks_like + 1
    return encode(verdict) | {"channel": verdict.channel + 1, "looks_like": other, "masked": verdict.masked}


def as_text(health: RecordingHealth, audio: Audio, array: MicrophoneArray, stance: str) -> Iterator[str]:
    """Yield the lines of the report."""
    yield f"{audio.path}: {audio.channels} channels, {audio.sample_rate_hz} Hz, {audio.duration_s:.1f} s"
    yield f"array: {stance}, alias-free to {array.alias_hz():.0f} Hz"
    if health.verdicts:
        yield ""
        yield from _table(health.verdicts)
    yield from _position_lines(health.positions)
    yield from _other_lines(health)
    yield ""
    yield "healthy" if health.is_healthy else _conclusion(health)


def _table(verdicts: tuple[ChannelVerdict, ...]) -> Iterator[str]:
    yield f"{'channel':>7}  {'fault':<12}  {'since':>6}  {'hops':>5}  finding and remedy"
    for _, card in itertools.groupby(enumerate(verdicts), _card):
        each = [verdict for _, verdict in card]
        first, last = each[0], each[-1].channel + 1
        channels = str(last) if len(each) == 1 else f"{first.channel + 1}-{last}"
        when = f"{first.first_s:5.1f}s  {100 * first.share:4.0f}%"
        yield f"{channels:>7}  {first.fault.value:<12}  {when}  {_advice(first)}"


def _card(numbered: tuple[int, ChannelVerdict]) -> object:
    """Return what verdicts of one sound card have in common: consecutive channels, equal delay or drift."""
    number, verdict = numbered
    return number if verdict.std is None else (verdict.channel - number, verdict.fault, verdict.value)


_MEND = "exchange the plugs or the lines of the array file"


def _advice(verdict: ChannelVerdict) -> str:
    value, std = verdict.value, verdict.std or 0.0
    other = (verdict.looks_like or 0) + 1
    late = f"{1e3 * abs(value):.2f} +- {1e3 * std:.2f} ms"
    drift = f"{1e6 * abs(value):.0f} +- {1e6 * std:.0f}"
    return {
        Fault.DEAD: "no signal: check the plug, the cable and the phantom power",
        Fault.INTERMITTENT: f"no signal or crackling {100 * value:.0f} % of the time: check plug and cable",
        Fault.NOISY: f"{100 * max(value, 0):.0f} % of the usual coherence: own noise or another position",
        Fault.INVERTED: "polarity reversed: exchange its two leads",
        Fault.SWAPPED: f"fits the position of channel {other}: {_MEND}",
        Fault.CLIPPED: f"{100 * value:.2g} % of the samples are clipped: lower the gain",
        Fault.OFFSET: f"mean is {100 * value:.0f} % of the peak-to-peak amplitude: check bias and coupling",
        Fault.LEVEL: f"{value:+.0f} dB relative to the median channel: check gain and sensitivity",
        Fault.GUSTS: f"louder than the others in {100 * value:.0f} % of ten seconds: fit a windscreen",
        Fault.DELAY: f"{late} {_when(value)} than the others: start the cards together, by one trigger",
        Fault.DRIFT: f"{drift} us per second {_when(value)}: its own clock: connect the word clocks",
    }[verdict.fault]


def _when(value: float) -> str:
    return "later" if value > 0.0 else "earlier"


def _position_lines(positions: PositionVerdict) -> Iterator[str]:
    if positions.order is not None:
        yield f"positions: {_order_text(positions.order)}"
    if positions.size is not None:
        better = f"{positions.size:.3g} times the given size fits better"
        yield f"positions: {better}: check the radius and the unit"
    if positions.mounting:
        fits = " or ".join(positions.mounting)
        yield f"mounting: {fits}: the sound does not come from the azimuth of --heard-from"
    yield from (f"not decided: {unjudged}" for unjudged in positions.unjudged)


def _order_text(order: tuple[int, ...]) -> str:
    moved = [str(channel + 1) for channel, place in enumerate(order) if channel != place]
    if len(moved) == 2:
        return f"channels {' and '.join(moved)} are exchanged: {_MEND}"
    if moved:
        return f"the channels belong to the positions {', '.join(str(place + 1) for place in order)}: {_MEND}"
    return "the sound fits no better in this order than in a random one: check the order of the array file"


def _other_lines(health: RecordingHealth) -> Iterator[str]:
    if health.n_dropouts:
        shown = ", ".join(f"{one.kind} at sample {one.sample}" for one in health.dropouts[:5])
        more = ", ..." if health.n_dropouts > 5 else ""
        count = "1 dropout" if health.n_dropouts == 1 else f"{health.n_dropouts} dropouts"
        yield f"{count} ({shown}{more}): check the recorder's buffers"
    if (rate := health.sample_rate) is not None:
        ppm = f"{rate.rate_hz:.2f} +- {rate.std_hz:.2f} Hz, {1e6 * rate.error:+.0f} ppm off"
        wrong = ": the header is wrong, or samples are missing" if rate.is_wrong else ""
        yield f"sample rate by the other clock: {ppm}{wrong}"
    if isinstance(health.coherence, NotUsable):
        yield f"inverted, noisy and swapped microphones not tested: {health.coherence.reason}"


def _conclusion(health: RecordingHealth) -> str:
    kinds: dict[str, set[int]] = {}
    for verdict in health.verdicts:
        kinds.setdefault(verdict.fault.value, set()).add(verdict.channel + 1)
    parts = [f"{kind} {', '.join(map(str, sorted(found)))}" for kind, found in kinds.items()]
    parts += [f"{health.unheard} ({_CAUSES[health.unheard]})"] if health.unheard else []
    parts += [] if health.positions.fits else ["the sound contradicts the positions"]
    masked = len(health.masked_channels)
    left_out = f"; {masked} excluded by the front-end" if masked else ""
    return f"not healthy: {'; '.join(parts) or 'see above'}{left_out}"
