"""Rendering up to 2 kHz gives the feature of full bandwidth."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import resample_poly

from worldstate.adapters.datasets.feature_table import read_features
from worldstate.adapters.files.acoustic_domain import check_tables, feature_order
from worldstate.adapters.files.model_file import read_model
from worldstate.adapters.listener import measure_steps
from worldstate.adapters.source import ListenSettings, open_source
from worldstate.cli.main import main
from worldstate.frontend.array.microphone_array import MicrophoneArray, ovad_array
from worldstate.frontend.direction.feature import feature_nfft, published_feature
from worldstate.frontend.settings import FrontEndSettings
from worldstate.ground.errors import OutOfDomainError
from worldstate.simulation.scene.driving import trajectories
from worldstate.simulation.scene.junction import SITES
from worldstate.simulation.scene.octave_bands import REFERENCE_PA
from worldstate.simulation.scene.settings import SAMPLE_RATE_HZ, SimulationSettings, draw_settings, rate_for
from worldstate.simulation.scene.vehicle import LIGHT, SOURCE_HEIGHT_M, SourceSignal, drive, emit
from worldstate.simulation.sound.delay import KNOT_SAMPLES
from worldstate.simulation.sound.propagation import add_sources
from worldstate.simulation.sound.receiver import Receiver, standing_m
from worldstate.simulation.sound.renderers import add_ambience
from worldstate.simulation.sound.scatter import add_scattered
from worldstate.simulation.sound.static_field import StaticSources, StreetSound

FACTOR, ARRAY = 8, ovad_array()
FEWER = MicrophoneArray(ARRAY.positions_m[::4])
LOW_HZ = SAMPLE_RATE_HZ / FACTOR
# Emission begins this number of knots before the recording and ends with it.
BEFORE = 94


def vehicle_sound(
    settings: SimulationSettings,
    array: MicrophoneArray,
    sources: list[SourceSignal],
    samples: int,
    rate: float,
) -> np.ndarray:
    """Return the sound of one vehicle with these signals at an array by every path, (M, n)."""
    knots = np.arange(-(-samples // KNOT_SAMPLES) + 1) * KNOT_SAMPLES / rate
    receiver = Receiver(standing_m(array), np.zeros(array.n_microphones), knots, settings.ego)
    out = np.zeros((array.n_microphones, receiver.samples), np.float32)
    street = StreetSound(StaticSources(out, rate), settings.site, settings.preset, receiver)
    emitted = -BEFORE * KNOT_SAMPLES / LOW_HZ
    emitted += np.arange(len(sources[0].signal) // KNOT_SAMPLES + 1) * KNOT_SAMPLES / rate
    (path,) = trajectories(settings, emitted)
    *moving, middle = (
        street.source(one.signal, emitted, path.behind(one.behind_m), one.height_m)
        for one in [*sources, SourceSignal(sum(s.signal for s in sources), 1.0, SOURCE_HEIGHT_M)]
    )
    add_sources(street, moving)
    add_scattered(street, middle)
    street.static.render()
    return out[:, :samples]


def decimated(sound: np.ndarray) -> np.ndarray:
    return resample_poly(sound, 1, FACTOR, axis=-1, window=("kaiser", 8.0)).astype(np.float32)


def feature_errors(number: int, duration_s: float, array: MicrophoneArray = ARRAY) -> np.ndarray:
    """Return the rms change of the feature at an eighth of the rate, relative to its rms, per second."""
    rng = np.random.default_rng([7, number])
    settings = draw_settings(SITES[number % len(SITES)], ("left", "right")[number % 2], rng, duration_s)
    blocks = BEFORE + -(-int(duration_s * LOW_HZ) // KNOT_SAMPLES)
    knots = np.arange(FACTOR * blocks + 1) - FACTOR * BEFORE
    (path,) = trajectories(settings, knots * KNOT_SAMPLES / SAMPLE_RATE_HZ)
    samples = FACTOR * blocks * KNOT_SAMPLES
    whole = emit(path, samples, SAMPLE_RATE_HZ, settings.preset.vehicle_level_db, rng)
    less = [SourceSignal(decimated(one.signal), one.behind_m, one.height_m) for one in whole]
    # The ambience is drawn once at the full rate, because a lower rate would draw other noise.
    ambience = np.zeros((array.n_microphones, round(duration_s * SAMPLE_RATE_HZ)), np.float32)
    knots_s = np.arange(2) * KNOT_SAMPLES / SAMPLE_RATE_HZ
    receiver = Receiver(standing_m(array), np.zeros(array.n_microphones), knots_s)
    add_ambience(ambience, receiver, settings.site, settings.preset, rng)
    full = ambience + vehicle_sound(settings, array, whole, ambience.shape[1], SAMPLE_RATE_HZ)
    low = decimated(ambience)
    low += vehicle_sound(settings, array, less, low.shape[1], LOW_HZ)
    expected, found = features(full, array, SAMPLE_RATE_HZ), features(low, array, LOW_HZ)
    return np.asarray(np.sqrt(((found - expected) ** 2).mean(axis=1) / (expected**2).mean(axis=1)))


def features(sound: np.ndarray, array: MicrophoneArray, rate: float) -> np.ndarray:
    starts = range(int(sound.shape[1] / rate + 1e-3))
    return np.array(
        [published_feature(sound.T[round(s * rate) :][: round(rate)], array, rate) for s in starts]
    )


@pytest.mark.slow
def test_the_feature_does_not_change_at_an_eighth_of_the_rate() -> None:
    assert feature_errors(0, 1.0, FEWER).max() < 0.01


@pytest.mark.slow
def test_the_feature_of_ten_recordings_does_not_depend_on_the_rate() -> None:
    errors = np.concatenate([feature_errors(number, 4.0) for number in range(10)])
    assert len(errors) == 40
    # The limit is 0.01; measured are 0.0013 on average and 0.0029 at most.
    assert errors.max() < 0.005


def test_engine_lines_above_half_the_rate_do_not_alias() -> None:
    # Lines from 1.4 to 2.8 kHz only: at 3 kHz those above 1.5 kHz would alias below 1.2 kHz.
    two_kilohertz = tuple(90.0 if octave == 5 else 0.0 for octave in range(8))
    kind = replace(LIGHT, harmonic_share=1.0, propulsion_a_db=two_kilohertz, propulsion_b_db=(0.0,) * 8)
    time = np.arange(0.0, 2.0, 0.05)
    path = drive(time, entry_s=4.0, entry_y_m=3.0, lane_x_m=8.0, speed_mps=5.5, kind=kind)
    for seed in range(4):
        engine = emit(path, 5700, 3_000.0, 0.0, np.random.default_rng(seed))[-1].signal
        spectrum = np.abs(np.fft.rfft(engine * np.hanning(5700))) ** 2
        below = spectrum[: round(1200.0 / 3_000.0 * 5700)].sum() / 5700**2
        assert below < 1e-4 * REFERENCE_PA**2 * 10.0**9


def test_the_shipped_model_reads_recordings_up_to_2_khz(tmp_path: Path) -> None:
    words = "sim make --static 2 --bandwidth 2000 --duration 1.6 --seed 3"
    assert main([*words.split(), "--out", str(tmp_path)]) == 0
    (folder,) = (tmp_path / "SA1" / "left").iterdir()
    source = open_source(folder)
    steps = list(measure_steps(source))
    assert (soundfile.info(source.audio_path).samplerate, len(steps)) == (6000, 7)
    assert main(["model", "features", str(tmp_path), "--out", str(tmp_path / "table.csv")]) == 0
    # A model of such windows also reads full-rate sound, because only the duration of frames matters.
    domain = read_features(tmp_path / "table.csv").domain
    shipped = read_model().signature.domain
    assert domain is not None and shipped is not None
    check_tables(shipped, domain)
    assert feature_order(domain, ARRAY, SAMPLE_RATE_HZ, FrontEndSettings()) is None


def test_sound_without_the_bands_of_the_model_raises_an_error() -> None:
    shipped = read_model().signature.domain
    assert shipped is not None
    for rate in (6_000, 8_000, 12_000, 16_000, 24_000):
        assert feature_order(shipped, ARRAY, rate, ListenSettings().front_end(ARRAY, rate)) is None
    for rate in (3_000, 5_800):
        with pytest.raises(OutOfDomainError, match=f"sample rate: .*got {rate} Hz: record at 8 kHz or more"):
            feature_order(shipped, ARRAY, rate, ListenSettings().front_end(ARRAY, rate))


@given(st.floats(700.0, 32_000.0))
def test_the_rate_covers_the_band_and_keeps_the_bins(bandwidth_hz: float) -> None:
    rate = rate_for(bandwidth_hz)
    assert rate == SAMPLE_RATE_HZ or 2.99 * bandwidth_hz <= rate <= 6.01 * bandwidth_hz
    if rate > 5_000.0:
        assert rate / feature_nfft(rate) == pytest.approx(SAMPLE_RATE_HZ / 512, rel=1e-4)
