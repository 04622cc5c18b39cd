"""Call functions in many processes: of this machine, or of a Dask cluster.

One thread each. Processes of this machine are started afresh ("spawn"), so a script that starts some needs the usual
`if __name__ == "__main__":`. That takes about a second, as long as ten thousand control steps: keep `Workers` where
calls follow each other.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from importlib.metadata import version
from itertools import islice
from threading import Thread
from typing import Any, TypeVar

from qpavoid.errors import ConfigError, QpavoidError

_SINGLE_THREADED = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "NUMBA")}
CONNECT_TIMEOUT = 10.0
"""Time in which a scheduler has to answer, and a first worker to be there [s]."""

Call = TypeVar("Call", bound=tuple[Any, ...])


class WorkerDied(QpavoidError):
    """A worker process ended before its call was done: killed, out of memory, crashed."""


class ClusterLost(QpavoidError):
    """The scheduler of a cluster went away."""


class Workers:
    """Processes of this machine that wait for calls, until `close` or the end of the `with` block."""

    _died: type[Exception] = BrokenExecutor
    """What a call raises whose process ended."""

    def __init__(self, jobs: int | None = None) -> None:
        """Start `jobs` processes, one a core if left out.

        Raises:
            ValueError: no job at all.
            WorkerDied: they do not start.
        """
        if jobs is not None and jobs < 1:
            raise ValueError(f"jobs: {jobs}; at least one process is needed")
        self._count = cores() if jobs is None else jobs
        self._executor: Executor | None = None
        try:
            for started in [self._submit(os.getpid, ()) for _ in range(self._count)]:
                started.result()
        except BrokenExecutor:
            self.close()
            remedy = 'a script that starts processes needs `if __name__ == "__main__":` around what it does'
            raise WorkerDied(f"a process ended while it started; {remedy}") from None

    def __len__(self) -> int:
        """Return the number of calls that can be under way at a time."""
        return self._count

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, error: type[BaseException] | None, *_: Any) -> None:
        if error is not None:
            self.stop()
        self.close()

    def close(self) -> None:
        """End the processes, after the calls that are under way."""
        self._count = 0
        if self._executor is not None:
            self._executor.shutdown()

    def stop(self) -> None:
        """End the processes and what they do at once; the next call starts new ones."""
        executor, self._executor = self._executor, None
        if isinstance(executor, ProcessPoolExecutor):
            processes = list((executor._processes or {}).values())  # from Python 3.14 on: executor.kill_workers()
            executor.shutdown(wait=False, cancel_futures=True)
            for process in processes:
                process.kill()

    def map(
        self,
        function: Callable[..., Any],
        calls: Iterable[tuple[Any, ...]],
        progress: Callable[[int, int], None] | None = None,
    ) -> list[Any]:
        """Return the answers to calls, as `as_completed` gives them, in the order of the calls.

        Args:
            function: of some module.
            calls: arguments of each call.
            progress: called after each with the number done and the number in all.
        """
        numbered = [(i, function, *call) for i, call in enumerate(calls)]
        answers: list[Any] = [None] * len(numbered)
        try:
            for done, (call, answer) in enumerate(self.as_completed(_unnumbered, numbered), 1):
                answers[call[0]] = answer
                if progress is not None:
                    progress(done, len(numbered))
        except BaseException:  # Ctrl-C, in `progress` as well
            self.stop()
            raise
        return answers

    def as_completed(self, function: Callable[..., Any], calls: Iterable[Call]) -> Iterator[tuple[Call, Any]]:
        """Yield each call with what it returned, or the exception that it raised, as they come.

        Calls are read no faster than they can begin. Those that were under way as a process died are done once more in
        the end, one by one: so the one that ends its process again, a `WorkerDied`, takes no other with it.

        Raises:
            ClusterLost: the scheduler went away.
        """
        lost = []
        for call, answer in self._run(function, calls):
            if isinstance(answer, WorkerDied):
                lost.append(call)
            else:
                yield call, answer
        for call in lost:
            yield from self._run(function, [call])

    def _run(self, function: Callable[..., Any], calls: Iterable[Call]) -> Iterator[tuple[Call, Any]]:
        """Yield each call with its answer; `WorkerDied` of all that were under way as a process died."""
        remaining, pending = iter(calls), dict[Future[Any], Call]()
        try:
            while True:
                for call in islice(remaining, max(len(self) - len(pending), not pending)):
                    pending[self._submit(function, call)] = call
                if not pending:
                    return
                for future in wait(pending, return_when=FIRST_COMPLETED).done:
                    yield pending.pop(future), self._answer(future)
        except BaseException:  # Ctrl-C, or who reads this goes no further
            self.stop()
            raise

    def _answer(self, future: Future[Any]) -> Any:
        if future.cancelled():
            raise ClusterLost("the scheduler went away")
        error = future.exception()
        if isinstance(error, self._died):
            return WorkerDied("its process ended before it was done: killed, out of memory or crashed")
        return future.result() if error is None else error

    def _submit(self, function: Callable[..., Any], call: tuple[Any, ...]) -> Future[Any]:
        if not self._count:
            raise ValueError("these workers are closed")
        with _environment(_SINGLE_THREADED):  # processes, which start here, load their libraries with it
            if self._executor is not None:
                try:
                    return self._executor.submit(function, *call)
                except BrokenExecutor:
                    self.stop()
            self._executor = ProcessPoolExecutor(self._count, multiprocessing.get_context("spawn"), _begin_process)
            return self._executor.submit(function, *call)


class ClusterWorkers(Workers):
    """Workers of a Dask cluster that runs already; they may come and go."""

    def __init__(self, address: str) -> None:
        """Connect to a scheduler.

        Args:
            address: of the scheduler, as in tcp://host:8786.

        Raises:
            ConfigError: no scheduler or no worker answers, or one is of another version of qpavoid.
        """
        from distributed import Client, KilledWorker

        self._died = KilledWorker
        self._log_level = logging.getLogger("distributed").level
        logging.getLogger("distributed").setLevel(logging.CRITICAL)  # it reports every dead worker, which we do as well
        try:
            self._client = Client(address, timeout=CONNECT_TIMEOUT)
        except (OSError, ValueError, TypeError) as error:  # TimeoutError among them
            start = "start one with `dask scheduler`, and give the address that it prints, as in tcp://host:8786"
            message = " ".join(str(error).split()) or type(error).__name__
            raise ConfigError(f"--cluster {address}: no scheduler answers: {message:.200}; {start}") from None
        try:
            _check_versions(self._client, address)
        except ConfigError:
            self.close()
            raise
        self._remote = self._client.get_executor(pure=False)

    def __len__(self) -> int:
        try:
            return sum(self._client.nthreads().values())
        except OSError:  # of a connection that is closed
            raise ClusterLost("the scheduler went away") from None

    def close(self) -> None:
        """Disconnect; what is under way is dropped."""
        self._client.close()
        logging.getLogger("distributed").setLevel(self._log_level)

    def stop(self) -> None:
        """Drop what is under way."""
        self._remote.shutdown(wait=False)
        self._remote = self._client.get_executor(pure=False)

    def _submit(self, function: Callable[..., Any], call: tuple[Any, ...]) -> Future[Any]:
        future: Future[Any] = self._remote.submit(function, *call)
        return future


@contextmanager
def _environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Set some variables of the environment for a while."""
    saved = dict(os.environ)
    os.environ.update(variables)
    try:
        yield
    finally:
        for name in variables:
            del os.environ[name]
        os.environ.update(saved)


def _begin_process() -> None:
    """Leave Ctrl-C, which a terminal sends to all processes, to the one that started this one, and end with that."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()

    def end() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    Thread(target=end, daemon=True).start()


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _unnumbered(_: int, function: Callable[..., Any], *call: Any) -> Any:
    return function(*call)


def _check_versions(client: Any, address: str) -> None:
    """Check that there is a worker, and that all have this version of qpavoid."""
    try:
        client.wait_for_workers(1, timeout=CONNECT_TIMEOUT)
    except TimeoutError:
        raise ConfigError(f"--cluster {address}: no worker there; start some with `dask worker {address}`") from None
    ours = version("qpavoid")
    for worker, theirs in client.run(version, "qpavoid", on_error="return").items():
        if theirs != ours:  # or what it raised
            raise ConfigError(f"--cluster {address}: worker {worker} has qpavoid {theirs!r}, here it is {ours!r}")
