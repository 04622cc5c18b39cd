"""Run many scenarios, or many states of one, on all cores.

One process a core, one thread in each.

Processes are started afresh ("spawn"), so a script that calls these needs the usual `if __name__ == "__main__":`.
Starting them takes about a second, as long as ten thousand ticks: keep `Workers` where calls follow each other.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, nullcontext, suppress
from functools import lru_cache
from queue import SimpleQueue
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from qpavoid.config import ScenarioConfig
from qpavoid.config.loading import load_scenario
from qpavoid.controller import Controller
from qpavoid.errors import QpavoidError
from qpavoid.problem import Array, require_finite
from qpavoid.run.log import STATUSES, Log
from qpavoid.run.simulate import simulate


class WorkerDied(QpavoidError):
    """A worker process ended before its call was done: killed, out of memory, crashed."""


class BatchError(QpavoidError):
    """Some scenarios could not be run; the others were."""

    def __init__(self, logs: list[Log | None], errors: dict[int, Exception]) -> None:
        self.logs = logs
        """Log of each scenario in the order of the input; None where there is none."""
        self.errors = errors
        """Error of each scenario that could not be run, by its index in the input."""
        lines = [f"  {i}: {type(error).__name__}: {error}" for i, error in errors.items()]
        super().__init__("\n".join([f"{len(errors)} of {len(logs)} scenarios could not be run:", *lines]))


class Steps(NamedTuple):
    """Velocities that a controller commands in n states."""

    v: Array
    """(n, nv) joint velocities [rad/s or m/s]."""
    status: npt.NDArray[np.int8]
    """(n,) indices into `qpavoid.run.log.STATUSES`, as in a log."""


def simulate_many(
    scenarios: Iterable[ScenarioConfig | str],
    jobs: int | Workers | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Log]:
    """Run scenarios, each as `simulate` does.

    Args:
        scenarios: configurations, shipped names or paths.
        jobs: number of processes, one a core if left out; or `Workers` that are kept.
        progress: called after each scenario with the number done and the number in all.

    Returns:
        A log each, in the order of the input. One whose loop failed says so in `meta["stopped_by"]`.

    Raises:
        BatchError: some cannot be built, or took their process down. It comes when all others are done and has
            their logs.
    """
    calls = [(scenario,) for scenario in scenarios]
    with _workers(jobs, len(calls)) as workers:
        answers = workers.map(simulate, calls, progress)
    if errors := {i: answer for i, answer in enumerate(answers) if isinstance(answer, Exception)}:
        raise BatchError([None if i in errors else answer for i, answer in enumerate(answers)], errors)
    return answers


def steps(scenario: ScenarioConfig | str, q: Array, t: float | Array = 0.0, jobs: int | Workers | None = None) -> Steps:
    """Compute a control step in each of n independent states, the robot at rest in all.

    Args:
        scenario: configuration, shipped name or path.
        q: configurations (n, nq), n > 0.
        t: time [s], one for all or (n,).
        jobs: number of processes, one a core if left out; or `Workers` that are kept.

    Raises:
        ConfigError, UnknownName, SolverNotInstalled: the scenario cannot be built.
        NumericalError: q or t of the wrong shape, NaN or infinity.
        WorkerDied: a process ended before its time.
    """
    q = require_finite("q", q, (len(q), *np.shape(q)[1:]))
    times = require_finite("t", np.full(len(q), t) if np.ndim(t) == 0 else t, (len(q),))
    frozen = pickle.dumps(load_scenario(scenario) if isinstance(scenario, str) else scenario)
    with _workers(jobs, len(q)) as workers:
        parts = np.array_split(np.arange(len(q)), min(len(workers), len(q)))
        answers = workers.map(_steps, [(frozen, q[part], times[part]) for part in parts])
    for answer in answers:
        if isinstance(answer, Exception):
            raise answer
    v, status = zip(*answers, strict=True)
    return Steps(np.concatenate(v), np.concatenate(status))


def _steps(scenario: bytes, q: Array, t: Array) -> Steps:
    """Compute one control step in each of the states q (n, nq) at times t (n,) [s]."""
    controller = _controller(scenario)
    solutions = []
    for state in zip(q, t.tolist(), strict=True):
        controller.reset()
        solutions.append(controller.step(*state))
    status = np.array([STATUSES.index(solution.status) for solution in solutions], dtype=np.int8)
    return Steps(np.array([solution.v for solution in solutions]), status)


@lru_cache(maxsize=1)
def _controller(scenario: bytes) -> Controller:
    """Build the controller of a pickled scenario, once for all calls of a batch."""
    return Controller.from_scenario(pickle.loads(scenario))[0]


class Workers:
    """Processes that wait for work, until `close` or the end of the `with` block."""

    def __init__(self, jobs: int | None = None) -> None:
        """Start `jobs` processes, one a core if left out.

        Raises:
            ValueError: no job at all.
            WorkerDied: they do not start.
        """
        if jobs is not None and jobs < 1:
            raise ValueError(f"jobs: {jobs}; at least one process is needed")
        # a pool for each process tells which call a dead process was at; one pool of all loses whatever is queued
        self._pids: dict[ProcessPoolExecutor, Future[int]] = {}
        pools = [self._start() for _ in range(_cores() if jobs is None else jobs)]
        self._count, self._idle = len(pools), SimpleQueue[ProcessPoolExecutor]()
        for pool in pools:
            self._idle.put(pool)
        try:
            for started in [pool.submit(_cores) for pool in pools]:
                started.result()
        except BrokenProcessPool:
            self.close()
            remedy = 'a script that starts processes needs `if __name__ == "__main__":` around what it does'
            raise WorkerDied(f"a process ended while it started; {remedy}") from None

    def __len__(self) -> int:
        return self._count

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    def close(self) -> None:
        """End the processes."""
        self._count = 0
        while not self._idle.empty():
            self._idle.get().shutdown()

    def map(
        self,
        call: Callable[..., Any],
        arguments: Sequence[tuple[Any, ...]],
        progress: Callable[[int, int], None] | None = None,
    ) -> list[Any]:
        """Call a function of some module with each of several arguments.

        Returns:
            What it returned, or the exception that it raised, in the order of the arguments. A process that dies
            takes its own call with it (`WorkerDied`), no other, and is replaced.
        """

        def run(call_arguments: tuple[Any, ...]) -> Any:
            pool = self._idle.get()
            try:
                return pool.submit(call, *call_arguments).result()
            except BrokenProcessPool:
                del self._pids[pool]
                pool = self._start()
                return WorkerDied("its process ended before it was done: killed, out of memory or crashed")
            except Exception as error:
                return error
            finally:
                self._idle.put(pool)

        with ThreadPoolExecutor(len(self)) as threads:
            futures = [threads.submit(run, call_arguments) for call_arguments in arguments]
            try:
                for count_done, _ in enumerate(as_completed(futures), 1):
                    if progress is not None:
                        progress(count_done, len(futures))
            except BaseException:  # Ctrl-C: do not begin what is left, nor wait for what began before that was known
                threads.shutdown(wait=False, cancel_futures=True)
                self._kill()
                raise
        return [future.result() for future in futures]

    def _start(self) -> ProcessPoolExecutor:
        pool, pid = _start()
        self._pids[pool] = pid
        return pool

    def _kill(self) -> None:
        for pid in list(self._pids.values()):
            with suppress(BrokenProcessPool, OSError):  # it has ended, as Ctrl-C in a terminal reaches it, too
                os.kill(pid.result(), signal.SIGTERM)


_SINGLE_THREADED = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "NUMBA")}
_starting = Lock()


def _start() -> tuple[ProcessPoolExecutor, Future[int]]:
    """Start a pool of one process, which ends without a message at Ctrl-C; and the id of the process, once it runs."""
    spawn = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(1, spawn, signal.signal, (signal.SIGINT, signal.SIG_DFL))
    with _starting:  # the number of threads must be in the environment when the process loads its libraries
        environment = dict(os.environ)
        os.environ.update(_SINGLE_THREADED)
        try:
            pid = pool.submit(os.getpid)  # starts the process
        finally:
            for name in _SINGLE_THREADED:
                os.environ.pop(name)
            os.environ.update({name: environment[name] for name in _SINGLE_THREADED if name in environment})
    return pool, pid


def _workers(jobs: int | Workers | None, count: int) -> AbstractContextManager[Workers]:
    """Return workers for at most `count` calls; a `Workers` that the caller owns stays open."""
    if isinstance(jobs, Workers):
        return nullcontext(jobs)
    return Workers(min(_cores() if jobs is None else jobs, max(count, 1)))


def _cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
