"""The sound of one event of a stream, rendered by itself over the time in which it can be heard."""

from dataclasses import dataclass, replace

import numpy as np

from worldstate.ground.typing import Float32Array, FloatArray
from worldstate.simulation.emitters.placed_sound import add_signal, add_sound
from worldstate.simulation.scene.junction import Site
from worldstate.simulation.scene.octave_bands import REFERENCE_PA, smooth_step
from worldstate.simulation.scene.presets import Preset
from worldstate.simulation.scene.route import EgoMotion
from worldstate.simulation.sound.delay import KNOT_SAMPLES
from worldstate.simulation.sound.receiver import Receiver
from worldstate.simulation.sound.static_field import StaticSources
from worldstate.simulation.sound.vehicle_sound import add_vehicle

from .ambience import Microphones
from .arrivals import STANDING, Event, SoundEvent, VehicleEvent

HEAD_START_S = 1.0  # emission begins this long before it is heard: 100 m of way and the late field
FADE_S = 2.0
# Into another street the block's corner takes 6 dB after 3 m and 22 dB after 10 m, about Maekawa's curve for
# 500 Hz at some 40 m from the corner on one side.
SHADE_M = 3.0
ROW_S = 0.1
ALWAYS_S = (-np.inf, np.inf)
SILENCE_PA2 = 1e-14  # -46 dB, below any level that means something; a logarithm of zero would not be JSON


@dataclass(frozen=True, slots=True, eq=False)
class EventSound:
    """What the microphones hear of one event alone."""

    first: int  # Sample of the stream, negative where it began before
    pressure_pa: Float32Array  # shape (M, n)


def rendered_s(event: Event, within_s: tuple[float, float] = ALWAYS_S) -> tuple[float, float]:
    """Return from when to when of the stream an event is rendered: what else sounds always to its end."""
    end_s = event.end_s if isinstance(event, SoundEvent) else min(event.end_s, within_s[1])
    return max(event.start_s, within_s[0]), end_s


def event_blocks(event: Event, rate_hz: float, within_s: tuple[float, float] = ALWAYS_S) -> int:
    """Length of what is rendered of an event in knots."""
    begin_s, end_s = rendered_s(event, within_s)
    return int(np.ceil((end_s - begin_s) * rate_hz / KNOT_SAMPLES))


def event_sound(
    event: Event,
    site: Site,
    preset: Preset,
    microphones: Microphones,
    rng: np.random.Generator,
    ego: EgoMotion = STANDING,
    within_s: tuple[float, float] = ALWAYS_S,
) -> EventSound:
    """Render one event within some time of the stream, faded in and out where it is out of earshot."""
    rate = microphones.sample_rate_hz
    knot_s = np.float64(KNOT_SAMPLES / rate)
    blocks, before = event_blocks(event, rate, within_s), int(np.ceil(HEAD_START_S / knot_s))
    begin_s, _ = rendered_s(event, within_s)
    late_s, own = begin_s - event.start_s, ego.later(begin_s)
    receiver = Receiver(microphones.positions_m, microphones.skew_s, np.arange(blocks + 1) * knot_s, own)
    sound = np.zeros((len(microphones.positions_m), receiver.samples), np.float32)
    static = StaticSources(sound, rate)
    if isinstance(event, SoundEvent):
        add_sound(static, event.sound, site, preset, receiver, rng)
    else:
        time, manoeuvre = np.arange(-before, blocks + 1) * knot_s, event.manoeuvre
        # The clock of what is rendered begins with it, that of the vehicle may have begun before.
        path = replace(manoeuvre.motion.trajectory(time + late_s, manoeuvre.heard), time_s=time)
        add_vehicle(static, site, preset, path, receiver, rng)
        if event.signal:
            add_signal(static, event.signal, path, site, preset, receiver, rng)
    static.render()
    sound *= _envelope(event, site, receiver, late_s)
    return EventSound(round(begin_s * rate), sound)


def _envelope(event: Event, site: Site, receiver: Receiver, late_s: float) -> Float32Array:
    """Amplitude over the event: its ends, and the block that it is behind in another street, shape (n,)."""
    knots = receiver.knots_s + late_s
    ends = smooth_step(np.minimum(knots, event.end_s - event.start_s - knots) / FADE_S)
    if isinstance(event, VehicleEvent) and event.manoeuvre.heard is not None:
        x = event.manoeuvre.motion.trajectory(knots).behind(0.0)[0]
        near, far = site.corner_ahead_m, site.corner_ahead_m + site.street_width_m
        ends = ends / (1.0 + (np.maximum(np.maximum(near - x, x - far), 0.0) / SHADE_M) ** 2)
    samples = np.arange(receiver.samples) / receiver.sample_rate_hz
    return np.interp(samples, receiver.knots_s, ends).astype(np.float32)


def loudness_db(sound: EventSound, rows_s: FloatArray, sample_rate_hz: float) -> FloatArray:
    """Sound pressure level over the tenth of a second round each time, mean over the microphones.

    Shapes: rows_s (R,).
    """
    power = np.einsum("mn,mn->n", sound.pressure_pa, sound.pressure_pa, dtype=np.float64)
    energy = np.r_[0.0, np.cumsum(power)] / len(sound.pressure_pa)
    ends = (rows_s + ROW_S * np.array([[-0.5], [0.5]])) * sample_rate_hz - sound.first
    first, last = np.clip(np.rint(ends), 0, len(power)).astype(int)
    mean = (energy[last] - energy[first]) / (ROW_S * sample_rate_hz)
    return np.asarray(10.0 * np.log10(np.maximum(mean, SILENCE_PA2) / REFERENCE_PA**2))
