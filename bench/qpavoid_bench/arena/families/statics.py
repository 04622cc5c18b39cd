"""Generators of static scenes: spheres, shelf, box, opening in a wall, gap, goals out of reach."""

from __future__ import annotations

from typing import Any

import coal
import numpy as np

from qpavoid.model.robot import Robot
from qpavoid.problem import Array
from qpavoid_bench.arena.families.arms import Arm, arms, position_task, posture, scenario_fields, straight_path
from qpavoid_bench.arena.families.free_space import min_distance, placed_bodies
from qpavoid_bench.arena.families.parameters import Draw
from qpavoid_bench.arena.families.reach import chain
from qpavoid_bench.arena.families.tool_path import ToolPath, path_motion

MIN_START_CLEARANCE = 0.03
"""Smallest distance of single obstacles from the robot at start and goal [m]."""
_TRIES = 20
"""Places that are tried for each obstacle; without a free one, it is left out."""
_BOARD = 0.02
"""Thickness of boards and walls [m]."""
_UNREACHABLE_REST_TIME = 8.0
"""Time to come to rest after the planned motion to a goal that cannot be reached [s]."""


def sideways_path(draw: Draw, robot: Robot) -> tuple[Arm, ToolPath, Array]:
    """Draw a tool's path from one side of its home to the other, and q (nv,) at its start.

    Draws `side`, and of start and goal each `forward`, `sideways` and `up`, in arm lengths from the tool's home, and
    `speed`.
    """
    arm = arms(robot)[0]
    side = draw("side")
    start, goal = (arm.place(draw("forward"), sign * draw("sideways"), draw("up")) for sign in (side, -side))
    return arm, straight_path(start, goal, draw("speed")), posture(robot, {arm.tool: start})


def sphere_field(draw: Draw, robot: Robot) -> dict[str, Any]:
    """Put `count` balls of some `radius` around a tool's path, `along` it and `aside` of it."""
    arm, path, q = sideways_path(draw, robot)
    goal_q = posture(robot, {arm.tool: path.goal}, q)
    occupied = [(shape, place) for place in (q, goal_q) for _, shape, place in placed_bodies(robot, place)]
    obstacles = []
    for i in range(draw("count")):
        for _ in range(_TRIES):
            radius, offset = draw("radius"), arm.length * draw("aside") * np.array(draw("direction"))
            center = path.point(draw("along")) + offset
            if min_distance(coal.Sphere(radius), coal.Transform3s(np.eye(3), center), occupied) > MIN_START_CLEARANCE:
                obstacles.append(_fixed_obstacle(f"ball{i}", {"type": "sphere", "radius": radius}, center))
                break
    return scenario_fields(robot, q, [position_task(arm.tool, path_motion(path))], obstacles)


def shelf(draw: Draw, robot: Robot) -> dict[str, Any]:
    """Move from one compartment of a shelf, or from in front of it, to the next one."""
    arm, upward = arms(robot)[0], draw("up")
    depth, width, height = draw.vector("depth", "width", "height")
    edge = np.array([draw("front"), arm.home[1] + draw("aside"), draw("middle")])  # of the board between both
    start = _offset(edge, draw("start"), draw("left"), -0.5 * upward * height)
    goal = _offset(edge, draw("inside"), draw("left"), 0.5 * upward * height)
    middle = _offset(edge, 0.5 * depth)
    obstacles = [_board(f"board{i}", _offset(middle, upward=(i - 1) * height), depth, width, _BOARD) for i in range(3)]
    for name, sign in _SIDES:
        obstacles.append(_board(name, _offset(middle, to_left=0.5 * sign * width), depth, _BOARD, 2.0 * height))
    obstacles.append(_board("back", _offset(edge, depth), _BOARD, width, 2.0 * height))
    return _scenario_through(draw, robot, arm, start, goal, obstacles)


def box(draw: Draw, robot: Robot) -> dict[str, Any]:
    """Move from beside a box without a lid down into it."""
    arm, side = arms(robot)[0], draw("side")
    length, width, height = draw.vector("length", "width", "height")
    rim = np.array([draw("ahead"), arm.home[1] + draw("left"), draw("rim")])
    start = _offset(rim, draw("shift"), side * (0.5 * width + draw("beside")), draw("start_height"))
    goal = _offset(rim, draw("shift"), draw("shift"), -draw("deep"))
    middle = _offset(rim, upward=-0.5 * height)
    obstacles = [_board("bottom", _offset(rim, upward=-height), length, width, _BOARD)]
    for name, sign in (("front", -1.0), ("back", 1.0)):
        obstacles.append(_board(name, _offset(middle, 0.5 * sign * length), _BOARD, width, height))
    for name, sign in _SIDES:
        obstacles.append(_board(name, _offset(middle, to_left=0.5 * sign * width), length, _BOARD, height))
    return _scenario_through(draw, robot, arm, start, goal, obstacles)


def opening(draw: Draw, robot: Robot) -> dict[str, Any]:
    """Move through an opening in a wall, a window or a doorway, from beside it to behind it."""
    arm, side = arms(robot)[0], draw("side")
    width, height, wall = draw.vector("width", "height", "wall")
    center = _offset(arm.home, draw("ahead"), draw("left"), draw("up"))
    obstacles = [
        _board(name, _offset(center, to_left=0.5 * sign * (width + wall)), _BOARD, wall, height + 2.0 * wall)
        for name, sign in _SIDES
    ]
    for name, sign in (("above", 1.0), ("below", -1.0))[: 2 if draw("kind") == "window" else 1]:
        obstacles.append(_board(name, _offset(center, upward=0.5 * sign * (height + wall)), _BOARD, width, wall))
    start = _offset(center, -draw("before"), side * (0.5 * width + draw("beside")), draw("shift"))
    goal = _offset(center, draw("behind"), draw("shift"), draw("shift"))
    return _scenario_through(draw, robot, arm, start, goal, obstacles)


def narrow_gap(draw: Draw, robot: Robot) -> dict[str, Any]:
    """Move between two blocks that stand side by side, to a place behind them."""
    arm, side = arms(robot)[0], draw("side")
    width, thickness, block = draw.vector("width", "thick", "block")
    center = _offset(arm.home, draw("ahead"), draw("left"), draw("up"))
    obstacles = [
        _board(name, _offset(center, to_left=0.5 * sign * (width + block)), thickness, block, 2.0 * block)
        for name, sign in _SIDES
    ]
    start = _offset(center, -0.5 * thickness - draw("before"), side * (0.5 * width + draw("beside")), draw("shift"))
    goal = _offset(center, 0.5 * thickness + draw("behind"), draw("shift"), draw("shift"))
    return _scenario_through(draw, robot, arm, start, goal, obstacles)


def unreachable(draw: Draw, robot: Robot) -> dict[str, Any]:
    """Put the goal inside a ball, or beyond the length of the arm with a ball on the path.

    It is `deep` of the ball's radius inside, or `beyond` all links in a row.
    """
    arm, path, q = sideways_path(draw, robot)
    radius = arm.length * draw("radius")
    goal, fraction, excess, depth = path.goal, draw("share"), draw("beyond"), draw("deep")
    if draw("kind") == "inside":
        ball = goal + (1.0 - depth) * radius * path.direction  # its nearest point is on this side: a place to rest
    else:
        root, length = chain(robot, robot.frame_id(arm.tool, "tool"))
        direction = goal - root
        goal = root + (length + excess) * direction / np.linalg.norm(direction)
        ball = path.start + fraction * (goal - path.start)
    path = straight_path(path.start, goal, draw("speed"))
    obstacle = _fixed_obstacle("ball", {"type": "sphere", "radius": radius}, ball)
    return scenario_fields(robot, q, [position_task(arm.tool, path_motion(path))], [obstacle], _UNREACHABLE_REST_TIME)


_SIDES = (("left", 1.0), ("right", -1.0))


def _offset(place: Array, forward: float = 0.0, to_left: float = 0.0, upward: float = 0.0) -> Array:
    """Return a place (3,) moved along the world axes [m]."""
    return np.asarray(place + np.array([forward, to_left, upward]))


def _scenario_through(
    draw: Draw, robot: Robot, arm: Arm, start: Array, goal: Array, obstacles: list[dict[str, Any]]
) -> dict[str, Any]:
    """Return the scenario of a straight path among obstacles."""
    path = straight_path(start, goal, draw("speed"))
    return scenario_fields(
        robot, posture(robot, {arm.tool: start}), [position_task(arm.tool, path_motion(path))], obstacles
    )


def _board(name: str, center: Array, length: float, width: float, height: float) -> dict[str, Any]:
    """Return an obstacle block of a box at rest."""
    return _fixed_obstacle(name, {"type": "box", "size": [length, width, height]}, center)


def _fixed_obstacle(name: str, shape: dict[str, Any], position: Array) -> dict[str, Any]:
    """Return an obstacle block at rest at a position (3,) [m]."""
    return {"name": name, "shape": shape, "motion": {"type": "fixed", "position": position}}
