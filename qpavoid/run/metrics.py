"""How far a tool is off the path that was planned for it, and what motors did."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from qpavoid.problem import Array


def point_segment_distance(p: Array, a: Array, b: Array) -> Array:
    """Compute the distances (...) of points p from segments ab [m]; the last axis of each holds the coordinates.

    Eq. 2 of the paper with the projection clamped to the segment, so that the axial part beyond an end counts, which
    eq. 2 leaves out. A segment of zero length is the point a.
    """
    u = b - a
    square = np.sum(u * u, axis=-1)
    t = np.divide(np.sum((p - a) * u, axis=-1), square, out=np.zeros(np.broadcast(p, u).shape[:-1]), where=square > 0.0)
    return np.asarray(np.linalg.norm(p - a - np.clip(t, 0.0, 1.0)[..., None] * u, axis=-1))


def path_deviation(tool: Array, target: Array, corners: int = 500) -> Array:
    """Compute the distance of each tool from the path that its target draws, at whatever time.

    Args:
        tool: (N, k, 3) positions of the tools [m].
        target: (N, k, 3) positions of their targets [m].
        corners: the path is taken as a polyline with at most so many corners.

    Returns:
        (N, k) [m].
    """
    count, tasks = tool.shape[:2]
    deviation = np.full((count, tasks), np.inf)
    every = np.unique(np.linspace(0, max(count - 1, 0), min(count, corners)).astype(int))
    for task in range(tasks):
        path = target[every, task]
        for start, end in zip(path, np.concatenate((path[1:], path[-1:])), strict=True):
            deviation[:, task] = np.minimum(deviation[:, task], point_segment_distance(tool[:, task], start, end))
    return deviation


def torque_figures(torque: Array, limit: Sequence[float | None], slip: Array, dt: float) -> dict[str, float] | None:
    """Compute the figures of motors; None where there are none.

    Args:
        torque: (N, m) of the motors [Nm or N].
        limit: m largest ones, None where there is none [Nm or N].
        slip: (N, c) of contact points [m].
        dt: control period [s].

    Returns:
        share: largest torque over its limit [-]; jitter: Σ|Δτ| over motors, per second [Nm/s]; slip: largest one [m].
    """
    if not torque.size:
        return None
    limits = np.array([np.inf if largest is None else largest for largest in limit])
    changes = np.abs(np.diff(torque, axis=0)).sum()
    return {
        "share": float(np.max(np.abs(torque) / limits)),
        "jitter": float(changes / (dt * len(torque))),
        "slip": float(np.max(slip, initial=0.0)),
    }
