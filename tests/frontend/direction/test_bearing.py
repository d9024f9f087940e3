"""SRP-PHAT and MUSIC against pyroomacoustics, pair delays, and the stated error of a bearing."""

import numpy as np
import pyroomacoustics
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plane_waves import noise_from, plane_wave

from worldstate.frontend.array.microphone_array import MicrophoneArray, ovad_array, roof_array_56
from worldstate.frontend.array.steering import Steering
from worldstate.frontend.bounds.cramer_rao import delay_crb_s2
from worldstate.frontend.direction.bearing import AcousticBearing, BearingScatter, srp_phat
from worldstate.frontend.direction.feature import feature_nfft
from worldstate.frontend.direction.gcc_phat import all_pairs, gcc_delays
from worldstate.frontend.direction.music import count_sources, covariance, music_spectrum, signal_subspace
from worldstate.frontend.settings import FrontEndSettings
from worldstate.frontend.spectra.stft import StreamingStft, band_bins, bin_frequencies_hz
from worldstate.frontend.stream import AcousticFrame, FrontEnd
from worldstate.ground.typing import FloatArray

AZIMUTHS = np.radians(np.arange(-90.0, 91.0))
BAND = (300.0, 1800.0)


@pytest.mark.parametrize("rate", [47_998.0, 16_000.0])
@pytest.mark.parametrize("layout", ["roof", "square", "line", "solid"])
def test_srp_phat_equals_pyroomacoustics_on_the_same_frames(layout: str, rate: float) -> None:
    layouts = {
        "roof": roof_array_56().positions_m,
        "square": [[0.1, 0.1, 0], [0.1, -0.1, 0], [-0.1, -0.1, 0], [-0.1, 0.1, 0]],
        "line": [[0, 0.1 * i, 0] for i in range(6)],
        "solid": np.random.default_rng(5).uniform(-0.3, 0.3, (9, 3)),
    }
    array = MicrophoneArray(layouts[layout])
    sound = noise_from(array, 0.3, rate, 4800 / rate)
    frames = StreamingStft(array.n_microphones, 512, range(0, 257)).push(sound)
    peer = pyroomacoustics.doa.SRP(array.positions_m.T, rate, 512, c=343.0, azimuth=AZIMUTHS)
    peer.locate_sources(frames.transpose(2, 1, 0).astype(np.complex128), freq_range=list(BAND))
    bins = band_bins(BAND, rate, 512)
    beams = Steering.towards(array, bin_frequencies_hz(bins, rate, 512), AZIMUTHS)
    ours = srp_phat(frames[:, bins.start : bins.stop], beams)
    m = array.n_microphones
    np.testing.assert_allclose(ours * 2 * m / (m - 1), peer.grid.values, rtol=2e-5)


RATE = 6000
# Wide spacing as in OVAD's array: two rows of different height, no microphone above another.
FOUR = MicrophoneArray([[0, 0.41, 0.3], [0, -0.28, 0.3], [0, -0.37, -0.3], [0, 0.25, -0.3]])
SPREAD = {
    56: ovad_array(),
    14: MicrophoneArray(ovad_array().positions_m[::4]),
    7: MicrophoneArray(ovad_array().positions_m[::8]),
    4: FOUR,
}


def wave(array: MicrophoneArray, azimuth_deg: float, elevation_deg: float, n: int, seed: int) -> FloatArray:
    """White plane wave of unit power, (n, M)."""
    sound = np.random.default_rng(seed).standard_normal(n)
    return plane_wave(array, sound, np.radians(azimuth_deg), RATE, np.radians(elevation_deg))


def diffuse(array: MicrophoneArray, seconds: int, seed: int) -> FloatArray:
    """Waves of equal power from 48 directions all round, a little above and below the horizon."""
    rng = np.random.default_rng(seed)
    azimuths, elevations = np.linspace(-np.pi, np.pi, 48, endpoint=False), rng.uniform(-0.3, 0.3, 48)
    steering = array.steering(np.fft.rfftfreq(RATE, 1 / RATE), azimuths, elevations)
    spectra = np.fft.rfft(rng.standard_normal((seconds, 48, RATE))).transpose(2, 1, 0)
    return np.concatenate(np.fft.irfft((steering @ spectra).transpose(2, 0, 1), RATE, axis=1))


def hear(array: MicrophoneArray, sound: FloatArray) -> list[AcousticFrame]:
    chosen = FrontEndSettings(nfft=feature_nfft(RATE), watch_channels=False)
    return FrontEnd(array, RATE, chosen).process(sound)


@pytest.mark.long
@pytest.mark.parametrize("microphones", SPREAD)
@pytest.mark.parametrize("kind", ["white", "diffuse"])
def test_a_bearing_of_noise_has_a_large_error(kind: str, microphones: int) -> None:
    array, rng = SPREAD[microphones], np.random.default_rng(1)
    white = rng.standard_normal((4 * RATE, microphones))
    frames = hear(array, diffuse(array, 3, 1) if kind == "diffuse" else white)
    stated = np.degrees([frame.bearing_std_rad for frame in frames])
    assert np.mean(stated < 10.0) <= 0.1
    # A uniform bearing ahead has a deviation of 52 degrees, and a bearing of noise one of 40 or more.
    assert np.median(stated) > 30.0


def test_the_stated_error_of_a_single_source_is_correct() -> None:
    """Drawn arrays, directions and 3 to 25 dB of noise that is independent between microphones."""
    scores, n = [], round(1.1 * RATE)
    for seed in range(40):
        rng = np.random.default_rng(seed)
        microphones = int(rng.integers(4, 25))
        azimuth_deg, elevation_deg = rng.uniform(-60, 60), rng.uniform(-15, 2)
        array = MicrophoneArray(rng.uniform([-0.05, -0.4, -0.3], [0.05, 0.4, 0.3], (microphones, 3)))
        noise = rng.standard_normal((n, microphones)) * 10 ** (-rng.uniform(3, 25) / 20)
        for frame in hear(array, wave(array, azimuth_deg, elevation_deg, n, seed) + noise):
            assert frame.prominence > frame.least_prominence
            assert frame.bearing_std_rad < np.radians(40)
            scores.append((np.degrees(frame.bearing_rad) - azimuth_deg) / np.degrees(frame.bearing_std_rad))
    assert 0.7 < np.sqrt(np.mean(np.square(scores))) < 1.3


def test_contradicting_bearings_have_a_larger_error() -> None:
    """Two sources in turn, as with a reflecting wall, widen the error; a single source keeps it."""
    array, n = SPREAD[14], 4 * RATE
    lone, other = wave(array, 30.0, 0.0, n, 6), wave(array, -20.0, 0.0, n, 7)
    first = (np.arange(n) // (RATE // 2) % 2 == 0)[:, None]
    assert hear(array, lone)[-1].bearing_std_rad < np.radians(2.0)
    assert hear(array, np.where(first, lone, other))[-1].bearing_std_rad > np.radians(25.0)


def test_agreeing_bearings_do_not_hide_earlier_contradictions() -> None:
    """A steady reflection with an error of 1 degree follows bearings 60 degrees apart with 15 degrees."""
    scatter = BearingScatter(most_rad=np.radians(52.0))
    degrees = [0.0, 60.0] * 15 + [0.0] * 30
    stated = [scatter.widened(AcousticBearing(np.radians(d), np.radians(15 - 14 * (k >= 30)), 2.0)).std_rad
              for k, d in enumerate(degrees)]  # fmt: skip
    assert max(stated) <= np.radians(52.0)
    assert stated[-1] > np.radians(20.0)


@pytest.mark.parametrize("microphones", SPREAD)
def test_a_source_below_the_horizon_keeps_its_azimuth(microphones: int) -> None:
    """Tyres 8 m ahead of a roof array: a search at the horizon alone was 40 degrees off."""
    array = SPREAD[microphones]
    rng = np.random.default_rng(2)
    for azimuth in (-50.0, -10.0, 30.0):
        sound = wave(array, azimuth, -10.0, RATE, 3) + 0.3 * rng.standard_normal((RATE, microphones))
        (frame,) = hear(array, sound)
        assert np.degrees(frame.bearing_rad) == pytest.approx(azimuth, abs=3.0)


@pytest.mark.parametrize("microphones", SPREAD)
def test_the_error_covers_both_of_two_equal_sources(microphones: int) -> None:
    array = SPREAD[microphones]
    lone, other = wave(array, 35.0, 0.0, RATE, 4), wave(array, -35.0, 0.0, RATE, 5)
    (alone,), (both,), (weak,) = (hear(array, lone + gain * other) for gain in (0.0, 1.0, 0.3))
    assert alone.bearing_std_rad < np.radians(12)
    assert both.bearing_std_rad > np.radians(35)
    assert alone.bearing_std_rad <= weak.bearing_std_rad < 0.6 * both.bearing_std_rad


BINS_HZ = np.arange(300.0, 1800.0, 50.0)
# The bins from 281 to 1688 Hz.
BINS = np.arange(3, 19)
FREQUENCIES = bin_frequencies_hz(range(3, 19), 48_000, 512)


def plate(microphones: int, rng: np.random.Generator) -> MicrophoneArray:
    """Return microphones anywhere on a vertical plate."""
    return MicrophoneArray(np.column_stack([np.zeros(microphones), rng.uniform(-0.4, 0.4, (microphones, 2))]))


def circular(rng, *shape):
    return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2)


def spectra_of(array, azimuths, rng, frames):
    """Plane waves in white noise of twice their power: spectra (frames, bins, M) complex64."""
    waves = circular(rng, frames, len(BINS), len(azimuths)) * np.sqrt(0.5)
    signal = np.einsum("fbd,bmd->fbm", waves, array.steering(FREQUENCIES, np.asarray(azimuths)))
    return (signal + circular(rng, *signal.shape)).astype(np.complex64)


@pytest.mark.parametrize(("frames", "sources"), [(18, 1), (18, 2), (187, 2)])
def test_music_equals_pyroomacoustics(frames, sources):
    """Also with fewer frames than microphones."""
    rng = np.random.default_rng(frames + sources)
    array = plate(56, rng)
    X = spectra_of(array, [0.4, -0.3][:sources], rng, frames)
    peer = pyroomacoustics.doa.MUSIC(
        array.positions_m.T, 48_000, 512, c=343.0, num_src=sources, azimuth=AZIMUTHS
    )
    padded = np.zeros((56, 257, frames), dtype=complex)
    padded[:, BINS] = X.transpose(2, 1, 0)
    peer.locate_sources(padded, freq_bins=BINS)
    ours = music_spectrum(
        signal_subspace(X, sources), array.steering(FREQUENCIES, AZIMUTHS).astype(np.complex64)
    )
    np.testing.assert_allclose(ours, peer.grid.values, rtol=2e-3)


@pytest.mark.parametrize(
    ("microphones", "frames", "truths", "azimuths_deg"),
    [*((12, 100, [truth] * 40, (-50, 10, 45)) for truth in range(4)), (56, 19, [0, 1, 2] * 10, (-40, 30))],
)
def test_the_number_of_sources_is_found(microphones, frames, truths, azimuths_deg):
    """Also with fewer frames than microphones."""
    rng = np.random.default_rng(truths[-1])
    array, hits = plate(microphones, rng), 0
    for truth in truths:
        X = spectra_of(array, np.deg2rad(azimuths_deg[:truth]), rng, frames)
        hits += count_sources(np.linalg.eigvalsh(covariance(X)), frames) == truth
    assert hits >= 0.9 * len(truths)


def delayed(delays, rng, frames=40, noise=0.0):
    """One wave at microphones with these arrival times: spectra (frames, bins, M)."""
    wave = circular(rng, frames, len(BINS_HZ), 1)
    shift = np.exp(-2j * np.pi * BINS_HZ[:, None] * np.asarray(delays))
    return wave * shift + noise * circular(rng, frames, len(BINS_HZ), len(delays))


@settings(max_examples=50, deadline=None)
@given(arrivals=st.lists(st.floats(-1e-3, 1e-3), min_size=2, max_size=5))
def test_noiseless_delays_are_exact_between_samples(arrivals):
    X = delayed(arrivals, np.random.default_rng(0))
    got = gcc_delays(X, BINS_HZ, 2.5e-3)
    i, j = all_pairs(len(arrivals)).T
    np.testing.assert_allclose(got.delay_s, np.take(arrivals, i) - np.take(arrivals, j), atol=1e-12)
    np.testing.assert_allclose(got.peak, 1.0, atol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("snr", [1.0, 10.0, 100.0])
def test_variance_meets_the_bound(snr):
    rng = np.random.default_rng(int(snr))
    frames, truth, trials = 60, 1.37e-4, 600
    errors = []
    for _ in range(trials):
        X = delayed([truth, 0.0], rng, frames=frames, noise=snr**-0.5)
        errors.append(gcc_delays(X, BINS_HZ, 3e-3).delay_s[0] - truth)
    coherence = (snr / (1 + snr)) ** 2
    spacing = BINS_HZ[1] - BINS_HZ[0]
    # The sum over bins as an integral: frames of 1 / spacing seconds each, half a bin added at either end.
    edges = np.array([BINS_HZ[0] - spacing / 2, BINS_HZ[-1] + spacing / 2])
    fine = np.linspace(*edges, 2000)
    bound = delay_crb_s2(fine, np.full(fine.size, coherence), frames / spacing)
    ratio_db = 10 * np.log10(np.var(errors) / bound)
    sampling_db = 10 * np.log10(1 - 3.0 * np.sqrt(2 / trials))
    assert sampling_db < ratio_db < 1.5
    assert abs(np.mean(errors)) < 4 * np.sqrt(bound / trials)


def test_a_dead_microphone_has_no_peak():
    X = delayed([0.0, 1e-4, 0.0], np.random.default_rng(2), frames=4000, noise=1.0)
    X[..., 2] = 0.0
    assert gcc_delays(X, BINS_HZ, 1e-3).peak[1] == 0.0
