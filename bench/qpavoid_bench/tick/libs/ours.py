"""qpavoid, through the interface that a user embeds: this one, or another that is put before it on the path."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid import Avoidance, Controller, Pose, Sample, build_tasks
from qpavoid.config import Task
from qpavoid_bench.tick.build import make_scene, reference
from qpavoid_bench.tick.loops import Loop, make_loop
from qpavoid_bench.tick.workloads import Array, Workload


def make(workload: Workload | str) -> Recorded | Loop:
    """Return a workload, recorded or of qpavoid alone, ready to be stepped."""
    return make_loop(workload) if isinstance(workload, str) else Recorded(workload)


class Recorded:
    """Plays back the recorded swing, with the targets and obstacles that the workload's variant names."""

    def __init__(self, workload: Workload) -> None:
        self.workload, self.scene = workload, make_scene(workload)
        is_held = workload.variant == "held"
        names = [name for name, _, _ in workload.frames]
        tasks = [Task(frame=name, type="pose") for name in names]
        if not is_held:
            tasks = [Task(frame=name, type="pose", gain=1.0 / workload.dt) for name in names]
        self.controller = Controller(
            self.scene,
            build_tasks(tasks, self.scene.robot, workload.q[0]),
            "qp",
            workload.dt,
            Avoidance(d1=workload.d_min, d2=workload.influence),
        )
        self._q = list(workload.q)
        self._steps = 0
        self._targets: list[Any] = [None] * len(self._q)
        if not is_held:
            self._targets = [
                {name: Sample.at(target[:3, 3], target[:3, :3]) for name, target in zip(names, targets, strict=True)}
                for targets in workload.targets
            ]
        self._obstacles = self._given() if workload.variant[:-1] and not is_held else None

    def _given(self) -> dict[str, Any]:
        """Return the first obstacles, as many as the variant says, as a Sample or a Pose where they are."""
        kind = Sample if self.workload.variant.startswith("sample") else Pose
        count = int(self.workload.variant.removeprefix("sample").removeprefix("pose"))
        bodies = self.workload.bodies[len(self.workload.bodies) - self.workload.obstacles :][:count]
        return {body.name: kind.at(body.placement[:3, 3], body.placement[:3, :3]) for body in bodies}

    def step(self, tick: int) -> Array:
        """One control step."""
        if self._obstacles is None:
            return self.controller.step(self._q[tick], targets=self._targets[tick]).v
        self._steps += 1
        t = self._steps * self.workload.dt
        return self.controller.step(self._q[tick], t, self._targets[tick], self._obstacles).v

    def problem(self, tick: int) -> Any:
        """Return the `Problem` of a control step."""
        return self.controller.tick(self._q[tick], None, self._targets[tick], self._obstacles).problem

    def velocity(self, v: Array) -> Array:
        """As it is."""
        return v

    def frames(self, tick: int) -> Array:
        """By Pinocchio on this scene's model."""
        return np.asarray(reference(self.scene, self.workload, [tick])[0][0])

    def distances(self, tick: int) -> Array:
        """By coal on this scene's geometry."""
        return np.asarray(reference(self.scene, self.workload, [tick])[1][0])
