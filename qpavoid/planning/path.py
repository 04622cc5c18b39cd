"""A path: configurations with times, and what is known of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from qpavoid.model.scene import Scene
from qpavoid.problem import Array
from qpavoid.reason import Reason


@dataclass(frozen=True)
class Path:
    """Straight motions between configurations that are clear all along; false where none was found."""

    q: Array
    """(k, nq) from the start to a goal; none (0, nq) where no path was found."""
    t: Array
    """(k,) times [s]: where obstacles move, those at which it is clear; otherwise, of the fastest motion along it."""
    coordinates: Array
    """(k, nv) angle or length of each joint; of continuous joints, whose q are cosine and sine, without jumps."""
    clearance: float
    """Distance beyond the safety distance that all pairs have all along [m]; pairs that begin nearer than that have
    what they begin with, less 1 mm. NaN where no path was found."""
    checks: int
    """Configurations that were checked."""
    nodes: int
    """Nodes of the search trees."""
    goals: int
    """Clear goal configurations that were tried in the last search."""
    reason: Reason | None
    """Why no path was found; None if one was."""

    def __bool__(self) -> bool:
        """Return whether a path was found."""
        return self.reason is None

    @property
    def duration(self) -> float:
        """Time at its end [s]."""
        return float(self.t[-1]) if len(self.t) else 0.0

    def at(self, t: float) -> Array:
        """Return the coordinates (nv,) at a time [s]; those of an end beyond it."""
        return np.array([np.interp(t, self.t, column) for column in self.coordinates.T])


def no_path(scene: Scene, reason: Reason, checks: int = 0, nodes: int = 0, goals: int = 0) -> Path:
    """Return no path of a scene, with its reason."""
    nq, nv = scene.robot.model.nq, scene.robot.model.nv
    return Path(np.zeros((0, nq)), np.zeros(0), np.zeros((0, nv)), np.nan, checks, nodes, goals, reason)
