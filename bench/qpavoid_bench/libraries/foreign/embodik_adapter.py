"""embodik 0.23: solve_position_step with pose tasks and a collision constraint: its example 02_collision_aware_IK.

The solver has the runtime policy of the examples and 5 collision rows, of the 3 to 5 that the documentation recommends.
"""

from __future__ import annotations

import os
import tempfile
from types import SimpleNamespace
from typing import Any

import embodik
import numpy as np
from base import Adapter, urdf_with_bodies


class Library(Adapter):
    """Obstacles are links that are fixed to the world: it has no interface for them, so that they cannot move."""

    def __init__(self, setup: SimpleNamespace) -> None:
        """Set embodik up."""
        super().__init__(setup)
        if setup.floating and len(setup.bodies) > setup.robot_bodies:
            raise ValueError("obstacles are links of its robot, which moves")
        self.robot = _load(urdf_with_bodies(setup, range(len(setup.bodies))), bool(setup.floating))
        self.use_indices(
            self.robot.neutral_configuration(), self.robot.get_joint_config_index, self.robot.get_joint_velocity_index
        )
        self.solver = solver = embodik.KinematicsSolver(self.robot)
        solver.dt = setup.dt
        policy = solver.runtime_config()
        policy.enable_auto_task_layout = policy.weighted_fallback_enabled = True
        solver.configure_runtime(policy)
        self._tasks = []
        for name, _, _, position, orientation in setup.frames:
            kinds = {(True, True): "FRAME_POSE", (True, False): "FRAME_POSITION", (False, True): "FRAME_ORIENTATION"}
            kind = getattr(embodik.TaskType, kinds[bool(position), bool(orientation)])
            task = solver.add_frame_task(name, name, kind)
            task.priority, task.weight, task.solve_mode = 0, 1.0, embodik.TaskSolveMode.SCALE
            task.allow_min_error_fallback = False
            self._tasks.append(task)
        if len(setup.pairs):
            pairs = [(f"body_{a}_0", f"body_{b}_0") for a, b in setup.pairs.tolist()]
            known = {frozenset(pair) for pair in self.robot.get_collision_pair_names()}
            pairs = [pair for pair in pairs if frozenset(pair) in known]  # two bodies at rest are none of its pairs
            solver.configure_collision_constraint(setup.d1, pairs, max_constraints=setup.options["max_constraints"])
        self._options = embodik.PositionStepOptions()
        self._options.position_gain = self._options.orientation_gain = 1.0 / setup.dt  # the whole error in one step
        self._by_velocity = setup.options["call"] == "solve_velocity"
        for task in self._tasks if self._by_velocity else ():
            task.weight = 1.0 / setup.dt

    def targets(self, poses: Any) -> Any:
        """Return task targets; their gains close the whole error in one step."""
        if self._by_velocity:
            return [(np.array(pose[:3, 3]), np.asfortranarray(pose[:3, :3])) for pose in poses]
        out = []
        for frame, pose in zip(self.setup.frames, poses, strict=True):
            target = embodik.TaskTarget()
            target.task_name, target.target_pose = frame[0], np.asfortranarray(pose)
            target.position_gain = target.orientation_gain = 1.0 / self.setup.dt
            out.append(target)
        return out

    def step(self, q: Any, targets: Any) -> Any:
        """Apply what it returns, whatever its status is, as its examples do."""
        if self._by_velocity:
            for task, (position, rotation) in zip(self._tasks, targets, strict=True):
                task.set_target_pose(position, rotation)
            return self.solver.solve_velocity(q).joint_velocities
        answer = self.solver.solve_position_step(q, targets, self._options)
        return self.robot.difference(q, answer.q_solution) / self.setup.dt

    def frames(self, q: Any) -> Any:
        """Return the poses of its frames."""
        self.robot.update_configuration(q)
        return np.array([self.robot.get_frame_pose(frame[0]).homogeneous() for frame in self.setup.frames])

    def distances(self, q: Any) -> Any:
        """Return its distances, of the pairs that it has."""
        self.robot.update_configuration(q)
        names, distances = self.robot.get_collision_pair_names(), self.robot.compute_collision_distances()
        by_pair = {frozenset(pair): distance for pair, distance in zip(names, distances, strict=True)}
        pairs = (frozenset((f"body_{a}_0", f"body_{b}_0")) for a, b in self.setup.pairs.tolist())
        return np.array([by_pair.get(pair, np.nan) for pair in pairs])


def _load(urdf: str, floating: bool) -> Any:
    """Load a URDF, which it reads from a file only."""
    file, path = tempfile.mkstemp(suffix=".urdf")
    with os.fdopen(file, "w") as stream:
        stream.write(urdf)
    try:
        return embodik.RobotModel(path, floating)
    finally:
        os.remove(path)
