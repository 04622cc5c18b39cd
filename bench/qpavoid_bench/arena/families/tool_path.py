"""Straight paths of tools and of the obstacles that cross them, and their motion blocks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from qpavoid.problem import Array

OVERSHOOT = 1.5
"""Distance that obstacles travel past the tool's path [m]."""


class ToolPath(NamedTuple):
    """Straight line that a tool is to follow."""

    start: Array
    """(3,) [m]."""
    goal: Array
    """(3,) [m]."""
    begin: float
    """Time at the start [s]."""
    end: float
    """Time at the goal [s]."""

    def point(self, fraction: float) -> Array:
        """Return the position (3,) at a fraction of the path's time, at constant speed [m]."""
        return self.start + fraction * (self.goal - self.start)

    def time(self, fraction: float) -> float:
        """Return the time at a fraction of the path [s]."""
        return self.begin + fraction * (self.end - self.begin)

    @property
    def direction(self) -> Array:
        """Return the unit vector (3,) from start to goal."""
        path_motion = self.goal - self.start
        return np.asarray(path_motion / max(float(np.linalg.norm(path_motion)), 1e-9))


def crossing(path: ToolPath, fraction: float, direction: Array, offset: Array, speed: float) -> dict[str, Any]:
    """Return a line motion that crosses the path at the time when the tool is there.

    Args:
        path: of the tool.
        fraction: of the tool's time, when they meet [-].
        direction: of the obstacle (3,).
        offset: by how much it misses the tool (3,) [m].
        speed: of the obstacle [m/s].
    """
    point = path.point(fraction) + offset
    return line_motion(point - speed * path.time(fraction) * direction, point + OVERSHOOT * direction, speed)


def head_on(path: ToolPath, distance_forward: float, offset: Array, speed: float) -> dict[str, Any]:
    """Return a line motion along the path against the tool's direction, from beyond its goal."""
    start = path.goal + distance_forward * path.direction + offset
    return line_motion(start, path.start - OVERSHOOT * path.direction + offset, speed)


def chasing(path: ToolPath, distance_behind: float, offset: Array, speed: float) -> dict[str, Any]:
    """Return a line motion along the path in the tool's direction, from behind its start."""
    start = path.start - distance_behind * path.direction + offset
    return line_motion(start, path.goal + OVERSHOOT * path.direction + offset, speed)


def line_motion(start: Array, end: Array, speed: float) -> dict[str, Any]:
    """Return a motion block: straight at constant speed [m/s]."""
    return {"type": "line", "start": start.tolist(), "end": end.tolist(), "speed": speed}


def path_motion(path: ToolPath) -> dict[str, Any]:
    """Return a motion block: a tool's path, from rest to rest."""
    return waypoint_motion([path.start, path.goal], [path.begin, path.end])


def waypoint_motion(points: Sequence[Array], times: Sequence[float], profile: str = "smooth") -> dict[str, Any]:
    """Return a motion block: points (3,) [m] at their times [s]."""
    return {"type": "waypoints", "times": list(times), "positions": [p.tolist() for p in points], "profile": profile}
