"""QPs of closed loops, in the order of their control steps: of those steps in which tracking alone is not safe."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from qpavoid import Controller, ScenarioConfig, load_scenario
from qpavoid.config import QpSolver
from qpavoid.config.shipped import shipped_names
from qpavoid.problem import Array, Problem
from qpavoid_bench.tick.build import build
from qpavoid_bench.tick.loops import circling
from qpavoid_bench.tick.ours import Recorded

REGULARIZATION = QpSolver().regularization


class QP(NamedTuple):
    """min ½ xᵀP x + qᵀx subject to G x >= h, lower <= x <= upper; P = AᵀA + λ 1, q = -P v."""

    P: Array
    """(n, n)."""
    q: Array
    """(n,)."""
    G: Array
    """(m, n)."""
    h: Array
    """(m,)."""
    lower: Array
    """(n,)."""
    upper: Array
    """(n,)."""
    A: Array
    """(k, n) task rows."""
    v: Array
    """(n,) tracking velocity."""


class Run(NamedTuple):
    """The QPs of one closed loop."""

    name: str
    dt: float
    """Control period [s]."""
    steps: int
    """Control steps of the loop, with or without a QP."""
    qps: list[QP]


def runs(every: int = 1) -> list[Run]:
    """Return all runs that have a QP, recorded in this process.

    Args:
        every: keep the QPs of every so many control steps only; warm starts get older with it.
    """
    shipped = [load_scenario(name) for name in shipped_names("scenario")]
    scenarios = {each.source.stem: each for each in shipped if each.solver.name == "qp" and each.dynamics is None}
    scenarios["circling"] = circling(backup=None)
    scenarios["squeezed"] = load_scenario(str(Path(__file__).with_name("squeezed.yaml")))
    recorded = [*(_of_scenario(name, each, every) for name, each in scenarios.items()), _humanoid(every)]
    return [run for run in recorded if run.qps]


def _of_scenario(name: str, scenario: ScenarioConfig, every: int) -> Run:
    controller, q = Controller.from_scenario(scenario)
    qps = []
    steps = round(scenario.duration / scenario.dt) + 1
    for k in range(steps):
        tick = controller.tick(q, k * controller.dt)
        if k % every == 0 and tick.problem.violation > 0.0:
            qps.append(_qp(tick.problem))
        q = pin.integrate(controller.scene.robot.model, q, tick.solution.v * controller.dt)
    return Run(name, controller.dt, steps, qps)


def _humanoid(every: int) -> Run:
    """Play the G1 of `qpavoid bench tick` back: 35 velocities, four pose tasks, 8 obstacles, self-collision."""
    loop = Recorded(build("g1-8@0.30"))
    steps = range(0, len(loop.workload.q), every)
    problems = [loop.problem(k) for k in steps]
    return Run("g1", loop.workload.dt, len(steps), [_qp(problem) for problem in problems if problem.violation > 0.0])


def _qp(problem: Problem) -> QP:
    A, rows, v = np.array(problem.tracking.A), problem.avoidance, np.array(problem.v_tracking)
    P = A.T @ A + REGULARIZATION * np.eye(A.shape[1])
    h, lower, upper = (np.array(side) for side in (rows.b, problem.lower, problem.upper))
    return QP(P, -P @ v, np.array(rows.J, order="C"), h, lower, upper, A, v)


Solve = Callable[[QP], "Array | None"]
"""A back end as it is replayed: the minimum (n,), or None where it found none."""
