"""Physics of the simulator against closed forms and Acoular."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from simulated_sound import C, carried, error_db, source_in, street_of

from worldstate.simulation.scene.junction import Site
from worldstate.simulation.scene.octave_bands import octave_masks, split_octaves
from worldstate.simulation.scene.vehicle import SOURCE_HEIGHT_M
from worldstate.simulation.sound.delay import (
    KNOT_SAMPLES,
    OVERSAMPLING,
    SampledSignal,
    add_delayed,
    emission_times,
)
from worldstate.simulation.sound.diffraction import screen_attenuation_db
from worldstate.simulation.sound.static_field import StaticSources

FS = 48_000.0
# Corners far to the sides: everything is in view and nothing reflects.
FREE_FIELD = Site("Free1", 30.0, 30.0, 1.0, None, 30.0, 30.0, 12.0, side_order=0, facade_order=0)


def up_to(limit_hz: float, samples: int, low_hz: float = 0.0) -> np.ndarray:
    """Return the spectrum of white noise in a band."""
    spectrum, f = (
        np.fft.rfft(np.random.default_rng(3).standard_normal(samples)),
        np.fft.rfftfreq(samples, 1 / FS),
    )
    return np.where((f < low_hz) | (f > limit_hz), 0.0, spectrum)


@given(st.integers(0, 2**32 - 1), st.integers(50, 4000))
def test_bands_add_up_to_the_signal(seed, n):
    x = np.random.default_rng(seed).standard_normal(n).astype(np.float32)
    np.testing.assert_allclose(split_octaves(x, FS).sum(axis=0), x, atol=2e-5)
    assert octave_masks(np.fft.rfftfreq(n, 1 / FS)).min() >= 0.0


@pytest.mark.parametrize("frequency", [100.0, 1000.0, 4000.0])
def test_fractional_delay_error_is_below_minus_50_db(frequency):
    blocks, delay = 40, 0.0123456789
    start, rate = -2048 / FS, FS * OVERSAMPLING
    table_time = start + np.arange((blocks * KNOT_SAMPLES + 4096) * OVERSAMPLING) / rate
    table = SampledSignal(np.sin(2 * np.pi * frequency * table_time).astype(np.float32), start, rate)
    out = np.zeros(blocks * KNOT_SAMPLES, np.float32)
    add_delayed(out, table, np.arange(blocks + 1) * KNOT_SAMPLES / FS - delay, np.ones(blocks + 1))
    assert error_db(out, np.sin(2 * np.pi * frequency * (np.arange(len(out)) / FS - delay))) < -50.0


@given(st.floats(-30.0, 30.0), st.floats(5.0, 40.0), st.floats(-20.0, 20.0))
def test_emission_times_solve_the_retarded_time_equation(speed, lane, y0):
    emit = np.linspace(-1.0, 2.0, 1200)
    travel = np.hypot(lane, y0 + speed * emit)
    receive = np.linspace(0.0, 1.5, 50)
    found = emission_times(receive, emit, travel)
    # Linear between knots: v^2 h^2 / (8 r c) is 0.6 us at the worst, 0.06 % of a period at 1 kHz.
    np.testing.assert_allclose(found + np.hypot(lane, y0 + speed * found) / C, receive, rtol=0.0, atol=6e-7)


def acoular_signal(acoular, samples):
    """Return a signal of Acoular with given samples, with its own resampling."""

    class Samples(acoular.SignalGenerator):
        def signal(self):
            return samples

        def _get_digest(self):
            return "samples"

    return Samples(sample_freq=FS, num_samples=len(samples))


def test_free_field_waveform_equals_acoular():
    """Distance, delay and Doppler shift of a vehicle at three microphones."""
    acoular = pytest.importorskip("acoular")
    speed, lane, y0, seconds = 13.0, 6.0, -9.0, 1.2
    n = int(seconds * FS)
    signal = np.fft.irfft(up_to(1800.0, n, 300.0), n)
    signal /= signal.std()
    positions = np.array([[0.0, 0.35, 1.7], [0.02, -0.31, 1.9], [-0.05, 0.04, 1.5]])
    street = street_of(FREE_FIELD, positions, seconds, FS)
    sent = source_in(
        street, lambda time: signal[: len(time)], lambda time: (lane, y0 + speed * time), head_s=0.0
    )
    ours = carried(street, sent)
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
    n = 30_000
    spectrum = up_to(4000.0, n)
    delays = np.array([[0.0, 3.3e-4, -8.1e-4]])
    static = StaticSources(np.zeros((3, n), np.float32), FS)
    static.add(np.fft.irfft(spectrum, n)[None].astype(np.float32), delays)
    static.render()
    for channel, delay in zip(static.out, delays[0], strict=True):
        turned = np.fft.irfft(spectrum * np.exp(-2j * np.pi * np.fft.rfftfreq(n, 1 / FS) * delay), n)
        assert error_db(channel[5000:-5000], turned[5000:-5000]) < -45.0
