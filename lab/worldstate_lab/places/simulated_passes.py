"""Simulated passes before the two junctions, as spatial spectra with the place of the vehicle."""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from worldstate.frontend.array.steering import Steering
from worldstate.frontend.direction.srp import srp_phat
from worldstate.frontend.spectra.stft import StreamingStft
from worldstate.ground.typing import Float32Array, FloatArray
from worldstate.simulation.dataset.recording import simulate_recording
from worldstate.simulation.scene.settings import SimulationSettings

from .junctions import BINS, FREQUENCIES_HZ, NFFT, RATE_HZ, ROOF_ARRAY, SIMULATED
from .spatial_spectra import AZIMUTHS_RAD, SpectrumTable

HOP_S = 0.1
# The truth of a simulation is the front bumper; real places are the middle of the car.
HALF_LENGTH_M = 2.0


def simulated_pass(site: str, rng: np.random.Generator) -> tuple[str, SpectrumTable]:
    """Draw and render one pass; return the side that it comes from and its spectra."""
    side = ("left", "right")[int(rng.integers(2))]
    speed = rng.uniform(2.0, 7.0)
    duration = float(np.clip(rng.uniform(18.0, 30.0) / speed, 4.0, 14.0))
    entry = duration * rng.uniform(0.25, 0.5)
    plan = replace(
        SIMULATED[site],
        side_reflection=rng.uniform(0.7, 0.97),
        facade_reflection=rng.uniform(0.6, 0.97),
        surface_db=rng.uniform(0.0, 10.0),
    )
    settings = SimulationSettings(plan, side, duration, entry, speed, sample_rate_hz=RATE_HZ)
    recording = simulate_recording(settings, rng, ROOF_ARRAY)
    spectra = _spectra(recording.audio)
    front = np.array([frame["position_m"][1] for frame in recording.truth["frames"]])[: len(spectra)]
    along = front + HALF_LENGTH_M * (1.0 if side == "left" else -1.0)
    return side, SpectrumTable(HOP_S * np.arange(1.0, len(along) + 1.0), along, spectra[: len(along)])


def _spectra(audio: Float32Array) -> FloatArray:
    """SRP-PHAT of every hop by itself, shape (hops, azimuths)."""
    steering = Steering.towards(ROOF_ARRAY, FREQUENCIES_HZ, AZIMUTHS_RAD)
    frames = StreamingStft(ROOF_ARRAY.n_microphones, NFFT, BINS).push(audio)
    hop = round(RATE_HZ * HOP_S)
    ends = NFFT + np.arange(len(frames)) * (NFFT // 2)
    edges = np.searchsorted(ends, np.arange(len(audio) // hop + 1) * hop, side="right")
    return np.array([srp_phat(frames[a:b], steering) for a, b in pairwise(edges)])
