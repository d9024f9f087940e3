"""States as a table of pandas, one row per state and approach side."""

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

from worldstate.ground.extras import optional
from worldstate.state import WorldState

if TYPE_CHECKING:
    import pandas

COLUMNS = (
    "time_s", "side", "risk", "advisory", "began", "usable", "why_not", "in_view_within_3_s",
    "time_to_visible_s", "azimuth_deg", "entity_id",
)  # fmt: skip


def to_dataframe(states: Iterable[WorldState]) -> "pandas.DataFrame":
    """Return states as a table of pandas: one row per state and approach side.

    A state without a side, such as one of an array without a model, has one row. Unknown values are None or
    NaN.

    Parameters
    ----------
    states : iterable of WorldState
        As `worldstate.run`, `read` and `listen` return them.

    Returns
    -------
    pandas.DataFrame
        Columns ``time_s`` (s, on the clock of the state), ``side``, ``risk``, ``advisory`` (true during one),
        ``began`` (true in its first state), ``usable``, ``why_not`` (reasons joined by commas),
        ``in_view_within_3_s`` (probability), ``time_to_visible_s`` (best estimate, s), ``azimuth_deg``
        (degrees, left positive) and ``entity_id``.

    Raises
    ------
    MissingExtraError
        If pandas is not installed.

    Examples
    --------
    >>> from worldstate.ground import MissingExtraError
    >>> from worldstate.state import WorldState
    >>> try:
    ...     print(list(to_dataframe([WorldState(0, 0)]).time_s))
    ... except MissingExtraError:
    ...     print([0.0])
    [0.0]
    """
    pandas = optional("pandas")
    return pandas.DataFrame([row for state in states for row in _rows(state)], columns=list(COLUMNS))


def _rows(state: WorldState) -> Iterator[tuple[object, ...]]:
    for cue in [one for one in state.cues if one.direction]:
        within = (cue.within or {}).get("3")
        best_s = cue.time_to_visible_s and cue.time_to_visible_s[1]
        advised = cue.advisory is not None, cue.began, cue.usable, ", ".join(cue.why_not)
        yield state.time_s, cue.direction, cue.risk, *advised, within, best_s, cue.azimuth_deg, cue.entity_id
    if not any(one.direction for one in state.cues):
        yield state.time_s, *[None] * (len(COLUMNS) - 1)
