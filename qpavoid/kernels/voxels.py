"""Which voxels of a cloud are nearest to each body, in numpy; `voxels_compiled` has the same for numba.

Bodies count as capsules: those that are something else as the capsule around them.
"""

from __future__ import annotations

import numpy as np

from qpavoid.problem import Array, IntArray


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
    witness: Array,
) -> None:
    """Voxels that are nearer to a body than `reach`, body after body.

    Args:
        axes: ends of the bodies' axes in the cloud's frame (b, 6) [m]; NaN for a body that is not to be looked at.
        radii: of the bodies' capsules plus the voxels' balls (b,) [m].
        reach: surface distance [m].
        centers: of the voxels (m, 3), see `Voxels`.
        blocks: balls around the blocks (k, 4).
        starts: where each block begins (k + 1,).
        first: out, where each body's voxels begin in what follows (b + 1,).
        point: out, numbers of the voxels; as the others with room for b m.
        distance: out, between surfaces [m].
        witness: out, closest points on the bodies' surfaces (…, 3) [m].
    """
    start, along = axes[:, :3], axes[:, 3:] - axes[:, :3]
    half = 0.5 * np.sqrt(np.einsum("ij,ij->i", along, along))
    middle = start + 0.5 * along
    with np.errstate(invalid="ignore"):
        apart = np.sqrt(np.square(middle[:, None] - blocks[:, :3]).sum(axis=2))
        body, block = np.nonzero(apart <= (half + radii + reach)[:, None] + blocks[:, 3])
    counts = starts[block + 1] - starts[block]
    ends = np.cumsum(counts)
    total = int(ends[-1]) if len(ends) else 0
    points = np.arange(total) + np.repeat(starts[block] - (ends - counts), counts)
    bodies = np.repeat(body, counts)
    foot, unit, gap = _to_axis(centers[points], start[bodies], along[bodies])
    gap -= radii[bodies]
    near = gap < reach
    bodies, count = bodies[near], int(np.count_nonzero(near))
    first[:] = np.searchsorted(bodies, np.arange(len(first)))
    point[:count], distance[:count] = points[near], gap[near]
    witness[:count] = foot[near] + radii[bodies][:, None] * unit[near]


def _to_axis(points: Array, start: Array, along: Array) -> tuple[Array, Array, Array]:
    """Nearest points of segments to points (n, 3), directions to these (zero where there is none), distances (n,)."""
    away = points - start
    length2 = np.einsum("ij,ij->i", along, along)
    share = np.clip(np.einsum("ij,ij->i", away, along) / np.maximum(length2, 1e-300), 0.0, 1.0)
    foot = start + share[:, None] * along
    away = points - foot
    gap = np.sqrt(np.einsum("ij,ij->i", away, away))
    return foot, away / np.maximum(gap, 1e-300)[:, None], gap


def choose(
    first: IntArray,
    point: IntArray,
    distance: Array,
    witness: Array,
    spacing: Array,
    keys: IntArray,
    slots: IntArray,
    kept: IntArray,
) -> None:
    """Fills the slots of each body: half with its nearest voxels, the others with the nearest that face it elsewhere.

    The nearest ones keep a row on either side of each tie, so that rows do not jump; the others look after the other
    end of a body that the nearest ones are not at. A voxel that was in a slot before stays in it.

    Args:
        first: where each body's voxels begin (b + 1,), as of `within_reach`.
        point: their numbers.
        distance: from the body [m]; overwritten.
        witness: closest points on the body (…, 3) [m].
        spacing: how far apart those of the others are from all chosen before (b,) [m].
        keys: of all voxels (m,).
        slots: out, numbers of the chosen voxels (b, k); -1 for none.
        kept: keys of the voxels that were in the slots before (b, k), -1 for none; overwritten with those of now.
    """
    size = slots.shape[1]
    nearest = (size + 1) // 2
    slots.fill(-1)
    for body in np.flatnonzero(np.diff(first)).tolist():
        low, high = first[body], first[body + 1]
        left, at = distance[low:high], witness[low:high]
        chosen: list[int] = []
        for k in range(size):
            if k == nearest:
                for i in chosen:
                    left[np.square(at - at[i]).sum(axis=1) < spacing[body] ** 2] = np.inf
            i = int(left.argmin())
            if left[i] == np.inf:
                break
            chosen.append(i)
            if k < nearest:
                left[i] = np.inf
            else:
                left[np.square(at - at[i]).sum(axis=1) < spacing[body] ** 2] = np.inf
        _put(point[low:high][chosen].tolist(), keys, slots[body], kept[body])
    kept[:] = np.where(slots >= 0, keys[slots] if len(keys) else -1, -1)


def _put(chosen: list[int], keys: IntArray, slots: IntArray, kept: IntArray) -> None:
    """Puts voxels into slots: into the one where each was before, the others into those that are free."""
    before = {key: slot for slot, key in enumerate(kept.tolist()) if key >= 0}
    new = []
    for voxel in chosen:
        slot = before.get(int(keys[voxel]))
        if slot is None:
            new.append(voxel)
        else:
            slots[slot] = voxel
    slots[np.flatnonzero(slots < 0)[: len(new)]] = new
