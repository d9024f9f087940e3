"""Pushed sound gives the states of `run` for any blocks, and continues from a checkpoint at any sample."""

from pathlib import Path

import numpy as np
import pytest
from camera_boxes import boxed
from hypothesis import given, settings
from hypothesis import strategies as st
from made_up_sound import THREE, model_of

from worldstate import Listener, ListenSettings, MicrophoneArray, Odometry, PinholeCamera
from worldstate.adapters.files.checkpoint_file import Checkpoint, read_checkpoint, save_checkpoint
from worldstate.ground import InvalidArgumentError, nanoseconds
from worldstate.ground.typing import Float32Array

RATE_HZ = 16_000
RNG = np.random.default_rng(5)
SOUND = (0.1 * RNG.standard_normal((3 * RATE_HZ, 3)).cumsum(axis=1)).astype(np.float32)
MODEL = model_of(THREE)
CAR, TRUCK = (boxed((300, 200, 380, 260), label=label) for label in ("car", "truck"))


def pushed(listener: Listener, start: int, end: int) -> list[str]:
    """Push samples and their images; the image at 0.5 s shows a truck, and the last samples end the sound."""
    for number in range(30):
        if start <= number * RATE_HZ // 10 < end:
            listener.look(nanoseconds(number / 10), TRUCK if number == 5 else CAR)
    blocks = [SOUND[start:end], None] if end == len(SOUND) else [SOUND[start:end]]
    return [state.to_json() for block in blocks for state in listener.push(block)]


@pytest.fixture(scope="module")
def in_one() -> list[str]:
    listener = Listener(THREE, RATE_HZ, model=MODEL, camera=PinholeCamera.ovad())
    return pushed(listener, 0, len(SOUND))


@pytest.mark.long
@settings(max_examples=8)
@given(cut=st.integers(0, len(SOUND) - 1))
def test_another_listener_continues_at_any_sample_bit_for_bit(cut, in_one) -> None:
    first = Listener(THREE, RATE_HZ, model=MODEL, camera=PinholeCamera.ovad())
    states = pushed(first, 0, cut)
    kept = first.checkpoint()
    first.push(SOUND[cut:])  # The checkpoint must not change
    for _ in range(2):  # Two listeners continue from it
        second = Listener(THREE, RATE_HZ, model=MODEL, camera=PinholeCamera.ovad(), resume=kept)
        assert states + pushed(second, cut, len(SOUND)) == in_one


def test_a_skipped_loss_keeps_the_time_and_is_reported() -> None:
    silence = np.zeros((round(0.9 * RATE_HZ), 3), np.float32)
    listener = Listener(THREE, RATE_HZ, model=MODEL)
    listener.push(np.concatenate([SOUND, silence]))
    listener.skip(4 * 10**9)
    told = {one.stamp_ns: one.heard[0] for one in listener.push(SOUND)}
    # The last hop of the silence stays in the resampler.
    assert list(told) == [nanoseconds(7.9 + 0.1 * hop) for hop in range(30)]
    lost_s = [stamp_ns / 1e9 for stamp_ns, heard in told.items() if heard.reason == "lost samples"]
    # The loss affects one window of one second.
    assert 0.8 <= max(lost_s) - min(told) / 1e9 <= 1.0
    assert list(told.values())[-1].share == 1.0


def test_a_checkpoint_file_continues_from_a_second_before_it(tmp_path: Path) -> None:
    told = [Odometry("wheels", nanoseconds(at), 0.01 * at) for at in (0.4, 1.4, 2.4)]
    whole, backwards = (Listener(THREE, RATE_HZ, model=MODEL) for _ in range(2))
    whole.add(*told)
    backwards.add(*reversed(told))
    first = whole.push(SOUND[: 2 * RATE_HZ])
    assert backwards.push(SOUND[: 2 * RATE_HZ]) == first
    save_checkpoint(tmp_path / "now.json", whole.checkpoint())
    second = Listener(THREE, RATE_HZ, model=MODEL, resume=tmp_path / "now.json", start_s=0.0)
    second.add(*told)
    rest = second.push(SOUND)
    assert rest == whole.push(SOUND[2 * RATE_HZ :])
    assert [one.stamp_ns for one in first + rest] == [10**8 * tenth for tenth in range(10, 30)]
    assert read_checkpoint(tmp_path / "now.json").senses is None


def test_a_checkpoint_of_another_array_or_rate_is_refused() -> None:
    kept: Checkpoint = Listener(THREE, RATE_HZ, model=MODEL).checkpoint()
    moved = MicrophoneArray([[0.0, 0.2, 0.0], [0.1, 0.0, 0.0], [0.0, -0.2, 0.0]])
    anything = ListenSettings(uncalibrated=True)
    for array, rate, free in ((moved, RATE_HZ, anything), (THREE, 48_000, ListenSettings())):
        with pytest.raises(InvalidArgumentError, match="resume: expected the array, rate"):
            Listener(array, rate, model=MODEL, resume=kept, settings=free)
    with pytest.raises(InvalidArgumentError, match="model: expected nothing beside a source"):
        Listener(Listener(THREE, RATE_HZ, model=MODEL)._source, RATE_HZ, model=MODEL)


def test_samples_of_another_shape_are_refused_and_nothing_is_lost() -> None:
    listener, other = (Listener(THREE, RATE_HZ, model=MODEL) for _ in range(2))
    wrong: Float32Array
    for wrong in (SOUND[:100, :2], np.full((5, 3), np.nan, np.float32)):
        with pytest.raises(InvalidArgumentError, match="block"):
            listener.push(wrong)
    assert listener.push(SOUND) == other.push(SOUND)


def test_a_site_is_learned_with_a_forgetting_time_or_not_at_all() -> None:
    def heard_s(**how: float) -> float | None:
        listener = Listener(THREE, RATE_HZ, model=MODEL, settings=ListenSettings(**how))
        listener.push(SOUND)
        site = listener.checkpoint().site
        return None if site is None else site.heard_s

    assert heard_s(site_adaptation=False) is None
    assert heard_s(forgetting_s=0.2) <= 0.3 < 1.5 < heard_s()
