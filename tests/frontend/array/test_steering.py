"""Power at a few directions determines the power at all directions."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from worldstate.frontend.array.microphone_array import MicrophoneArray, roof_array_56
from worldstate.frontend.array.steering import Steering, interpolation_nodes
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
def test_a_quadratic_form_is_interpolated_from_its_nodes(seed: int, planar: bool, span: float) -> None:
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


def test_the_roof_array_needs_few_nodes_for_the_power_of_all_beams() -> None:
    assert BEAMS.nodes is not None
    assert BEAMS.nodes[0].weights.shape[2] <= 32
    spectra = heard(np.random.default_rng(0), [20.0], 3.0)
    direct = np.square(np.abs(np.einsum("kmd,tkm->tkd", RESPONSE.conj(), spectra))).sum(axis=(0, 1))
    ours = BEAMS.quadratic_form(BEAMS.covariance(spectra))
    np.testing.assert_allclose(ours.real, direct, atol=2e-6 * direct.max())
    E = np.linalg.qr(circular(np.random.default_rng(1), 16, 56, 2))[0].astype(np.complex64)
    within = np.square(np.abs(E.conj().transpose(0, 2, 1) @ RESPONSE)).sum(axis=1)
    np.testing.assert_allclose(BEAMS.power_within(E), within, atol=1e-4)
