"""Choose the array that a recording was made with: the data set's, the user's, or a default."""

import logging
from pathlib import Path

import numpy as np

from worldstate.adapters.audio.sound_file import open_audio
from worldstate.adapters.files.array_file import read_array
from worldstate.adapters.files.array_match import array_difference, microphone_order
from worldstate.frontend.array.microphone_array import MicrophoneArray, ovad_array
from worldstate.ground.errors import InputFileError, OutOfDomainError

from .ovad import ARRAY_NAME, AUDIO_NAME, LOG_NAME

_LOG = logging.getLogger(__name__)


def choose_array(
    path: Path,
    given: MicrophoneArray | None = None,
    *,
    assumed: MicrophoneArray | None = None,
    trust_given: bool = False,
) -> MicrophoneArray:
    """Return the array of a recording, a data set or a sound file, in the order of the channels.

    `array.xml` beside the sound or in the root of its data set is right; an array given must be the same one,
    and where it lists the same places in another order the data set's order counts. Without such a file the
    array given is taken, then OVAD's for a folder, then the one assumed for a sound file.

    Parameters
    ----------
    path : Path
        Data set, recording folder or sound file.
    given : MicrophoneArray, optional
        By the user.
    assumed : MicrophoneArray, optional
        For a sound file that nothing is known of, if it has as many channels; OVAD's where not given.
    trust_given : bool
        Take the array given whatever the data set says.

    Raises
    ------
    OutOfDomainError
        If the array given is not that of the data set.
    InputFileError
        If the data set's array is damaged, or a sound file has other channels than the array assumed.
    """
    named = named_array(path)
    if given is not None and (named is None or trust_given):
        return given
    if named is None:
        return ovad_array() if path.is_dir() else _assumed(path, assumed or ovad_array())
    own = read_array(named)
    if given is not None:
        order = microphone_order(own.positions_m, given)
        if order is None:
            difference = array_difference(own.positions_m, given)
            raise OutOfDomainError(f"{given.name}: not the array of {named}: {difference}. Leave --array out")
        if (np.diff(order) != 1).any():
            _LOG.warning("%s: in another order than %s, whose order counts", given.name, named)
    return own


def named_array(path: Path) -> Path | None:
    """Return the file that names the array of a data set, recording or sound file, None without one."""
    folder = path if path.is_dir() else path.parent
    roots = [folder]
    if path.is_dir() or path.name == AUDIO_NAME:
        roots += [root for root in folder.absolute().parents[2:3] if (root / LOG_NAME).is_file()]
    return next((root / ARRAY_NAME for root in roots if (root / ARRAY_NAME).is_file()), None)


def check_channels(path: Path, array: MicrophoneArray) -> None:
    """Refuse a sound file of which no array is named and that has other channels than the one assumed.

    Raises
    ------
    InputFileError
        Then; the message says how to go on.
    """
    with open_audio(path, strict=False) as audio:
        if audio.channels != array.n_microphones:
            wanted = f"expected --array FILE, or {ARRAY_NAME} beside it, for its {audio.channels} channels"
            other = f"{array.name}, the array of the model, has {array.n_microphones}"
            ways = (
                "With it `worldstate array bearings` needs no model; `worldstate model make` makes one for it"
            )
            raise InputFileError(path, f"{wanted}; {other}. {ways}")


def _assumed(path: Path, array: MicrophoneArray) -> MicrophoneArray:
    """Return the array that a sound file is taken to be of, if it has as many channels."""
    check_channels(path, array)
    _LOG.warning("%s: no array is named; taken as %s, %d microphones", path, array.name, array.n_microphones)
    return array
