"""placo, in a Python process of its own: run as a file, by an interpreter that has placo, pin, coal and numpy.

Speaks through a connection, whose file descriptor is its argument: each request is the name of a method of `Robot` and
its argument, each answer what that returns, or what it raised, and how long it took. Knows nothing of qpavoid, which
that interpreter need not have.
"""

from __future__ import annotations

import pickle
import sys
from multiprocessing.connection import Connection
from time import perf_counter
from typing import Any

import coal
import numpy as np
import pinocchio as pin
import placo


class Robot:
    """placo's solver, set up for one case; all poses are (4, 4)."""

    def __init__(self, setup: dict[str, Any]) -> None:
        self.robot = placo.RobotWrapper("", 0, setup["urdf"])
        model, self._dt = self.robot.model, setup["dt"]
        joints = [0, *(model.getJointId(name) for name in setup["joints"])]  # placo's own base is not among them
        self._q_index = np.array([model.joints[joint].idx_q for joint in joints[1:]])
        self._v_index = np.array([model.joints[joint].idx_v for joint in joints[1:]])
        self._add_bodies(setup, joints)
        self.solver = placo.KinematicsSolver(self.robot)
        self.solver.dt = self._dt
        self.solver.mask_fbase(True)
        self.solver.enable_joint_limits(True)
        self.solver.enable_velocity_limits(True)
        self.solver.add_regularization_task(setup["regularization"])
        self._frames = [f"frame {number}" for number in range(len(setup["tasks"]))]
        self._tasks = [self._task(name, *task) for name, task in zip(self._frames, setup["tasks"], strict=True)]
        if setup["pairs"]:
            avoid = self.solver.add_avoid_self_collisions_constraint()
            avoid.configure("avoid", setup["priority"], 1.0)
            avoid.self_collisions_margin, avoid.self_collisions_trigger = setup["margin"], setup["trigger"]

    def _task(self, frame: str, moves: bool, turns: bool, weight: float, orientation_weight: float) -> Any:
        """Add a frame task; return a setter of its target pose."""
        if moves and turns:
            task = self.solver.add_frame_task(frame, np.eye(4))
            task.configure(frame, "soft", weight, orientation_weight)
            return lambda pose: setattr(task, "T_world_frame", pose)
        if moves:
            task = self.solver.add_position_task(frame, np.zeros(3))
            task.configure(frame, "soft", weight)
            return lambda pose: setattr(task, "target_world", pose[:3, 3])
        task = self.solver.add_orientation_task(frame, np.eye(3))
        task.configure(frame, "soft", orientation_weight)
        return lambda pose: setattr(task, "R_world_frame", pose[:3, :3])

    def _add_bodies(self, setup: dict[str, Any], joints: list[int]) -> None:
        """Add obstacles as bodies of the collision model that no joint moves.

        placo has no interface for obstacles.
        """
        geometry = self.robot.collision_model
        for number, (joint, kind, sizes, placement) in enumerate(setup["bodies"]):
            body = pin.GeometryObject(f"body {number}", joints[joint], pin.SE3(placement), shape(kind, sizes))
            geometry.addGeometryObject(body)
        for a, b in setup["pairs"]:
            geometry.addCollisionPair(pin.CollisionPair(a, b))
        self._pairs = setup["pairs"]

    def place(self, state: dict[str, Any]) -> Any:
        """Put the robot to `q` (nv,) and bodies to their poses; return the frames (f, 4, 4)."""
        bodies = self.robot.collision_model.geometryObjects
        for number, placement in state["bodies"].items():
            bodies[number].placement = pin.SE3(placement)
        q = self.robot.state.q.copy()
        q[self._q_index] = state["q"]
        self.robot.state.q = q
        self.robot.update_kinematics()
        return np.array([self.robot.get_T_world_frame(frame) for frame in self._frames])

    def solve(self, poses: Any) -> Any:
        """Compute the velocity (nv,) towards poses (f, 4, 4) of the frames."""
        for set_pose, pose in zip(self._tasks, poses, strict=True):
            set_pose(pose)
        return np.asarray(self.solver.solve(False))[self._v_index] / self._dt

    def distances(self, _: None) -> Any:
        """Return the distances (k,) of the pairs by placo [m]."""
        distances_by_pair = {(near.objA, near.objB): near.min_distance for near in self.robot.distances()}
        return np.array([distances_by_pair[a, b] for a, b in self._pairs])


def shape(kind: str, sizes: Any) -> Any:
    """Return a coal shape by its name and the arguments of its constructor.

    A hull is given by its points (n, 3).
    """
    if kind != "Convex":
        return getattr(coal, kind)(*sizes)
    points = coal.StdVec_Vec3s()
    points.extend(list(np.asarray(sizes)))
    return coal.ConvexBase.convexHull(points, True, "Qt")


def main() -> None:
    """Answer requests until the other end is closed."""
    connection, robot = Connection(int(sys.argv[1])), None
    while True:
        try:
            command, argument = pickle.loads(connection.recv_bytes())
        except EOFError:
            return
        begin = perf_counter()
        try:
            if command == "setup":
                robot, answer = Robot(argument), None
            else:
                answer = getattr(robot, command)(argument)
            message = ""
        except Exception as error:  # whatever placo raises is an answer
            answer, message = None, f"{type(error).__name__}: {error}"
        connection.send_bytes(pickle.dumps((answer, message, perf_counter() - begin), protocol=4))


if __name__ == "__main__":
    main()
