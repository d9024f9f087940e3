"""Inputs of a calibration: data sets, recordings, sound files, saved hop streams."""

import json
from pathlib import Path
from zlib import crc32

from worldstate.adapters.datasets.ovad import LOG_NAME, OvadDataset, Recording
from worldstate.adapters.files.model_file import read_model
from worldstate.adapters.listener import measure_steps
from worldstate.adapters.source import ListenSettings, open_source
from worldstate.frontend.array.microphone_array import MicrophoneArray
from worldstate.ground.errors import InputFileError, OutOfDomainError
from worldstate.ground.serialisation import encode
from worldstate.operations.recordings.hop_table import HopTable, hop_stream, load_streams


def find_inputs(path: Path) -> list[Path]:
    """Return the recordings of a data set, or the file or recording folder itself."""
    if not path.exists():
        raise InputFileError(path, "expected a data set, a recording folder or a sound file")
    if path.is_dir() and (path / LOG_NAME).is_file():
        return [recording.path for recording in OvadDataset(path).recordings]
    return [path]


def read_input(
    path: Path, *, array: MicrophoneArray | None = None, model: Path | None = None
) -> list[HopTable]:
    """Listen to a recording or read streams; a sound file counts as hazard-free."""
    chosen = read_model(model)
    # What was heard are this signature's scores: another one's thresholds cannot be set on them.
    about = {"signature": crc32(json.dumps(encode(chosen.signature)).encode())}
    if path.suffix == ".npz":
        streams = load_streams(path)
        if any({**about, **stream.about} != about for stream in streams):
            raise OutOfDomainError(f"{path}: heard with another model's signature; listen to the sound again")
        return streams
    source = open_source(path, array=array, model=chosen, settings=ListenSettings(alpha=None))
    measured = (measurement for _, measurement in measure_steps(source))
    if not path.is_dir():
        return [hop_stream(measured, name=str(path)).replace(about=about)]
    recording = Recording.open(path)
    name = "/".join(filter(None, (recording.environment, recording.recording_id)))
    stream = hop_stream(measured, name=name, label=recording.label or "none", t0_s=source.t0_s)
    return [stream.replace(about=about)]
