"""IDMT-Traffic: passing vehicles at four roads, recorded with studio and with MEMS microphones.

J. Abesser et al., "IDMT-Traffic: An open benchmark dataset for acoustic traffic monitoring research",
EUSIPCO 2021; doi:10.5281/zenodo.7551553. The layout is that of its readme and of its import script,
``annotation/import_idmt_traffic_dataset.py``::

    <root>/annotation/idmt_traffic_all.txt      one file name a line, 17,506 of them
    <root>/annotation/eusipco_2021_train.txt    the official split
    <root>/annotation/eusipco_2021_test.txt
    <root>/audio/<name>.wav                     2 s, two channels, 48 kHz

A name holds date and time, location, speed limit, middle of the clip in samples of its recording, time of
day (M, A), road (D dry, W wet), vehicle (B bus, C car, M motorcycle, T truck) with the side that it comes
from (L, R), microphone (SE sE8 studio, ME ICS-43434 MEMS) and channel pair::

    2019-10-22-08-40_Fraunhofer-IDMT_30Kmh_1272258_M_D_CR_ME_CH12.wav
    2019-10-22-08-40_Fraunhofer-IDMT_30Kmh_10077440_SE_CH34-BG.wav       without a vehicle
"""

import re
from pathlib import Path

from worldstate.adapters.files.text_file import read_text
from worldstate.ground.errors import InputFileError

from .traffic_clips import BACKGROUND, ClipLabels, TrafficClip, check_number, refuse_missing

ALL_NAME = "idmt_traffic_all.txt"
SPLIT_NAMES = {"train": "eusipco_2021_train.txt", "test": "eusipco_2021_test.txt"}
VEHICLES = {"B": "bus", "C": "car", "M": "motorcycle", "T": "truck"}
MICROPHONES = {"SE": "studio", "ME": "mems"}
_MAX_BYTES = 16 << 20
_NAME = re.compile(
    r"(?P<stamp>\d{4}(?:-\d{2}){4})_(?P<site>[\w.-]+?)_(?P<limit>\d+|unknown)Kmh_(?P<middle>\d+)"
    r"(?:_[MA]_[DW]_(?P<vehicle>[BCMT])[LR])?_(?P<microphone>SE|ME)_CH\d+(?P<background>-BG)?",
    re.ASCII,
)


def idmt_traffic(root: str | Path) -> list[TrafficClip]:
    """List the clips of the data set; refuse a folder that lacks a list or any of the sound that it names."""
    folder = Path(root)
    lists = (ALL_NAME, *SPLIT_NAMES.values())
    missing = [f"annotation/{name}" for name in lists if not (folder / "annotation" / name).is_file()]
    refuse_missing(folder, "IDMT-Traffic (audio/*.wav and annotation/*.txt)", missing)
    names = _names(folder / "annotation" / ALL_NAME)
    check_number(folder, names)
    # One look into the folder: 17,506 questions to a network disk take minutes.
    there = {path.name for path in (folder / "audio").glob("*.wav")}
    missing = [f"audio/{name}" for name in names if name not in there]
    refuse_missing(folder, f"the {len(names)} clips of annotation/{ALL_NAME}", missing)
    splits = {
        name: part for part, file in SPLIT_NAMES.items() for name in _names(folder / "annotation" / file)
    }
    return [
        TrafficClip(folder / "audio" / name, _labels(folder, name, splits.get(name, ""))) for name in names
    ]


def _names(path: Path) -> list[str]:
    """Return the file names of a list; its lines may lack the suffix."""
    lines = read_text(path, "a list of file names", _MAX_BYTES).splitlines()
    names = [line.strip().removesuffix(".wav") + ".wav" for line in lines if line.strip()]
    if not names:
        raise InputFileError(path, "expected one file name a line, the list is empty")
    return names


def _labels(folder: Path, name: str, split: str) -> ClipLabels:
    found = _NAME.fullmatch(name.removesuffix(".wav"))
    # A clip is either of a vehicle or of the background; a name that says both or neither is no label.
    if found is None or (found["vehicle"] is None) == (found["background"] is None):
        problem = f"expected a name such as ..._30Kmh_1272258_M_D_CR_ME_CH12.wav, got {name[:100]!r}"
        raise InputFileError(folder / "annotation" / ALL_NAME, problem)
    kind = BACKGROUND if found["vehicle"] is None else VEHICLES[found["vehicle"]]
    # Both microphones heard the same passage: they share a recording, so that no fold parts them.
    recording = f"{found['stamp']}_{found['site']}_{found['limit']}"
    return ClipLabels(kind, MICROPHONES[found["microphone"]], recording, found["site"], split)
