"""What is kept of one recording of the twin: a few numbers a hop, on disk for the next run.

What was heard is kept, not what a classifier made of it: another classifier judges the same files.
"""

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from worldstate.abduction.signature.ensemble import EnsembleModel
from worldstate.abduction.signature.signature_io import AnySignature
from worldstate.abduction.signature.site_signature import SiteSignature
from worldstate.adapters.datasets.feature_table import N_FEATURES
from worldstate.adapters.files.npz_file import load_npz, save_npz
from worldstate.ground.checks import check_shape
from worldstate.ground.typing import BoolArray, FloatArray, IntArray
from worldstate.operations.recordings.hop_stream import HopStream
from worldstate.operations.recordings.stream_statistic import stream_statistic

MAX_BYTES = 16 << 20
DIRECTION_COLUMNS = slice(0, 2)
NONE_APPROACH = "none"


@dataclass(frozen=True, slots=True, eq=False)
class TwinRecording:
    """One simulated recording as it was heard.

    Examples
    --------
    >>> recording = TwinRecording.blank("2_00_0001", hops=3)
    >>> recording.hazard_free, recording.before_sight().any()
    (True, np.False_)
    """

    name: str  # As in ``DataLog.csv``
    site: str  # Junction; "left", "right" or "none"
    approach: str
    # Line-of-sight entry, and when the vehicle's middle crosses the ego's axis; NaN without a vehicle.
    t0_s: float
    pass_s: float
    doppler: str  # Why the tonal Doppler of the pass-by is not usable; empty where it is
    time_s: FloatArray  # shape (n,): End of each window
    features: FloatArray  # shape (n, 60): Published feature of the window
    answer: IntArray  # shape (n,)
    miss_rate: FloatArray  # shape (n,): Of the camera: see `HopStream`
    clutter_rate: FloatArray
    prominence: FloatArray  # shape (n,): Peak-to-median ratio of the spatial spectrum of the window
    log_slope_hz: FloatArray  # shape (n,): Looming slope of log energy; NaN where not usable
    # shape (n,): Azimuth of the camera's moving box and the two acoustic bearings; NaN where no box is
    # there.
    reference_rad: FloatArray
    srp_rad: FloatArray
    music_rad: FloatArray
    # shape (n, 4): Of hidden left, hidden right, visible and none at the classifier's own prior, by the
    # signature alone; equal until `judged`.
    posteriors: FloatArray
    # shape (n,): Eq. (6) at that prior with the camera's answer; zero until `judged`.
    statistic: FloatArray

    def __post_init__(self) -> None:
        n = np.size(self.time_s)
        wide = {"posteriors": (n, 4), "features": (n, N_FEATURES)}
        for name in (*_HEARD, *_JUDGED):
            check_shape(name, np.shape(getattr(self, name)), wide.get(name, (n,)))

    @property
    def hazard_free(self) -> bool:
        """Whether nothing approaches."""
        return self.approach == NONE_APPROACH

    @property
    def published_statistic(self) -> FloatArray:
        """The paper's s(t) = P_left + P_right, shape (n,)."""
        return np.asarray(self.posteriors[:, DIRECTION_COLUMNS].sum(axis=1))

    @property
    def argmax_hazard(self) -> BoolArray:
        """Where the likeliest class is left or right, shape (n,)."""
        return np.asarray(self.posteriors.argmax(axis=1) < DIRECTION_COLUMNS.stop)

    def judged(self, signature: AnySignature) -> "TwinRecording":
        """Return the recording as a classifier hears it; one that learns its site learns it anew."""
        listening = SiteSignature(signature) if isinstance(signature, EnsembleModel) else signature
        evidence = [listening.evidence(feature) for feature in self.features]
        stream = replace(
            HopStream.blank(self.name, len(self.time_s)),
            log_likelihoods=np.stack([one.log_likelihoods for one in evidence]),
            answer=self.answer,
            miss_rate=self.miss_rate,
            clutter_rate=self.clutter_rate,
        )
        joint = stream.log_likelihoods + np.log(signature.reference_prior)
        return replace(
            self,
            posteriors=np.exp(joint - np.logaddexp.reduce(joint, axis=1, keepdims=True)),
            statistic=stream_statistic(stream, signature.reference_prior),
        )

    def before_sight(self, horizon_s: float = np.inf) -> BoolArray:
        """Windows that end within `horizon_s` before T0, T0 included, shape (n,); none without a vehicle."""
        left_s = self.t0_s - self.time_s
        return np.asarray((left_s >= -1e-6) & (left_s <= horizon_s + 1e-6))

    @classmethod
    def blank(cls, name: str, hops: int) -> "TwinRecording":
        """Return a hazard-free recording that says nothing, to be filled with `dataclasses.replace`."""
        flat, unknown = np.zeros(hops), np.full(hops, np.nan)
        return cls(
            name=name,
            site="SA1",
            approach=NONE_APPROACH,
            t0_s=np.nan,
            pass_s=np.nan,
            doppler="no vehicle",
            time_s=1.0 + 0.1 * np.arange(hops, dtype=np.float64),
            features=np.zeros((hops, N_FEATURES)),
            answer=np.zeros(hops, dtype=np.int64),
            miss_rate=flat + 1.0,
            clutter_rate=flat,
            prominence=flat + 1.0,
            log_slope_hz=unknown,
            reference_rad=unknown,
            srp_rad=unknown,
            music_rad=unknown,
            posteriors=np.full((hops, 4), 0.25),
            statistic=flat,
        )


_TEXTS = ("name", "site", "approach", "doppler")
_SCALARS = ("t0_s", "pass_s")
_JUDGED = ("posteriors", "statistic")
_HEARD = tuple(f.name for f in fields(TwinRecording) if f.name not in (*_TEXTS, *_SCALARS, *_JUDGED))


def save_twin(path: str | Path, recording: TwinRecording, origin: str) -> None:
    """Write what was heard of a recording as npz without objects, whole or not at all."""
    values = {name: np.array(getattr(recording, name)) for name in (*_TEXTS, *_SCALARS, *_HEARD)}
    save_npz(path, {"origin": np.array(origin), **values})


def load_twin(path: str | Path, origin: str) -> TwinRecording | None:
    """Return what `save_twin` wrote, not yet judged; None where nothing of this origin stands there.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     save_twin(Path(folder) / "a.npz", TwinRecording.blank("a", 2), origin="seed 1")
    ...     kept, other = (load_twin(Path(folder) / "a.npz", origin) for origin in ("seed 1", "seed 2"))
    >>> kept.name, kept.time_s, other
    ('a', array([1. , 1.1]), None)
    """
    if not Path(path).is_file():
        return None
    return load_npz(path, "recordings of the twin", MAX_BYTES, lambda values: _read(values, origin))


def _read(values: dict[str, np.ndarray], origin: str) -> TwinRecording | None:
    if str(values.get("origin")) != origin:
        return None
    known: dict[str, Any] = {name: str(values[name]) for name in _TEXTS}
    known |= {name: float(values[name]) for name in _SCALARS}
    known |= {name: values[name] for name in _HEARD}
    n = len(known["time_s"])
    return TwinRecording(**known, posteriors=np.full((n, 4), 0.25), statistic=np.zeros(n))
