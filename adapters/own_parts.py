"""Parts that installed packages bring, each by its entry point: detectors, exporters, other modalities.

A package names them in its pyproject.toml, and the command line names one of them:

| group of entry points | what stands there | option |
|---|---|---|
| `worldstate.detectors` | `DetectorPart` | ``--detector NAME`` |
| `worldstate.exporters` | `ExporterPart` | ``--export NAME=TARGET`` |
| `worldstate.measurements` | `MeasurementsPart` | ``--measurements NAME=FILE`` |
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Literal, TypeAlias

from worldstate.adapters.camera.detections import DetectionFrame, Detector
from worldstate.core.fixed_lag import Timed
from worldstate.ground.errors import InvalidArgumentError, OwnPartError, WorldstateError
from worldstate.ground.typing import ImageArray
from worldstate.state import WorldState

# Exit codes above it are those of signals.
SIGNALLED = 128
Group = Literal["worldstate.detectors", "worldstate.exporters", "worldstate.measurements"]
# What other modalities say, each time it is asked for anew.
OtherModality: TypeAlias = Callable[[], Iterable[Timed]]


# Makes a detector that has seen no image, a new one for every video; a class without arguments does.
DetectorPart: TypeAlias = Callable[[], Detector]
# Opens what states go to, a file, a socket, another stack: lends a function of one state, called once a hop.
ExporterPart: TypeAlias = Callable[[str], AbstractContextManager[Callable[[WorldState], object]]]
# Reads what another sensor recorded as measurements on the clock of the sound, in the order of their stamps;
# what wraps a `MeasurementAdapter` does.
MeasurementsPart: TypeAlias = Callable[[Path], Iterable[Timed]]


def installed(group: Group) -> list[str]:
    """Return the names that installed packages bring.

    Examples
    --------
    >>> installed("worldstate.exporters")
    []
    """
    return sorted({one.name for one in entry_points(group=group)})


def load_part(group: Group, name: str, option: str, built_in: Iterable[str] = ()) -> Any:
    """Import what a package brings under a name; nothing of it was imported before.

    Parameters
    ----------
    group : str
        Group of entry points.
    name : str
        As the package calls it.
    option : str
        That named it, for messages.
    built_in : iterable of str
        Other names that the option takes, for messages.

    Raises
    ------
    InvalidArgumentError
        If no package brings it, two do, or its module cannot be imported.
    """
    found = list(entry_points(group=group, name=name))
    if len({one.value for one in found}) != 1:
        known = ", ".join([*built_in, *installed(group)]) or "none is installed"
        several = f", which {len(found)} packages bring" if found else ""
        raise InvalidArgumentError(f"{option}: expected one of {group} ({known}), got {name!r:.60}{several}")
    try:
        with of_part(found[0].value):
            part = found[0].load()
    except OwnPartError as error:
        where = f"{option}: expected {found[0].value} to be importable"
        raise InvalidArgumentError(f"{where} ({type(error.error).__name__}: {error.error})") from error
    if not callable(part):
        raise InvalidArgumentError(f"{option}: expected {found[0].value} to be callable, got {part!r:.60}")
    return part


@contextmanager
def of_part(name: str) -> Iterator[None]:
    """Turn whatever a part raises inside into an error with its name, `SystemExit` too."""
    try:
        yield
    except (WorldstateError, KeyboardInterrupt, GeneratorExit):
        raise
    except BaseException as error:
        # A signal that ends the program: see `run_program`.
        if isinstance(error, SystemExit) and isinstance(error.code, int) and error.code > SIGNALLED:
            raise
        raise OwnPartError(name, error) from error


@dataclass(frozen=True, slots=True)
class OwnDetector:
    """A detector that a package brings, whose errors have its name."""

    name: str
    detector: Detector

    @classmethod
    def of(cls, name: str, part: DetectorPart) -> "OwnDetector":
        """Make one that has seen no image."""
        with of_part(name):
            return cls(name, part())

    def detect(self, frame: ImageArray) -> DetectionFrame:
        """Return what it finds in an image."""
        with of_part(self.name):
            found = self.detector.detect(frame)
        return checked_frame(self.name, found)


def checked_frame(name: str, found: object) -> DetectionFrame:
    """Return the boxes that a detector found; refuse a result of no known kind, such as None."""
    frame = DetectionFrame.of(found)
    if frame is None:
        expected = "a DetectionFrame, or a result of supervision or ultralytics"
        raise InvalidArgumentError(f"{name}: expected {expected}, got {found!r:.60}")
    return frame


def checked_timed(name: str, told: object) -> Timed:
    """Return what another sensor measured; refuse None and whatever else is no measurement."""
    if not isinstance(told, Timed):
        expected = "Measurement, PositionScan or Odometry"
        raise InvalidArgumentError(f"{name}: expected {expected}, got {told!r:.60}")
    return told


@contextmanager
def own_exporter(name: str, part: ExporterPart, target: str) -> Iterator[Callable[[WorldState], object]]:
    """Open what an exporter of a package lends, whose errors have its name."""
    with ExitStack() as opened:
        with of_part(name):
            export = opened.enter_context(part(target))

        def guarded(state: WorldState) -> object:
            with of_part(name):
                return export(state)

        yield guarded


def part_and_target(option: str, text: str) -> tuple[str, str]:
    """Split NAME=TARGET.

    Examples
    --------
    >>> part_and_target("--export", "table=out.csv")
    ('table', 'out.csv')
    """
    name, equals, target = text.partition("=")
    if not (name and equals and target):
        raise InvalidArgumentError(f"{option}: expected NAME=TARGET, got {text!r:.60}")
    return name, target


def other_modality(option: str, text: str) -> OtherModality:
    """Return what NAME=FILE reads, by the package that brings NAME."""
    name, path = part_and_target(option, text)
    return partial(_checked, load_part("worldstate.measurements", name, option), Path(path), name=name)


def _checked(part: MeasurementsPart, path: Path, name: str) -> Iterator[Timed]:
    with of_part(name):
        told = iter(part(path))
    while True:
        with of_part(name):
            one = next(told, None)
        if one is None:
            return
        yield checked_timed(name, one)
