"""A vehicle in independent noise: the sound is unusable, or the vehicle is announced as without noise."""

from dataclasses import replace

import numpy as np
import pytest
from plane_waves import SPECTRA, shaped

from worldstate.adapters.files.array_file import named_arrays
from worldstate.adapters.listener import Listener, Step
from worldstate.adapters.source import ListenSettings
from worldstate.frontend.array.microphone_array import MicrophoneArray, ovad_array
from worldstate.ground import LEAST_HEARD
from worldstate.simulation import SITES, draw_settings, simulate_recording, site

RATE = 6000.0
UNHEARD, AS_WITHOUT = "unheard", "as without the noise"


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
    listener = Listener(array, RATE, settings=ListenSettings(uncalibrated=not own))
    return list(listener.steps(sound.astype(np.float32)))


def risk(step: Step) -> float:
    return max(cue.risk for cue in step.state.cues)


def announced(some: list[Step]) -> bool:
    return any(cue.advisory is not None for one in some for cue in one.state.cues)


def verdict(seed: int) -> tuple[str, str]:
    """Return the spectrum of one draw and its result: unheard, as without the noise, or a failure.

    Unheard also requires that the risk does not fall below that of the first hop.
    """
    rng = np.random.default_rng(seed)
    array, spectrum = drawn_array(rng), str(rng.choice(list(SPECTRA)))
    noise_db = rng.uniform(10.0, 30.0)
    drawn = draw_settings(str(rng.choice(SITES)), str(rng.choice(["left", "right"])), rng)
    street = site(f"T{rng.choice(['A', 'B'])}{rng.integers(1, 50)}") if rng.random() < 0.4 else drawn.site
    hidden = replace(drawn, sample_rate_hz=RATE, site=street)
    same = int(rng.integers(2**31))
    with_it, without = (
        simulate_recording(one, np.random.default_rng(same), array)
        for one in (hidden, replace(hidden, approach="none"))
    )
    end = round(with_it.t0_frame / 10 * RATE)
    level = (with_it.audio - without.audio)[end - round(3 * RATE) : end].std() * 10.0 ** (noise_db / 20.0)
    noise = shaped(rng.standard_normal((end, array.n_microphones)), spectrum, RATE)
    noisy = steps(array, with_it.audio[:end] + level * noise)
    if all(one.measurement.heard.share < LEAST_HEARD for one in noisy):
        return spectrum, UNHEARD if min(map(risk, noisy)) >= risk(noisy[0]) - 1e-3 else "the risk falls"
    if announced(noisy) == announced(steps(array, with_it.audio[:end])):
        return spectrum, AS_WITHOUT
    return spectrum, f"heard, not announced: {array.n_microphones} microphones, {noise_db:.0f} dB"


@pytest.mark.parametrize("seed", [5002, 5004])
def test_a_vehicle_in_noise_is_unheard_or_announced(seed: int) -> None:
    assert verdict(seed)[1] in (UNHEARD, AS_WITHOUT)


@pytest.mark.slow
def test_at_most_eleven_of_a_hundred_draws_fail() -> None:
    """Five of 100 draws failed when this was measured; eleven is the upper end of the interval.

    In four of them wind covers only the low frequencies, as in a windy street without any fault. In the
    fifth the sound was usable for one hop.
    """
    first = int(np.random.SeedSequence().generate_state(1)[0])
    found = [verdict(first + i) for i in range(100)]
    failed = [one for one in found if one[1] not in (UNHEARD, AS_WITHOUT)]
    print(f"from seed {first}: {100 - len(failed)} of 100", failed)
    assert len(failed) <= 11
