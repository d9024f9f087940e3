"""What options and headers of files tell of a call, checked before what listens is imported."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

from worldstate.ground.errors import InvalidArgumentError
from worldstate.ground.extras import check_extra

from .exports import needed_extras
from .sensors import MOVING

if TYPE_CHECKING:
    from worldstate.frontend.array.microphone_array import MicrophoneArray

    from .sensors import GivenSensors

# A signature is a line of a model file; no model that `save_model` writes has a longer one.
_LONGEST_LINE = 1 << 20
_EXTRAS = {"figure": "matplotlib", "camera_device": "cv2"}


def check_call(given: "GivenSensors", sound: list[Path]) -> None:
    """Refuse what cannot be heard: a missing extra, no array for a sound file, not the model's array.

    It takes some .5 s of processor time less than to import what listens and to read a model.

    Raises
    ------
    MissingExtraError, InputFileError, OutOfDomainError
        As the call that listens would, later.
    """
    arguments = given.arguments
    wanted = {module for option, module in _EXTRAS.items() if getattr(arguments, option, None) is not None}
    looks = arguments.detector in MOVING and "camera_device" not in arguments
    check_extra(*wanted, *needed_extras(arguments), *(["cv2"] if looks else []))
    made_for = array_of_model(given.model)
    if made_for is not None:
        _check_array(given, made_for, sound)


def _check_array(given: "GivenSensors", made_for: "MicrophoneArray", sound: list[Path]) -> None:
    from worldstate.adapters.datasets.array_choice import check_channels, named_array
    from worldstate.adapters.files.array_match import WAY_OUT, matched_order

    if any(named_array(path) is not None for path in sound):
        return
    array = given.car.array
    if array is None:
        if len(sound) == 1 and sound[0].is_file():
            check_channels(sound[0], made_for)
    elif not given.arguments.uncalibrated:
        matched_order(made_for, array, WAY_OUT)


def array_of_model(path: Path | None = None) -> "MicrophoneArray | None":
    """Return the array that the first lines of a model file name, None where they are of another form.

    Examples
    --------
    >>> array_of_model().n_microphones
    56
    """
    from importlib.resources import files

    from worldstate.frontend.array.microphone_array import MicrophoneArray

    shipped = files("worldstate") / "data" / "default_model.json"
    try:
        with (shipped if path is None else path).open(encoding="utf-8") as file:
            lines = iter(lambda: file.readline(_LONGEST_LINE), "")
            line = next(one for one in lines if one.startswith('"signature": {'))
        domain = json.loads(f"{{{line.rstrip().rstrip(',')}}}")["signature"]["domain"]
        return MicrophoneArray(domain["positions_m"], domain["array"])
    except (OSError, StopIteration, ValueError, LookupError, TypeError, InvalidArgumentError):
        return None  # what reads the whole file says what is wrong with it
