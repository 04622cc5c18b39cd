"""Volume of what a triangle mesh encloses."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_fill_holes

from qpavoid.problem import Array

_CELLS = 40
"""Along the longest side of the grid that stands for an open mesh."""
_POINTS = 60_000
"""Samples of its surface: some ten for each cell that it passes through."""
_SAME = 1e-6
"""Distance between corners, as a share of the size, below which they are one [-]."""


def solid_volume(surface: Array) -> float:
    """Volume of the inside of a mesh [m³].

    Of a closed surface, that of the divergence theorem. Of any other, the cells of a grid that its surface passes
    through (half of their volume) or that cannot be reached from outside: to some 5 %.

    Args:
        surface: (t, 3, 3) corners of the triangles [m].
    """
    if not len(surface):
        return 0.0
    origin = surface[0, 0]
    size = float(np.ptp(surface.reshape(-1, 3), axis=0).max())
    if size == 0.0:
        return 0.0
    if _is_closed(surface, _SAME * size):
        a, b, c = np.moveaxis(surface - origin, 1, 0)
        return abs(float(np.einsum("ti,ti->", a, np.cross(b, c)))) / 6.0
    return _filled(surface, size)


def _is_closed(surface: Array, same: float) -> bool:
    """Whether every edge of a triangle is passed by another triangle in the other direction."""
    corners = np.unique(np.round(surface.reshape(-1, 3) / same), axis=0, return_inverse=True)[1].reshape(-1, 3)
    edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    edges = edges[edges[:, 0] != edges[:, 1]]
    count = int(corners.max()) + 1
    there, back = np.sort(edges @ [count, 1]), np.sort(edges @ [1, count])
    return bool(np.array_equal(there, back))


def _filled(surface: Array, size: float) -> float:
    cell = size / _CELLS
    points = _on_surface(surface)
    index = np.floor((points - points.min(axis=0)) / cell).astype(np.intp) + 1
    grid = np.zeros(index.max(axis=0) + 2, dtype=bool)
    grid[tuple(index.T)] = True
    return float((binary_fill_holes(grid).sum() - 0.5 * grid.sum()) * cell**3)


def _on_surface(surface: Array) -> Array:
    """Points (n, 3) spread evenly over triangles, and their corners."""
    random = np.random.default_rng(0)
    area = np.linalg.norm(np.cross(surface[:, 1] - surface[:, 0], surface[:, 2] - surface[:, 0]), axis=1)
    chosen = surface[random.choice(len(surface), _POINTS, p=area / area.sum())] if area.sum() > 0.0 else surface
    weights = random.dirichlet(np.ones(3), len(chosen))
    return np.concatenate((np.einsum("nk,nki->ni", weights, chosen), surface.reshape(-1, 3)))
