"""Which voxels of a cloud are nearest to each body, in numpy; `kernels.compiled.voxels` has the same for numba.

Bodies count as capsules: those that are something else as the capsule around them.
"""

from __future__ import annotations

import numpy as np

from qpavoid.problem import Array, IntArray

ALIKE = 0.05
"""Angle below which voxels at about the same place of a body are felt alike [rad]."""


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
        place: out, where along the axis the nearest point is [m], and the direction from there (…, 4).
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
    share, unit, gap = _to_axis(centers[points], start[bodies], along[bodies])
    gap -= radii[bodies]
    near = gap < reach
    bodies, count = bodies[near], int(np.count_nonzero(near))
    first[:] = np.searchsorted(bodies, np.arange(len(first)))
    point[:count], distance[:count] = points[near], gap[near]
    place[:count, 0], place[:count, 1:] = 2.0 * half[bodies] * share[near], unit[near]


def _to_axis(points: Array, start: Array, along: Array) -> tuple[Array, Array, Array]:
    """Shares (n,) at which segments are nearest to points, directions from there (n, 3), distances (n,)."""
    away = points - start
    length2 = np.einsum("ij,ij->i", along, along)
    share = np.clip(np.einsum("ij,ij->i", away, along) / np.maximum(length2, 1e-300), 0.0, 1.0)
    away -= share[:, None] * along
    gap = np.sqrt(np.einsum("ij,ij->i", away, away))
    return share, away / np.maximum(gap, 1e-300)[:, None], gap


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
    """Fills the slots of each body with its nearest voxels, but for those that are felt as a nearer one is.

    Two voxels that a body faces at about the same place of its axis, in about the same direction, make the same row. Up
    to half of the slots go to the nearest voxels at different places of the axis, so that no end is forgotten over the
    other; the others to the nearest that are not alike, which leaves a row on either side of each tie, so that rows
    do not jump. A voxel that was in a slot before stays in it.

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
    slots.fill(-1)
    for body in np.flatnonzero(np.diff(first)).tolist():
        low, high = first[body], first[body + 1]
        left, at = distance[low:high], place[low:high]
        chosen: list[int] = []
        while len(chosen) < slots.shape[1]:
            i = -1
            if len(chosen) < (slots.shape[1] + 1) // 2:
                beside = np.abs(at[:, :1] - at[chosen, 0]).min(axis=1, initial=np.inf) < spacing[body]
                elsewhere = np.where(beside, np.inf, left)
                i = int(elsewhere.argmin())
                i = i if elsewhere[i] < np.inf else -1
            if i < 0:
                i = int(left.argmin())
            if left[i] == np.inf:
                break
            chosen.append(i)
            alike = np.square(at[:, 1:] - at[i, 1:]).sum(axis=1) < ALIKE**2
            left[alike & (np.abs(at[:, 0] - at[i, 0]) < spacing[body])] = np.inf
            left[i] = np.inf
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
