"""MELAUDIS: vehicles in the streets of Melbourne, recorded with phones on the pavement.

H. Parineh, M. Sarvi, S. A. Bagloee, "MELAUDIS: A large-scale benchmark acoustic dataset for intelligent
transportation systems research", Scientific Data 12, 362, 2025; doi:10.6084/m9.figshare.27115870, two
archives that unpack to::

    <root>/MELAUDIS_Vehicles/**/<name>.wav    two seconds around a passage, 13,668 of them
    <root>/MELAUDIS_BG/**/<name>.wav          without a vehicle

The data descriptor ("Data Features") says what the name of a vehicle clip holds: date, time and place, state
of the traffic (FF free flow, TJN and TJF jams), number and kind of vehicles, lanes, direction, and mono or
stereo, which tells the two models of phone apart::

    2024-02-09_13-0-1.8-Fitzroy1_FF_1V-Car_2Lanes_LR_stereo.wav

Only free flow with one vehicle is used (1V-Car, -Truck, -Bus, -MC, -Tram, -Bic), and NoV as background. How
the files of MELAUDIS_BG are named is not documented: any WAV there is background, cut into clips where it is
longer, of the day and place with which its name begins, else a recording of its own.
"""

import re
from pathlib import Path

import numpy as np

from worldstate.adapters.audio.sound_file import open_audio
from worldstate.ground.errors import InputFileError

from .traffic_clips import BACKGROUND, CLIP_S, ClipLabels, TrafficClip, check_number, refuse_missing

VEHICLES_NAME, BACKGROUND_NAME = "MELAUDIS_Vehicles", "MELAUDIS_BG"
KINDS = {"Car": "car", "Truck": "truck", "Bus": "bus", "MC": "motorcycle", "Tram": "tram", "Bic": "bicycle"}
# Neighbouring clips of a long recording say the same; so many of them, evenly apart, tell its spread.
CLIPS_A_FILE = 20
# Minutes of 60 to 62 occur: the time is not read as one.
_WHERE = r"(?P<date>\d{4}-\d{2}-\d{2})_\d+-\d+-[\d.]+-(?P<place>[A-Za-z]+)(?P<spot>\d*[A-Za-z]?)"
_NAME = re.compile(
    _WHERE + r"_(?P<state>[A-Z]+)_(?P<what>NoV|\dV-\w+?)(?:_\w+)?_(?:mono|stereo)",
    re.ASCII,
)
# A stray file does no harm; many are a release with other names, of which a part would be used unsaid.
_MOST_UNREAD = 0.01
_BEGINNING = re.compile(_WHERE + r"(?![A-Za-z\d])", re.ASCII)


def melaudis(root: str | Path) -> list[TrafficClip]:
    """List the clips of one vehicle in free flow and those of the background; refuse a partial folder."""
    folder = Path(root)
    found = {name: sorted((folder / name).rglob("*.wav")) for name in (VEHICLES_NAME, BACKGROUND_NAME)}
    missing = [f"{name}/**/*.wav" for name, files in found.items() if not files]
    refuse_missing(folder, "MELAUDIS (both archives unpacked side by side)", missing)
    check_number(folder, found[VEHICLES_NAME] + found[BACKGROUND_NAME])
    vehicles = [(path, _NAME.fullmatch(path.stem)) for path in found[VEHICLES_NAME]]
    unread = [path.name for path, name in vehicles if name is None]
    if len(unread) > _MOST_UNREAD * len(vehicles):
        example = "2024-02-09_13-0-1.8-Fitzroy1_FF_1V-Car_2Lanes_LR_stereo.wav"
        got = f"{len(unread)} of {len(vehicles)} others, the first {unread[0][:100]!r}"
        raise InputFileError(folder / VEHICLES_NAME, f"expected names such as {example}, got {got}")
    clips = [clip for path, name in vehicles if name is not None for clip in _vehicle_clips(path, name)]
    return clips + [clip for path in found[BACKGROUND_NAME] for clip in _background_clips(folder, path)]


def _vehicle_clips(path: Path, found: re.Match[str]) -> list[TrafficClip]:
    """Return the clip of a file; none where it holds a jam or several vehicles."""
    single = KINDS.get(found["what"].removeprefix("1V-"))
    kind = BACKGROUND if found["what"] == "NoV" else single
    if kind is None or found["state"] != "FF":
        return []
    return [TrafficClip(path, _labels(kind, found))]


def _labels(kind: str, found: re.Match[str]) -> ClipLabels:
    # Start and end of the original recordings are not published. A day at a spot is the least that shares
    # its background, so what is learned on one clip of it is not tested on the next.
    return ClipLabels(kind, "phone", f"{found['date']}_{found['place']}{found['spot']}", found["place"])


def _background_clips(root: Path, path: Path) -> list[TrafficClip]:
    try:
        with open_audio(path, strict=False) as source:
            last_s = max(source.duration_s - CLIP_S, 0.0)
    except InputFileError:
        return [TrafficClip(path, _background(root, path))]  # which is reported when it is read
    starts = np.linspace(0.0, last_s, min(int(last_s // CLIP_S) + 1, CLIPS_A_FILE))
    return [TrafficClip(path, _background(root, path), start_s) for start_s in starts.tolist()]


def _background(root: Path, path: Path) -> ClipLabels:
    found = _BEGINNING.match(path.stem)
    if found is not None:
        return _labels(BACKGROUND, found)
    return ClipLabels(BACKGROUND, "phone", path.relative_to(root).with_suffix("").as_posix(), "")
