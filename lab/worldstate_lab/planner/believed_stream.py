"""What the filter said of a stream, hop by hop, with the vehicles that were there; kept once followed."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from worldstate.abduction.sequence.sequence_inputs import SIDES
from worldstate.adapters.files.model_file import Model, model_to_dict
from worldstate.commissioning.heard_stream import HeardStream
from worldstate.commissioning.plan import junction_named
from worldstate.ground.typing import BoolArray, FloatArray, IndexArray
from worldstate.operations.recordings.hop_table import HopTable
from worldstate.simulation.scene.junction import Site
from worldstate.simulation.scene.kinds import vehicle_kind
from worldstate_lab.passes.world_exam import passed_stream
from worldstate_lab.trials.pass_cache import PassCache, content_hash

GONE_M = -1e3
_CHANCES = "chances"
_SPEED_ROWS = 5


@dataclass(frozen=True, slots=True, eq=False)
class Crossing:
    """How a vehicle out of a hidden arm crosses the ego's axis, tenth of a second by tenth."""

    side: int
    entry_s: float
    length_m: float
    width_m: float
    time_s: FloatArray  # shape (r,)
    to_come_m: FloatArray  # shape (r,): Of its front to the axis, negative behind it
    in_view: BoolArray  # shape (r,): From where the state was recorded

    def at(self, clock_s: FloatArray) -> FloatArray:
        """Return the way to come at some times; before its first row it came as fast as it is there."""
        last = min(_SPEED_ROWS, len(self.time_s) - 1)
        speed = (self.to_come_m[0] - self.to_come_m[last]) / max(self.time_s[last] - self.time_s[0], 0.1)
        early = np.maximum(self.time_s[0] - clock_s, 0.0)
        return np.asarray(np.interp(clock_s, self.time_s, self.to_come_m, right=GONE_M) + speed * early)

    def seen(self, clock_s: FloatArray) -> BoolArray:
        """Tell when it is in view."""
        row = np.searchsorted(self.time_s, clock_s + 1e-6, side="right") - 1
        return np.asarray(self.in_view[np.maximum(row, 0)] & (row >= 0) & (clock_s <= self.time_s[-1]))


@dataclass(frozen=True, slots=True, eq=False)
class BelievedStream:
    """The chances that a stream's snapshots state, and who was there; sides are left and right."""

    time_s: FloatArray  # shape (n,)
    within: FloatArray  # shape (n, 2, horizons): Probability to come into view within each horizon
    heard: HeardStream
    site: Site
    ways: tuple[Crossing, ...]  # Of those who come out of a hidden arm
    others: IndexArray  # Numbers of everybody else


def believed_stream(path: Path, model: Model, cache: Path | None) -> BelievedStream:
    """Return a stream with its chances, kept in a folder by the content of stream and model."""
    follow = partial(_chances, path, model)
    if cache is None:
        return with_chances(HeardStream.load(path), follow()[_CHANCES])
    # The filter's own code is no part of the name: after a change of it another folder is due.
    marks = [content_hash(path), model_to_dict(model)]
    return with_chances(HeardStream.load(path), PassCache(cache).tables(_CHANCES, marks, follow)[_CHANCES])


def _chances(path: Path, model: Model) -> dict[str, HopTable]:
    followed = passed_stream(path, model).followed
    return {_CHANCES: HopTable({"time_s": followed.time_s, "within": followed.within.astype(np.float32)})}


def with_chances(heard: HeardStream, chances: HopTable) -> BelievedStream:
    """Return a stream with what was said of it; where nothing was said the chance is one."""
    return BelievedStream(
        time_s=chances.time_s,
        within=np.nan_to_num(chances.within, nan=1.0),
        heard=heard,
        site=junction_named(heard.site),
        ways=tuple(_way(heard, i) for i in np.flatnonzero(heard.vehicles.hazard).tolist()),
        others=heard.vehicles.vehicle[~heard.vehicles.hazard],
    )


def _way(heard: HeardStream, i: int) -> Crossing:
    vehicles, rows = heard.vehicles, heard.rows
    mine, kind = rows.vehicle == vehicles.vehicle[i], vehicle_kind(str(vehicles.kind[i]))
    side = SIDES.index(vehicles.arm[i])
    return Crossing(
        side=side,
        entry_s=float(vehicles.entry_s[i]),
        length_m=kind.length_m,
        width_m=kind.width_m,
        time_s=rows.time_s[mine],
        # Rows hold the front axle, and left is positive.
        to_come_m=(1.0 - 2.0 * side) * rows.y_m[mine] - kind.axles_m[0],
        in_view=rows.in_view[mine].astype(np.bool_),
    )
