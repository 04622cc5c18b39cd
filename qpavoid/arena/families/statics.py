"""Generators of scenes that rest: spheres, shelf, box, opening in a wall, gap."""

from __future__ import annotations

from typing import Any

import coal
import numpy as np

from qpavoid.arena.families.arms import Arm, arms, follow, posture, run, set_out
from qpavoid.arena.families.parameters import Draw
from qpavoid.arena.families.room import bodies_at, gap
from qpavoid.arena.families.ways import Way, along
from qpavoid.problem import Array
from qpavoid.robot import Robot

ROOM = 0.03
"""Distance from the robot, at start and goal, at which single obstacles are put [m]."""
_TRIES = 20
"""Places that are tried for each of them; without room in any, it is left out."""
_BOARD = 0.02
"""Thickness of boards and walls [m]."""


def sweep(draw: Draw, robot: Robot) -> tuple[Arm, Way, Array]:
    """One tool's way from one side of its home to the other, and the configuration (nv,) at its start.

    Draws `side`, and of start and goal each `forward`, `sideways` and `up`, in arm lengths from the tool's home; and
    `speed`.
    """
    one = arms(robot)[0]
    side = draw("side")
    start, goal = (one.at(draw("forward"), sign * draw("sideways"), draw("up")) for sign in (side, -side))
    return one, set_out(start, goal, draw("speed")), posture(robot, {one.tool: start})


def sphere_field(draw: Draw, robot: Robot) -> dict[str, Any]:
    """Balls around the way of a tool: `count` of them, of some `radius`, `along` it and `aside` of it."""
    one, way, q = sweep(draw, robot)
    there = posture(robot, {one.tool: way.goal}, q)
    taken = [(shape, place) for at in (q, there) for _, shape, place in bodies_at(robot, at)]
    obstacles = []
    for i in range(draw("count")):
        for _ in range(_TRIES):
            radius, aside = draw("radius"), one.length * draw("aside") * np.array(draw("direction"))
            center = way.point(draw("along")) + aside
            if gap(coal.Sphere(radius), coal.Transform3s(np.eye(3), center), taken) > ROOM:
                obstacles.append(_fixed(f"ball{i}", {"type": "sphere", "radius": radius}, center))
                break
    return _reach(robot, one, way, q, obstacles)


def shelf(draw: Draw, robot: Robot) -> dict[str, Any]:
    """From one compartment of a shelf to the one above or below it."""
    one, up = arms(robot)[0], draw("up")
    front, depth, width, height = draw.vector("front", "depth", "width", "height")
    corner = np.array([front, one.home[1] + draw("aside"), draw("middle")])
    inside = [np.array([draw("inside"), draw("left"), level]) for level in (-0.5 * up * height, 0.5 * up * height)]
    inside[0][0] = draw("start")
    back = 0.5 * depth
    obstacles = [
        _board(f"board{i}", corner + [back, 0.0, (i - 1) * height], [depth, width, _BOARD]) for i in range(3)
    ]
    for name, sign in (("left", 1.0), ("right", -1.0)):
        obstacles.append(_board(name, corner + [back, 0.5 * sign * width, 0.0], [depth, _BOARD, 2.0 * height]))
    obstacles.append(_board("back", corner + [depth, 0.0, 0.0], [_BOARD, width, 2.0 * height]))
    return _go(draw, robot, one, corner + inside[0], corner + inside[1], obstacles)


def box(draw: Draw, robot: Robot) -> dict[str, Any]:
    """From beside a box without a lid down into it."""
    one, side = arms(robot)[0], draw("side")
    length, width, height = draw.vector("length", "width", "height")
    center = np.array([draw("ahead"), one.home[1] + draw("left"), draw("rim")])  # of the opening
    start = center + [draw("shift"), side * (0.5 * width + draw("beside")), draw("start_height")]
    goal = center + [draw("shift"), draw("shift"), -draw("deep")]
    obstacles = [_board("bottom", center - [0.0, 0.0, height], [length, width, _BOARD])]
    for name, sign in (("front", -1.0), ("back", 1.0)):
        obstacles.append(_board(name, center + [0.5 * sign * length, 0.0, -0.5 * height], [_BOARD, width, height]))
    for name, sign in (("left", 1.0), ("right", -1.0)):
        obstacles.append(_board(name, center + [0.0, 0.5 * sign * width, -0.5 * height], [length, _BOARD, height]))
    return _go(draw, robot, one, start, goal, obstacles)


def opening(draw: Draw, robot: Robot) -> dict[str, Any]:
    """Through a wall with an opening in it, a window or a doorway, from beside it on this side to behind it."""
    one, side = arms(robot)[0], draw("side")
    width, height, wall = draw.vector("width", "height", "wall")
    center = one.home + draw.vector("ahead", "left", "up")
    obstacles = [
        _board("left", center + [0.0, 0.5 * (width + wall), 0.0], [_BOARD, wall, height + 2.0 * wall]),
        _board("right", center - [0.0, 0.5 * (width + wall), 0.0], [_BOARD, wall, height + 2.0 * wall]),
        _board("above", center + [0.0, 0.0, 0.5 * (height + wall)], [_BOARD, width, wall]),
    ]
    if draw("kind") == "window":
        obstacles.append(_board("below", center - [0.0, 0.0, 0.5 * (height + wall)], [_BOARD, width, wall]))
    start = center + [-draw("before"), side * (0.5 * width + draw("beside")), draw("shift")]
    return _go(draw, robot, one, start, center + [draw("behind"), draw("shift"), draw("shift")], obstacles)


def gap_between_blocks(draw: Draw, robot: Robot) -> dict[str, Any]:
    """Between two blocks that stand side by side, to a place behind them."""
    one, side = arms(robot)[0], draw("side")
    width, thick, block = draw.vector("width", "thick", "block")
    center = one.home + draw.vector("ahead", "left", "up")
    obstacles = [
        _board(name, center + [0.0, 0.5 * sign * (width + block), 0.0], [thick, block, 2.0 * block])
        for name, sign in (("left", 1.0), ("right", -1.0))
    ]
    start = center + [-0.5 * thick - draw("before"), side * (0.5 * width + draw("beside")), draw("shift")]
    return _go(draw, robot, one, start, center + [0.5 * thick + draw("behind"), draw("shift"), draw("shift")], obstacles)


def _go(
    draw: Draw, robot: Robot, one: Arm, start: Array, goal: Array, obstacles: list[dict[str, Any]]
) -> dict[str, Any]:
    return _reach(robot, one, set_out(start, goal, draw("speed")), posture(robot, {one.tool: start}), obstacles)


def _reach(robot: Robot, one: Arm, way: Way, q: Array, obstacles: list[dict[str, Any]]) -> dict[str, Any]:
    return run(robot, q, [follow(one.tool, along(way))], obstacles)


def _board(name: str, center: Array, size: list[float]) -> dict[str, Any]:
    return _fixed(name, {"type": "box", "size": size}, center)


def _fixed(name: str, shape: dict[str, Any], position: Array) -> dict[str, Any]:
    return {"name": name, "shape": shape, "motion": {"type": "fixed", "position": position}}
