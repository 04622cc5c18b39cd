"""Small boxes and cylinders around points."""

from __future__ import annotations

from typing import Any

import coal
import numpy as np
import pinocchio as pin

from qpavoid.geometry.capsules import enclosing_circles, rotations_to
from qpavoid.problem import Array

_MARGIN = 1e-10
"""Against rounding, so that the points on the surface count as inside [m]."""


def fit_box(points: Array) -> tuple[Any, Any]:
    """Fit a small box that encloses points (n, 3) [m], along the axes of their frame or their principal ones.

    Returns:
        coal geometry and its placement.
    """
    rotations = [np.eye(3), _principal_axes(points)]
    boxes = [(R, (points @ R).min(axis=0), (points @ R).max(axis=0)) for R in rotations]
    R, low, high = min(boxes, key=lambda box: float(np.prod(box[2] - box[1])))
    return coal.Box(*(high - low + _MARGIN)), pin.SE3(R, R @ (0.5 * (low + high)))


def fit_cylinder(points: Array) -> tuple[Any, Any]:
    """Fit a small cylinder that encloses points (n, 3) [m], about an axis of their frame or a principal one.

    Returns:
        coal geometry and its placement.
    """
    rotations = rotations_to(np.concatenate((np.eye(3), _principal_axes(points).T)))
    local = points @ rotations
    centers, radii = enclosing_circles(local[..., :2])
    low, high = local[..., 2].min(axis=1), local[..., 2].max(axis=1)
    best = int(np.argmin(radii**2 * (high - low)))
    center = np.array([*centers[best], 0.5 * (low + high)[best]])
    length = float(high[best] - low[best]) + _MARGIN
    return coal.Cylinder(float(radii[best]) + _MARGIN, length), pin.SE3(rotations[best], rotations[best] @ center)


def _principal_axes(points: Array) -> Array:
    """Return the principal axes of points (n, 3) as the columns of a rotation (3, 3)."""
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2].T
    if axes.shape != (3, 3):
        return np.eye(3)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    return np.asarray(axes)
