"""What a recording said at every hop, kept so that decisions can be tried on it again and again.

A hop stream is a `HopTable` with the columns of `STREAM_COLUMNS`.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from worldstate.abduction.co_evidence import Absent, CoEvidence, Present
from worldstate.ground.checks import finite_array
from worldstate.ground.errors import InputFileError, InvalidArgumentError
from worldstate.ground.values import NotUsable, seconds
from worldstate.measurement.measurement import Measurement

from .hop_table import HopTable, load_tables

HOP_S = 0.1
UNQUERIED, ABSENT, PRESENT = 0, 1, 2
STREAM_COLUMNS = (
    "time_s",  # End of each window, seconds from the start
    "log_likelihoods",  # shape (n, K + 2): Of hidden_1 .. hidden_K, visible, none; nats
    "answer",  # 0 unqueried, 1 absent, 2 present
    "miss_rate",  # Of the channel that was asked; 1 and 0 where none was
    "clutter_rate",
    "approach",  # 1/TTA over its standard deviation; NaN where not usable
    "seen",  # Whether a moving object was reported anywhere
    "there",  # Whether one was in view, by a reference where there is one: what a degraded camera may miss
)


def hop_stream(
    measurements: Iterable[Measurement],
    *,
    name: str,
    label: str = "none",
    t0_s: float | None = None,
    there: Sequence[bool] | None = None,
) -> HopTable:
    """Record what an adapter measured."""
    measured = list(measurements)
    if not measured:
        raise InvalidArgumentError(f"{name}: expected at least one hop, so at least one second of sound")
    seen = [any(sighting.moving for sighting in one.sightings) for one in measured]
    rows = (
        (
            seconds(one.stamp_ns),
            one.signature.log_likelihoods,
            *_answer(one.co_evidence),
            _approach(one),
            *flags,
        )
        for one, *flags in zip(measured, seen, seen if there is None else there, strict=True)
    )
    entry_s = float("nan") if t0_s is None else t0_s
    return HopTable.of_rows(STREAM_COLUMNS, rows).replace(name=name, label=label, t0_s=entry_s)


def load_streams(path: str | Path) -> list[HopTable]:
    """Read the hop streams that `save_tables` wrote, and check them: a user may bring them."""
    streams = load_tables(path, "hop streams", check=_check_stream)
    if not streams:
        raise InputFileError(path, "expected at least one hop stream")
    return streams


def _check_stream(stream: HopTable) -> None:
    if not set(STREAM_COLUMNS) <= set(stream.columns):
        raise InvalidArgumentError(f"expected the columns {', '.join(STREAM_COLUMNS)}")
    for name in ("time_s", "miss_rate", "clutter_rate"):
        finite_array(name, stream.columns[name], (None,))
    finite_array("log_likelihoods", stream.log_likelihoods, (None, None))
    if not np.isin(stream.answer, (UNQUERIED, ABSENT, PRESENT)).all():
        raise InvalidArgumentError("answer: expected 0 unqueried, 1 absent or 2 present")


def _answer(co_evidence: CoEvidence) -> tuple[int, float, float]:
    if isinstance(co_evidence, Absent | Present):
        answer = ABSENT if isinstance(co_evidence, Absent) else PRESENT
        return answer, co_evidence.miss_rate, co_evidence.clutter_rate
    return UNQUERIED, 1.0, 0.0


def _approach(measurement: Measurement) -> float:
    approach = measurement.approach
    return np.nan if isinstance(approach, NotUsable) else approach.inverse_tta_hz / approach.std_hz
