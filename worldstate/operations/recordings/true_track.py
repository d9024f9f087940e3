"""Where the vehicles of a simulated recording really were, from its truth.json."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from worldstate.adapters.datasets.ovad import TRUTH_NAME
from worldstate.ground.errors import InputFileError
from worldstate.ground.typing import BoolArray, FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class TrueTrack:
    """True azimuth and place of one vehicle over time, and when it was in line of sight."""

    time_s: FloatArray  # shape (n,): Camera frames, seconds from the start of the recording
    azimuth_rad: FloatArray  # shape (n,): Left positive
    in_view: BoolArray  # shape (n,): Line of sight between camera and vehicle
    position_m: FloatArray  # shape (n, 2): Middle of its front, x ahead and y left of the array

    @property
    def visible_s(self) -> tuple[float, float] | None:
        """First and last time in line of sight; None where the vehicle never is."""
        seen = self.time_s[self.in_view]
        return (float(seen[0]), float(seen[-1])) if seen.size else None


def read_true_tracks(folder: Path) -> tuple[TrueTrack, ...]:
    """Read the tracks of all vehicles, none where the recording is not a simulated one."""
    path = folder / TRUTH_NAME
    if not path.is_file():
        return ()
    try:
        truth = json.loads(path.read_text(encoding="utf-8"))
        vehicles = [rows for rows in (truth["frames"], *truth.get("others", ())) if rows]
        return tuple(map(_track, vehicles))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputFileError(path, f"expected the truth of a simulated recording: {error!r}") from error


def _track(rows: list[dict[str, Any]]) -> TrueTrack:
    columns = [[row[key] for row in rows] for key in ("time_s", "azimuth_rad", "line_of_sight")]
    time_s, azimuth_rad, in_view = np.array(columns, dtype=np.float64)
    return TrueTrack(time_s, azimuth_rad, in_view > 0.5, np.array([row["position_m"] for row in rows]))
