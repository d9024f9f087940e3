"""What an update of the world-state costs beside a plain numpy batch and Stone Soup's JPDA.

The batch is the least that a tracker does: predict and update of n Kalman filters of four states and two
measurements, their association known, by einsum.
"""

import time
from collections.abc import Callable, Iterator
from functools import partial
from importlib.util import find_spec

import numpy as np

from worldstate import Measurement, Present, Sighting, SignatureEvidence, WorldFilter
from worldstate.ground import FloatArray, NotUsable

from .hop_costs import Milliseconds

ENTITIES = 1, 20
CROWD = 64, 600  # Boxes an image; the filter counts 64
HOPS, WARM_UP = 40, 20  # Once tracks are known
_SILENT, _EVEN = NotUsable("not listened to"), SignatureEvidence(("left", "right"), (0.0, 0.0), 0.0, 0.0)


def tracker_times(rng: np.random.Generator) -> dict[str, Milliseconds]:
    """Return the milliseconds of processor time of every hop, of every method and number of entities."""
    times = dict[str, Milliseconds]()
    for n in (*ENTITIES, *CROWD):
        times[f"update_{n}"], times[f"state_{n}"] = _world_times(hops(n, rng))
    for n in ENTITIES:
        times[f"numpy_batch_{n}"] = [_cpu_ms(partial(_batch_step, *_batch(n, rng))) for _ in range(HOPS)]
    if find_spec("stonesoup") is not None:
        times["jpda_1"] = list(_jpda_times(hops(1, rng)))
    return times


def hops(n: int, rng: np.random.Generator) -> list[Measurement]:
    """Return hops in which a camera finds the same n vehicles, side by side."""
    stand = np.linspace(-0.5, 0.5, n) if n > 1 else np.zeros(1)
    # As far apart as the deviations of their boxes allow.
    std = min(0.02, 0.2 / n)
    azimuth_rad = stand + rng.normal(0.0, 0.25 * std, (HOPS, n))
    return [
        Measurement(
            100_000_000 * hop,
            _EVEN,
            Present(0.06, 0.01),
            _SILENT,
            _SILENT,
            tuple(Sighting(one, std, "car", 0.9, 0.03) for one in row),
        )
        for hop, row in enumerate(azimuth_rad.tolist(), 1)
    ]


def _world_times(measured: list[Measurement]) -> tuple[Milliseconds, Milliseconds]:
    world, updates, states = WorldFilter(), Milliseconds(), Milliseconds()
    for one in measured:
        start = time.process_time()
        world = world.update(one)
        updates.append(1e3 * (time.process_time() - start))
        states.append(_cpu_ms(partial(getattr, world, "state")))
    return updates[WARM_UP:], states[WARM_UP:]


def _batch(n: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray, FloatArray]:
    return rng.normal(size=(n, 4)), np.tile(np.eye(4), (n, 1, 1)), rng.normal(size=(n, 2))


def _batch_step(mean: FloatArray, covariance: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
    flow, row = np.eye(4) + 0.1 * np.eye(4, k=2), np.eye(2, 4)
    mean = np.einsum("ij,nj->ni", flow, mean)
    covariance = np.einsum("ij,njk,lk->nil", flow, covariance, flow) + 0.01 * np.eye(4)
    spread = np.einsum("ij,njk,lk->nil", row, covariance, row) + 0.1 * np.eye(2)
    gain = np.einsum("nij,kj,nkl->nil", covariance, row, np.linalg.inv(spread))
    mean = mean + np.einsum("nij,nj->ni", gain, z - mean @ row.T)
    return mean, covariance - np.einsum("nij,jk,nkl->nil", gain, row, covariance)


def _jpda_times(measured: list[Measurement]) -> Iterator[float]:
    from .stone_soup_trackers import Jpda, scan_time, scans

    tracker = Jpda()
    for hop, one in enumerate(measured):
        taken, when = scans(one, (-0.5, 0.5)), scan_time(one)
        spent_ms = _cpu_ms(partial(tracker.step, taken, when))
        if hop >= WARM_UP:
            yield spent_ms


def _cpu_ms(call: Callable[[], object]) -> float:
    start = time.process_time()
    call()
    return 1e3 * (time.process_time() - start)
