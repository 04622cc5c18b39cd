"""Convex decomposition of triangle meshes: hulls of pieces that together enclose the surface, and enclose little else.

The mesh is cut along planes that follow its own faces where it has few distinct ones, as parts made of boards do, else
at even distances. Then pieces are put together again, two at a time, as long as the hull of both encloses little more
than both hulls do. Hulls only ever grow on the way, so that nothing of the surface is lost.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from qpavoid.problem import Array, IntArray

_CUTS = 8
"""Slabs along each axis, at most: their third power bounds the cells that are merged."""
_CLOSE = 1e-3
"""Share of a part's extent below which coordinates count as the same."""
_THIN = 1e-9
"""Thickness of what has no volume: a share of the size of the mesh."""


def decompose(vertices: Array, triangles: IntArray, max_pieces: int, tolerance: float) -> list[Array]:
    """Cover a mesh with convex pieces whose union encloses every triangle of it.

    Args:
        vertices: (n, 3) [m].
        triangles: (t, 3) indices.
        max_pieces: most pieces; with few, they enclose more than the tolerance allows.
        tolerance: volume that a merge may add, all merges together, as a share of the volume of the mesh's hull.

    Returns:
        Corners (n_i, 3) of each piece.
    """
    size = float(np.ptp(vertices, axis=0).max())
    pieces = [
        np.unique(cell.reshape(-1, 3), axis=0)
        for part in _parts(vertices, triangles, 1e-9 * size)
        for cell in _cells(part)
    ]
    volume = _Volume(_THIN * size)
    return _merge(pieces, volume, max_pieces, tolerance * volume(vertices))


class _Volume:
    """Volume of hulls [m³]; of what is flat, its area times next to nothing."""

    def __init__(self, thin: float) -> None:
        self._box = thin * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])

    def __call__(self, points: Array) -> float:
        try:
            return float(ConvexHull(points).volume)
        except (QhullError, ValueError):
            return float(ConvexHull((points[:, None] + 1e3 * self._box).reshape(-1, 3), qhull_options="QJ").volume)


def _parts(vertices: Array, triangles: IntArray, weld_distance: float) -> list[Array]:
    """Split a mesh into the parts that touch no other; triangles (t, 3, 3) of each."""
    _, same = np.unique(np.round(vertices / weld_distance), axis=0, return_inverse=True)
    corners = same.ravel()[triangles]
    edges = np.concatenate((corners[:, :2], corners[:, 1:]))
    count = int(same.max()) + 1
    graph = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
    parts, label = connected_components(graph, directed=False)
    of = label[corners[:, 0]]
    components = [vertices[triangles[of == part]] for part in range(parts) if np.any(of == part)]
    return [part if _signed_volume(part) >= 0.0 else part[:, ::-1] for part in components]


def _signed_volume(triangles: Array) -> float:
    """Return the volume of a closed part; negative where its faces look inwards."""
    return float(np.einsum("ij,ij->", triangles[:, 0] - triangles[0, 0], _normals(triangles)))


def _cells(triangles: Array) -> list[Array]:
    """Cut the triangles (t, 3, 3) of a part along all three axes."""
    cells = [triangles]
    for axis in range(3):
        coordinates = triangles[..., axis].ravel()
        close = _CLOSE * float(np.ptp(coordinates))
        planes = _planes(np.sort(coordinates), close)
        slabs = []
        for cell in cells:
            remainder = cell
            for plane in planes:
                below, remainder = _cut(remainder, axis, plane, close)
                slabs.append(below)
            slabs.append(remainder)
        cells = [slab for slab in slabs if len(slab)]
    return cells


def _planes(coordinates: Array, close: float) -> list[float]:
    """Choose the planes of the cuts along an axis.

    At the corners' own coordinates (n,), sorted, where these are few, else evenly.
    """
    distinct = coordinates[np.diff(coordinates, prepend=-np.inf) > close].tolist()
    if len(distinct) > _CUTS + 1:
        distinct = np.linspace(coordinates[0], coordinates[-1], _CUTS + 1).tolist()
    inner: list[float] = [x for x in distinct if coordinates[0] + close < x < coordinates[-1] - close]
    return inner


def _cut(triangles: Array, axis: int, plane: float, close: float) -> tuple[Array, Array]:
    """Cut triangles (t, 3, 3) at a plane; return those below and those above it.

    Corners closer to the plane than `close` count as lying in it, and stay where they are.
    """
    height = triangles[..., axis] - plane
    height[np.abs(height) <= close] = 0.0
    below, above = (height <= 0.0).all(axis=1), (height >= 0.0).all(axis=1)
    is_crossed = ~(below | above)
    # the corner that is alone on its side comes first
    low = height[is_crossed] < 0.0
    lone_corner = np.where(low.sum(axis=1) == 1, low.argmax(axis=1), (height[is_crossed] > 0.0).argmax(axis=1))
    order = (lone_corner[:, None] + np.arange(3)) % 3
    cut = np.take_along_axis(triangles[is_crossed], order[..., None], axis=1)
    h = np.take_along_axis(height[is_crossed], order, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.clip(h[:, :1] / (h[:, :1] - h[:, 1:]), 0.0, 1.0)
    on = cut[:, :1] + share[..., None] * (cut[:, 1:] - cut[:, :1])
    tip = np.stack((cut[:, 0], on[:, 0], on[:, 1]), axis=1)
    remainder = np.concatenate(
        (np.stack((on[:, 0], cut[:, 1], cut[:, 2]), axis=1), np.stack((on[:, 0], cut[:, 2], on[:, 1]), axis=1))
    )
    tip_low = h[:, 0] < 0.0
    is_tip_low = np.concatenate((tip_low, tip_low))
    # what lies in the plane goes to the side where there is material: against its outward normal
    flat, up = below & above, _normals(triangles)[:, axis] > 0.0
    return (
        np.concatenate((triangles[below & (~flat | up)], tip[tip_low], remainder[~is_tip_low])),
        np.concatenate((triangles[above & ~(flat & up)], tip[~tip_low], remainder[is_tip_low])),
    )


def _normals(triangles: Array) -> Array:
    return np.asarray(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]))


def _merge(pieces: list[Array], volume: _Volume, max_pieces: int, allowance: float) -> list[Array]:
    """Merge neighbours, the pair that adds least volume first."""
    points_of: dict[int, Array] = dict(enumerate(pieces))
    own = {i: volume(points) for i, points in points_of.items()}
    boxes = {i: (points.min(axis=0), points.max(axis=0)) for i, points in points_of.items()}
    price: dict[tuple[int, int], float] = {}

    def consider(i: int, j: int, far: float = 0.0) -> None:
        if np.all(boxes[i][0] <= boxes[j][1] + far) and np.all(boxes[j][0] <= boxes[i][1] + far):
            union = volume(np.concatenate((points_of[i], points_of[j])))
            price[min(i, j), max(i, j)] = union - own[i] - own[j]

    for i in points_of:
        for j in range(i + 1, len(pieces)):
            consider(i, j)
    added_volume, next_index = 0.0, len(pieces)
    while len(points_of) > 1:
        if not price:  # what is left lies apart
            if len(points_of) <= max_pieces:
                break
            for i, j in ((i, j) for i in points_of for j in points_of if i < j):
                consider(i, j, np.inf)
        (i, j), added = min(price.items(), key=lambda entry: entry[1])
        if len(points_of) <= max_pieces and added_volume + max(added, 0.0) > allowance:
            break
        added_volume += max(added, 0.0)
        points = np.concatenate((points_of.pop(i), points_of.pop(j)))
        price = {pair: cost for pair, cost in price.items() if not {i, j} & set(pair)}
        points_of[next_index] = _corners(points)
        own[next_index], boxes[next_index] = volume(points), (points.min(axis=0), points.max(axis=0))
        for neighbour in list(points_of)[:-1]:
            consider(neighbour, next_index)
        next_index += 1
    return list(points_of.values())


def _corners(points: Array) -> Array:
    try:
        return np.asarray(points[ConvexHull(points).vertices])
    except (QhullError, ValueError):
        return points
