"""The functions of `qpavoid.kernels.vectorised.voxels` as loops that numba compiles; documented there."""

from __future__ import annotations

import numpy as np

from qpavoid.kernels.compiled.packing import compiled
from qpavoid.kernels.vectorised.voxels import ALIKE
from qpavoid.problem import Array, IntArray


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
    """See `vectorised.voxels.within_reach`."""
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
def choose(
    first: IntArray,
    point: IntArray,
    distance: Array,
    place: Array,
    spacing: Array,
    keys: IntArray,
    slots: IntArray,
    kept: IntArray,
) -> None:
    """See `vectorised.voxels.choose`."""
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
