"""The channel between the thread of a sensor and that of the computation."""

import threading
import time
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from worldstate.adapters.live.live_sensors import image_channel
from worldstate.adapters.live.live_sound import BoundedChannel
from worldstate.ground.errors import InputFileError

DAY_IMAGES = 24 * 3600 * 10


def test_the_oldest_item_is_dropped_and_counted():
    channel = BoundedChannel[int](3)
    for number in range(10):
        channel.put(number)
    assert [channel.take() for _ in range(3)] == [7, 8, 9]
    assert channel.dropped == 7


def test_queued_items_precede_end_and_error():
    channel = BoundedChannel[int](3)
    channel.put(1)
    channel.close(InputFileError("device", "unplugged"))
    assert channel.take() == 1
    with pytest.raises(InputFileError, match="unplugged"):
        channel.take()
    with pytest.raises(InputFileError, match="unplugged"):
        channel.take_all()


def test_items_after_the_end_are_ignored():
    channel = BoundedChannel[int](3)
    channel.put(1)
    channel.close()
    channel.put(2)
    assert [channel.take(), channel.take()] == [1, None]
    assert channel.dropped == 0


def test_items_and_the_end_wake_a_waiting_thread():
    channel = BoundedChannel[int](2)
    taken = []
    waiting = threading.Thread(target=lambda: taken.extend([channel.take(), channel.take()]))
    waiting.start()
    channel.put(5)
    channel.close()
    waiting.join(timeout=5.0)
    assert taken == [5, None]


def pushed(count: int, taken_every: int) -> int:
    """Push `count` images at once; return the bytes held at the end."""
    images, seen = image_channel(), 0
    tracemalloc.start()
    try:
        for number in range(count):
            images.put((0.1 * number, np.full((48, 64, 3), number % 256, np.uint8)))
            if number % taken_every == 0:
                seen += len(images.take_all())
        held, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert seen + images.dropped + len(images.take_all()) == count
    assert most < 1 << 19
    return held


def test_unread_images_use_no_memory():
    assert abs(pushed(4_000, 100) - pushed(400, 100)) < 1 << 15


@pytest.mark.slow
def test_a_day_of_images_uses_as_much_memory_as_a_minute():
    resident = Path("/proc/self/statm")
    before = int(resident.read_text().split()[1]) if resident.exists() else 0
    started_s = time.monotonic()
    assert abs(pushed(DAY_IMAGES, 7) - pushed(600, 7)) < 1 << 15
    after = int(resident.read_text().split()[1]) if resident.exists() else 0
    assert (after - before) * 4096 < 8 << 20
    assert time.monotonic() - started_s < 600.0
