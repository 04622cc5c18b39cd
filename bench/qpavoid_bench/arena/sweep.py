"""Sweeps: make the missing cases of a suite, then do its missing runs, on a Dask cluster.

The same code runs on the cores of this machine and on a cluster of many: only the client differs. A task whose worker
dies is done once more, in the end with nothing else beside it that could have brought the worker down; a task has one
answer, whichever worker gave it, and each answer is in the results folder before the next one is read.
"""

from __future__ import annotations

import itertools
import logging
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple
from uuid import uuid4

import dask
import pyarrow as pa
import pyarrow.compute as pc
from distributed import Client, KilledWorker, LocalCluster, as_completed
from tornado.ioloop import PeriodicCallback

from qpavoid.errors import ConfigError, QpavoidError
from qpavoid.run.machine import machine, versions
from qpavoid_bench.arena.case import Case
from qpavoid_bench.arena.entrants import Entrant
from qpavoid_bench.arena.families import Family, load_family, make_case
from qpavoid_bench.arena.mujoco_model import build
from qpavoid_bench.arena.plan import cases_of, missing_cases, missing_runs
from qpavoid_bench.arena.store import Journal, Store, read_cases
from qpavoid_bench.arena.suite import Suite, describe_entrants, origin
from qpavoid_bench.arena.trial import failing_entrant, run_trial
from qpavoid_bench.arena.world import build_world

_CONNECT_TIMEOUT = 10.0
"""Time in which a scheduler has to answer, and a first worker to be there [s]."""
_REPLACE_PERIOD = 2.0
"""Time between checks whether all processes of this machine are alive [s]."""
_KILLED = "the processes that ran it ended before it was done, each time: killed, out of memory or crashed"
_SCHEDULER_LOST = "the scheduler went away"
_SINGLE_THREADED = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "NUMBA")}
_IGNORE_INTERRUPT = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"
"""Run by a worker as it starts: a terminal sends Ctrl-C to workers as well, which the sweep has to end itself."""
_DASK_CONFIG = {
    "distributed.scheduler.allowed-failures": 0,  # whose worker died is tried again by us, alone
    "distributed.admin.low-level-log-length": 0,  # the scheduler's memory stays flat
    "distributed.deploy.lost-worker-timeout": "60 s",  # on a busy machine it takes long to start again
}


class ClusterLost(QpavoidError):
    """The scheduler went away; finished runs are kept."""


class Tally(NamedTuple):
    """Progress of a sweep."""

    stage: str
    """`cases` or `runs`."""
    done: int
    total: int
    """Number of those that were not there before."""
    collided: int
    """Number of runs with a contact."""
    failed: int
    """Number without a row: they are in failures.jsonl."""


@contextmanager
def local_cluster(jobs: int | None = None) -> Iterator[Client]:
    """Start processes of one thread each on this machine, one a core if `jobs` is left out."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    count = cores if jobs is None else jobs
    with (
        _silenced_dask_log(),
        dask.config.set(_DASK_CONFIG),
        LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"},
            silence_logs=logging.CRITICAL,
            env=_SINGLE_THREADED,
            preload=[_IGNORE_INTERRUPT],
        ) as cluster,
        Client(cluster) as client,
    ):
        # Dask gives a worker up that is not back in time, or that dies again as it starts, and replaces it when asked
        replacement = PeriodicCallback(lambda: cluster.scale(count), 1e3 * _REPLACE_PERIOD)
        cluster.periodic_callbacks["lost workers"] = replacement  # stopped when the cluster is closed
        cluster.loop.add_callback(replacement.start)
        yield client


@contextmanager
def remote_cluster(address: str) -> Iterator[Client]:
    """Connect to a Dask cluster that runs already.

    Raises:
        ConfigError: no scheduler or no worker answers, or one is of another version of qpavoid.
    """
    with _silenced_dask_log():
        try:
            client = Client(address, timeout=_CONNECT_TIMEOUT)
        except (OSError, ValueError, TypeError) as error:  # TimeoutError among them
            start = "start one with `dask scheduler`, and give the address that it prints, as in tcp://host:8786"
            message = " ".join(str(error).split()) or type(error).__name__
            raise ConfigError(f"--cluster {address}: no scheduler answers: {message:.200}; {start}") from None
        with client:
            _check_workers(client, address)
            yield client


def _check_workers(client: Client, address: str) -> None:
    """Check that there is a worker, and that all have this version of qpavoid."""
    try:
        client.wait_for_workers(1, timeout=_CONNECT_TIMEOUT)
    except TimeoutError:
        raise ConfigError(f"--cluster {address}: no worker there; start some with `dask worker {address}`") from None
    for worker, worker_version in client.run(version, "qpavoid", on_error="return").items():
        if worker_version != version("qpavoid"):
            message = (
                f"qpavoid {worker_version}"
                if isinstance(worker_version, str)
                else f"no qpavoid ({type(worker_version).__name__}: {worker_version})"
            )
            raise ConfigError(
                f"--cluster {address}: worker {worker} has {message}, here it is {version('qpavoid')}; install the same"
            )


def sweep(suite: Suite, store: Store, client: Client, report_progress: Callable[[Tally], None]) -> Tally:
    """Make and run whatever of a suite is not in the store yet.

    Args:
        suite: what is to be there in the end.
        store: where results go.
        client: who does the work.
        report_progress: called with the progress after every answer.

    Returns:
        How it ended: runs, and what failed of cases and runs.

    Raises:
        ClusterLost: the scheduler went away.
    """
    store.describe(_facts(suite, client))
    failed_cases = _make_cases(suite, store, client, report_progress).failed
    missing = missing_runs(suite, store.folder, cases_of(suite, store.folder))

    def describe(pending_run: _PendingRun) -> dict[str, Any]:
        case = Case.from_json(pending_run[0])
        return {"family": case.family, "seed": case.seed, "entrant": pending_run[1].name}

    answers = _run_all(client, _pending_runs(suite, missing, store.folder))
    tally = _collect("runs", len(missing), answers, store.runs, store.fail, describe, report_progress)
    return tally._replace(failed=tally.failed + failed_cases)


def _make_cases(suite: Suite, store: Store, client: Client, report_progress: Callable[[Tally], None]) -> Tally:
    missing = missing_cases(suite, store.folder)
    paths = {family.name: str(family.path.resolve()) for family in suite.families}
    calls = ((paths[row["family"]], row["origin"], row["seed"]) for row in _iterate_rows(missing))

    def describe(call: tuple[str, str, int]) -> dict[str, Any]:
        return {"family": Path(call[0]).stem, "seed": call[2], "entrant": None}

    return _collect(
        "cases",
        len(missing),
        _submit_with_retry(client, _make_case, calls),
        store.cases,
        store.fail,
        describe,
        report_progress,
    )


def _iterate_rows(table: pa.Table) -> Iterator[dict[str, Any]]:
    for batch in table.to_batches(max_chunksize=1000):
        yield from batch.to_pylist()


_PendingRun = tuple[str, Entrant]
"""A run that is to be done: the case as JSON, and its entrant."""


def _pending_runs(suite: Suite, missing: pa.Table, folder: Path) -> Iterator[_PendingRun]:
    entrants = {entrant.name: entrant for entrant in suite.entrants}
    cases = read_cases(folder)
    for batch in missing.to_batches(max_chunksize=1000):
        texts = cases["json"].take(pc.index_in(batch["case"], cases["case"]))
        yield from zip(texts.to_pylist(), (entrants[name] for name in batch["entrant"].to_pylist()), strict=True)


def _run_all(client: Client, pending_runs: Iterable[_PendingRun]) -> Iterator[tuple[_PendingRun, Any]]:
    """Yield runs with their rows or exceptions.

    A run that takes its process down counts as one in which the robot never moves.
    """
    ours = version("qpavoid")
    for (text, entrant, _), answer in _submit_with_retry(
        client, _run_case, ((*pending_run, ours) for pending_run in pending_runs)
    ):
        if isinstance(answer, KilledWorker):
            ((_, answer),) = _submit_with_retry(client, _run_case, [(text, failing_entrant(entrant, _KILLED), ours)])
        yield (text, entrant), answer


def _collect(
    stage: str,
    total: int,
    answers: Iterable[tuple[Any, Any]],
    journal: Journal,
    fail: Callable[[dict[str, Any]], None],
    describe: Callable[[Any], dict[str, Any]],
    report_progress: Callable[[Tally], None],
) -> Tally:
    """Record every answer as it comes: rows in a journal, exceptions as failures."""
    tally = Tally(stage, 0, total, 0, 0)
    report_progress(tally)
    for call, answer in answers:
        failed, collided = isinstance(answer, BaseException), False
        if failed:
            fail({**describe(call), "failure": f"{type(answer).__name__}: {answer}"[:500]})
        else:
            journal.append(answer)
            collided = answer.get("collided", False)
        tally = Tally(stage, tally.done + 1, total, tally.collided + collided, tally.failed + failed)
        report_progress(tally)
    return tally


# --- what workers do ---------------------------------------------------------------------------------------


def _make_case(path: str, of: str, seed: int) -> dict[str, Any]:
    """Make a case and check that MuJoCo can model it: a row of `store.CASES`."""
    family = _family(path, of)
    case = make_case(family, seed)
    world = build_world(case.scenario)
    build(world.scene, world.q0)
    return {"family": family.name, "seed": seed, "origin": of, "case": case.key, "json": case.to_json()}


@lru_cache(maxsize=64)
def _family(path: str, of: str) -> Family:
    family = load_family(path)
    if origin(family) != of:
        raise ConfigError(f"{path}: is another one here; the same files and versions are needed on all machines")
    return family


def _run_case(case: str, entrant: Entrant, of: str) -> dict[str, Any]:
    """Run a case: a row of `store.RUNS`."""
    if version("qpavoid") != of:
        raise ConfigError(f"this worker has qpavoid {version('qpavoid')} in place of {of}; install the same")
    if entrant.missing:
        raise ConfigError(f"entrant {entrant.name!r} needs {', '.join(entrant.missing)}, which this worker has not")
    return run_trial(Case.from_json(case), entrant).row()


# --- Dask --------------------------------------------------------------------------------------------------


def _submit_with_retry(
    client: Client, function: Callable[..., Any], calls: Iterable[tuple[Any, ...]]
) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """Yield each call with its result or exception, as they come.

    Calls whose workers died are done once more at the end, one by one.
    """
    killed = []
    for call, answer in _submit_all(client, function, calls):
        if isinstance(answer, KilledWorker):
            killed.append(call)
        else:
            yield call, answer
    for call in killed:
        yield from _submit_all(client, function, [call])


def _submit_all(
    client: Client, function: Callable[..., Any], calls: Iterable[tuple[Any, ...]]
) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """Yield each call with its result or exception, as they come.

    No more are under way than there are threads, however many there are in all: none waits at a worker behind one that
    brings it down.
    """
    calls = iter(calls)
    pending: dict[str, tuple[Any, ...]] = {}
    futures = as_completed(with_results=True, raise_errors=False)

    def refill() -> None:
        free = max(_threads(client) - len(pending), not pending)
        for call in itertools.islice(calls, free):
            future = client.submit(function, *call, key=f"{function.__name__}-{uuid4().hex}", pure=False)
            pending[future.key] = call
            futures.add(future)

    refill()
    for future, answer in futures:
        call = pending.pop(future.key)
        if future.cancelled():
            raise ClusterLost(_SCHEDULER_LOST)
        yield call, answer[1] if future.status == "error" else answer
        del future
        refill()


def _threads(client: Client) -> int:
    """Return the number of tasks that can run at a time, on all current workers."""
    try:
        return sum(client.nthreads().values())
    except OSError:  # of a connection that is closed
        raise ClusterLost(_SCHEDULER_LOST) from None


@contextmanager
def _silenced_dask_log() -> Iterator[None]:
    """Silence Dask's log, which reports every dead worker and closed connection.

    The sweep reports those that matter.
    """
    log = logging.getLogger("distributed")
    level_before = log.level
    log.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        log.setLevel(level_before)


def _facts(suite: Suite, client: Client) -> dict[str, Any]:
    return {
        "suite": suite.name,
        "title": suite.title,
        "families": [family.name for family in suite.families],
        "seeds": len(suite.seeds),
        "first_seed": suite.seeds.start,
        "entrants": describe_entrants(suite.entrants),
        "absent": {entrant.name: list(entrant.missing) for entrant in suite.absent},
        "versions": versions(),
        "machine": machine(),
        "workers": _threads(client),
    }
