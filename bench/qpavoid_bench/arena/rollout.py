"""Closed loop of the arena: one entrant in one case, with velocities followed exactly."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from time import perf_counter, process_time
from typing import Protocol

import numpy as np
import pinocchio as pin

from qpavoid.model.sample import Sample
from qpavoid.problem import Array, IntArray, Solution, Status
from qpavoid.run.log import STATUSES
from qpavoid_bench.arena.case import Case, SensorModel
from qpavoid_bench.arena.world import World


class Pilot(Protocol):
    """One entrant, set up for one case.

    A `Controller` is one; other libraries come in through adapters. A pilot that works in another process gives the
    time of its last step there in an attribute `seconds` [s].
    """

    def step(self, q: Array, t: float, targets: Mapping[str, Sample], obstacles: Mapping[str, Sample]) -> Solution:
        """Compute the velocity for the next control period.

        Args:
            q: configuration (nq,) in the order of the scene's model.
            t: time [s].
            targets: what each task should reach now, by its name.
            obstacles: where each obstacle is seen, and how it moves.

        Raises:
            Exception: it has no velocity for this step; the robot stays still, and the next step is asked for again.
        """
        ...


@dataclass(frozen=True)
class Rollout:
    """Record of an entrant in a case; N steps, k tools."""

    t: Array
    """(N,) time [s]."""
    q: Array
    """(N, nq) configuration [rad or m]."""
    v: Array
    """(N, nv) commanded velocity [rad/s or m/s]."""
    tool: Array
    """(N, k, 3) positions of the tasks' frames [m]."""
    target: Array
    """(N, k, 3) positions of their targets [m]."""
    status: IntArray
    """(N,) indices into `qpavoid.run.log.STATUSES`."""
    failed: Array
    """(N,) 1 where the entrant raised or gave no finite velocity, else 0."""
    tick: Array
    """(N,) computation time of the step, without what else the machine does meanwhile [s]; of a pilot in another
    process, as that process measured it."""
    failure: str
    """Message of the first failure; empty without one."""


def roll_out(case: Case, pilot: Pilot, world: World, time_budget: float = np.inf) -> Rollout:
    """Run a case to its end; where the entrant fails, the robot stays still for that step.

    Args:
        case: what is run.
        pilot: who runs it.
        world: of the same case.
        time_budget: time that the entrant may take in all [s]; after that, it fails at every tick.
    """
    model, dt = world.scene.robot.model, case.scenario.dt
    data, count = model.createData(), round(case.scenario.duration / dt) + 1
    tools, sensor = world.tools, SensorModel(case, world.scene.obstacles)
    shapes = {"q": (model.nq,), "v": (model.nv,), "tool": (len(tools), 3), "target": (len(tools), 3)}
    out = {name: np.zeros((count, *shape)) for name, shape in shapes.items()}
    failed, tick, status, failure = np.zeros(count), np.zeros(count), np.zeros(count, dtype=np.intp), ""
    q, spent = world.q0, 0.0
    for k in range(count):
        pin.framesForwardKinematics(model, data, q)
        targets = {task.settings.label: task.motion.sample(k * dt) for task in world.tasks}
        out["q"][k] = q
        out["tool"][k] = [data.oMf[task.frame_id].translation for task in tools]
        out["target"][k] = [targets[task.settings.label].position for task in tools]
        measured = sensor.measure(k * dt)
        begin, computed = perf_counter(), process_time()
        in_time = spent < time_budget
        solution, message = _ask_pilot(pilot, q, k * dt, targets, measured) if in_time else (None, "out of time")
        spent, computed = spent + perf_counter() - begin, process_time() - computed
        tick[k] = getattr(pilot, "seconds", computed) if in_time else computed
        if solution is None:
            failed[k], failure = 1.0, failure or message
        else:
            out["v"][k] = solution.v
        status[k] = STATUSES.index(Status.STOPPED if solution is None else solution.status)
        q = pin.integrate(model, q, out["v"][k] * dt)
    return Rollout(
        t=dt * np.arange(count, dtype=np.float64), status=status, failed=failed, tick=tick, failure=failure, **out
    )


def _ask_pilot(
    pilot: Pilot, q: Array, t: float, targets: Mapping[str, Sample], measured: Mapping[str, Sample]
) -> tuple[Solution | None, str]:
    """Return the entrant's solution; None and the reason if it has none."""
    try:
        solution = pilot.step(q.copy(), t, targets, measured)
        if np.isfinite(solution.v).all():
            return solution, ""
        return None, "NaN or infinity in its velocity"
    except Exception as error:  # whatever another library raises is a result here
        return None, f"{type(error).__name__}: {error}"[:200]
