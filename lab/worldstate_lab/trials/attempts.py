"""The same work over recordings, on processes of this machine: what comes out does not depend on how many."""

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

from worldstate.frontend.array.steering import one_blas_thread
from worldstate.ground.errors import WorldstateError
from worldstate.simulation.parallel import in_processes

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class Failed:
    """What stands in the place of the result of a recording that could not be read."""

    name: str  # Of the recording
    problem: str  # Text of the error


def attempted(
    work: Callable[[Item], Result], items: Sequence[Item], jobs: int, name: Callable[[Item], str] = str
) -> Generator[Result | Failed, None, None]:
    """Yield ``work(item)`` in the order of the items; one that fails is reported and the others go on.

    `work` is sent to other processes with the items: paths and settings, never sound. Errors of programs,
    which would meet every recording, are raised.

    Examples
    --------
    >>> from worldstate.adapters import read_model
    >>> list(attempted(read_model, ["missing.json"], jobs=1))
    [Failed(name='missing.json', problem='missing.json: ...')]
    """
    named = [(name(item), item) for item in items]
    return in_processes(partial(_attempt, work), named, jobs)


def _attempt(work: Callable[[Item], Result], named: tuple[str, Item]) -> Result | Failed:
    """Do the work on one BLAS thread, here as on every worker: sums of two threads differ in the last bit."""
    name, item = named
    try:
        with one_blas_thread():
            return work(item)
    except (WorldstateError, OSError) as error:
        return Failed(name, str(error))
