"""The sound of a street at a few microphones, without files, and what tests measure in it."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from worldstate.cli.main import main
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.array.steering import Steering
from worldstate.frontend.direction.bearing import srp_phat
from worldstate.simulation import preset
from worldstate.simulation.scene.junction import Site
from worldstate.simulation.scene.presets import Preset
from worldstate.simulation.scene.vehicle import SOURCE_HEIGHT_M, EgoMotion
from worldstate.simulation.sound import propagation
from worldstate.simulation.sound.delay import KNOT_SAMPLES
from worldstate.simulation.sound.diffraction import SPEED_OF_SOUND_MPS
from worldstate.simulation.sound.receiver import Receiver
from worldstate.simulation.sound.static_field import PlacedSource, StaticSources, StreetSound

OPEN = Site("Open1", 30.0, 30.0, 1.0, None, 30.0, 30.0, 12.0, in_the_open=True)
PAIR = MicrophoneArray([[0.0, 0.2, 0.0], [0.0, -0.2, 0.1]])
ONE = np.array([[0.0, 0.0, 1.7]])
STANDING, C = EgoMotion(), SPEED_OF_SOUND_MPS
# No background, no late field, smooth walls and equal microphones.
QUIET = replace(
    preset(),
    ambient_octaves_db=(-20.0,) * 8,
    far_rate=0.0,
    wind_100hz_db=-20.0,
    self_noise_db=0.0,
    gain_mismatch_db=0.0,
    delay_mismatch_s=0.0,
    late_walled_db=-90.0,
    late_open_db=-90.0,
    wall_scattering=0.0,
)


def street_of(
    plan: Site, positions_m, seconds: float, rate_hz: float, ego=STANDING, levels: Preset = QUIET
) -> StreetSound:
    """Return a silent street around microphones."""
    blocks, positions = int(seconds * rate_hz / KNOT_SAMPLES), np.asarray(positions_m)
    receiver = Receiver(
        positions, np.zeros(len(positions)), np.arange(blocks + 1) * KNOT_SAMPLES / rate_hz, ego
    )
    out = np.zeros((len(positions), receiver.samples), np.float32)
    return StreetSound(StaticSources(out, rate_hz), plan, levels, receiver)


def source_in(
    street: StreetSound, sound: Callable, way: Callable, head_s: float = 0.5, height_m=SOURCE_HEIGHT_M
) -> PlacedSource:
    """Return a source with the pressure `sound(time)` at the places `way(time)`, from a head start on."""
    rate, step_s = street.static.sample_rate_hz, KNOT_SAMPLES / street.static.sample_rate_hz
    knots = np.arange(-np.ceil(head_s / step_s), len(street.receiver.knots_s)) * step_s
    signal = sound(knots[0] + np.arange((len(knots) - 1) * KNOT_SAMPLES) / rate)
    x, y = (one + np.zeros(len(knots)) for one in way(knots))
    return street.source(signal.astype(np.float32), knots, (x, y), height_m)


def carried(street: StreetSound, *sources: PlacedSource) -> np.ndarray:
    """Return the sound of sources at the microphones, (M, n), without losses in air and on the road."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(propagation, "media_gain", lambda *_: 1.0)
        propagation.add_sources(street, sources)
    return rendered(street)


def rendered(street: StreetSound) -> np.ndarray:
    street.static.render()
    return street.static.out.astype(float)


def at(x: float, y: float) -> Callable:
    return lambda time: (x, y)


def tone(frequency_hz: float) -> Callable:
    return lambda time: np.cos(2 * np.pi * frequency_hz * time)


def noise(time: np.ndarray) -> np.ndarray:
    return np.random.default_rng(1).standard_normal(len(time))


def error_db(found: np.ndarray, expected: np.ndarray) -> float:
    return float(20 * np.log10(np.std(found - expected) / np.std(expected)))


def level_db(signal: np.ndarray) -> float:
    return float(20 * np.log10(np.std(signal) / 20e-6))


def band_power(signal: np.ndarray, rate_hz: float, low_hz: float, high_hz: float = np.inf) -> float:
    """Return the power of a band, up to a common factor."""
    power, hz = np.abs(np.fft.rfft(signal)) ** 2, np.fft.rfftfreq(signal.shape[-1], 1.0 / rate_hz)
    return float(power[..., (hz > low_hz) & (hz < high_hz)].sum())


def srp_spectrum(sound: np.ndarray, array: MicrophoneArray, rate_hz: float, azimuths_deg, band_hz):
    """Return the steered response power, PHAT-weighted, of sound (M, n) at azimuths, in frames of 128."""
    hz = np.fft.rfftfreq(128, 1.0 / rate_hz)
    bins = (hz >= band_hz[0]) & (hz < band_hz[1])
    frames = sound.shape[1] // 128
    cut = sound[:, : frames * 128].T.reshape(frames, 128, -1) * np.hanning(128)[:, None]
    spectra = np.ascontiguousarray(np.fft.rfft(cut, axis=1)[:, bins].astype(np.complex64))
    return srp_phat(spectra, Steering.towards(array, hz[bins], np.radians(azimuths_deg)))


def apart_deg(one, other):
    return np.abs((one - other + 180.0) % 360.0 - 180.0)


def made(capsys: pytest.CaptureFixture[str], out: Path, words: str) -> dict:
    """Return the summary of `worldstate sim make`."""
    assert main(["sim", "make", "--out", str(out), "--json", *words.split()]) == 0
    return json.loads(capsys.readouterr().out)


def refusal(capsys: pytest.CaptureFixture[str], out: Path, words: str) -> str:
    """Return the error of `worldstate sim make`."""
    assert main(["sim", "make", "--out", str(out), *words.split()]) == 2
    return capsys.readouterr().err
