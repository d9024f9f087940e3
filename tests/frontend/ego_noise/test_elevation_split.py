"""What is learned is used as far as it comes from below: physics, no harm in a street, noise at one level."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.metrics import roc_auc_score

from worldstate.frontend.array.microphone_array import MicrophoneArray, roof_array_56
from worldstate.frontend.ego_noise.ego_noise import ElevationSplit, GuardDelay, share_of
from worldstate.frontend.settings import FrontEndSettings
from worldstate.frontend.stream import FrontEnd
from worldstate.simulation.sound.ego_sound import ego_noise

RATE = 16_000
WHOLE = roof_array_56()
THIN = MicrophoneArray(WHOLE.positions_m[::4])
BINS_HZ = np.arange(312.5, 1800.0, 125.0)
JUDGES = {array.n_microphones: ElevationSplit.of(array, BINS_HZ) for array in (WHOLE, THIN)}
PLAIN = FrontEndSettings(nfft=256)
LEARNING = replace(PLAIN, ego_noise=True)


def plane_wave(
    array: MicrophoneArray, azimuth_rad: float, elevation_rad: float, n: int, seed: int
) -> np.ndarray:
    """Noise of unit mean square between 300 and 1800 Hz, (n, M)."""
    frequencies = np.fft.rfftfreq(n, 1 / RATE)
    band = (frequencies > 300) & (frequencies < 1800)
    spectrum = np.zeros((len(frequencies), array.n_microphones), complex)
    steering = array.steering(frequencies[band], azimuth_rad, elevation_rad)[:, :, 0]
    spectrum[band] = np.fft.rfft(np.random.default_rng(seed).standard_normal(n))[band, None] * steering
    heard = np.fft.irfft(spectrum, n, axis=0)
    return np.asarray(heard / heard.std())


def street(array: MicrophoneArray, n: int, seed: int) -> np.ndarray:
    """A dozen waves from about the horizon and white noise 10 dB below them, (n, M)."""
    rng = np.random.default_rng(seed)
    waves = [
        plane_wave(array, rng.uniform(-np.pi, np.pi), abs(rng.normal(0, 0.2)), n, seed * 100 + k)
        for k in range(12)
    ]
    white = rng.standard_normal((n, array.n_microphones))
    return np.asarray(np.sum(waves, axis=0) / 12**0.5 + 0.3 * white, np.float32)


def drive(array: MicrophoneArray, speed_mps: float, n: int, seed: int) -> np.ndarray:
    mounted = array.centred_m + np.array([0.0, 0.0, 1.7])
    return ego_noise(mounted, np.full(n, speed_mps), RATE, np.random.default_rng(seed))


def srp_of(array: MicrophoneArray, sound: np.ndarray, chosen: FrontEndSettings, learn_s: float) -> np.ndarray:
    """SRP of every hop, (hops, A); the gate is open up to a time."""
    front_end = FrontEnd(array, RATE, chosen)
    cut, frames = round(learn_s * RATE), []
    for weight, part in ((1.0, sound[:cut]), (0.0, sound[cut:])):
        if chosen.ego_noise:
            front_end.learn_ego_noise(weight)
        frames += front_end.process(part)
    return np.array([frame.srp for frame in frames])


@settings(deadline=None, max_examples=30)
@given(
    azimuth=st.floats(-np.pi, np.pi),
    below=st.floats(np.radians(30), np.radians(60)),
    above=st.floats(0.0, np.radians(30)),
    white=st.floats(0.0, 10.0),
    thin=st.booleans(),
)
def test_elevation_decides_and_white_noise_has_no_say(
    azimuth: float, below: float, above: float, white: float, thin: bool
) -> None:
    array = THIN if thin else WHOLE
    judge = JUDGES[array.n_microphones]
    shares = []
    for elevation in (-below, above):
        a = array.steering(BINS_HZ, azimuth, elevation)
        R = a @ a.conj().transpose(0, 2, 1) + white * np.eye(array.n_microphones)
        shares.append(share_of(*judge.powers(R.astype(np.complex64))))
    assert shares[0] > 0.6
    assert shares[1] < 0.3


@settings(deadline=None, max_examples=20)
@given(mixed=st.floats(0.1, 0.85), azimuth=st.floats(-1.5, 1.5))
def test_the_share_grows_with_what_comes_from_below(mixed: float, azimuth: float) -> None:
    judge = JUDGES[56]
    low, high = (WHOLE.steering(BINS_HZ, azimuth, el) for el in (-0.7, 0.1))
    R_low, R_high = (a @ a.conj().transpose(0, 2, 1) for a in (low, high))
    less, more = (
        share_of(*judge.powers((p * R_low + (1 - p) * R_high).astype(np.complex64)))
        for p in (mixed, mixed + 0.05)
    )
    assert less < more
    assert share_of(*judge.powers(np.zeros((len(BINS_HZ), 56, 56), np.complex64))) == 0.0


def test_a_level_line_cannot_tell_and_trusts_its_caller() -> None:
    line = MicrophoneArray(np.linspace(-0.4, 0.4, 9)[:, None] * [0.0, 1.0, 0.0])
    judge = ElevationSplit.of(line, BINS_HZ)
    assert JUDGES[56].is_separable
    assert JUDGES[14].is_separable
    assert not judge.is_separable
    assert share_of(*judge.powers(np.ones((len(BINS_HZ), 9, 9), np.complex64))) == 1.0


@pytest.mark.long
@pytest.mark.parametrize("array", [WHOLE, THIN], ids=["56", "14"])
def test_a_street_that_is_learned_changes_nothing(array: MicrophoneArray) -> None:
    """The gate stays open throughout, a source from the horizon included: bit for bit what it was."""
    sound = street(array, 3 * RATE, 160)
    sound[2 * RATE :] += plane_wave(array, 0.4, 0.0, RATE, 161).astype(np.float32)
    plain, learned = (srp_of(array, sound, chosen, 3.0) for chosen in (PLAIN, LEARNING))
    np.testing.assert_array_equal(plain, learned)


def test_a_vehicle_that_sets_off_is_whitened_within_seconds() -> None:
    """It stood in the street for as long, learning all the time."""
    sound = np.concatenate([0.1 * street(THIN, 3 * RATE, 162), drive(THIN, 6.0, 5 * RATE, 163)])
    plain, learned = (srp_of(THIN, sound, chosen, 8.0) for chosen in (PLAIN, LEARNING))
    np.testing.assert_array_equal(plain[:20], learned[:20])
    last = (srp[-10:].max(axis=1) / np.median(srp[-10:], axis=1) for srp in (plain, learned))
    before, after = (float(np.median(ratio)) for ratio in last)
    assert before > 1.25
    assert after < 1.1


def test_noise_reads_the_same_at_every_speed() -> None:
    levels = {}
    for name, chosen in (("plain", PLAIN), ("learned", LEARNING)):
        levels[name] = [
            np.log(srp_of(THIN, drive(THIN, speed, 3 * RATE, 164), chosen, 3.0)[-3:].max(axis=1)).mean()
            for speed in (2.0, 14.0)
        ]
    assert np.ptp(levels["plain"]) > 0.3
    assert np.ptp(levels["learned"]) < 0.15
    # The highest of two rows of elevation lies a little above the mean.
    assert levels["learned"][0] == pytest.approx(np.log(1 / 14), abs=0.2)


def in_band(sound: np.ndarray) -> np.ndarray:
    frequencies = np.fft.rfftfreq(len(sound), 1 / RATE)
    band = (frequencies > 300) & (frequencies < 1800)
    return np.asarray(np.fft.irfft(np.fft.rfft(sound, axis=0) * band[:, None], len(sound), axis=0))


@pytest.mark.long
def test_a_source_where_the_noise_was_loudest_is_still_found() -> None:
    """Within five degrees of the azimuth where beams at the horizon hear the own noise, 11 dB below it."""
    scores: dict[tuple[str, bool], list[np.ndarray]] = {}
    rng = np.random.default_rng(165)
    for seed in range(170, 174):
        n = round(3.25 * RATE)
        noise = drive(THIN, rng.uniform(3, 9), n, seed)
        loudest = np.radians(np.arange(-90, 91))[srp_of(THIN, noise, PLAIN, 0.0)[-1].argmax()]
        source = plane_wave(THIN, loudest + rng.uniform(-0.09, 0.09), 0.0, n, seed + 10)
        source = np.cumsum(source, axis=0)  # falls by 6 dB per octave, as the noise does
        source = in_band(source) * 10 ** (-11 / 20) * in_band(noise).std() / in_band(source).std()
        source[: 9 * RATE // 4] = 0.0
        for present, heard in ((True, noise + source.astype(np.float32)), (False, noise)):
            for name, chosen in (("plain", PLAIN), ("learned", LEARNING)):
                srp = srp_of(THIN, heard, chosen, 2.25)[-3:]
                row = np.log([srp.max(axis=1), srp.max(axis=1) / np.median(srp, axis=1)])
                scores.setdefault((name, present), []).append(row.T)
    found = {}
    for name in ("plain", "learned"):
        here, gone = (np.concatenate(scores[name, present]) for present in (True, False))
        labels = np.repeat([1, 0], [len(here), len(gone)])
        found[name] = np.array([roc_auc_score(labels, c) for c in np.concatenate([here, gone]).T])
    assert (found["learned"] > 0.95).all(), found
    assert (found["learned"] - found["plain"] > -0.01).all(), found


@settings(deadline=None)
@given(weights=st.lists(st.floats(0, 1), max_size=30), hops=st.integers(0, 6))
def test_a_guard_gives_everything_back_in_order_with_the_least_weight_since(
    weights: list[float], hops: int
) -> None:
    guard: GuardDelay[int] = GuardDelay(hops)
    out = [guard.push(k, weight) for k, weight in enumerate(weights)]
    assert out[:hops] == [None] * min(hops, len(weights))
    assert out[hops:] == [(k, min(weights[k : k + hops + 1])) for k in range(len(weights) - hops)]
