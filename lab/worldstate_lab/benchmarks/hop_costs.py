"""Processing time of a hop, stage by stage, in front-end and listener, and that of the published chain.

Every stage is timed in place: its function is wrapped with a clock, so that the chain is not repeated here.
`published_chain_times` implements the published acoustic baseline in its amortised form. It computes scipy's
STFT of the whole file, channel by channel, and its time is shared among the hops. For every hop it then
computes two segments of half a second by pyroomacoustics' SRP with thirty azimuths, 50-1500 Hz.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial, wraps
from typing import Any
from unittest.mock import patch

import numpy as np

from worldstate import Measurement, Present, Sighting, SignatureEvidence, WorldFilter
from worldstate.abduction.road_users import DomainGuard
from worldstate.abduction.signature.site_estimate import SiteSignature
from worldstate.adapters import acoustic
from worldstate.frontend import hop_spectra
from worldstate.frontend.approach.tone import ToneStage
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.direction import bearing, feature
from worldstate.frontend.health.channel_monitor import ChannelMonitor
from worldstate.frontend.hop_spectra import LevelMeter
from worldstate.frontend.spectra.stft import StreamingStft
from worldstate.frontend.stream import FrontEnd
from worldstate.ground.typing import Float32Array
from worldstate.ground.values import NotUsable

Milliseconds = list[float]
Stages = Mapping[str, tuple[tuple[Any, str], ...]]
Calls = Sequence[Callable[[], object]]

RATE_HZ, NFFT = 47_998, 512
FRONT_END: Stages = {
    "stft": ((StreamingStft, "push"),),
    "phat": ((hop_spectra, "power"), (hop_spectra, "whiten")),
    "srp181": ((hop_spectra, "steered_power"), (FrontEnd, "_srp")),
    "feature": ((hop_spectra, "cross_spectra"), (feature, "pair_sum"), (FrontEnd, "_feature")),
    "peaks": ((bearing, "find_peaks"),),
    "bands": ((LevelMeter, "push"),),
    "looming": ((FrontEnd, "_looming"),),
    "tone": ((ToneStage, "push"), (ToneStage, "read")),
    "channel_watching": ((ChannelMonitor, "push"),),
}
EVIDENCE: Stages = {
    "window_evidence": ((SiteSignature, "evidence"),),
    "domain_guard": ((DomainGuard, "judge"),),
    "sequence_reader": ((acoustic, "read_hop"),),
}


def elapsed_ms(call: Callable[[], object], clock: Callable[[], float] = time.perf_counter) -> float:
    """Return the duration of `call` in milliseconds, wall time or processor time (`time.process_time`).

    Examples
    --------
    >>> elapsed_ms(lambda: None) < 1000.0
    True
    """
    start = clock()
    call()
    return 1e3 * (clock() - start)


def stage_times(stages: Stages, calls: Calls) -> dict[str, Milliseconds]:
    """Return the time of every stage within each call, in milliseconds.

    Examples
    --------
    >>> len(stage_times({"power": ((np, "square"),)}, [lambda: np.square(2.0)] * 3)["power"])
    3
    """
    times = {name: Milliseconds() for name in stages}
    with ExitStack() as patches:
        for name, functions in stages.items():
            for owner, function in functions:
                clocked = _clocked(getattr(owner, function), times[name])
                patches.enter_context(patch.object(owner, function, clocked))
        for call in calls:
            for spent in times.values():
                spent.append(0.0)
            call()
    return times


def _clocked(stage: Callable[..., Any], spent: Milliseconds) -> Callable[..., Any]:
    """Return a function that adds its milliseconds to the last entry of `spent`."""

    @wraps(stage)
    def call(*arguments: Any, **options: Any) -> Any:
        start = time.perf_counter()
        found = stage(*arguments, **options)
        spent[-1] += 1e3 * (time.perf_counter() - start)
        return found

    return call


REPEATS = 9


def published_chain_times(sound: Float32Array, array: MicrophoneArray) -> Milliseconds:
    """Return milliseconds per hop of the published chain on sound of an array, shape (n, M)."""
    import pyroomacoustics
    from scipy.signal import stft

    def transform(part: Float32Array) -> list[Any]:
        return [stft(channel, RATE_HZ, nperseg=NFFT)[2] for channel in part.T]

    shared_ms = 0.1 * elapsed_ms(partial(transform, sound)) * RATE_HZ / len(sound)
    second = np.stack(transform(sound[:RATE_HZ]))
    azimuths = np.radians(np.linspace(-90.0, 90.0, 30))
    peer = pyroomacoustics.doa.SRP(array.positions_m.T, RATE_HZ, NFFT, azimuth=azimuths)
    half = second.shape[2] // 2

    def one_hop() -> None:
        for segment in (second[..., :half], second[..., half : 2 * half]):
            peer.locate_sources(segment, freq_range=[50.0, 1500.0])

    return [elapsed_ms(one_hop) + shared_ms for _ in range(REPEATS)]


VEHICLES = 1, 20
HOPS, WARM_UP = 40, 20  # Timed hops, and hops before them until tracks are established


def update_times(rng: np.random.Generator) -> dict[str, Milliseconds]:
    """Return the milliseconds of the filter's updates and snapshots, by number of vehicles."""
    times = dict[str, Milliseconds]()
    for n in VEHICLES:
        world, updates, states = WorldFilter(), Milliseconds(), Milliseconds()
        for one in vehicle_hops(n, rng):
            start = time.process_time()
            world = world.update(one)
            updates.append(1e3 * (time.process_time() - start))
            states.append(elapsed_ms(partial(getattr, world, "state"), time.process_time))
        times[f"update_{n}"], times[f"state_{n}"] = updates[WARM_UP:], states[WARM_UP:]
    return times


def vehicle_hops(n: int, rng: np.random.Generator) -> list[Measurement]:
    """Return hops in which a camera detects the same n vehicles, side by side."""
    stand = np.linspace(-0.5, 0.5, n) if n > 1 else np.zeros(1)
    # The deviation falls with the number of vehicles, so that neighbouring boxes remain distinguishable.
    std = min(0.02, 0.2 / n)
    azimuth_rad = stand + rng.normal(0.0, 0.25 * std, (HOPS, n))
    silent, even = NotUsable("not measured"), SignatureEvidence(("left", "right"), (0.0, 0.0), 0.0, 0.0)
    return [
        Measurement(
            100_000_000 * hop,
            even,
            Present(0.06, 0.01),
            silent,
            silent,
            tuple(Sighting(one, std, "car", 0.9, 0.03) for one in row),
        )
        for hop, row in enumerate(azimuth_rad.tolist(), 1)
    ]
