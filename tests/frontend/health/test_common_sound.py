"""Independent noise and sound that contradicts the positions are unusable from the first second on."""

import json
import os
from collections.abc import Iterable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plane_waves import SPECTRA, array_check, plane_wave, shaped

from worldstate.adapters.acoustic import AcousticAdapter, heard_of
from worldstate.adapters.audio.sound_file import open_sound
from worldstate.adapters.files.array_file import named_arrays
from worldstate.adapters.listener import Listener, Step
from worldstate.adapters.source import ListenSettings
from worldstate.frontend.array.microphone_array import MicrophoneArray, ovad_array, roof_array_56
from worldstate.frontend.health.common_sound import (
    ARRAY_FAULTS,
    NOTHING_IN_COMMON,
    OUT_OF_PLACE,
    CommonSound,
    FarField,
)
from worldstate.frontend.hop_spectra import BANDS, NoiseMeter
from worldstate.frontend.settings import FrontEndSettings
from worldstate.frontend.stream import AcousticFrame, FrontEnd
from worldstate.ground import LEAST_HEARD
from worldstate.operations.recordings.channel_report import HealthLog
from worldstate.simulation import SITES, draw_settings, simulate_recording, site
from worldstate.simulation.stream.settings import StreamSettings, traffic_named
from worldstate.simulation.stream.writing import draw_stream

RATE, LOW = 16_000, 6000
REAL = Path(os.environ.get("FOUR_MICROPHONES", Path(__file__).parents[4] / "shared" / "four-microphones"))
# The positions are not documented; an upright square of 6.5 cm diagonal nearly fits its sound.
BOARD = [[0.0, 0.0137, -0.0293], [0.0, -0.0293, -0.0137], [0.0, -0.0137, 0.0293], [0.0, 0.0293, 0.0137]]
ROOF = roof_array_56().positions_m
ARRAYS = {
    "4 of the roof": ROOF[[0, 20, 30, 42]],
    "7 of the roof": ROOF[::8][:7],
    "8 of the roof": ROOF[3::7][:8],
    "16 of the roof": ROOF[::3][:16],
    "the roof": ROOF,
    "two, 0.1 m": np.array([[0.0, 0.05, 0.0], [0.0, -0.05, 0.0]]),
    **{name: np.array(board["positions_m"]) for name, board in named_arrays().items()},
}


def street(array: MicrophoneArray, spectrum: str, noise_db: float, seed: int = 0) -> np.ndarray:
    """Return a wave from the left in noise of the same spectrum, independent between the microphones."""
    rng = np.random.default_rng(seed)
    wave = plane_wave(array, rng.standard_normal(2 * RATE), 0.7, RATE)
    noise = shaped(rng.standard_normal((2 * RATE, array.n_microphones)), spectrum, RATE)
    sound = shaped(wave, spectrum, RATE) + 10.0 ** (noise_db / 20.0) * noise
    return np.asarray(0.01 * sound, np.float32)


def frames_of(array: MicrophoneArray, sound: np.ndarray) -> list[AcousticFrame]:
    return FrontEnd(array, RATE, FrontEndSettings.heard_at(RATE)).process(sound)


@pytest.mark.parametrize("spectrum", SPECTRA)
@pytest.mark.parametrize("name", ARRAYS)
def test_independent_noise_is_unusable(name: str, spectrum: str) -> None:
    array = MicrophoneArray(ARRAYS[name])
    for noise_db in (10.0, 20.0, 30.0):
        frames = frames_of(array, street(array, spectrum, noise_db))
        assert max(heard_of(frame).share for frame in frames) < 0.2
        assert {frame.unheard for frame in frames} == {NOTHING_IN_COMMON}
    assert all(frame.heard == 1.0 for frame in frames_of(array, street(array, spectrum, -6.0)))


def test_a_wide_pair_makes_no_decision_about_common_sound() -> None:
    pair = MicrophoneArray([[0.0, 0.34, 0.0], [0.0, -0.34, 0.0]])
    assert all(frame.unheard is None for frame in frames_of(pair, street(pair, "white", 30.0)))


def test_noise_makes_the_sensor_impaired_and_the_recording_unhealthy() -> None:
    array, log = roof_array_56(), HealthLog()
    noise = np.random.default_rng(0).standard_normal((2 * RATE, 56)).astype(np.float32)
    adapter = AcousticAdapter(array, RATE, Unasked(), front_end_settings=FrontEndSettings.heard_at(RATE))
    for measured in adapter.measure(noise):
        assert (measured.fault, measured.heard.usable) == (NOTHING_IN_COMMON, False)
        log.add(adapter.last_frame)
    assert log.summary().unheard == NOTHING_IN_COMMON and not log.summary().is_healthy


class Unasked:
    """A model that must not be called for unusable sound."""

    def evidence(self, feature: np.ndarray) -> object:
        raise AssertionError("asked of noise")


@settings(max_examples=30)
@given(st.integers(0, 40), st.floats(-3.0, 6.0), st.sampled_from([NOTHING_IN_COMMON, OUT_OF_PLACE]))
def test_the_usual_level_is_not_learned_from_unusable_sound(hops: int, nats: float, reason: str) -> None:
    one, other, quiet = NoiseMeter(), NoiseMeter(), np.full(BANDS, -12.0)
    for _ in range(hops):
        assert one.push(quiet + nats, 0.0, (0.0, reason)) == (0.0, reason)
    for hop in range(30):
        level = quiet + 0.01 * hop
        assert one.push(level, 0.5) == other.push(level, 0.5)
    assert one.excess_db == other.excess_db


BINS_HZ = np.arange(100.0, 1500.0, 200.0)


def far_field(positions_m: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Coherence (K, M, M) of some waves from anywhere, over noise of a quarter of their power."""
    directions = rng.standard_normal((3, rng.integers(1, 6)))
    delays = positions_m @ (directions / np.linalg.norm(directions, axis=0)) / 343.0
    levels = np.sqrt(rng.dirichlet(np.ones(delays.shape[1])))
    waves = levels * np.exp(-2j * np.pi * BINS_HZ[:, None, None] * delays)
    return 0.8 * waves @ waves.conj().swapaxes(1, 2)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(6, 9), st.floats(0.1, 0.6))
def test_waves_fit_the_positions_and_no_other_order(seed: int, n: int, extent_m: float) -> None:
    """Most other orders of an irregular array exceed 0.4: a larger misfit is a vote against an order.

    Of 400 random arrays and waves the smallest median was 0.55; a search found 0.42 (seed 229325, n = 6).
    """
    rng = np.random.default_rng(seed)
    positions = extent_m * rng.uniform(-0.5, 0.5, (n, 3))
    check, coherence = FarField(positions, BINS_HZ), np.asarray(far_field(positions, rng), np.complex64)
    fits = check.misfit(coherence, 0.005)
    orders = [rng.permutation(n) for _ in range(20)]
    others = [check.misfit(coherence[:, one][:, :, one], 0.005) for one in orders]
    known = [one for one in others if one is not None]
    # Waves much longer than the array show little of its order.
    assert len(known) > 10 or extent_m < 0.2
    assert fits is None or fits < 0.1
    assert len(known) < 10 or np.median(known) > 0.4


@pytest.mark.filterwarnings("error")
@settings(max_examples=10, deadline=None)
@given(st.integers(1, 9000), st.integers(3, 6))
def test_common_sound_recovers_after_a_loss_of_any_length(lost: int, n: int) -> None:
    rng = np.random.default_rng(lost)
    positions = rng.uniform(-0.2, 0.2, (n, 3))
    common, keep = CommonSound(MicrophoneArray(positions), BINS_HZ), np.ones(n, bool)
    heard, nothing = 18.0 * far_field(positions, rng), np.zeros((len(BINS_HZ), n, n), complex)
    heard[:, range(n), range(n)] = 18.0
    for matrices, frames in [(heard, 18)] * 20 + [(nothing, 0)] * lost + [(heard, 18)] * 20:
        share, reason = common.push(np.asarray(matrices, np.complex64), frames, keep)
        assert 0.0 <= share <= 1.0
    assert (share, reason) == (1.0, None)


CROSSED = {
    "random order": lambda x, rng: x[:, rng.permutation(x.shape[1])],
    "even ones first": lambda x, rng: np.concatenate([x[:, ::2], x[:, 1::2]], axis=1),
    "half of them 30 ms late": lambda x, rng: np.concatenate([x[180:, ::2], x[:-180, 1::2]], axis=1),
    "each later, up to 1 s": lambda x, rng: np.array([np.roll(c, rng.integers(60, 6000)) for c in x.T]).T,
    "every other inverted": lambda x, rng: x * np.where(np.arange(x.shape[1]) % 2, -1.0, 1.0),
    "a sample of one channel lost": lambda x, rng: x.reshape(-1)[1 : 1 - x.shape[1]].reshape(-1, x.shape[1]),
}
SPREAD = {
    "uma-8": ARRAYS["uma-8"],
    "12 anywhere": np.random.default_rng(3).uniform(-0.4, 0.4, (12, 3)) * [0.7, 1.0, 0.3],
    "7 anywhere": np.random.default_rng(4).uniform(-0.1, 0.1, (7, 3)),
}


@pytest.fixture(scope="module", params=["SA1", "TB2"])
def streets(request: pytest.FixtureRequest) -> dict[str, np.ndarray]:
    """Return some seconds of busy streets of each renderer at each array."""
    chosen = StreamSettings(site(request.param), 0.11, 5, traffic_named("pairs"), sample_rate_hz=float(LOW))
    shifted = [one - one.mean(axis=0) + [0.013 * i, 0.0, 0.0] for i, one in enumerate(SPREAD.values())]
    stream = draw_stream(chosen, MicrophoneArray(np.concatenate(shifted)))
    with closing(stream.blocks()) as blocks:
        sound = np.concatenate([stream.recorded(block) for block in blocks])
    ends = np.cumsum([len(places) for places in SPREAD.values()])[:-1]
    return dict(zip(SPREAD, np.split(sound, ends, axis=1), strict=True))


@pytest.mark.parametrize("kind", CROSSED)
def test_sound_of_wrong_channels_is_unusable(kind: str, streets: dict[str, np.ndarray]) -> None:
    rng = np.random.default_rng(1)
    for name, sound in streets.items():
        array, wrong = MicrophoneArray(SPREAD[name]), CROSSED[kind](np.ascontiguousarray(sound), rng)
        front_ends = [FrontEnd(array, LOW, FrontEndSettings.heard_at(LOW)) for _ in range(2)]
        right, crossed = (one.process(x) for one, x in zip(front_ends, (sound, wrong), strict=True))
        assert all(frame.heard == 1.0 for frame in right)
        unheard = [frame.heard == 0.0 and frame.unheard in ARRAY_FAULTS for frame in crossed[10:]]
        assert np.mean(unheard) > 0.9, name


@pytest.mark.parametrize("kind", ["random order", "each later, up to 1 s", "every other inverted"])
def test_array_check_exits_with_1_and_the_reason(kind, streets, tmp_path, capsys):
    array, sound = MicrophoneArray(SPREAD["uma-8"]), np.ascontiguousarray(streets["uma-8"])
    wrong = CROSSED[kind](sound, np.random.default_rng(1))
    assert array_check(tmp_path, array, wrong, LOW, "--json") == 1
    assert json.loads(capsys.readouterr().out)["unheard"] in ARRAY_FAULTS
    assert array_check(tmp_path, array, wrong, LOW) == 1
    assert capsys.readouterr().out.splitlines()[-1].startswith("not healthy: ")


def drawn_array(rng: np.random.Generator) -> MicrophoneArray:
    """OVAD's 56, some of them, a board, or 4 to 16 anywhere."""
    roof, kind = ovad_array().positions_m, rng.integers(4)
    if kind == 0:
        return ovad_array()
    if kind == 1:
        return MicrophoneArray(roof[np.sort(rng.choice(56, rng.integers(4, 57), replace=False))])
    if kind == 2:
        return MicrophoneArray(named_arrays()[str(rng.choice(list(named_arrays())))]["positions_m"])
    extent_m = rng.uniform(0.1, 1.0) * np.array([0.6, 1.0, 0.3])
    return MicrophoneArray(rng.uniform(-0.5, 0.5, (rng.integers(4, 17), 3)) * extent_m)


def steps(array: MicrophoneArray, sound: np.ndarray) -> list[Step]:
    own = array.n_microphones == 56 and np.allclose(array.positions_m, ovad_array().positions_m)
    listener = Listener(array, LOW, settings=ListenSettings(uncalibrated=not own))
    return list(listener.steps(sound.astype(np.float32)))


def announced(some: list[Step]) -> bool:
    return any(cue.advisory is not None for one in some for cue in one.state.cues)


def is_unheard_or_announced(seed: int) -> bool:
    """Whether a hidden vehicle in noise is unheard at a risk that does not fall, or as without the noise."""
    rng = np.random.default_rng(seed)
    array, spectrum = drawn_array(rng), str(rng.choice(list(SPECTRA)))
    noise_db = rng.uniform(10.0, 30.0)
    drawn = draw_settings(str(rng.choice(SITES)), str(rng.choice(["left", "right"])), rng)
    place = site(f"T{rng.choice(['A', 'B'])}{rng.integers(1, 50)}") if rng.random() < 0.4 else drawn.site
    hidden = replace(drawn, sample_rate_hz=LOW, site=place)
    same = int(rng.integers(2**31))
    with_it, without = (
        simulate_recording(one, np.random.default_rng(same), array)
        for one in (hidden, replace(hidden, approach="none"))
    )
    end = round(with_it.t0_frame / 10 * LOW)
    level = (with_it.audio - without.audio)[end - round(3 * LOW) : end].std() * 10.0 ** (noise_db / 20.0)
    noise = shaped(rng.standard_normal((end, array.n_microphones)), spectrum, LOW)
    noisy = steps(array, with_it.audio[:end] + level * noise)
    if all(one.measurement.heard.share < LEAST_HEARD for one in noisy):
        risks = [max(cue.risk for cue in one.state.cues) for one in noisy]
        return min(risks) >= risks[0] - 1e-3
    return announced(noisy) == announced(steps(array, with_it.audio[:end]))


@pytest.mark.parametrize(
    ("seeds", "most"), [((5002, 5004), 0), pytest.param(range(6000, 6100), 11, marks=pytest.mark.slow)]
)
def test_a_vehicle_in_noise_is_unheard_or_announced(seeds: Iterable[int], most: int) -> None:
    """Of 100 draws 95 passed when this was measured; 11 failures are the upper end of the interval.

    In four of them wind covers only the low frequencies, as in a windy street without any fault. In the
    fifth the sound was usable for one hop.
    """
    assert sum(not is_unheard_or_announced(seed) for seed in seeds) <= most


@pytest.mark.long
@pytest.mark.skipif(not REAL.is_dir(), reason=f"no recordings in {REAL}")
def test_real_streets_are_usable() -> None:
    """At most 1 % of hops of real streets with four microphones have no common sound."""
    array, unheard = MicrophoneArray(BOARD), []
    for path in sorted(REAL.glob("*.flac"))[::6]:
        with open_sound(path, 4) as audio:
            rate = audio.sample_rate_hz
            front_end = FrontEnd(array, rate, FrontEndSettings.heard_at(rate))
            frames = [frame for block in audio.blocks(rate) for frame in front_end.process(block)]
        unheard += [frame.unheard == NOTHING_IN_COMMON for frame in frames]
    assert len(unheard) > 300 and np.mean(unheard) <= 0.01
