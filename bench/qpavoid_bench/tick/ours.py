"""qpavoid, through the interface that a user embeds: this one, or another that is put before it on the path."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid import Avoidance, Controller, Pose, Sample, build_tasks
from qpavoid.config import Task
from qpavoid_bench.tick.build import make_scene, reference
from qpavoid_bench.tick.loops import Loop, make_loop
from qpavoid_bench.tick.workloads import Array, Workload


def Library(workload: Workload | str) -> Recorded | Loop:
    """Return a workload, recorded or of qpavoid alone, ready to be stepped: what `libraries.foreign.worker` serves."""
    return make_loop(workload) if isinstance(workload, str) else Recorded(workload)


class Recorded:
    """Plays back the recorded swing, with the targets and obstacles that the workload's variant names."""

    def __init__(self, workload: Workload) -> None:
        self.workload, self.scene = workload, make_scene(workload)
        is_held = workload.variant == "held"
        names = self._names = list(workload.frames)
        self._is_held = is_held
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
        self._steps = 0
        self._obstacles = self._given() if workload.variant[:-1] and not is_held else None

    def _given(self) -> dict[str, Any]:
        """Return the first obstacles, as many as the variant says, as a Sample or a Pose where they are."""
        kind = Sample if self.workload.variant.startswith("sample") else Pose
        count = int(self.workload.variant.removeprefix("sample").removeprefix("pose"))
        bodies = self.workload.obstacles[:count]
        return {body.name: kind.at(body.placement[:3, 3], body.placement[:3, :3]) for body in bodies}

    def configuration(self, q: Array) -> Array:
        """Return it as it is."""
        return q

    def targets(self, poses: Array) -> Any:
        """Return poses as samples by the names of their frames; nothing if they are held."""
        if self._is_held:
            return None
        return {name: Sample.at(pose[:3, 3], pose[:3, :3]) for name, pose in zip(self._names, poses, strict=True)}

    def step(self, q: Array, targets: Any) -> Array:
        """Compute the velocity of a control step."""
        if self._obstacles is None:
            return self.controller.step(q, targets=targets).v
        self._steps += 1
        return self.controller.step(q, self._steps * self.workload.dt, targets, self._obstacles).v

    def problem(self, tick: int) -> Any:
        """Return the `Problem` of a control step."""
        targets = self.targets(self.workload.targets[tick])
        return self.controller.tick(self.workload.q[tick], None, targets, self._obstacles).problem

    def velocity(self, v: Array) -> Array:
        """As it is."""
        return v

    def frames(self, q: Array) -> Array:
        """Return the poses of the frames by Pinocchio on this scene's model."""
        return np.asarray(reference(self.scene, self.workload, q[None])[0][0])

    def distances(self, q: Array) -> Array:
        """Return the distances by coal on this scene's geometry."""
        return np.asarray(reference(self.scene, self.workload, q[None])[1][0])
