r"""Inputs of a sequence model: the evidence of each side, its change, and further properties of the sound.

There is one row per hop and side. It is computed from the hop and from earlier ones: up to three seconds for
the evidence, up to eight for the after-effects of the loudest recent vehicle. The right side is mirrored, so
that one model serves both sides. If the history is shorter, its oldest hop replaces the missing ones.
"""

import numpy as np

from worldstate.ground.typing import FloatArray
from worldstate.ground.values import mean, part_means

_SECOND = 10  # hops
_HALF, _TWO, _THREE = _SECOND // 2, 2 * _SECOND, _SECOND + 2 * _SECOND
_FOUR, _SIX = 2 * _TWO, 2 * _THREE
RECENT_HOPS, MEMORY_HOPS = _THREE + 1, 2 * _FOUR + 1  # Three and eight seconds, and the hop itself
QUIET_HOPS = _SIX * _SECOND  # One minute
# The street's usual level is the 20 % quantile of the last minute, and its usual evidence the median. Both
# differ between junctions, and a vehicle that passes within a few seconds does not change them.
QUIET_SHARE, USUAL_SHARE = 0.2, 0.5
# Groups of neighbouring bands; a value is the mean over the hop and this many before it. Sound from behind a
# corner lacks high frequencies; they increase as the vehicle approaches the edge and decrease first after it
# has passed. At junctions outside the training set, the Brier skill at 3 s is 0.265 without bands, 0.273 with
# the four levels relative to the street's and 0.293 with their changes as well; the error of the time to
# visible is 0.756, 0.751 and 0.727 of the constant's.
BANDS, _BAND_HOPS = 4, 3
SIDES = ("left", "right")
_UNKNOWN_HZ = 10.0  # Standard deviation of an unknown approach rate
HOP_S = 1.0 / _SECOND


_BANDS = tuple(f"band_{number}" for number in range(1, BANDS + 1))
_BAND_INPUTS = tuple(f"{name}{before}" for before in ("", "_1s", "_2s") for name in _BANDS)
INPUTS = (
    *("this", "this_above", "this_1s", "this_2s", "this_before", "this_highest"),
    *("other", "other_above", "other_1s", "other_2s", "other_highest"),
    # A single hop hardly separates the sides; the mean over seconds does.
    *("this_mean", "other_mean", "lean", "lean_1s", "lean_3s"),
    *("visible", "visible_above", "visible_1s", "visible_2s", "visible_highest"),
    *("level", "level_1s", "level_2s"),
    *("loudness", "loudness_1s", "loudness_2s"),
    *("prominence", "prominence_1s"),
    *("approach", "approach_std"),
    *("bearing", "bearing_1s", "bearing_spread"),
    *_BAND_INPUTS,
    # A visible vehicle masks others for about three seconds, so these inputs cover more: the time since the
    # loudest hop, the level below it and the rise since then. With them, over sixteen left-out junctions with
    # vehicles up to 6 s apart, the Brier skill at 3 s is 0.234 (was 0.215), the detection rate at 20 onsets
    # per hour 0.77 (was 0.73), and the AUROC of a second vehicle from the other side that adds 1 dB 0.78 (was
    # 0.72).
    *("since_loudest", "below_loudest", "above_dip", "loudness_half", "loudness_4s", "loudness_6s"),
    *(f"{name}_half" for name in _BANDS),
    *("visible_highest_8s", "visible_below_8s", "since_visible"),
    *("this_highest_8s", "other_highest_8s", "since_this", "since_other", "lean_8s", "lean_4s_ago"),
    *("this_half", "other_half", "this_above_dip"),
)


# Stored values of a hop. `left`, `right` and `visible` are log ratios, nats; `level` is the mean log of the
# 60 feature values, `loudness` the mean log energy of the bands, `prominence` the log of the peak-to-median
# ratio, `rate` 1/TTA, `spread` its deviation, and `bearing` positive to the left. The bands are log energies
# of four groups of neighbouring bands, low ones first.
COLUMNS = (
    *("left", "right", "visible", "level", "loudness", "prominence", "rate", "spread", "bearing"),
    *_BANDS,
)
_OF_LEVEL = COLUMNS[COLUMNS.index("level") : -BANDS]
_HIGHEST, _LOUDNESS, _PROMINENCE, _RATE, _SPREAD, _BEARING = map(COLUMNS.index, _OF_LEVEL)
_CHANGING = _LOUDNESS + 1
_BAND_COLUMNS = slice(_BEARING + 1, _BEARING + 1 + BANDS)
# Values with maxima over eight seconds: the level, both sides and visible. The first three also have minima.
_FOLLOWED = [_LOUDNESS, *range(_HIGHEST)]
_EACH = np.arange(len(_FOLLOWED))
_CHANGED = [_LOUDNESS, *range(_BAND_COLUMNS.start, _BAND_COLUMNS.stop), 0, 1]
# Values that are compared with usual ones in the street: levels (20 % quantile), then evidence (median).
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
    *("loudness_half", *(f"{name}_half" for name in _BANDS), "left_half", "right_half"),
    *("loudness_4s", "loudness_6s"),
    *("since_loudest", "since_left", "since_right", "since_visible"),
    *("below_loudest", "left_highest_8s", "right_highest_8s", "visible_highest_8s", "visible_below_8s"),
    *("above_dip", "left_above_dip", "right_above_dip", "lean_8s", "lean_4s_ago"),
)


def _of_side(this: str, other: str) -> list[int]:
    named = [name.replace("this", this).replace("other", other) for name in INPUTS]
    return [_EVERY.index(name) for name in named]


_SIGNED = ("bearing", "bearing_1s", "lean", "lean_1s", "lean_3s", "lean_8s", "lean_4s_ago")
_OWN = [COLUMNS.index(name) for name in USUAL]
_ORDER = (_of_side("left", "right"), _of_side("right", "left"))
_MIRRORED = np.where(np.isin(INPUTS, _SIGNED), -1.0, 1.0)


def hop_columns(
    sides: FloatArray,
    visible: FloatArray,
    *,
    feature: FloatArray,
    band_log_energy: FloatArray,
    prominence: FloatArray,
    looming_hz: FloatArray,
    looming_std_hz: FloatArray,
    bearing_rad: FloatArray,
) -> FloatArray:
    """Return the columns of consecutive hops, one row per hop, shape (n, 13), in the order of `COLUMNS`.

    Training and operation both use this function, because a model needs the inputs that it was trained on.
    `sides`, shape (n, 2), are the log ratios of hidden on the left and on the right to visible or none;
    `visible` is the log ratio of visible to none. A looming rate or a bearing is NaN if it was not usable.
    """
    # In double precision, because files store the energy in half precision.
    energy = np.asarray(band_log_energy, np.float64)
    # An unusable rate becomes 0 with the deviation of an unknown rate.
    refused = ~np.isfinite(looming_hz)
    single = [
        visible,
        mean(np.log(np.asarray(feature, np.float64)), 1),
        mean(energy, 1),
        np.log(prominence),
        np.where(refused, 0.0, looming_hz),
        np.where(refused, _UNKNOWN_HZ, np.minimum(looming_std_hz, _UNKNOWN_HZ)),
        np.where(np.isfinite(bearing_rad), bearing_rad, 0.0),
    ]
    return np.concatenate([sides, np.array(single).T, part_means(energy, BANDS)], axis=1)


def streets_own(columns: FloatArray) -> FloatArray:
    """Return the columns `USUAL`, whose usual values are computed over a minute."""
    return np.asarray(columns[:, _OWN])


def sequence_inputs(columns: FloatArray) -> FloatArray:
    """Return the inputs of both sides at every hop of a stream, shape (n, 2, inputs), from its `hop_columns`.

    Examples
    --------
    >>> sequence_inputs(np.ones((5, len(COLUMNS)))).shape == (5, 2, len(INPUTS))
    True
    """
    own, ends = streets_own(columns), range(1, len(columns) + 1)
    # The same function as in operation, so that training and operation agree bit for bit.
    rows = [last_inputs(columns[max(n - MEMORY_HOPS, 0) : n], own[max(n - QUIET_HOPS, 0) : n]) for n in ends]
    return np.concatenate(rows) if rows else np.zeros((0, len(SIDES), len(INPUTS)))


def last_inputs(recent: FloatArray, minute: FloatArray) -> FloatArray:
    """Return the inputs of the last hop, shape (1, 2, inputs), from the stored hops of a stream.

    Shapes: recent (up to 81, 13), minute (up to 600, 9).
    """
    whole, recent = recent, recent[-RECENT_HOPS:]

    def before(hops: int) -> int:
        return max(len(recent) - 1 - hops, 0)

    def bands(hops: int) -> FloatArray:
        at = before(hops)
        return np.asarray(mean(recent[max(at - _BAND_HOPS, 0) : at + 1, _BAND_COLUMNS], 0))

    now, second, two, three = [recent[before(hops)] for hops in (0, _SECOND, _TWO, _THREE)]
    last_second, this_bands = recent[-1 - _SECOND :], bands(0)
    swing, spread = last_second[:, _BEARING], now[_SPREAD]
    mean_1s, mean_3s = [mean(rows[:, : len(SIDES)], 0) for rows in (last_second, recent)]
    usual_levels = _ranked(minute[:, :_LEVELS], QUIET_SHARE)
    usual_evidence = _ranked(minute[:, _LEVELS:], USUAL_SHARE)
    usual_bands, usual_rest = usual_levels[:BANDS], np.concatenate([usual_levels[BANDS:], usual_evidence])
    rest = [now[_PROMINENCE], second[_PROMINENCE], now[_RATE] / spread, np.log(spread)]
    swung = np.maximum.reduce(swing) - np.minimum.reduce(swing)
    rest += [now[_BEARING], now[_BEARING] - second[_BEARING], swung]
    parts = [now[:_HIGHEST], now[_OWN[BANDS:]] - usual_rest]
    parts += [(now - one)[:_CHANGING] for one in (second, two)]
    highest = np.maximum.reduce(recent[:, :_HIGHEST])
    parts += [(second - three)[: len(SIDES)], highest, np.array(rest), mean_3s]
    parts += [side[:1] - side[1:2] for side in (now, mean_1s, mean_3s)]
    parts += [this_bands - one for one in (usual_bands, bands(_SECOND), bands(_TWO))]
    every = np.concatenate([*parts, *_remembered(whole)])
    left, right = [every[order] for order in _ORDER]
    return np.array([[left, right * _MIRRORED]])


def _remembered(whole: FloatArray) -> list[FloatArray]:
    """Return the inputs from eight seconds, in the order of `_EVERY`."""
    last = len(whole) - 1

    def before(hops: int) -> FloatArray:
        """Return the mean of the three hops that ended this many hops ago."""
        end = max(last - hops, 0) + 1
        rows = whole[max(end - _BAND_HOPS, 0) : end]
        return np.asarray(np.add.reduce(rows) / len(rows))

    recent, half = before(0), before(_HALF)
    followed = whole[:, _FOLLOWED]
    at, now, lean = followed.argmax(axis=0), followed[-1], followed[:, 1] - followed[:, 2]
    highest, dip = followed[at, _EACH], np.minimum.reduce(followed[at[0] :])
    level = recent[_LOUDNESS]
    return [
        (recent - half)[_CHANGED],
        np.array([level - before(_FOUR)[_LOUDNESS], level - before(_SIX)[_LOUDNESS]]),
        HOP_S * (last - at),
        now[:1] - highest[:1],
        highest[1:],
        now[_HIGHEST:] - highest[_HIGHEST:],
        (now - dip)[:_HIGHEST],
        np.array([np.add.reduce(lean) / len(lean), lean[max(last - _FOUR, 0)]]),
    ]


def _ranked(values: FloatArray, share: float) -> FloatArray:
    """Return the quantile of each column, shape (columns,)."""
    rank = int(share * (len(values) - 1))
    ordered = values.copy()
    ordered.partition(rank, axis=0)
    return np.asarray(ordered[rank])
