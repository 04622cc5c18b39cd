"""Generators for two arms at once: crossing, and meeting to pass something on."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.errors import ConfigError
from qpavoid.model.robot import Robot
from qpavoid.problem import Array
from qpavoid_bench.arena.families.arms import Arm, arms, position_task, posture, scenario_fields
from qpavoid_bench.arena.families.parameters import Draw
from qpavoid_bench.arena.families.tool_path import waypoint_motion

_START_TIME = 0.5
"""Time at which the tools start to move [s]."""


def crossing_arms(draw: Draw, robot: Robot) -> dict[str, Any]:
    """Move each tool straight to about where the other one started, in the same time."""
    left, right = _two_arms(robot)
    paths = [[start, goal] for start, goal in _start_and_goals(draw, left, right)]
    return _synchronized_scenario(draw, robot, (left, right), paths, 0.0)


def passing(draw: Draw, robot: Robot) -> dict[str, Any]:
    """Let the tools meet in the middle, as if to pass something on, and change sides."""
    left, right = _two_arms(robot)
    middle = 0.5 * (left.home + right.home) + left.length * draw.vector("forward", "lean", "up")
    half = 0.5 * draw("between") * np.array([0.0, 1.0, 0.0])
    ends = zip(_start_and_goals(draw, left, right), (half, -half), strict=True)
    paths = [[start, middle + offset, goal] for (start, goal), offset in ends]
    return _synchronized_scenario(draw, robot, (left, right), paths, draw("pause"))


def _two_arms(robot: Robot) -> tuple[Arm, Arm]:
    arm_count = arms(robot)
    if len(arm_count) != 2:
        raise ConfigError(f"{robot.name} has {len(arm_count)} arms that move; two are needed")
    return arm_count[0], arm_count[1]


def _start_and_goals(draw: Draw, left: Arm, right: Arm) -> list[tuple[Array, Array]]:
    """Draw start and goal of the left tool, then of the right.

    At the goals, one tool is `over` the other.
    """
    middle, height = 0.5 * (left.home + right.home), 0.5 * draw("above") * draw("over")

    def place(side: float, extra_height: float) -> Array:
        offset = [draw("forward"), side * draw("sideways"), draw("up") + extra_height]
        return np.asarray(middle + left.length * np.array(offset))

    return [(place(1.0, 0.0), place(-1.0, height)), (place(-1.0, 0.0), place(1.0, -height))]


def _synchronized_scenario(
    draw: Draw, robot: Robot, pair: tuple[Arm, Arm], paths: list[list[Array]], pause: float
) -> dict[str, Any]:
    """Move both tools along their paths, corner by corner at the same time.

    The longer segment sets the duration.
    """
    speed, times, points = draw("speed"), [_START_TIME], [[path[0]] for path in paths]
    for corner in range(1, len(paths[0])):
        length = max(float(np.linalg.norm(path[corner] - path[corner - 1])) for path in paths)
        times.append(times[-1] + length / speed)
        for corners, path in zip(points, paths, strict=True):
            corners.append(path[corner])
        if pause and corner < len(paths[0]) - 1:
            times.append(times[-1] + pause)
            for corners, path in zip(points, paths, strict=True):
                corners.append(path[corner])
    q = posture(robot, {arm.tool: path[0] for arm, path in zip(pair, paths, strict=True)})
    return scenario_fields(
        robot,
        q,
        [position_task(arm.tool, waypoint_motion(corners, times)) for arm, corners in zip(pair, points, strict=True)],
        [],
    )
