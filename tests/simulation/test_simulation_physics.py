"""Physics of the simulator against closed forms and Acoular."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from worldstate.simulation.scene.junction import Site
from worldstate.simulation.scene.octave_bands import octave_masks, split_octaves
from worldstate.simulation.scene.vehicle import SOURCE_HEIGHT_M
from worldstate.simulation.sound import propagation
from worldstate.simulation.sound.delay import (
    KNOT_SAMPLES,
    OVERSAMPLING,
    Emission,
    MovingSource,
    SampledSignal,
    add_delayed,
    emission_times,
)
from worldstate.simulation.sound.diffraction import SPEED_OF_SOUND_MPS, screen_attenuation_db
from worldstate.simulation.sound.receiver import Receiver, Surroundings
from worldstate.simulation.sound.static_field import StaticSources

FS = 48_000.0
C = SPEED_OF_SOUND_MPS
# Corners far to the sides: everything is in view and nothing reflects.
FREE_FIELD = Site("Free1", 30.0, 30.0, 1.0, None, 30.0, 30.0, 12.0, side_order=0, facade_order=0)


def add_sources(out, *arguments):
    """Add sources and pending blocks."""
    static = StaticSources(out, FS)
    propagation.add_sources(static, *arguments)
    static.render()


def receiver(positions: np.ndarray, blocks: int) -> Receiver:
    return Receiver(positions, np.zeros(len(positions)), np.arange(blocks + 1) * KNOT_SAMPLES / FS)


def free_field(signal: np.ndarray, y_of_t, lane: float, positions: np.ndarray, start_s: float, blocks: int):
    emission = Emission.of(signal.astype(np.float32), start_s, FS)
    out = np.zeros((len(positions), blocks * KNOT_SAMPLES), np.float32)
    add_sources(
        out,
        [MovingSource(emission, lane, y_of_t(emission.knots_s))],
        Surroundings(FREE_FIELD, receiver(positions, blocks), 40.0),
    )
    return out


def tone_phase(x: np.ndarray, f: float) -> np.ndarray:
    """Return the unwrapped phase of a slowly shifting tone, band-passed around f."""
    spectrum = np.fft.fft(x)
    frequencies = np.fft.fftfreq(len(x), 1 / FS)
    spectrum[np.abs(frequencies - f) > 0.2 * f] = 0.0
    return np.unwrap(np.angle(np.fft.ifft(spectrum)))


@given(st.lists(st.floats(0.0, 24e3), min_size=1, max_size=20))
def test_octave_bands_are_a_partition_of_unity(frequencies):
    masks = octave_masks(np.array(frequencies))
    assert masks.min() >= 0.0
    np.testing.assert_allclose(masks.sum(axis=0), 1.0, atol=1e-12)


@given(st.integers(0, 2**32 - 1), st.integers(50, 4000))
def test_bands_add_up_to_the_signal(seed, n):
    x = np.random.default_rng(seed).standard_normal(n).astype(np.float32)
    np.testing.assert_allclose(split_octaves(x, FS).sum(axis=0), x, atol=2e-5)


@pytest.mark.parametrize("frequency", [100.0, 1000.0, 4000.0])
def test_fractional_delay_error_is_below_minus_50_db(frequency):
    blocks = 40
    time = np.arange(-2048, blocks * KNOT_SAMPLES + 2048) / FS
    table_time = np.arange(len(time) * OVERSAMPLING) / (FS * OVERSAMPLING) + time[0]
    table = SampledSignal(
        np.sin(2 * np.pi * frequency * table_time).astype(np.float32), time[0], FS * OVERSAMPLING
    )
    out = np.zeros(blocks * KNOT_SAMPLES, np.float32)
    delay = 0.0123456789
    knots = np.arange(blocks + 1) * KNOT_SAMPLES / FS
    add_delayed(out, table, knots - delay, np.ones(blocks + 1))
    wanted = np.sin(2 * np.pi * frequency * (np.arange(len(out)) / FS - delay))
    error_db = 20 * np.log10(np.std(out - wanted) / np.std(wanted))
    assert error_db < -50.0


@given(st.floats(-30.0, 30.0), st.floats(5.0, 40.0), st.floats(-20.0, 20.0))
def test_emission_times_solve_the_retarded_time_equation(speed, lane, y0):
    emit = np.linspace(-1.0, 2.0, 1200)
    travel = np.hypot(lane, y0 + speed * emit)
    receive = np.linspace(0.0, 1.5, 50)
    found = emission_times(receive, emit, travel)
    # Linear between knots: v^2 h^2 / (8 r c) is 0.6 us at the worst, 0.06 % of a period at 1 kHz.
    np.testing.assert_allclose(found + np.hypot(lane, y0 + speed * found) / C, receive, rtol=0.0, atol=6e-7)


def test_the_doppler_shift_is_that_of_the_retarded_position():
    """f = f0 / (1 + v_r / c) with v_r at emission time, within 1e-4."""
    f0, speed, lane, blocks = 1000.0, 13.0, 6.0, 750
    start, n = -0.5, (blocks + 400) * KNOT_SAMPLES
    time = start + np.arange(n) / FS
    position = np.array([[0.0, 0.0, SOURCE_HEIGHT_M]])
    tone = np.cos(2 * np.pi * f0 * time)
    out = free_field(tone, lambda t: -13.0 + speed * t, lane, position, start, blocks)
    phase = tone_phase(out[0].astype(float), f0)
    step = 480
    received = (phase[step:] - phase[:-step]) / (2 * np.pi * step / FS)
    centre = (np.arange(len(received)) + step / 2) / FS
    emit = emission_times(centre, time, np.hypot(lane, -13.0 + speed * time))
    y = -13.0 + speed * emit
    radial = speed * y / np.hypot(lane, y)
    expected = f0 / (1.0 + radial / C)
    inner = slice(4800, -4800)
    assert np.abs(received[inner] / expected[inner] - 1.0).max() < 1e-4
    assert np.ptp(expected[inner]) > 40.0  # the shift is large enough for the test


def acoular_signal(acoular, samples):
    """Return a signal of Acoular with given samples, with its own resampling."""

    class Samples(acoular.SignalGenerator):
        def signal(self):
            return samples

        def _get_digest(self):
            return "samples"

    return Samples(sample_freq=FS, num_samples=len(samples))


def test_free_field_waveform_equals_acoular():
    acoular = pytest.importorskip("acoular")
    speed, lane, y0, seconds = 13.0, 6.0, -9.0, 1.2
    n = int(seconds * FS)
    noise = np.random.default_rng(3).standard_normal(n)
    spectrum = np.fft.rfft(noise)
    f = np.fft.rfftfreq(n, 1 / FS)
    spectrum[(f < 300) | (f > 1800)] = 0.0
    signal = np.fft.irfft(spectrum, n)
    signal /= signal.std()
    positions = np.array([[0.0, 0.35, 1.7], [0.02, -0.31, 1.9], [-0.05, 0.04, 1.5]])

    padded, blocks = np.pad(signal, (0, -n % KNOT_SAMPLES)), n // KNOT_SAMPLES
    ours = free_field(padded, lambda t: y0 + speed * t, lane, positions, 0.0, blocks)
    trajectory = acoular.Trajectory()
    for t in np.linspace(-0.2, seconds + 0.2, 60):
        trajectory.points[float(t)] = (lane, y0 + speed * float(t), SOURCE_HEIGHT_M)
    source = acoular.MovingPointSource(
        signal=acoular_signal(acoular, signal),
        mics=acoular.MicGeom(pos_total=positions.T),
        env=acoular.Environment(c=C),
        trajectory=trajectory,
        start=0.0,
        up=16,
    )
    theirs = np.concatenate(list(source.result(4096)))
    inner = slice(4800, min(len(theirs), ours.shape[1]) - 2000)
    for ours_one, theirs_one in zip(ours, theirs.T, strict=True):
        assert np.corrcoef(ours_one[inner], theirs_one[inner])[0, 1] > 0.999
        assert np.std(ours_one[inner]) == pytest.approx(np.std(theirs_one[inner]), rel=0.02)


@pytest.mark.parametrize(("fresnel", "maekawa_db"), [(0.1, 8.0), (1.0, 13.0), (10.0, 23.0)])
def test_screen_attenuation_equals_the_chart_of_maekawa(fresnel, maekawa_db):
    """Maekawa (1968): 13 dB at N = 1, 10 log10(20 N) beyond; 8 dB on the chart at N = 0.1."""
    detour = np.array([fresnel * C / 2000.0])
    assert screen_attenuation_db(detour, np.array(1000.0), 60.0)[0] == pytest.approx(maekawa_db, abs=1.5)


@given(st.floats(20.0, 20e3))
def test_screen_attenuation_is_continuous_and_monotone(frequency):
    detour = np.linspace(-0.5, 0.5, 4001) * C / frequency
    attenuation = screen_attenuation_db(detour, np.array(frequency), 60.0)
    assert np.all(np.diff(attenuation) >= -1e-9)
    assert np.abs(np.diff(attenuation)).max() < 0.6
    assert attenuation[0] == 0.0


def test_static_sources_arrive_with_their_delays():
    rng = np.random.default_rng(5)
    n = 30_000
    spectrum = np.fft.rfft(rng.standard_normal(n))
    spectrum[np.fft.rfftfreq(n, 1 / FS) > 4000.0] = 0.0
    signal = np.fft.irfft(spectrum, n)
    delays = np.array([[0.0, 3.3e-4, -8.1e-4]])
    out = np.zeros((3, n), np.float32)
    static = StaticSources(out, FS)
    static.add(signal[None].astype(np.float32), delays)
    static.render()
    for channel, delay in zip(out, delays[0], strict=True):
        turned = np.fft.irfft(spectrum * np.exp(-2j * np.pi * np.fft.rfftfreq(n, 1 / FS) * delay), n)
        error_db = 20 * np.log10(np.std((channel - turned)[5000:-5000]) / np.std(turned))
        assert error_db < -45.0
