"""Generator of goals that cannot be reached."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.model.robot import Robot
from qpavoid_bench.arena.families.arms import position_task, scenario_fields, straight_path
from qpavoid_bench.arena.families.parameters import Draw
from qpavoid_bench.arena.families.reach import arm
from qpavoid_bench.arena.families.statics import fixed_obstacle, sideways_path
from qpavoid_bench.arena.families.tool_path import path_motion

_REST_TIME = 8.0
"""Time to come to rest after the planned motion [s]."""


def unreachable(draw: Draw, robot: Robot) -> dict[str, Any]:
    """Put the goal inside a ball, or beyond the length of the arm with a ball on the path.

    It is `deep` of the ball's radius inside, or `beyond` all links in a row.
    """
    arm_of_tool, path, q = sideways_path(draw, robot)
    radius = arm_of_tool.length * draw("radius")
    goal, fraction, excess, depth = path.goal, draw("share"), draw("beyond"), draw("deep")
    if draw("kind") == "inside":
        ball = goal + (1.0 - depth) * radius * path.direction  # its nearest point is on this side: a place to rest
    else:
        root, length = arm(robot, robot.frame_id(arm_of_tool.tool, "tool"))
        direction = goal - root
        goal = root + (length + excess) * direction / np.linalg.norm(direction)
        ball = path.start + fraction * (goal - path.start)
    path = straight_path(path.start, goal, draw("speed"))
    obstacle = fixed_obstacle("ball", {"type": "sphere", "radius": radius}, ball)
    return scenario_fields(robot, q, [position_task(arm_of_tool.tool, path_motion(path))], [obstacle], _REST_TIME)
