"""The closed loop of the arena: one entrant in one case, with velocities that are followed exactly."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from time import perf_counter

import numpy as np
import pinocchio as pin

from qpavoid.arena.case import Case, Sight
from qpavoid.arena.pilot import Pilot
from qpavoid.arena.world import World
from qpavoid.model.trajectory import Sample
from qpavoid.problem import Array, IntArray, Solution, Status
from qpavoid.run.log import STATUSES


@dataclass(frozen=True)
class Rollout:
    """What an entrant did; N ticks, k tools."""

    t: Array
    """(N,) [s]."""
    q: Array
    """(N, nq)."""
    v: Array
    """(N, nv) [rad/s or m/s]."""
    tool: Array
    """(N, k, 3) where the frames of the tasks were [m]."""
    target: Array
    """(N, k, 3) where they were meant to be [m]."""
    status: IntArray
    """(N,) indices into `qpavoid.run.log.STATUSES`."""
    failed: Array
    """(N,) 1 where the entrant raised or gave no finite velocity, else 0."""
    tick: Array
    """(N,) time that it took [s]; where a pilot works in another process, what it says of that."""
    failure: str
    """The first thing that it said when it failed."""


def roll_out(case: Case, pilot: Pilot, world: World, patience: float = np.inf) -> Rollout:
    """Runs a case to its end. Where the entrant fails, the robot is held for that tick.

    Args:
        case: what is run.
        pilot: who runs it.
        world: of the same case.
        patience: time that the entrant may take in all [s]; after that, it fails at every tick.
    """
    model, dt = world.scene.robot.model, case.scenario.dt
    data, count = model.createData(), round(case.scenario.duration / dt) + 1
    tools, sight = world.tools, Sight(case, world.scene.obstacles)
    shapes = {"q": (model.nq,), "v": (model.nv,), "tool": (len(tools), 3), "target": (len(tools), 3)}
    out = {name: np.zeros((count, *shape)) for name, shape in shapes.items()}
    failed, tick, status, failure = np.zeros(count), np.zeros(count), np.zeros(count, dtype=np.intp), ""
    q = world.q0
    for k in range(count):
        pin.framesForwardKinematics(model, data, q)
        targets = {task.settings.label: task.motion.sample(k * dt) for task in world.tasks}
        out["q"][k] = q
        out["tool"][k] = [data.oMf[task.frame_id].translation for task in tools]
        out["target"][k] = [targets[task.settings.label].position for task in tools]
        seen = sight.look(k * dt)
        begin = perf_counter()
        patient = tick.sum() < patience
        solution, said = _asked(pilot, q, k * dt, targets, seen) if patient else (None, "out of time")
        elapsed = perf_counter() - begin
        tick[k] = getattr(pilot, "seconds", elapsed) if patient else elapsed
        if solution is None:
            failed[k], failure = 1.0, failure or said
        else:
            out["v"][k] = solution.v
        status[k] = STATUSES.index(Status.STOPPED if solution is None else solution.status)
        q = pin.integrate(model, q, out["v"][k] * dt)
    return Rollout(
        t=dt * np.arange(count, dtype=np.float64), status=status, failed=failed, tick=tick, failure=failure, **out
    )


def _asked(
    pilot: Pilot, q: Array, t: float, targets: Mapping[str, Sample], seen: Mapping[str, Sample]
) -> tuple[Solution | None, str]:
    """What the entrant answers; None and why, where it does not."""
    try:
        solution = pilot.step(q.copy(), t, targets, seen)
        if np.isfinite(solution.v).all():
            return solution, ""
        return None, "NaN or infinity in its velocity"
    except Exception as error:  # whatever another library raises is a result here
        return None, f"{type(error).__name__}: {error}"[:200]
