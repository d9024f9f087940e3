"""Ego-noise: the generator's physics, prewhitening and its definition, learning, no harm."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.covariance import OAS
from sklearn.metrics import roc_auc_score

from worldstate.frontend.array.microphone_array import MicrophoneArray, roof_array_56
from worldstate.frontend.array.steering import Steering
from worldstate.frontend.direction.bearing import steered_power
from worldstate.frontend.direction.music import Subspace, music_spectrum
from worldstate.frontend.ego_noise import ego_noise as whitening
from worldstate.frontend.ego_noise.ego_noise import (
    EgoNoise,
    ElevationSplit,
    shrunk_inverse_root,
    white_share,
)
from worldstate.frontend.settings import FrontEndSettings
from worldstate.frontend.spectra.stft import whiten
from worldstate.frontend.stream import FrontEnd
from worldstate.ground.errors import InvalidArgumentError
from worldstate.simulation.sound.ego_sound import ENGINE_M, ego_noise

RATE, NFFT = 16_000, 256
ROOF = MicrophoneArray(roof_array_56().positions_m[::4])
LIFTED_M = np.array([0.0, 0.0, 1.7])
MOUNTED_M = ROOF.positions_m + LIFTED_M
PLAIN = FrontEndSettings(nfft=NFFT)
LEARNING = replace(PLAIN, ego_noise=True)


def noise_covariance(rng: np.random.Generator, bins: int, microphones: int) -> np.ndarray:
    roots = rng.standard_normal((bins, microphones, 2 * microphones)) + 1j * rng.standard_normal(
        (bins, microphones, 2 * microphones)
    )
    return roots @ roots.conj().transpose(0, 2, 1)


def wave(
    azimuth_rad: float, seconds: float, rng: np.random.Generator, like: np.ndarray | None = None
) -> np.ndarray:
    """A plane wave of noise in the band of SRP, unit mean square, flat or coloured like a sound, (n, M)."""
    n = round(seconds * RATE)
    frequencies = np.fft.rfftfreq(n, 1 / RATE)
    spectrum = np.fft.rfft(rng.standard_normal(n)) * ((frequencies > 300) & (frequencies < 1800))
    if like is not None:
        grid, density = scipy.signal.welch(like, RATE, nperseg=512, axis=0)
        spectrum *= np.sqrt(np.interp(frequencies, grid, density.mean(axis=1)))
    heard = np.fft.irfft(spectrum[:, None] * ROOF.steering(frequencies, azimuth_rad)[:, :, 0], n, axis=0)
    return (heard / heard.std()).astype(np.float32)


def in_band(sound: np.ndarray, rate: float = RATE) -> np.ndarray:
    sos = scipy.signal.butter(4, [300, 1800], "bandpass", fs=rate, output="sos")
    return scipy.signal.sosfilt(sos, sound, axis=0)


# The generator.


def test_the_same_seed_gives_the_same_sound_and_another_another() -> None:
    speed = np.full(4000, 8.0)
    first, again, other = (ego_noise(MOUNTED_M, speed, RATE, np.random.default_rng(s)) for s in (1, 1, 2))
    assert first.shape == (4000, len(MOUNTED_M))
    assert first.dtype == np.float32
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.1 * first.std()


def test_levels_follow_the_speed_while_driving() -> None:
    speed = np.repeat([5.0, 10.0, 20.0], RATE)
    sound = in_band(ego_noise(MOUNTED_M, speed, RATE, np.random.default_rng(3)))
    level_db = 10 * np.log10([np.square(part[2000:-2000]).mean() for part in np.split(sound, 3)])
    # Per doubling rolling noise rises by 8 to 12 dB, wind by 12, flow by 18; the engine by one or two.
    assert 3 < level_db[1] - level_db[0] < 14
    assert 6 < level_db[2] - level_db[1] < 14


def test_wind_knows_nothing_of_its_neighbour_and_the_vehicle_does(monkeypatch: pytest.MonkeyPatch) -> None:
    pair = np.array([[0, 0.03, 1.7], [0, -0.03, 1.7]])
    both = ego_noise(pair, np.full(4 * RATE, 8.0), RATE, np.random.default_rng(4))
    monkeypatch.setattr("worldstate.simulation.sound.ego_sound._add_wind", lambda *_: None)
    vehicle = ego_noise(pair, np.full(4 * RATE, 8.0), RATE, np.random.default_rng(4))
    of_wind, of_vehicle = (
        scipy.signal.coherence(*sound.T, RATE, nperseg=1024)[1][20:60] for sound in (both - vehicle, vehicle)
    )
    assert of_wind.mean() < 0.05
    assert of_vehicle.mean() > 0.8


def test_the_engine_s_sound_arrives_when_geometry_says(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only the engine, no wind, no road: two microphones, delay and level by hand."""
    monkeypatch.setattr("worldstate.simulation.sound.ego_sound._PLACES_M", ENGINE_M[None])
    monkeypatch.setattr("worldstate.simulation.sound.ego_sound._add_wind", lambda *_: None)
    monkeypatch.setattr("worldstate.simulation.sound.ego_sound.ROAD_REFLECTION", 0.0)
    monkeypatch.setattr(
        "worldstate.simulation.sound.ego_sound._levels_db", lambda *_: [np.full((8, 9), 94.0)]
    )
    monkeypatch.setattr("worldstate.simulation.sound.ego_sound._LINE_SHARES", (0.0,))
    pair = np.array([[0.0, 0.4, 1.4], [0.0, -0.1, 2.2]])
    sound = ego_noise(pair, np.full(9 * 1024, 5.0), 48_000.0, np.random.default_rng(5))
    edge = np.stack([np.full(1201, 0.4), np.linspace(-0.6, 0.6, 1201), np.full(1201, 1.35)], axis=1)
    paths = np.linalg.norm(edge - ENGINE_M, axis=1)[:, None] + np.linalg.norm(edge[:, None] - pair, axis=2)
    lengths = paths.min(axis=0)
    lag = np.argmax(np.correlate(sound[:, 1], sound[:, 0], "full")) - (len(sound) - 1)
    assert lag == pytest.approx(np.diff(lengths)[0] / 343.0 * 48_000, abs=1.0)
    levels = sound[2000:-2000].std(axis=0)
    assert levels[0] / levels[1] == pytest.approx(lengths[1] / lengths[0], rel=0.02)


def test_a_standing_car_has_an_engine_and_no_tyres() -> None:
    sound = ego_noise(MOUNTED_M, np.zeros(4 * RATE), RATE, np.random.default_rng(6))
    frequencies, density = scipy.signal.welch(sound[:, 0], RATE, nperseg=RATE)
    firing_hz = 800 / 60 * 2  # four cylinders that idle at 800 turns a minute
    lines = [density[np.abs(frequencies - h * firing_hz) < 3].max() for h in (2, 3, 4)]
    between = [density[np.abs(frequencies - (h + 0.5) * firing_hz) < 3].max() for h in (2, 3, 4)]
    assert np.median(np.array(lines) / between) > 5


@pytest.mark.parametrize(
    ("positions", "speed", "named"),
    [
        (MOUNTED_M[:, :2], np.ones(100), "positions_m"),
        (MOUNTED_M, np.ones((100, 2)), "speed_mps"),
        (MOUNTED_M, -np.ones(100), "speed_mps"),
        (MOUNTED_M, np.full(100, np.nan), "speed_mps"),
        (MOUNTED_M, np.ones(0), "one sample"),
    ],
)
def test_a_bad_drive_is_named(positions: np.ndarray, speed: np.ndarray, named: str) -> None:
    with pytest.raises(InvalidArgumentError, match=named):
        ego_noise(positions, speed, RATE, np.random.default_rng(0))


# Prewhitening.


def inverse_root(R: np.ndarray, shrinkage: float = 0.0) -> np.ndarray:
    """Inverse roots of all bins."""
    return np.stack([shrunk_inverse_root(matrix, shrinkage) for matrix in R])


@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 10_000), microphones=st.integers(2, 12), level=st.floats(1e-6, 1e6))
def test_whitened_noise_is_white_whatever_its_level(seed: int, microphones: int, level: float) -> None:
    R = level * noise_covariance(np.random.default_rng(seed), 2, microphones)
    root = inverse_root(R)
    power = np.einsum("bmm->b", R).real / microphones
    expected = np.eye(microphones) * power[:, None, None]
    np.testing.assert_allclose(root @ R @ root, expected, atol=1e-6 * level * microphones)
    np.testing.assert_allclose(root, root.conj().transpose(0, 2, 1), atol=1e-12)


@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 10_000), microphones=st.integers(3, 10))
def test_eigenvalues_are_the_generalised_ones(seed: int, microphones: int) -> None:
    """Oracle: scipy's generalised eigensolver."""
    rng = np.random.default_rng(seed)
    R, noise = noise_covariance(rng, 1, microphones), noise_covariance(rng, 1, microphones)
    noise /= np.trace(noise[0]).real / microphones
    root = inverse_root(noise)
    ours = np.linalg.eigvalsh((root @ R @ root)[0])
    np.testing.assert_allclose(ours, scipy.linalg.eigh(R[0], noise[0], eigvals_only=True), rtol=1e-7)


@settings(deadline=None, max_examples=10)
@given(level=st.floats(1e-3, 1e3), shrinkage=st.floats(0.0, 1.0))
def test_white_noise_changes_nothing(level: float, shrinkage: float) -> None:
    np.testing.assert_allclose(shrunk_inverse_root(level * np.eye(5), shrinkage), np.eye(5), atol=1e-12)


def test_a_dead_microphone_has_no_say_and_silence_changes_nothing() -> None:
    R = noise_covariance(np.random.default_rng(8), 2, 4)
    R[:, 2] = R[:, :, 2] = 0.0
    root = inverse_root(R, 0.03)
    assert not root[:, 2].any()
    assert np.einsum("bmm->bm", root).real[:, [0, 1, 3]].min() > 0
    np.testing.assert_array_equal(inverse_root(np.zeros((2, 3, 3))), np.tile(np.eye(3), (2, 1, 1)))


def test_gain_is_bounded_by_the_shrinkage() -> None:
    rank_one = np.ones((1, 6, 6))
    assert np.linalg.eigvalsh(inverse_root(rank_one, 0.04)[0]).max() == pytest.approx(1 / np.sqrt(0.04))


@settings(deadline=None, max_examples=15)
@given(seed=st.integers(0, 10_000), microphones=st.integers(4, 30), n_frames=st.integers(60, 400))
def test_the_shrinkage_knows_white_noise_from_structure(seed: int, microphones: int, n_frames: int) -> None:
    """Oracle for the real part of the formula: scikit-learn's OAS on real data."""
    rng = np.random.default_rng(seed)
    white = (
        rng.standard_normal((n_frames, microphones)) + 1j * rng.standard_normal((n_frames, microphones))
    ) / 2**0.5
    loud = white + 3.0 * rng.standard_normal((n_frames, 1)) * np.exp(1j * np.arange(microphones))
    of_white, of_loud = (white_share(x.T @ x.conj() / n_frames, n_frames) for x in (white, loud))
    assert of_white > 0.5
    assert of_loud < 0.1
    x = white.real @ np.diag(np.linspace(0.5, 2.0, microphones))
    shrinkage = OAS(assume_centered=True).fit(x).shrinkage_
    # scikit-learn leaves the small terms 2 / M out, as the published correction does.
    assert white_share(x.T @ x / n_frames, n_frames) == pytest.approx(shrinkage, rel=0.25)


def strongest(R: np.ndarray) -> Subspace:
    values, vectors = np.linalg.eigh(R)
    return Subspace(vectors[..., -1:], values[..., -1:])


def test_generalised_music_finds_the_source_under_a_louder_interferer() -> None:
    grid = np.radians(np.arange(-90.0, 91.0))
    A = ROOF.steering([700.0, 1000.0, 1300.0], grid)
    noise_at, source_at = 60, 115
    interferer = 10.0 * A[:, :, [noise_at]] @ A[:, :, [noise_at]].conj().transpose(0, 2, 1)
    noise = interferer + np.eye(ROOF.n_microphones)
    R = noise + A[:, :, [source_at]] @ A[:, :, [source_at]].conj().transpose(0, 2, 1)
    root = inverse_root(noise, 1e-3)
    plain = music_spectrum(strongest(R), A)
    whitened = root @ A / np.linalg.norm(root @ A, axis=1, keepdims=True)
    general = music_spectrum(strongest(root @ R @ root), whitened)
    assert plain.argmax() == noise_at
    assert general.argmax() == source_at


# Learning.


def run(sound: np.ndarray, chosen: FrontEndSettings, gate: float | None = None) -> list:
    front_end = FrontEnd(ROOF, RATE, chosen)
    if gate is not None:
        front_end.learn_ego_noise(gate)
    return front_end.process(sound)


def test_nothing_changes_before_something_is_learned() -> None:
    sound = wave(0.3, 1.5, np.random.default_rng(10))
    for plain, shut in zip(run(sound, PLAIN), run(sound, LEARNING, gate=0.0), strict=True):
        np.testing.assert_array_equal(plain.srp, shut.srp)
        np.testing.assert_array_equal(plain.feature, shut.feature)


@settings(deadline=None, max_examples=4)
@given(cuts=st.lists(st.integers(0, 28_000), max_size=8))
def test_block_size_does_not_matter_while_learning(cuts: list[int]) -> None:
    rng = np.random.default_rng(11)
    sound = ego_noise(MOUNTED_M, np.full(28_000, 8.0), RATE, rng) + 0.01 * wave(0.4, 1.75, rng)
    whole, pieces = FrontEnd(ROOF, RATE, LEARNING), FrontEnd(ROOF, RATE, LEARNING)
    for front_end in (whole, pieces):
        front_end.learn_ego_noise(0.9)
    frames = whole.process(sound)
    parts = [frame for block in np.split(sound, sorted(cuts)) for frame in pieces.process(block)]
    assert len(parts) == len(frames) > 5
    for a, b in zip(frames, parts, strict=True):
        np.testing.assert_array_equal(a.srp, b.srp)


def test_the_published_feature_is_left_alone() -> None:
    sound = ego_noise(MOUNTED_M, np.full(3 * RATE, 8.0), RATE, np.random.default_rng(12))
    plain, learned = run(sound, PLAIN)[-1], run(sound, LEARNING, gate=1.0)[-1]
    np.testing.assert_array_equal(plain.feature, learned.feature)
    assert np.abs(plain.srp - learned.srp).max() > 0.01


def whitener(n_microphones: int, beams: Steering) -> EgoNoise:
    # Of an array that cannot separate them all noise is taken for that of the own vehicle.
    fields = np.zeros((len(beams.weights), 2 * n_microphones**2), np.float32)
    return EgoNoise(125.0, n_microphones, [beams], ElevationSplit(fields, fields, is_separable=False))


def correlated_hops(rng: np.random.Generator, hops: int, array: MicrophoneArray = ROOF) -> np.ndarray:
    """Frames of an interferer in white noise, (hops, frames, bins, M)."""
    a = array.steering([600.0, 900.0], 0.5)[:, :, 0]
    shape = (hops, 12, 2)
    loud = 3.0 * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape))[..., None] * a
    white = rng.standard_normal((*shape, len(a.T))) + 1j * rng.standard_normal((*shape, len(a.T)))
    return (loud + white).astype(np.complex64)


@pytest.mark.parametrize("thin", [False, True])
def test_beams_are_those_of_the_definition(thin: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Oracle: the definition in double precision, its root by scipy's sqrtm."""
    array = roof_array_56() if thin else MicrophoneArray(ROOF.positions_m[:5])
    grid = np.linspace(-1.2, 1.2, 21)
    beams = Steering.towards(array, [600.0, 900.0], grid)
    assert (beams.basis is not None) == thin
    monkeypatch.setattr(whitening, "_GUARD_HOPS", 0)
    monkeypatch.setattr(whitening, "_FORGETTING_S", 1e5)
    monkeypatch.setattr(whitening, "_MIN_SHRINKAGE", 0.1)
    ego = whitener(array.n_microphones, beams)
    hops = correlated_hops(np.random.default_rng(13), 40, array)
    ego.weight = 1.0
    for hop in hops:
        heard, (steering,) = ego.process(hop)
    # Every second hop is learned; a few more let both bins see the last of them.
    ego.weight = 0.0
    for _ in range(9):
        heard, (steering,) = ego.process(hops[-1])
    learned = hops[::2].reshape(-1, 2, array.n_microphones).astype(np.complex128)
    unit = learned / np.linalg.norm(learned, axis=2, keepdims=True) * np.sqrt(array.n_microphones)
    R = np.einsum("tbi,tbj->bij", unit, unit.conj()) / len(unit)
    s = np.maximum(0.1, [white_share(matrix, len(unit)) for matrix in R])
    assert s.max() < 0.5
    A = MicrophoneArray(array.centred_m).steering([600.0, 900.0], grid)
    expected = np.zeros(len(grid))
    for b in range(2):
        root = np.linalg.inv(scipy.linalg.sqrtm((1 - s[b]) * R[b] + s[b] * np.eye(len(R[b]))))
        bent = root @ A[b]
        bent *= np.sqrt(array.n_microphones) / np.linalg.norm(bent, axis=0)
        z = hops[-1][:, b].astype(np.complex128) @ root.T
        expected += np.square(np.abs((z / np.abs(z)) @ bent.conj())).sum(axis=0)
    np.testing.assert_allclose(steered_power(heard, steering), expected, rtol=2e-3)


def test_a_shut_gate_keeps_what_is_known() -> None:
    hops = correlated_hops(np.random.default_rng(14), 200)
    ego = whitener(ROOF.n_microphones, Steering.towards(ROOF, [600.0, 900.0], [0.0, 0.5]))
    ego.weight = 1.0
    for hop in hops[:50]:
        ego.process(hop)
    ego.weight = 0.0
    for hop in hops[50:70]:
        ego.process(hop)
    before, _ = ego.process(hops[0])
    remembered = ego.learned_frames
    for hop in hops[70:]:
        ego.process(hop)
    after, _ = ego.process(hops[0])
    assert ego.learned_frames == remembered > 0
    np.testing.assert_array_equal(before, after)


def test_the_hops_before_the_gate_shuts_are_not_learned(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(whitening, "_FORGETTING_S", 1e5)
    hops = correlated_hops(np.random.default_rng(15), 30)
    ego = whitener(ROOF.n_microphones, Steering.towards(ROOF, [600.0, 900.0], [0.0, 0.5]))
    for k, hop in enumerate(hops):
        ego.weight = 1.0 if k < 20 else 0.0
        ego.process(hop)
    assert ego.learned_frames == pytest.approx(12 * ((20 - 5 + 1) // 2), rel=1e-2)


def test_an_unlikely_none_is_not_learned_at_all() -> None:
    hops = correlated_hops(np.random.default_rng(16), 20)
    ego = whitener(ROOF.n_microphones, Steering.towards(ROOF, [600.0, 900.0], [0.0, 0.5]))
    ego.weight = 0.49
    for hop in hops:
        heard, _ = ego.process(hop)
    assert ego.learned_frames == 0
    np.testing.assert_array_equal(heard, whiten(hops[-1]))


def test_old_noise_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(whitening, "_GUARD_HOPS", 0)
    monkeypatch.setattr(whitening, "_FORGETTING_S", 1.0)
    rng = np.random.default_rng(17)
    mirror = MicrophoneArray(ROOF.positions_m * [1, -1, 1])
    beams = Steering.towards(ROOF, [600.0, 900.0], [-0.5, 0.5])
    ego = whitener(ROOF.n_microphones, beams)
    ego.weight = 1.0
    for hop in correlated_hops(rng, 60):
        ego.process(hop)
    # Now the interferer stands at -0.5.
    stands_out = []
    for hop in correlated_hops(rng, 60, mirror):
        heard, (steering,) = ego.process(hop)
        power = steered_power(heard, steering)
        stands_out.append(power[0] / power[1])
    assert np.mean(stands_out[-10:]) < 0.6 * stands_out[0]


def test_it_has_to_be_asked_for() -> None:
    front_end = FrontEnd(ROOF, RATE, PLAIN)
    with pytest.raises(InvalidArgumentError, match="ego_noise"):
        front_end.learn_ego_noise(1.0)
    with pytest.raises(InvalidArgumentError, match="none_probability"):
        FrontEnd(ROOF, RATE, LEARNING).learn_ego_noise(1.2)


# What it is for.


def statistics(sound: np.ndarray, chosen: FrontEndSettings, learn_s: float) -> np.ndarray:
    """Log peak and log prominence of SRP in the seconds after learning, shape (hops, 2)."""
    front_end = FrontEnd(ROOF, RATE, chosen)
    cut = round(learn_s * RATE)
    if chosen.ego_noise:
        front_end.learn_ego_noise(1.0)
    front_end.process(sound[:cut])
    if chosen.ego_noise:
        front_end.learn_ego_noise(0.0)
    srp = np.array([frame.srp for frame in front_end.process(sound[cut:])[10:]])
    return np.log(np.stack([srp.max(axis=1), srp.max(axis=1) / np.median(srp, axis=1)], axis=1))


def auroc(positive: list[np.ndarray], negative: list[np.ndarray]) -> np.ndarray:
    """AUROC of both statistics over all windows."""
    scores = np.concatenate(positive + negative)
    labels = np.repeat([1, 0], [sum(map(len, positive)), sum(map(len, negative))])
    return np.array([roc_auc_score(labels, column) for column in scores.T])


@pytest.mark.long
@pytest.mark.slow
def test_a_plane_wave_under_ego_noise_is_found_again_and_elsewhere_no_harm_is_done() -> None:
    rng = np.random.default_rng(20)
    gains: dict[str, list[np.ndarray]] = {}
    for ego in (True, False):
        found: dict[tuple[str, bool], list[np.ndarray]] = {}
        for _ in range(4):
            speed = np.full(round(3.7 * RATE), rng.uniform(4, 12))
            for present in (True, False):
                white = rng.standard_normal((len(speed), ROOF.n_microphones)).astype(np.float32)
                noise = ego_noise(MOUNTED_M, speed, RATE, rng) if ego else white
                source = wave(rng.uniform(-0.9, 0.9), 3.7, rng, like=noise)
                source[: 2 * RATE] = 0.0
                level = in_band(noise).std() * 10 ** ((-17.0 if ego else -19.0) / 20)
                sound = (noise + present * level * source).astype(np.float32)
                for name, chosen in (("plain", PLAIN), ("learned", LEARNING)):
                    found.setdefault((name, present), []).append(statistics(sound, chosen, 2.0))
        for name in ("plain", "learned"):
            gains.setdefault(name, []).append(auroc(found[name, True], found[name, False]))
    plain, learned = np.array(gains["plain"]), np.array(gains["learned"])
    assert (learned[0] - plain[0] > 0.1).all()
    assert (learned[1] - plain[1] > -0.01).all()
    assert 0.7 < plain[1].min() < 0.999


@pytest.mark.long
def test_the_bearing_stays_where_it_was_without_ego_noise() -> None:
    rng = np.random.default_rng(21)
    errors: dict[str, list[float]] = {"plain": [], "learned": []}
    for azimuth in np.radians([-50.0, -20.0, 5.0, 40.0]):
        quiet = rng.standard_normal((5 * RATE, ROOF.n_microphones)).astype(np.float32)
        sound = quiet.copy()
        sound[3 * RATE :] += wave(azimuth, 2.0, rng)
        for name, chosen in (("plain", PLAIN), ("learned", LEARNING)):
            front_end = FrontEnd(ROOF, RATE, chosen)
            if chosen.ego_noise:
                front_end.learn_ego_noise(1.0)
            front_end.process(sound[: 3 * RATE])
            if chosen.ego_noise:
                front_end.learn_ego_noise(0.0)
            errors[name] += [f.bearing_rad - azimuth for f in front_end.process(sound[3 * RATE :])[3:]]
    rms = {name: float(np.degrees(np.sqrt(np.mean(np.square(error))))) for name, error in errors.items()}
    assert rms["plain"] < 1.0
    assert rms["learned"] < rms["plain"] + 0.1
