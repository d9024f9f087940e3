"""The whole chain on running sensors: one state a hop, with the time that it took."""

from collections.abc import Iterator
from dataclasses import dataclass

from worldstate.adapters.listen import Source, Step, listen_steps
from worldstate.ground.errors import InvalidArgumentError

from .live_sound import LiveSound


@dataclass(frozen=True, slots=True)
class LiveStep:
    """One hop, as `Step` has it, and its age."""

    step: Step
    latency_s: float  # From the capture of the hop's last sample to the state
    overruns: int  # Times that sound was lost up to now
    lost_s: float  # Seconds of sound that were lost up to now


def live_steps(source: Source) -> Iterator[LiveStep]:
    """Yield every hop of a source whose sound is a `LiveSound`, as soon as it is known."""
    sound = source.sound
    if not isinstance(sound, LiveSound):
        got = source.audio_path
        raise InvalidArgumentError(f"source: expected one whose sound is a LiveSound, got {got}")
    for step in listen_steps(source):
        latency_s = sound.age_s(step.frame.sample_index)
        yield LiveStep(step, latency_s, sound.overruns, sound.lost_s)
