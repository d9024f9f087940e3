"""The streaming front-end: hops, invariances, lost samples and noise."""

import gc
import tracemalloc
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plane_waves import noise_from
from threadpoolctl import threadpool_info, threadpool_limits

from worldstate.frontend.approach.looming import Looming
from worldstate.frontend.approach.tone import ToneReading
from worldstate.frontend.array import steering
from worldstate.frontend.array.microphone_array import MicrophoneArray, roof_array_56
from worldstate.frontend.array.steering import Steering, one_blas_thread
from worldstate.frontend.direction.bearing import direct_probability, srp_phat
from worldstate.frontend.direction.feature import feature_nfft
from worldstate.frontend.hop_spectra import BANDS, LevelMeter, NoiseMeter
from worldstate.frontend.settings import ELEVATIONS_RAD, FrontEndSettings
from worldstate.frontend.spectra.stft import StreamingStft, band_bins, bin_frequencies_hz
from worldstate.frontend.stream import AcousticFrame, FrontEnd
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.values import NotUsable, wrap_angle

SQUARE = MicrophoneArray([[0.1, 0.1, 0], [0.1, -0.1, 0], [-0.1, -0.1, 0], [-0.1, 0.1, 0]])
RATE = 16_000
EVERYTHING = FrontEndSettings(tone_band_hz=(20.0, 400.0))


def assert_same(ours: list[AcousticFrame], theirs: list[AcousticFrame], rtol: float = 1e-5) -> None:
    assert [f.stamp_ns for f in ours] == [f.stamp_ns for f in theirs]
    for a, b in zip(ours, theirs, strict=True):
        for name in ("srp", "feature", "band_log_energy", "bearing_rad", "bearing_std_rad", "prominence"):
            np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=rtol, err_msg=name)
        assert isinstance(a.looming, Looming) == isinstance(b.looming, Looming)
        if isinstance(a.looming, Looming) and isinstance(b.looming, Looming):
            assert a.looming.inverse_tta_hz == pytest.approx(b.looming.inverse_tta_hz, rel=rtol, abs=1e-7)
            assert a.looming.std_hz == pytest.approx(b.looming.std_hz, rel=rtol)
        assert a.tone == b.tone  # bit for bit: hops are cut before anything is computed


@pytest.mark.long
@settings(deadline=None, max_examples=15)
@given(cuts=st.lists(st.integers(0, 20_000), max_size=12), rate=st.sampled_from([8_000, 15_999.7]))
def test_block_size_does_not_matter(cuts: list[int], rate: float) -> None:
    sound = noise_from(SQUARE, 0.5, RATE, 1.25)
    sound += np.sin(2 * np.pi * 61.0 / RATE * np.arange(len(sound)), dtype=np.float32)[:, None]
    sound[14_000:14_100] = sound[:, 3] = 0.0
    whole = FrontEnd(SQUARE, rate, EVERYTHING).process(sound)
    front_end = FrontEnd(SQUARE, rate, EVERYTHING)
    blocks = np.split(sound, sorted(min(c, len(sound)) for c in cuts))
    pieces = [frame for block in blocks for frame in front_end.process(block)]
    assert_same(pieces, whole)
    reports = [
        [(f.health.faults, f.health.dropouts, f.health.coherence) for f in one] for one in (pieces, whole)
    ]
    assert reports[0] == reports[1] and whole[-1].health.n_dropouts == len(whole[-1].health.faults) == 1
    assert isinstance(whole[-1].tone, ToneReading)


def test_hops_do_not_drift_at_the_recordings_odd_rate() -> None:
    array = MicrophoneArray([[0, 0.1, 0], [0, -0.1, 0]])
    sound = np.random.default_rng(0).standard_normal((47_998 * 4, 2))
    frames = FrontEnd(array, 47_998, start_ns=5).process(sound)
    assert [f.sample_index for f in frames] == [int(k * 4799.8 + 0.5) for k in range(10, 41)]
    assert frames[10].stamp_ns == 5 + 2_000_000_000
    assert abs(frames[3].stamp_ns - 1_300_000_005) < 1e9 / 47_998


@settings(deadline=None, max_examples=10)
@given(exponent=st.floats(-3.0, 13.0), seed=st.integers(0, 1000))
def test_a_gain_changes_neither_bearing_nor_looming(exponent: float, seed: int) -> None:
    sound, gain = noise_from(SQUARE, 0.5, RATE, 1.0, seed), np.float32(10.0**exponent)
    plain, louder = (FrontEnd(SQUARE, RATE).process(s)[0] for s in (sound, sound * gain))
    assert louder.bearing_rad == pytest.approx(plain.bearing_rad, abs=1e-5)
    assert louder.looming.inverse_tta_hz == pytest.approx(plain.looming.inverse_tta_hz, abs=1e-5)
    np.testing.assert_allclose(louder.band_log_energy - plain.band_log_energy, 2 * np.log(gain), atol=1e-4)


def test_several_sources_are_several_peaks() -> None:
    array, truth_deg = MicrophoneArray(roof_array_56().positions_m[::3]), (-50.0, -5.0, 40.0)
    waves = (noise_from(array, np.radians(one), RATE, 1.2, i) for i, one in enumerate(truth_deg))
    frame = FrontEnd(array, RATE).process(np.sum(list(waves), axis=0))[-1]
    found = sorted(np.degrees(peak.azimuth_rad) for peak in frame.peaks[:3])
    np.testing.assert_allclose(found, truth_deg, atol=2.5)
    assert frame.peaks[0].azimuth_rad == frame.bearing_rad
    assert sorted(frame.peaks, key=lambda peak: -peak.value) == list(frame.peaks)


def test_band_levels_of_white_noise_and_a_tone() -> None:
    rng = np.random.default_rng(0)
    # Independent noise is unusable if channels are watched.
    chosen = FrontEndSettings(nfft=feature_nfft(RATE), watch_channels=False)
    white = FrontEnd(SQUARE, RATE, chosen).process(rng.standard_normal((RATE, 4)))[0].band_log_energy
    # The 16 bands cover bins 2..230 of 256: mean square 1 times that share.
    assert np.exp(white).sum() == pytest.approx(228 / 256, rel=0.05)
    tone = np.sin(2 * np.pi * 1000 * np.arange(RATE) / RATE)[:, None] * np.ones(4)
    levels = FrontEnd(SQUARE, RATE).process(tone)[0].band_log_energy
    assert np.exp(levels).max() == pytest.approx(0.5, rel=0.02)
    assert np.sort(levels)[-3] < np.log(1e-6)


def test_the_level_of_a_hop_is_that_of_the_frames_without_lost_samples() -> None:
    loud, quiet = (gain * np.random.default_rng(0).standard_normal((1024, 4)) for gain in (1.0, 0.1))
    both, alone = (LevelMeter(4, RATE, FrontEndSettings(nfft=512)) for _ in range(2))
    # Seven frames of 512 samples begin 256 samples apart; the last three contain no loud sample.
    heard = np.array([False] * 4 + [True] * 3)
    level = both.push(np.vstack([loud, quiet]), heard=heard)
    np.testing.assert_allclose(level, alone.push(quiet), atol=1e-6)


def test_silence_is_reported() -> None:
    frame = FrontEnd(SQUARE, RATE).process(np.zeros((RATE, 4)))[0]
    assert frame.looming == NotUsable("silence within the window")
    assert frame.prominence == 1.0
    assert frame.bearing_std_rad > 0.8
    assert not frame.srp.any()
    assert np.isfinite(frame.band_log_energy).all()


def test_a_refused_block_leaves_the_stream_as_it_was() -> None:
    sound = noise_from(SQUARE, 0.5, RATE, 1.0)
    front_end = FrontEnd(SQUARE, RATE)
    front_end.process(sound[:5000])
    broken = sound[5000:].copy()
    broken[100, 2] = np.nan
    with pytest.raises(InvalidArgumentError, match=r"channels \[2\]"):
        front_end.process(broken)
    assert_same(front_end.process(sound[5000:]), FrontEnd(SQUARE, RATE).process(sound))


@pytest.mark.long
def test_memory_does_not_grow_with_the_length_of_a_stream() -> None:
    """The limit is one float per hop and channel."""
    sound, front_end = noise_from(SQUARE, 0.5, 8_000, 20.0), FrontEnd(SQUARE, 8_000, EVERYTHING)
    sound[30_000:31_000] = sound[60_000:80_000, 3] = 0.0
    tracemalloc.start()
    used = []
    # Histories reach back at most one minute.
    for _ in range(6):
        front_end.process(sound)
        gc.collect()
        used.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    assert used[5] - used[3] < 8 * 4 * 400


def lose(sound: np.ndarray, first: int, length: int, value: float = 0.0) -> np.ndarray:
    hurt = sound.copy()
    hurt[first : first + length] = value
    return hurt


@settings(deadline=None, max_examples=15)
@given(st.integers(1, 6), st.integers(0, 1580), st.integers(32, 8000), st.sampled_from([0.0, 0.3, -1.0]))
def test_a_window_with_lost_samples_is_the_mean_over_its_other_frames(hop, offset, length, value):
    # A run needs more than 16 samples, so the offset leaves out the end of a hop.
    rate, sound, first = 16_000, noise_from(SQUARE, 0.5, 16_000, 1.3), 1600 * hop + offset
    frame = FrontEnd(SQUARE, rate).process(lose(sound, first, length, value))[2]
    last = min(first + length, round(1.2 * rate))
    assert frame.lost == pytest.approx(max(last - max(first, round(0.2 * rate)), 0) / rate, abs=1e-3)
    bins = band_bins((300.0, 1800.0), rate, 512)
    spectra = StreamingStft(4, 512, bins).push(sound)
    ends = 512 + 256 * np.arange(len(spectra))
    within = (ends > 0.2 * rate) & (ends <= 1.2 * rate) & ((ends <= first) | (ends - 512 >= first + length))
    frequencies = bin_frequencies_hz(bins, rate, 512)
    rows = [Steering.towards(SQUARE, frequencies, frame.azimuths_rad, el) for el in ELEVATIONS_RAD]
    expected = np.max([srp_phat(spectra[within], row) for row in rows], axis=0)
    np.testing.assert_allclose(frame.srp, expected, rtol=1e-5)
    heard = FrontEnd(SQUARE, rate).process(sound)[2]
    assert frame.bearing_rad == pytest.approx(0.5, abs=0.02)
    np.testing.assert_allclose(frame.band_log_energy, heard.band_log_energy, atol=1.0)


@pytest.mark.parametrize("kind", ["zeros", "a constant", "repeated"])
def test_features_recover_after_lost_samples(kind: str) -> None:
    rate, sound = 16_000, noise_from(SQUARE, 0.5, 16_000, 3.0)
    hurt = lose(sound, 20_000, 4000, {"zeros": 0.0}.get(kind, 0.2))
    if kind == "repeated":
        hurt[20_000:24_000] = sound[16_000:20_000]
    chosen = FrontEndSettings(character=True)
    ours, theirs = (FrontEnd(SQUARE, rate, chosen).process(one) for one in (hurt, sound))
    lost = [round(frame.lost * rate) for frame in ours]
    assert max(lost) == pytest.approx(4000, abs=100)
    assert lost[:3] == [0, 0, 0] and not any(lost[-5:])
    # The stated error of a bearing depends on half a minute of history.
    stated = [frame.bearing_std_rad for frame in theirs[-5:]]
    assert [frame.bearing_std_rad for frame in ours[-5:]] == pytest.approx(stated, rel=0.1)
    assert_same([replace(a, bearing_std_rad=b) for a, b in zip(ours[-5:], stated, strict=True)], theirs[-5:])
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(one.feature, other.feature, atol=0.08)
        assert one.health.faults == ()


def test_a_lost_window_is_silent_and_no_channel_fault() -> None:
    rate, sound = 16_000, noise_from(SQUARE, 0.5, 16_000, 4.0)
    frames = FrontEnd(SQUARE, rate, EVERYTHING).process(lose(sound, 20_000, 20_000))
    gone = [frame for frame in frames if frame.lost == 1.0]
    assert len(gone) == 3
    assert all(not frame.feature.any() and frame.prominence == 1.0 for frame in gone)
    assert all(np.isfinite(frame.band_log_energy).all() and frame.bearing_age_s >= 0.0 for frame in frames)
    assert frames[-1].lost == 0.0


LEVELS = st.lists(st.floats(-20.0, -5.0), min_size=BANDS, max_size=BANDS)


@settings(max_examples=30)
@given(LEVELS, st.floats(-5.0, 5.0), st.floats(0.01, 1.0), st.lists(st.floats(-0.2, 0.2), max_size=40))
def test_a_street_that_changes_slowly_is_never_masked(levels, gain, coherence, steps):
    """Up to 0.9 dB per hop and 35 dB in all, at any level, if the coherence is as usual."""
    meter, level = NoiseMeter(), np.array(levels) + gain
    for step in (0.0, *steps, *([0.2] * 10)):
        level = level + step
        assert meter.push(level, coherence) == (1.0, None)


@settings(max_examples=30)
@given(LEVELS, st.floats(2.5, 6.0), st.integers(1, 30), st.floats(-5.0, 5.0), st.booleans())
def test_a_burst_of_noise_is_masked_until_it_ends_at_any_gain(levels, nats, hops, gain, incoherent):
    meter, level = NoiseMeter(), np.array(levels) + gain
    assert {meter.push(level, 0.5) for _ in range(50)} == {(1.0, None)}
    burst = [meter.push(level + nats, 0.1 if incoherent else 0.5) for _ in range(hops)]
    # A level that holds for a fifth of the time becomes the usual level.
    assert set(burst[:10]) == {(0.0, "noise far above this place's usual")}
    assert meter.push(level + 0.5, 0.5) == (1.0, None)


def test_a_level_of_ten_seconds_becomes_the_usual_level() -> None:
    meter, level = NoiseMeter(), np.full(BANDS, -12.0)
    shares = [meter.push(level + (3.0 if hop > 100 else 0.0), 0.5)[0] for hop in range(230)]
    assert set(shares[:101]) == {1.0} and set(shares[101:200]) == {0.0} and set(shares[203:]) == {1.0}


def test_a_masked_hop_is_unusable_within_a_usable_window() -> None:
    sound = noise_from(SQUARE, 0.5, 16_000, 2.5)
    sound[17_600:20_800] += 20.0 * np.random.default_rng(1).standard_normal((3200, 4))
    heard = {one.sample_index: one.heard for one in FrontEnd(SQUARE, 16_000).process(sound)}
    assert [heard[end] for end in (19_200, 20_800)] == [0.0, 0.0]
    assert heard[17_600] == heard[40_000] == 1.0 and 0.5 < heard[24_000] < 0.9


@pytest.mark.long
@settings(deadline=None, max_examples=10)
@given(st.integers(17_600, 30_000), st.integers(3200, 9600), st.booleans())
def test_masked_hops_are_left_out_of_the_window(first: int, length: int, same: bool) -> None:
    rate, sound, rng = 16_000, noise_from(SQUARE, 0.5, 16_000, 3.5), np.random.default_rng(1)
    noise = 20.0 * rng.standard_normal((length, 1 if same else 4))
    hurt = sound.copy()
    hurt[first : first + length] += noise
    ours, theirs = (FrontEnd(SQUARE, rate).process(one) for one in (hurt, sound))
    for one, other in zip(ours, theirs, strict=True):
        begin, end = one.sample_index - 1600, one.sample_index
        if first <= begin and end <= first + length:
            assert (one.heard, one.unheard) == (0.0, "noise far above this place's usual")
        if one.heard >= 0.4:
            # The first and last hop may hold too little noise to raise the level by 10 dB.
            assert abs(one.bearing_rad - 0.5) < 0.05
            np.testing.assert_allclose(one.feature, other.feature, atol=0.3)
            assert one.band_log_energy.mean() < other.band_log_energy.mean() + 2.3
    assert ours[-1].heard == 1.0 and theirs[-1].heard == min(one.heard for one in theirs) == 1.0


@pytest.mark.parametrize("azimuth_deg", [60.0, 85.0, 90.0, 95.0])
def test_an_all_round_search_treats_all_directions_alike(azimuth_deg: float) -> None:
    """Oracle: turned by a right angle, the array is the same with its channels in another order."""
    all_round = FrontEndSettings(azimuth_span_deg=(-180.0, 180.0))
    beside = noise_from(SQUARE, np.radians(azimuth_deg), RATE, 1.0)
    behind = beside[:, [1, 2, 3, 0]]
    one, other = (FrontEnd(SQUARE, RATE, all_round).process(sound)[0] for sound in (beside, behind))
    turned = wrap_angle(other.bearing_rad - one.bearing_rad)
    assert abs(turned) == pytest.approx(np.pi / 2, abs=1e-3)
    assert abs(wrap_angle(other.bearing_rad)) > np.radians(145.0)
    assert other.bearing_std_rad == pytest.approx(one.bearing_std_rad, rel=0.02)
    assert direct_probability(other.peaks) == pytest.approx(direct_probability(one.peaks), abs=0.02)
    assert [round(p.value, 2) for p in other.peaks] == [round(p.value, 2) for p in one.peaks]


def blas_threads() -> set[int]:
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


def test_the_limit_is_lifted_at_the_end_of_the_outer_one_and_after_an_error() -> None:
    steering._controller.cache_clear()  # An earlier test may have loaded another library
    with threadpool_limits(2, user_api="blas"):
        with suppress(KeyError), one_blas_thread():
            with one_blas_thread():
                assert blas_threads() == {1}
            assert blas_threads() == {1}
            raise KeyError
        assert blas_threads() == {2}


def test_the_number_of_threads_does_not_change_a_bit() -> None:
    array = MicrophoneArray(np.random.default_rng(0).uniform(-0.3, 0.3, (24, 3)))
    sound = np.random.default_rng(1).standard_normal((16_000, 24))
    steering._controller.cache_clear()
    frames = []
    for threads in (1, 2):
        with threadpool_limits(threads, user_api="blas"):
            frames.append(FrontEnd(array, 16_000).process(sound)[0])
    np.testing.assert_array_equal(frames[0].srp, frames[1].srp)
    np.testing.assert_array_equal(frames[0].feature, frames[1].feature)


def test_mirrored_world_and_array_mirror_the_frame() -> None:
    array = roof_array_56()
    mirrored = MicrophoneArray(array.positions_m * [1.0, -1.0, 1.0])
    left = FrontEnd(array, 48_000).process(noise_from(array, 0.6, 48_000, 1.0))[0]
    right = FrontEnd(mirrored, 48_000).process(noise_from(mirrored, -0.6, 48_000, 1.0))[0]
    np.testing.assert_allclose(right.srp, left.srp[::-1], rtol=1e-4)
    assert right.bearing_rad == pytest.approx(-left.bearing_rad, abs=1e-4)
    mirrored_feature = right.feature.reshape(2, 30)[:, ::-1].ravel()
    np.testing.assert_allclose(mirrored_feature, left.feature, rtol=1e-3)
