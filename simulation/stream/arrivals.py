"""Arrivals: every flow is a Poisson process, and every arrival is one vehicle or several."""

from collections.abc import Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np

from worldstate.ground.typing import FloatArray
from worldstate.simulation.scene.kinds import VehicleKind, vehicle_kind
from worldstate.simulation.scene.settings import (
    EGO_STOPS_AFTER_S,
    SimulationSettings,
    SoundSettings,
    with_sounds,
)
from worldstate.simulation.scene.vehicle import EgoMotion

from .manoeuvres import EARSHOT_M, LEFT, MANOEUVRES, RIGHT, Manoeuvre, behind, draw_driver
from .settings import HAZARDS, StreamSettings, Traffic

TOGETHER_S = 0.7  # Standard deviation of the time between two vehicles that come from both sides at once
LONGEST_QUEUE, FAR = 8, ("far", "distant")
AROUND_DRIVE_S = 20.0  # A vehicle that arrives this long before or after a drive is still audible in it
STANDING = EgoMotion()
SOUND_S, SOUND_MARGIN_S = (8.0, 40.0), 2.0  # The fades of an event are outside the sound


@dataclass(frozen=True, slots=True, eq=False)
class VehicleEvent:
    """One vehicle of a stream."""

    flow: str  # Flow of the vehicle, or "follows"
    manoeuvre: Manoeuvre
    start_s: float  # Time of the stream at which the clock of its motion is 0
    signal: str = ""  # Warning signal of the vehicle

    @property
    def end_s(self) -> float:
        """Time of the stream at which the vehicle is out of earshot."""
        return self.start_s + self.manoeuvre.motion.duration_s


@dataclass(frozen=True, slots=True)
class SoundEvent:
    """A sound of a stream that does not belong to a vehicle."""

    sound: SoundSettings
    start_s: float  # Time of the stream at which its clock is 0
    gusty: tuple[tuple[int, ...], ...] = ()  # For gusts: the channels that they hit in each array

    @property
    def end_s(self) -> float:
        """Time of the stream at which the sound is over, with its late part."""
        return self.start_s + self.sound.end_s + SOUND_MARGIN_S

    def at(self, array: int) -> "SoundEvent":
        """Return the sound at one of the arrays."""
        if not self.gusty:
            return self
        return replace(self, sound=replace(self.sound, channels=self.gusty[array]))


Event = VehicleEvent | SoundEvent


def draw_events(settings: StreamSettings, rng: np.random.Generator) -> list[VehicleEvent]:
    """Draw all vehicles of a stream, in the order in which they come into earshot."""
    traffic, duration_s = settings.traffic, settings.duration_s
    # One generator per flow: another rate of one flow does not change the others.
    flows = dict(zip(MANOEUVRES, rng.spawn(len(MANOEUVRES)), strict=True))
    turns = _turns(settings, rng) if traffic.evenly else {}
    around_s = 0.0 if settings.ego.stands else AROUND_DRIVE_S
    events: list[VehicleEvent] = []
    for flow, own in flows.items():
        times_s = turns.get(flow)
        if times_s is None:
            drawn_s = duration_s + 2.0 * around_s
            number = own.poisson(traffic.per_hour.get(flow, 0.0) * drawn_s / 3600.0)
            times_s = np.sort(own.uniform(0.0, drawn_s, number)) - around_s
        for arrival_s, one in zip(times_s, own.spawn(len(times_s)), strict=True):
            events += _arrival(flow, float(arrival_s), settings, one)
    inside = [event for event in events if event.start_s < duration_s and event.end_s > 0.0]
    return sorted(inside, key=lambda event: event.start_s)


def _turns(settings: StreamSettings, rng: np.random.Generator) -> dict[str, FloatArray]:
    """Assign equal stretches of time to the hazards, and draw each arrival in the middle half of its own.

    Like a recording, a drive has one hazard, shortly before the ego stops.
    """
    per_hour, ego = settings.traffic.per_hour, settings.ego
    if not ego.stands:
        rates = np.array([per_hour.get(flow, 0.0) for flow in HAZARDS])
        chosen = rng.choice(HAZARDS, p=rates / rates.sum())
        arrives_s = np.array([ego.stop_s - rng.uniform(*EGO_STOPS_AFTER_S)])
        return {flow: arrives_s[: int(flow == chosen)] for flow in HAZARDS}
    counts = {flow: round(per_hour.get(flow, 0.0) * settings.duration_s / 3600.0) for flow in HAZARDS}
    order = rng.permutation(np.repeat(list(counts), list(counts.values())))
    middle = np.arange(len(order)) + rng.uniform(0.25, 0.75, len(order))
    return {flow: middle[order == flow] * settings.duration_s / max(len(order), 1) for flow in counts}


def _arrival(
    flow: str, arrival_s: float, settings: StreamSettings, rng: np.random.Generator
) -> Iterator[VehicleEvent]:
    traffic, preset = settings.traffic, settings.drawn_preset
    arms = {"left": (LEFT,), "right": (RIGHT,), "both": (LEFT, RIGHT)}
    if flow == "queue":
        arms[flow] = ((LEFT,), (RIGHT,))[rng.integers(2)]
    names, shares = zip(*traffic.kinds.items(), strict=True)
    for arm in arms.get(flow, (None,)):
        kind = vehicle_kind(str(rng.choice(names, p=np.array(shares) / sum(shares))))
        # A bicycle two streets away is inaudible, so a light vehicle replaces it.
        heard = vehicle_kind("light") if flow in FAR and kind.name == "bicycle" else kind
        driver = draw_driver(settings.site, heard, preset, rng, arm)
        signal = _signal(traffic, heard, rng)
        if signal:
            driver = replace(driver, reach_m=EARSHOT_M[1])  # A signal is louder than tyres
        leader = MANOEUVRES[flow](driver, rng)
        late_s = _later(traffic, rng) if flow == "both" and arm == RIGHT else 0.0
        yield replace(_event(flow, arrival_s + late_s, leader), signal=signal)
        if arm is None:
            continue
        last = leader
        for number in range(LONGEST_QUEUE):
            another = number == 0 if flow == "queue" else rng.random() < traffic.follower_share
            if not another:
                break
            # A bicycle could not follow, so the follower is of the leader's kind or a car.
            kind = leader.motion.kind if rng.random() < 0.5 else vehicle_kind("light")
            last = behind(last, rng.uniform(*traffic.headway_s), kind)
            yield _event("follows", arrival_s + late_s, last)


def _later(traffic: Traffic, rng: np.random.Generator) -> float:
    """Draw the delay of the vehicle from the right, seconds."""
    if traffic.apart_s is None:
        return TOGETHER_S * float(rng.standard_normal())
    return float(rng.uniform(-traffic.apart_s, traffic.apart_s))


def draw_sounds(
    settings: StreamSettings, arrays: Sequence[int], rng: np.random.Generator
) -> list[SoundEvent]:
    """Draw all sounds of a stream that do not belong to vehicles; each kind is a Poisson process.

    `arrays` are numbers of microphones.
    """
    events: list[SoundEvent] = []
    kinds = settings.traffic.sounds
    for (kind, rate), own in zip(sorted(kinds.items()), rng.spawn(len(kinds)), strict=True):
        for arrival_s in own.uniform(0.0, settings.duration_s, own.poisson(rate * settings.minutes / 60.0)):
            lasts_s, preset = own.uniform(*SOUND_S), settings.drawn_preset
            empty = SimulationSettings(settings.site, "none", duration_s=lasts_s, preset=preset)
            gusts = kind == "gusts"
            # The number of draws for gusts depends on the number of microphones; the next draws must not.
            draws = [deepcopy(one) for one in own.spawn(1) * len(arrays)] if gusts else [own]
            at = [
                with_sounds(empty, [kind], microphones, one).sounds[0]
                for microphones, one in zip(arrays, draws, strict=False)
            ]
            gusty = tuple(one.channels for one in at) if gusts else ()
            events.append(SoundEvent(replace(at[0], start_s=SOUND_MARGIN_S), float(arrival_s), gusty))
    return sorted(events, key=lambda event: event.start_s)


def _event(flow: str, arrival_s: float, manoeuvre: Manoeuvre) -> VehicleEvent:
    return VehicleEvent(flow, manoeuvre, arrival_s + manoeuvre.gap_s - manoeuvre.arrives_s)


def _signal(traffic: Traffic, kind: VehicleKind, rng: np.random.Generator) -> str:
    """Draw the warning signal of a vehicle; only ridden vehicles have a bicycle's bell."""
    for signal, share in traffic.signals.items():
        if (signal == "bicycle-bell") == (kind.ridden_mps is not None) and rng.random() < share:
            return signal
    return ""
