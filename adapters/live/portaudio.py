"""PortAudio by way of sounddevice, which comes with the extra `live`."""

from typing import Any

from worldstate.ground.errors import MissingExtraError, WorldstateError


class MissingPortAudioError(WorldstateError):
    """The package is there, the system's library that it speaks to is not."""


def portaudio() -> Any:
    """Return the module `sounddevice`.

    Raises
    ------
    MissingExtraError
        If it is not installed.
    MissingPortAudioError
        If it finds no PortAudio library.
    """
    try:
        import sounddevice
    except ImportError as error:
        raise MissingExtraError("sounddevice", "live") from error
    except OSError as error:
        raise MissingPortAudioError(
            "expected the system's library PortAudio, found none: install it "
            "(Debian, Ubuntu: apt-get install libportaudio2; Fedora: dnf install portaudio; "
            "macOS and Windows: it comes with sounddevice)"
        ) from error
    return sounddevice
