"""A workload as plain data: what every library is given, whatever it is built on. Needs numpy only.

Units are m, rad and s; poses are 4x4 matrices in world axes; configurations and velocities follow Pinocchio's
conventions (a free joint has x y z qx qy qz qw, and its velocity is in its own axes).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Joint:
    """One joint; the list is sorted so that parents come first, and number 0 is the world."""

    name: str
    parent: int
    kind: str
    """world, free, hinge or slide."""
    axis: tuple[float, float, float]
    placement: Array
    """(4, 4) in the parent joint."""
    q_index: int
    v_index: int
    lower: float
    upper: float
    velocity: float
    """Largest speed; infinite where there is none."""


@dataclass(frozen=True)
class Body:
    """A capsule (radius, length between the caps), sphere (radius) or box (full sides)."""

    name: str
    joint: int
    shape: str
    size: tuple[float, ...]
    placement: Array
    """(4, 4) in the joint."""


@dataclass(frozen=True)
class Frame:
    """A frame with a pose task."""

    name: str
    joint: int
    placement: Array
    """(4, 4) in the joint."""


@dataclass(frozen=True)
class Workload:
    """Geometry, pairs, joints, trajectory and targets of one measurement."""

    name: str
    robot: str
    influence: float
    """Distance below which a pair is constrained [m]."""
    d_min: float
    """Distance that is held [m]."""
    dt: float
    """Control period [s]."""
    nv: int
    joints: tuple[Joint, ...]
    bodies: tuple[Body, ...]
    """The robot's, then the obstacles."""
    obstacles: int
    pairs: Array
    """(m, 2) indices of bodies."""
    disabled_pairs: tuple[tuple[str, str], ...]
    """Pairs of neighbouring bodies that are left out."""
    frames: tuple[Frame, ...]
    q: Array
    """(T, nq) recorded configurations, one a tick."""
    targets: Array
    """(T, f, 4, 4) where each frame should be one period later."""
    variant: str = ""
    """Of qpavoid alone: `held` (no targets are given), `sampleN` or `poseN` (so many obstacles are, at every step)."""

    @property
    def boxes(self) -> Any:
        """(m,) whether a pair needs an iterative algorithm: it has a box in it."""
        box = np.array([body.shape == "box" for body in self.bodies])
        return box[self.pairs].any(axis=1)


def pose(rotation: Array, translation: Array) -> Array:
    """(4, 4) of a rotation and a translation."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return matrix
