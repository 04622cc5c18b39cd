"""Bodies of a scene in a Pinocchio collision model, for the libraries that are built on its Python package."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import coal
import numpy as np
import pinocchio as pin


def add_bodies(geometry: Any, setup: SimpleNamespace, joint_of: dict[str, int]) -> None:
    """Add bodies and pairs to a collision model; obstacles are bodies that no joint moves.

    Args:
        geometry: the model.
        setup: of the scene.
        joint_of: number of the joint that moves a link.
    """
    for name, link, kind, size, placement, _ in setup.bodies:
        geometry.addGeometryObject(pin.GeometryObject(name, joint_of[link], pin.SE3(placement), _shape(kind, size)))
    for a, b in setup.pairs.tolist():
        geometry.addCollisionPair(pin.CollisionPair(a, b))


def _shape(kind: str, size: Any) -> Any:
    """Return a coal shape by its name and the arguments of its constructor; a hull is given by its points (n, 3)."""
    if kind != "Convex":
        return getattr(coal, kind)(*size)
    points = coal.StdVec_Vec3s()
    points.extend(list(np.asarray(size)))
    return coal.ConvexBase.convexHull(points, True, "Qt")
