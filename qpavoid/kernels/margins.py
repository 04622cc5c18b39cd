"""Margins of the pairs at a later pose: how much farther apart they are than they have to be."""

from __future__ import annotations

import numpy as np

from qpavoid.kernels.packing import compiled
from qpavoid.problem import Array, IntArray


@compiled
def distances_of(near: IntArray, results: Array, pairs: IntArray) -> Array:
    """Return the distances (k,) of some pairs, infinite for those that are not near [m].

    Args:
        near: pairs that are (c,), increasing.
        results: distance first, of all pairs (m, 10).
        pairs: those that are asked for (k,), increasing.
    """
    distances, i = np.full(len(pairs), np.inf), 0
    for k in range(len(pairs)):
        while i < len(near) and near[i] < pairs[k]:
            i += 1
        if i < len(near) and near[i] == pairs[k]:
            distances[k] = results[near[i], 0]
    return distances


@compiled
def least_margin(
    pairs: IntArray,
    later: Array,
    present: Array,
    offset: Array,
    allowance: Array,
    twist_row: IntArray,
    uncertainty: Array,
    safety_distance: float,
    approach: float,
) -> tuple[float, int, float]:
    """Compute the least margin of some pairs: distance, less the safety distance, or a little less than it is now.

    Args:
        pairs: their numbers (k,).
        later: distances at the later pose (k,) [m].
        present: distances now (k,) [m].
        offset: added to the distances of each pair (m,) [m].
        allowance: by which each pair may come nearer on purpose (m,) [m].
        twist_row: entry of `uncertainty` for each pair (m,).
        uncertainty: taken off the distances to obstacles [m].
        safety_distance: that is required of pairs that keep it now [m].
        approach: by which a pair may come nearer that does not keep it now [m].

    Returns:
        Least margin, infinite without pairs, the first NaN where there is one [m]; number of its pair, -1 without;
        least distance [m].
    """
    least, pair, distance = np.inf, -1, np.inf
    for k in range(len(pairs)):
        i = pairs[k]
        shift = offset[i] - uncertainty[twist_row[i]]
        required = min(safety_distance, present[k] + shift - approach)
        margin = later[k] + shift - required + allowance[i]
        distance = np.minimum(distance, later[k] + shift)  # keeps NaN, unlike min
        if not (least <= margin or least != least):
            least, pair = margin, i
    return least, pair, distance
