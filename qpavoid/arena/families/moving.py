"""Generators of obstacles that move while a tool is on its way: across it, against it, behind it, at random."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from qpavoid.arena.families import ways
from qpavoid.arena.families.arms import REST, Arm, follow, run
from qpavoid.arena.families.parameters import Draw
from qpavoid.arena.families.statics import sweep
from qpavoid.arena.families.ways import Way, along, timed
from qpavoid.model.robot import Robot
from qpavoid.problem import Array

Motion = Callable[[Draw, Arm, Way], dict[str, Any]]


def crossing(draw: Draw, robot: Robot) -> dict[str, Any]:
    """Obstacles cross the tool's way, each at some `share` of its time and in some `direction`, `aside` of it."""
    return _among(draw, robot, _crossing)


def head_on(draw: Draw, robot: Robot) -> dict[str, Any]:
    """Obstacles come along the tool's way from `away` beyond its goal, `aside` of it."""
    return _among(draw, robot, _head_on)


def chasing(draw: Draw, robot: Robot) -> dict[str, Any]:
    """Obstacles come along the tool's way from `away` behind its start, `aside` of it."""
    return _among(draw, robot, _chasing)


def random_walk(draw: Draw, robot: Robot) -> dict[str, Any]:
    """Obstacles wander about the tool's way: straight from one place to the next, `aside` of it, for the whole run."""
    return _among(draw, robot, _random_walk)


def _among(draw: Draw, robot: Robot, motion: Motion) -> dict[str, Any]:
    """A tool's way among `count` obstacles, each of some `shape` and `radius`."""
    one, way, q = sweep(draw, robot)
    obstacles = [
        {"name": f"mover{i}", "shape": _shape(draw), "motion": motion(draw, one, way)} for i in range(draw("count"))
    ]
    return run(robot, q, [follow(one.tool, along(way))], obstacles)


def _shape(draw: Draw) -> dict[str, Any]:
    """A ball, or a capsule or cube of about its size."""
    radius = draw("radius")
    match draw("shape"):
        case "capsule":
            return {"type": "capsule", "radius": radius, "length": 2.0 * radius}
        case "box":
            return {"type": "box", "size": [1.6 * radius] * 3}
        case _:
            return {"type": "sphere", "radius": radius}


def _crossing(draw: Draw, one: Arm, way: Way) -> dict[str, Any]:
    direction = np.array(draw("direction"))
    return ways.crossing(way, draw("share"), direction, _aside(draw, one), draw("obstacle_speed"))


def _head_on(draw: Draw, one: Arm, way: Way) -> dict[str, Any]:
    return ways.head_on(way, one.length * draw("away"), _aside(draw, one), draw("obstacle_speed"))


def _chasing(draw: Draw, one: Arm, way: Way) -> dict[str, Any]:
    return ways.chasing(way, one.length * draw("away"), _aside(draw, one), draw("obstacle_speed"))


def _random_walk(draw: Draw, one: Arm, way: Way) -> dict[str, Any]:
    points, times = [_beside(draw, one, way)], [0.0]
    while times[-1] < way.end + REST:
        points.append(_beside(draw, one, way))
        length = float(np.linalg.norm(points[-1] - points[-2]))
        times.append(times[-1] + max(length / draw("obstacle_speed"), 0.1))
    return timed(points, times, "constant")


def _aside(draw: Draw, one: Arm) -> Array:
    return np.asarray(one.length * draw("aside") * np.array(draw("direction")))


def _beside(draw: Draw, one: Arm, way: Way) -> Array:
    return way.point(draw("along")) + _aside(draw, one)
