"""Runs a suite: makes the cases that are not there yet, then all runs that are not there yet, on a Dask cluster.

The same code runs on the cores of this machine and on a cluster of many: only the client differs. A task whose worker
dies is done again, in the end with nothing else beside it that could have brought the worker down; a task has one
answer, whoever gave it, and each answer is in the results folder before the next one is looked at.
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

from qpavoid.arena.case import Case
from qpavoid.arena.entrants import Entrant
from qpavoid.arena.families import Family, load_family, make_case
from qpavoid.arena.plan import cases_of, missing_cases, missing_runs
from qpavoid.arena.store import Journal, Store, read_cases
from qpavoid.arena.suite import Suite, facts_of, origin
from qpavoid.arena.trial import held, run_trial
from qpavoid.arena.twin import build
from qpavoid.arena.world import build_world
from qpavoid.errors import ConfigError, QpavoidError
from qpavoid.run.machine import machine, versions

_ANSWER_WITHIN = 10.0
"""Time in which a scheduler has to answer, and a first worker to be there [s]."""
_LOOK_FOR_LOST = 2.0
"""Time between looks at whether all processes of this machine are there [s]."""
_KILLED = "the processes that ran it ended before it was done, each time: killed, out of memory or crashed"
_GONE = "the scheduler went away"
_SINGLE_THREADED = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "NUMBA")}
_DEAF = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"
"""Run by a worker as it starts: a terminal sends Ctrl-C to it as well, and it is for the sweep to end its workers."""
_DASK = {
    "distributed.scheduler.allowed-failures": 0,  # whose worker died is tried again by us, alone
    "distributed.admin.low-level-log-length": 0,  # the scheduler's memory stays flat
    "distributed.deploy.lost-worker-timeout": "60 s",  # on a busy machine it takes long to start again
}


class ClusterLost(QpavoidError):
    """The scheduler went away; what was done is kept."""


class Tally(NamedTuple):
    """How far a sweep is."""

    stage: str
    """`cases` or `runs`."""
    done: int
    total: int
    """Of those that were not there before."""
    collided: int
    """Runs with a contact among them."""
    failed: int
    """Of which there is no row: they are in failures.jsonl."""


@contextmanager
def local_cluster(jobs: int | None = None) -> Iterator[Client]:
    """Processes of one thread each on this machine, one a core if `jobs` is left out."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    count = cores if jobs is None else jobs
    with (
        _quiet(),
        dask.config.set(_DASK),
        LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"},
            silence_logs=logging.CRITICAL,
            env=_SINGLE_THREADED,
            preload=[_DEAF],
        ) as cluster,
        Client(cluster) as client,
    ):
        # Dask gives a worker up that is not back in time, or that dies again as it starts, and replaces it when asked
        asking = PeriodicCallback(lambda: cluster.scale(count), 1e3 * _LOOK_FOR_LOST)
        cluster.periodic_callbacks["lost workers"] = asking  # stopped when the cluster is closed
        cluster.loop.add_callback(asking.start)
        yield client


@contextmanager
def remote_cluster(address: str) -> Iterator[Client]:
    """A Dask cluster that runs already.

    Raises:
        ConfigError: no scheduler or no worker answers, or one is of another version of qpavoid.
    """
    with _quiet():
        try:
            client = Client(address, timeout=_ANSWER_WITHIN)
        except (OSError, ValueError, TypeError) as error:  # TimeoutError among them
            start = "start one with `dask scheduler`, and give the address that it prints, as in tcp://host:8786"
            said = " ".join(str(error).split()) or type(error).__name__
            raise ConfigError(f"--cluster {address}: no scheduler answers: {said:.200}; {start}") from None
        with client:
            _check_workers(client, address)
            yield client


def _check_workers(client: Client, address: str) -> None:
    try:
        client.wait_for_workers(1, timeout=_ANSWER_WITHIN)
    except TimeoutError:
        raise ConfigError(f"--cluster {address}: no worker there; start some with `dask worker {address}`") from None
    for worker, found in client.run(version, "qpavoid", on_error="return").items():
        if found != version("qpavoid"):
            said = f"qpavoid {found}" if isinstance(found, str) else f"no qpavoid ({type(found).__name__}: {found})"
            raise ConfigError(
                f"--cluster {address}: worker {worker} has {said}, here it is {version('qpavoid')}; install the same"
            )


def sweep(suite: Suite, store: Store, client: Client, tell: Callable[[Tally], None]) -> Tally:
    """Makes and runs whatever of a suite is not in the store yet.

    Args:
        suite: what is to be there in the end.
        store: where results go.
        client: who does the work.
        tell: hears how far it is, after every answer.

    Returns:
        How it ended: runs, and what failed of cases and runs.

    Raises:
        ClusterLost: the scheduler went away.
    """
    store.describe(_facts(suite, client))
    lost = _make_cases(suite, store, client, tell).failed
    todo = missing_runs(suite, store.folder, cases_of(suite, store.folder))

    def about(unit: _Unit) -> dict[str, Any]:
        case = Case.from_json(unit[0])
        return {"family": case.family, "seed": case.seed, "entrant": unit[1].name}

    answers = _run_all(client, _units(suite, todo, store.folder))
    tally = _collect("runs", len(todo), answers, store.runs, store.fail, about, tell)
    return tally._replace(failed=tally.failed + lost)


def _make_cases(suite: Suite, store: Store, client: Client, tell: Callable[[Tally], None]) -> Tally:
    todo = missing_cases(suite, store.folder)
    paths = {family.name: str(family.path.resolve()) for family in suite.families}
    calls = ((paths[row["family"]], row["origin"], row["seed"]) for row in _each(todo))

    def about(call: tuple[str, str, int]) -> dict[str, Any]:
        return {"family": Path(call[0]).stem, "seed": call[2], "entrant": None}

    return _collect("cases", len(todo), _answers(client, _make, calls), store.cases, store.fail, about, tell)


def _each(table: pa.Table) -> Iterator[dict[str, Any]]:
    for batch in table.to_batches(max_chunksize=1000):
        yield from batch.to_pylist()


_Unit = tuple[str, Entrant]
"""A run that is to be done: the case as JSON, and who runs it."""


def _units(suite: Suite, todo: pa.Table, folder: Path) -> Iterator[_Unit]:
    entrants = {entrant.name: entrant for entrant in suite.entrants}
    cases = read_cases(folder)
    for batch in todo.to_batches(max_chunksize=1000):
        texts = cases["json"].take(pc.index_in(batch["case"], cases["case"]))
        yield from zip(texts.to_pylist(), (entrants[name] for name in batch["entrant"].to_pylist()), strict=True)


def _run_all(client: Client, units: Iterable[_Unit]) -> Iterator[tuple[_Unit, Any]]:
    """Runs with their rows, or what was raised; one that takes its process down counts as one that never moves."""
    ours = version("qpavoid")
    for (text, entrant, _), answer in _answers(client, _run, ((*unit, ours) for unit in units)):
        if isinstance(answer, KilledWorker):
            ((_, answer),) = _answers(client, _run, [(text, held(entrant, _KILLED), ours)])
        yield (text, entrant), answer


def _collect(
    stage: str,
    total: int,
    answers: Iterable[tuple[Any, Any]],
    journal: Journal,
    fail: Callable[[dict[str, Any]], None],
    about: Callable[[Any], dict[str, Any]],
    tell: Callable[[Tally], None],
) -> Tally:
    """Writes down every answer as it comes: rows into a journal, and what was raised with what it is about."""
    tally = Tally(stage, 0, total, 0, 0)
    tell(tally)
    for call, answer in answers:
        failed, collided = isinstance(answer, BaseException), False
        if failed:
            fail({**about(call), "failure": f"{type(answer).__name__}: {answer}"[:500]})
        else:
            journal.append(answer)
            collided = answer.get("collided", False)
        tally = Tally(stage, tally.done + 1, total, tally.collided + collided, tally.failed + failed)
        tell(tally)
    return tally


# --- what workers do ---------------------------------------------------------------------------------------


def _make(path: str, of: str, seed: int) -> dict[str, Any]:
    """Makes a case, and sees to it that it can be judged: a row of `store.CASES`."""
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


def _run(case: str, entrant: Entrant, of: str) -> dict[str, Any]:
    """Runs a case: a row of `store.RUNS`."""
    if version("qpavoid") != of:
        raise ConfigError(f"this worker has qpavoid {version('qpavoid')} in place of {of}; install the same")
    if entrant.missing:
        raise ConfigError(f"entrant {entrant.name!r} needs {', '.join(entrant.missing)}, which this worker has not")
    return run_trial(Case.from_json(case), entrant).row()


# --- Dask --------------------------------------------------------------------------------------------------


def _answers(
    client: Client, function: Callable[..., Any], calls: Iterable[tuple[Any, ...]]
) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """Each call with what it returned or raised, as they come; at the end, one by one, those whose workers died."""
    killed = []
    for call, answer in _together(client, function, calls):
        if isinstance(answer, KilledWorker):
            killed.append(call)
        else:
            yield call, answer
    for call in killed:
        yield from _together(client, function, [call])


def _together(
    client: Client, function: Callable[..., Any], calls: Iterable[tuple[Any, ...]]
) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """Each call with what it returned or raised, as they come.

    No more are under way than there are threads, however many there are in all: none waits at a worker behind one that
    brings it down.
    """
    calls = iter(calls)
    under_way: dict[str, tuple[Any, ...]] = {}
    futures = as_completed(with_results=True, raise_errors=False)

    def refill() -> None:
        free = max(_threads(client) - len(under_way), not under_way)
        for call in itertools.islice(calls, free):
            future = client.submit(function, *call, key=f"{function.__name__}-{uuid4().hex}", pure=False)
            under_way[future.key] = call
            futures.add(future)

    refill()
    for future, answer in futures:
        call = under_way.pop(future.key)
        if future.cancelled():
            raise ClusterLost(_GONE)
        yield call, answer[1] if future.status == "error" else answer
        del future
        refill()


def _threads(client: Client) -> int:
    """How many tasks can run at a time, on all workers that are there now."""
    try:
        return sum(client.nthreads().values())
    except OSError:  # of a connection that is closed
        raise ClusterLost(_GONE) from None


@contextmanager
def _quiet() -> Iterator[None]:
    """Dask's log tells of every worker that dies, and of every connection that closes; what matters is told by us."""
    log = logging.getLogger("distributed")
    before = log.level
    log.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        log.setLevel(before)


def _facts(suite: Suite, client: Client) -> dict[str, Any]:
    return {
        "suite": suite.name,
        "title": suite.title,
        "families": [family.name for family in suite.families],
        "seeds": len(suite.seeds),
        "first_seed": suite.seeds.start,
        "entrants": facts_of(suite.entrants),
        "absent": {entrant.name: list(entrant.missing) for entrant in suite.absent},
        "versions": versions(),
        "machine": machine(),
        "workers": _threads(client),
    }
