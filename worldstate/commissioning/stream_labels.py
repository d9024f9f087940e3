"""What the truth of a stream says of every hop and side, in the groups that a sequence model tells apart."""

from dataclasses import dataclass

import numpy as np

from worldstate.abduction.sequence.sequence_inputs import SIDES
from worldstate.abduction.sequence.sequence_model import COMING_S, GROUPS
from worldstate.ground.typing import BoolArray, FloatArray, IndexArray

from .heard_stream import HeardStream

# Hardly heard before they are seen: as hidden windows they would be wrong labels, as empty ones too.
SILENT_KINDS = ("bicycle", "scooter")
# Tyres of electric cars are learned from, but heard later than engines: an exam counts all of these apart.
QUIET_KINDS = (*SILENT_KINDS, "electric")
# Below it a vehicle is lost in the background of the simulated streets, some 50 dB at the array.
AUDIBLE_DB = 48.0
OTHER_SIDE_S = 3.0
ROW_S = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class StreamTruth:
    """Who is where at every hop of a stream; sides are left and right."""

    coming_s: FloatArray  # shape (n, 2): Seconds until the next one comes into view, infinite without
    seen: BoolArray  # shape (n,): Whether any is in view
    past_db: FloatArray  # shape (n, 2): Loudest that has left the view into this side
    far_db: FloatArray  # shape (n, 2): Loudest that never comes into view, or not yet and not from here
    far_rises: BoolArray  # shape (n, 2): Whether that one grows louder

    def groups(self) -> IndexArray:
        """Return the number of the group of every hop and side, shape (n, 2)."""
        nearest = np.searchsorted(COMING_S, self.coming_s, side="left")
        coming = self.coming_s <= COMING_S[-1]
        # In the order in which they count: who comes is told even while another one is in view.
        conditions = {
            "seen": np.broadcast_to(self.seen[:, None], coming.shape),
            "other": self.coming_s[:, ::-1] <= OTHER_SIDE_S,
            "past": self.past_db >= np.maximum(self.far_db, AUDIBLE_DB),
            "rising": (self.far_db >= AUDIBLE_DB) & self.far_rises,
            "falling": self.far_db >= AUDIBLE_DB,
        }
        numbers = [GROUPS.index(name) for name in conditions]
        rest = np.select(list(conditions.values()), numbers, GROUPS.index("none"))
        return np.where(coming, nearest, rest)


def stream_truth(heard: HeardStream) -> StreamTruth:
    """Collect the rows of all vehicles at the hops of a stream."""
    time_s, n = heard.hops.time_s, len(heard.hops)
    coming_s = np.full((n, len(SIDES)), np.inf)
    past_db, far_db = np.full((2, n, len(SIDES)), -np.inf)
    rises, seen = np.zeros((n, len(SIDES)), bool), np.zeros(n, bool)
    vehicles, rows = heard.vehicles, heard.rows
    hop_of = np.round((rows.time_s - time_s[0]) / ROW_S).astype(np.intp)
    inside = (hop_of >= 0) & (hop_of < n)
    for i, number in enumerate(vehicles.vehicle):
        mine = inside & (rows.vehicle == number)
        hop, loudness = hop_of[mine], rows.loudness_db[mine]
        if not hop.size:
            continue
        arm, entry_s, louder = (
            SIDES.index(vehicles.arm[i]),
            vehicles.entry_s[i],
            np.diff(loudness, prepend=loudness[0]) > 0,
        )
        before, in_view = ~(time_s[hop] > entry_s + ROW_S / 100), rows.in_view[mine]
        seen[hop[in_view]] = True
        if vehicles.hazard[i]:
            left_s = entry_s - time_s[hop[before]]
            coming_s[hop[before], arm] = np.minimum(coming_s[hop[before], arm], left_s)
        gone = ~in_view & ~before
        into = (rows.y_m[mine][gone] < 0.0).astype(np.intp)
        np.maximum.at(past_db, (hop[gone], into), loudness[gone])
        elsewhere = ~in_view & before
        at = hop[elsewhere]
        wins = loudness[elsewhere] > far_db[at, arm]
        far_db[at[wins], arm], rises[at[wins], arm] = loudness[elsewhere][wins], louder[elsewhere][wins]
    return StreamTruth(coming_s, seen, past_db, far_db, rises)
