"""The limit on BLAS threads holds inside, and only there."""

from contextlib import suppress

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from worldstate.frontend.array import steering as limits
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.array.steering import one_blas_thread
from worldstate.frontend.stream import FrontEnd


@pytest.fixture(autouse=True)
def _of_now() -> None:
    """Search for BLAS libraries again, because an earlier test may have loaded another one."""
    limits._controller.cache_clear()


def blas_threads() -> set[int]:
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


def test_the_limit_is_lifted_at_the_end_of_the_outer_one_and_after_an_error() -> None:
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
    frames = []
    for threads in (1, 2):
        with threadpool_limits(threads, user_api="blas"):
            frames.append(FrontEnd(array, 16_000).process(sound)[0])
    np.testing.assert_array_equal(frames[0].srp, frames[1].srp)
    np.testing.assert_array_equal(frames[0].feature, frames[1].feature)
