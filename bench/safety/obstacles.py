"""Random obstacles: shapes, and motions across the path of the robot."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from qpavoid.problem import Array
from qpavoid_bench.arena.families import tool_path
from qpavoid_bench.arena.families.tool_path import ToolPath, line_motion

if TYPE_CHECKING:
    from bench.safety.campaign import Ranges


def draw_obstacle(
    random: np.random.Generator, name: str, moving: bool, way: ToolPath, bodies: Array, ranges: Ranges
) -> dict[str, Any]:
    """Return an obstacle as in a scenario file; whether its place is free at the start is not checked.

    Args:
        random: generator.
        name: its name.
        moving: whether it moves.
        way: path of a tool.
        bodies: (b, 3) likely positions of parts of the robot [m].
        ranges: sizes and speeds.
    """
    if moving:
        motion = MOTIONS[random.integers(len(MOTIONS))](random, way, bodies, ranges)
        if motion["type"] == "line" and random.random() < ranges.tumbling_fraction:
            motion = _tumbling(random, motion, ranges)
    else:
        motion = {"type": "fixed", "position": _beside(random, way, bodies).tolist(), "rpy": _rpy(random)}
    return {"name": name, "shape": _shape(random, ranges), "motion": motion}


def _shape(random: np.random.Generator, ranges: Ranges) -> dict[str, Any]:
    radius, sides = random.uniform(*ranges.radius), random.uniform(*ranges.length, size=3)
    match random.integers(5):
        case 0:
            return {"type": "sphere", "radius": radius}
        case 1:
            return {"type": "capsule", "radius": radius, "length": sides[0]}
        case 2:
            return {"type": "cylinder", "radius": radius, "length": sides[0]}
        case 3:
            return {"type": "box", "size": sides.tolist()}
        case _:
            return {"type": "box", "size": [sides[0], sides[1], random.uniform(*ranges.thickness)]}


def _beside(random: np.random.Generator, way: ToolPath, bodies: Array) -> Array:
    """Return a point (3,) near the tool's path, two times in three, else near the robot [m]."""
    near_way = random.random() < 2.0 / 3.0
    point = way.point(random.uniform(-0.1, 1.1)) if near_way else bodies[random.integers(len(bodies))]
    return np.asarray(point + random.uniform(0.0, 0.35) * _direction(random))


def _crossing(random: np.random.Generator, way: ToolPath, bodies: Array, ranges: Ranges) -> dict[str, Any]:
    """Return a line through the tool's path, at the time when the tool is there."""
    speed, fraction, direction = random.uniform(*ranges.obstacle_speed), random.uniform(0.2, 1.0), _direction(random)
    return tool_path.crossing(way, fraction, direction, random.uniform(0.0, 0.05) * _direction(random), speed)


def _at_the_arm(random: np.random.Generator, way: ToolPath, bodies: Array, ranges: Ranges) -> dict[str, Any]:
    """Return a line through a part of the robot."""
    speed, direction = random.uniform(*ranges.obstacle_speed), _direction(random)
    point = bodies[random.integers(len(bodies))] + random.uniform(0.0, 0.1) * _direction(random)
    return line_motion(point - random.uniform(0.3, 1.0) * direction, point + tool_path.OVERSHOOT * direction, speed)


def _head_on(random: np.random.Generator, way: ToolPath, bodies: Array, ranges: Ranges) -> dict[str, Any]:
    """Return a line along the tool's path, towards it."""
    offset = random.uniform(0.0, 0.03) * _direction(random)
    return tool_path.head_on(way, random.uniform(0.2, 0.6), offset, random.uniform(*ranges.obstacle_speed))


def _chasing(random: np.random.Generator, way: ToolPath, bodies: Array, ranges: Ranges) -> dict[str, Any]:
    """Return a line along the tool's path from behind, and on past the goal."""
    offset = random.uniform(0.0, 0.03) * _direction(random)
    return tool_path.chasing(way, random.uniform(0.2, 0.6), offset, random.uniform(*ranges.obstacle_speed))


def _circling(random: np.random.Generator, way: ToolPath, bodies: Array, ranges: Ranges) -> dict[str, Any]:
    """Return a circle near the tool's path or the robot."""
    radius = random.uniform(0.05, 0.3)
    return {
        "type": "circle",
        "center": _beside(random, way, bodies).tolist(),
        "radius": radius,
        "normal": _direction(random).tolist(),
        "start_direction": _direction(random).tolist(),
        "period": 2.0 * np.pi * radius / random.uniform(*ranges.obstacle_speed),
        "rpy": _rpy(random),
    }


MOTIONS = (_crossing, _at_the_arm, _head_on, _chasing, _circling)
"""Motions, all equally likely."""


def _tumbling(random: np.random.Generator, line: dict[str, Any], ranges: Ranges) -> dict[str, Any]:
    """Return the same line, turning from one orientation to another."""
    time = float(np.linalg.norm(np.subtract(line["end"], line["start"]))) / line["speed"]
    yaw = random.uniform(-1.0, 1.0) * min(ranges.turn_rate * time, np.pi)
    first = _rpy(random)
    return {
        "type": "waypoints",
        "times": [0.0, time],
        "positions": [line["start"], line["end"]],
        "rpys": [first, [first[0], first[1], first[2] + yaw]],
    }


def _direction(random: np.random.Generator) -> Array:
    vector = random.normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector))


def _rpy(random: np.random.Generator) -> list[float]:
    return [random.uniform(-np.pi, np.pi), random.uniform(-0.5 * np.pi, 0.5 * np.pi), random.uniform(-np.pi, np.pi)]
