"""What generators need of a robot: its arms, and postures with the tools at given places."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from qpavoid.arena.families.parameters import Redraw
from qpavoid.arena.families.reach import Ranges, Want, configuration_at
from qpavoid.arena.families.ways import Way
from qpavoid.errors import ConfigError
from qpavoid.model.robot import Robot
from qpavoid.problem import Array
from qpavoid.safety.reachability import arm

REST = 3.0
"""Time from the end of the planned motion to that of the run [s]."""
_PRECISE = 1e-4
"""How far a tool may be from where it was put [m]."""
_MAX_SPEED = 0.5
"""Cap on the speed that tasks command [m/s]."""


class Arm(NamedTuple):
    """A tool and the joints that move it and no other tool."""

    tool: str
    """Its frame."""
    home: Array
    """(3,) where the tool is at home [m]."""
    length: float
    """Of the links between the first of these joints and the tool, in a row [m]."""

    def at(self, forward: float, left: float, up: float) -> Array:
        """(3,) a place given from the tool's home, in arm lengths along the world axes x, y, z [m]."""
        return self.home + self.length * np.array([forward, left, up])


def arms(robot: Robot) -> list[Arm]:
    """The arms of a robot, those at the left first. A tool that moves only with others has none.

    Raises:
        ConfigError: there is none.
    """
    model, data = robot.model, robot.model.createData()
    pin.framesForwardKinematics(model, data, robot.home)
    frames = {tool: robot.frame_id(tool, "end_effectors") for tool in robot.end_effectors}
    chains = {tool: list(model.supports[model.frames[frame].parentJoint]) for tool, frame in frames.items()}
    found = []
    for tool, chain in chains.items():
        others = {joint for other, joints in chains.items() if other != tool for joint in joints}
        own = [place for place, joint in enumerate(chain) if joint > 0 and joint not in others]
        if own:
            length = arm(robot, frames[tool], own[0])[1]
            found.append(Arm(tool, np.array(data.oMf[frames[tool]].translation), length))
    if not found:
        raise ConfigError(f"{robot.name} has no tool that moves; give `end_effectors` in its robot.yaml")
    return sorted(found, key=lambda one: -one.home[1])


def posture(robot: Robot, places: Mapping[str, ArrayLike], near: Array | None = None) -> Array:
    """A configuration (nv,) with tools at some places (3,) [m], as near to another one, or home, as a search gets.

    Raises:
        Redraw: the search found none.
    """
    wants = [Want(robot.frame_id(tool, "tool"), np.asarray(place, dtype=float)) for tool, place in places.items()]
    q = configuration_at(robot, wants, robot.home if near is None else near, Ranges.of(robot), _PRECISE)
    if q is None:
        raise Redraw("no posture has the tools where the run begins")
    return q


def named(robot: Robot, q: Array) -> dict[str, float]:
    """A configuration (nv,) as `q0` has it: joint: value."""
    return dict(zip(robot.joint_names, q.tolist(), strict=True))


def follow(tool: str, motion: Mapping[str, Any]) -> dict[str, Any]:
    """A task: a tool's position follows a motion."""
    return {"frame": tool, "type": "position", "motion": dict(motion), "max_speed": _MAX_SPEED}


def set_out(start: Array, goal: Array, speed: float, begin: float = 0.5) -> Way:
    """The straight way of a tool at a mean speed [m/s]."""
    return Way(start, goal, begin, begin + max(float(np.linalg.norm(goal - start)), 0.01) / speed)


def run(
    robot: Robot, q: Array, tasks: list[dict[str, Any]], obstacles: list[dict[str, Any]], rest: float = REST
) -> dict[str, Any]:
    """Fields of a scenario that begins at q (nv,) and ends some time [s] after its tasks' waypoints."""
    end = max(task["motion"]["times"][-1] for task in tasks)
    return {"q0": named(robot, q), "tasks": tasks, "obstacles": obstacles, "duration": round(end + rest, 1)}
