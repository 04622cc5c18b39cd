"""Sweeps: make the missing cases of a suite, then do its missing runs, in processes of this machine or of a cluster.

Each answer is in the results folder before the next one is read. What ends its process, or takes too long, twice, is a
run in which the robot never moves.
"""

from __future__ import annotations

import faulthandler
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from qpavoid.errors import ConfigError
from qpavoid.run.machine import machine, versions
from qpavoid.run.mujoco import build
from qpavoid.run.pool import WorkerDied, Workers
from qpavoid_bench.arena.case import Case
from qpavoid_bench.arena.entrants import Entrant
from qpavoid_bench.arena.families import Family, load_family, make_case
from qpavoid_bench.arena.store import Store
from qpavoid_bench.arena.suite import Suite, describe_entrants, origin
from qpavoid_bench.arena.trial import failing_entrant, run_trial
from qpavoid_bench.arena.world import build_world

TIME_LIMIT = 1800.0
"""Time after which a process that makes or runs one case is ended [s]: it hangs. An entrant that is slow fails long
before, see `trial.MAX_TIME_RATIO`."""
_KILLED = "the processes that ran it ended before it was done, each time: killed, out of memory, crashed or too slow"


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
    """Number without a row: they are among the failures of the store."""


class Plan(NamedTuple):
    """What a suite asks of a store."""

    cases: list[tuple[str, int, str]]
    """Cases that are not made: family, seed, origin."""
    runs: list[tuple[str, Entrant]]
    """Runs that are not done, of the cases that are made: the case as JSON, and its entrant."""
    keys: frozenset[tuple[str, ...]]
    """Keys of all runs, done or not, of the cases that are made; as `scores.KEY`."""
    texts: list[str]
    """Cases that are made, as JSON, family by family."""


def plan(suite: Suite, store: Store) -> Plan:
    """Compare what a suite asks for with what is in a store."""
    made, done, here = store.cases(), store.run_keys(), version("qpavoid")
    chosen = [(family.name, seed, of) for family, of in _origins(suite) for seed in suite.seeds]
    cases = [made[key] for key in chosen if key in made]
    runs = [
        (text, entrant, (case, entrant.name, entrant.digest, here))
        for case, text in cases
        for entrant in suite.entrants
    ]
    return Plan(
        cases=[key for key in chosen if key not in made],
        runs=[(text, entrant) for text, entrant, key in runs if key not in done],
        keys=frozenset(key for *_, key in runs),
        texts=[text for _, text in cases],
    )


def sweep(suite: Suite, store: Store, workers: Workers, report_progress: Callable[[Tally], None]) -> Tally:
    """Make and run whatever of a suite is not in the store yet.

    Args:
        suite: what is to be there in the end.
        store: where results go.
        workers: who do the work.
        report_progress: called with the progress after every answer.

    Returns:
        How it ended: runs, and what failed of cases and runs.

    Raises:
        ClusterLost: the scheduler went away.
    """
    store.begin(_facts(suite, workers))
    paths = {family.name: str(family.path.resolve()) for family in suite.families}
    calls = [(paths[family], of, seed) for family, seed, of in plan(suite, store).cases]
    answers = (
        ({"family": Path(call[0]).stem, "seed": call[2], "entrant": None}, answer)
        for call, answer in workers.as_completed(_make_case, calls)
    )
    failed_cases = _collect(Tally("cases", 0, len(calls), 0, 0), answers, store, report_progress).failed
    runs = plan(suite, store).runs
    tally = _collect(Tally("runs", 0, len(runs), 0, 0), _run_all(workers, runs), store, report_progress)
    return tally._replace(failed=tally.failed + failed_cases)


def _run_all(workers: Workers, runs: Iterable[tuple[str, Entrant]]) -> Iterator[tuple[dict[str, Any], Any]]:
    """Yield the subject of each run with its row or exception."""
    ours = version("qpavoid")
    for (text, entrant, _), answer in workers.as_completed(_run_case, ((*run, ours) for run in runs)):
        if isinstance(answer, WorkerDied):
            ((_, answer),) = workers.as_completed(_run_case, [(text, failing_entrant(entrant, _KILLED), ours)])
        case = Case.from_json(text)
        yield {"family": case.family, "seed": case.seed, "entrant": entrant.name}, answer


def _collect(
    tally: Tally,
    answers: Iterable[tuple[Mapping[str, Any], Any]],
    store: Store,
    report_progress: Callable[[Tally], None],
) -> Tally:
    """Record every answer as it comes: rows in their table, exceptions as failures."""
    report_progress(tally)
    for subject, answer in answers:
        failed, collided = isinstance(answer, BaseException), False
        if failed:
            store.fail({**subject, "failure": f"{type(answer).__name__}: {answer}"[:500]})
        else:
            store.add(tally.stage, answer)
            collided = answer.get("collided", False)
        tally = tally._replace(done=tally.done + 1, collided=tally.collided + collided, failed=tally.failed + failed)
        report_progress(tally)
    return tally


def _make_case(path: str, of: str, seed: int) -> dict[str, Any]:
    """Make a case and check that MuJoCo can model it: a row of `cases`; runs in a worker."""
    with _time_limit():
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
    """Run a case: a row of `runs`; runs in a worker."""
    if version("qpavoid") != of:
        raise ConfigError(f"this worker has qpavoid {version('qpavoid')} in place of {of}; install the same")
    if reason := entrant.prepare():
        raise ConfigError(f"entrant {entrant.name!r} cannot take part here: {reason}")
    with _time_limit():
        return run_trial(Case.from_json(case), entrant).row()


@contextmanager
def _time_limit() -> Iterator[None]:
    """End this process, with a traceback on stderr, if the block takes longer than `TIME_LIMIT`."""
    faulthandler.dump_traceback_later(TIME_LIMIT, exit=True, file=sys.__stderr__ or 2)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()


def _origins(suite: Suite) -> list[tuple[Family, str]]:
    return [(family, origin(family)) for family in suite.families]


def _facts(suite: Suite, workers: Workers) -> dict[str, Any]:
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
        "workers": len(workers),
    }
