"""A generator of goals that cannot be reached."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.arena.families.arms import follow, run, set_out
from qpavoid.arena.families.parameters import Draw
from qpavoid.arena.families.statics import fixed, sweep
from qpavoid.arena.families.ways import along
from qpavoid.model.robot import Robot
from qpavoid.safety.reachability import arm

_REST = 8.0
"""Time to come to rest in, after the planned motion [s]."""


def unreachable(draw: Draw, robot: Robot) -> dict[str, Any]:
    """A goal inside a ball, as `deep` as a share of its radius, or `beyond` all links in a row, a ball on the way."""
    one, way, q = sweep(draw, robot)
    radius = one.length * draw("radius")
    goal, share, beyond, deep = way.goal, draw("share"), draw("beyond"), draw("deep")
    if draw("kind") == "inside":
        ball = goal + (1.0 - deep) * radius * way.direction  # its nearest point is on this side: a place to rest
    else:
        root, length = arm(robot, robot.frame_id(one.tool, "tool"))
        towards = goal - root
        goal = root + (length + beyond) * towards / np.linalg.norm(towards)
        ball = way.start + share * (goal - way.start)
    way = set_out(way.start, goal, draw("speed"))
    obstacle = fixed("ball", {"type": "sphere", "radius": radius}, ball)
    return run(robot, q, [follow(one.tool, along(way))], [obstacle], _REST)
