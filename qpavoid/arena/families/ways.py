"""The ways of tools and of what crosses them: plain geometry, and how a scenario file words it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from qpavoid.problem import Array

BEYOND = 1.5
"""How far obstacles go on past what they came for [m]."""


class Way(NamedTuple):
    """The straight line that a tool is meant to follow."""

    start: Array
    """(3,) [m]."""
    goal: Array
    """(3,) [m]."""
    begin: float
    """When it sets out [s]."""
    end: float
    """When it is there [s]."""

    def point(self, share: float) -> Array:
        """(3,) where it is at that share of its time, at constant speed [m]."""
        return self.start + share * (self.goal - self.start)

    def time(self, share: float) -> float:
        """When that is [s]."""
        return self.begin + share * (self.end - self.begin)

    @property
    def direction(self) -> Array:
        """(3,) unit vector."""
        along = self.goal - self.start
        return np.asarray(along / max(float(np.linalg.norm(along)), 1e-9))


def crossing(way: Way, share: float, direction: Array, aside: Array, speed: float) -> dict[str, Any]:
    """A line through a way, at the time when the tool is there.

    Args:
        way: of the tool.
        share: of the tool's time, when they meet [-].
        direction: of the obstacle (3,).
        aside: by how much it misses the tool (3,) [m].
        speed: of the obstacle [m/s].
    """
    point = way.point(share) + aside
    return line(point - speed * way.time(share) * direction, point + BEYOND * direction, speed)


def head_on(way: Way, ahead: float, aside: Array, speed: float) -> dict[str, Any]:
    """Along a way against the tool's direction, from `ahead` [m] beyond its goal, (3,) aside."""
    start = way.goal + ahead * way.direction + aside
    return line(start, way.start - BEYOND * way.direction + aside, speed)


def chasing(way: Way, behind: float, aside: Array, speed: float) -> dict[str, Any]:
    """Along a way in the tool's direction, from `behind` [m] its start, and on past the goal, (3,) aside."""
    start = way.start - behind * way.direction + aside
    return line(start, way.goal + BEYOND * way.direction + aside, speed)


def line(start: Array, end: Array, speed: float) -> dict[str, Any]:
    """A motion block: straight on at constant speed [m/s]."""
    return {"type": "line", "start": start.tolist(), "end": end.tolist(), "speed": speed}


def along(way: Way) -> dict[str, Any]:
    """A motion block: a tool's way, from rest to rest."""
    return timed([way.start, way.goal], [way.begin, way.end])


def timed(points: Sequence[Array], times: Sequence[float], profile: str = "smooth") -> dict[str, Any]:
    """A motion block: points (3,) [m] at their times [s]."""
    return {"type": "waypoints", "times": list(times), "positions": [p.tolist() for p in points], "profile": profile}
