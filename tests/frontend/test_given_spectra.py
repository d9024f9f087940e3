"""Spectra that another front-end computed, beside one channel of sound."""

import numpy as np
import pytest
from plane_waves import plane_wave

from worldstate.adapters.listener import Listener
from worldstate.frontend import FrontEnd, FrontEndSettings, GivenSpectra, MicrophoneArray, ovad_array
from worldstate.frontend.direction.feature import FEATURE_BAND_HZ
from worldstate.frontend.given_spectra import SpectrumFrontEnd
from worldstate.frontend.hop_spectra import hop_end

RATE_HZ = 48_000
AHEAD_RAD = np.radians(np.linspace(-90.0, 90.0, 180))
SEVEN = MicrophoneArray(ovad_array().positions_m[::8])
SETTINGS = FrontEndSettings(level_band_hz=(50.0, 2700.0), character=True)


def street(azimuth_rad, rng, seconds=2.3):
    """Return noise from one azimuth at the seven microphones, and as much noise between them, (n, 7)."""
    n = int(seconds * RATE_HZ)
    wave = plane_wave(SEVEN, rng.standard_normal(n), azimuth_rad, RATE_HZ)
    return 0.05 * (wave + 0.5 * rng.standard_normal((n, 7)))


def pair_sums(sound):
    """Return the pair sums of every hop by pyroomacoustics' STFT and the plain formula, (hops, 180)."""
    transform = pytest.importorskip("pyroomacoustics").transform.stft
    hz = np.arange(1, 257) * RATE_HZ / 512
    inside = (hz >= FEATURE_BAND_HZ[0]) & (hz < FEATURE_BAND_HZ[1])
    units = np.stack([np.cos(AHEAD_RAD), np.sin(AHEAD_RAD), 0.0 * AHEAD_RAD])
    steering = np.exp(2j * np.pi * hz[inside, None, None] * (SEVEN.positions_m @ units) / 343.0)
    rows = []
    for k in range(len(sound) * 10 // RATE_HZ):
        hop = sound[hop_end(k, RATE_HZ) : hop_end(k + 1, RATE_HZ)]
        spectra = transform.analysis(hop, 512, 256, win=np.hanning(513)[:-1])[:, 1:257][:, inside]
        whitened = spectra / np.abs(spectra)
        pairs = np.triu(np.einsum("tki,tkj->kij", whitened, whitened.conj()), 1) / len(whitened)
        total = (steering.conj() * (pairs @ steering)).sum(axis=(0, 1))
        rows.append(np.abs(total) / (21.0 * inside.sum()))
    return np.array(rows)


def given(sound):
    return GivenSpectra(pair_sums(sound), AHEAD_RAD, SEVEN)


@pytest.mark.parametrize("azimuth_deg", [-40.0, 0.0, 25.0])
def test_spectra_give_the_frames_of_their_channels(azimuth_deg):
    rng = np.random.default_rng(3)
    sound = street(np.radians(azimuth_deg), rng)
    frames = SpectrumFrontEnd(given(sound), RATE_HZ, SETTINGS).process(sound[:, :1])
    whole = FrontEnd(SEVEN, RATE_HZ, SETTINGS).process(sound)
    assert [one.stamp_ns for one in frames] == [one.stamp_ns for one in whole]
    for one, other in zip(frames, whole, strict=True):
        assert np.degrees(one.bearing_rad) == pytest.approx(azimuth_deg, abs=2.0)
        # Frames across a hop boundary are in neither pair sum.
        assert np.corrcoef(one.feature, other.feature)[0, 1] > 0.99
        assert np.log(one.feature).mean() == pytest.approx(np.log(other.feature).mean(), abs=0.1)


def test_levels_and_looming_come_from_the_single_channel():
    rng = np.random.default_rng(4)
    louder = np.exp(np.linspace(0.0, 2.0, int(2.3 * RATE_HZ)))[:, None]
    sound = (street(0.3, rng) * louder).astype(np.float32)
    frames = SpectrumFrontEnd(given(sound), RATE_HZ, SETTINGS).process(sound[:, :1])
    twice = MicrophoneArray([[0.0, 0.1, 0.0], [0.0, -0.1, 0.0]])
    quiet = FrontEndSettings(level_band_hz=(50.0, 2700.0), watch_channels=False, character=True)
    whole = FrontEnd(twice, RATE_HZ, quiet).process(np.repeat(sound[:, :1], 2, axis=1))
    for one, other in zip(frames, whole, strict=True):
        np.testing.assert_allclose(one.band_log_energy, other.band_log_energy, atol=1e-5)
        assert one.looming.inverse_tta_hz == pytest.approx(other.looming.inverse_tta_hz, rel=0.05)
    np.testing.assert_allclose(frames[-1].character, whole[-1].character, atol=1e-4)


def test_blocks_of_any_length_give_the_same_states_across_a_checkpoint():
    rng = np.random.default_rng(5)
    sound = street(0.5, rng).astype(np.float32)[:, :1]
    spectra = GivenSpectra(rng.uniform(0.1, 0.3, (22, 180)), AHEAD_RAD, SEVEN)
    whole = Listener(ovad_array(), RATE_HZ, spectra=spectra).push(sound)
    first, rest = (np.array_split(part, 20) for part in (sound[:70_000], sound[70_000:]))
    listener = Listener(ovad_array(), RATE_HZ, spectra=spectra)
    pieces = [state for block in first for state in listener.push(block)]
    other = Listener(ovad_array(), RATE_HZ, spectra=spectra, resume=listener.checkpoint())
    pieces += [state for block in rest for state in other.push(block)]
    # The last hop of the sound has no spectrum.
    assert len(whole) == 13 and pieces == whole


def test_unmeasured_hearing_is_null():
    rng = np.random.default_rng(7)
    spectra = GivenSpectra(rng.uniform(0.1, 0.3, (15, 180)), AHEAD_RAD, SEVEN)
    states = Listener(ovad_array(), RATE_HZ, spectra=spectra).push(street(0.5, rng)[:, :1])
    assert states[-1].heard is None and not states[-1].calibrated
    assert states[-1].to_dict()["heard"] is None
    assert all(cue.alpha is None for cue in states[-1].cues)


def test_rows_of_half_a_window_count_at_their_end():
    """A row of five hops equals the mean of five rows of one hop."""
    rng = np.random.default_rng(8)
    rows = rng.uniform(0.1, 0.3, (23, 180))
    halves = np.array([rows[max(k - 4, 0) : k + 1].mean(axis=0) for k in range(23)])
    sound = street(0.5, rng)[:, :1]
    hops, whole = (
        SpectrumFrontEnd(GivenSpectra(values, AHEAD_RAD, SEVEN, each), RATE_HZ, SETTINGS).process(sound)
        for values, each in ((rows, 1), (halves, 5))
    )
    for one, other in zip(hops, whole, strict=True):
        np.testing.assert_allclose(one.feature, other.feature)
        np.testing.assert_allclose(one.srp, other.srp)
        # The peak is that of the newest row.
        assert (one.bearing_age_s, other.bearing_age_s) == (0.1, 0.25)
