"""Tones: exact without noise, at the bound of Rife and Boorstyn in noise; engine line of a stream."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from worldstate.frontend.approach.tone import ToneReading, ToneStage, estimate_tone
from worldstate.frontend.array.microphone_array import ChannelMask, MicrophoneArray, roof_array_56
from worldstate.frontend.bounds.cramer_rao import tone_crb_hz2
from worldstate.frontend.settings import FrontEndSettings
from worldstate.frontend.spectra.resampling import Decimator
from worldstate.frontend.stream import FrontEnd
from worldstate.ground.values import NotUsable

SAMPLES_HZ = 1000.0
SLOW = 6_000
RATE = 47_998
PAIR = MicrophoneArray([[0, 0.1, 0], [0, -0.1, 0]])
BOTH = ChannelMask.all_of(2)
SETTINGS = FrontEndSettings(tone_band_hz=(20.0, 400.0))


def line(frequency_hz: float, seconds: float, rate: float, phase: float = 0.3) -> np.ndarray:
    return np.cos(2 * np.pi * frequency_hz / rate * np.arange(round(seconds * rate)) + phase)


@settings(max_examples=60, deadline=None)
@given(
    frequency=st.floats(10.0, 490.0),
    phase=st.floats(-3.1, 3.1),
    amplitude=st.floats(1e-4, 1e4),
    n=st.integers(200, 400),
)
def test_noiseless_real_tone_is_exact(frequency, phase, amplitude, n):
    tone = estimate_tone(amplitude * line(frequency, n / SAMPLES_HZ, SAMPLES_HZ, phase), SAMPLES_HZ)
    assert tone.frequency_hz == pytest.approx(frequency, rel=1e-8)
    assert tone.amplitude == pytest.approx(amplitude, rel=1e-6)
    assert np.exp(1j * tone.phase_rad) == pytest.approx(np.exp(1j * phase), abs=1e-5)


def test_real_estimate_is_the_least_squares_optimum():
    """Near 0 Hz the periodogram of a real tone is biased; the likelihood must be maximal instead."""
    rng = np.random.default_rng(5)
    t = np.arange(128) / SAMPLES_HZ
    y = np.cos(2 * np.pi * 13.0 * t + 1.0) + 0.3 * rng.normal(size=128)

    def misfit(frequency):
        H = np.stack([np.cos(2 * np.pi * frequency * t), np.sin(2 * np.pi * frequency * t)], axis=1)
        return np.linalg.lstsq(H, y, rcond=None)[1][0]

    best = minimize_scalar(misfit, bounds=(11.0, 15.0), method="bounded", options={"xatol": 1e-9})
    assert estimate_tone(y, SAMPLES_HZ).frequency_hz == pytest.approx(best.x, abs=1e-5)


def test_the_strongest_tone_is_found_and_an_offset_is_none():
    y, other = (line(frequency, 0.5, SAMPLES_HZ) for frequency in (80.0, 200.3))
    assert estimate_tone(5 * y + other, SAMPLES_HZ).frequency_hz == pytest.approx(80, abs=0.05)
    assert estimate_tone(0.1 + y, SAMPLES_HZ).frequency_hz == pytest.approx(80, abs=0.01)


def read(sound: np.ndarray, rate: float, array: MicrophoneArray = PAIR, keep=(True, True)):
    """Return the reading after a sound at the microphones."""
    stage = ToneStage(array, rate)
    stage.push(sound.astype(np.float32), ChannelMask(np.array(keep)))
    return stage.read()


def each_hop(sound: np.ndarray) -> list[ToneReading | NotUsable]:
    """Return readings per hop if both microphones receive the same sound."""
    stage, found = ToneStage(PAIR, SLOW), []
    for hop in on_both(sound).reshape(-1, SLOW // 10, 2):
        stage.push(hop, BOTH)
        found.append(stage.read())
    return found


def on_both(sound: np.ndarray) -> np.ndarray:
    return np.stack([sound, sound], axis=1).astype(np.float32)


@pytest.mark.long
@pytest.mark.parametrize(("low_hz", "high_hz"), [(20.5, 24.0), (25.0, 390.0), (390.0, 399.0)])
@pytest.mark.parametrize("snr_db", [-6.0, 10.0, 35.0])
def test_variance_meets_the_decimated_bound(snr_db: float, low_hz: float, high_hz: float) -> None:
    """Within 1.5 dB of the bound, never below it beyond sampling error; the claimed variance is right."""
    rng, trials, eta = np.random.default_rng(int(snr_db) + int(low_hz)), 150, 10 ** (snr_db / 10)
    stage = ToneStage(PAIR, RATE)
    rate = Decimator(RATE, 400.0).rate_hz
    # White noise of a density that gives the decimated samples this eta: 1 / 2 eta per sample.
    noise = np.sqrt(0.5 / eta * RATE / rate)
    errors, claimed = [], []
    for _ in range(trials):
        frequency = rng.uniform(low_hz, high_hz)
        sound = line(frequency, 1.0, RATE, rng.uniform(-3.1, 3.1)) + noise * rng.standard_normal(RATE)
        stage.push(on_both(sound), BOTH)
        reading = stage.read()
        errors.append(reading.frequency_hz - frequency)
        claimed.append(reading.frequency_std_hz**2)
    bound = tone_crb_hz2(eta, len(stage._band_samples), rate)
    spread = 3 * np.sqrt(2 / trials)
    assert 10 * np.log10(1 - spread) < 10 * np.log10(np.mean(np.square(errors)) / bound) < 1.5
    assert abs(10 * np.log10(np.mean(claimed) / bound)) < 1.0


def test_noise_alone_is_no_tone() -> None:
    rng, stage, found = np.random.default_rng(3), ToneStage(PAIR, 4_000), 0
    for _ in range(600):
        stage.push(rng.standard_normal((4_000, 2), dtype=np.float32), BOTH)
        found += isinstance(stage.read(), ToneReading)
    assert found <= 4


@pytest.mark.parametrize("slope", [1.0, 1.5])
def test_steep_or_gusty_noise_is_no_tone(slope: float) -> None:
    """Without the comparison with neighbouring bins a quarter of the windows of f^-3 noise had a line."""
    rng, n = np.random.default_rng(7), 40 * SLOW
    white = np.fft.rfft(rng.standard_normal(n))
    steep = np.fft.irfft(white / np.maximum(np.fft.rfftfreq(n, 1 / SLOW), 5.0) ** slope, n)
    gusts = np.exp(np.interp(np.arange(n), np.arange(0, n, SLOW // 2), rng.standard_normal(80)))
    for sound in (steep / steep.std(), gusts * rng.standard_normal(n)):
        found = [isinstance(one, ToneReading) for one in each_hop(sound)]
        assert np.mean(found) <= 0.1


@pytest.mark.parametrize("wander", [0.0, 0.002, 0.01])
def test_the_stated_error_of_a_wandering_line_is_correct(wander: float) -> None:
    """The bound of a steady line is one hundredth of the error of a line that varies by 1 %."""
    rng, n = np.random.default_rng(8), 40 * SLOW
    knots = rng.standard_normal(n // (SLOW // 10) + 1)
    frequency = 83.37 * (1.0 + wander * np.interp(np.arange(n), SLOW // 10 * np.arange(len(knots)), knots))
    phase = 2 * np.pi * np.cumsum(frequency) / SLOW
    z = []
    for hop, one in enumerate(each_hop(10.0 * np.sin(phase) + rng.standard_normal(n))):
        if isinstance(one, ToneReading):
            middle = (hop + 1) * SLOW // 10 - SLOW // 2
            truth = frequency[max(middle - 47 * SLOW // 100, 0) : middle + 47 * SLOW // 100].mean()
            z.append((one.frequency_hz - truth) / one.frequency_std_hz)
    assert len(z) > 300
    assert 0.7 < np.sqrt(np.mean(np.square(z))) < 1.4


def test_a_weak_line_is_found_beside_rumble() -> None:
    """A line far weaker than low-frequency noise and an offset is found at its frequency."""
    rng = np.random.default_rng(4)
    n = 2 * RATE
    f = np.fft.rfftfreq(n, 1 / RATE)
    rumble = np.fft.irfft(np.fft.rfft(rng.standard_normal(n)) / np.maximum(f, 2.0) ** 1.5, n)
    rumble /= rumble.std()
    reading = read(on_both(rumble + 2.0 + 0.03 * line(151.7, 2.0, RATE)), RATE)
    assert abs(reading.frequency_hz - 151.7) < 4 * reading.frequency_std_hz < 0.2


def test_a_stream_has_a_tone_reading_per_hop() -> None:
    """A gliding line: the frequency is that of the middle of the window, half a second before the stamp."""
    rate, n = 16_000, 32_000
    t = np.arange(n) / rate
    glide = np.cos(2 * np.pi * (100.0 * t + 0.5 * 0.4 * t**2))
    noise = 0.05 * np.random.default_rng(0).standard_normal(n)
    frames = FrontEnd(PAIR, rate, SETTINGS).process(on_both(glide + noise))
    assert len(frames) == 11
    for frame in frames:
        middle_s = frame.sample_index / rate - 0.5
        assert frame.tone.frequency_hz == pytest.approx(100.0 + 0.4 * middle_s, abs=0.01)


@pytest.mark.parametrize("azimuth_deg", [0.0, 60.0, 90.0])
def test_a_line_is_found_from_any_direction(azimuth_deg: float) -> None:
    array, f = roof_array_56(), 380.0
    delays = array.delays_s(np.radians(azimuth_deg)).ravel()
    t = np.arange(8_000)[:, None] / 8_000
    reading = read(np.cos(2 * np.pi * f * (t - delays)), 8_000, array, [True] * 56)
    assert reading.frequency_hz == pytest.approx(f, abs=1e-4)


def test_masked_microphones_have_no_effect_on_the_tone() -> None:
    sound = on_both(line(90.0, 1.0, 8_000))
    sound[:, 1] = 1e3 * line(210.0, 1.0, 8_000)
    assert read(sound, 8_000, keep=(True, False)).frequency_hz == pytest.approx(90.0, abs=1e-3)


def test_an_unusable_tone_has_its_reason() -> None:
    assert read(on_both(line(90.0, 0.5, 8_000)), 8_000) == NotUsable("needs 0.99 s of sound")
    silent = FrontEnd(PAIR, 8_000, SETTINGS).process(np.zeros((8_000, 2)))[0]
    assert silent.tone == NotUsable("silence")
    assert isinstance(FrontEnd(PAIR, 8_000).process(np.zeros((8_000, 2)))[0].tone, NotUsable)


@pytest.mark.parametrize("scale", [1e-9, 1e14])
def test_level_does_not_matter(scale: float) -> None:
    reading = read(on_both(scale * line(90.0, 1.0, 8_000)), 8_000)
    assert reading.frequency_hz == pytest.approx(90.0, abs=1e-4)


@pytest.mark.long
@pytest.mark.parametrize("snr_db", [0.0, 10.0, 25.0])
def test_variance_of_samples_meets_the_bound(snr_db):
    """Within 1.5 dB of eq. (9) of Rife and Boorstyn, never below it beyond three standard errors."""
    rng = np.random.default_rng(int(snr_db) + 4)
    n, trials, eta = 256, 800, 10 ** (snr_db / 10)
    errors, claimed, found = [], [], []
    for _ in range(trials):
        frequency = rng.uniform(40, 460)
        wave = line(frequency, n / SAMPLES_HZ, SAMPLES_HZ, rng.uniform(-np.pi, np.pi))
        tone = estimate_tone(wave + rng.normal(size=n) * np.sqrt(1 / (2 * eta)), SAMPLES_HZ)
        errors.append(tone.frequency_hz - frequency)
        claimed.append(tone.frequency_std_hz**2)
        found.append(tone.snr)
    bound = tone_crb_hz2(eta, n, SAMPLES_HZ)
    ratio_db = 10 * np.log10(np.mean(np.square(errors)) / bound)
    assert 10 * np.log10(1 - 3 * np.sqrt(2 / trials)) < ratio_db < 1.5
    assert np.mean(claimed) == pytest.approx(bound, rel=0.05)
    assert np.median(found) == pytest.approx(eta, rel=0.05)
