"""Sounds some metres away, recorded by devices of any make: close passes, idling engines, single sounds.

Streets are rendered at junctions. A model for one microphone must also work at other places and with other
recorders. Here a vehicle passes or idles in the open, and any other sound is in a yard or a room, over noise
of a drawn spectrum and through a drawn frequency response. Fluctuations, tones and their spread are fitted to
those of real recordings (docs/evidence/foreign_sounds.md).
"""

from dataclasses import replace

import numpy as np
import scipy
from scipy.fft import irfft, rfft, rfftfreq

from worldstate.ground.typing import Float32Array, FloatArray
from worldstate.simulation.emitters.emitter import emitted
from worldstate.simulation.emitters.placed_sound import in_the_open
from worldstate.simulation.emitters.signals import drift
from worldstate.simulation.scene.junction import Site
from worldstate.simulation.scene.kinds import VehicleKind
from worldstate.simulation.scene.octave_bands import split_octaves
from worldstate.simulation.scene.presets import Preset
from worldstate.simulation.scene.settings import sound_kind
from worldstate.simulation.scene.vehicle import along

from .arrivals import VehicleEvent
from .manoeuvres import LEFT, Manoeuvre, Motion
from .rendering import FADE_S, Microphones, event_sound

# Passes at 2 to 12 m, the microphone 1 to 2 m above the road.
DISTANCES_M, HEIGHTS_M = (2.0, 12.0), (1.0, 2.0)
SPEEDS_MPS, ACCELERATIONS_MPS2 = (5.0, 16.0), (0, 0, 0, 1.2, -1.5)
RIDDEN_MPS2 = (0, 0, 1.2, 2.5, 4.0, -2.0, -4.0)  # Motorcycles are driven harder
FAR_M = 300.0
# Spread of single vehicles within a kind, and of recorders and ambience; dB, by octave.
_VEHICLE_DB, _RECORDER_DB, _MOST_DB, _TILT_DB, _CUTS_HZ = 4.0, 3.0, 6.0, 1.0, (30.0, 150.0)
_MOTORCYCLE_DB = 7.0  # Exhausts vary more
_NOISE_SLOPES_DB, _SWELL_DB = (-7.0, -2.0), (0.0, 2.0)
# Fluctuation of a level: interval of the knots in seconds, dB, whether common to all octaves. Without it the
# 49 features of simulated cars had a median |AUROC - 0.5| of 0.14 against real ones, with it 0.08.
_FLUCTUATIONS = (
    (0.35, 1.1, True),
    (0.05, 0.5, True),
    (0.016, 0.5, True),
    (0.3, 1.1, False),
    (0.03, 1.2, False),
)
_STEADIER = 0.8  # For an idling engine
# Firing frequency of an idling engine, Hz; depth of the level's modulation, dB, and its sharpness.
_FIRING_HZ, _RATTLE_DB, _SHARPNESS = (15.0, 45.0), 16.0, (1.0, 4.0)
# Share of the modulation per octave: knocking is stronger above 500 Hz
_FOLLOWED = np.array((0.3, 0.3, 0.5, 1.0, 1.0, 1.0, 1.0, 1.0))
# Share of the sounds with tones of gears, motors and fans; their number, frequency in Hz and amplitude.
_TONES = {
    "passes": (0.2, 4, (250.0, 900.0)),
    "tram": (1.0, 4, (250.0, 900.0)),
    "idles": (0.5, 6, (300.0, 2600.0)),
}
_TONE_GAIN = (0.02, 0.5)
_REVERBERATION_S, _DIRECT_DB, _OUTDOORS = (0.1, 2.0), (-6.0, 15.0), 0.2
# Signal-to-noise ratio in the band of the guard.
_SNR_DB, BAND_HZ = (0.0, 30.0), (250.0, 2600.0)
# Shots, barks and steps are recorded in quiet places: their pauses are silent.
_CALM_DB = (0.0, 55.0)


def close_vehicle(
    kind: VehicleKind, preset: Preset, site: Site, seconds: float, rate_hz: float, rng: np.random.Generator
) -> FloatArray:
    """Draw a vehicle that passes close by in the open, shape (samples,), at any level."""
    passes_s, speed = rng.uniform(0.1, 0.9) * seconds, rng.uniform(*(kind.ridden_mps or SPEEDS_MPS))
    time = np.arange(0.0, seconds, 0.1) - passes_s
    harder = RIDDEN_MPS2 if kind.turns_hz else ACCELERATIONS_MPS2
    moves = np.maximum(speed + rng.choice(harder) * time, 1.0)
    sound = _in_the_open(kind, moves, passes_s, preset, site, rate_hz, rng)
    tones = "tram" if kind.name == "tram" else "passes"
    return _with_tones(_fluctuating(sound, rate_hz, rng), tones, rate_hz, rng)


def idling_vehicle(
    kind: VehicleKind, preset: Preset, site: Site, seconds: float, rate_hz: float, rng: np.random.Generator
) -> FloatArray:
    """Draw a stationary vehicle close by with a running engine, shape (samples,), at any level."""
    sound = _in_the_open(kind, np.zeros(len(np.arange(0.0, seconds, 0.1))), 0.0, preset, site, rate_hz, rng)
    if kind.turns_hz:  # Its sound already contains the pulses
        return _fluctuating(sound, rate_hz, rng, _STEADIER)
    firing_hz = rng.uniform(*_FIRING_HZ) * (1.0 + 0.02 * drift(len(sound), rate_hz, 0.3, rng))
    cycles = np.cumsum(firing_hz) / rate_hz
    pulse = (0.5 + 0.5 * np.cos(2.0 * np.pi * cycles)) ** rng.uniform(*_SHARPNESS) - 0.5
    # One of two or four cylinders is louder.
    uneven = 0.3 * rng.random() * np.cos(np.pi * cycles * rng.choice((0.5, 1.0)))
    rattle_db = rng.choice((0.0, 1.0)) * rng.uniform(0.0, _RATTLE_DB)
    octaves = split_octaves(sound.astype(np.float32), rate_hz).astype(np.float64)
    followed = rattle_db * _FOLLOWED[:, None] * (pulse + uneven)
    sound = np.asarray((octaves * 10.0 ** (followed / 20.0)).sum(axis=0))
    return _with_tones(_fluctuating(sound, rate_hz, rng, _STEADIER), "idles", rate_hz, rng)


def close_sound(kind: str, seconds: float, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Draw a sound of a kind of `SOUNDS` in a yard, a room or the open, shape (samples,), at any level."""
    sound = emitted(sound_kind(kind), round(seconds * rate_hz), rate_hz, rng).astype(np.float64)
    if rng.random() < _OUTDOORS:
        return sound
    decay_s = np.exp(rng.uniform(*np.log(_REVERBERATION_S)))
    time = np.arange(round(decay_s * rate_hz)) / rate_hz
    late = rng.standard_normal(len(time)) * 10.0 ** (-3.0 * time / decay_s)
    late /= np.sqrt(np.square(late).sum())
    direct = 10.0 ** (rng.uniform(*_DIRECT_DB) / 20.0)
    return np.asarray(direct * sound + scipy.signal.fftconvolve(sound, late)[: len(sound)])


def recorded(
    sound: FloatArray, rate_hz: float, rng: np.random.Generator, *, calm: bool = False
) -> Float32Array:
    """Add noise of a drawn spectrum and apply a drawn frequency response to both, shape (n,)."""
    hz, white = _frequencies(len(sound), rate_hz), rng.standard_normal(len(sound))
    colour_db = rng.uniform(*_NOISE_SLOPES_DB) * np.log2(np.maximum(hz, 40.0) / 500.0)
    noise = _filtered(white, colour_db + _wavy_db(hz, _RECORDER_DB, rng))
    noise *= 10.0 ** (rng.uniform(*_SWELL_DB) * drift(len(sound), rate_hz, 1.0, rng) / 20.0)
    band = scipy.signal.butter(4, BAND_HZ, "bandpass", fs=rate_hz, output="sos")
    loud, beside = (np.square(scipy.signal.sosfilt(band, one)) for one in (sound, noise))
    # Signal level of the louder third, which excludes pauses.
    parts = np.sort([part.mean() for part in np.array_split(loud, max(len(loud) // round(0.1 * rate_hz), 1))])
    ratio_db = rng.uniform(*(_CALM_DB if calm else _SNR_DB))
    louder = parts[-len(parts) // 3 :].mean() + np.finfo(float).tiny
    gain = np.sqrt(louder / beside.mean()) * 10.0 ** (-ratio_db / 20)
    response_db = np.clip(_wavy_db(hz, _RECORDER_DB, rng), -_MOST_DB, _MOST_DB)
    response_db += rng.uniform(-_TILT_DB, _TILT_DB) * np.log2(hz / 500.0)
    response_db -= 10.0 * np.log10(1.0 + (rng.uniform(*_CUTS_HZ) / hz) ** 4)
    heard = _filtered(sound + gain * noise, response_db)
    return np.asarray(0.5 * heard / (np.abs(heard).max() + np.finfo(float).tiny), np.float32)


def _in_the_open(
    kind: VehicleKind,
    speeds_mps: FloatArray,
    passes_s: float,
    preset: Preset,
    site: Site,
    rate_hz: float,
    rng: np.random.Generator,
) -> FloatArray:
    """Render a vehicle on a straight road, its front at the microphone at `passes_s`; speeds every 0.1 s."""
    # An event fades in and out while it is out of earshot, so it is rendered longer by both fades and then
    # cut.
    around = round(FADE_S / 0.1)
    speeds = np.pad(speeds_mps, around, mode="edge")
    driven = np.cumsum(np.r_[0.0, 0.05 * (speeds[1:] + speeds[:-1])])
    time = np.arange(len(speeds), dtype=np.float64) / 10.0
    driven = np.asarray(driven + FAR_M - np.interp(passes_s + FADE_S, time, driven))
    distance, height = rng.uniform(*DISTANCES_M), rng.uniform(*HEIGHTS_M)
    route = along([[distance, FAR_M], [distance, -FAR_M]])
    event = VehicleEvent("passes", Manoeuvre(LEFT, Motion(route, time, driven, speeds, kind, -1), 0.0), 0.0)
    alone = Microphones(np.array([[0.0, 0.0, height]]), np.zeros(1), np.ones(1), rate_hz)
    # The preset lowers the bass of engines in streets; close passes keep it.
    heard = event_sound(event, in_the_open(site), replace(preset, engine_bass_db=0.0), alone, rng)
    sound = heard.pressure_pa[0].astype(np.float64)
    first, length = round(FADE_S * rate_hz), round(0.1 * len(speeds_mps) * rate_hz)
    spread_db = _MOTORCYCLE_DB if kind.turns_hz else _VEHICLE_DB
    return _filtered(sound[first : first + length], _wavy_db(_frequencies(length, rate_hz), spread_db, rng))


def _fluctuating(
    sound: FloatArray, rate_hz: float, rng: np.random.Generator, share: float = 1.0
) -> FloatArray:
    octaves = split_octaves(sound.astype(np.float32), rate_hz).astype(np.float64)
    for every_s, spread_db, together in _FLUCTUATIONS:
        spread = share * spread_db * rng.uniform(0.3, 1.7)
        ways = 1 if together else len(octaves)
        octaves *= [10.0 ** (spread * drift(len(sound), rate_hz, every_s, rng) / 20.0) for _ in range(ways)]
    return np.asarray(octaves.sum(axis=0))


def _with_tones(sound: FloatArray, of: str, rate_hz: float, rng: np.random.Generator) -> FloatArray:
    """Add tones that rise and fall with the sound, in a share of the cases."""
    share, most, span_hz = _TONES[of]
    if rng.random() >= share:
        return sound
    tenth = round(0.1 * rate_hz)
    level = np.sqrt(np.convolve(np.square(sound), np.full(tenth, 1.0 / tenth), "same"))
    tones = np.zeros(len(sound))
    for _ in range(int(rng.integers(1, most))):
        pitch_hz = rng.uniform(*span_hz) * (1.0 + 0.004 * drift(len(sound), rate_hz, 0.5, rng))
        phase = 2.0 * np.pi * (np.cumsum(pitch_hz) / rate_hz + rng.random())
        wave = np.sin(phase) + rng.choice((0.0, 0.3)) * np.sin(2.0 * phase)
        tones += rng.uniform(0.3, 1.0) * 10.0 ** (drift(len(sound), rate_hz, 0.3, rng) / 10.0) * wave
    return np.asarray(sound + rng.uniform(*_TONE_GAIN) * level * tones)


def _wavy_db(hz: FloatArray, spread_db: float, rng: np.random.Generator) -> FloatArray:
    """Draw normal numbers an octave apart, linearly interpolated, shape of `hz`."""
    octaves = np.arange(np.log2(40.0), np.log2(hz[-1]) + 1.0)
    return np.interp(np.log2(hz), octaves, spread_db * rng.standard_normal(len(octaves)))


def _frequencies(samples: int, rate_hz: float) -> FloatArray:
    return np.asarray(np.maximum(rfftfreq(samples, 1.0 / rate_hz), 1.0))


def _filtered(sound: FloatArray, response_db: FloatArray) -> FloatArray:
    return np.asarray(irfft(rfft(sound) * 10.0 ** (response_db / 20.0), len(sound)))
