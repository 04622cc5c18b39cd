"""A workload: what is played back to every library.

Units are m, rad and s; poses are 4x4 matrices; configurations and velocities follow Pinocchio's conventions (a floating
base has x y z qx qy qz qw, and its velocity is in its own axes; its coordinates come first).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Body:
    """An obstacle: a sphere (radius) or box (full sides)."""

    name: str
    shape: str
    size: tuple[float, ...]
    placement: Array
    """(4, 4)."""


@dataclass(frozen=True)
class Workload:
    """Geometry, pairs, joints, trajectory and targets of one measurement."""

    name: str
    robot: str
    influence: float
    """Distance below which a pair is constrained [m]."""
    d_min: float
    """Safety distance [m]."""
    dt: float
    """Control period [s]."""
    nv: int
    obstacles: tuple[Body, ...]
    pairs: NDArray[np.intp]
    """(m, 2) indices of bodies: the robot's, then the obstacles."""
    boxes: Any
    """(m,) whether a pair needs an iterative algorithm: it has a box in it."""
    disabled_pairs: tuple[tuple[str, str], ...]
    """Pairs of neighbouring bodies that are left out."""
    frames: tuple[str, ...]
    """Name of each frame with a pose task."""
    q: Array
    """(T, nq) recorded configurations, one a step."""
    targets: Array
    """(T, f, 4, 4) where each frame should be one period later."""
    variant: str = ""
    """Of qpavoid alone: `held` (no targets are given), `sampleN` or `poseN` (so many obstacles are, at every step)."""
