"""MUSIC against pyroomacoustics, with fewer frames than microphones too, and the number of sources."""

import numpy as np
import pyroomacoustics as pra
import pytest

from worldstate.frontend.direction.music import (
    count_sources,
    covariance,
    music_spectrum,
    signal_subspace,
)

SAMPLE_RATE_HZ, NFFT, SOUND_M_S = 48_000, 512, 343.0
BINS = np.arange(3, 19)
AZIMUTHS = np.deg2rad(np.arange(-90, 91, 1.0))


def plate(microphones, rng):
    """A vertical plate, positions in base_link axes."""
    return np.column_stack([np.zeros(microphones), rng.uniform(-0.4, 0.4, (microphones, 2))])


def steering(positions, azimuths):
    directions = np.stack([np.cos(azimuths), np.sin(azimuths), np.zeros_like(azimuths)])
    omega = 2 * np.pi * BINS * SAMPLE_RATE_HZ / NFFT
    return np.exp(1j * omega[:, None, None] * (positions @ directions) / SOUND_M_S)


def circular(rng, *shape):
    return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2)


def heard(positions, azimuths, rng, frames):
    """Plane waves in white noise of twice their power: spectra (frames, bins, M) complex64."""
    waves = circular(rng, frames, len(BINS), len(azimuths)) * np.sqrt(0.5)
    signal = np.einsum("fbd,bmd->fbm", waves, steering(positions, np.asarray(azimuths)))
    return (signal + circular(rng, *signal.shape)).astype(np.complex64)


@pytest.mark.parametrize(("frames", "sources"), [(18, 1), (18, 2), (187, 2)])
def test_spectrum_equals_pyroomacoustics(frames, sources):
    rng = np.random.default_rng(frames + sources)
    positions = plate(56, rng)
    X = heard(positions, [0.4, -0.3][:sources], rng, frames)
    peer = pra.doa.MUSIC(positions.T, SAMPLE_RATE_HZ, NFFT, c=SOUND_M_S, num_src=sources, azimuth=AZIMUTHS)
    padded = np.zeros((56, NFFT // 2 + 1, frames), dtype=complex)
    padded[:, BINS] = X.transpose(2, 1, 0)
    peer.locate_sources(padded, freq_bins=BINS)
    A = steering(positions, AZIMUTHS).astype(np.complex64)
    ours = music_spectrum(signal_subspace(X, sources), A)
    theirs = peer.grid.values
    assert np.corrcoef(ours, theirs)[0, 1] > 0.9999
    np.testing.assert_allclose(ours, theirs, rtol=2e-3)


@pytest.mark.parametrize(
    ("microphones", "frames", "truths", "azimuths_deg"),
    [*((12, 100, [truth] * 40, (-50, 10, 45)) for truth in range(4)), (56, 19, [0, 1, 2] * 10, (-40, 30))],
)
def test_number_of_sources(microphones, frames, truths, azimuths_deg):
    """Also with fewer frames than microphones."""
    rng = np.random.default_rng(truths[-1])
    positions, hits = plate(microphones, rng), 0
    for truth in truths:
        X = heard(positions, np.deg2rad(azimuths_deg[:truth]), rng, frames)
        hits += count_sources(np.linalg.eigvalsh(covariance(X)), frames) == truth
    assert hits >= 0.9 * len(truths)
