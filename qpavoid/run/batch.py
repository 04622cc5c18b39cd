"""Run many scenarios, or many states of one, on all cores; see `qpavoid.run.pool`."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, nullcontext
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from qpavoid.config import ScenarioConfig
from qpavoid.config.loading import load_scenario
from qpavoid.config.shipped import find_robot
from qpavoid.controller import Controller
from qpavoid.errors import QpavoidError, located
from qpavoid.model.robot import Robot
from qpavoid.problem import Array, require_finite
from qpavoid.run.log import STATUSES, Log
from qpavoid.run.pool import Workers, cores
from qpavoid.run.simulate import run


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
        answers = workers.map(_simulate, calls, progress)
    if errors := {i: answer for i, answer in enumerate(answers) if isinstance(answer, Exception)}:
        raise BatchError([None if i in errors else answer for i, answer in enumerate(answers)], errors)
    return answers


def _simulate(scenario: ScenarioConfig | str) -> Log:
    """Run a scenario, with the robot of an earlier one where it is the same: loading takes as long as 500 steps."""
    scenario = load_scenario(scenario) if isinstance(scenario, str) else scenario
    with located(f"{scenario.source}: robot"):
        file = find_robot(scenario.robot, scenario.source.parent)
        robot = _robot(file, file.stat().st_mtime_ns)
    return run(scenario, robot)


@lru_cache(maxsize=4)
def _robot(file: Path, changed: int) -> Robot:
    """Load the robot of a file that was changed at some time; those that it names count as part of it."""
    return Robot.load(file)


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


def _workers(jobs: int | Workers | None, count: int) -> AbstractContextManager[Workers]:
    """Return workers for at most `count` calls; `Workers` that the caller owns stay open."""
    if isinstance(jobs, Workers):
        return nullcontext(jobs)
    return Workers(min(cores() if jobs is None else jobs, max(count, 1)))
