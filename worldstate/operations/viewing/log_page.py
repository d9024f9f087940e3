"""A state log as one page of HTML, which needs no other file and no network."""

import base64
import io
import json
import math
from bisect import bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import NotRequired, TypeAlias, TypedDict

import numpy as np
import soundfile
from numpy.typing import NDArray

from worldstate.abduction.road_users import Foreign
from worldstate.adapters.datasets.ovad import TrueTrack
from worldstate.adapters.export.other_stacks import CROSSING_M
from worldstate.adapters.export.scene import CompressedImage, RawAudio, hidden_sector, label_of, sector_of
from worldstate.adapters.files.file_io import write_text
from worldstate.ground import InvalidArgumentError, seconds
from worldstate.operations.recordings.evidence_report import WHY_NOT, common_lines
from worldstate.state import Entity, RiskCue, WorldState
from worldstate.state.text import plain, towards

# A snapshot with two entities has 1 kB: five to ten minutes are shown completely, and take at most 6 MB.
MOST_STATES = 3000
# Images have at most 12 MB of characters and sound 8 MB, so that a page stays below 27 MB. Sound of a street
# has little power above 8 kHz.
MOST_IMAGES, MOST_CHARACTERS = 300, 12_000_000
MOST_SOUND_S, HIGHEST_RATE_HZ, _MOST_RATE_HZ = 180.0, 16_000, 1_000_000
# A log contains images and sound within this time of the snapshots to which they belong.
_WRITTEN_WITHIN_NS = 1_000_000_000
# Half the sector in which a camera is searched for the source of a sound.
_BESIDE_RAD = math.radians(10.0)
# A street has fewer entities; after a fault that creates many, the likeliest ones are enough to show it.
_MOST_ENTITIES = 16

Row: TypeAlias = dict[str, object]


class PageData(TypedDict):
    """Data of the page: azimuths in degrees, left positive, times in seconds on the clock of the states."""

    title: str
    remarks: list[str]
    t0_s: float | None
    truth: list[list[Row]]
    states: list[Row]
    images: NotRequired[list[Row]]  # Time and data URI; "image" of a state is an index, -1 before the first
    sound: NotRequired[str]  # Data URI; the sound begins at the first snapshot


def write_log_page(path: Path, data: PageData) -> None:
    """Write the result of `page_data` as one page of HTML to this file."""
    write_text(path, page_html(data))


def page_html(data: PageData, live: str = "") -> str:
    """Return the page; `live` is a script that may connect to the server of the page only."""
    template = (files("worldstate") / "data" / "log_view.html").read_text("utf-8")
    # Inside a script element, only "<" can begin its end tag or a comment.
    text = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    page = template.replace("@connect@", "connect-src 'self'; " if live else "").replace("@live@", live)
    return page.replace("@data@", text)


def page_data(
    states: Iterable[WorldState],
    *,
    title: str = "",
    t0_s: float | None = None,
    truth: Sequence[TrueTrack] = (),
    media: Iterable[tuple[int, CompressedImage | RawAudio]] = (),
) -> PageData:
    """Return the data of the page from snapshots.

    Parameters
    ----------
    states : iterable of WorldState
        Snapshots of one run, at least one; beyond 6,000 only every second, fourth, ... is kept.
    title : str
        Heading of the page.
    t0_s : float, optional
        Time of line-of-sight entry, s.
    truth : sequence of TrueTrack
        True tracks of the vehicles of a simulated recording.
    media : iterable of (int, CompressedImage or RawAudio), optional
        Images and sound from `read_media`, each in order of their stamps, ns; read after the snapshots. The
        page holds at most 300 images with 12 MB, evenly spread, and 180 s of sound at no more than 16 kHz.

    Raises
    ------
    InvalidArgumentError
        If there is no snapshot, or if the sound is not of one microphone at one rate.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> page = page_data([WorldState(0, 0)])
    >>> with TemporaryDirectory() as folder:
    ...     write_log_page(Path(folder) / "log.html", page)
    >>> len(page["states"])
    1
    """
    kept, every, count, calibrated = list[tuple[int, Row]](), 1, 0, 0
    for count, state in enumerate(states, start=1):
        calibrated += state.calibrated
        if (count - 1) % every == 0:
            kept.append((state.stamp_ns, page_row(state)))
        if len(kept) > 2 * MOST_STATES:
            kept, every = kept[::2], 2 * every
    if not kept:
        raise InvalidArgumentError("states: expected at least one snapshot, got none")
    rows = [row for _, row in kept]
    for row in rows if not calibrated else ():
        row["thresholds"] = {}
    remarks = _remarks(count, every, calibrated)
    data = PageData(title=title, remarks=remarks, t0_s=t0_s, truth=list(map(_track, truth)), states=rows)
    _add_media(data, [stamp_ns for stamp_ns, _ in kept], media)
    return data


def _add_media(
    data: PageData, stamps_ns: Sequence[int], media: Iterable[tuple[int, CompressedImage | RawAudio]]
) -> None:
    """Add images and sound, in one reading of the log."""
    images, sound = _Images(stamps_ns[0], stamps_ns[-1]), _Sound(stamps_ns[0], stamps_ns[-1])
    for stamp_ns, one in media:
        if stamp_ns > stamps_ns[-1] + _WRITTEN_WITHIN_NS:
            break
        if isinstance(one, CompressedImage):
            images.take(stamp_ns, one)
        else:
            sound.take(stamp_ns, one)
    images.add_to(data, stamps_ns)
    sound.add_to(data)


@dataclass(slots=True)
class _Images:
    """Images since the last one before the first snapshot, thinned evenly to the limit of a page."""

    first_ns: int
    last_ns: int
    kept: list[tuple[int, str]] = field(default_factory=list)
    every: int = 1
    count: int = 0

    def take(self, stamp_ns: int, image: CompressedImage) -> None:
        if stamp_ns > self.last_ns:
            return
        if stamp_ns <= self.first_ns:
            self.kept, self.every, self.count = [], 1, 0
        if self.count % self.every == 0:
            self.kept.append((stamp_ns, f"data:image/{image.format};base64,{image.data}"))
        self.count += 1
        while len(self.kept) > MOST_IMAGES or sum(len(uri) for _, uri in self.kept) > MOST_CHARACTERS:
            self.kept, self.every = self.kept[::2] if len(self.kept) > 1 else [], 2 * self.every

    def add_to(self, data: PageData, stamps_ns: Sequence[int]) -> None:
        """Add the images, and to each snapshot the index of its image."""
        kept = self.kept
        if len(kept) < self.count:
            said = f"{len(kept)} of {self.count} images of the camera are shown, evenly spread over the time."
            data["remarks"].append(f"{said} The option --between shows more of a part.")
        if kept:
            data["images"] = [{"t": round(seconds(stamp_ns), 3), "src": uri} for stamp_ns, uri in kept]
            for stamp_ns, row in zip(stamps_ns, data["states"], strict=True):
                row["image"] = bisect_right(kept, stamp_ns, key=lambda one: one[0]) - 1


@dataclass(slots=True)
class _Sound:
    """Sound since the first snapshot, with silence for gaps in the log."""

    first_ns: int
    last_ns: int
    rate_hz: int = 0
    begun_ns: int = 0
    samples: NDArray[np.int16] = field(default_factory=lambda: np.zeros(0, np.int16))

    @property
    def span_s(self) -> float:
        """Length of the sound of the page, s."""
        return min(seconds(self.last_ns - self.first_ns), MOST_SOUND_S)

    def take(self, stamp_ns: int, block: RawAudio) -> None:
        if seconds(stamp_ns - self.first_ns) > self.span_s:
            return
        rate = self.rate_hz or block.sample_rate
        got = block.format, block.number_of_channels, block.sample_rate
        if got != ("pcm-s16", 1, rate) or not 0 < rate <= _MOST_RATE_HZ:
            raise InvalidArgumentError(f"sound: expected pcm-s16 of one channel at one rate, got {got}")
        if not self.rate_hz:
            self.rate_hz, self.begun_ns = rate, stamp_ns
            self.samples = np.zeros(round(self.span_s * rate), np.int16)
        told = base64.b64decode(block.data)
        heard = np.frombuffer(told, "<i2", len(told) // 2)
        # Later blocks are placed at whole samples from the first one, so that rounding leaves no gap.
        begun = round(seconds(self.begun_ns - self.first_ns) * rate)
        at = begun + round(seconds(stamp_ns - self.begun_ns) * rate)
        low, high = np.clip((at, at + len(heard)), 0, len(self.samples))
        self.samples[low:high] = heard[low - at : high - at]

    def add_to(self, data: PageData) -> None:
        if not self.samples.any():
            return
        samples, step = self.samples, -(-self.rate_hz // HIGHEST_RATE_HZ)
        if step > 1:
            from scipy import signal  # Imported here: it takes 1 s, and a page without sound does not need it

            resampled = signal.resample_poly(samples.astype(float), 1, step)
            samples = np.clip(np.rint(resampled), -32768, 32767).astype(np.int16)
        file = io.BytesIO()
        soundfile.write(file, samples, round(self.rate_hz / step), "PCM_16", format="WAV")
        data["sound"] = "data:audio/wav;base64," + base64.b64encode(file.getvalue()).decode()
        if seconds(self.last_ns - self.first_ns) > self.span_s:
            said = f"The sound is that of the first {self.span_s:g} s."
            data["remarks"].append(f"{said} The option --between chooses another part.")


def _remarks(count: int, every: int, calibrated: int) -> list[str]:
    """Return the limitations of the page, for its reader."""
    said = []
    if not calibrated:
        said.append("Not calibrated: no snapshot keeps a budget of false alarms. No threshold is drawn.")
    elif calibrated < count:
        said.append(
            f"{count - calibrated} of {count} snapshots are not calibrated: nothing could be heard, or the "
            "budget was broken."
        )
    if every > 1:
        said.append(
            f"One of {every} snapshots is shown of {count}: shorter events may be missing. "
            "The option --between shows every snapshot of a part."
        )
    return said


def headline(state: WorldState) -> str:
    """Return the first sentence of the page: the advisories or the highest risk, and whether it may be used.

    Examples
    --------
    >>> headline(WorldState(0, 0))
    'There is no measurement yet.'
    """
    sides = sorted((cue for cue in state.cues if cue.direction), key=lambda cue: -(cue.risk or 0.0))
    advised = "; ".join(f"{plain(cue.direction)}: {_hidden(cue)}" for cue in sides if cue.advisory)
    if advised:
        said = f"{advised[0].upper()}{advised[1:]}."
    elif sides and sides[0].risk is not None:
        said = f"No advisory: the highest risk is {sides[0].risk:.2f}, on the {plain(sides[0].direction)}."
    elif state.bearing is not None:
        said = f"A sound comes from {towards(state.bearing.azimuth_rad)}; no risk can be stated."
    else:
        said = "No risk can be stated." if state.seq else "There is no measurement yet."
    reasons = dict.fromkeys(WHY_NOT[one] for cue in sides for one in cue.why_not)
    return f"{said} Do not act on it: {'; '.join(reasons)}." if reasons else said


def _hidden(cue: RiskCue) -> str:
    if (within := (cue.within or {}).get("3")) is None:
        return f"a vehicle is hidden, risk {cue.risk or 0.0:.2f}"
    return f"a vehicle is hidden, {100.0 * within:.0f} % to appear within 3 s"


def is_reflected(state: WorldState) -> bool:
    """Return whether the loudest sound is probably reflected, or diffracted around a corner.

    This holds while a vehicle is probably hidden, unless a vehicle in view is within 10 degrees of the sound:
    the sound of a hidden vehicle has no straight path to the array.

    Examples
    --------
    >>> is_reflected(WorldState(0, 0))
    False
    """
    if state.bearing is None or not any(cue.advisory or (cue.risk or 0.0) >= 0.5 for cue in state.cues):
        return False
    in_view = (one for one in state.entities if one.moving and one.status in ("emerged", "visible"))
    apart_rad = (math.remainder(one.azimuth_rad - state.bearing.azimuth_rad, math.tau) for one in in_view)
    return not any(abs(one) <= _BESIDE_RAD for one in apart_rad)


def page_row(state: WorldState) -> Row:
    """Return the data of one snapshot for the page, rounded to the resolution of the drawing."""
    parts = (part for one in state.entities if one.moving for part in one.on_each_side())
    likeliest = sorted(parts, key=lambda one: -one.existence_probability)[:_MOST_ENTITIES]
    bearing = state.bearing
    stated = [(one.direction, one.evidence) for one in state.cues if one.direction and one.evidence]
    return {
        "t": round(state.time_s, 3),
        "sentence": headline(state),
        "entities": list(map(_entity, likeliest)),
        "cues": [_cue(one) for one in state.cues if one.direction is not None],
        "thresholds": {side: round(one.threshold_nats, 2) for side, one in stated},
        "bearing": None if bearing is None else degrees(bearing.azimuth_rad),
        "reflected": is_reflected(state),
        "prominence": None if bearing is None else round(bearing.prominence, 2),
        "corners": [
            {
                "edge": degrees(one.edge_azimuth_rad),
                "assumed": one.assumed,
                "crossing": CROSSING_M if one.crossing_m is None else one.crossing_m,
                **ends_deg(hidden_sector(one)),
            }
            for one in state.context.occluders
        ],
        "searched": [
            {"sensor": one.sensor, "found": one.found, **ends_deg(one.sector_rad)} for one in state.searched
        ],
        "heard": {one.sensor: round(one.share, 2) for one in state.heard or ()},
        "foreign": isinstance(state.domain, Foreign),
        "notes": list(common_lines(state)),
    }


def _entity(one: Entity) -> Row:
    return {
        "id": one.id[:8],
        "hidden": one.status and one.status == "hidden",  # None without a model
        "label": label_of(one),
        "existence": round(one.existence_probability, 3),
        "azimuth": degrees(one.azimuth_rad),
        **ends_deg(sector_of(one.azimuth_rad, one.azimuth_std_rad, one.sector_rad)),
        "place": None if one.position_m is None else [round(value, 1) for value in one.position_m[:2]],
    }


def _cue(one: RiskCue) -> Row:
    within, evidence, held = one.within or {}, one.evidence, None
    if one.held is not None:
        held = f"below the threshold, ends at the latest at {seconds(one.held.until_ns):.1f} s"
    return {
        "side": one.direction,
        "risk": None if one.risk is None else round(one.risk, 5),
        "within": round(within["3"], 5) if "3" in within else None,
        "since": None if one.advisory is None else round(seconds(one.advisory.since_ns), 3),
        "said": [text for text in (held, one.not_advised) if text],
        "usable": one.usable,
        "why_not": list(one.why_not),
        **ends_deg(sector_of(one.azimuth_rad, one.azimuth_std_rad, one.sector_rad)),
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


def ends_deg(sector_rad: tuple[float, float]) -> Row:
    """Return the ends of a sector in degrees."""
    low, high = map(degrees, sector_rad)
    return {"low": low, "high": high}


def degrees(azimuth_rad: float) -> float:
    """Return an azimuth in degrees, rounded for the page."""
    return round(math.degrees(azimuth_rad), 1)
