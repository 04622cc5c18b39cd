"""Which voxels of a cloud are nearest to each body.

Bodies count as capsules: those that are something else as the capsule around them.
"""

from __future__ import annotations

import numpy as np

from qpavoid.kernels.packing import compiled
from qpavoid.problem import Array, IntArray

ALIKE = 0.05
"""Angle below which the directions to voxels at about the same place of a body count as one [rad]."""


@compiled
def within_reach(
    axes: Array,
    radii: Array,
    reach: float,
    centers: Array,
    blocks: Array,
    starts: IntArray,
    first: IntArray,
    point: IntArray,
    distance: Array,
    place: Array,
) -> None:
    """Find the voxels that are nearer to a body than `reach`, body after body.

    Args:
        axes: ends of the bodies' axes in the cloud's frame (b, 6) [m]; NaN for a body that is left out.
        radii: of the bodies' capsules plus the voxels' balls (b,) [m].
        reach: surface distance [m].
        centers: of the voxels (m, 3), see `Voxels`.
        blocks: balls around the blocks (k, 4).
        starts: where each block begins (k + 1,).
        first: out, where each body's voxels begin in what follows (b + 1,).
        point: out, numbers of the voxels; as the others with room for b m.
        distance: out, between surfaces [m].
        place: out, where along the axis the nearest point is [m], and the direction from there (…, 4).
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
        limit = radii[body] + reach
        for block in range(len(blocks)):
            dx, dy, dz = blocks[block, 0] - mx, blocks[block, 1] - my, blocks[block, 2] - mz
            far = half + limit + blocks[block, 3]
            if not dx * dx + dy * dy + dz * dz <= far * far:
                continue
            for i in range(starts[block], starts[block + 1]):
                px, py, pz = centers[i, 0] - sx, centers[i, 1] - sy, centers[i, 2] - sz
                share = min(max((px * ax + py * ay + pz * az) / max(length2, 1e-300), 0.0), 1.0)
                px, py, pz = px - share * ax, py - share * ay, pz - share * az
                gap2 = px * px + py * py + pz * pz
                if gap2 < limit * limit:
                    gap = np.sqrt(gap2)
                    if gap - radii[body] < reach:
                        point[count], distance[count] = i, gap - radii[body]
                        scale = 1.0 / max(gap, 1e-300)
                        place[count, 0], place[count, 1] = 2.0 * half * share, scale * px
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
    kept: IntArray,
) -> None:
    """Fill the slots of each body with its nearest voxels, but for those that make the same row as a nearer one.

    Two voxels at about the same place of a body's axis, in about the same direction, make the same row. Up to half of
    the slots go to the nearest voxels at different places of the axis, so that no end is left out for the other; the
    others to the nearest that are not alike, which leaves a row on either side of each tie, so that rows do not jump. A
    voxel that was in a slot before stays in it.

    Args:
        first: where each body's voxels begin (b + 1,), as of `within_reach`.
        point: their numbers.
        distance: from the body [m]; overwritten.
        place: where along the axis, and in which direction (…, 4).
        spacing: how far apart along the axis places count as different (b,) [m].
        keys: of all voxels (m,).
        slots: out, numbers of the chosen voxels (b, k); -1 for none.
        kept: keys of the voxels that were in the slots before (b, k), -1 for none; overwritten with those of now.
    """
    bodies, size = slots.shape
    chosen = np.empty(size, np.intp)
    for body in range(bodies):
        low, high = first[body], first[body + 1]
        count = 0
        while count < size:
            best, least = -1, np.inf
            if count < (size + 1) // 2:
                for i in range(low, high):
                    if distance[i] < least:
                        beside = False
                        for c in range(count):
                            beside = beside or abs(place[i, 0] - place[chosen[c], 0]) < spacing[body]
                        if not beside:
                            best, least = i, distance[i]
            if best < 0:
                for i in range(low, high):
                    if distance[i] < least:
                        best, least = i, distance[i]
            if best < 0:
                break
            chosen[count] = best
            count += 1
            for i in range(low, high):
                dx, dy, dz = (place[i, 1] - place[best, 1], place[i, 2] - place[best, 2], place[i, 3] - place[best, 3])
                if dx * dx + dy * dy + dz * dz < ALIKE**2 and abs(place[i, 0] - place[best, 0]) < spacing[body]:
                    distance[i] = np.inf
            distance[best] = np.inf
        for slot in range(size):
            slots[body, slot] = -1
        for c in range(count):
            voxel = point[chosen[c]]
            for slot in range(size):
                if kept[body, slot] == keys[voxel]:
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
            kept[body, slot] = keys[slots[body, slot]] if slots[body, slot] >= 0 else -1
