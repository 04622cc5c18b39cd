"""A workload as plain data: what every library is given, whatever it is built on. Needs numpy only.

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
    """A capsule (radius, length between the caps), sphere (radius) or box (full sides)."""

    name: str
    link: str
    """Link of the URDF; `world` for an obstacle."""
    shape: str
    size: tuple[float, ...]
    placement: Array
    """(4, 4) in the link."""


@dataclass(frozen=True)
class Joint:
    """A hinge or slide."""

    name: str
    q_index: int
    v_index: int
    speed: float
    """Its limit; infinite where there is none."""


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
    urdf: str
    """Joints and frames, without geometry; each joint moves a link `link_JOINT`."""
    floating: str
    """Root link, which a floating base moves; empty without one."""
    joints: tuple[Joint, ...]
    bodies: tuple[Body, ...]
    """The robot's, then the obstacles."""
    obstacles: int
    pairs: NDArray[np.intp]
    """(m, 2) indices of bodies."""
    disabled_pairs: tuple[tuple[str, str], ...]
    """Pairs of neighbouring bodies that are left out."""
    frames: tuple[tuple[str, str, Array], ...]
    """Name, link and (4, 4) placement in it of each frame with a pose task."""
    q: Array
    """(T, nq) recorded configurations, one a step."""
    targets: Array
    """(T, f, 4, 4) where each frame should be one period later."""
    variant: str = ""
    """Of qpavoid alone: `held` (no targets are given), `sampleN` or `poseN` (so many obstacles are, at every step)."""

    @property
    def boxes(self) -> Any:
        """Return for each pair (m,) whether it needs an iterative algorithm: it has a box in it."""
        return np.array([body.shape == "box" for body in self.bodies])[self.pairs].any(axis=1)
