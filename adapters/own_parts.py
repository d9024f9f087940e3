"""Parts of installed packages, found by their entry points: detectors, exporters, other sensors.

A package lists its parts in its pyproject.toml:

| group of entry points | type of the part | use |
|---|---|---|
| `worldstate.detectors` | `DetectorPart` | ``--detector NAME`` |
| `worldstate.exporters` | `ExporterPart` | ``--export NAME=TARGET`` |
| `worldstate.measurements` | `MeasurementsPart` | ``"measurements": {NAME: FILE}`` of a car file |
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache, partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Literal, TypeAlias

from worldstate.adapters.camera.detections import DetectionFrame, Detector
from worldstate.adapters.camera.detectors import MotionDetector, OnnxDetector, open_onnx
from worldstate.core.fixed_lag import Timed
from worldstate.ground.errors import InvalidArgumentError, OwnPartError, WorldstateError
from worldstate.ground.typing import ImageArray
from worldstate.state import WorldState

# Larger exit codes are those of signals.
SIGNALLED = 128
# Detectors by background subtraction, whose score is not a confidence.
MOTION = "motion", "knn"
Group = Literal["worldstate.detectors", "worldstate.exporters", "worldstate.measurements"]
# Returns the measurements of another sensor, at each call from the beginning.
OtherModality: TypeAlias = Callable[[], Iterable[Timed]]
# Makes a new detector for each video, for example a class without arguments.
DetectorPart: TypeAlias = Callable[[], Detector]
# Opens a target, such as a file or a socket, and returns a function that is called with each state.
ExporterPart: TypeAlias = Callable[[str], AbstractContextManager[Callable[[WorldState], object]]]
# Reads a file of another sensor: measurements on the clock of the sound, in the order of their time stamps.
MeasurementsPart: TypeAlias = Callable[[Path], Iterable[Timed]]


def installed(group: Group) -> list[str]:
    """Return the names of the installed parts of a group.

    Examples
    --------
    >>> installed("worldstate.exporters")
    []
    """
    return sorted({one.name for one in entry_points(group=group)})


def load_part(group: Group, name: str, option: str, built_in: Iterable[str] = ()) -> Any:
    """Import a part of an installed package by its name.

    Parameters
    ----------
    group : str
        Group of entry points.
    name : str
        Name of the entry point.
    option : str
        Argument that holds the name, for error messages.
    built_in : iterable of str
        Further names that the argument takes, for error messages.

    Raises
    ------
    InvalidArgumentError
        If no package or more than one has such a part, or if its module cannot be imported.
    """
    found = list(entry_points(group=group, name=name))
    if len({one.value for one in found}) != 1:
        known = ", ".join([*built_in, *installed(group)]) or "none is installed"
        several = f", a name in {len(found)} packages" if found else ""
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
    """Turn every exception of a part, `SystemExit` included, into an error with the part's name."""
    try:
        yield
    except (WorldstateError, KeyboardInterrupt, GeneratorExit):
        raise
    except BaseException as error:
        # `run_program` turns signals that end the program into such exits.
        if isinstance(error, SystemExit) and isinstance(error.code, int) and error.code > SIGNALLED:
            raise
        raise OwnPartError(name, error) from error


@dataclass(frozen=True, slots=True)
class OwnDetector:
    """A detector of an installed package; errors carry its name."""

    name: str
    detector: Detector

    @classmethod
    def of(cls, name: str, part: DetectorPart) -> "OwnDetector":
        """Return a new detector."""
        with of_part(name):
            return cls(name, part())

    def detect(self, frame: ImageArray) -> DetectionFrame:
        """Return the detections in an image."""
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
    """Return the measurement of another sensor; refuse anything else."""
    if not isinstance(told, Timed):
        expected = "Measurement, PositionScan or Odometry"
        raise InvalidArgumentError(f"{name}: expected {expected}, got {told!r:.60}")
    return told


@contextmanager
def own_exporter(name: str, part: ExporterPart, target: str) -> Iterator[Callable[[WorldState], object]]:
    """Open an exporter of an installed package; errors carry its name."""
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


def other_modality(name: str, path: Path) -> OtherModality:
    """Return the reader of another sensor's file, from the package that has a reader of that name."""
    return partial(_checked, load_part("worldstate.measurements", name, "measurements"), path, name=name)


def detector_maker(name: str, labels: tuple[str, ...] = ("car",)) -> DetectorPart:
    """Return a function that makes a detector; an ONNX model, with the labels of its classes, is opened once.

    Raises
    ------
    InvalidArgumentError
        If there is no detector of that name.
    """
    if name.endswith(".onnx"):
        make = partial(_opened, Path(name), labels)
        make()  # An unusable model is refused before the work begins
        return make
    if name not in MOTION:
        known = (*MOTION, "FILE.onnx")
        return partial(OwnDetector.of, name, load_part("worldstate.detectors", name, "detector", known))
    return partial(MotionDetector, "knn" if name == "knn" else "mog2")


@cache
def _opened(path: Path, labels: tuple[str, ...]) -> OnnxDetector:
    """Open a model once per process."""
    return open_onnx(path, labels)


def detector_name(name: str) -> str:
    """Return the name of a detector for reports; for an ONNX model with the name of its file."""
    return f"onnx {Path(name).name}" if name.endswith(".onnx") else name


def _checked(part: MeasurementsPart, path: Path, name: str) -> Iterator[Timed]:
    with of_part(name):
        told = iter(part(path))
    while True:
        with of_part(name):
            one = next(told, None)
        if one is None:
            return
        yield checked_timed(name, one)
