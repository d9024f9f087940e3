"""A simulated stream as the front-end hears it: one row a hop, and the truth beside it.

The sound itself is not kept: an hour of 56 channels at 6 kHz is 5 GB, what is heard in it 50 MB.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from worldstate.adapters.acoustic_sequence import LEVEL_BAND_HZ
from worldstate.adapters.audio.open_sound import open_sound
from worldstate.frontend.approach.looming import Looming
from worldstate.frontend.approach.tone import ENGINE_BAND_HZ, ToneReading
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.direction.feature import feature_nfft
from worldstate.frontend.frame import AcousticFrame
from worldstate.frontend.settings import FrontEndSettings
from worldstate.frontend.stream import FrontEnd
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import AnyArray, Float32Array, FloatArray
from worldstate.operations.recordings.hop_table import HopTable, load_named, save_named
from worldstate.simulation.scene.junction import ego_moves
from worldstate.simulation.stream.drawn_stream import DrawnStream, draw_stream
from worldstate.simulation.stream.rendering import Block
from worldstate.simulation.stream.settings import StreamSettings
from worldstate.simulation.stream.truth import VehicleTruth

HOPS, VEHICLES, ROWS = "hops", "vehicles", "rows"
_PCM = 32767.0


@dataclass(frozen=True, slots=True, eq=False)
class HeardStream:
    """What was heard of one stream, and who was there."""

    hops: HopTable  # One row a hop: `AcousticFrame` by columns, NaN where something was refused
    vehicles: HopTable  # One row a vehicle: flow, kind, arm, T0 as `entry_s` (NaN: never comes into view)
    rows: HopTable  # One row a vehicle and tenth of a second: time, place, in view, loudness

    @property
    def hazard_free(self) -> bool:
        """Whether nobody comes out of a hidden arm."""
        return not self.vehicles.hazard.any()

    @property
    def site(self) -> str:
        """Name of the junction."""
        return str(self.hops.about["site"])

    @property
    def ego_moves(self) -> bool:
        """Whether the ego drives up to the corner."""
        return ego_moves(self.site)

    def save(self, path: Path) -> None:
        """Write it, whole or not at all."""
        save_named(path, {HOPS: self.hops, VEHICLES: self.vehicles, ROWS: self.rows})

    @classmethod
    def load(cls, path: Path) -> "HeardStream":
        """Read what `save` wrote."""
        tables = load_named(path, "a stream that was listened to")
        return cls(tables[HOPS], tables[VEHICLES], tables[ROWS])


def hear_stream(
    settings: StreamSettings, array: MicrophoneArray, believed: Sequence[MicrophoneArray] = ()
) -> list[HeardStream]:
    """Render a stream and listen to it, block by block, with each array that is believed to hear it."""
    stream, loudness = draw_stream(settings, array), dict[int, FloatArray]()
    about = {
        **{"site": settings.site.name, "traffic": settings.traffic.name, "seed": settings.seed},
        "sample_rate_hz": settings.sample_rate_hz,
    }
    with closing(stream.blocks()) as blocks:
        samples = _recorded(stream, blocks, loudness)
        told = _heard_hops(samples, believed or [array], settings.sample_rate_hz, settings.name, about)
    return [
        HeardStream(one, vehicle_table(stream.vehicles), vehicle_rows(stream.vehicles, loudness))
        for one in told
    ]


def hear_recording(sound: Path, array: MicrophoneArray) -> HeardStream:
    """Listen to a recording in which nobody is known to come."""
    with open_sound(sound, array.n_microphones) as audio:
        about = {"site": sound.stem, "traffic": "recorded", "sample_rate_hz": audio.sample_rate_hz}
        blocks = audio.blocks(round(audio.sample_rate_hz))
        (hops,) = _heard_hops(blocks, [array], audio.sample_rate_hz, sound.name, about)
    return HeardStream(hops, vehicle_table(()), vehicle_rows((), {}))


def _recorded(
    stream: DrawnStream, blocks: Iterable[Block], loudness_db: dict[int, FloatArray]
) -> Iterator[Float32Array]:
    """Yield what the converters make of the blocks, and keep how loud the events were."""
    for block in blocks:
        loudness_db |= block.loudness_db
        yield stream.recorded(block)


def _heard_hops(
    blocks: Iterable[Float32Array],
    arrays: Sequence[MicrophoneArray],
    sample_rate_hz: float,
    name: str,
    about: Mapping[str, object],
) -> list[HopTable]:
    chosen = listening_settings(sample_rate_hz)
    front_ends = [FrontEnd(array, sample_rate_hz, chosen) for array in arrays]
    frames: list[list[AcousticFrame]] = [[] for _ in arrays]
    middle: list[Float32Array] = []
    for samples in blocks:
        middle.append(samples[:, arrays[0].middle].copy())
        for heard, front_end in zip(frames, front_ends, strict=True):
            heard += front_end.process(samples)
    if not frames[0]:
        raise InvalidArgumentError(f"{name}: expected more than a second of sound")
    whole = np.concatenate(middle)
    return [HopTable(_columns(heard, whole), name=name, about=about) for heard in frames]


def listening_settings(sample_rate_hz: float) -> FrontEndSettings:
    """Return what streams are listened to with: everything that evidence reads, microphones trusted."""
    # Simulated microphones do not fail, and watching them takes a third of the time.
    return FrontEndSettings(
        nfft=feature_nfft(sample_rate_hz),
        tone_band_hz=ENGINE_BAND_HZ,
        level_band_hz=LEVEL_BAND_HZ,
        watch_channels=False,
    )


def _columns(frames: list[AcousticFrame], middle: Float32Array) -> dict[str, np.ndarray]:
    looming = [one.looming if isinstance(one.looming, Looming) else None for one in frames]
    tones = [one.tone if isinstance(one.tone, ToneReading) else None for one in frames]
    return {
        "time_s": np.array([one.stamp_ns for one in frames]) * 1e-9,
        "feature": np.array([one.feature for one in frames], np.float32),
        "bearing_rad": np.array([one.bearing_rad for one in frames]),
        "bearing_std_rad": np.array([one.bearing_std_rad for one in frames]),
        "prominence": np.array([one.prominence for one in frames]),
        "band_log_energy": np.array([one.band_log_energy for one in frames], np.float32),
        "looming_hz": np.array([np.nan if one is None else one.inverse_tta_hz for one in looming]),
        "looming_std_hz": np.array([np.nan if one is None else one.std_hz for one in looming]),
        "tone_hz": np.array([np.nan if one is None else one.frequency_hz for one in tones]),
        "tone_std_hz": np.array([np.nan if one is None else one.frequency_std_hz for one in tones]),
        "middle": _last_hops(middle, [one.sample_index for one in frames]),
    }


def _last_hops(middle: Float32Array, ends: list[int]) -> np.ndarray:
    """Return what one microphone heard in the last hop of every window, shape (n, samples), 16 bit."""
    length = ends[1] - ends[0] if len(ends) > 1 else 0
    pcm = np.round(np.clip(middle, -1.0, 1.0) * _PCM).astype(np.int16)
    return np.array([pcm[end - length : end] for end in ends], np.int16)


def vehicle_table(every: Sequence[VehicleTruth]) -> HopTable:
    """Return one row a vehicle, as `HeardStream.vehicles`."""
    # Typed column by column: of no vehicles at all rows would make columns of floats.
    motions = [one.event.manoeuvre for one in every]
    return HopTable(
        {
            "vehicle": np.array([one.number for one in every], np.int64),
            "flow": np.array([one.event.flow for one in every], np.str_),
            "kind": np.array([one.motion.kind.name for one in motions], np.str_),
            "arm": np.array([one.arm for one in motions], np.str_),
            "entry_s": np.array([np.nan if one.t0_s is None else one.t0_s for one in every], np.float64),
            "hazard": np.array([one.hazard for one in every], np.bool_),
        }
    )


def vehicle_rows(every: Sequence[VehicleTruth], loudness_db: Mapping[int, FloatArray]) -> HopTable:
    """Return one row a vehicle and tenth of a second, as `HeardStream.rows`."""
    azimuth, distance = (_joined([getattr(one, name) for one in every]) for name in ("axle_rad", "axle_m"))
    return HopTable(
        {
            "vehicle": np.repeat([one.number for one in every], [len(one.time_s) for one in every]),
            "time_s": _joined([one.time_s for one in every]),
            "x_m": distance * np.cos(azimuth),
            "y_m": distance * np.sin(azimuth),
            "in_view": _joined([one.in_view for one in every]).astype(np.bool_),
            "loudness_db": _joined([loudness_db[one.number] for one in every]),
        }
    )


def _joined(parts: Sequence[AnyArray]) -> AnyArray:
    return np.concatenate(parts) if parts else np.zeros(0)
