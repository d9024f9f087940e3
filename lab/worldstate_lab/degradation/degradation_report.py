"""The degradation study as JSON and as text."""

import math
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

from worldstate.adapters.camera.degradation import LEVELS

from .awareness import AwarenessRow
from .beta_curves import Band
from .conditions import FAMILIES
from .degradation_study import DegradationStudy, DetectorSweep

_COLUMNS = ("d", "beta", "vision", "aware", "unseen", "detected", "lead s", "FA/h", "aware/h", "share")


def degradation_record(study: DegradationStudy) -> dict[str, Any]:
    """Return everything that was found, ready for JSON; null where nothing is known."""
    values = {
        "approaches": study.approaches,
        "hazard_free": study.hazard_free,
        "skipped": study.skipped,
        "missing": study.missing,
        "beta_shift": study.beta_shift,
        "largest_awareness_difference": study.largest_awareness_difference,
        "detectors": {sweep.detector: _sweep(sweep) for sweep in study.sweeps},
    }
    known: dict[str, Any] = _known(values)
    return known


def degradation_lines(study: DegradationStudy) -> list[str]:
    """Return a table a detector, one row a condition, and what rain takes at once."""
    return [line for sweep in study.sweeps for line in _lines(sweep)]


def _sweep(sweep: DetectorSweep) -> dict[str, object]:
    beta, found = sweep.beta, sweep.awareness
    return {
        "hops_in_view": found.hops_in_view,
        "hazard_free_hours": found.hazard_free_hours,
        "least_awareness": sweep.least_awareness.awareness,
        "least_vision": sweep.least_vision.vision,
        "rows": [{"name": row.condition.name, **asdict(row)} for row in found.rows],
        "common_cause": [asdict(cause) for cause in found.common_cause],
        "beta": {
            "families": FAMILIES,
            "levels": LEVELS,
            "azimuth_deg": beta.azimuth_deg,
            "looks": beta.looks.tolist(),
            "by_azimuth": _lists(beta.by_azimuth),
            "overall": _lists(beta.overall),
            "falls": [asdict(fall) for fall in beta.falls],
        },
    }


def _lists(band: Band) -> dict[str, object]:
    return {name: part.tolist() for name, part in band._asdict().items()}


def _known(value: Any) -> Any:
    """Replace NaN, which JSON does not know, by null."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _known(one) for key, one in value.items()}
    return [_known(one) for one in value] if isinstance(value, list | tuple) else value


def _lines(sweep: DetectorSweep) -> Iterator[str]:
    yield ""
    yield f"camera states, detector {sweep.detector}, {sweep.awareness.hops_in_view} hops in view"
    yield f"{'':16}" + "".join(f"{title:>10}" for title in _COLUMNS)
    for row in sweep.awareness.rows:
        yield f"{row.condition.name:16}" + "".join(f"{_text(value):>10}" for value in _cells(row))
    for cause in sweep.awareness.common_cause:
        rain = f"rain {LEVELS[cause.level]:g} at {cause.noise_db:+.0f} dB: aware {cause.rain.value:.2f}"
        yield rain + "; additive effects say {:.2f} [{:.2f}, {:.2f}] too much".format(*cause.optimism)


def _cells(row: AwarenessRow) -> tuple[float | None, ...]:
    sees = row.degradation, row.miss_rate, row.vision.value, row.awareness.value, row.unseen_awareness
    false = row.false_alarms_per_hour.value, row.false_awareness_per_hour.value, row.false_awareness
    return *sees, row.detected, row.lead_time_s, *false


def _text(value: float | None) -> str:
    return "-" if value is None else f"{value:.{0 if value >= 20.0 else 2}f}"
