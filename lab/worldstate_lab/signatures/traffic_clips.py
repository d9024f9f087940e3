"""Two-second clips of roadside traffic, from IDMT-Traffic and MELAUDIS: their files and labels."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from worldstate.adapters.audio.sound_file import open_audio
from worldstate.adapters.files.file_io import read_text
from worldstate.ground.errors import InputFileError
from worldstate.ground.typing import Float32Array

CLIP_S = 2.0
BACKGROUND = "background"
# Maximum number of names in an error message.
_NAMED = 8


@dataclass(frozen=True, slots=True)
class ClipLabels:
    """Labels of a clip."""

    kind: str  # `BACKGROUND` or the kind of the single passing vehicle
    microphone: str  # "studio", "mems" or "phone"
    recording: str  # Recording, the same for clips with the same day, place and background
    site: str
    split: str = ""  # "train" or "test" of an official split


@dataclass(frozen=True, slots=True)
class TrafficClip:
    """Two seconds of a sound file."""

    path: Path
    labels: ClipLabels
    start_s: float = 0.0


def read_clip(clip: TrafficClip) -> tuple[Float32Array, float]:
    """Return the samples of a clip, shape (n, channels), and their rate in Hz."""
    with open_audio(clip.path) as source:
        start, rate = round(clip.start_s * source.sample_rate_hz), source.sample_rate_hz
        # A few clips of MELAUDIS are shorter than two seconds.
        return source.span(start, min(round(CLIP_S * rate), source.frames - start)), float(rate)


def _refuse_missing(root: Path, corpus: str, missing: Sequence[str]) -> None:
    """Raise an error that lists the missing parts of a folder, if there are any."""
    if missing:
        more = f" and {len(missing) - _NAMED} more" if len(missing) > _NAMED else ""
        raise InputFileError(root, f"expected {corpus}; missing: {', '.join(missing[:_NAMED])}{more}")


ALL_NAME = "idmt_traffic_all.txt"
SPLIT_NAMES = {"train": "eusipco_2021_train.txt", "test": "eusipco_2021_test.txt"}
VEHICLES = {"B": "bus", "C": "car", "M": "motorcycle", "T": "truck"}
MICROPHONES = {"SE": "studio", "ME": "mems"}
_MAX_BYTES = 16 << 20
_IDMT_NAME = re.compile(
    r"(?P<stamp>\d{4}(?:-\d{2}){4})_(?P<site>[\w.-]+?)_(?P<limit>\d+|unknown)Kmh_(?P<middle>\d+)"
    r"(?:_[MA]_[DW]_(?P<vehicle>[BCMT])[LR])?_(?P<microphone>SE|ME)_CH\d+(?P<background>-BG)?",
    re.ASCII,
)


def idmt_traffic(root: str | Path) -> list[TrafficClip]:
    """List the clips of the data set; raise an error if a list or any listed sound file is missing.

    IDMT-Traffic: passing vehicles at four roads, recorded with studio and with MEMS microphones.

    J. Abesser et al., "IDMT-Traffic: An open benchmark dataset for acoustic traffic monitoring research",
    EUSIPCO 2021; doi:10.5281/zenodo.7551553. The layout is that of its readme and of its import script,
    ``annotation/import_idmt_traffic_dataset.py``::

        <root>/annotation/idmt_traffic_all.txt      one file name per line, 17,506 of them
        <root>/annotation/eusipco_2021_train.txt    the official split
        <root>/annotation/eusipco_2021_test.txt
        <root>/audio/<name>.wav                     2 s, two channels, 48 kHz

    A name contains date and time, location, speed limit, centre of the clip in samples of its recording, time
    of day (M, A), road (D dry, W wet), vehicle (B bus, C car, M motorcycle, T truck) with the side from which
    it comes (L, R), microphone (SE sE8 studio, ME ICS-43434 MEMS) and channel pair::

        2019-10-22-08-40_Fraunhofer-IDMT_30Kmh_1272258_M_D_CR_ME_CH12.wav
        2019-10-22-08-40_Fraunhofer-IDMT_30Kmh_10077440_SE_CH34-BG.wav       without a vehicle
    """
    folder = Path(root)
    lists = (ALL_NAME, *SPLIT_NAMES.values())
    missing = [f"annotation/{name}" for name in lists if not (folder / "annotation" / name).is_file()]
    _refuse_missing(folder, "IDMT-Traffic (audio/*.wav and annotation/*.txt)", missing)
    names = _names(folder / "annotation" / ALL_NAME)
    # One listing of the folder: 17,506 separate queries to a network disk take minutes.
    there = {path.name for path in (folder / "audio").glob("*.wav")}
    missing = [f"audio/{name}" for name in names if name not in there]
    _refuse_missing(folder, f"the {len(names)} clips of annotation/{ALL_NAME}", missing)
    splits = {one: part for part, file in SPLIT_NAMES.items() for one in _names(folder / "annotation" / file)}
    return [
        TrafficClip(folder / "audio" / name, _idmt_labels(folder, name, splits.get(name, "")))
        for name in names
    ]


def _names(path: Path) -> list[str]:
    """Return the file names of a list; its lines may lack the suffix."""
    lines = read_text(path, "a list of file names", _MAX_BYTES).splitlines()
    names = [line.strip().removesuffix(".wav") + ".wav" for line in lines if line.strip()]
    if not names:
        raise InputFileError(path, "expected one file name per line, the list is empty")
    return names


def _idmt_labels(folder: Path, name: str, split: str) -> ClipLabels:
    found = _IDMT_NAME.fullmatch(name.removesuffix(".wav"))
    # A clip is either of a vehicle or of background; a name with both or neither is invalid.
    if found is None or (found["vehicle"] is None) == (found["background"] is None):
        problem = f"expected a name such as ..._30Kmh_1272258_M_D_CR_ME_CH12.wav, got {name[:100]!r}"
        raise InputFileError(folder / "annotation" / ALL_NAME, problem)
    kind = BACKGROUND if found["vehicle"] is None else VEHICLES[found["vehicle"]]
    # Both microphones recorded the same passage: they share a recording, so that no fold separates them.
    recording = f"{found['stamp']}_{found['site']}_{found['limit']}"
    return ClipLabels(kind, MICROPHONES[found["microphone"]], recording, found["site"], split)


VEHICLES_NAME, BACKGROUND_NAME = "MELAUDIS_Vehicles", "MELAUDIS_BG"
KINDS = {"Car": "car", "Truck": "truck", "Bus": "bus", "MC": "motorcycle", "Tram": "tram", "Bic": "bicycle"}
# Neighbouring clips of a long recording are similar; this many, evenly spaced, represent its variation.
CLIPS_A_FILE = 20
# Minutes of 60 to 62 occur, so the time is not parsed.
_WHERE = r"(?P<date>\d{4}-\d{2}-\d{2})_\d+-\d+-[\d.]+-(?P<place>[A-Za-z]+)(?P<spot>\d*[A-Za-z]?)"
_MELAUDIS_NAME = re.compile(
    _WHERE + r"_(?P<state>[A-Z]+)_(?P<what>NoV|\dV-\w+?)(?:_\w+)?_(?:mono|stereo)", re.ASCII
)
# A single stray file is harmless. Many indicate a release with other names, of which only a part would be
# used without notice.
_MOST_UNREAD = 0.01
_BEGINNING = re.compile(_WHERE + r"(?![A-Za-z\d])", re.ASCII)


def melaudis(root: str | Path) -> list[TrafficClip]:
    """List the clips of one vehicle in free flow and of the background; raise an error for a partial folder.

    MELAUDIS: vehicles in the streets of Melbourne, recorded with phones on the pavement.

    H. Parineh, M. Sarvi, S. A. Bagloee, "MELAUDIS: A large-scale benchmark acoustic dataset for intelligent
    transportation systems research", Scientific Data 12, 362, 2025; doi:10.6084/m9.figshare.27115870, two
    archives that unpack to::

        <root>/MELAUDIS_Vehicles/**/<name>.wav    two seconds around a passage, 13,668 of them
        <root>/MELAUDIS_BG/**/<name>.wav          without a vehicle

    According to the data descriptor ("Data Features"), the name of a vehicle clip contains date, time and
    place, state of the traffic (FF free flow, TJN and TJF jams), number and kind of vehicles, lanes,
    direction, and mono or stereo, which distinguishes the two models of phone::

        2024-02-09_13-0-1.8-Fitzroy1_FF_1V-Car_2Lanes_LR_stereo.wav

    Only free flow with one vehicle is used (1V-Car, -Truck, -Bus, -MC, -Tram, -Bic), and NoV as background.
    The names of the files in MELAUDIS_BG are not documented: every WAV there is background and is cut into
    clips if it is longer. If its name begins with a day and a place, these define its recording; otherwise
    the file is a recording of its own.
    """
    folder = Path(root)
    found = {name: sorted((folder / name).rglob("*.wav")) for name in (VEHICLES_NAME, BACKGROUND_NAME)}
    missing = [f"{name}/**/*.wav" for name, files in found.items() if not files]
    _refuse_missing(folder, "MELAUDIS (both archives unpacked side by side)", missing)
    vehicles = [(path, _MELAUDIS_NAME.fullmatch(path.stem)) for path in found[VEHICLES_NAME]]
    unread = [path.name for path, name in vehicles if name is None]
    if len(unread) > _MOST_UNREAD * len(vehicles):
        example = "2024-02-09_13-0-1.8-Fitzroy1_FF_1V-Car_2Lanes_LR_stereo.wav"
        got = f"{len(unread)} of {len(vehicles)} others, the first {unread[0][:100]!r}"
        raise InputFileError(folder / VEHICLES_NAME, f"expected names such as {example}, got {got}")
    clips = [clip for path, name in vehicles if name is not None for clip in _vehicle_clips(path, name)]
    return clips + [clip for path in found[BACKGROUND_NAME] for clip in _background_clips(folder, path)]


def _vehicle_clips(path: Path, found: re.Match[str]) -> list[TrafficClip]:
    """Return the clip of a file; empty if it contains a jam or several vehicles."""
    single = KINDS.get(found["what"].removeprefix("1V-"))
    kind = BACKGROUND if found["what"] == "NoV" else single
    if kind is None or found["state"] != "FF":
        return []
    return [TrafficClip(path, _melaudis_labels(kind, found))]


def _melaudis_labels(kind: str, found: re.Match[str]) -> ClipLabels:
    # Start and end of the original recordings are not published. Clips of one day and spot share a
    # background, so they are never divided between training and test.
    return ClipLabels(kind, "phone", f"{found['date']}_{found['place']}{found['spot']}", found["place"])


def _background_clips(root: Path, path: Path) -> list[TrafficClip]:
    try:
        with open_audio(path, strict=False) as source:
            last_s = max(source.duration_s - CLIP_S, 0.0)
    except InputFileError:
        return [TrafficClip(path, _background(root, path))]  # an error is raised when it is read
    starts = np.linspace(0.0, last_s, min(int(last_s // CLIP_S) + 1, CLIPS_A_FILE))
    return [TrafficClip(path, _background(root, path), start_s) for start_s in starts.tolist()]


def _background(root: Path, path: Path) -> ClipLabels:
    found = _BEGINNING.match(path.stem)
    if found is not None:
        return _melaudis_labels(BACKGROUND, found)
    return ClipLabels(BACKGROUND, "phone", path.relative_to(root).with_suffix("").as_posix(), "")
