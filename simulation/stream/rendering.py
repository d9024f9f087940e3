"""A stream as blocks of samples: pieces of background and whole events, added up in their order."""

from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial

import numpy as np
from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

from worldstate.adapters.parallel import in_processes
from worldstate.ground.typing import Float32Array, FloatArray
from worldstate.simulation.scene.ambience import Ambience
from worldstate.simulation.sound.delay import KNOT_SAMPLES
from worldstate.simulation.sound.ego_sound import add_ego_echo, ego_noise
from worldstate.simulation.sound.receiver import Receiver

from .ambience import Microphones, ambience_piece, overlap_samples
from .arrivals import Event
from .event_sound import ALWAYS_S, ROW_S, event_blocks, event_sound, loudness_db
from .settings import StreamSettings

# What one process renders at a time: 40 MB of sound for 56 channels at 6 kHz, 80 MB at the full rate.
PIECE_S, PIECE_SAMPLES = 30.0, 360_000
AMBIENCE, EVENT, EGO_NOISE = 3, 4, 8  # purposes of generators


@dataclass(frozen=True, slots=True, eq=False)
class StreamScene:
    """What stays the same through a stream."""

    settings: StreamSettings
    ambience: Ambience
    microphones: Microphones

    @property
    def piece(self) -> int:
        """Samples in a piece; not shorter than two overlaps, so that only neighbours meet; a drive is one."""
        if not self.settings.ego.stands:
            return self.settings.samples
        rate = self.settings.sample_rate_hz
        return max(min(round(PIECE_S * rate), PIECE_SAMPLES), 2 * overlap_samples(self.settings))

    @property
    def within_s(self) -> tuple[float, float]:
        """What is rendered of the events: all, of a drive what is heard in it, often a third."""
        return ALWAYS_S if self.settings.ego.stands else (0.0, self.settings.duration_s)


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
    """The events that begin in one piece of the stream, with their numbers."""

    number: int
    events: dict[int, Event]


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Sound from one sample on, and the loudness of the events that are in it from their beginning."""

    pressure_pa: Float32Array  # shape (M, n)
    loudness_db: dict[int, FloatArray]  # At the rows of every event


def row_times(event: Event, settings: StreamSettings) -> FloatArray:
    """Return the tenths of a second of the stream in which an event is heard or seen, shape (R,)."""
    first, last = max(event.start_s, 0.0), min(event.end_s, settings.duration_s)
    begin, end = (int(np.ceil(time_s / ROW_S - 1e-9)) for time_s in (first, last))
    return ROW_S * np.arange(begin, end, dtype=np.float64)


def render_blocks(scene: StreamScene, events: Sequence[Event], jobs: int = 1) -> Generator[Block, None, None]:
    """Yield a stream from its beginning; what comes out does not depend on the number of jobs."""
    length, left = scene.piece, scene.settings.samples
    pending = np.zeros((len(scene.microphones.positions_m), 0), np.float32)
    with closing(in_processes(partial(render_piece, scene), pieces(scene, events), jobs)) as rendered:
        for piece in rendered:
            # An event may last beyond the next piece: either of the two may be the longer one.
            shorter, sound = sorted((pending, piece.pressure_pa), key=lambda one: one.shape[1])
            sound[:, : shorter.shape[1]] += shorter
            yield Block(sound[:, : min(length, left)], piece.loudness_db)
            pending, left = sound[:, length:].copy(), left - length


def pieces(scene: StreamScene, events: Sequence[Event]) -> list[Piece]:
    """Deal the events to the pieces that they begin in; those before the stream to the first one."""
    first = np.maximum([event.start_s for event in events], 0.0) * scene.settings.sample_rate_hz
    owner = (first // scene.piece).astype(int)
    return [
        Piece(number, {i: events[i] for i in np.flatnonzero(owner == number).tolist()})
        for number in range(-(-scene.settings.samples // scene.piece))
    ]


def render_piece(scene: StreamScene, piece: Piece) -> Block:
    """Render the background of one piece and all that begins in it, to the end."""
    settings, begin = scene.settings, piece.number * scene.piece
    rate, within, ego = settings.sample_rate_hz, scene.within_s, settings.ego
    ends = [
        round(max(one.start_s, within[0]) * rate) + event_blocks(one, rate, within) * KNOT_SAMPLES
        for one in piece.events.values()
    ]
    samples = max([end - begin for end in ends] + [scene.piece + overlap_samples(settings)])
    sound = np.zeros((len(scene.microphones.positions_m), samples), np.float32)
    loudness = {}
    with threadpool_limits(1):  # the number of BLAS threads would change the last bits
        _add_ambience(sound, scene, piece.number)
        if not ego.stands:
            _add_ego(sound, scene)
        for number, event in piece.events.items():
            rng = settings.generator(EVENT, number)
            alone = event_sound(event, settings.site, settings.preset, scene.microphones, rng, ego, within)
            loudness[number] = loudness_db(alone, row_times(event, settings), rate)
            heard = alone.pressure_pa[:, max(-alone.first, 0) :]
            at = max(alone.first, 0) - begin
            sound[:, at : at + heard.shape[1]] += heard
    return Block(sound, loudness)


def _add_ambience(sound: Float32Array, scene: StreamScene, number: int) -> None:
    rng = scene.settings.generator(AMBIENCE, number)
    piece = ambience_piece(
        scene.settings, scene.ambience, scene.microphones, scene.piece, rng, begins=number == 0
    )
    sound[:, : piece.shape[1]] += piece


def _add_ego(sound: Float32Array, scene: StreamScene) -> None:
    """Add what the ego itself sounds like over a drive."""
    settings, heard = scene.settings, scene.microphones
    to_ego, to_echo = settings.generator(EGO_NOISE).spawn(2)
    rate, engine_db, tyre_db = (
        settings.sample_rate_hz,
        settings.preset.ego_engine_db,
        settings.site.surface_db,
    )
    speed = settings.ego.at_mps(np.arange(sound.shape[1]) / rate)
    sound += ego_noise(heard.positions_m, speed, rate, to_ego, engine_db, tyre_db).T
    knots = np.arange(2) * KNOT_SAMPLES / rate
    receiver = Receiver(heard.positions_m, heard.skew_s, knots, settings.ego)
    add_ego_echo(sound, receiver, settings.site, engine_db, to_echo)
