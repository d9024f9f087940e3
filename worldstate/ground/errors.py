"""Typed errors; each message contains the actual and the expected value.

All are `ValueError`s with one common root: a program can catch `WorldstateError`, and the command line turns
any of them into one line and exit code 2.
"""


class WorldstateError(ValueError):
    """Root of all errors that this library raises on purpose.

    Examples
    --------
    >>> from worldstate.adapters import read_model
    >>> try:
    ...     read_model("missing.json")
    ... except WorldstateError as error:
    ...     print(type(error).__name__, isinstance(error, ValueError))
    InputFileError True
    """


class InvalidArgumentError(WorldstateError):
    """An argument has the wrong shape, range or type; the message contains its name.

    Examples
    --------
    >>> from worldstate import Absent
    >>> Absent(miss_rate=1.5)
    Traceback (most recent call last):
    ...
    worldstate.ground.errors.InvalidArgumentError: miss_rate: ...
    """


class OutOfDomainError(WorldstateError):
    """An array, a sample rate or a feature differs from that of a model or a data set.

    Examples
    --------
    >>> error = OutOfDomainError("street.wav: not the array of the model")
    >>> isinstance(error, WorldstateError)
    True
    """


class InputFileError(WorldstateError):
    """A file is missing, damaged or not what was expected; the message begins with its name.

    Examples
    --------
    >>> error = InputFileError("mics.xml", "expected positions of microphones")
    >>> error.path, str(error)
    ('mics.xml', 'mics.xml: expected positions of microphones')
    """

    def __init__(self, path: object, problem: str) -> None:
        super().__init__(f"{path}: {problem}")
        self.path = path
        self.problem = problem

    def __reduce__(self) -> tuple[type, tuple[object, str]]:
        # Pickle would call the class with the message alone, which would fail and break the pool of
        # processes.
        return type(self), (self.path, self.problem)


class OwnPartError(WorldstateError):
    """A part from another installed package failed; the message contains its name and the error.

    Examples
    --------
    >>> str(OwnPartError("mine:Detector", SystemExit(3)))
    'mine:Detector: expected a part that works, got SystemExit: 3'
    """

    def __init__(self, part: str, error: BaseException) -> None:
        super().__init__(f"{part}: expected a part that works, got {type(error).__name__}: {error}")
        self.part, self.error = part, error

    def __reduce__(self) -> tuple[type, tuple[str, BaseException]]:
        return type(self), (self.part, self.error)


class SchemaVersionError(InputFileError):
    """A file was written by another major version of its schema.

    Examples
    --------
    >>> from worldstate import WorldState
    >>> stranger = WorldState(0, 0).to_json().replace('"version":"4.', '"version":"9.')
    >>> try:
    ...     WorldState.from_json(stranger)
    ... except SchemaVersionError as error:
    ...     print(type(error).__name__)
    SchemaVersionError
    """


class MissingExtraError(WorldstateError):
    """An optional package is not installed; the message contains the extra that installs it.

    Examples
    --------
    >>> str(MissingExtraError("cv2", "vision"))
    "cv2 is not installed: pip install 'worldstate[vision]'"
    """

    def __init__(self, package: str, extra: str) -> None:
        super().__init__(f"{package} is not installed: pip install 'worldstate[{extra}]'")
        self.package = package
        self.extra = extra

    def __reduce__(self) -> tuple[type, tuple[str, str]]:
        return type(self), (self.package, self.extra)
