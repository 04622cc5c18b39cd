"""Another library as an entrant: a scene is described to its process, which then answers every control step."""

from __future__ import annotations

from collections.abc import Mapping
from time import perf_counter, process_time

import numpy as np
import pinocchio as pin

from qpavoid.control.tasks import FrameTask
from qpavoid.errors import ConfigError
from qpavoid.model.sample import Sample
from qpavoid.model.scene import Scene
from qpavoid.problem import Array, IntArray, Solution
from qpavoid_bench.arena.case import Case
from qpavoid_bench.arena.world import World
from qpavoid_bench.libraries import Library
from qpavoid_bench.libraries.process import STEP_TIMEOUT, LibraryError, Process
from qpavoid_bench.libraries.setup import describe

DAMPING = 0.05
"""λ of the damped inverse of every library that is given one [-]: its square is what it takes."""


class LibraryPilot:
    """A library in a process of its own."""

    seconds: float
    """Time that the last step took in that process, and for its targets here, without the transport [s]."""

    def __init__(self, library: Library, case: Case, world: World) -> None:
        """Start the process and set the library up in it.

        Raises:
            ConfigError: the case has something that it cannot be given, or there is no such environment.
        """
        scenario, self._world, self.timeout = case.scenario, world, STEP_TIMEOUT
        self.frame_tasks, self._dt = frame_tasks(case, world, library.name), scenario.dt
        self.pairs, avoidance = movable_pairs(world.scene), scenario.avoidance
        numbers = world.scene.obstacle_of
        self._bodies = {o.name: np.flatnonzero(numbers == i).tolist() for i, o in enumerate(world.scene.obstacles)}
        self._model, self._data = world.scene.robot.model, world.scene.robot.model.createData()
        self.process = Process(library.interpreter(), library.module)
        try:
            scene = describe(
                world.scene,
                world.q0,
                [(task.frame_id, *_weights(task)) for task in self.frame_tasks],
                self.pairs,
                scenario.dt,
                (avoidance.d1 - avoidance.offset, avoidance.d2 - avoidance.offset),
                world.scene.robot.bounds().within(scenario.limits),
                DAMPING**2,
                library.options,
            )
            self.process.ask("setup", scene)
        except (ValueError, LibraryError) as error:
            raise ConfigError(f"{scenario.source}: {library.name} cannot be set up: {error}") from error

    def step(self, q: Array, t: float, targets: Mapping[str, Sample], obstacles: Mapping[str, Sample]) -> Solution:
        """Compute the velocity for the next control period.

        Raises:
            LibraryError: it found none, or its process has ended; the robot is held then.
        """
        begin, computed = perf_counter(), process_time()
        pin.framesForwardKinematics(self._model, self._data, q)
        poses = [
            target_after_step(task, targets[task.settings.label], self._data.oMf[task.frame_id].homogeneous, self._dt)
            for task in self.frame_tasks
        ]
        moved = {
            number: pin.SE3(sample.rotation, sample.position).homogeneous
            for name, sample in obstacles.items()
            for number in self._bodies[name]
        }
        prepared = process_time() - computed
        try:
            v, solved = self.process.timed("step", q, np.array(poses), moved, timeout=self.timeout)
        except LibraryError:
            self.seconds = perf_counter() - begin
            raise
        self.seconds = prepared + solved
        return Solution(np.asarray(v))

    def observe(self, q: Array) -> tuple[Array, Array]:
        """Return the frames (f, 4, 4) and distances of `pairs` (k,) by the library, obstacles where they were last."""
        frames, distances = self.process.ask("observe", q)
        return np.asarray(frames), np.asarray(distances)


def frame_tasks(case: Case, world: World, library: str) -> list[FrameTask]:
    """Return the tasks of a case, all of which follow frames.

    Raises:
        ConfigError: the case has something that the library is not given.
    """
    unsupported = []
    tasks = [task for task in world.tasks if isinstance(task, FrameTask)]
    if len(tasks) < len(world.tasks):
        unsupported.append("tasks other than `position`, `pose` and `orientation`")
    if world.scene.clouds:
        unsupported.append("point clouds")
    if any(joint.nq != 1 or joint.nv != 1 for joint in list(world.scene.robot.model.joints)[1:]):
        unsupported.append("joints that are neither hinges nor slides; lock them")
    if unsupported:
        raise ConfigError(f"{case.scenario.source}: the adapter of {library} knows no {', no '.join(unsupported)}")
    return tasks


def movable_pairs(scene: Scene) -> IntArray:
    """Return pairs (k, 2) whose distance the robot can change.

    A row for any other pair could only make a QP infeasible.
    """
    return np.asarray(scene.pairs[np.any(scene.support != 0.0, axis=1)], dtype=np.intp)


def target_after_step(task: FrameTask, target: Sample, pose: Array, dt: float) -> Array:
    """Return the pose that a task asks of its frame after dt.

    These libraries close the whole error in every step, and know no velocity of a target; here a task asks for
    v_ref + K (x_ref - x), capped. A target that lies dt times that velocity from where the frame is makes both the
    same, with the library's gain left alone.

    Args:
        task: with its gain K and caps.
        target: what it follows.
        pose: pose of its frame (4, 4).
        dt: length of the step [s].

    Returns:
        Pose (4, 4); what of it does not count is as it is.
    """
    settings, there = task.settings, np.array(pose)
    if task.moves:
        linear = target.linear + settings.gain * (target.position - pose[:3, 3])
        there[:3, 3] += dt * _limit_norm(linear, settings.max_speed)
    if task.turns:
        angular = target.angular + settings.gain * pin.log3(target.rotation @ pose[:3, :3].T)
        there[:3, :3] = pin.exp3(dt * _limit_norm(angular, settings.max_turn_rate)) @ pose[:3, :3]
    return there


def _weights(task: FrameTask) -> tuple[float, float]:
    """Return the weights of a task's position and orientation; 0 for what does not count."""
    settings = task.settings
    return settings.weight if task.moves else 0.0, settings.orientation_weight if task.turns else 0.0


def _limit_norm(velocity: Array, cap: float | None) -> Array:
    """Scale a velocity down to a cap on its norm."""
    speed = float(np.linalg.norm(velocity))
    return velocity if cap is None or speed <= cap else velocity * (cap / speed)
