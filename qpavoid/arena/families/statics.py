"""Generators of scenes that rest: spheres, shelf, box, opening in a wall, gap."""

from __future__ import annotations

from typing import Any

import coal
import numpy as np

from qpavoid.arena.families.arms import Arm, arms, follow, posture, run, set_out
from qpavoid.arena.families.parameters import Draw
from qpavoid.arena.families.room import bodies_at, gap
from qpavoid.arena.families.ways import Way, along
from qpavoid.model.robot import Robot
from qpavoid.problem import Array

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
                obstacles.append(fixed(f"ball{i}", {"type": "sphere", "radius": radius}, center))
                break
    return run(robot, q, [follow(one.tool, along(way))], obstacles)


def shelf(draw: Draw, robot: Robot) -> dict[str, Any]:
    """From one compartment of a shelf, or from in front of it, into the one above or below."""
    one, up = arms(robot)[0], draw("up")
    depth, width, height = draw.vector("depth", "width", "height")
    edge = np.array([draw("front"), one.home[1] + draw("aside"), draw("middle")])  # of the board between both
    start = _off(edge, draw("start"), draw("left"), -0.5 * up * height)
    goal = _off(edge, draw("inside"), draw("left"), 0.5 * up * height)
    middle = _off(edge, 0.5 * depth)
    obstacles = [_board(f"board{i}", _off(middle, up=(i - 1) * height), depth, width, _BOARD) for i in range(3)]
    for name, sign in _SIDES:
        obstacles.append(_board(name, _off(middle, left=0.5 * sign * width), depth, _BOARD, 2.0 * height))
    obstacles.append(_board("back", _off(edge, depth), _BOARD, width, 2.0 * height))
    return _reach(draw, robot, one, start, goal, obstacles)


def box(draw: Draw, robot: Robot) -> dict[str, Any]:
    """From beside a box without a lid down into it."""
    one, side = arms(robot)[0], draw("side")
    length, width, height = draw.vector("length", "width", "height")
    rim = np.array([draw("ahead"), one.home[1] + draw("left"), draw("rim")])
    start = _off(rim, draw("shift"), side * (0.5 * width + draw("beside")), draw("start_height"))
    goal = _off(rim, draw("shift"), draw("shift"), -draw("deep"))
    middle = _off(rim, up=-0.5 * height)
    obstacles = [_board("bottom", _off(rim, up=-height), length, width, _BOARD)]
    for name, sign in (("front", -1.0), ("back", 1.0)):
        obstacles.append(_board(name, _off(middle, 0.5 * sign * length), _BOARD, width, height))
    for name, sign in _SIDES:
        obstacles.append(_board(name, _off(middle, left=0.5 * sign * width), length, _BOARD, height))
    return _reach(draw, robot, one, start, goal, obstacles)


def opening(draw: Draw, robot: Robot) -> dict[str, Any]:
    """Through a wall with an opening in it, a window or a doorway, from beside it on this side to behind it."""
    one, side = arms(robot)[0], draw("side")
    width, height, wall = draw.vector("width", "height", "wall")
    center = _off(one.home, draw("ahead"), draw("left"), draw("up"))
    obstacles = [
        _board(name, _off(center, left=0.5 * sign * (width + wall)), _BOARD, wall, height + 2.0 * wall)
        for name, sign in _SIDES
    ]
    for name, sign in (("above", 1.0), ("below", -1.0))[: 2 if draw("kind") == "window" else 1]:
        obstacles.append(_board(name, _off(center, up=0.5 * sign * (height + wall)), _BOARD, width, wall))
    start = _off(center, -draw("before"), side * (0.5 * width + draw("beside")), draw("shift"))
    goal = _off(center, draw("behind"), draw("shift"), draw("shift"))
    return _reach(draw, robot, one, start, goal, obstacles)


def narrow_gap(draw: Draw, robot: Robot) -> dict[str, Any]:
    """Between two blocks that stand side by side, to a place behind them."""
    one, side = arms(robot)[0], draw("side")
    width, thick, block = draw.vector("width", "thick", "block")
    center = _off(one.home, draw("ahead"), draw("left"), draw("up"))
    obstacles = [
        _board(name, _off(center, left=0.5 * sign * (width + block)), thick, block, 2.0 * block)
        for name, sign in _SIDES
    ]
    start = _off(center, -0.5 * thick - draw("before"), side * (0.5 * width + draw("beside")), draw("shift"))
    goal = _off(center, 0.5 * thick + draw("behind"), draw("shift"), draw("shift"))
    return _reach(draw, robot, one, start, goal, obstacles)


_SIDES = (("left", 1.0), ("right", -1.0))


def _off(place: Array, forward: float = 0.0, left: float = 0.0, up: float = 0.0) -> Array:
    """(3,) a place moved along the world axes [m]."""
    return np.asarray(place + np.array([forward, left, up]))


def _reach(
    draw: Draw, robot: Robot, one: Arm, start: Array, goal: Array, obstacles: list[dict[str, Any]]
) -> dict[str, Any]:
    way = set_out(start, goal, draw("speed"))
    return run(robot, posture(robot, {one.tool: start}), [follow(one.tool, along(way))], obstacles)


def _board(name: str, center: Array, length: float, width: float, height: float) -> dict[str, Any]:
    return fixed(name, {"type": "box", "size": [length, width, height]}, center)


def fixed(name: str, shape: dict[str, Any], position: Array) -> dict[str, Any]:
    """An obstacle that rests at a position (3,) [m]."""
    return {"name": name, "shape": shape, "motion": {"type": "fixed", "position": position}}
