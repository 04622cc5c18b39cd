"""Small capsules around points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from qpavoid.problem import Array

_MANY, _PROMISING = 200, 12
"""Number of points from which axes are preselected on extreme points, and number of axes selected."""
_WIDER = (1.0, 1.02, 1.05, 1.1, 1.2, 1.4)
"""Radii that are tried, in units of the smallest one that encloses the projected points."""


@dataclass(frozen=True, slots=True)
class CapsuleFit:
    """An enclosing capsule: axis along z of `rotation`, centred on `center`; length 0 is a sphere."""

    center: Array
    """(3,) [m]."""
    rotation: Array
    """(3, 3)."""
    radius: float
    """[m]."""
    length: float
    """Between the centres of the caps [m]."""

    @property
    def volume(self) -> float:
        """[m³]."""
        return float(np.pi * self.radius**2 * (self.length + 4.0 / 3.0 * self.radius))


def fit_capsule(points: Array, directions: int = 250) -> CapsuleFit:
    """Fit a small capsule that encloses all points.

    Tries the points' principal axes and a spiral of directions over the half sphere, all at once; for each, the axis
    runs through the centre of the smallest circle around the projected points, and the caps are drawn in as far as
    the points allow.

    Args:
        points: (n, 3) [m], at least one.
        directions: how many directions are tried.

    Returns:
        The fit of smallest volume; every point is inside.
    """
    points = np.unique(np.asarray(points, dtype=np.float64), axis=0)
    principal = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    rotations = rotations_to(np.concatenate((principal, half_sphere(directions))))
    if len(points) > _MANY:  # the outermost points tell which axes are worth trying with all of them
        best = np.argsort(_tried_along(extreme_points(points), rotations)[0].min(axis=0))
        rotations = rotations[best[:_PROMISING]]
    volume, fits, center = _tried_along(points, rotations)
    wider, axis = np.unravel_index(np.argmin(volume), volume.shape)
    radius, length, middle = fits[wider, axis]
    origin = rotations[axis] @ np.array([*center[axis], middle])
    margin = 1e-10  # against rounding, so that the points on the surface count as inside
    return CapsuleFit(origin, rotations[axis], float(radius) + margin, float(length))


def _tried_along(points: Array, rotations: Array) -> tuple[Array, Array, Array]:
    """Fit capsules along k axes, of w radii each: volumes (w, k), fits (w, k, 3) and the axes' centres (k, 2)."""
    local = points @ rotations
    center, narrowest = enclosing_circles(local[..., :2])
    off_axis = np.sum((local[..., :2] - center[:, None]) ** 2, axis=2)
    # wider than needed is worth it where it lets flat ends sink into the caps
    fits = np.stack([_fit_along(local[..., 2], off_axis, narrowest * wider) for wider in _WIDER])
    volume = np.pi * fits[..., 0] ** 2 * (fits[..., 1] + 4.0 / 3.0 * fits[..., 0])
    return volume, fits, center


def _fit_along(height: Array, off_axis: Array, radius: Array) -> Array:
    """Fit the shortest capsules of given radii (k,) along given axes: rows [radius, length, height of the middle].

    Each point, at a height (k, n) along an axis and a squared distance (k, n) from it, lets the caps' centres come no
    nearer to the far side than half its chord; where they would cross, a sphere about their middle encloses everything.
    """
    half_chord = np.sqrt(np.maximum(radius[:, None] ** 2 - off_axis, 0.0))
    low, high = np.min(height + half_chord, axis=1), np.max(height - half_chord, axis=1)
    return np.column_stack((radius, np.maximum(high - low, 0.0), 0.5 * (low + high)))


def extreme_points(points: Array) -> Array:
    """Return those of many points (n, 3) that lie farthest along 120 fixed directions."""
    return np.asarray(points[np.unique(np.argmax(_ROUND @ points.T, axis=1))])


def half_sphere(count: int) -> Array:
    """Return evenly spread unit vectors with z >= 0 (count, 3): a golden-angle spiral."""
    i = np.arange(count) + 0.5
    z, angle = i / count, np.pi * (1.0 + np.sqrt(5.0)) * i
    r = np.sqrt(1.0 - z * z)
    return np.column_stack((r * np.cos(angle), r * np.sin(angle), z))


_ROUND = np.concatenate([side * half_sphere(60) for side in (1.0, -1.0)])


def rotations_to(axes: Array) -> Array:
    """Return rotations (k, 3, 3) whose z columns are the unit vectors `axes` (k, 3)."""
    x = np.cross(np.eye(3)[np.argmin(np.abs(axes), axis=1)], axes)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack((x, np.cross(axes, x), axes), axis=2)


def enclosing_circles(points: Array) -> tuple[Array, Array]:
    """Find a nearly smallest circle around each set of 2-D points (k, n, 2): centres (k, 2) and radii (k,).

    Badoiu and Clarkson's iteration for the centre; the radius is then exact for that centre.
    """
    center = 0.5 * (points.min(axis=1) + points.max(axis=1))
    square, every = np.sum(points**2, axis=2), np.arange(len(points))
    for step in range(1, 60):
        # |p - c|² without |c|², which is the same for all points
        farthest = np.argmax(square - 2.0 * (points @ center[:, :, None])[..., 0], axis=1)
        center = center + (points[every, farthest] - center) / (step + 1)
    return center, np.sqrt(np.max(np.sum((points - center[:, None]) ** 2, axis=2), axis=1))
