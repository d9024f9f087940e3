"""`worldstate-lab bearings`: calibration of stated standard deviations, and errors of bearings beside peers.

Sources surround rings of 4 to 8 microphones, 3 to 10 cm in radius, in simulated rooms (reverberation 0.3 to
0.8 s, noise 5 to 20 dB below the source) and in the open. Each sound lasts three seconds, and only hops that
share no frame are used. The methods of pyroomacoustics run on the same STFT frames, band and azimuths. With
--streams, hops of streets with a vehicle in view within 20 m are evaluated; the error is the distance to the
nearest vehicle in azimuth.

`z` is the root mean square of error over stated deviation, and `surest_half` the mean of its square in the
half of the hops with the smallest deviation. `median_deg` is the median error of all hops, of the surest half
and of the surest sixth; hops without a bearing count as the least sure. `beyond_60_deg` is the share of
larger errors.

Examples
--------
  worldstate-lab bearings --scenes 30
  worldstate-lab bearings --streams streams/*-pairs-*.npz --json
"""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from worldstate.adapters.source import ListenSettings
from worldstate.cli.common.output import CommandResult
from worldstate.cli.common.progress import track
from worldstate.commissioning.heard_stream import HeardStream
from worldstate.commissioning.stream_exam import NEAR_M
from worldstate.frontend.array.microphone_array import SPEED_OF_SOUND_M_S, MicrophoneArray
from worldstate.frontend.settings import BEARING_HOPS
from worldstate.frontend.spectra.stft import StreamingStft
from worldstate.frontend.stream import FrontEnd
from worldstate.ground.checks import in_range
from worldstate.ground.errors import MissingExtraError
from worldstate.ground.parallel import in_processes
from worldstate.ground.typing import Float32Array, FloatArray
from worldstate.ground.values import wrap_angle
from worldstate.operations.metrics.approach_table import Figures
from worldstate.operations.recordings.hop_table import HOP_S
from worldstate_lab.report.table import figure_lines

RATE_HZ, LASTS_S = 24_000, 3.0  # Rate that needs no resampling
OPEN_SHARE = 1.0 / 3.0
PEERS = ("MUSIC", "NormMUSIC", "SRP", "CSSM", "FRIDA")
SPAN_DEG = 360.0
SURE, FAR_RAD = 1.0 / 6.0, np.radians(60.0)  # A larger error belongs to another peak


def drawn_scene(rng: np.random.Generator) -> tuple[MicrophoneArray, Float32Array, float, bool]:
    """Draw a ring and a source of noise that falls by 3 dB per octave, in a room or in the open.

    Return the ring, its sound (n, M), the azimuth of the source in radians, and whether it is a room.
    """
    pyroomacoustics = _peer()
    count, radius_m = int(rng.integers(4, 9)), rng.uniform(0.03, 0.1)
    round_rad = 2.0 * np.pi * np.arange(count) / count
    ring = radius_m * np.stack([np.cos(round_rad), np.sin(round_rad), 0.0 * round_rad], axis=1)
    azimuth, indoors = rng.uniform(-np.pi, np.pi), bool(rng.random() >= OPEN_SHARE)
    size = np.array([rng.uniform(5.0, 12.0), rng.uniform(5.0, 9.0), rng.uniform(2.5, 4.0)])
    if indoors:
        absorption, order = pyroomacoustics.inverse_sabine(rng.uniform(0.3, 0.8), size)
        walls = pyroomacoustics.Material(absorption)
        room = pyroomacoustics.ShoeBox(size, fs=RATE_HZ, materials=walls, max_order=order)
    else:
        room = pyroomacoustics.AnechoicRoom(fs=RATE_HZ)
    middle = size * [0.5, 0.5, 0.4] + rng.uniform(-0.5, 0.5, 3) * [1.0, 1.0, 0.5]
    away = rng.uniform(1.0, 1.9) * np.array([np.cos(azimuth), np.sin(azimuth), rng.uniform(-0.2, 0.2)])
    spectrum = np.fft.rfft(rng.standard_normal(round(LASTS_S * RATE_HZ)))
    source = np.fft.irfft(spectrum / np.sqrt(np.arange(len(spectrum)) + 1.0))
    room.add_source(middle + away, signal=source)
    room.add_microphone_array((middle + ring).T)
    room.simulate()
    clean = room.mic_array.signals.T[: round(LASTS_S * RATE_HZ)]
    noise = np.std(clean) * 10.0 ** (-rng.uniform(5.0, 20.0) / 20.0) * rng.standard_normal(clean.shape)
    sound = (0.1 / np.std(clean) * (clean + noise)).astype(np.float32)
    return MicrophoneArray(ring), sound, float(azimuth), indoors


def _peer() -> Any:
    try:
        import pyroomacoustics
    except ImportError as error:
        raise MissingExtraError("pyroomacoustics", "oracles") from error
    return pyroomacoustics


@dataclass(frozen=True, slots=True, eq=False)
class Bearings:
    """Errors of hops, stated deviations (infinite without a bearing), and the errors of peers."""

    error_rad: FloatArray  # shape (n,)
    std_rad: FloatArray  # shape (n,)
    peers_rad: Mapping[str, FloatArray]

    @classmethod
    def joined(cls, some: Sequence["Bearings"]) -> "Bearings":
        """Return the bearings of several scenes together."""
        parts = [np.concatenate([getattr(one, name) for one in some]) for name in ("error_rad", "std_rad")]
        peers = {name: np.concatenate([one.peers_rad[name] for one in some]) for name in some[0].peers_rad}
        return cls(parts[0], parts[1], peers)

    def figures(self) -> Figures:
        """Return their calibration and their errors."""
        order = np.argsort(self.std_rad, kind="stable")
        half, sixth = order[: len(order) // 2], order[: round(SURE * len(order))]
        stated = np.isfinite(self.std_rad)
        ratio = (self.error_rad[stated] / self.std_rad[stated]) ** 2
        sure = (self.error_rad[half] / self.std_rad[half]) ** 2
        medians = {"": order, "surest_half_": half, "surest_sixth_": sixth}
        return {
            "hops": len(order),
            "stated": float(stated.mean()),
            "z": float(np.sqrt(ratio.mean())),
            "surest_half": float(sure.mean()),
            "beyond_60_deg": float((np.abs(self.error_rad) > FAR_RAD).mean()),
            **{f"{name}median_deg": _median_deg(self.error_rad[rows]) for name, rows in medians.items()},
            **{f"{name}_deg": _median_deg(errors) for name, errors in self.peers_rad.items()},
            **{f"surest_half_{name}_deg": _median_deg(one[half]) for name, one in self.peers_rad.items()},
        }


def _median_deg(errors_rad: FloatArray) -> float:
    return float(np.degrees(np.median(np.abs(errors_rad))))


def scene_bearings(number: int, seed: int) -> tuple[bool, Bearings]:
    """Return whether a scene is a room, and its bearings with those of peers."""
    array, sound, azimuth_rad, indoors = drawn_scene(np.random.default_rng((seed, number)))
    settings = ListenSettings(azimuth_span_deg=SPAN_DEG).front_end(array, RATE_HZ)
    frames = FrontEnd(array, RATE_HZ, settings).process(sound)[::BEARING_HOPS]
    found = np.array([one.bearing_rad for one in frames])
    stated = np.array([one.prominence > one.least_prominence for one in frames])
    std_rad = np.where(stated, [one.bearing_std_rad for one in frames], np.inf)
    # The frames of every hop's bearing, for pyroomacoustics' methods.
    nfft, span = settings.nfft, BEARING_HOPS * HOP_S * RATE_HZ
    spectra = StreamingStft(array.n_microphones, nfft, range(nfft // 2 + 1)).push(sound)
    done = nfft + np.arange(len(spectra)) * (nfft // 2)
    heard = [spectra[(done <= end) & (done > end - span)] for end in (one.sample_index for one in frames)]
    heard = [one.transpose(2, 1, 0).astype(np.complex128) for one in heard]
    peers = {}
    for name in PEERS:
        method, sector = getattr(_peer().doa, name), settings.azimuths_rad()
        peer = method(array.positions_m.T, RATE_HZ, nfft, c=SPEED_OF_SOUND_M_S, num_src=1, azimuth=sector)
        azimuths = []
        for one in heard:
            peer.locate_sources(one, freq_range=list(settings.srp_band_hz))
            azimuths.append(float(peer.azimuth_recon[0]))
        peers[name] = wrap_angle(np.array(azimuths) - azimuth_rad)
    return indoors, Bearings(wrap_angle(found - azimuth_rad), std_rad, peers)


def street_bearings(heard: HeardStream) -> Bearings:
    """Return the bearings of the hops of a stream with a near vehicle in view, relative to the nearest."""
    hop, inside = heard.row_hops()
    seen = np.flatnonzero(heard.in_view_within(NEAR_M) & inside)
    true = np.arctan2(heard.rows.y_m[seen], heard.rows.x_m[seen])
    error = np.full(len(heard.hops), np.inf)
    np.minimum.at(error, hop[seen], np.abs(wrap_angle(heard.hops.bearing_rad[hop[seen]] - true)))
    known = np.isfinite(error) & np.isfinite(heard.hops.bearing_std_rad)
    return Bearings(error[known], heard.hops.bearing_std_rad[known], {})


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("--scenes", type=int, default=60, metavar="N", help="scenes with rings (default: %(default)s)")
    add("--streams", type=Path, nargs="+", metavar="NPZ", help="processed streams, instead of rings")
    add("--seed", type=int, default=1, help="seed of the scenes (default: %(default)s)")
    add("--jobs", type=int, default=1, help="processes (default: 1)")


def run(arguments: argparse.Namespace) -> CommandResult:
    """Run the command; return its result."""
    if arguments.streams:
        found = {"streets": list(map(street_bearings, map(HeardStream.load, arguments.streams)))}
    else:
        many = int(in_range("--scenes", arguments.scenes, 1, 10_000))
        heard = in_processes(partial(scene_bearings, seed=arguments.seed), range(many), arguments.jobs)
        scenes = list(track(heard, "listening", many))
        found = {"all": [one for _, one in scenes]}
        found["rooms"] = [one for indoors, one in scenes if indoors]
        found["in the open"] = [one for indoors, one in scenes if not indoors]
    report = {name: Bearings.joined(some).figures() for name, some in found.items() if some}
    return CommandResult(report, table={}, lines=figure_lines(report, ".3f"))
