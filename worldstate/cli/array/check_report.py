"""What `worldstate array check` found, for people and machines; channels are counted from 1."""

from collections.abc import Iterator

from worldstate.adapters.audio.sound_file import Audio
from worldstate.cli.common.inputs import stance
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.health.channel_health import Fault
from worldstate.ground.serialisation import encode
from worldstate.ground.values import NotUsable
from worldstate.operations.recordings.channel_report import ChannelVerdict, RecordingHealth


def as_json(health: RecordingHealth, audio: Audio, array: MicrophoneArray) -> dict[str, object]:
    """Return the report as JSON-able values; channels are counted from 1, unknown is None."""
    rate = health.sample_rate
    return {
        "path": str(audio.path),
        "healthy": health.is_healthy,
        "channels": audio.channels,
        "sample_rate_hz": audio.sample_rate_hz,
        "duration_s": audio.duration_s,
        "array": stance(array),
        "ambiguity": array.ambiguity,
        "coherence": None if isinstance(health.coherence, NotUsable) else health.coherence,
        "masked_microphones": [channel + 1 for channel in health.masked_channels],
        "faults": [_fault_json(verdict) for verdict in health.verdicts],
        "n_dropouts": health.n_dropouts,
        "dropouts": [encode(one) for one in health.dropouts],
        "measured_rate_hz": rate and rate.rate_hz,
        "measured_rate_std_hz": rate and rate.std_hz,
    }


def _fault_json(verdict: ChannelVerdict) -> dict[str, object]:
    other = None if verdict.looks_like is None else verdict.looks_like + 1
    counted = {"channel": verdict.channel + 1, "looks_like": other, "masked": verdict.masked}
    return encode(verdict) | counted


def as_text(health: RecordingHealth, audio: Audio, array: MicrophoneArray) -> Iterator[str]:
    """Yield the lines of the report."""
    alias = array.alias_hz()
    yield f"{audio.path}: {audio.channels} channels, {audio.sample_rate_hz} Hz, {audio.duration_s:.1f} s"
    yield f"array: {stance(array)}, alias-free to {alias:.0f} Hz"
    if health.verdicts:
        yield ""
        yield from _table(health.verdicts)
    yield from _other_lines(health)
    yield ""
    yield "healthy" if health.is_healthy else _conclusion(health)


def _table(verdicts: tuple[ChannelVerdict, ...]) -> Iterator[str]:
    yield f"{'channel':>7}  {'fault':<12}  {'since':>6}  {'hops':>5}  what and what to do"
    for card in _cards(verdicts):
        first, last, verdict = card[0].channel + 1, card[-1].channel + 1, card[0]
        channels = str(first) if first == last else f"{first}-{last}"
        when = f"{verdict.first_s:5.1f}s  {100 * verdict.share:4.0f}%"
        yield f"{channels:>7}  {verdict.fault.value:<12}  {when}  {_advice(verdict)}"


def _cards(verdicts: tuple[ChannelVerdict, ...]) -> list[list[ChannelVerdict]]:
    """Put consecutive channels with one delay or drift together: they are one card."""
    cards: list[list[ChannelVerdict]] = []
    for verdict in verdicts:
        last = cards[-1][-1] if cards else None
        same = last and verdict.std is not None and (last.fault, last.value) == (verdict.fault, verdict.value)
        if same and last and last.channel + 1 == verdict.channel:
            cards[-1].append(verdict)
        else:
            cards.append([verdict])
    return cards


def _advice(verdict: ChannelVerdict) -> str:
    value, std = verdict.value, verdict.std or 0.0
    other = (verdict.looks_like or 0) + 1
    late, drift = (
        f"{1e3 * abs(value):.2f} +- {1e3 * std:.2f} ms",
        f"{1e6 * abs(value):.0f} +- {1e6 * std:.0f}",
    )
    return {
        Fault.DEAD: "silent: check plug, cable, phantom power",
        Fault.INTERMITTENT: f"out or crackling in {100 * value:.0f} % of the time: check plug and cable",
        Fault.NOISY: f"{100 * max(value, 0):.0f} % of the usual coherence: own noise, or another place",
        Fault.INVERTED: "polarity is reversed: cross its two leads",
        Fault.SWAPPED: f"fits the place of channel {other}: exchange plugs, or the lines of the array file",
        Fault.CLIPPED: f"{100 * value:.2g} % of samples at its limit: lower the gain",
        Fault.OFFSET: f"mean is {100 * value:.0f} % of the peak-to-peak sound: check bias and coupling",
        Fault.LEVEL: f"{value:+.0f} dB against the median channel: check gain and sensitivity",
        Fault.GUSTS: f"loud by itself in {100 * value:.0f} % of ten seconds, wind: fit a windscreen",
        Fault.DELAY: f"{late} {_when(value)} than the others: start the cards together, by one trigger",
        Fault.DRIFT: f"{drift} us a second {_when(value)}: a clock of its own, connect the word clocks",
    }[verdict.fault]


def _when(value: float) -> str:
    return "later" if value > 0.0 else "earlier"


def _other_lines(health: RecordingHealth) -> Iterator[str]:
    if health.n_dropouts:
        shown = ", ".join(f"{one.kind} at sample {one.sample}" for one in health.dropouts[:5])
        more = ", ..." if health.n_dropouts > 5 else ""
        count = "1 dropout" if health.n_dropouts == 1 else f"{health.n_dropouts} dropouts"
        yield f"{count} ({shown}{more}): check the recorder's buffers"
    if (rate := health.sample_rate) is not None:
        ppm = f"{rate.rate_hz:.2f} +- {rate.std_hz:.2f} Hz, {1e6 * rate.error:+.0f} millionths off"
        wrong = ": the header is wrong, or samples are missing" if rate.is_wrong else ""
        yield f"sample rate by the other clock: {ppm}{wrong}"
    if isinstance(health.coherence, NotUsable):
        yield f"inverted and noisy microphones, swapped ones of many not judged: {health.coherence.reason}"


def _conclusion(health: RecordingHealth) -> str:
    kinds: dict[str, set[int]] = {}
    for verdict in health.verdicts:
        kinds.setdefault(verdict.fault.value, set()).add(verdict.channel + 1)
    parts = [f"{kind} {', '.join(map(str, sorted(found)))}" for kind, found in kinds.items()]
    masked = len(health.masked_channels)
    left_out = f"; {masked} left out by the front-end" if masked else ""
    return f"not healthy: {'; '.join(parts) or 'see above'}{left_out}"
