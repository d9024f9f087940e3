"""Passes before two junctions: as recorded, as simulated, and what is expected of them.

The junctions and the array are those of M. Jeon et al., "Non-Line-of-Sight Vehicle Localization Based on
Sound", IEEE Transactions on Intelligent Transportation Systems, 2025: facts of the publication's maps. How
far ahead vehicles cross follows from where they come into view, 4.5 m and 4.0 m aside.

Columns of a table of spatial spectra, one row a hop: ``time_s``, ``x_m`` (along the crossing street, right
positive; may be empty) and ``srp_0`` to ``srp_179``, the steered response on `numpy.linspace(-90, 90, 180)`
degrees, right positive.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType

import numpy as np

from worldstate.adapters.files.text_file import number, read_rows
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.frontend.array.steering import Steering
from worldstate.frontend.direction.srp import srp_phat
from worldstate.frontend.spectra.stft import StreamingStft
from worldstate.ground.errors import InputFileError
from worldstate.ground.typing import Float32Array, FloatArray
from worldstate.simulation.dataset.recording import simulate_recording
from worldstate.simulation.scene.junction import Site
from worldstate.simulation.scene.settings import SimulationSettings

from .spectrum_model import SpectrumModel, StreetWalls

N_AZIMUTHS = 180
AZIMUTHS_RAD = np.radians(np.linspace(90.0, -90.0, N_AZIMUTHS))  # Of the columns, left positive
_COLUMNS = tuple(f"srp_{i}" for i in range(N_AZIMUTHS))
_ASIDE_M, _AHEAD_M = (0.338, 0.162, -0.162, -0.338), (-0.192, -0.06, 0.06, 0.192)
ROOF_ARRAY = MicrophoneArray(np.array([[x, y, 0.0] for x in _AHEAD_M for y in _ASIDE_M]), "roof array of 16")
# 50 to 2000 Hz of frames of 512 samples at 48 kHz, and of 64 at 6 kHz, at which passes are simulated.
RATE_HZ, NFFT, BINS = 6000.0, 64, range(1, 22)
FREQUENCIES_HZ: FloatArray = np.array(BINS) * RATE_HZ / NFFT
HOP_S = 0.1
# The truth of a simulation is the front bumper; real places are the middle of the car.
HALF_LENGTH_M = 2.0
WALLS: Mapping[str, StreetWalls] = MappingProxyType(
    {
        "Site1": StreetWalls(4.45, 2.8, 2.8, 7.15, facing_m=9.9),
        "Site2": StreetWalls(4.5, 2.78, 2.78, 6.5),
    }
)
# Both lanes lie .75 m beside the middle that the model is given.
SIMULATED: Mapping[str, Site] = MappingProxyType(
    {
        "Site1": Site("Site1", 2.8, 2.8, 4.45, 9.9, 2.8, 2.8, 3.0, verge_m=1.2, side_order=8),
        "Site2": Site("Site2", 2.78, 2.78, 4.5, None, 2.78, 2.78, 3.0, verge_m=0.5, side_order=8),
    }
)


@dataclass(frozen=True, slots=True, eq=False)
class SpectrumTable:
    """Spatial spectra of one recording, with the place of the vehicle where it is known."""

    time_s: FloatArray  # shape (T,)
    along_m: FloatArray  # shape (T,): Left positive; NaN where it is unknown
    spectra: FloatArray  # shape (T, N_AZIMUTHS)


def place_models() -> dict[str, SpectrumModel]:
    """Return what is expected at both junctions."""
    return {
        name: SpectrumModel.of(walls, ROOF_ARRAY, AZIMUTHS_RAD, FREQUENCIES_HZ)
        for name, walls in WALLS.items()
    }


def read_spectra(path: Path) -> SpectrumTable:
    r"""Read one recording; `InputFileError` where a column is missing or a number is none.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     table = Path(folder) / "pass.csv"
    ...     _ = table.write_text(f"time_s,x_m,{','.join(_COLUMNS)}\n0,2.5{',0.1' * N_AZIMUTHS}\n")
    ...     read_spectra(table).along_m
    array([-2.5])
    """
    rows = list(read_rows(path, ("time_s", "x_m", *_COLUMNS)))
    if not rows:
        raise InputFileError(path, "expected at least one row")
    return SpectrumTable(
        np.array([number(path, line, row, "time_s") for line, row in rows]),
        np.array([-number(path, line, row, "x_m") if row["x_m"] else np.nan for line, row in rows]),
        np.array([[number(path, line, row, name) for name in _COLUMNS] for line, row in rows]),
    )


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
