"""Typed errors: each says what came and what was expected.

All are `ValueError`s with one common root, so that an embedder can catch `WorldstateError` and the command
line can turn any of them into one line and exit code 2.
"""


class WorldstateError(ValueError):
    """Root of every error that this library raises on purpose."""


class InvalidArgumentError(WorldstateError):
    """An argument has the wrong shape, range or type; the message names it."""


class OutOfDomainError(WorldstateError):
    """An array, a sample rate or a feature is not what a model or a data set was made with."""


class InputFileError(WorldstateError):
    """A file is missing, damaged or not what was expected; the message begins with its name."""

    def __init__(self, path: object, problem: str) -> None:
        super().__init__(f"{path}: {problem}")
        self.path = path
        self.problem = problem


class SchemaVersionError(InputFileError):
    """A file was written by another major version of its schema."""


class MissingExtraError(WorldstateError):
    """An optional package is not installed; the message names the extra that brings it."""

    def __init__(self, package: str, extra: str) -> None:
        super().__init__(f"{package} is not installed: pip install 'worldstate[{extra}]'")
        self.package = package
        self.extra = extra
