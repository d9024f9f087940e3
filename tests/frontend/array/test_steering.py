"""Power at a few directions says it at all; sums that forget; MUSIC on them, raw and prewhitened."""

import numpy as np
import pyroomacoustics as pra
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from worldstate.frontend.array.microphone_array import ChannelMask, MicrophoneArray, roof_array_56
from worldstate.frontend.array.steering import Steering, interpolation_nodes
from worldstate.frontend.direction.music import MusicReading, MusicStage, WindowSum, covariance_subspace
from worldstate.frontend.spectra.stft import bin_frequencies_hz

RATE, NFFT, BINS = 47_998, 512, range(3, 19)
ROOF, GRID = roof_array_56(), np.radians(np.arange(-90.0, 91.0))
FREQUENCIES = bin_frequencies_hz(BINS, RATE, NFFT)
BEAMS = Steering.towards(ROOF, FREQUENCIES, GRID)
RESPONSE = ROOF.steering(FREQUENCIES, GRID)


def circular(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)


def heard(rng: np.random.Generator, azimuths_deg: list[float], snr: float, frames: int = 19) -> np.ndarray:
    """Plane waves in white noise, spectra (frames, K, M) complex64."""
    noise = circular(rng, frames, len(BINS), 56)
    for azimuth in azimuths_deg:
        response = ROOF.steering(FREQUENCIES, np.radians(azimuth))[:, :, 0]
        noise += np.sqrt(snr) * circular(rng, frames, len(BINS), 1) * response
    return noise.astype(np.complex64)


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 2**32 - 1), planar=st.booleans(), span=st.floats(0.2, 3.1))
def test_any_quadratic_form_is_said_by_its_nodes(seed: int, planar: bool, span: float) -> None:
    rng = np.random.default_rng(seed)
    places = rng.uniform(-0.3, 0.3, (8, 3)) * [0.0 if planar else 1.0, 1.0, 1.0]
    vectors = MicrophoneArray(places).steering([400.0, 900.0], np.linspace(-span, span, 151))
    nodes = interpolation_nodes(vectors)
    assert nodes is not None
    index, spread = nodes
    assert len(index) < 60
    Q = circular(rng, 2, 8, 8)
    power = np.einsum("kmd,kmn,knd->d", vectors.conj(), Q, vectors)
    missed = np.abs(power[index] @ spread - power).max()
    assert missed < 1e-6 * 64 * np.linalg.norm(Q, axis=(1, 2)).max()


def test_too_coarse_a_grid_has_no_nodes() -> None:
    assert interpolation_nodes(ROOF.steering([1500.0], np.radians(np.linspace(-90, 90, 15)))) is None


def test_the_roof_needs_few_and_its_power_is_that_of_every_beam() -> None:
    assert BEAMS.nodes is not None
    assert BEAMS.nodes.weights.shape[2] <= 32
    spectra = heard(np.random.default_rng(0), [20.0], 3.0)
    direct = np.square(np.abs(np.einsum("kmd,tkm->tkd", RESPONSE.conj(), spectra))).sum(axis=(0, 1))
    ours = BEAMS.quadratic_form(BEAMS.covariance(spectra))
    np.testing.assert_allclose(ours.real, direct, atol=2e-6 * direct.max())
    E = np.linalg.qr(circular(np.random.default_rng(1), 16, 56, 2))[0].astype(np.complex64)
    within = np.square(np.abs(E.conj().transpose(0, 2, 1) @ RESPONSE)).sum(axis=1)
    np.testing.assert_allclose(BEAMS.power_within(E), within, atol=1e-4)
    keep = np.arange(56) % 3 > 0
    lengths = BEAMS.squared_lengths(keep)
    np.testing.assert_allclose(lengths, np.full(lengths.shape, keep.sum()), rtol=1e-5)


@settings(deadline=None, max_examples=60)
@given(
    length=st.integers(1, 13),
    levels=st.lists(st.sampled_from([0.0, 1e-6, 1e-3, 1.0, 1e6]), min_size=1, max_size=40),
)
def test_a_window_sum_forgets_what_was_loud(length: int, levels: list[float]) -> None:
    rng, window = np.random.default_rng(0), WindowSum(length, n_bins=2, size=3)
    sets: list[np.ndarray] = []
    for level in levels:
        x = np.sqrt(level) * circular(rng, 2, 3, 5)
        sets.append((x @ x.conj().transpose(0, 2, 1)).astype(np.complex64))
        window.open_slot()[...] = sets[-1]
        window.close_slot()
        expected = np.sum([s.astype(complex) for s in sets[-length:]], axis=0)
        scale = np.einsum("bmm->b", expected).real.max()
        np.testing.assert_allclose(window.total, expected, atol=2e-5 * scale)


@pytest.mark.parametrize(("snr", "sources"), [(0.0, 1), (0.3, 1), (1e4, 1), (0.3, 2), (100.0, 2)])
def test_stream_equals_pyroomacoustics_on_the_same_frames(snr: float, sources: int) -> None:
    """Every hop of a source that moves at 40 deg/s, in noise without any source, and far above the noise."""
    rng, window = np.random.default_rng(3), 5
    stage = MusicStage([BEAMS], GRID, sources, 56, window)
    peer = pra.doa.MUSIC(
        ROOF.positions_m.T, RATE, NFFT, c=343.0, num_src=sources, azimuth=GRID, frequency_normalization=True
    )
    hops: list[np.ndarray] = []
    for hop in range(14):
        hops.append(heard(rng, [-60.0 + 4 * hop, 40.0][:sources], snr))
        stage.push(hops[-1])
        reading = stage.read(ChannelMask.all_of(56))
        frames = np.concatenate(hops[-window:])
        padded = np.zeros((56, NFFT // 2 + 1, len(frames)), complex)
        padded[:, BINS.start : BINS.stop] = frames.transpose(2, 1, 0)
        peer.locate_sources(padded, freq_bins=np.arange(BINS.start, BINS.stop))
        assert isinstance(reading, MusicReading)
        assert np.corrcoef(reading.spectrum, peer.grid.values)[0, 1] > 0.9999


def test_whitened_music_is_the_generalised_eigenvalue_form() -> None:
    """Noise from one side drowns the source; whitened by its covariance, MUSIC is that of R_x u = l R u."""
    rng, mask = np.random.default_rng(5), ChannelMask.all_of(56)
    noise = ROOF.steering(FREQUENCIES, np.radians(-40.0))[:, :, 0]
    R = np.eye(56) + 30.0 * np.einsum("km,kn->kmn", noise, noise.conj())
    values, vectors = np.linalg.eigh(R)
    roots = (vectors / np.sqrt(values)[:, None]) @ vectors.conj().transpose(0, 2, 1)
    X = heard(rng, [25.0], 3.0, 150) + np.sqrt(30.0) * circular(rng, 150, 16, 1) * noise
    whitened = np.einsum("kmn,tkn->tkm", roots, X).astype(np.complex64)
    B = roots @ RESPONSE
    B *= np.sqrt(56.0) / np.linalg.norm(B, axis=1, keepdims=True)
    beams = Steering(None, B.conj().astype(np.complex64), B.astype(np.complex64))
    stage = MusicStage([BEAMS], GRID, 1, 56, 1)
    stage.push(X.astype(np.complex64))
    raw = stage.read(mask)
    stage.push(whitened, [beams])
    reading = stage.read(mask)
    assert isinstance(raw, MusicReading)
    assert isinstance(reading, MusicReading)
    assert np.degrees(raw.azimuth_rad) == pytest.approx(-40.0, abs=1.0)
    assert np.degrees(reading.azimuth_rad) == pytest.approx(25.0, abs=1.0)
    E = covariance_subspace(np.einsum("tkm,tkn->kmn", whitened, whitened.conj()), 1).vectors
    outside = 56.0 - np.square(np.abs(E.conj().transpose(0, 2, 1) @ B)).sum(axis=1)
    expected = (outside.min(axis=1, keepdims=True) / outside).mean(axis=0)
    assert np.corrcoef(reading.spectrum, expected)[0, 1] > 0.9999
