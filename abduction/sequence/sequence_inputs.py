r"""What a sequence model reads: each side's evidence, how it changed, and what else the sound did.

One row a hop and side, from the hop itself and those up to three seconds before it. The right side is
mirrored onto the left, so that one model serves both. Where less than that was heard, the oldest hop stands
in.
"""

from dataclasses import dataclass

import numpy as np

from worldstate.ground.typing import FloatArray

MEMORY_HOPS = 31  # three seconds and the hop itself
QUIET_HOPS = 600
# The street's own level is what the quietest fifth of the last minute stays below, its own evidence what half
# of the minute does: another junction moves both, and a vehicle a few seconds long neither.
QUIET_SHARE, USUAL_SHARE = 0.2, 0.5
_SECOND, _TWO, _THREE = 10, 20, 30
# Groups of neighbouring bands, read as means over so many hops more. Behind a corner sound is dull: the
# nearer a vehicle comes to the edge, the more of its high frequencies come round it, and they go first when
# it has passed. At junctions left out, Brier skill at 3 s .265 without, .273 with the four levels above the
# street's own, .293 with their changes, too; time to visible .756, .751, .727 of the constant's error.
BANDS, _BAND_HOPS = 4, 3
SIDES = ("left", "right")


@dataclass(frozen=True, slots=True, eq=False)
class HopEvidence:
    """What the hops of a stream said, each of shape (n,), the sides of shape (n, 2), the bands of (n, 4)."""

    sides: FloatArray  # Log ratio of hidden on the left, on the right, to visible or none; nats
    visible: FloatArray  # Log ratio of visible to none, nats
    level: FloatArray  # Mean of the log of the 60 values
    loudness: FloatArray  # Mean log energy of the bands, nats
    prominence: FloatArray  # Natural logarithm of the peak-to-median ratio
    looming_hz: FloatArray  # 1/TTA; NaN where refused
    looming_std_hz: FloatArray
    bearing_rad: FloatArray  # Left positive; NaN where refused
    bands: FloatArray  # shape (n, 4): Log energy of four groups of neighbouring bands, low ones first, nats

    def __len__(self) -> int:
        return len(self.visible)

    @classmethod
    def heard(
        cls,
        sides: FloatArray,
        visible: FloatArray,
        *,
        feature: FloatArray,
        band_log_energy: FloatArray,
        prominence: FloatArray,
        looming_hz: FloatArray,
        looming_std_hz: FloatArray,
        bearing_rad: FloatArray,
    ) -> "HopEvidence":
        """Return the evidence of hops, one a row, from what the window model and the front-end said.

        The only way from either to a sequence: a model that learns one and reads another is worth nothing.
        """
        # In double precision: streams on disk keep half of it, and its logarithm would have the other half's.
        energy = np.asarray(band_log_energy, np.float64)
        return cls(
            sides=sides,
            visible=visible,
            level=np.log(np.asarray(feature, np.float64)).mean(axis=1),
            loudness=energy.mean(axis=1),
            prominence=np.log(prominence),
            looming_hz=looming_hz,
            looming_std_hz=looming_std_hz,
            bearing_rad=bearing_rad,
            bands=np.stack([part.mean(axis=1) for part in np.array_split(energy, BANDS, axis=1)], axis=1),
        )


_BANDS = tuple(f"band_{number}" for number in range(1, BANDS + 1))
_BAND_INPUTS = tuple(f"{name}{before}" for before in ("", "_1s", "_2s") for name in _BANDS)
INPUTS = (
    *("this", "this_above", "this_1s", "this_2s", "this_before", "this_highest"),
    *("other", "other_above", "other_1s", "other_2s", "other_highest"),
    # One hop hardly tells the sides apart; what it leans to over seconds does.
    *("this_mean", "other_mean", "lean", "lean_1s", "lean_3s"),
    *("visible", "visible_above", "visible_1s", "visible_2s", "visible_highest"),
    *("level", "level_1s", "level_2s"),
    *("loudness", "loudness_1s", "loudness_2s"),
    *("prominence", "prominence_1s"),
    *("approach", "approach_std"),
    *("bearing", "bearing_1s", "bearing_spread"),
    *_BAND_INPUTS,
)


# What is kept of a hop, without gaps: the first five change, the first three have a highest.
COLUMNS = (
    *("left", "right", "visible", "level", "loudness", "prominence", "rate", "spread", "bearing"),
    *_BANDS,
)
_CHANGING, _HIGHEST = 5, 3
_PROMINENCE, _RATE, _SPREAD, _BEARING = range(5, 9)
_BAND_COLUMNS = slice(_BEARING + 1, _BEARING + 1 + BANDS)
# What of it is usual in the street: levels that the quietest fifth stays below, then evidence.
USUAL = (*_BANDS, "level", "loudness", "left", "right", "visible")
_LEVELS = BANDS + 2
_EVERY = (
    *COLUMNS[:_HIGHEST],
    *("level", "loudness", "left_above", "right_above", "visible_above"),
    *(f"{name}_1s" for name in COLUMNS[:_CHANGING]),
    *(f"{name}_2s" for name in COLUMNS[:_CHANGING]),
    *("left_before", "right_before"),
    *(f"{name}_highest" for name in COLUMNS[:_HIGHEST]),
    *("prominence", "prominence_1s", "approach", "approach_std"),
    *("bearing", "bearing_1s", "bearing_spread"),
    *("left_mean", "right_mean", "lean", "lean_1s", "lean_3s"),
    *_BAND_INPUTS,
)


def _of_side(this: str, other: str) -> list[int]:
    named = [name.replace("this", this).replace("other", other) for name in INPUTS]
    return [_EVERY.index(name) for name in named]


_OWN = [COLUMNS.index(name) for name in USUAL]
_ORDER = (_of_side("left", "right"), _of_side("right", "left"))
_MIRRORED = np.where(np.isin(INPUTS, ("bearing", "bearing_1s", "lean", "lean_1s", "lean_3s")), -1.0, 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class _Columns:
    """What inputs are made of: columns now and before, and what is usual in the street, one row a hop."""

    now: FloatArray  # shape (n, 13): `columns_of`
    second: FloatArray  # The same one, two and three seconds before
    two: FloatArray
    three: FloatArray
    highest: FloatArray  # shape (n, 3): Of both sides and the visible, over three seconds
    swing: FloatArray  # shape (n,): Of the bearing, over one
    mean_1s: FloatArray  # shape (n, 2): Of the sides, over one second and over three
    mean_3s: FloatArray
    usual: FloatArray  # shape (n, 9): Levels of the quiet street, then usual evidence, as `USUAL`
    bands: FloatArray  # shape (3, n, 4): Levels of the bands now, one and two seconds before

    def inputs(self) -> FloatArray:
        """Return the inputs of both sides, shape (n, 2, inputs)."""
        now, second = self.now, self.second
        spread = now[:, _SPREAD]
        rest = [now[:, _PROMINENCE], second[:, _PROMINENCE], now[:, _RATE] / spread, np.log(spread)]
        rest += [now[:, _BEARING], now[:, _BEARING] - second[:, _BEARING], self.swing]
        changes = [(now - one)[:, :_CHANGING] for one in (second, self.two)]
        before = (second - self.three)[:, : len(SIDES)]
        above = (streets_own(now) - self.usual)[:, BANDS:]
        leans = [side[:, :1] - side[:, 1:2] for side in (now, self.mean_1s, self.mean_3s)]
        parts = [now[:, :_HIGHEST], above, *changes, before, self.highest, np.stack(rest, axis=1)]
        bands = [self.bands[0] - self.usual[:, :BANDS], *(self.bands[0] - self.bands[1:])]
        parts += [self.mean_3s, *leans, *bands]
        every = np.concatenate(parts, axis=1)
        left, right = (every[:, order] for order in _ORDER)
        return np.stack([left, right * _MIRRORED], axis=1)


def columns_of(evidence: HopEvidence) -> FloatArray:
    """Return evidence as columns without gaps, shape (n, 13), as `COLUMNS` names them."""
    # Where nothing could be read the rate is 0 and its deviation that of knowing nothing.
    refused = ~np.isfinite(evidence.looming_hz)
    rate = np.where(refused, 0.0, evidence.looming_hz)
    spread = np.where(refused, 10.0, np.minimum(evidence.looming_std_hz, 10.0))
    azimuth = np.where(np.isfinite(evidence.bearing_rad), evidence.bearing_rad, 0.0)
    single = [evidence.visible, evidence.level, evidence.loudness, evidence.prominence, rate, spread, azimuth]
    return np.concatenate([evidence.sides, np.stack(single, axis=1), evidence.bands], axis=1)


def streets_own(columns: FloatArray) -> FloatArray:
    """Return the columns whose usual values are kept for a minute, as `USUAL` names them."""
    return np.asarray(columns[:, _OWN])


def sequence_inputs(evidence: HopEvidence) -> FloatArray:
    """Return the inputs of both sides at every hop, shape (n, 2, inputs).

    Examples
    --------
    >>> flat = HopEvidence(np.zeros((5, 2)), *np.ones((7, 5)), bands=np.ones((5, 4)))
    >>> sequence_inputs(flat).shape == (5, 2, len(INPUTS))
    True
    """
    columns = columns_of(evidence)
    shares = [QUIET_SHARE] * _LEVELS + [USUAL_SHARE] * (len(USUAL) - _LEVELS)
    usual = [running(one, share) for one, share in zip(streets_own(columns).T, shares, strict=True)]
    azimuth, bands = columns[:, _BEARING], mean(columns[:, _BAND_COLUMNS], _BAND_HOPS)
    return _Columns(
        now=columns,
        second=ago(columns, _SECOND),
        two=ago(columns, _TWO),
        three=ago(columns, _THREE),
        highest=np.stack([highest(one, _THREE) for one in columns[:, :_HIGHEST].T], axis=1),
        swing=highest(azimuth, _SECOND) + highest(-azimuth, _SECOND),
        mean_1s=mean(evidence.sides, _SECOND),
        mean_3s=mean(evidence.sides, _THREE),
        usual=np.stack(usual, axis=1),
        bands=np.stack([bands, ago(bands, _SECOND), ago(bands, _TWO)]),
    ).inputs()


def last_inputs(recent: FloatArray, minute: FloatArray) -> FloatArray:
    """Return the inputs of the last hop, shape (1, 2, inputs), from what is kept of a stream.

    Shapes: recent (up to 31, 13), minute (up to 600, 9).
    """
    now = len(recent) - 1

    def before(hops: int) -> FloatArray:
        at = max(now - hops, 0)
        return recent[at : at + 1]

    def bands(hops: int) -> FloatArray:
        at = max(now - hops, 0)
        return np.asarray(recent[max(at - _BAND_HOPS, 0) : at + 1, _BAND_COLUMNS].mean(axis=0))

    swing = recent[-1 - _SECOND :, _BEARING]
    usual = [_ranked(minute[:, :_LEVELS], QUIET_SHARE), _ranked(minute[:, _LEVELS:], USUAL_SHARE)]
    return _Columns(
        now=recent[-1:],
        second=before(_SECOND),
        two=before(_TWO),
        three=before(_THREE),
        highest=recent[:, :_HIGHEST].max(axis=0)[None],
        swing=(swing.max() + (-swing).max())[None],
        mean_1s=recent[-1 - _SECOND :, : len(SIDES)].mean(axis=0)[None],
        mean_3s=recent[:, : len(SIDES)].mean(axis=0)[None],
        usual=np.concatenate(usual)[None],
        bands=np.stack([bands(0), bands(_SECOND), bands(_TWO)])[:, None],
    ).inputs()


def _ranked(values: FloatArray, share: float) -> FloatArray:
    """Return the value of each column that a share of its rows stays below."""
    rank = int(share * (len(values) - 1))
    return np.asarray(np.partition(values, rank, axis=0)[rank])


def ago(values: FloatArray, hops: int) -> FloatArray:
    """Return what each value was so many hops before; the first one where there is none.

    Examples
    --------
    >>> ago(np.array([1.0, 2.0, 3.0]), 1)
    array([1., 1., 2.])
    """
    before = np.maximum(np.arange(len(values)) - hops, 0)
    return np.asarray(values[before])


def mean(values: FloatArray, hops: int) -> FloatArray:
    """Return the means of each row and those up to so many hops before it, of fewer where there are fewer.

    Examples
    --------
    >>> mean(np.array([[3.0], [1.0], [2.0]]), 1).ravel()
    array([3. , 2. , 1.5])
    """
    padded = np.concatenate([np.zeros((hops, values.shape[1])), values])
    sums = np.lib.stride_tricks.sliding_window_view(padded, hops + 1, axis=0).sum(axis=-1)
    return np.asarray(sums / np.minimum(np.arange(len(values)) + 1, hops + 1)[:, None])


def highest(values: FloatArray, hops: int) -> FloatArray:
    """Return the largest of each value and those up to so many hops before it.

    Examples
    --------
    >>> highest(np.array([3.0, 1.0, 2.0, 0.0]), 1)
    array([3., 3., 2., 2.])
    """
    padded = np.concatenate([np.full(hops, -np.inf), values])
    return np.asarray(np.lib.stride_tricks.sliding_window_view(padded, hops + 1).max(axis=1))


def running(values: FloatArray, share: float) -> FloatArray:
    """Return the value that a share of the last minute stays below, hop by hop.

    Examples
    --------
    >>> running(np.array([3.0, 1.0, 2.0]), 0.5)
    array([3., 1., 2.])
    """
    padded = np.concatenate([np.full(QUIET_HOPS - 1, np.nan), values])
    found = np.empty(len(values))
    heard = np.minimum(np.arange(len(values)) + 1, QUIET_HOPS)
    # NaN sorts last: the rank counts what was heard.
    rank = np.floor(share * (heard - 1)).astype(np.intp)
    windows = np.lib.stride_tricks.sliding_window_view(padded, QUIET_HOPS)
    for begin in range(0, len(values), 1000):
        block = np.sort(windows[begin : begin + 1000], axis=1)
        found[begin : begin + 1000] = np.take_along_axis(block, rank[begin : begin + 1000, None], 1)[:, 0]
    return found
