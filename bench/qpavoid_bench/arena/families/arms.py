"""Arms of a robot, and postures with the tools at given places, for generators."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from qpavoid.errors import ConfigError
from qpavoid.model.robot import Robot
from qpavoid.problem import Array
from qpavoid_bench.arena.families.inverse_kinematics import FrameGoal, JointRanges, solve_inverse_kinematics
from qpavoid_bench.arena.families.parameters import Redraw
from qpavoid_bench.arena.families.reach import chain
from qpavoid_bench.arena.families.tool_path import ToolPath

REST_TIME = 3.0
"""Time from the end of the planned motion to that of the run [s]."""
_TOLERANCE = 1e-4
"""Largest distance of a tool from its place in a posture [m]."""
_MAX_SPEED = 0.5
"""Cap on the speed that tasks command [m/s]."""


class Arm(NamedTuple):
    """A tool and the joints that move it and no other tool."""

    tool: str
    """Name of the tool's frame."""
    home: Array
    """(3,) position of the tool at home [m]."""
    length: float
    """Length of the links between the first of these joints and the tool, in a row [m]."""

    def place(self, forward: float, to_left: float, upward: float) -> Array:
        """Return a place (3,) [m] given from the tool's home, in arm lengths along world x, y, z."""
        return self.home + self.length * np.array([forward, to_left, upward])


def arms(robot: Robot) -> list[Arm]:
    """Return the arms of a robot, left ones first.

    A tool that moves only with others has none.

    Raises:
        ConfigError: there is none.
    """
    model, data = robot.model, robot.model.createData()
    pin.framesForwardKinematics(model, data, robot.home)
    frames = {tool: robot.frame_id(tool, "end_effectors") for tool in robot.end_effectors}
    chains = {tool: list(model.supports[model.frames[frame].parentJoint]) for tool, frame in frames.items()}
    arm_count = []
    for tool, own in chains.items():
        shared = {joint for other, joints in chains.items() if other != tool for joint in joints}
        places = [place for place, joint in enumerate(own) if joint > 0 and joint not in shared]
        if places:
            length = chain(robot, frames[tool], places[0])[1]
            arm_count.append(Arm(tool, np.array(data.oMf[frames[tool]].translation), length))
    if not arm_count:
        raise ConfigError(f"{robot.name} has no tool that moves; give `end_effectors` in its robot.yaml")
    return sorted(arm_count, key=lambda one: -one.home[1])


def posture(robot: Robot, places: Mapping[str, ArrayLike], q_near: Array | None = None) -> Array:
    """Find a configuration (nv,) with tools at some places (3,) [m], near `q_near` or home.

    Raises:
        Redraw: the search found none.
    """
    goals = [FrameGoal(robot.frame_id(tool, "tool"), np.asarray(place, dtype=float)) for tool, place in places.items()]
    q = solve_inverse_kinematics(
        robot, goals, robot.home if q_near is None else q_near, JointRanges.of(robot), _TOLERANCE
    )
    if q is None:
        raise Redraw("no posture has the tools where the run begins")
    return q


def joint_values(robot: Robot, q: Array) -> dict[str, float]:
    """Return a configuration (nv,) as `q0` of a scenario has it: joint: value."""
    return dict(zip(robot.joint_names, q.tolist(), strict=True))


def position_task(tool: str, motion: Mapping[str, Any]) -> dict[str, Any]:
    """Return a task block: the position of a tool follows a motion."""
    return {"frame": tool, "type": "position", "motion": dict(motion), "max_speed": _MAX_SPEED}


def straight_path(start: Array, goal: Array, speed: float, begin: float = 0.5) -> ToolPath:
    """Return the straight path of a tool at a mean speed [m/s]."""
    return ToolPath(start, goal, begin, begin + max(float(np.linalg.norm(goal - start)), 0.01) / speed)


def scenario_fields(
    robot: Robot, q: Array, tasks: list[dict[str, Any]], obstacles: list[dict[str, Any]], rest_time: float = REST_TIME
) -> dict[str, Any]:
    """Return fields of a scenario that begins at q (nv,) and ends after its tasks' waypoints."""
    end = max(task["motion"]["times"][-1] for task in tasks)
    return {"q0": joint_values(robot, q), "tasks": tasks, "obstacles": obstacles, "duration": round(end + rest_time, 1)}
