"""A stream as blocks of samples: pieces of background and whole events, summed in order.

The mismatch of the microphones is constant, the background has no seam, and every event is rendered
separately over its audible time.
"""

from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy
from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.parallel import in_processes
from worldstate.ground.typing import Float32Array, FloatArray
from worldstate.simulation.emitters.placed_sound import WEATHER, add_signal, add_sound, add_vehicle
from worldstate.simulation.emitters.weather import add_rain
from worldstate.simulation.scene.junction import Site
from worldstate.simulation.scene.octave_bands import REFERENCE_PA, smooth_step
from worldstate.simulation.scene.presets import Ambience, Preset, recording_ambience, site_ambience
from worldstate.simulation.scene.settings import SoundSettings
from worldstate.simulation.scene.vehicle import EgoMotion
from worldstate.simulation.sound.delay import KNOT_SAMPLES
from worldstate.simulation.sound.ego_sound import add_ego
from worldstate.simulation.sound.receiver import Receiver, standing_m
from worldstate.simulation.sound.renderers import add_ambience
from worldstate.simulation.sound.static_field import StaticSources, StreetSound

from .arrivals import STANDING, Event, SoundEvent, VehicleEvent
from .settings import StreamSettings


@dataclass(frozen=True, slots=True, eq=False)
class Microphones:
    """Positions of the microphones of one or several arrays, and their mismatch."""

    positions_m: FloatArray  # shape (M, 3): In `base_link`, z above the road
    skew_s: FloatArray  # shape (M,): Phase mismatch as a delay
    gains: FloatArray  # shape (M,): About 1
    sample_rate_hz: float
    sizes: tuple[int, ...] = ()  # Number of microphones of each array, in order; empty for one array

    @property
    def slices(self) -> list[slice]:
        """Channels of each array."""
        ends = np.cumsum(self.sizes or (len(self.positions_m),)).tolist()
        return [slice(first, last) for first, last in zip([0, *ends], ends, strict=False)]

    @property
    def arrays(self) -> list["Microphones"]:
        """The microphones of each array alone."""
        parts = ((self.positions_m[own], self.skew_s[own], self.gains[own]) for own in self.slices)
        return [Microphones(*part, self.sample_rate_hz) for part in parts]

    @classmethod
    def joined(cls, arrays: Sequence["Microphones"]) -> "Microphones":
        """Return the microphones of several arrays whose centres coincide."""
        return cls(
            np.concatenate([one.positions_m for one in arrays]),
            np.concatenate([one.skew_s for one in arrays]),
            np.concatenate([one.gains for one in arrays]),
            arrays[0].sample_rate_hz,
            tuple(len(one.gains) for one in arrays),
        )

    def receiver(self, knots_s: FloatArray, ego: EgoMotion = STANDING) -> Receiver:
        """Return these microphones as a receiver between knots, shape (K + 1,)."""
        return Receiver(self.positions_m, self.skew_s, knots_s, ego)


def draw_microphones(
    settings: StreamSettings, array: MicrophoneArray, rng: np.random.Generator
) -> Microphones:
    """Draw the mismatch of the channels, once for a whole stream."""
    positions = standing_m(array)
    skew = settings.preset.delay_mismatch_s * rng.standard_normal(len(positions))
    gains = 10.0 ** (settings.preset.gain_mismatch_db * rng.standard_normal(len(positions)) / 20.0)
    return Microphones(positions, skew, gains, settings.sample_rate_hz)


# As long as the rise or fall of a distant vehicle: in a shorter overlap a vehicle that a piece's end cuts
# would begin too fast (with 2 s the spectrogram showed the starts of the pieces).
OVERLAP_S = 8.0


@dataclass(frozen=True, slots=True, eq=False)
class StreamScene:
    """Constant properties of a stream."""

    settings: StreamSettings
    ambience: Ambience
    microphones: Microphones

    @classmethod
    def drawn(
        cls, settings: StreamSettings, microphones: Microphones, rng: np.random.Generator
    ) -> "StreamScene":
        """Draw the ambience of a stream, which is constant within it."""
        preset = settings.drawn_preset
        ambience = recording_ambience(site_ambience(settings.site, preset), preset, rng)
        return cls(settings, ambience, microphones)

    @property
    def piece(self) -> int:
        """Samples in a piece: two overlaps or more, so that only neighbours overlap; a drive is one piece."""
        if not self.settings.ego.stands:
            return self.settings.samples
        rate = self.settings.sample_rate_hz
        return max(min(round(PIECE_S * rate), PIECE_SAMPLES), 2 * overlap_samples(self.settings))

    @property
    def within_s(self) -> tuple[float, float]:
        """Time span in which events are rendered: unlimited, or for a drive its duration, often a third."""
        return ALWAYS_S if self.settings.ego.stands else (0.0, self.settings.duration_s)


def ambience_piece(
    scene: StreamScene, samples: int, rng: np.random.Generator, *, begins: bool
) -> Float32Array:
    """Render background, (M, samples + overlap), faded at both ends except at the stream's start."""
    # Neighbouring pieces are independent: if the squares of their fades sum to one, the power is constant. A
    # fade of amplitudes would leave a dip of 3 dB in the middle.
    settings, overlap = scene.settings, overlap_samples(scene.settings)
    sound = np.zeros((len(scene.microphones.positions_m), samples + overlap), np.float32)
    receiver = scene.microphones.receiver(np.arange(2) * KNOT_SAMPLES / settings.sample_rate_hz)
    add_ambience(sound, receiver, settings.site, settings.drawn_preset, rng, scene.ambience)
    if settings.rain_db is not None:
        # From a second before the piece to a second after it, because a shower starts and ends slowly.
        lasts_s = sound.shape[1] / settings.sample_rate_hz + 2.0
        static = StaticSources(sound, settings.sample_rate_hz)
        shower = SoundSettings("rain", -1.0, lasts_s, level_offset_db=settings.rain_db)
        add_rain(static, shower, receiver, rng)
        static.render()
    rise = np.sin(0.5 * np.pi * (np.arange(overlap) + 0.5) / overlap).astype(np.float32)
    if not begins:
        sound[:, :overlap] *= rise
    sound[:, samples:] *= rise[::-1]
    return sound


def overlap_samples(settings: StreamSettings) -> int:
    """Return the length of a cross-fade; a drive is one piece."""
    return round(OVERLAP_S * settings.sample_rate_hz) if settings.ego.stands else 0


HEAD_START_S = 1.0  # Emission begins this long before reception: 100 m of path and the late field
FADE_S = 2.0
# In another street the block's corner attenuates by 6 dB after 3 m and 22 dB after 10 m, about Maekawa's
# curve for 500 Hz at some 40 m from the corner on one side.
SHADE_M = 3.0
ROW_S = 0.1
ALWAYS_S = (-np.inf, np.inf)
# Band in which a vehicle behind a corner masks another; below it, wind and distant engines dominate.
BAND_HZ = (300.0, 2000.0)
SILENCE_PA2 = 1e-14  # -46 dB, below any relevant level; the logarithm of zero would not be JSON


@dataclass(frozen=True, slots=True, eq=False)
class EventSound:
    """Sound of one event alone at the microphones."""

    first: int  # Sample of the stream; negative if it began before
    pressure_pa: Float32Array  # shape (M, n)


def rendered_s(event: Event, within_s: tuple[float, float] = ALWAYS_S) -> tuple[float, float]:
    """Return the time span of the stream in which an event is rendered; other sounds run to their end."""
    end_s = event.end_s if isinstance(event, SoundEvent) else min(event.end_s, within_s[1])
    return max(event.start_s, within_s[0]), end_s


def event_blocks(event: Event, rate_hz: float, within_s: tuple[float, float] = ALWAYS_S) -> int:
    """Return the rendered length of an event in knots."""
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
    """Render one event within a time span of the stream, faded in and out when it is out of earshot."""
    rate = microphones.sample_rate_hz
    knot_s = np.float64(KNOT_SAMPLES / rate)
    blocks, before = event_blocks(event, rate, within_s), int(np.ceil(HEAD_START_S / knot_s))
    begin_s, _ = rendered_s(event, within_s)
    late_s, own = begin_s - event.start_s, ego.later(begin_s)
    receiver = microphones.receiver(np.arange(blocks + 1) * knot_s, own)
    sound = np.zeros((len(microphones.positions_m), receiver.samples), np.float32)
    static = StaticSources(sound, rate)
    street = StreetSound(static, site, preset, receiver)
    if isinstance(event, SoundEvent):
        add_sound(street, event.sound, rng)
    else:
        time, manoeuvre = np.arange(-before, blocks + 1) * knot_s, event.manoeuvre
        # The rendered sound has a clock that starts at its first sample; the vehicle's clock may have started
        # earlier.
        path = replace(manoeuvre.motion.trajectory(time + late_s, manoeuvre.heard), time_s=time)
        add_vehicle(street, path, rng)
        if event.signal:
            add_signal(street, event.signal, path, rng)
    static.render()
    sound *= _envelope(event, site, receiver, late_s)
    return EventSound(round(begin_s * rate), sound)


def _envelope(event: Event, site: Site, receiver: Receiver, late_s: float) -> Float32Array:
    """Return the amplitude over the event: its fades, and the shadow of a block in another street, (n,)."""
    knots = receiver.knots_s + late_s
    ends = smooth_step(np.minimum(knots, event.end_s - event.start_s - knots) / FADE_S)
    if isinstance(event, VehicleEvent) and event.manoeuvre.heard is not None:
        x = event.manoeuvre.motion.trajectory(knots).behind(0.0)[0]
        near, far = site.corner_ahead_m, site.corner_ahead_m + site.street_width_m
        ends = ends / (1.0 + (np.maximum(np.maximum(near - x, x - far), 0.0) / SHADE_M) ** 2)
    samples = np.arange(receiver.samples) / receiver.sample_rate_hz
    return np.interp(samples, receiver.knots_s, ends).astype(np.float32)


def band_filter(sample_rate_hz: float) -> FloatArray:
    """Return the second-order sections that pass `BAND_HZ`, as far as the rate allows."""
    band = BAND_HZ[0], min(BAND_HZ[1], 0.45 * sample_rate_hz)
    return np.asarray(scipy.signal.butter(4, band, "bandpass", fs=sample_rate_hz, output="sos"))


def loudness_db(
    sound: EventSound, rows_s: FloatArray, sample_rate_hz: float, *, banded: bool = False
) -> FloatArray:
    """Return the sound pressure level in a tenth of a second around each time, mean over microphones.

    The level is that of the whole spectrum or of `BAND_HZ`. Shapes: rows_s (R,).
    """
    pressure = sound.pressure_pa
    if banded:
        # Every eighth microphone is enough: levels differ little between them, and filtering takes time.
        pressure = scipy.signal.sosfilt(band_filter(sample_rate_hz), pressure[::8])
    power = np.einsum("mn,mn->n", pressure, pressure, dtype=np.float64)
    energy = np.r_[0.0, np.cumsum(power)] / len(pressure)
    ends = (rows_s + ROW_S * np.array([[-0.5], [0.5]])) * sample_rate_hz - sound.first
    first, last = np.clip(np.rint(ends), 0, len(power)).astype(int)
    mean = (energy[last] - energy[first]) / (ROW_S * sample_rate_hz)
    return np.asarray(10.0 * np.log10(np.maximum(mean, SILENCE_PA2) / REFERENCE_PA**2))


# Length that one process renders at a time: 40 MB of sound for 56 channels at 6 kHz, 80 MB at the full rate.
PIECE_S, PIECE_SAMPLES = 30.0, 360_000
AMBIENCE, EVENT, EGO_NOISE = 3, 4, 8  # Purposes of generators


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Sound from one sample on, and the loudness of the events that begin in it."""

    pressure_pa: Float32Array  # shape (M, n)
    # shape (arrays, 2, R): At the rows of every event, broadband and in `BAND_HZ`, at each array
    loudness_db: dict[int, FloatArray]


def row_times(event: Event, settings: StreamSettings) -> FloatArray:
    """Return the tenths of a second of the stream in which an event is audible or visible, shape (R,)."""
    first, last = max(event.start_s, 0.0), min(event.end_s, settings.duration_s)
    begin, end = (int(np.ceil(time_s / ROW_S - 1e-9)) for time_s in (first, last))
    return ROW_S * np.arange(begin, end, dtype=np.float64)


def render_blocks(scene: StreamScene, events: Sequence[Event], jobs: int = 1) -> Generator[Block, None, None]:
    """Yield the blocks of a stream in order; they do not depend on the number of jobs."""
    length, left = scene.piece, scene.settings.samples
    pending = np.zeros((len(scene.microphones.positions_m), 0), np.float32)
    with closing(in_processes(partial(render_piece, scene), pieces(scene, events), jobs)) as rendered:
        for piece in rendered:
            # An event may last beyond the next piece, so either of the two may be the longer one.
            shorter, sound = sorted((pending, piece.pressure_pa), key=lambda one: one.shape[1])
            sound[:, : shorter.shape[1]] += shorter
            yield Block(sound[:, : min(length, left)], piece.loudness_db)
            pending, left = sound[:, length:].copy(), left - length


def pieces(scene: StreamScene, events: Sequence[Event]) -> list[tuple[int, dict[int, Event]]]:
    """Return number and events of every piece: those that begin in it, or before the stream in the first."""
    first = np.maximum([event.start_s for event in events], 0.0) * scene.settings.sample_rate_hz
    owner = (first // scene.piece).astype(int)
    count = -(-scene.settings.samples // scene.piece)
    return [(i, {k: events[k] for k in np.flatnonzero(owner == i).tolist()}) for i in range(count)]


def render_piece(scene: StreamScene, piece: tuple[int, dict[int, Event]]) -> Block:
    """Render the background of one piece and, completely, all events that begin in it."""
    (number, events), settings = piece, scene.settings
    begin, rate, within = number * scene.piece, settings.sample_rate_hz, scene.within_s
    ends = [
        round(max(one.start_s, within[0]) * rate) + event_blocks(one, rate, within) * KNOT_SAMPLES
        for one in events.values()
    ]
    samples = max([end - begin for end in ends] + [scene.piece + overlap_samples(settings)])
    sound = np.zeros((len(scene.microphones.positions_m), samples), np.float32)
    loudness = {}
    with threadpool_limits(1):  # The number of BLAS threads would change the last bits
        _add_background(sound, scene, number)
        for k, event in events.items():
            alone, rows_s = _event_alone(scene, k, event), row_times(event, settings)
            at = [EventSound(alone.first, alone.pressure_pa[own]) for own in scene.microphones.slices]
            both = ([loudness_db(one, rows_s, rate, banded=banded) for banded in (False, True)] for one in at)
            loudness[k] = np.array(list(both))
            heard = alone.pressure_pa[:, max(-alone.first, 0) :]
            first = max(alone.first, 0) - begin
            sound[:, first : first + heard.shape[1]] += heard
    return Block(sound, loudness)


def _event_alone(scene: StreamScene, number: int, event: Event) -> EventSound:
    """Render one event at all arrays; weather is rendered for each, because it hits single microphones."""
    settings, microphones = scene.settings, scene.microphones
    street, drive = (settings.site, settings.drawn_preset), (settings.ego, scene.within_s)
    if not isinstance(event, SoundEvent) or event.sound.kind not in WEATHER:
        return event_sound(event, *street, microphones, settings.generator(EVENT, number), *drive)
    heard = [
        event_sound(event.at(array), *street, one, settings.generator(EVENT, number), *drive)
        for array, one in enumerate(microphones.arrays)
    ]
    return EventSound(heard[0].first, np.concatenate([one.pressure_pa for one in heard]))


# The uncorrelated noise of the microphones is drawn array by array from the same generator, so the sound of
# an array does not depend on the other arrays.
def _add_background(sound: Float32Array, scene: StreamScene, number: int) -> None:
    """Add the ambience of one piece and, for a drive, the ego's own noise."""
    settings, ego = scene.settings, scene.settings.ego
    for own, microphones in zip(scene.microphones.slices, scene.microphones.arrays, strict=True):
        rng = settings.generator(AMBIENCE, number)
        piece = ambience_piece(replace(scene, microphones=microphones), scene.piece, rng, begins=number == 0)
        sound[own, : piece.shape[1]] += piece
        if not ego.stands:
            receiver = microphones.receiver(np.arange(2) * KNOT_SAMPLES / settings.sample_rate_hz, ego)
            add_ego(sound[own], receiver, settings.site, settings.preset, settings.generator(EGO_NOISE))
