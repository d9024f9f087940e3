"""What a recording said at every hop, kept so that decisions can be tried on it again and again."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from worldstate.abduction.co_evidence import Absent, CoEvidence, Present
from worldstate.adapters.files.npz_file import load_npz, save_npz
from worldstate.ground.checks import check_shape, finite_array
from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.typing import BoolArray, FloatArray, IntArray
from worldstate.ground.values import NotUsable, seconds
from worldstate.measurement.measurement import Measurement

HOP_S = 0.1
UNQUERIED, ABSENT, PRESENT = 0, 1, 2
MAX_BYTES = 512 << 20
MAX_STREAMS = 100_000
VERSION = 1


@dataclass(frozen=True, slots=True, eq=False)
class HopStream:
    """One recording, one row a hop.

    Parameters
    ----------
    name : str
        Of the recording.
    label : str
        Side that a vehicle comes from, or ``"none"`` for a hazard-free recording.
    t0_s : float
        Line-of-sight entry; NaN where there is none or it is not known.
    time_s : ndarray, shape (n,)
        End of each window, seconds from the start.
    log_likelihoods : ndarray, shape (n, K + 2)
        Of hidden_1 .. hidden_K, visible, none; nats.
    answer : ndarray of int, shape (n,)
        0 unqueried, 1 absent, 2 present.
    miss_rate, clutter_rate : ndarray, shape (n,)
        Of the channel that was asked; 1 and 0 where none was.
    approach : ndarray, shape (n,)
        1/TTA over its standard deviation; NaN where not usable.
    seen : ndarray of bool, shape (n,)
        Whether a moving object was reported anywhere.
    there : ndarray of bool, shape (n,)
        Whether one was in view, by a reference where there is one: what a degraded camera may miss.

    Raises
    ------
    InvalidArgumentError
        If shapes do not agree or a number that may not be is not finite.

    Examples
    --------
    >>> quiet = HopStream.blank("SA1/0", hops=3)
    >>> len(quiet), quiet.hazard_free
    (3, True)
    """

    name: str
    label: str
    t0_s: float
    time_s: FloatArray
    log_likelihoods: FloatArray
    answer: IntArray
    miss_rate: FloatArray
    clutter_rate: FloatArray
    approach: FloatArray
    seen: BoolArray
    there: BoolArray

    def __post_init__(self) -> None:
        n = np.size(self.time_s)
        for name in ("time_s", "miss_rate", "clutter_rate"):
            finite_array(name, getattr(self, name), (n,))
        finite_array("log_likelihoods", self.log_likelihoods, (n, None))
        for name in ("answer", "approach", "seen", "there"):
            check_shape(name, np.shape(getattr(self, name)), (n,))
        if not np.isin(self.answer, (UNQUERIED, ABSENT, PRESENT)).all():
            raise InvalidArgumentError("answer: expected 0 unqueried, 1 absent or 2 present")

    def __len__(self) -> int:
        return int(self.time_s.size)

    @property
    def hazard_free(self) -> bool:
        """Whether nothing approaches in this recording."""
        return self.label == "none"

    @property
    def before_sight(self) -> BoolArray:
        """Windows of an approach that end at or before T0, shape (n,); none where T0 is not known."""
        return np.asarray(self.time_s <= self.t0_s + 1e-6) & (not self.hazard_free)

    @classmethod
    def blank(cls, name: str, hops: int, directions: int = 2) -> "HopStream":
        """Return a hazard-free stream that says nothing, to be filled with `dataclasses.replace`."""
        return cls(
            name=name,
            label="none",
            t0_s=float("nan"),
            time_s=1.0 + HOP_S * np.arange(hops, dtype=np.float64),
            log_likelihoods=np.zeros((hops, directions + 2)),
            answer=np.zeros(hops, dtype=np.int64),
            miss_rate=np.ones(hops),
            clutter_rate=np.zeros(hops),
            approach=np.full(hops, np.nan),
            seen=np.zeros(hops, dtype=bool),
            there=np.zeros(hops, dtype=bool),
        )


_ARRAYS = tuple(field.name for field in fields(HopStream) if field.name not in ("name", "label", "t0_s"))


def hop_stream(
    measurements: Iterable[Measurement],
    *,
    name: str,
    label: str = "none",
    t0_s: float | None = None,
    there: Sequence[bool] | None = None,
) -> HopStream:
    """Record what an adapter measured."""
    rows = list(measurements)
    if not rows:
        raise InvalidArgumentError(f"{name}: expected at least one hop, so at least one second of sound")
    seen = np.array([any(sighting.moving for sighting in row.sightings) for row in rows])
    answers = np.array([_answer(row.co_evidence) for row in rows])
    return HopStream(
        name=name,
        label=label,
        t0_s=float("nan") if t0_s is None else t0_s,
        time_s=np.array([seconds(row.stamp_ns) for row in rows]),
        log_likelihoods=np.stack([row.signature.log_likelihoods for row in rows]),
        answer=answers[:, 0].astype(np.int64),
        miss_rate=answers[:, 1],
        clutter_rate=answers[:, 2],
        approach=np.array([_approach(row) for row in rows]),
        seen=seen,
        there=seen if there is None else np.array(there, dtype=bool),
    )


def save_streams(path: str | Path, streams: Iterable[HopStream]) -> None:
    """Write streams as npz without objects, whole or not at all."""
    kept = list(streams)
    arrays = {name: np.concatenate([getattr(stream, name) for stream in kept]) for name in _ARRAYS}
    save_npz(
        path,
        {
            "version": np.array(VERSION),
            "names": np.array([stream.name for stream in kept]),
            "labels": np.array([stream.label for stream in kept]),
            "t0_s": np.array([stream.t0_s for stream in kept]),
            "hops": np.array([len(stream) for stream in kept]),
            **arrays,
        },
    )


def load_streams(path: str | Path) -> list[HopStream]:
    """Read what `save_streams` wrote.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     save_streams(Path(folder) / "s.npz", [HopStream.blank("a", 3), HopStream.blank("b", 2)])
    ...     [(stream.name, len(stream)) for stream in load_streams(Path(folder) / "s.npz")]
    [('a', 3), ('b', 2)]
    """
    return load_npz(path, "hop streams", MAX_BYTES, _streams)


def _streams(arrays: dict[str, np.ndarray]) -> list[HopStream]:
    if int(arrays["version"]) != VERSION:
        raise InvalidArgumentError(f"version: expected {VERSION}, got {int(arrays['version'])}")
    hops = arrays["hops"].astype(np.int64)
    if hops.size > MAX_STREAMS:
        raise InvalidArgumentError(f"hops: expected at most {MAX_STREAMS} streams, got {hops.size}")
    check_shape("names", arrays["names"].shape, (hops.size,))
    if (hops < 0).any() or hops.sum() != len(arrays["time_s"]):
        raise InvalidArgumentError("hops: expected counts that sum to the number of rows")
    parts = {name: np.split(arrays[name], np.cumsum(hops)[:-1]) for name in _ARRAYS}
    return [
        HopStream(
            name=str(arrays["names"][i]),
            label=str(arrays["labels"][i]),
            t0_s=float(arrays["t0_s"][i]),
            **{name: parts[name][i] for name in _ARRAYS},
        )
        for i in range(hops.size)
    ]


def _answer(co_evidence: CoEvidence) -> tuple[float, float, float]:
    if isinstance(co_evidence, Absent):
        return ABSENT, co_evidence.miss_rate, co_evidence.clutter_rate
    if isinstance(co_evidence, Present):
        return PRESENT, co_evidence.miss_rate, co_evidence.clutter_rate
    return UNQUERIED, 1.0, 0.0


def _approach(measurement: Measurement) -> float:
    approach = measurement.approach
    return np.nan if isinstance(approach, NotUsable) else approach.inverse_tta_hz / approach.std_hz
