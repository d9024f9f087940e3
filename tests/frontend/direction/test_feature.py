"""The published feature and given pair sums: against a plain restatement and pyroomacoustics.

The shipped model was trained on the released feature windows. The restatement follows the formula in double
precision and shares nothing with the library but the place of the microphones.
"""

from collections.abc import Iterable
from itertools import pairwise

import numpy as np
import pyroomacoustics
import pytest
import scipy.signal
from acoular_scene import RATE
from plane_waves import noise_from

from worldstate.adapters.listener import Listener
from worldstate.frontend.array.microphone_array import MicrophoneArray, ovad_array, roof_array_56
from worldstate.frontend.array.steering import cross_spectra
from worldstate.frontend.direction.feature import feature_steering, pair_sum, published_feature
from worldstate.frontend.given_spectra import GivenSpectra, SpectrumFrontEnd
from worldstate.frontend.settings import FrontEndSettings
from worldstate.frontend.spectra.stft import StreamingStft
from worldstate.frontend.stream import FrontEnd

ROOF = roof_array_56()
SMALL = MicrophoneArray(np.random.default_rng(3).uniform(-0.4, 0.4, (7, 3)))
RIGHT_POSITIVE_RAD = np.radians(np.linspace(-90.0, 90.0, 30))


def plain_feature(
    segments: Iterable[np.ndarray], positions_m: np.ndarray, azimuths_rad=RIGHT_POSITIVE_RAD, rate=RATE
) -> np.ndarray:
    """|sum over frames, bins and pairs i < j| over their number, of spectra (257, M, frames) per segment."""
    bins = np.arange(round(50 / rate * 512), round(1500 / rate * 512))
    pairs = len(positions_m) * (len(positions_m) - 1) / 2
    units = np.stack([np.cos(azimuths_rad), -np.sin(azimuths_rad)])
    early_s = positions_m[:, :2] @ units / 343.0
    turn, values = np.exp(2j * np.pi * rate / 512 * bins[:, None, None] * early_s), []
    for spectra in segments:
        phases = np.exp(1j * np.angle(spectra[bins]))
        products = np.triu(phases @ np.conj(phases).transpose(0, 2, 1), 1)
        total = np.sum(np.conj(turn) * (products @ turn), axis=(0, 1))
        values.append(np.abs(total) / (spectra.shape[2] * len(bins) * pairs))
    return np.concatenate(values)


def plain_window(window: np.ndarray, positions_m: np.ndarray) -> np.ndarray:
    """The feature of a window with zero-padded edges; an odd last frame is omitted."""
    spectra = scipy.signal.stft(window.astype(np.float64), RATE, nperseg=512, axis=0)[2]
    half = spectra.shape[2] // 2
    return plain_feature((spectra[..., :half], spectra[..., half : 2 * half]), positions_m)


def frames_of(sound: np.ndarray, padded: bool = False) -> np.ndarray:
    """Spectra (257, M, frames) without a padded beginning."""
    return scipy.signal.stft(sound, nperseg=512, axis=0, boundary=None, padded=padded)[2]


def street(array: MicrophoneArray, seed: int, seconds: float = 1.0, rate: int = RATE) -> np.ndarray:
    """A white source to the left at 40 deg and noise, float32 (n, M)."""
    return noise_from(array, np.radians(40.0), rate, seconds, seed, noise=1.0)


def test_a_stream_equals_the_plain_formula_per_half() -> None:
    sound = street(SMALL, 1, seconds=1.3)
    frame = FrontEnd(SMALL, RATE).process(sound)[2]
    edges = [round(time_s * RATE) for time_s in (0.2, 0.7, 1.2)]
    assert frame.sample_index == edges[2]
    spectra = frames_of(sound)
    ends = 512 + 256 * np.arange(spectra.shape[2])
    halves = [spectra[..., (ends > a) & (ends <= b)] for a, b in pairwise(edges)]
    np.testing.assert_allclose(frame.feature, plain_feature(halves, SMALL.positions_m), rtol=1e-4)


def test_twice_the_real_part_plus_the_diagonal_is_pyroomacoustics() -> None:
    frames = StreamingStft(56, 512, range(0, 257)).push(street(ROOF, 4, seconds=0.2))
    right_handed = ROOF.positions_m * [1.0, -1.0, 1.0]
    peer = pyroomacoustics.doa.SRP(right_handed.T, RATE, 512, azimuth=RIGHT_POSITIVE_RAD)
    peer.locate_sources(frames.transpose(2, 1, 0).astype(np.complex128), freq_range=[50.0, 1500.0])
    used = frames[:, 1:16].transpose(1, 0, 2)
    sums = pair_sum(cross_spectra(used / np.abs(used)), feature_steering(ROOF, range(1, 16), RATE))
    pairs = 56 * 55 / 2
    expected = 2 * sums.real / (len(frames) * 15 * pairs) + 56 / pairs
    np.testing.assert_allclose(expected, peer.grid.values, rtol=1e-4)


@pytest.mark.parametrize("rate", [16_000, 48_000])
def test_other_rates_agree_too(rate: int) -> None:
    sound = street(SMALL, 6, rate=rate)
    stream = FrontEnd(SMALL, rate).process(sound)[0].feature
    assert np.corrcoef(stream, published_feature(sound, SMALL, rate))[0, 1] > 0.99


@pytest.mark.parametrize(("array", "seed"), [(SMALL, 0), (ROOF, 2)])
def test_a_whole_window_equals_the_plain_formula(array: MicrophoneArray, seed: int) -> None:
    window = street(array, seed)
    plain = plain_window(window, array.positions_m)
    np.testing.assert_allclose(published_feature(window, array, RATE), plain, rtol=1e-4)


GIVEN_HZ = 48_000
LEFT_POSITIVE_RAD = np.radians(np.linspace(-90.0, 90.0, 180))
SEVEN = MicrophoneArray(ovad_array().positions_m[::8])
SETTINGS = FrontEndSettings(level_band_hz=(50.0, 2700.0), character=True)


def at_seven(azimuth_rad: float, seed: int) -> np.ndarray:
    return 0.05 * noise_from(SEVEN, azimuth_rad, GIVEN_HZ, 2.3, seed, noise=0.5)


def given(sound: np.ndarray) -> GivenSpectra:
    """Return the pair sums of every hop by the plain formula, in place of another front-end."""
    hops = [frames_of(sound[i : i + 4800], padded=True) for i in range(0, len(sound), 4800)]
    sums = plain_feature(hops, SEVEN.positions_m, -LEFT_POSITIVE_RAD, GIVEN_HZ)
    return GivenSpectra(sums.reshape(-1, 180), LEFT_POSITIVE_RAD, SEVEN)


@pytest.mark.parametrize("azimuth_deg", [-40.0, 0.0, 25.0])
def test_spectra_give_the_frames_of_their_channels(azimuth_deg):
    sound = at_seven(np.radians(azimuth_deg), 9)
    frames = SpectrumFrontEnd(given(sound), GIVEN_HZ, SETTINGS).process(sound[:, :1])
    whole = FrontEnd(SEVEN, GIVEN_HZ, SETTINGS).process(sound)
    assert [one.stamp_ns for one in frames] == [one.stamp_ns for one in whole]
    for one, other in zip(frames, whole, strict=True):
        assert np.degrees(one.bearing_rad) == pytest.approx(azimuth_deg, abs=2.0)
        # Frames across a hop boundary are in neither pair sum.
        assert np.corrcoef(one.feature, other.feature)[0, 1] > 0.99
        assert np.log(one.feature).mean() == pytest.approx(np.log(other.feature).mean(), abs=0.1)


def test_levels_and_looming_come_from_the_single_channel():
    louder = np.exp(np.linspace(0.0, 2.0, round(2.3 * GIVEN_HZ)))[:, None]
    sound = np.float32(at_seven(0.3, 4) * louder)
    frames = SpectrumFrontEnd(given(sound), GIVEN_HZ, SETTINGS).process(sound[:, :1])
    twice = MicrophoneArray([[0.0, 0.1, 0.0], [0.0, -0.1, 0.0]])
    quiet = FrontEndSettings(level_band_hz=(50.0, 2700.0), watch_channels=False, character=True)
    whole = FrontEnd(twice, GIVEN_HZ, quiet).process(np.repeat(sound[:, :1], 2, axis=1))
    for one, other in zip(frames, whole, strict=True):
        np.testing.assert_allclose(one.band_log_energy, other.band_log_energy, atol=1e-5)
        assert one.looming.inverse_tta_hz == pytest.approx(other.looming.inverse_tta_hz, rel=0.05)
    np.testing.assert_allclose(frames[-1].character, whole[-1].character, atol=1e-4)


def test_blocks_of_any_length_give_the_same_states_across_a_checkpoint():
    rng = np.random.default_rng(5)
    sound = at_seven(0.5, 5)[:, :1]
    spectra = GivenSpectra(rng.uniform(0.1, 0.3, (22, 180)), LEFT_POSITIVE_RAD, SEVEN)
    whole = Listener(ovad_array(), GIVEN_HZ, spectra=spectra).push(sound)
    first, rest = (np.array_split(part, 20) for part in (sound[:70_000], sound[70_000:]))
    listener = Listener(ovad_array(), GIVEN_HZ, spectra=spectra)
    pieces = [state for block in first for state in listener.push(block)]
    other = Listener(ovad_array(), GIVEN_HZ, spectra=spectra, resume=listener.checkpoint())
    pieces += [state for block in rest for state in other.push(block)]
    # The last hop of the sound has no spectrum.
    assert len(whole) == 13 and pieces == whole
    # The usable share is not measured, so it is null.
    assert whole[-1].to_dict()["heard"] is None and not whole[-1].calibrated
    assert all(cue.alpha is None for cue in whole[-1].cues)


def test_rows_of_half_a_window_count_at_their_end():
    """A row of five hops equals the mean of five rows of one hop."""
    rng = np.random.default_rng(8)
    rows = rng.uniform(0.1, 0.3, (23, 180))
    halves = np.array([rows[max(k - 4, 0) : k + 1].mean(axis=0) for k in range(23)])
    sound = at_seven(0.5, 8)[:, :1]
    spectra = (GivenSpectra(values, LEFT_POSITIVE_RAD, SEVEN, n) for values, n in ((rows, 1), (halves, 5)))
    hops, whole = (SpectrumFrontEnd(one, GIVEN_HZ, SETTINGS).process(sound) for one in spectra)
    for one, other in zip(hops, whole, strict=True):
        np.testing.assert_allclose(one.feature, other.feature)
        np.testing.assert_allclose(one.srp, other.srp)
        # The peak is that of the newest row.
        assert (one.bearing_age_s, other.bearing_age_s) == (0.1, 0.25)
