"""What every method is given of a recording, and what it answers."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from worldstate.ground.typing import BoolArray, FloatArray, IntArray
from worldstate.operations.recordings.hop_table import HopTable

LEFT, RIGHT, NO_SIDE = 1, -1, 0
# The columns of the tables of a trial and of an answer.
BOX_COLUMNS = ("frame", "time_s", "box_px", "score", "class_name", "azimuth_rad", "moving")
TRUTH_COLUMNS = ("time_s", "vehicle", "azimuth_rad", "in_view")
TRACK_COLUMNS = ("time_s", "track", "azimuth_rad")
# One value a hop each, in the order of `Decisions`.
DECISION_COLUMNS = ("time_s", "alarm", "side", "bearing_rad", "score", "risk", "visible_s")


@dataclass(frozen=True, slots=True, eq=False)
class Decisions:
    """What one method said of one recording, hop by hop.

    Parameters
    ----------
    time_s : ndarray, shape (n,)
        End of each decision window, seconds from the start of the recording.
    alarm : ndarray of bool, shape (n,)
        Whether an advisory is on.
    side : ndarray of int, shape (n,)
        1 left, -1 right, 0 where the method names none.
    bearing_rad : ndarray, shape (n,)
        Left positive; NaN where the method states none.
    score, risk : ndarray, shape (n,)
        The statistic that is thresholded, and the calibrated probability; NaN where a method has none.
    visible_s : ndarray, shape (n, 3)
        Stated time to visible: low end, best value and high end of its interval; NaN where not stated.
    tracks : HopTable
        One row a hop and track: `time_s`, `track` (a number that names the identity), `azimuth_rad`.
    threshold : ndarray, shape (1,) or (0,)
        What the score is held against, if a method holds it against anything.

    Examples
    --------
    >>> said = Decisions.of(np.array([1.0, 1.1]), alarm=np.array([False, True]))
    >>> said.side.tolist(), said.visible_s.shape, len(said.tracks)
    ([0, 0], (2, 3), 0)
    """

    time_s: FloatArray
    alarm: BoolArray
    side: IntArray
    bearing_rad: FloatArray
    score: FloatArray
    risk: FloatArray
    visible_s: FloatArray
    tracks: HopTable
    threshold: FloatArray = field(default_factory=lambda: np.empty(0))

    @classmethod
    def of(cls, time_s: FloatArray, alarm: BoolArray, **stated: Any) -> "Decisions":
        """Return the decisions of a method that states only some of the columns."""
        n = len(time_s)
        unknown = dict.fromkeys(("bearing_rad", "score", "risk"), np.full(n, np.nan))
        columns = {"side": np.zeros(n, np.int64), "visible_s": np.full((n, 3), np.nan), **unknown}
        tracks = HopTable.of_rows(TRACK_COLUMNS, ())
        return cls(
            **{"time_s": time_s, "alarm": np.asarray(alarm, bool), "tracks": tracks, **columns, **stated}
        )


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """One recording as every method is given it.

    Parameters
    ----------
    hops : HopTable
        What the front-end read, one row a decision of 0.1 s: `time_s`, `features` (n, 60), `srp_rad`,
        `prominence`, `log_slope_hz` of looming, the camera's `answer`, `miss_rate` and `clutter_rate`, and
        the reference `reference_rad` of a moving box in view. Name, label and T0 are the recording's;
        `about` holds its `site`, whether the ego moves, and by what the model was not asked, why it was not
        made for this sound (`refused`).
    boxes : HopTable
        What the camera reported, one row a box: `frame`, `time_s`, `box_px` (n, 4) as x1, y1, x2, y2,
        `score`, `class_name`, `azimuth_rad` of its middle, `moving`; no rows where there is no camera.
    truth : HopTable
        Where the vehicles were, one row a camera frame and vehicle: `time_s`, `vehicle`, `azimuth_rad`,
        `in_view`. Of a real recording these are the moving boxes, all in view.
    chains : mapping of str to Decisions
        What the whole library said, by variant; see `listening.CHAINS`.

    Examples
    --------
    >>> hops = HopTable({"time_s": np.array([1.0, 1.1])}, "a", "left", 1.1, {"site": "SA1", "moving": False})
    >>> trial = Trial(hops)
    >>> trial.name, trial.site, trial.hazard_free, trial.t0_s
    ('a', 'SA1', False, 1.1)
    """

    hops: HopTable
    boxes: HopTable = field(default_factory=lambda: HopTable.of_rows(BOX_COLUMNS, ()))
    truth: HopTable = field(default_factory=lambda: HopTable.of_rows(TRUTH_COLUMNS, ()))
    chains: Mapping[str, Decisions] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Of the recording."""
        return self.hops.name

    @property
    def label(self) -> str:
        """Side that the vehicle comes from, or "none"."""
        return self.hops.label

    @property
    def hazard_free(self) -> bool:
        """Whether nothing approaches."""
        return self.hops.hazard_free

    @property
    def t0_s(self) -> float:
        """Line-of-sight entry, seconds; NaN without one."""
        return self.hops.t0_s

    @property
    def refused(self) -> Mapping[str, str]:
        """By chain or score that the model was not asked for: why it was not made for this sound."""
        return dict(self.hops.about.get("refused", {}))

    @property
    def site(self) -> str:
        """Junction with the ego's motion, such as "SA1"."""
        return str(self.hops.about["site"])


# A method that was fitted to the calibration recordings: from one trial to what it says of it.
Decide = Callable[[Trial], Decisions]


class Method(Protocol):
    """One row of Table I: fitted to the calibration recordings, then asked about the others.

    Examples
    --------
    >>> class Never:
    ...     name = "never"
    ...     def fit(self, calibration, rng):
    ...         return lambda trial: Decisions.of(trial.hops.time_s, np.zeros(len(trial.hops), bool))
    >>> method: Method = Never()
    >>> decide = method.fit([], np.random.default_rng(0))
    >>> decide(Trial(HopTable({"time_s": np.array([1.0])}))).alarm
    array([False])
    """

    @property
    def name(self) -> str:
        """As in the report."""
        ...

    def fit(self, calibration: Sequence[Trial], rng: np.random.Generator, /) -> Decide:
        """Set thresholds and maps on recordings none of which is asked about afterwards."""
        ...
