"""Tables with a row for each method of a protocol, and what each of them stands on."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from worldstate_lab.evaluation.evaluation import Evaluation
from worldstate_lab.report.table import Cell, Table, Value

from .measured_values import Values

_UNSTATED = {
    "bearing_deg": "states none",
    "side_correct": "states none",
    "gospa_deg": "states none",
    "lead_s": "none detected",
}
_REFUSED = "not scored: the model was not made for this sound"


def method_table(
    found: Evaluation,
    values: Values,
    protocol: str,
    methods: Iterable[str],
    columns: Sequence[tuple[str, str]],
    *,
    name: str,
    title: str,
    caption: str,
) -> Table:
    """Return a table with a row for each method and a column, head and figure, for each of `columns`."""
    refused = found.refused.get(protocol, {})
    rows: list[tuple[Cell, ...]] = []
    reasons: dict[str, None] = {}
    for method in methods:
        if method in refused:
            reasons[f"Not scored: {refused[method]}."] = None
            rows.append((method, Value(np.nan, note=_REFUSED), *[Value(np.nan)] * (len(columns) - 1)))
        else:
            cells = (values.get((protocol, method, figure), Value(np.nan)) for _, figure in columns)
            rows.append((method, *(_cell(one, f) for one, (_, f) in zip(cells, columns, strict=True))))
    told = " ".join((f"{stands_on(found, protocol)}.", caption, *reasons))
    return Table(name, title, ("method", *(head for head, _ in columns)), tuple(rows), told)


def methods_of(found: Evaluation, protocol: str) -> list[str]:
    """Return the names of the methods that have a row of their own, those that are not scored last."""
    scored = [name for name in found.scores[protocol] if not name.startswith("curve")]
    return [*scored, *found.refused.get(protocol, {})]


def stands_on(found: Evaluation, protocol: str) -> str:
    """Return in words how many recordings the figures of a protocol are of."""
    of = found.runs[protocol].stands_on
    return (
        f"{of['recordings']:.0f} recordings: {of['approaches']:.0f} approaches and {of['hazard_free']:.0f} "
        f"hazard-free, {of['hazard_free_hours']:.3f} h"
    )


def _cell(value: Value, figure: str) -> Value:
    return value if math.isfinite(value.value) else replace(value, note=_UNSTATED.get(figure, ""))
