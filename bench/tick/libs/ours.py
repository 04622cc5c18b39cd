"""qpavoid, through the interface that a user embeds."""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.tick.build import make_scene, reference
from bench.tick.stages import measure
from bench.tick.workloads import Array, Workload
from qpavoid import Controller
from qpavoid.config import Avoidance, Task
from qpavoid.control.tasks import build_tasks
from qpavoid.model.trajectory import Sample


class Ours:
    """The default installation."""

    settings = (
        "Controller(solver='qp') at its defaults; Task.gain = 1/dt, which is the dead beat that the others have by "
        "default; d1 = d_min, d2 = influence distance"
    )
    packages = ("qpavoid", "pin", "coal", "daqp", "numpy", "numba")

    closing_gain = 5.0
    """ξ of its avoidance rows, by default [1/s]."""

    def __init__(self, workload: Workload) -> None:
        self.workload, self.scene = workload, make_scene(workload)
        self.controller = self._controller("qp")
        self._q = list(workload.q)
        names = [frame.name for frame in workload.frames]
        self._targets = [
            {name: Sample.at(target[:3, 3], target[:3, :3]) for name, target in zip(names, targets, strict=True)}
            for targets in workload.targets
        ]

    def _controller(self, solver: str) -> Controller:
        workload, robot = self.workload, self.scene.robot
        tasks = [Task(frame=frame.name, type="pose", gain=1.0 / workload.dt) for frame in workload.frames]
        return Controller(
            self.scene,
            build_tasks(tasks, robot, workload.q[0]),
            solver,
            workload.dt,
            Avoidance(d1=workload.d_min, d2=workload.influence),
        )

    def step(self, tick: int) -> Array:
        """One control step."""
        return self.controller.step(self._q[tick], targets=self._targets[tick]).v

    def velocity(self, v: Any) -> Array:
        """As it is."""
        return v

    def stages(self, ticks: list[int]) -> dict[str, float]:
        """Where the time goes [µs]."""
        return measure(self.step, ticks)

    def bound(self) -> Array:
        """(T,) ticks at which the answer differs from plain tracking: a row or limit binds."""
        tracking = self._controller("tracking")
        free = [tracking.step(q, targets=t).v for q, t in zip(self._q, self._targets, strict=True)]
        return np.array([not np.allclose(self.step(i), v, rtol=0.0, atol=1e-7) for i, v in enumerate(free)])

    def frames(self, tick: int) -> Array:
        """By Pinocchio on this scene's model."""
        return reference(self.scene, self.workload, [tick])[0][0]

    def distances(self, tick: int) -> Array:
        """By coal on this scene's geometry."""
        return reference(self.scene, self.workload, [tick])[1][0]
