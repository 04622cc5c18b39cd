"""Generators for two arms at once: crossing, and meeting to pass something on."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.arena.families.arms import Arm, arms, follow, posture, run
from qpavoid.arena.families.parameters import Draw
from qpavoid.arena.families.ways import timed
from qpavoid.errors import ConfigError
from qpavoid.model.robot import Robot
from qpavoid.problem import Array

_BEGIN = 0.5
"""When the tools set out [s]."""


def crossing_arms(draw: Draw, robot: Robot) -> dict[str, Any]:
    """Each tool goes, straight, to about where the other one comes from, both in the same time."""
    left, right = _pair(robot)
    paths = [[start, goal] for start, goal in _ends(draw, left, right)]
    return _together(draw, robot, (left, right), paths, 0.0)


def passing(draw: Draw, robot: Robot) -> dict[str, Any]:
    """The tools meet in the middle, as if one gave something to the other, and go on to each other's side."""
    left, right = _pair(robot)
    middle = 0.5 * (left.home + right.home) + left.length * draw.vector("forward", "lean", "up")
    half = 0.5 * draw("between") * np.array([0.0, 1.0, 0.0])
    ends = zip(_ends(draw, left, right), (half, -half), strict=True)
    paths = [[start, middle + aside, goal] for (start, goal), aside in ends]
    return _together(draw, robot, (left, right), paths, draw("pause"))


def _pair(robot: Robot) -> tuple[Arm, Arm]:
    found = arms(robot)
    if len(found) != 2:
        raise ConfigError(f"{robot.name} has {len(found)} arms that move; two are needed")
    return found[0], found[1]


def _ends(draw: Draw, left: Arm, right: Arm) -> list[tuple[Array, Array]]:
    """Start and goal of the left tool, then of the right one; at the goals, one is `over` the other."""
    middle, over = 0.5 * (left.home + right.home), 0.5 * draw("above") * draw("over")

    def place(side: float, higher: float) -> Array:
        away = [draw("forward"), side * draw("sideways"), draw("up") + higher]
        return np.asarray(middle + left.length * np.array(away))

    return [(place(1.0, 0.0), place(-1.0, over)), (place(-1.0, 0.0), place(1.0, -over))]


def _together(
    draw: Draw, robot: Robot, pair: tuple[Arm, Arm], paths: list[list[Array]], pause: float
) -> dict[str, Any]:
    """Both tools along their paths, corner by corner at the same time; the farther one sets the pace."""
    speed, times, points = draw("speed"), [_BEGIN], [[path[0]] for path in paths]
    for corner in range(1, len(paths[0])):
        length = max(float(np.linalg.norm(path[corner] - path[corner - 1])) for path in paths)
        times.append(times[-1] + length / speed)
        for to, path in zip(points, paths, strict=True):
            to.append(path[corner])
        if pause and corner < len(paths[0]) - 1:
            times.append(times[-1] + pause)
            for to, path in zip(points, paths, strict=True):
                to.append(path[corner])
    q = posture(robot, {one.tool: path[0] for one, path in zip(pair, paths, strict=True)})
    return run(robot, q, [follow(one.tool, timed(to, times)) for one, to in zip(pair, points, strict=True)], [])
