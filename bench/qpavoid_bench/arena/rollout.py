"""Closed loop of the arena: one entrant in one case, with velocities followed exactly, or torques by a plant."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from time import perf_counter, process_time
from typing import Protocol

import numpy as np
import pinocchio as pin

from qpavoid.model.sample import Sample
from qpavoid.problem import Array, IntArray, Solution, Status
from qpavoid.run.log import STATUSES
from qpavoid_bench.arena.bodies import Body, make_body
from qpavoid_bench.arena.case import Case, SensorModel
from qpavoid_bench.arena.world import World


class Pilot(Protocol):
    """One entrant, set up for one case.

    A `Controller` is one; other libraries come in through adapters. A pilot that works in another process gives the
    time of its last step there in an attribute `seconds` [s]. In a case with a plant, it is given `v`, the measured
    velocity, too, and has to give torques.
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
    """(N, nv) commanded velocity; of a plant, that at the end of the step [rad/s or m/s]."""
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
    torque: Array = field(default_factory=lambda: np.zeros((0, 0)))
    """(N, m) commanded torques [Nm or N]; none where velocities are followed."""
    torque_limit: Array = field(default_factory=lambda: np.zeros(0))
    """(m,) largest torques of the motors [Nm or N]."""
    slip: float = 0.0
    """Largest way of a contact point along the floor [m]."""
    fallen: float = 0.0
    """Share of the duration after the robot fell, in which nothing is run any more [-]."""


def roll_out(case: Case, pilot: Pilot, world: World, time_budget: float = np.inf) -> Rollout:
    """Run a case to its end, or until the robot falls.

    Where the entrant fails, the robot stays still for that step, or its torques stay as they are.

    Args:
        case: what is run.
        pilot: who runs it.
        world: of the same case.
        time_budget: time that the entrant may take in all [s]; after that, it fails at every tick.
    """
    model, dt = world.scene.robot.model, case.scenario.dt
    data, count = model.createData(), round(case.scenario.duration / dt) + 1
    tools, sensor = world.tools, SensorModel(case, world.scene.obstacles)
    body = make_body(case.scenario, world)
    shapes = {"q": (model.nq,), "v": (model.nv,), "tool": (len(tools), 3), "target": (len(tools), 3)}
    shapes["torque"] = body.torque.shape
    out = {name: np.zeros((count, *shape)) for name, shape in shapes.items()}
    failed, tick, status, failure = np.zeros(count), np.zeros(count), np.zeros(count, dtype=np.intp), ""
    slip, spent, done = 0.0, 0.0, 0
    while done < count and not body.has_fallen:
        k = done
        pin.framesForwardKinematics(model, data, body.q)
        targets = {task.settings.label: task.motion.sample(k * dt) for task in world.tasks}
        out["q"][k] = body.q
        out["tool"][k] = [data.oMf[task.frame_id].translation for task in tools]
        out["target"][k] = [targets[task.settings.label].position for task in tools]
        measured = sensor.measure(k * dt)
        begin, computed = perf_counter(), process_time()
        in_time = spent < time_budget
        solution, message = _ask_pilot(pilot, body, k * dt, targets, measured) if in_time else (None, "out of time")
        spent, computed = spent + perf_counter() - begin, process_time() - computed
        tick[k] = getattr(pilot, "seconds", computed) if in_time else computed
        if solution is None:
            failed[k], failure = 1.0, failure or message
        status[k] = STATUSES.index(Status.STOPPED if solution is None else solution.status)
        body.follow(solution, dt)
        out["v"][k], out["torque"][k], slip, done = body.v, body.torque, max(slip, body.slip), done + 1
    arrays = {"status": status, "failed": failed, "tick": tick, **out}
    return Rollout(
        t=dt * np.arange(done, dtype=np.float64), failure=failure, torque_limit=body.torque_limit, slip=slip,
        fallen=1.0 - done / count, **{name: array[:done] for name, array in arrays.items()},
    )  # fmt: skip


def _ask_pilot(
    pilot: Pilot, body: Body, t: float, targets: Mapping[str, Sample], measured: Mapping[str, Sample]
) -> tuple[Solution | None, str]:
    """Return the entrant's solution; None and the reason if it has none."""
    try:
        q, v = body.measure()
        velocity = {} if v is None else {"v": v}
        solution = pilot.step(q, t, targets, measured, **velocity)
        torque = solution.v if v is None else solution.torque
        if torque is None:
            return None, "no torques"
        if np.isfinite(solution.v).all() and np.isfinite(torque).all():
            return solution, ""
        return None, "NaN or infinity in its velocity or torques"
    except Exception as error:  # whatever another library raises is a result here
        return None, f"{type(error).__name__}: {error}"[:200]
