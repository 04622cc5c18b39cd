"""Depth images into voxels: pixels of the robot's own bodies are marked, all others fill the cells of a grid.

A pixel (u, v) of depth z is at z ((u - cx) / fx, (v - cy) / fy, 1) in the camera's axes: x to the right, y down, z into
the picture. Cells are kept in a hash table with open addressing, so that memory is bounded and no pixel is sorted.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from qpavoid.kernels.packing import compiled, inlined
from qpavoid.problem import Array, IntArray, Mask


class OwnBodies(NamedTuple):
    """Collision bodies of a robot, as points are compared with them.

    A body is a box with a radius around it (sphere: a point, capsule: a segment), or the inside of some planes.
    """

    poses: Array
    """(b, 12) of the bodies in the camera's axes: rotation by columns, position [m]."""
    core: Array
    """(b, 4) radius around the box, then half its sizes along x, y and z [m]."""
    sphere: Array
    """(b, 4) bounding sphere in the body's frame: centre, radius [m]."""
    planes: Array
    """(p, 4) outward unit normals and offsets of all bodies that have planes: n·x + offset <= 0 inside [-, m]."""
    span: IntArray
    """(b, 2) first plane of each body, and the one after its last; the same of a box."""


class CellGrid(NamedTuple):
    """Cells of a voxel grid that hold something, at most `c` of them."""

    table: IntArray
    """(2^k,) number of a cell plus 1, at its hash or after it; 0 where there is none."""
    cells: IntArray
    """(c, 3) number of each cell along the axes."""
    pixels: IntArray
    """(c,) how many pixels fell into each."""
    stamps: Array
    """(c,) when each was seen last [s]."""


@compiled
def mark_own_pixels(depth: Array, lens: Array, bodies: OwnBodies, margin: float, own: Mask) -> None:
    """Mark the pixels whose points are within a margin of a body.

    Exactly those for boxes and what has a box as core; for bodies with planes, those within all planes shifted outwards
    by the margin, which contain them. Only pixels in a rectangle around the picture of its bounding sphere are looked
    at.

    Args:
        depth: of each pixel (h, w) [m].
        lens: fx, fy, cx, cy [pixels].
        bodies: of the robot.
        margin: distance from a body up to which points count as its own [m].
        own: out (h, w).
    """
    height, width = depth.shape
    planes, per_x, per_y = _planes_in_camera(bodies), 1.0 / lens[0], 1.0 / lens[1]
    own[:] = False
    for b in range(len(bodies.core)):
        x, y, z = _center(bodies.poses[b], bodies.sphere[b])
        size = bodies.sphere[b, 3] + margin
        if z + size <= 0.0:
            continue
        left, right = _pixels_across(x, z, size, lens[0], lens[2], width)
        top, bottom = _pixels_across(y, z, size, lens[1], lens[3], height)
        kx, ky, kz, known = 0.0, 0.0, 0.0, 0.0  # the last point whose distance was computed, and that minus the margin
        for v in range(top, bottom):
            ray_y = (v - lens[3]) * per_y
            for u in range(left, right):
                d = depth[v, u]
                if own[v, u] or not abs(d - z) <= size:  # NaN too
                    continue
                px, py = d * ((u - lens[2]) * per_x), d * ray_y
                if (px - x) ** 2 + (py - y) ** 2 + (d - z) ** 2 > size * size:
                    continue
                if (px - kx) ** 2 + (py - ky) ** 2 + (d - kz) ** 2 >= known * known:
                    kx, ky, kz, known = px, py, d, _distance(bodies, planes, b, px, py, d) - margin
                own[v, u] = known <= 0.0  # no distance differs by more than how far two points are apart


@inlined
def _center(pose: Array, sphere: Array) -> tuple[float, float, float]:
    """Return the centre of a body's bounding sphere, in the camera's axes."""
    return (
        pose[0] * sphere[0] + pose[3] * sphere[1] + pose[6] * sphere[2] + pose[9],
        pose[1] * sphere[0] + pose[4] * sphere[1] + pose[7] * sphere[2] + pose[10],
        pose[2] * sphere[0] + pose[5] * sphere[1] + pose[8] * sphere[2] + pose[11],
    )


@inlined
def _planes_in_camera(bodies: OwnBodies) -> Array:
    """Return the planes of all bodies in the camera's axes (4, p): normals, then offsets; in rows, as vectors need."""
    planes = np.empty((4, len(bodies.planes)))
    for b in range(len(bodies.core)):
        pose = bodies.poses[b]
        for i in range(bodies.span[b, 0], bodies.span[b, 1]):
            normal = bodies.planes[i]
            offset = normal[3]
            for k in range(3):
                planes[k, i] = pose[k] * normal[0] + pose[3 + k] * normal[1] + pose[6 + k] * normal[2]
                offset -= planes[k, i] * pose[9 + k]
            planes[3, i] = offset
    return planes


@inlined
def _pixels_across(x: float, z: float, size: float, focal: float, center: float, count: int) -> tuple[int, int]:
    """Return the first pixel, and the one after the last, that a sphere about (x, z) of that radius can cover."""
    if z - size <= 1e-3:
        return 0, count
    low, high = x - size, x + size
    first = center + focal * (low / (z + size if low > 0.0 else z - size))
    last = center + focal * (high / (z - size if high > 0.0 else z + size))
    first, last = min(max(first, 0.0), float(count)), min(max(last + 1.0, 0.0), float(count))
    return int(np.floor(first)), int(np.ceil(last))


@inlined
def _distance(bodies: OwnBodies, planes: Array, b: int, x: float, y: float, z: float) -> float:
    """Return the distance of a point from body b, or from the farthest of its planes (4, p); in the camera's axes [m].

    It is not positive inside, and changes by at most as much as the point is moved.
    """
    first, end = bodies.span[b, 0], bodies.span[b, 1]
    if first < end:
        nx, ny, nz, offsets = planes[0, first:end], planes[1, first:end], planes[2, first:end], planes[3, first:end]
        farthest = -np.inf
        for i in range(len(offsets)):
            farthest = max(farthest, nx[i] * x + ny[i] * y + nz[i] * z + offsets[i])
        return farthest
    pose, core = bodies.poses[b], bodies.core[b]
    x, y, z = x - pose[9], y - pose[10], z - pose[11]
    bx = max(abs(pose[0] * x + pose[1] * y + pose[2] * z) - core[1], 0.0)
    by = max(abs(pose[3] * x + pose[4] * y + pose[5] * z) - core[2], 0.0)
    bz = max(abs(pose[6] * x + pose[7] * y + pose[8] * z) - core[3], 0.0)
    return float(np.sqrt(bx * bx + by * by + bz * bz) - core[0])


@compiled
def fill_cells(
    depth: Array, lens: Array, pose: Array, own: Mask, ranges: Array, region: Array, resolution: float, t: float,
    grid: CellGrid,
) -> int:  # fmt: skip
    """Fill the cells that hold a point of a depth image; those that are marked as the robot's own are left out.

    Args:
        depth: of each pixel (h, w) [m].
        lens: fx, fy, cx, cy [pixels].
        pose: of the camera (12,), world axes.
        own: pixels to leave out (h, w).
        ranges: least and largest depth that counts (2,) [m].
        region: corners (2, 3) of the box, in world axes, outside of which no point counts [m].
        resolution: edge of a cell [m].
        t: when the image was taken [s].
        grid: overwritten.

    Returns:
        Number of cells; -1 where they do not fit.
    """
    height, width = depth.shape
    grid.table[:] = 0
    count, last, ix, iy, iz = 0, -1, 0, 0, 0
    per_cell, per_x, per_y = 1.0 / resolution, 1.0 / lens[0], 1.0 / lens[1]  # divisions would take half of the time
    for v in range(height):
        ray_y = (v - lens[3]) * per_y
        for u in range(width):
            d = depth[v, u]
            if own[v, u] or not (d >= ranges[0] and d <= ranges[1]):
                continue
            ray_x = (u - lens[2]) * per_x
            x = d * (pose[0] * ray_x + pose[3] * ray_y + pose[6]) + pose[9]
            y = d * (pose[1] * ray_x + pose[4] * ray_y + pose[7]) + pose[10]
            z = d * (pose[2] * ray_x + pose[5] * ray_y + pose[8]) + pose[11]
            if not (
                region[0, 0] <= x <= region[1, 0] and region[0, 1] <= y <= region[1, 1]
                and region[0, 2] <= z <= region[1, 2]
            ):  # fmt: skip
                continue
            jx, jy, jz = int(np.floor(x * per_cell)), int(np.floor(y * per_cell)), int(np.floor(z * per_cell))
            if last < 0 or jx != ix or jy != iy or jz != iz:  # neighbouring pixels are mostly in one cell
                ix, iy, iz = jx, jy, jz
                slot = _slot_of(grid, ix, iy, iz)
                last = grid.table[slot] - 1
                if last < 0:
                    if count == len(grid.cells):
                        return -1
                    last, count = count, count + 1
                    _write_cell(grid, slot, last, ix, iy, iz, 0, t)
            grid.pixels[last] += 1
    return count


@compiled
def recall_cells(
    depth: Array, lens: Array, pose: Array, own: Mask, bodies: OwnBodies, near: float, resolution: float,
    known: Array, stamps: Array, least_pixels: int, count: int, grid: CellGrid,
) -> int:  # fmt: skip
    """Add the voxels of earlier images of which this one shows nothing: what hides them is nearer.

    A voxel is dropped where its pixel is deeper than it by more than the radius of the sphere around it, since nothing
    is there; where it is as deep as that, since its own cells stand for what is there; and where a body of the robot
    is. It stays where a nearer surface or the robot hides it, out of the picture, and where there is no valid depth.

    Args:
        depth: see `fill_cells`; infinite where there is nothing.
        lens: see there.
        pose: see there.
        own: see there.
        bodies: of the robot.
        near: least depth that counts [m].
        resolution: see there.
        known: centres of the earlier voxels (m, 3), world axes [m].
        stamps: when they were seen last (m,) [s].
        least_pixels: pixels from which a cell counts; one of fewer counts where it is among the earlier ones.
        count: cells that are in the grid.
        grid: cells of this image; added to.

    Returns:
        Number of cells; -1 where they do not fit.
    """
    height, width = depth.shape
    slack, planes = 0.5 * np.sqrt(3.0) * resolution, _planes_in_camera(bodies)
    centers = np.empty((len(bodies.core), 3))
    for b in range(len(centers)):
        centers[b, 0], centers[b, 1], centers[b, 2] = _center(bodies.poses[b], bodies.sphere[b])
    for i in range(len(known)):
        dx, dy, dz = known[i, 0] - pose[9], known[i, 1] - pose[10], known[i, 2] - pose[11]
        x = pose[0] * dx + pose[1] * dy + pose[2] * dz
        y = pose[3] * dx + pose[4] * dy + pose[5] * dz
        z = pose[6] * dx + pose[7] * dy + pose[8] * dz
        is_dropped = False
        if z > near:
            u, v = lens[2] + lens[0] * x / z, lens[3] + lens[1] * y / z
            if -0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5:
                row, column = int(v + 0.5), int(u + 0.5)
                is_dropped = depth[row, column] > (z + slack if own[row, column] else z - slack)
        for b in range(len(centers)):
            away = (x - centers[b, 0]) ** 2 + (y - centers[b, 1]) ** 2 + (z - centers[b, 2]) ** 2
            if away <= bodies.sphere[b, 3] ** 2 and not is_dropped:
                is_dropped = _distance(bodies, planes, b, x, y, z) <= 0.0
        if is_dropped:
            continue
        ix, iy = int(np.floor(known[i, 0] / resolution)), int(np.floor(known[i, 1] / resolution))
        iz = int(np.floor(known[i, 2] / resolution))
        slot = _slot_of(grid, ix, iy, iz)
        cell = grid.table[slot] - 1
        if cell < 0:
            if count == len(grid.cells):
                return -1
            _write_cell(grid, slot, count, ix, iy, iz, least_pixels, stamps[i])
            count += 1
        elif grid.pixels[cell] < least_pixels:
            grid.pixels[cell], grid.stamps[cell] = least_pixels, stamps[i]
    return count


@inlined
def _slot_of(grid: CellGrid, ix: int, iy: int, iz: int) -> int:
    """Return where in the table a cell is, or where it would be put."""
    mask = len(grid.table) - 1
    slot = ((ix * 73856093) ^ (iy * 19349663) ^ (iz * 83492791)) & mask  # the primes of Teschner et al. 2003
    while grid.table[slot] > 0:
        cell = grid.cells[grid.table[slot] - 1]
        if cell[0] == ix and cell[1] == iy and cell[2] == iz:
            break
        slot = (slot + 1) & mask
    return slot


@inlined
def _write_cell(grid: CellGrid, slot: int, number: int, ix: int, iy: int, iz: int, pixels: int, stamp: float) -> None:
    """Write a new cell of that number, of which nothing is in the table yet."""
    grid.table[slot] = number + 1
    grid.cells[number, 0], grid.cells[number, 1], grid.cells[number, 2] = ix, iy, iz
    grid.pixels[number], grid.stamps[number] = pixels, stamp
