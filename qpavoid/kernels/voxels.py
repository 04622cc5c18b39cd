"""Voxels of a point cloud that are nearest to each body.

Bodies count as capsules: other shapes as the capsule around them.
"""

from __future__ import annotations

import numpy as np

from qpavoid.kernels.packing import compiled
from qpavoid.problem import Array, IntArray

SAME_DIRECTION = 0.05
"""Angle below which the directions to voxels at about the same place of a body count as one [rad]: their normals differ
by 5 % at most."""


@compiled
def voxels_within(
    axes: Array,
    radii: Array,
    max_distance: float,
    centers: Array,
    blocks: Array,
    starts: IntArray,
    first: IntArray,
    point: IntArray,
    distance: Array,
    place: Array,
) -> None:
    """Find the voxels that are nearer to a body than `max_distance`, body after body.

    A block of voxels is skipped where the ball around it is farther than that from the ball around the body's capsule.

    Args:
        axes: ends of the bodies' axes in the cloud's frame (b, 6) [m]; NaN for a body that is skipped.
        radii: of the bodies' capsules plus the voxels' balls (b,) [m].
        max_distance: surface distance [m].
        centers: of the voxels (m, 3), see `Voxels`.
        blocks: balls around the blocks (k, 4).
        starts: where each block begins (k + 1,).
        first: out (b + 1,): index at which each body's voxels begin in the arrays that follow.
        point: out (b m,): numbers of the voxels.
        distance: out (b m,): between surfaces [m].
        place: out (b m, 4): coordinate of the nearest point along the axis [m], and the direction from there.
    """
    count = 0
    for body in range(len(axes)):
        first[body] = count
        sx, sy, sz = axes[body, 0], axes[body, 1], axes[body, 2]
        ax, ay, az = axes[body, 3] - sx, axes[body, 4] - sy, axes[body, 5] - sz
        length2 = ax * ax + ay * ay + az * az
        if not length2 < np.inf:
            continue
        half = 0.5 * np.sqrt(length2)
        mx, my, mz = sx + 0.5 * ax, sy + 0.5 * ay, sz + 0.5 * az
        limit = radii[body] + max_distance
        for block in range(len(blocks)):
            dx, dy, dz = blocks[block, 0] - mx, blocks[block, 1] - my, blocks[block, 2] - mz
            far = half + limit + blocks[block, 3]
            if not dx * dx + dy * dy + dz * dz <= far * far:
                continue
            for i in range(starts[block], starts[block + 1]):
                px, py, pz = centers[i, 0] - sx, centers[i, 1] - sy, centers[i, 2] - sz
                fraction = min(max((px * ax + py * ay + pz * az) / max(length2, 1e-300), 0.0), 1.0)
                px, py, pz = px - fraction * ax, py - fraction * ay, pz - fraction * az
                gap2 = px * px + py * py + pz * pz
                if gap2 < limit * limit:
                    gap = np.sqrt(gap2)
                    if gap - radii[body] < max_distance:
                        point[count], distance[count] = i, gap - radii[body]
                        scale = 1.0 / max(gap, 1e-300)
                        place[count, 0], place[count, 1] = 2.0 * half * fraction, scale * px
                        place[count, 2], place[count, 3] = scale * py, scale * pz
                        count += 1
    first[len(axes)] = count


@compiled
def select_voxels(
    first: IntArray,
    point: IntArray,
    distance: Array,
    place: Array,
    spacing: Array,
    keys: IntArray,
    slots: IntArray,
    previous_keys: IntArray,
) -> None:
    """Select for each body its nearest voxels, except those that make the same row as a nearer one.

    Two voxels at about the same place of a body's axis, in about the same direction, make the same row. Up to half of
    the slots go to the nearest voxels at different places of the axis, so that both ends have some; the remaining ones
    to the nearest that make other rows, so that there is a row on either side of each tie, and rows do not jump. A
    voxel that is selected again stays in its slot.

    Args:
        first: index at which each body's voxels begin (b + 1,), as of `voxels_within`.
        point: their numbers (b m,).
        distance: from the body (b m,) [m]; overwritten.
        place: coordinate along the axis, and direction (b m, 4).
        spacing: distance along the axis from which places count as different (b,) [m].
        keys: of all voxels (m,).
        slots: out (b, k): numbers of the selected voxels; -1 for none.
        previous_keys: keys of the voxels in the slots (b, k), -1 for none; overwritten with the new ones.
    """
    bodies, size = slots.shape
    chosen = np.empty(size, np.intp)
    for body in range(bodies):
        low, high = first[body], first[body + 1]
        count = 0
        while count < size:
            best, nearest = -1, np.inf
            if count < (size + 1) // 2:
                for i in range(low, high):
                    if distance[i] < nearest:
                        same_place = False
                        for c in range(count):
                            same_place = same_place or abs(place[i, 0] - place[chosen[c], 0]) < spacing[body]
                        if not same_place:
                            best, nearest = i, distance[i]
            if best < 0:
                for i in range(low, high):
                    if distance[i] < nearest:
                        best, nearest = i, distance[i]
            if best < 0:
                break
            chosen[count] = best
            count += 1
            for i in range(low, high):
                dx, dy, dz = place[i, 1] - place[best, 1], place[i, 2] - place[best, 2], place[i, 3] - place[best, 3]
                same_direction = dx * dx + dy * dy + dz * dz < SAME_DIRECTION**2
                if same_direction and abs(place[i, 0] - place[best, 0]) < spacing[body]:
                    distance[i] = np.inf
            distance[best] = np.inf
        for slot in range(size):
            slots[body, slot] = -1
        for c in range(count):
            voxel = point[chosen[c]]
            for slot in range(size):
                if previous_keys[body, slot] == keys[voxel]:
                    slots[body, slot] = voxel
                    chosen[c] = -1
                    break
        slot = 0
        for c in range(count):
            if chosen[c] >= 0:
                while slots[body, slot] >= 0:
                    slot += 1
                slots[body, slot] = point[chosen[c]]
        for slot in range(size):
            previous_keys[body, slot] = keys[slots[body, slot]] if slots[body, slot] >= 0 else -1
