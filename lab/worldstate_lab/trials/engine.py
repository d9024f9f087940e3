"""The same work over recordings, on processes of this machine or on a cluster: what comes out is the same."""

from collections import deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from worldstate.adapters.parallel import in_processes
from worldstate.ground.blas_threads import one_blas_thread
from worldstate.ground.errors import InvalidArgumentError, MissingExtraError, WorldstateError
from worldstate.ground.version import __version__

Item = TypeVar("Item")
Result = TypeVar("Result")

# A scheduler in the same network answers within a second; workers of a batch system are there or are not.
CONNECT_S = 10.0


@dataclass(frozen=True, slots=True)
class Failed:
    """What stands in the place of the result of a recording that could not be read."""

    name: str  # Of the recording
    problem: str  # Text of the error


@dataclass(frozen=True, slots=True)
class Engine:
    """Where the work is done: `jobs` processes of this machine, or the cluster of a Dask scheduler.

    Examples
    --------
    >>> from worldstate.adapters import read_model
    >>> list(Engine().over(read_model, ["missing.json"]))
    [Failed(name='missing.json', problem='missing.json: ...')]
    """

    jobs: int = 1  # Processes of this machine
    scheduler: str | None = None  # Address of a Dask scheduler, whose workers do the work instead
    shared: tuple[Path, ...] = ()  # Files and folders that every worker of the cluster must see

    def over(
        self, work: Callable[[Item], Result], items: Sequence[Item], name: Callable[[Item], str] = str
    ) -> Generator[Result | Failed, None, None]:
        """Yield ``work(item)`` in the order of the items; one that fails is reported and the others go on.

        `work` is sent to other processes with the items: paths and settings, never sound. Errors of programs,
        which would meet every recording, are raised.
        """
        named = [(name(item), item) for item in items]
        if self.scheduler is None:
            return in_processes(partial(_attempt, work), named, self.jobs)
        return _on_cluster(partial(_attempt, work), named, self.scheduler, self.shared)


def _attempt(work: Callable[[Item], Result], named: tuple[str, Item]) -> Result | Failed:
    """Do the work on one BLAS thread, here as on every worker: sums of two threads differ in the last bit."""
    name, item = named
    try:
        with one_blas_thread():
            return work(item)
    except (WorldstateError, OSError) as error:
        return Failed(name, str(error))


def _on_cluster(
    work: Callable[[Item], Result], items: Sequence[Item], address: str, shared: Sequence[Path]
) -> Generator[Result, None, None]:
    # Not through joblib, whose Dask backend (1.6) waits for ever once a worker has died of a task: the future
    # of such a task gets its error, but the callback that wakes the loop is not called.
    distributed = _distributed()
    # An OSError of the work itself comes as `Failed`: one that is raised is the connection's.
    lost = (CancelledError, distributed.KilledWorker, OSError)
    with _connect(distributed, address) as client:
        _check_workers(client, address, shared)
        waiting = deque(client.map(work, items, pure=False))
        try:
            while waiting:
                # This loop alone holds the future: the cluster forgets the result as soon as it is here.
                yield waiting.popleft().result()
        except lost as error:
            raise WorldstateError(
                f"the cluster at {address} lost a worker or its scheduler: {error}"
            ) from error
        finally:
            client.cancel(list(waiting))


def _distributed() -> Any:
    try:
        import distributed
    except ImportError as error:
        raise MissingExtraError("distributed", "dask") from error
    return distributed


def _connect(distributed: Any, address: str) -> Any:
    try:
        return distributed.Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InvalidArgumentError(
            f"scheduler: expected a Dask scheduler at {address}, none answers; start one with"
            f" `dask scheduler` and workers with `dask worker {address} --nthreads 1` ({error})"
        ) from error


def _check_workers(client: Any, address: str, shared: Sequence[Path]) -> None:
    """Refuse workers that would compute something else: other code, or other files."""
    try:
        client.wait_for_workers(1, timeout=CONNECT_S)
        found = client.run(_seen, [str(path.absolute()) for path in shared])
    except TimeoutError as error:
        problem = f"start some with `dask worker {address} --nthreads 1`"
        raise InvalidArgumentError(
            f"scheduler: expected workers at {address}, got none; {problem}"
        ) from error
    except ImportError as error:
        problem = f"expected worldstate {__version__} on every worker of {address}"
        raise InvalidArgumentError(f"scheduler: {problem} ({error})") from error
    for worker, (version, missing) in found.items():
        if version != __version__:
            raise InvalidArgumentError(
                f"scheduler: expected version {__version__} on {worker}, got {version}"
            )
        if missing:
            problem = f"{missing[0]} is not there: data set and cache must lie under the same path everywhere"
            raise InvalidArgumentError(
                f"scheduler: expected the files of this machine on {worker}; {problem}"
            )


def _seen(paths: Sequence[str]) -> tuple[str, list[str]]:
    """Return the version of this worker, and which paths it does not see."""
    return __version__, [path for path in paths if not Path(path).exists()]
