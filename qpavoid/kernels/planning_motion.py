"""Bounds on how far bodies get on a straight motion: what decides how much of it one sample covers.

The motion has q(s) = a + s (b - a), s from 0 to 1. A body's points then move at p'(s), and p'' = Σᵢⱼ ∂²p/∂qᵢ∂qⱼ Δᵢ Δⱼ.
The second derivative is a rotation's cross product with the lever arm about the distal one of the two joints, so that
|p''| ≤ Σⱼ Lⱼ |Δⱼ| (|Δⱼ| + 2 Σᵢ |Δᵢ|), i proximal to j and L the largest lever arms. With the speed at a sample, a point
gets no farther than |p'| δ + |p''| δ²/2 while s changes by δ. It gets no farther than Σ L |Δ| δ either.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.packing import compiled, inlined
from qpavoid.problem import Array


@compiled
def begin_motion(x: Any, a: Array, b: Array, duration: float) -> None:
    """Write the bounds that hold all along the straight motion from a to b (n,) in some time [s]."""
    lever, row_rates, rates, row, obstacle, speed = x.lever, x.row_rates, x.rates, x.row, x.obstacle, x.point_speed
    change, d = x.change, x.distances
    for i in range(len(a)):
        change[i] = b[i] - a[i]
    for r in range(len(lever)):
        rate = 0.0
        for i in range(len(a)):
            rate += lever[r, i] * abs(change[i])
        row_rates[r] = rate
    for k in range(len(rates)):
        rates[k] = row_rates[row[k]] + duration * speed[obstacle[k]]
    for g in range(len(d.joints)):
        x.bends[g] = _bend(x, g) if d.joints[g] > 0 else 0.0
        x.speeds[g] = 0.0
    for o in x.moving:
        for g in range(d.first[o], d.first[o + 1]):
            x.speeds[g] = duration * speed[o]


@inlined
def _bend(x: Any, g: int) -> float:
    """Compute a bound on the second derivative of body g's points [m]."""
    total, turns, lever = 0.0, 0.0, x.body_lever
    for c in range(len(x.columns)):
        if lever[g, c] > 0.0:
            change = abs(x.change[x.columns[c]])
            turn = x.factors[c] * change
            total += lever[g, c] * change * (turn + 2.0 * turns)
            turns += turn
    return total


@compiled
def write_speeds(x: Any) -> None:
    """Write the largest speed of any point of each body that joints move, at the poses of a sample [m]."""
    tree, d, twists, poses, change = x.frames, x.distances, x.twists, x.joint_poses, x.change
    for c in range(len(tree.column_joints)):
        i = tree.column_joints[c]
        p = tree.parents[i]
        rate = tree.multiplier[i] * change[tree.q_index[i]]
        dx, dy, dz = poses[i, 9] - poses[p, 9], poses[i, 10] - poses[p, 10], poses[i, 11] - poses[p, 11]
        wx, wy, wz = twists[p, 3], twists[p, 4], twists[p, 5]
        twists[i, 0] = twists[p, 0] + wy * dz - wz * dy
        twists[i, 1] = twists[p, 1] + wz * dx - wx * dz
        twists[i, 2] = twists[p, 2] + wx * dy - wy * dx
        for r in range(3):
            slide = poses[i, r] * tree.motions[c, 0] + poses[i, 3 + r] * tree.motions[c, 1]
            turn = poses[i, r] * tree.motions[c, 3] + poses[i, 3 + r] * tree.motions[c, 4]
            twists[i, r] += rate * (slide + poses[i, 6 + r] * tree.motions[c, 2])
            twists[i, 3 + r] = twists[p, 3 + r] + rate * (turn + poses[i, 6 + r] * tree.motions[c, 5])
    for g in range(len(d.joints)):
        i = d.joints[g]
        if i > 0:
            dx, dy, dz = d.centers[g, 0] - poses[i, 9], d.centers[g, 1] - poses[i, 10], d.centers[g, 2] - poses[i, 11]
            wx, wy, wz = twists[i, 3], twists[i, 4], twists[i, 5]
            vx = twists[i, 0] + wy * dz - wz * dy
            vy = twists[i, 1] + wz * dx - wx * dz
            vz = twists[i, 2] + wx * dy - wy * dx
            turning = np.sqrt(wx * wx + wy * wy + wz * wz)
            x.speeds[g] = np.sqrt(vx * vx + vy * vy + vz * vz) + turning * x.radius[g]


@inlined
def change_within(x: Any, k: int, s: float) -> float:
    """Compute how much the distance of pair k changes at most within a fraction s of the motion from a sample [m]."""
    speed = x.speeds[x.first[k]] + x.speeds[x.second[k]]
    bend = x.bends[x.first[k]] + x.bends[x.second[k]]
    return s * min(x.rates[k], speed + 0.5 * s * bend)


@inlined
def fraction_until(x: Any, k: int, change: float) -> float:
    """Compute the fraction of the motion within which the distance of pair k changes by no more than that [m]."""
    speed = x.speeds[x.first[k]] + x.speeds[x.second[k]]
    bend = x.bends[x.first[k]] + x.bends[x.second[k]]
    return max(change / x.rates[k], 2.0 * change / (speed + np.sqrt(speed * speed + 2.0 * bend * change) + 1e-300))
