"""Run the front-end on a simulated recording and keep what the published figures need, hop by hop."""

import numpy as np
from numpy.typing import ArrayLike

from worldstate.abduction.evidence import SignatureEvidence
from worldstate.adapters.acoustic import AcousticAdapter
from worldstate.adapters.camera.detections import DetectionFrame, DetectionLog
from worldstate.adapters.camera.pinhole import PinholeCamera
from worldstate.adapters.camera.vision_query import VisionQuery
from worldstate.adapters.datasets.ovad_layout import FRAME_RATE_HZ
from worldstate.adapters.listen import unoccluded_sector
from worldstate.adapters.simulation.dataset.recording import SimulatedRecording
from worldstate.adapters.simulation.scene.vehicle import LENGTH_M
from worldstate.frontend.approach.doppler import DopplerSettings, radial_speed
from worldstate.frontend.approach.engine_line import track_fundamental
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.direction.music import music_spectrum, signal_subspace
from worldstate.frontend.settings import FrontEndSettings
from worldstate.frontend.spectra.bins import band_bins, bin_frequencies_hz
from worldstate.frontend.spectra.stft import StreamingStft
from worldstate.frontend.stream import AcousticFrame
from worldstate.ground.blas_threads import one_blas_thread
from worldstate.ground.typing import BoolArray, FloatArray
from worldstate.ground.values import NotUsable, nanoseconds, seconds
from worldstate.operations.recordings.hop_stream import hop_stream
from worldstate.operations.recordings.hop_table import HopTable
from worldstate.state import Context

NONE_APPROACH = "none"
# The paper asks a usable tone for harmonics that agree: one line alone proves nothing.
DOPPLER = DopplerSettings(min_partials=2)
# Half a camera period: the frame nearest in time to the middle of a bearing's window is the one to compare.
NEAREST_S = 0.5 / FRAME_RATE_HZ


class _Silent:
    """A classifier that favours nothing: the features are classified later."""

    def evidence(self, feature: ArrayLike, /) -> SignatureEvidence:
        return SignatureEvidence(("left", "right"), (0.0, 0.0), 0.0, 0.0)


def run_front_end(recording: SimulatedRecording, name: str = "") -> HopTable:
    """Return one row a hop of a recording, by its own array; `classified` comes after.

    `reference_rad`, `srp_rad` and `music_rad` are the azimuth of the camera's moving box and the two acoustic
    bearings, NaN where no box is there; `doppler` says why the tone of the pass-by cannot be used, if so.
    """
    array = recording.array
    vision = VisionQuery(
        PinholeCamera(), detection_log(recording), line_of_sight=unoccluded_sector(Context())
    )
    adapter = AcousticAdapter(array, recording.sample_rate_hz, _Silent(), vision=vision)
    frames = adapter.front_end.process(recording.audio)
    stream = hop_stream((adapter.interpret(frame) for frame in frames), name=name)
    reference = np.array([_reference(frame, vision) for frame in frames])
    settings = recording.truth["settings"]
    approaches = settings["approach"] != NONE_APPROACH
    columns = {
        **{name: stream.columns[name] for name in ("time_s", "answer", "miss_rate", "clutter_rate")},
        "features": np.array([frame.feature for frame in frames]),
        "prominence": np.array([frame.srp.max() / np.median(frame.srp) for frame in frames]),
        "log_slope_hz": np.array([_log_slope(frame) for frame in frames]),
        "reference_rad": reference,
        "srp_rad": np.where(np.isfinite(reference), [frame.bearing_rad for frame in frames], np.nan),
        "music_rad": _music(recording, array, frames, np.isfinite(reference)),
    }
    about = {
        "site": settings["site"]["name"],
        "pass_s": pass_time_s(recording) if approaches else None,
        "doppler": _doppler(recording, array) if approaches else "no vehicle",
    }
    t0_s = recording.t0_frame / FRAME_RATE_HZ if approaches else np.nan
    return HopTable(columns, name, settings["approach"], t0_s, about)


def detection_log(recording: SimulatedRecording) -> DetectionLog:
    """Return the boxes of a simulated recording as the camera adapter reads them."""
    frames = [
        DetectionFrame(
            np.array([seen.box_px for seen in frame], dtype=np.float64).reshape(-1, 4),
            np.array([seen.score for seen in frame], dtype=np.float64),
            tuple(seen.label for seen in frame),
        )
        for frame in recording.detections
    ]
    return DetectionLog.at_rate(frames, FRAME_RATE_HZ)


def pass_time_s(recording: SimulatedRecording) -> float:
    """Return when the middle of the vehicle crosses the ego's axis; beyond the end at its last speed."""
    frames = recording.truth["frames"]
    heading = -1.0 if recording.truth["settings"]["approach"] == "left" else 1.0
    time = np.array([frame["time_s"] for frame in frames])
    done = heading * np.array([frame["position_m"][1] for frame in frames]) - 0.5 * LENGTH_M
    if done[-1] >= 0.0:
        return float(np.interp(0.0, done, time))
    return float(time[-1] - done[-1] / frames[-1]["speed_mps"])


def _reference(frame: AcousticFrame, vision: VisionQuery) -> float:
    """Azimuth of the moving box that is nearest to the acoustic bearing, NaN without one."""
    stamp = nanoseconds(seconds(frame.stamp_ns) - frame.bearing_age_s + NEAREST_S)
    moving = [seen.azimuth_rad for seen in vision.sightings(stamp) if seen.moving]
    return min(moving, key=lambda azimuth: abs(azimuth - frame.bearing_rad), default=np.nan)


def _log_slope(frame: AcousticFrame) -> float:
    return np.nan if isinstance(frame.looming, NotUsable) else frame.looming.log_slope_hz


def _doppler(recording: SimulatedRecording, array: MicrophoneArray) -> str:
    """Why the tone of the pass-by cannot be used, at the microphone nearest to the centre; else nothing."""
    middle = int(np.argmin(np.linalg.norm(array.centred_m, axis=1)))
    track = track_fundamental(recording.audio[:, middle], recording.sample_rate_hz)
    found = radial_speed(track, DOPPLER)
    return found.reason if isinstance(found, NotUsable) else ""


def _music(
    recording: SimulatedRecording, array: MicrophoneArray, frames: list[AcousticFrame], wanted: BoolArray
) -> FloatArray:
    """MUSIC bearings of the very samples that the SRP bearings were read from, NaN where not wanted."""
    chosen, rate = FrontEndSettings(), recording.sample_rate_hz
    bins = band_bins(chosen.srp_band_hz, rate, chosen.nfft)
    azimuths = chosen.azimuths_rad()
    steering = array.steering(bin_frequencies_hz(bins, rate, chosen.nfft), azimuths).astype(np.complex64)
    length = round(chosen.bearing_hops * rate / chosen.hop_rate_hz)
    bearings = np.full(len(frames), np.nan)
    with one_blas_thread():
        for i in np.flatnonzero(wanted):
            end = frames[i].sample_index
            stft = StreamingStft(array.n_microphones, chosen.nfft, bins)
            spectra = stft.push(recording.audio[max(end - length, 0) : end])
            bearings[i] = azimuths[music_spectrum(signal_subspace(spectra, 1), steering).argmax()]
    return bearings
