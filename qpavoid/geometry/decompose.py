"""Convex decomposition of triangle meshes: hulls of pieces that together enclose the surface, and enclose little else.

The mesh is cut along planes that follow its own faces where it has few distinct ones, as parts made of boards do, else
at even distances. Then pieces are put together again, two at a time, as long as the hull of both encloses little more
than both hulls do. Hulls only ever grow on the way, so that nothing of the surface is lost.

Tried instead of it, coacd does not promise that, and of a shelf of five boards it makes 16 pieces of 1.5 times their
volume in 49 s; this, the five boards in 0.02 s.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from qpavoid.geometry.meshes import cut, hull_corners, normals
from qpavoid.problem import Array, IntArray

CUTS = 8
"""Slabs along each axis, at most: their third power bounds the cells that are merged."""
_CLOSE = 1e-3
"""Share of a part's extent below which coordinates count as the same."""
_THIN = 1e-6
"""Thickness of what has no volume: a share of the size of the mesh."""
_CUBE = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])


def decompose(
    vertices: Array, triangles: IntArray, max_pieces: int, tolerance: float, slabs: int = CUTS
) -> list[Array]:
    """Cover a mesh with convex pieces whose union encloses every triangle of it.

    Args:
        vertices: (n, 3) [m].
        triangles: (t, 3) indices.
        max_pieces: most pieces; with few, they enclose more than the tolerance allows.
        tolerance: volume that a merge may add, all merges together, as a share of the volume of the mesh's hull.
        slabs: along each axis, at most.

    Returns:
        Corners (n_i, 3) of each piece.
    """
    size = float(np.ptp(vertices, axis=0).max())
    pieces = [
        np.unique(cell.reshape(-1, 3), axis=0)
        for part in _parts(vertices, triangles, 1e-9 * size)
        for cell in _cells(part, slabs)
    ]
    volume = partial(_volume, thin=_THIN * size)
    return _merge(pieces, volume, max_pieces, tolerance * volume(vertices))


def merge(pieces: list[Array], max_pieces: int) -> list[Array]:
    """Merge convex pieces (n_i, 3) until there are no more than so many, with the least volume that can be added."""
    size = float(np.ptp(np.concatenate(pieces), axis=0).max())
    return _merge(pieces, partial(_volume, thin=_THIN * size), max_pieces, 0.0)


def _volume(points: Array, thin: float) -> float:
    """Compute the volume of a hull [m³]; of what is flat, its area times next to nothing."""
    try:
        return float(ConvexHull(points).volume)
    except (QhullError, ValueError):
        thick = (points[:, None] + thin * _CUBE).reshape(-1, 3)
        return float(ConvexHull(thick, qhull_options="QJ").volume)


def _parts(vertices: Array, triangles: IntArray, weld_distance: float) -> list[Array]:
    """Split a mesh into the parts that touch no other: triangles (t, 3, 3) of each, which look outwards."""
    _, same = np.unique(np.round(vertices / weld_distance), axis=0, return_inverse=True)
    corners = same.ravel()[triangles]
    edges = np.concatenate((corners[:, :2], corners[:, 1:]))
    count = int(same.max()) + 1
    graph = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
    label = connected_components(graph, directed=False)[1][corners[:, 0]]
    parts = [vertices[triangles[label == part]] for part in np.unique(label)]
    volumes = [np.einsum("ij,ij->", part[:, 0] - part[0, 0], normals(part)) for part in parts]  # six times the signed
    return [part if volume >= 0.0 else part[:, ::-1] for part, volume in zip(parts, volumes, strict=True)]


def _cells(triangles: Array, count: int) -> list[Array]:
    """Cut the triangles (t, 3, 3) of a part along all three axes."""
    cells = [triangles]
    for axis in range(3):
        coordinates = np.sort(triangles[..., axis].ravel())
        close = _CLOSE * float(np.ptp(coordinates))
        slabs = []
        for cell in cells:
            remainder = cell
            for plane in _planes(coordinates, close, count):
                below, remainder = _split(remainder, axis, plane, close)
                slabs.append(below)
            slabs.append(remainder)
        cells = [slab for slab in slabs if len(slab)]
    return cells


def _planes(coordinates: Array, close: float, count: int) -> list[float]:
    """Choose the planes of the cuts along an axis: at the corners' own sorted coordinates where few, else evenly."""
    distinct = coordinates[np.diff(coordinates, prepend=-np.inf) > close].tolist()
    if len(distinct) > count + 1:
        distinct = np.linspace(coordinates[0], coordinates[-1], count + 1).tolist()
    return [float(x) for x in distinct if coordinates[0] + close < x < coordinates[-1] - close]


def _split(triangles: Array, axis: int, plane: float, close: float) -> tuple[Array, Array]:
    """Split triangles (t, 3, 3) at a plane, in which corners lie that are closer to it than `close`.

    What lies in the plane goes to the side where there is material: against its outward normal.
    """
    heights = triangles[..., axis] - plane
    heights[np.abs(heights) <= close] = 0.0
    flat, up = (heights == 0.0).all(axis=1), normals(triangles)[:, axis] > 0.0
    below, above = cut(triangles[~flat], heights[~flat])
    return np.concatenate((triangles[flat & up], below)), np.concatenate((triangles[flat & ~up], above))


def _merge(pieces: list[Array], volume: Callable[[Array], float], max_pieces: int, allowance: float) -> list[Array]:
    """Merge neighbours, the pair that adds least volume first."""
    parts = dict(enumerate(pieces))
    own = {i: volume(points) for i, points in parts.items()}
    cost: dict[tuple[int, int], float] = {}

    def consider(i: int, j: int, gap: float = 0.0) -> None:
        a, b = parts[i], parts[j]
        if np.all(a.min(axis=0) <= b.max(axis=0) + gap) and np.all(b.min(axis=0) <= a.max(axis=0) + gap):
            cost[i, j] = volume(np.concatenate((a, b))) - own[i] - own[j]

    for j in parts:
        for i in range(j):
            consider(i, j)
    added = 0.0
    while len(parts) > 1:
        if not cost:  # what is left lies apart
            if len(parts) <= max_pieces:
                break
            for i, j in ((i, j) for i in parts for j in parts if i < j):
                consider(i, j, np.inf)
        i, j = min(cost, key=lambda pair: cost[pair])
        if len(parts) <= max_pieces and added + max(cost[i, j], 0.0) > allowance:
            break
        added += max(cost[i, j], 0.0)
        new, points = max(parts) + 1, hull_corners(np.concatenate((parts.pop(i), parts.pop(j))))
        cost = {pair: price for pair, price in cost.items() if not {i, j} & set(pair)}
        parts[new], own[new] = points, volume(points)
        for neighbour in list(parts)[:-1]:
            consider(neighbour, new)
    return list(parts.values())
