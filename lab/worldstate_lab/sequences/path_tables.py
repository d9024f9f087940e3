"""The figures of a path as printed tables, with those of its model's simulated exam beside them."""

import math
from collections.abc import Iterator, Mapping
from typing import Any

from worldstate_lab.report.table import Cell, Table, Value

from .recordings import NANODET_BOXES
from .scores import Row

FOLLOWED = ("identity_kept", "hand_over_delay_s", "bearing_error_deg")
_ROW_HEADS = (
    *("warned", "lead (s)", "missed as 0 (s)", "lasting", "lasting (s)", "alarms (1/h)", "in alarm"),
    *("advisory", "2-6 s after T0", "over 5 s early"),
)
_SHOWN_LEADS, _SHOWN_SIDES, _SHOWN_ONSETS = ("0.5", "1", "2", "3"), ("1", "2"), ("1", "3")


def path_lines(path: str, found: Mapping[str, Any]) -> list[str]:
    """Return every table of a path."""
    return [line for table in _tables(path, found) for line in (*table.lines(), "")] + _sentences(found)


def _tables(path: str, found: Mapping[str, Any]) -> Iterator[Table]:
    on = found["stands_on"]
    basis = f"{path}: {on['approaches']} approaches, {on['hazard_free']} hazard-free recordings"
    exam, heard = found.get("exam"), "with the camera" if found["camera"] else "sound alone"
    yield _leads(found["leads"], exam, f"{basis}, {on['hazard_free_hours']:.3f} h; risk, {heard}")
    # The paper's rows with a camera use the filter of OVAD's authors instead.
    counted = f"boxes from {NANODET_BOXES.min_score} and {NANODET_BOXES.min_height_px:g} px up"
    untouched = f"alarms; thresholds from five folds, those of the product unchanged; {counted}"
    yield alarm_table(found["rows"], "alarm", untouched, exam)
    swept = "curve: decision value, sound alone, swept afterwards"
    yield alarm_table(found["at_onsets"], "onsets <=", swept)
    yield scores_table(found["scores"], "parts of the product, thresholds swept afterwards")


def _leads(rows: Mapping[str, Row], exam: Mapping[str, Any] | None, title: str) -> Table:
    sites = list(next(iter(rows.values()))["auroc_by_junction"])
    heads = ("lead (s)", "hazard", "all hops", "side", *sites, "n", *(("simulated exam",) if exam else ()))
    return Table("leads", title, heads, [_lead_row(name, row, exam) for name, row in rows.items()])


def _lead_row(name: str, row: Row, exam: Mapping[str, Any] | None) -> tuple[Cell, ...]:
    areas = (_spread(row, one) for one in ("auroc", "auroc_all_hops", "side_auroc"))
    sites = (Value(value) for value in row["auroc_by_junction"].values())
    simulated = () if exam is None else (_value(exam.get(f"auroc_{name}")),)
    return name, *areas, *sites, f"{row['approaches']} + {row['hazard_free']}", *simulated


def alarm_table(rows: Mapping[str, Row], head: str, title: str, exam: Row | None = None) -> Table:
    """Return a table of alarms, one per row, with the figures of a model's simulated exam."""
    cells = [(name, *_alarm_row(row)) for name, row in rows.items()]
    if exam is not None:
        warned, lead, rate = (_value(exam[one]) for one in ("warned", "lead_s_missed_0", "alarms_per_hour"))
        cells.append(("its simulated exam", warned, None, lead, None, None, rate, *[None] * 4))
    return Table("alarms", title, (head, *_ROW_HEADS), cells)


def _alarm_row(row: Row) -> tuple[Cell, ...]:
    low, high = row["interval"]
    return (
        row["text"],
        _value(row["lead_s"]),
        _spread(row, "lead_s_missed_0"),
        f"{row['lasting_count']:g}",
        _value(row["lasting_lead_s"]),
        Value(row["alarms_per_hour"], low, high, digits=0),
        f"{row['false_recordings']:g}",
        _value(row["advisory_share"], 3),
        _value(row["after_pass_share"], 3),
        " ".join(map(str, row["leads_beyond_5_s"])),
    )


def scores_table(scores: Mapping[str, Any], title: str) -> Table:
    """Return a table of scores: AUROC before T0, and the warnings at their best thresholds."""
    areas = (*(f"{one} s" for one in _SHOWN_LEADS), *(f"side {one} s" for one in _SHOWN_SIDES))
    heads = ("score", *areas, *(f"onsets <= {one}" for one in _SHOWN_ONSETS))
    return Table("scores", title, heads, [(name, *_score_row(one)) for name, one in scores.items()])


def _score_row(found: Mapping[str, Any]) -> tuple[Cell, ...]:
    leads, curve = found["leads"], found["at_onsets"]
    return (
        *(_spread(leads[one], "auroc") for one in _SHOWN_LEADS),
        *(_value(leads[one].get("side_auroc")) for one in _SHOWN_SIDES),
        *(f"{curve[n]['count']:g}, {curve[n]['lead_s_missed_0']:.2f} s" for n in _SHOWN_ONSETS),
    )


def _sentences(found: Mapping[str, Any]) -> list[str]:
    """Return lines on windows, risk and calibration, and on the figures of the exam."""
    lines = []
    for name, some in (("shipped model", found), ("published classifier", found["published"])):
        if some is not None:
            parts = [f"{one} {_spread(some['horizons'], one).text}" for one in ("all", "2s", "1s")]
            parts += [f"{one} {_spread(some['risk'], one).text}" for one in ("ece_raw", "ece")]
            lines.append(f"windows, {name}: {', '.join(parts)}")
    for name, key in (("with the camera", "calibration"), ("sound alone", "calibration_sound_alone")):
        some = found[key]
        known = (one for one in ("ece", "brier_skill") if some[one] is not None)
        parts = [*(f"{one} {_spread(some, one).text}" for one in known)]
        parts.append(f"base rate {_value(some['base_rate']).text}")
        lines.append(f"in view within 2 s, {name}: {', '.join(parts)}")
    lines.append(", ".join(f"{name} {_value(found[name]).text}" for name in FOLLOWED))
    for name, some in found.get("front_end", {}).items():
        if isinstance(some, dict) and "value" in some:
            value = Value(some["value"], *some["interval"]).text
            lines.append(f"front-end, {name}: {value}, paper {some['paper']:g}")
    if "exam" in found:
        parts = [f"{name} {_value(value, 3).text}" for name, value in found["exam"].items()]
        lines.append(f"simulated exam: {', '.join(parts)}")
    return lines + [f"not processed: {name}: {why}" for name, why in found["failed"].items()]


def _spread(row: Row, name: str) -> Value:
    """Return a figure with its interval."""
    value, (low, high) = row.get(name), row.get(f"{name}_interval", (math.nan, math.nan))
    return Value(math.nan if value is None else value, low, high)


def _value(value: float | None, digits: int = 2) -> Value:
    return Value(math.nan if value is None else value, digits=digits)
