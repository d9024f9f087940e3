"""Which recordings a sweep takes, and what is missing for one."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from worldstate.adapters.camera.video import VIDEO_NAME
from worldstate.adapters.datasets.ovad import Recording

# Of each kind: with fewer, no recording is left to set thresholds and miss rates on.
LEAST = 2


@dataclass(frozen=True, slots=True)
class SweepData:
    """Recordings of a sweep, and in words what there ought to be more of."""

    approaches: tuple[Recording, ...]
    hazard_free: tuple[Recording, ...]
    missing: tuple[str, ...]

    @property
    def recordings(self) -> tuple[Recording, ...]:
        """Both kinds."""
        return *self.approaches, *self.hazard_free

    @property
    def lacks(self) -> str | None:
        """What a sweep needs and does not find; None where it can be run."""
        if min(len(self.approaches), len(self.hazard_free)) >= LEAST:
            return None
        least = f"needs {LEAST} filmed approaches and {LEAST} filmed hazard-free recordings"
        return f"{least}; {'; '.join(self.missing)}"


def sweep_data(recordings: Sequence[Recording], approaches: int = 12, hazard_free: int = 12) -> SweepData:
    """Choose so many filmed recordings of a standing ego of each kind, evenly over junctions and sides.

    Examples
    --------
    >>> sweep_data([], approaches=2, hazard_free=0).missing
    ('2 of 2 filmed approaches are missing',)
    """
    of_kind = [[one for one in recordings if (one.label == "none") == free] for free in (False, True)]
    names = "approaches", "hazard-free recordings"
    wanted = approaches, hazard_free
    filmed = [[one for one in found if _usable(one)] for found in of_kind]
    missing = [
        f"{number - len(usable)} of {number} filmed {name} are missing" + _why(found)
        for name, number, usable, found in zip(names, wanted, filmed, of_kind, strict=True)
        if len(usable) < number
    ]
    chosen, free = (tuple(_evenly(usable, number)) for usable, number in zip(filmed, wanted, strict=True))
    return SweepData(chosen, free, tuple(missing))


def _usable(recording: Recording) -> bool:
    # From a moving camera every box moves: there is no reference there.
    standing = not recording.moving_ego and recording.label is not None
    return standing and recording.detections_path is not None and (recording.path / VIDEO_NAME).is_file()


def _why(found: Sequence[Recording]) -> str:
    without = [one.recording_id for one in found if not one.moving_ego and not _usable(one)]
    if not without:
        return ""
    more = f" and {len(without) - 3} more" if len(without) > 3 else ""
    return f": no {VIDEO_NAME} or no detections beside {', '.join(without[:3])}{more}"


def _evenly(recordings: Sequence[Recording], number: int) -> list[Recording]:
    """Take one of each junction and side in turn; kept in the order of the data set."""
    taken: Counter[tuple[str | None, str | None]] = Counter()
    ranked = []
    for place, one in enumerate(recordings):
        stratum = (one.environment, one.label)
        # By side before the junction, so that a remainder goes to as many junctions as it can.
        ranked.append((taken[stratum], one.label or "", place))
        taken[stratum] += 1
    return [recordings[place] for place in sorted(place for *_, place in sorted(ranked)[:number])]
