"""Closed loops: a controller drives the hands to the poses that they have at a problem's goal.

They are run and checked as cases of the arena: velocities are followed exactly, and MuJoCo looks for contacts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from qpavoid.config import Avoidance, Fixed, ObstacleConfig, ScenarioConfig, Task
from qpavoid.problem import Array
from qpavoid.run.mujoco import build
from qpavoid_bench.arena.case import Case, Sensor
from qpavoid_bench.arena.checker import check_run
from qpavoid_bench.arena.entrants import Entrant, find_entrant, solver_entrant
from qpavoid_bench.arena.rollout import roll_out
from qpavoid_bench.arena.world import World, build_world
from qpavoid_bench.grasps.clearance import REQUIRED
from qpavoid_bench.grasps.problems import Problem

DURATION = 12.0
"""Time within which the goals are to be reached [s]."""
MAX_DISTANCE, MAX_ANGLE = 0.005, float(np.radians(2.0))
"""Distance [m] and angle [rad] from its goal at which a hand has reached it."""
ENTRANTS = (
    find_entrant("qp"),
    solver_entrant("qp-planning", "qp with forecasts and plans", "qp", planning={"settle": DURATION}),
)
"""What is compared: the law alone, and with planning."""


@dataclass(frozen=True)
class GraspRun:
    """What became of one problem in closed loop."""

    is_reached: bool
    """Whether all hands are at their goals at the end."""
    is_clear: bool
    """Whether no pair touched, at any time."""
    distance: float
    """From its goal at the end, of the farthest hand [m]."""
    angle: float
    """The same [rad]."""
    time: float
    """After which all hands stay at their goals [s]; NaN where one is not there at the end."""
    clearance: float
    """Least distance of all pairs that a joint moves, by the checker [m]."""
    excess: float
    """Largest excess of velocities and positions over the limits of the joints, negative within [rad/s, rad, …]."""
    failure: str
    """What a step raised first; empty where none did."""

    @property
    def is_success(self) -> bool:
        """Return whether all goals are reached without contact."""
        return self.is_reached and self.is_clear and not self.failure


def to_case(problem: Problem) -> Case:
    """Return a problem as a case of the arena: each hand has the pose of its goal as its target from the start on."""
    goals = [
        Task(
            frame=frame,
            type="pose",
            motion=Fixed(position=_triple(pose.position), rpy=_triple(pin.rpy.matrixToRpy(np.asarray(pose.rotation)))),
        )
        for frame, pose in problem.goal_poses.items()
    ]
    obstacles = [
        ObstacleConfig(
            name=obstacle.name,
            shape=obstacle.shape,
            motion=Fixed(
                position=_triple(obstacle.motion.sample(0.0).position),
                rpy=_triple(pin.rpy.matrixToRpy(obstacle.motion.sample(0.0).rotation)),
            ),
        )
        for obstacle in problem.obstacles
    ]
    scenario = ScenarioConfig(
        robot=problem.robot_name,
        q0=problem.q_start.tolist(),
        duration=DURATION,
        tasks=[*goals],
        obstacles=obstacles,
        avoidance=Avoidance(d1=REQUIRED),
    )
    return Case(problem.family, problem.index, scenario, Sensor(), True, "a goal configuration of the set")


def run_grasp(problem: Problem, entrant: Entrant) -> GraspRun:
    """Run a problem in closed loop, and check it.

    Args:
        problem: robot, obstacles, start, and the configuration whose poses are the goal.
        entrant: who drives.
    """
    case = to_case(problem)
    world = build_world(case.scenario)
    rollout = roll_out(case, entrant.start(case, world), world)
    findings = check_run(build(world.scene, world.q0), rollout.t, rollout.v, case.scenario.limits)
    distances, angles = _errors(world, rollout.q)
    is_there = (distances <= MAX_DISTANCE) & (angles <= MAX_ANGLE)
    late = np.flatnonzero(~is_there)
    first = 0 if not len(late) else int(late[-1]) + 1
    return GraspRun(
        is_reached=bool(is_there[-1]),
        is_clear=not findings.contacts,
        distance=float(distances[-1]),
        angle=float(angles[-1]),
        time=float(rollout.t[first]) if is_there[-1] else np.nan,
        clearance=findings.distance,
        excess=max(findings.speed_excess, findings.position_excess),
        failure=rollout.failure,
    )


def _errors(world: World, q: Array) -> tuple[Array, Array]:
    """Return the largest distances [m], and the largest angles [rad], of the hands from their goals (N,)."""
    model, goals = world.scene.robot.model, [(task.frame_id, task.motion.sample(0.0)) for task in world.tools]
    data, distances, angles = model.createData(), np.zeros(len(q)), np.zeros(len(q))
    for k, row in enumerate(q):
        pin.framesForwardKinematics(model, data, row)
        for frame, goal in goals:
            place = data.oMf[frame]
            distances[k] = max(distances[k], float(np.linalg.norm(place.translation - goal.position)))
            angles[k] = max(angles[k], float(np.linalg.norm(pin.log3(place.rotation.T @ goal.rotation))))
    return distances, angles


def _triple(x: Array) -> tuple[float, float, float]:
    return (float(x[0]), float(x[1]), float(x[2]))
