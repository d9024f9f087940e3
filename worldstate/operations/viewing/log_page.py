"""A state log as one page of HTML to step through in a browser, without another file or a network."""

import json
import math
from collections.abc import Iterable, Sequence
from importlib.resources import files
from pathlib import Path
from typing import TypeAlias, TypedDict

import numpy as np

from worldstate.abduction.road_users import Foreign
from worldstate.adapters.datasets.ovad import TrueTrack
from worldstate.adapters.export.scene import hidden_sector, label_of, sector_of
from worldstate.adapters.files.file_io import write_text
from worldstate.ground import InputFileError, InvalidArgumentError, seconds
from worldstate.operations.recordings.evidence_report import common_lines
from worldstate.state import Entity, RiskCue, WorldState

# A snapshot with two entities is 1 kB: five to ten minutes are shown whole, and a page has 6 MB at most.
MOST_STATES = 3000
# A street has fewer; of a fault that gives birth to many the likeliest are enough to see it.
_MOST_ENTITIES = 16

Row: TypeAlias = dict[str, object]


class PageData(TypedDict):
    """What the page draws: azimuths in degrees, left positive, times in seconds on the states' clock."""

    title: str
    remarks: list[str]
    t0_s: float | None
    truth: list[list[Row]]
    states: list[Row]


def check_page(path: Path) -> Path:
    """Return `path` if it names a page; commands call it before their work."""
    if path.suffix.lower() not in (".html", ".htm"):
        raise InputFileError(path, "expected a page's name ending in .html")
    return path


def write_log_page(
    states: Iterable[WorldState],
    path: Path,
    *,
    title: str = "",
    t0_s: float | None = None,
    truth: Sequence[TrueTrack] = (),
) -> PageData:
    """Write snapshots as one page of HTML; return what it draws.

    Parameters
    ----------
    states : iterable of WorldState
        Of one run, at least one; of more than 6,000 every second, fourth, ... is kept.
    path : Path
        Exactly this file.
    title : str
        Heading of the page.
    t0_s : float, optional
        Line-of-sight entry.
    truth : sequence of TrueTrack
        True tracks of the vehicles of a simulated recording.

    Raises
    ------
    InvalidArgumentError
        If there is no snapshot.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     page = write_log_page([WorldState(0, 0)], Path(folder) / "log.html")
    >>> len(page["states"])
    1
    """
    data = page_data(states, title=title, t0_s=t0_s, truth=truth)
    template = (files("worldstate") / "data" / "log_view.html").read_text("utf-8")
    # Within a script element only "<" can end it or begin a comment.
    text = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    write_text(path, template.replace("@data@", text))
    return data


def page_data(
    states: Iterable[WorldState],
    *,
    title: str = "",
    t0_s: float | None = None,
    truth: Sequence[TrueTrack] = (),
) -> PageData:
    """Return what the page draws of snapshots; parameters are those of `write_log_page`."""
    kept, every, count, calibrated = list[Row](), 1, 0, 0
    for count, state in enumerate(states, start=1):
        calibrated += state.calibrated
        if (count - 1) % every == 0:
            kept.append(_row(state))
        if len(kept) > 2 * MOST_STATES:
            kept, every = kept[::2], 2 * every
    if not kept:
        raise InvalidArgumentError("states: expected at least one snapshot, got none")
    for row in kept if not calibrated else ():
        row["thresholds"] = {}
    remarks = _remarks(count, every, calibrated)
    return PageData(title=title, remarks=remarks, t0_s=t0_s, truth=list(map(_track, truth)), states=kept)


def _remarks(count: int, every: int, calibrated: int) -> list[str]:
    """Say what a reader of the page must not take for more than it is."""
    said = []
    if not calibrated:
        said.append("Not calibrated: no snapshot holds to a budget of false alarms. No threshold is drawn.")
    elif calibrated < count:
        said.append(
            f"{count - calibrated} of {count} snapshots are not calibrated: nothing could be heard, or the "
            "budget was broken."
        )
    if every > 1:
        said.append(
            f"One of {every} snapshots is shown of {count}: what was shorter may be missing. "
            "The option --between shows every one of a part."
        )
    return said


def _row(state: WorldState) -> Row:
    """Return one snapshot as the page draws it, rounded to what can be seen there."""
    parts = (part for one in state.entities if one.moving for part in one.on_each_side())
    likeliest = sorted(parts, key=lambda one: -one.existence_probability)[:_MOST_ENTITIES]
    bearing = state.bearing
    stated = [(one.direction, one.evidence) for one in state.cues if one.evidence is not None]
    return {
        "t": round(seconds(state.stamp_ns), 3),
        "entities": list(map(_entity, likeliest)),
        "cues": list(map(_cue, state.cues)),
        "thresholds": {side: round(one.threshold_nats, 2) for side, one in stated},
        "bearing": None if bearing is None else _degrees(bearing.azimuth_rad),
        "prominence": None if bearing is None else round(bearing.prominence, 2),
        "corners": [
            {"edge": _degrees(one.edge_azimuth_rad), "assumed": one.assumed, **_sector(hidden_sector(one))}
            for one in state.context.occluders
        ],
        "searched": [
            {"sensor": one.sensor, "found": one.found, **_sector(one.sector_rad)} for one in state.searched
        ],
        "heard": {one.sensor: round(one.share, 2) for one in state.heard or ()},
        "foreign": isinstance(state.domain, Foreign),
        "notes": list(common_lines(state)),
    }


def _entity(one: Entity) -> Row:
    return {
        "id": one.id[:8],
        "hidden": one.status == "hidden",
        "label": label_of(one),
        "existence": round(one.existence_probability, 3),
        "azimuth": _degrees(one.azimuth_rad),
        **_sector(sector_of(one.azimuth_rad, one.azimuth_std_rad, one.sector_rad)),
        "place": None if one.position_m is None else [round(value, 1) for value in one.position_m[:2]],
    }


def _cue(one: RiskCue) -> Row:
    within, evidence = one.within or {}, one.evidence
    held = one.held and f"held until {seconds(one.held.until_ns):.1f} s: now below the threshold"
    return {
        "side": one.direction,
        "risk": round(one.risk, 3),
        "within": round(within["3"], 3) if "3" in within else None,
        "since": None if one.advisory is None else round(seconds(one.advisory.since_ns), 3),
        "said": [text for text in (held, one.not_advised) if text],
        **_sector(sector_of(one.azimuth_rad, one.azimuth_std_rad, one.sector_rad)),
        "evidence": evidence
        and {
            "hypothesis": evidence.hypothesis,
            "terms": {name: round(value, 3) for name, value in evidence.terms_nats.items()},
            "compared": round(evidence.compared_nats, 2),
        },
    }


def _track(true: TrueTrack) -> list[Row]:
    azimuths = np.degrees(true.azimuth_rad).round(1)
    columns = true.time_s.round(3), azimuths, true.in_view, true.position_m.round(1)
    rows = zip(*(column.tolist() for column in columns), strict=True)
    return [dict(zip(("t", "azimuth", "in_view", "place"), row, strict=True)) for row in rows]


def _sector(sector_rad: tuple[float, float]) -> Row:
    low, high = map(_degrees, sector_rad)
    return {"low": low, "high": high}


def _degrees(azimuth_rad: float) -> float:
    return round(math.degrees(azimuth_rad), 1)
