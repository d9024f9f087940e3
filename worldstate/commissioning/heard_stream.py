"""Streams for training and exam of a model for an array, and the front-end's output for them.

The sound itself is not stored: an hour of 56 channels at 6 kHz takes 5 GB, the output 50 MB.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, fields, replace
from itertools import product
from math import ceil
from pathlib import Path

import numpy as np

from worldstate.adapters.acoustic import LEVEL_BAND_HZ, heard_of
from worldstate.adapters.audio.sound_file import open_sound
from worldstate.frontend.approach.looming import Looming
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.direction.bearing import direct_probability
from worldstate.frontend.hop_spectra import NoiseMeter
from worldstate.frontend.settings import FrontEndSettings
from worldstate.frontend.stream import AcousticFrame, FrontEnd
from worldstate.ground import InvalidArgumentError
from worldstate.ground.checks import check_ranges
from worldstate.ground.typing import AnyArray, BoolArray, Float32Array, FloatArray, IndexArray
from worldstate.operations.recordings.hop_table import HopTable, load_named, save_named
from worldstate.simulation.scene.junction import (
    MOVING_SITES,
    SITES,
    Site,
    drawn_site,
    ego_moves,
    renderer_named,
    site,
)
from worldstate.simulation.scene.presets import preset
from worldstate.simulation.scene.settings import rate_for
from worldstate.simulation.stream.rendering import Block
from worldstate.simulation.stream.settings import StreamSettings, traffic_named
from worldstate.simulation.stream.truth import VehicleTruth
from worldstate.simulation.stream.writing import DrawnStream, draw_stream

# Names of traffic: hazards one after another, one hazard per drive of a moving ego, and none.
PAIRS, APPROACHES, HAZARD_FREE = "pairs", "approaches", "no-hazard"
# Training traffic for an ego at rest, with each renderer and in varied weather: vehicles that come into view
# at every junction, and at two of four junctions near or loud sources that never do.
TOWN, CALM_TOWN, MISLEADING_TOWN = "town-varied", "no-hazard-varied", "misleading-varied"
LEARNED_PRESET = "street-7"
# Streams with the usual preset and without weather are added, half as long, because a model trained with one
# preset is worse with the other.
USUAL_SHARE = 0.5
RENDERERS = {"S": 0, "T": 500, "M": 750}  # First letter of a junction's name, and its first number
EXAM_OTHERS = ("A911", "B911", "A912", "B912", "A913")  # Exam junctions of the other renderers
# Seeds of training streams and exam streams, which never overlap. Every junction has its own; with one seed
# the same drivers would come at the same times everywhere.
LEARNED_SEED, USUAL_SEED, EXAM_SEED, SEEDS_EACH = 1_000_000, 1_099_000, 2_000_000, 1000
# With a moving ego, a stream consists of many drives with one seed each. An approach is evaluated until six
# seconds after its last vehicle, and the second vehicle of a queue comes four seconds after the first.
DRIVES_S, DRIVES_EACH = {APPROACHES: 18.0, HAZARD_FREE: 12.0}, 1000
MOUNTING = 2  # Number of the junction for wrong mountings


@dataclass(frozen=True, slots=True)
class CommissionSettings:
    """Amount of simulation, and the allowed alarms.

    Parameters
    ----------
    junctions : int
        Drawn junctions per renderer for training, half of them with a wall across the crossing street. With
        few junctions a model learns these streets instead of streets in general.
    approach_minutes, hazard_free_minutes : float
        Length of the stream at each junction; an ego at rest adds half as much in streets without weather.
    exam_minutes : float
        Length of the hazard-free stream per exam junction; the stream with approaches has three fifths of it.
    onsets_per_hour : float
        Alarms allowed per hour without vehicles.
    bandwidth_hz : float
        Upper limit of the rendered frequencies.
    seed : int
        Seed of the random streams.
    moving_ego : bool
        Whether the ego drives up to the corner, in many drives per junction, or stands there.
    leave_out : tuple of str
        Real junctions whose labelled windows are not used for training.
    quick : bool
        Whether this only tests the command; the model is then marked as unfit for use.

    Examples
    --------
    >>> plan = learned_streams(CommissionSettings(junctions=2))
    >>> [f"{one.site.name} {one.traffic.name} {one.minutes:g}" for one in plan][:2]
    ['SA101 town-varied 7.2', 'SA101 misleading-varied 6']
    """

    junctions: int = 12
    approach_minutes: float = 7.2
    hazard_free_minutes: float = 6.0
    exam_minutes: float = 24.0
    onsets_per_hour: float = 30.0
    bandwidth_hz: float = 2000.0
    seed: int = 1
    leave_out: tuple[str, ...] = ()
    quick: bool = False
    moving_ego: bool = False

    @property
    def sites(self) -> tuple[str, ...]:
        """The named junctions, which are used for the exam."""
        return MOVING_SITES if self.moving_ego else SITES

    def __post_init__(self) -> None:
        check_ranges(self, junctions=(2, 200))
        # Shorter streams contain no vehicles, and nothing can be learned.
        check_ranges(self, approach_minutes=(0.9, 120.0), hazard_free_minutes=(0.5, 120.0))
        check_ranges(self, exam_minutes=(0.5, 160.0), onsets_per_hour=(0.1, 3600.0), seed=(0, SEEDS_EACH - 1))


def quick_settings(settings: CommissionSettings) -> CommissionSettings:
    """Return settings for training at two junctions with about a minute each."""
    return replace(
        settings, junctions=2, approach_minutes=1.2, hazard_free_minutes=0.5, exam_minutes=2.0, quick=True
    )


def learned_streams(settings: CommissionSettings) -> list[StreamSettings]:
    """Return the training streams: drawn junctions, none of the five named ones.

    All renderers have the same number of junctions, so that none outweighs the others.
    """
    plans = {i: f"{'AB'[i % 2]}{101 + i // 2}" for i in range(settings.junctions)}
    approaching, quiet = settings.approach_minutes, settings.hazard_free_minutes
    found = list[StreamSettings]()
    for letter, (i, plan) in product(RENDERERS, plans.items()):
        name = _numbered(letter, {i: plan}, settings)
        if settings.moving_ego:
            # The noise of a moving ego was set relative to the levels of the usual preset.
            found += _streams(name, LEARNED_SEED, {APPROACHES: approaching, HAZARD_FREE: quiet}, settings)
            continue
        without = MISLEADING_TOWN if i % 4 < 2 else CALM_TOWN
        varied = _streams(name, LEARNED_SEED, {TOWN: approaching, without: quiet}, settings)
        found += [replace(one, preset=preset(LEARNED_PRESET)) for one in varied]
        usual = {PAIRS: USUAL_SHARE * approaching, HAZARD_FREE: USUAL_SHARE * quiet}
        found += _streams(name, USUAL_SEED, usual, settings)
    return found


def _numbered(letter: str, plans: Mapping[int, str], settings: CommissionSettings) -> dict[int, str]:
    """Return the junctions of a renderer, with numbers of its own."""
    prefix = "D" + letter.removeprefix("S") if settings.moving_ego else letter
    return {RENDERERS[letter] + i: prefix + plan for i, plan in plans.items()}


def exam_streams(settings: CommissionSettings) -> list[StreamSettings]:
    """Return the exam streams: twenty single vehicles, pairs and queues at each of the five named junctions.

    Five junctions of each other renderer are added, with a third of the time for an ego at rest.
    """
    names = {i: name for i, name in enumerate(settings.sites) if i == MOUNTING or not settings.quick}
    hazards = APPROACHES if settings.moving_ego else PAIRS
    minutes = {hazards: 0.6 * settings.exam_minutes, HAZARD_FREE: settings.exam_minutes}
    found = _streams(names, EXAM_SEED, minutes, settings)
    if settings.quick:
        return found
    others = [_numbered(letter, dict(enumerate(EXAM_OTHERS)), settings) for letter in "TM"]
    part = {name: one / (1.0 if settings.moving_ego else 3.0) for name, one in minutes.items()}
    return found + [stream for names in others for stream in _streams(names, EXAM_SEED, part, settings)]


def mounting_streams(settings: CommissionSettings) -> list[StreamSettings]:
    """Return the exam streams at the junction for wrong mountings."""
    return [one for one in exam_streams(settings) if one.site.name == settings.sites[MOUNTING]]


def junction_named(name: str) -> Site:
    """Return a named junction, or the drawn junction of another name."""
    return site(name) if name in SITES + MOVING_SITES else drawn_site(name)


def _streams(
    names: Mapping[int, str], first_seed: int, minutes_of: Mapping[str, float], settings: CommissionSettings
) -> list[StreamSettings]:
    """Return a stream of each traffic at every numbered junction, or as many drives as fill its time."""
    found, rate = list[StreamSettings](), rate_for(settings.bandwidth_hz)
    for (number, name), (traffic, minutes) in product(names.items(), minutes_of.items()):
        own = first_seed + number + SEEDS_EACH * settings.seed
        each = DRIVES_S[traffic] / 60.0 if settings.moving_ego else minutes
        whole = StreamSettings(junction_named(name), each, own, traffic_named(traffic), sample_rate_hz=rate)
        drives = ceil(minutes / whole.minutes - 1e-9) if settings.moving_ego else 0
        found += [replace(whole, seed=own * DRIVES_EACH + i) for i in range(drives)] or [whole]
    return found


# Errors that a bracket and a tape measure leave: two degrees are 14 mm over a width of 40 cm.
YAW_DEG, POSITION_MM = 2.0, 5.0


def mountings(array: MicrophoneArray, rng: np.random.Generator) -> dict[str, MicrophoneArray]:
    """Return versions of an array: as mounted, turned, and with a small error in every coordinate.

    Examples
    --------
    >>> found = mountings(MicrophoneArray([[0, 1, 0], [0, -1, 0]]), np.random.default_rng(1))
    >>> {name: one.positions_m[0, :2].round(2).tolist() for name, one in found.items()}
    {'as mounted': [0.0, 1.0], '2 deg of yaw': [-0.03, 1.0], '5 mm of position': [0.0, 1.0]}
    """
    cosine, sine = np.cos(np.radians(YAW_DEG)), np.sin(np.radians(YAW_DEG))
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    off = 1e-3 * POSITION_MM * rng.standard_normal(array.positions_m.shape)
    return {
        "as mounted": array,
        f"{YAW_DEG:g} deg of yaw": MicrophoneArray(array.positions_m @ turn.T),
        f"{POSITION_MM:g} mm of position": MicrophoneArray(array.positions_m + off),
    }


ROW_S = 0.1
_PCM = 32767.0


@dataclass(frozen=True, slots=True, eq=False)
class HeardStream:
    """Output of the front-end for one stream, and the vehicles in the stream."""

    hops: HopTable  # One row per hop: columns of `AcousticFrame`, NaN for missing values
    vehicles: HopTable  # One row per vehicle: flow, kind, arm, T0 as `entry_s` (NaN: never comes into view)
    rows: HopTable  # One row per vehicle and 0.1 s: time, position, in view, loudness, also in `BAND_HZ`

    def row_hops(self) -> tuple[IndexArray, BoolArray]:
        """Return the hop number of every row of `rows`, and whether that hop exists."""
        time_s = self.hops.time_s
        numbers = np.round((self.rows.time_s - time_s[0]) / ROW_S).astype(np.intp)
        return numbers, (numbers >= 0) & (numbers < len(time_s))

    def in_view_within(self, distance_m: float) -> BoolArray:
        """Return for every row of `rows` whether the vehicle is in view within a distance."""
        return np.asarray(self.rows.in_view & (np.hypot(self.rows.x_m, self.rows.y_m) <= distance_m))

    @property
    def hazard_free(self) -> bool:
        """Whether no vehicle comes out of a hidden arm."""
        return not self.vehicles.hazard.any()

    @property
    def site(self) -> str:
        """Name of the junction."""
        return str(self.hops.about["site"])

    @property
    def renderer(self) -> str:
        """Renderer of the sound, as in `Site.renderer`; recordings have that of the first renderer."""
        return renderer_named(self.site)

    @property
    def ego_moves(self) -> bool:
        """Whether the ego drives up to the corner."""
        return ego_moves(self.site)

    def save(self, path: Path) -> None:
        """Write the stream, completely or not at all."""
        save_named(path, {one.name: getattr(self, one.name) for one in fields(self)})

    @classmethod
    def load(cls, path: Path) -> "HeardStream":
        """Read a stream that `save` wrote."""
        return cls(**load_named(path, "a processed stream"))


def hear_stream(
    settings: StreamSettings,
    arrays: Sequence[MicrophoneArray],
    believed: Sequence[Sequence[MicrophoneArray]] = (),
) -> list[HeardStream]:
    """Render a stream once for several arrays, and process it block by block with each of them.

    Arrays do not affect one another. `believed` contains the assumed versions of each array, such as wrong
    mountings; its sound is processed once with each. By default it is the array itself.
    """
    stream, loudness = draw_stream(settings, *arrays), dict[int, FloatArray]()
    slices = stream.scene.microphones.slices
    ears = [
        (number, slices[number], array)
        for number, some in enumerate(believed or [[one] for one in arrays])
        for array in some
    ]
    about = {
        **{"site": settings.site.name, "traffic": settings.traffic.name, "seed": settings.seed},
        **{"sample_rate_hz": settings.sample_rate_hz, "background_db": settings.background_db},
    }
    with closing(stream.blocks()) as blocks:
        samples = _recorded(stream, blocks, loudness)
        heard_by = [(channels, array) for _, channels, array in ears]
        told = _heard_hops(samples, heard_by, settings.sample_rate_hz, settings.name, about)
    truths = [_truth(stream.vehicles, loudness, number) for number in range(len(arrays))]
    return [HeardStream(one, *truths[number]) for one, (number, *_) in zip(told, ears, strict=True)]


def hear_recording(sound: Path, array: MicrophoneArray) -> HeardStream:
    """Process a recording that is known to contain no vehicle."""
    with open_sound(sound, array.n_microphones, channels=array.channels) as audio:
        about = {"site": sound.stem, "traffic": "recorded", "sample_rate_hz": audio.sample_rate_hz}
        blocks = audio.blocks(round(audio.sample_rate_hz))
        every = [(slice(None), array)]
        (hops,) = _heard_hops(blocks, every, audio.sample_rate_hz, sound.name, about)
    return HeardStream(hops, *_truth((), {}))


def _recorded(
    stream: DrawnStream, blocks: Iterable[Block], loudness_db: dict[int, FloatArray]
) -> Iterator[Float32Array]:
    """Yield the blocks as converters record them, and store the loudness of the events."""
    for block in blocks:
        loudness_db |= block.loudness_db
        yield stream.recorded(block)


def _heard_hops(
    blocks: Iterable[Float32Array],
    ears: Sequence[tuple[slice, MicrophoneArray]],
    sample_rate_hz: float,
    name: str,
    about: Mapping[str, object],
) -> list[HopTable]:
    # Simulated microphones do not fail, and their monitoring takes a third of the time.
    chosen = FrontEndSettings.heard_at(sample_rate_hz, level_band_hz=LEVEL_BAND_HZ, watch_channels=False)
    front_ends = [FrontEnd(array, sample_rate_hz, chosen) for _, array in ears]
    frames, middles = [list[AcousticFrame]() for _ in ears], [list[Float32Array]() for _ in ears]
    for samples in blocks:
        for number, (channels, array) in enumerate(ears):
            own = samples[:, channels]
            middles[number].append(own[:, array.middle].copy())
            frames[number] += front_ends[number].process(own)
    for heard, front_end in zip(frames, front_ends, strict=True):
        heard += front_end.finish()
    if not frames[0]:
        raise InvalidArgumentError(f"{name}: expected more than a second of sound")
    return [
        HopTable(_columns(heard, np.concatenate(middle)), name=name, about=about)
        for heard, middle in zip(frames, middles, strict=True)
    ]


def _columns(frames: list[AcousticFrame], middle: Float32Array) -> dict[str, np.ndarray]:
    looming = [one.looming if isinstance(one.looming, Looming) else None for one in frames]
    # The meter is part of the monitoring, which is off here. It needs only levels.
    meter, excess_db = NoiseMeter(), list[float]()
    for one in frames:
        meter.push(one.band_log_energy, float(one.feature.mean()))
        excess_db.append(meter.excess_db)
    heard = [heard_of(replace(one, excess_db=db)) for one, db in zip(frames, excess_db, strict=True)]
    return {
        "time_s": np.array([one.stamp_ns for one in frames]) * 1e-9,
        "feature": np.array([one.feature for one in frames], np.float32),
        "bearing_rad": np.array([one.bearing_rad for one in frames]),
        "bearing_std_rad": np.array([one.bearing_std_rad for one in frames]),
        "prominence": np.array([one.prominence for one in frames]),
        "band_log_energy": np.array([one.band_log_energy for one in frames], np.float32),
        "looming_hz": np.array([np.nan if one is None else one.inverse_tta_hz for one in looming]),
        "looming_std_hz": np.array([np.nan if one is None else one.std_hz for one in looming]),
        "direct": np.array([direct_probability(one.peaks) for one in frames]),
        "excess_db": np.array(excess_db),
        "heard": np.array([one.share for one in heard]),
        "unheard": np.array([one.reason or "" for one in heard], np.str_),
        "middle": _last_hops(middle, [one.sample_index for one in frames]),
    }


def _last_hops(middle: Float32Array, ends: list[int]) -> np.ndarray:
    """Return the sound of one microphone in the last hop of every window, shape (n, samples), 16 bit."""
    length = ends[1] - ends[0] if len(ends) > 1 else 0
    pcm = np.round(np.clip(middle, -1.0, 1.0) * _PCM).astype(np.int16)
    return np.array([pcm[end - length : end] for end in ends], np.int16)


def _truth(
    every: Sequence[VehicleTruth], loudness_db: Mapping[int, FloatArray], array: int = 0
) -> tuple[HopTable, HopTable]:
    """Return one row per vehicle, and one per vehicle and tenth of a second, as in `HeardStream`."""
    # Columns are typed one by one, because without any vehicle they would be columns of floats.
    motions = [one.event.manoeuvre for one in every]
    vehicles = HopTable(
        {
            "vehicle": np.array([one.number for one in every], np.int64),
            "flow": np.array([one.event.flow for one in every], np.str_),
            "kind": np.array([one.motion.kind.name for one in motions], np.str_),
            "arm": np.array([one.arm for one in motions], np.str_),
            "entry_s": np.array([np.nan if one.t0_s is None else one.t0_s for one in every], np.float64),
            "hazard": np.array([one.hazard for one in every], np.bool_),
        }
    )
    azimuth, distance = (_joined([getattr(one, name) for one in every]) for name in ("axle_rad", "axle_m"))
    rows = HopTable(
        {
            "vehicle": np.repeat([one.number for one in every], [len(one.time_s) for one in every]),
            "time_s": _joined([one.time_s for one in every]),
            "x_m": distance * np.cos(azimuth),
            "y_m": distance * np.sin(azimuth),
            "in_view": _joined([one.in_view for one in every]).astype(np.bool_),
            "loudness_db": _joined([loudness_db[one.number][array][0] for one in every]),
            "band_db": _joined([loudness_db[one.number][array][1] for one in every]),
        }
    )
    return vehicles, rows


def _joined(parts: Sequence[AnyArray]) -> AnyArray:
    return np.concatenate(parts) if parts else np.zeros(0)
