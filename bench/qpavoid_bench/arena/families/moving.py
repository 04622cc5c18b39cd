"""Generators of obstacles that cross, meet or follow a tool's path, or move at random."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from qpavoid.model.robot import Robot
from qpavoid.problem import Array
from qpavoid_bench.arena.families import tool_path
from qpavoid_bench.arena.families.arms import REST_TIME, Arm, position_task, scenario_fields
from qpavoid_bench.arena.families.parameters import Draw
from qpavoid_bench.arena.families.statics import sideways_path
from qpavoid_bench.arena.families.tool_path import ToolPath, path_motion, waypoint_motion

MotionGenerator = Callable[[Draw, Arm, ToolPath], dict[str, Any]]
"""Function from draws, the arm and the path of its tool to the motion block of an obstacle."""


def movers(motion: MotionGenerator, draw: Draw, robot: Robot) -> dict[str, Any]:
    """Put a tool's path among `count` obstacles with motions of one kind, each of some `shape` and `radius`."""
    arm, path, q = sideways_path(draw, robot)
    obstacles = [
        {"name": f"mover{i}", "shape": draw_shape(draw), "motion": motion(draw, arm, path)}
        for i in range(draw("count"))
    ]
    return scenario_fields(robot, q, [position_task(arm.tool, path_motion(path))], obstacles)


def draw_shape(draw: Draw) -> dict[str, Any]:
    """Draw a ball, or a capsule, cylinder, cube or plate of about its size."""
    radius = draw("radius")
    match draw("shape"):
        case "capsule":
            return {"type": "capsule", "radius": radius, "length": 2.0 * radius}
        case "cylinder":
            return {"type": "cylinder", "radius": radius, "length": 2.0 * radius}
        case "box":
            return {"type": "box", "size": [1.6 * radius] * 3}
        case "plate":
            return {"type": "box", "size": [4.0 * radius, 4.0 * radius, 0.1 * radius]}
        case _:
            return {"type": "sphere", "radius": radius}


def _crossing(draw: Draw, arm: Arm, path: ToolPath) -> dict[str, Any]:
    """Cross the tool's path at some `share` of its time and `direction`, and miss the tool by `aside`."""
    direction = np.array(draw("direction"))
    return tool_path.crossing(path, draw("share"), direction, _offset(draw, arm), draw("obstacle_speed"))


def _head_on(draw: Draw, arm: Arm, path: ToolPath) -> dict[str, Any]:
    """Come along the tool's path from `away` beyond its goal, `aside` of it."""
    return tool_path.head_on(path, arm.length * draw("away"), _offset(draw, arm), draw("obstacle_speed"))


def _chasing(draw: Draw, arm: Arm, path: ToolPath) -> dict[str, Any]:
    """Come along the tool's path from `away` behind its start, `aside` of it."""
    return tool_path.chasing(path, arm.length * draw("away"), _offset(draw, arm), draw("obstacle_speed"))


def wander(draw: Draw, arm: Arm, path: ToolPath) -> dict[str, Any]:
    """Wander about the tool's path, `aside` of it, for the whole run."""
    points, times = [_random_point(draw, arm, path)], [0.0]
    while times[-1] < path.end + REST_TIME:
        points.append(_random_point(draw, arm, path))
        length = float(np.linalg.norm(points[-1] - points[-2]))
        times.append(times[-1] + max(length / draw("obstacle_speed"), 0.1))
    return waypoint_motion(points, times, "constant")


MOTIONS: dict[str, MotionGenerator] = {"crossing": _crossing, "head_on": _head_on, "chasing": _chasing}
"""Motions across or along a tool's path, by name."""


def _offset(draw: Draw, arm: Arm) -> Array:
    return np.asarray(arm.length * draw("aside") * np.array(draw("direction")))


def _random_point(draw: Draw, arm: Arm, path: ToolPath) -> Array:
    return path.point(draw("along")) + _offset(draw, arm)
