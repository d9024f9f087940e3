"""What is kept of a recording whose camera was staged in several states: a few numbers a hop and state."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from worldstate.adapters.atomic import atomic_path
from worldstate.checks import check_shape, finite_array
from worldstate.errors import InputFileError, InvalidArgumentError
from worldstate.evaluation.hop_stream import HopStream

MAX_BYTES = 64 << 20
# States that every sweep has: the camera as it is, and no camera at all.
CLEAN, OFF = "clean", "off"

Numbers = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class StagedRecording:
    """One recording in S states of its camera, n hops each.

    Parameters
    ----------
    name, label : str
        Of the recording; label ``"none"`` where it is hazard-free.
    t0_s : float
        Line-of-sight entry; NaN where there is none.
    states : tuple of str
        Names of the states.
    time_s : ndarray, shape (n,)
        End of each window.
    there : ndarray of bool, shape (n,)
        Whether a moving object is in view, by the reference.
    approach : ndarray, shape (n,)
        As in `HopStream`.
    log_likelihoods : ndarray, shape (n, K + 2)
        As in `HopStream`.
    answer, miss_rate, clutter_rate, seen : ndarray, shape (S, n)
        As in `HopStream`.
    degradation : ndarray, shape (S, n)
        d as it was estimated.
    presence : ndarray, shape (S, n)
        P(hidden) + P(visible) of the filter.

    Raises
    ------
    InvalidArgumentError
        If shapes do not agree, or a state of that name is asked for and there is none.
    """

    name: str
    label: str
    t0_s: float
    states: tuple[str, ...]
    time_s: Numbers
    there: NDArray[np.bool_]
    approach: Numbers
    log_likelihoods: Numbers
    answer: NDArray[np.int64]
    miss_rate: Numbers
    clutter_rate: Numbers
    seen: NDArray[np.bool_]
    degradation: Numbers
    presence: Numbers

    def __post_init__(self) -> None:
        shape = len(self.states), np.size(self.time_s)
        for name in _BY_STATE:
            check_shape(name, np.shape(getattr(self, name)), shape)
        for name in ("degradation", "presence"):
            finite_array(name, getattr(self, name), shape)
        for i in range(len(self.states)):
            self._stream(i)  # which checks the rest

    @classmethod
    def of(
        cls, streams: Sequence[HopStream], states: Sequence[str], degradation: Numbers, presence: Numbers
    ) -> "StagedRecording":
        """Return the streams of one recording, one a state, in one piece.

        Raises
        ------
        InvalidArgumentError
            If there is none.
        """
        if not streams:
            raise InvalidArgumentError("streams: expected at least one state")
        first = streams[0]
        return cls(
            name=first.name,
            label=first.label,
            t0_s=first.t0_s,
            states=tuple(states),
            **{name: getattr(first, name) for name in _SHARED},
            **{name: np.stack([getattr(stream, name) for stream in streams]) for name in _STACKED},
            degradation=degradation,
            presence=presence,
        )

    @property
    def hazard_free(self) -> bool:
        """Whether nothing approaches."""
        return self.label == "none"

    def index(self, state: str) -> int:
        """Return the row of a state.

        Raises
        ------
        InvalidArgumentError
            If there is no such state.
        """
        if state not in self.states:
            raise InvalidArgumentError(f"state: expected one of {', '.join(self.states)}, got {state:.40}")
        return self.states.index(state)

    def stream(self, state: str) -> HopStream:
        """Return the stream of one state."""
        return self._stream(self.index(state))

    @property
    def after_sight(self) -> NDArray[np.bool_]:
        """Hops after T0 with the vehicle in view, shape (n,)."""
        stream = self._stream(0)
        return np.asarray(stream.there & ~stream.before_sight) & (not self.hazard_free)

    def _stream(self, row: int) -> HopStream:
        return HopStream(
            name=self.name,
            label=self.label,
            t0_s=self.t0_s,
            **{name: getattr(self, name) for name in _SHARED},
            **{name: getattr(self, name)[row] for name in _STACKED},
        )


_TEXTS = ("name", "label")
_SHARED = ("time_s", "there", "approach", "log_likelihoods")
_STACKED = ("answer", "miss_rate", "clutter_rate", "seen")
_BY_STATE = (*_STACKED, "degradation", "presence")
_ARRAYS = tuple(
    field.name for field in fields(StagedRecording) if field.name not in (*_TEXTS, "t0_s", "states")
)


def save_staged(path: str | Path, recording: StagedRecording, origin: str) -> None:
    """Write a recording as npz without objects, whole or not at all.

    Parameters
    ----------
    path : str or Path
        In an existing folder.
    recording : StagedRecording
        What to keep.
    origin : str
        What it was made by; `load_staged` takes it back for the same origin only.

    Raises
    ------
    InputFileError
        If the folder is missing.
    """
    values = {name: np.array(getattr(recording, name)) for name in (*_TEXTS, "t0_s", "states", *_ARRAYS)}
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, origin=np.array(origin), **values)  # type: ignore[arg-type]


def load_staged(path: str | Path, origin: str) -> StagedRecording | None:
    """Return what `save_staged` wrote; None where nothing of this origin stands there.

    Raises
    ------
    InputFileError
        If the file is too large or damaged.
    """
    source = Path(path)
    if not source.is_file():
        return None
    if source.stat().st_size > MAX_BYTES:
        raise InputFileError(path, f"expected a staged recording of at most {MAX_BYTES >> 20} MiB")
    try:
        with np.load(source, allow_pickle=False) as file:
            values = {name: file[name] for name in file.files}
        return _read(values) if str(values["origin"]) == origin else None
    except (OSError, InvalidArgumentError) as error:
        raise InputFileError(path, f"expected a staged recording ({error})") from error
    except Exception as error:  # zipfile, zlib and numpy each have errors of their own for damaged bytes
        raise InputFileError(path, f"expected a staged recording, it does not read: {error}") from error


def _read(values: dict[str, np.ndarray]) -> StagedRecording:
    return StagedRecording(
        name=str(values["name"]),
        label=str(values["label"]),
        t0_s=float(values["t0_s"]),
        states=tuple(values["states"].tolist()),
        **{name: values[name] for name in _ARRAYS},
    )
