"""Clips of passing vehicles for tests of the signature study, from the simulator's emission models.

Every kind of road user drives past one microphone in an open street, with the ambience of the simulator. The
differences between the two streets, and the effects of a microphone, are assumptions.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from worldstate_lab.signatures.traffic_clips import BACKGROUND, CLIP_S, ClipLabels

from worldstate.ground.typing import Float32Array, FloatArray
from worldstate.simulation.dataset.recording import FULL_SCALE_PA
from worldstate.simulation.scene.junction import site
from worldstate.simulation.scene.kinds import vehicle_kind
from worldstate.simulation.scene.octave_bands import REFERENCE_PA
from worldstate.simulation.scene.presets import Preset, preset
from worldstate.simulation.scene.vehicle import SourceSignal, drive, emit
from worldstate.simulation.sound.delay import KNOT_SAMPLES, Emission, add_delayed, emission_times
from worldstate.simulation.sound.diffraction import air_gain, ground_gain
from worldstate.simulation.sound.receiver import NEAREST_M, Receiver
from worldstate.simulation.sound.renderers import add_ambience

# Slightly more than twice the highest band, at half the cost of 48 kHz.
RATE_HZ = 24_000.0
KNOTS_S = np.arange(CLIP_S * RATE_HZ / KNOT_SAMPLES + 1) * KNOT_SAMPLES / RATE_HZ
# Emission begins 0.3 s earlier, longer than the sound's travel time from the fastest vehicle
HEAD_BLOCKS = 57
MICROPHONE_HEIGHT_M = 1.5
# The corpora's names of the simulator's kinds.
WORDS = {
    "light": "car",
    "medium": "truck",
    "heavy": "truck",
    "electric": "electric",
    "bicycle": "bicycle",
    "tram": "tram",
}
SLOW_KMH = {"bicycle": (12.0, 25.0), "tram": (15.0, 40.0)}
BACKGROUNDS = 3  # Clips without a vehicle per recording: as many as of cars and trucks
# Assumed: CNOSSOS gives the mean of a category but not the variation of single vehicles.
VEHICLE_SPREAD_DB = 3.0
FAR_LEVEL_DB = (
    8.0  # level of a distant vehicle relative to the ambience: these streets are busier than a blind junction
)
# Assumed, per octave: backgrounds vary from day to day with birds, leaves, building sites and distant roads.
COLOUR_SPREAD_DB = 3.0
JITTER_S = 0.2  # Clips are centred by hand


@dataclass(frozen=True, slots=True)
class MicrophoneGrade:
    """Response and noise of a recorder."""

    name: str
    # White up to 12 kHz, dB re 20 uPa; its A-weighted level is 0.5 dB lower, so the data sheet's dB(A) are
    # used.
    self_noise_db: float
    low_cut_hz: float
    gain_db: float = 0.0  # Gain relative to full scale at `FULL_SCALE_PA`
    gain_spread_db: float = 0.0  # Standard deviation of the gain between recordings


# sE8: 13 dB(A). ICS-43434: 65 dB(A) below 94 dB SPL, -3 dB at 60 Hz.
STUDIO = MicrophoneGrade("studio", 13.0, 20.0)
MEMS = MicrophoneGrade("mems", 29.0, 60.0)
# No data sheet: a MEMS capsule with the high-pass and the automatic gain of a phone.
PHONE = MicrophoneGrade("phone", 36.0, 120.0, gain_db=14.0, gain_spread_db=4.0)


@dataclass(frozen=True, slots=True)
class Roadside:
    """Location of recordings."""

    name: str
    microphones: tuple[MicrophoneGrade, ...]
    ambient_db: float  # Level relative to the simulator's street
    far_rate: float  # Distant vehicles per ten seconds
    speed_kmh: tuple[float, float]
    distance_m: tuple[float, float]  # Distance of the lanes from the microphone
    kinds: tuple[str, ...]  # Kinds of vehicles that pass in every recording
    windshield_db: float = 0.0  # Reduction of the simulator's wind by the windshield
    official_split: bool = False  # Every second recording is for training


# Roads of 30 to 70 km/h at the edge of a small town, and streets with several lanes and trams in a large
# city.
TOWN_ROAD = Roadside(
    name="SIMULATED roads",
    microphones=(STUDIO, MEMS),
    ambient_db=-8.0,
    far_rate=0.6,
    speed_kmh=(30.0, 70.0),
    distance_m=(4.0, 10.0),
    kinds=("light", "medium", "heavy"),  # Like IDMT-Traffic, without quiet road users
    windshield_db=10.0,
    official_split=True,
)
CITY_STREET = Roadside(
    name="SIMULATED city",
    microphones=(PHONE,),
    ambient_db=2.0,
    far_rate=2.0,
    speed_kmh=(20.0, 50.0),
    distance_m=(4.0, 14.0),
    kinds=(*WORDS,),
)


def simulated_recording(
    street: Roadside, number: int, rng: np.random.Generator
) -> Iterator[tuple[ClipLabels, Float32Array]]:
    """Yield the clips of one recording, samples (n, 1) at `RATE_HZ`; every microphone records the same
    sound."""
    levels = _levels(street, rng)
    gains_db = [one.gain_db + one.gain_spread_db * rng.standard_normal() for one in street.microphones]
    split = ("train", "test")[number % 2] if street.official_split else ""
    for kind in (*street.kinds, *(BACKGROUND,) * BACKGROUNDS):
        pressure = _ambience(levels, rng)
        if kind != BACKGROUND:
            pressure += _passage(street, kind, rng)
        for grade, gain_db in zip(street.microphones, gains_db, strict=True):
            recording = f"{street.name} {number}"
            labels = ClipLabels(WORDS.get(kind, kind), grade.name, recording, street.name, split)
            yield labels, _recorded(pressure, grade, gain_db, rng)


def _levels(street: Roadside, rng: np.random.Generator) -> Preset:
    """Draw the ambience of a recording."""
    usual = preset()
    drawn_db = street.ambient_db + COLOUR_SPREAD_DB * rng.standard_normal(8)
    octaves = np.array(usual.ambient_octaves_db) + drawn_db
    # One microphone records no direction, so the minimum number of waves suffices. Its own noise is added by
    # its grade.
    return replace(
        usual,
        ambient_octaves_db=tuple(octaves.tolist()),
        ambient_waves=8,
        site_ambient_db=0.0,  # a street of this study has its own level
        site_wind_db=0.0,
        far_rate=street.far_rate,
        far_level_db=FAR_LEVEL_DB,
        wind_100hz_db=usual.wind_100hz_db - street.windshield_db,
        self_noise_db=0.0,
    )


def _ambience(levels: Preset, rng: np.random.Generator) -> Float32Array:
    """Draw the pressure of a street without a vehicle, Pa, shape (n,)."""
    receiver = Receiver(np.array([[0.0, 0.0, MICROPHONE_HEIGHT_M]]), np.zeros(1), KNOTS_S)
    heard = np.zeros((1, receiver.samples), np.float32)
    add_ambience(heard, receiver, site("SB1"), levels, rng)
    return np.asarray(heard[0])


def _passage(street: Roadside, kind: str, rng: np.random.Generator) -> Float32Array:
    """Draw the pressure of one vehicle that passes at the middle of the clip, Pa, shape (n,)."""
    knots = np.arange(-HEAD_BLOCKS, len(KNOTS_S)) * KNOT_SAMPLES / RATE_HZ
    what, side = vehicle_kind(kind), rng.choice((-1.0, 1.0))
    path = drive(
        knots,
        entry_s=0.5 * CLIP_S + rng.uniform(-JITTER_S, JITTER_S),
        entry_y_m=side * 0.5 * what.length_m,
        lane_x_m=rng.uniform(*street.distance_m),
        speed_mps=rng.uniform(*SLOW_KMH.get(kind, street.speed_kmh)) / 3.6,
        kind=what,
    )
    samples = (len(knots) - 1) * KNOT_SAMPLES
    parts = emit(path, samples, RATE_HZ, VEHICLE_SPREAD_DB * rng.standard_normal(), rng)
    # Axles and engine are separate sources: a single source at the height of an engine is 4 dB too quiet
    # between 0.7 and 2 kHz, where the road's reflection cancels its sound.
    out = np.zeros((len(KNOTS_S) - 1) * KNOT_SAMPLES, np.float32)
    for part in parts:
        _add_heard(out, part, knots, np.hypot(*path.behind(part.behind_m)))
    return out


def _add_heard(out: Float32Array, part: SourceSignal, knots_s: FloatArray, ground_m: FloatArray) -> None:
    """Propagate a signal over a changing distance: air, the road's reflection, delay and spreading."""
    length = np.hypot(ground_m, MICROPHONE_HEIGHT_M - part.height_m)
    gain = air_gain(length) * ground_gain(length, part.height_m, MICROPHONE_HEIGHT_M)
    made = Emission.of(part.signal, knots_s[0], RATE_HZ).table(gain)
    if made is not None:
        table, span = made
        emitted = emission_times(KNOTS_S, knots_s[span], length[span])
        travelled = np.interp(np.nan_to_num(emitted), knots_s[span], length[span])
        add_delayed(out, table, emitted, 1.0 / np.maximum(travelled, NEAREST_M))


def _recorded(
    pressure: Float32Array, grade: MicrophoneGrade, gain_db: float, rng: np.random.Generator
) -> Float32Array:
    """Return the recording of a pressure by a microphone, full scale 1, shape (n, 1)."""
    from scipy.signal import butter, sosfilt

    noise = REFERENCE_PA * 10.0 ** (grade.self_noise_db / 20.0) * rng.standard_normal(len(pressure))
    passed = sosfilt(butter(2, grade.low_cut_hz, "highpass", fs=RATE_HZ, output="sos"), pressure) + noise
    loud = passed[: round(CLIP_S * RATE_HZ)] * 10.0 ** (gain_db / 20.0) / FULL_SCALE_PA
    return np.asarray(np.clip(loud, -1.0, 1.0)[:, None], np.float32)
