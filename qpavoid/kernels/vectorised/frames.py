"""Rows of the frames that follow targets, and the velocity that the tracking law makes of all task rows."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.linalg.lapack import dposv

from qpavoid.kernels.rotation import rotation_vector
from qpavoid.problem import Array

WELL_CONDITIONED = 1e-6
"""Ratio of the smallest to the largest pivot of J Jᵀ down to which J⁺ is taken from it without damping."""

_SKEW = np.zeros((3, 9))
_SKEW[2, [1, 3]] = 1.0, -1.0
_SKEW[1, [2, 6]] = -1.0, 1.0
_SKEW[0, [5, 7]] = 1.0, -1.0


def frame_rows(x: Any) -> None:
    """Rows A v = b of f frames that follow targets: feed-forward plus gain times what is missing, capped and scaled.

    The orientation error is the rotation vector of R_target Rᵀ. Three linear rows for each frame whose position counts
    come first, then three angular rows for each whose orientation does; rows after these are left as they are.

    Args:
        x: reads frame_poses, targets and the layout of the tasks; writes poses, A, b.
    """
    x.frame_poses.take(x.frame_ids, axis=0, out=x.poses, mode="clip")
    here, turns, wanted = x.here, x.turns, x.wanted
    x.moments[:] = np.dot(here, _SKEW).reshape(-1, 3, 3)
    np.subtract(x.position, here, out=wanted)
    wanted *= x.moving_gain
    wanted += x.linear
    if len(turns):
        # poses hold rotations by columns, so these are their transposes
        missing = (x.rotation @ x.turned).tolist()
        if x.every_turns:
            x.wanted_turns[:] = [rotation_vector(R) for R in missing]
            x.wanted_turns *= x.gain_column
            x.wanted_turns += x.angular
        else:
            x.wanted_turns[:] = [rotation_vector(missing[f]) for f in turns]
            x.wanted_turns *= x.gain_column[turns]
            x.wanted_turns += x.angular[turns]
    if x.capped:
        asked = x.asked
        asked *= np.minimum(x.cap / np.maximum(np.sqrt((asked * asked).sum(axis=1)), 1e-12), 1.0)[:, None]
    if x.mimics:
        np.dot(np.dot(x.screws, x.J_world) * x.task_support, x.fold, out=x.A_frames)
    else:
        np.dot(x.screws, x.J_world, out=x.A_frames)
        np.multiply(x.A_frames, x.task_support, out=x.A_frames)
    np.multiply(x.b_frames, x.scale, out=x.b_frames)


def damped_solution(x: Any, v: Array) -> None:
    """A⁺b with A⁺ = Aᵀ (A Aᵀ + λ²)⁻¹.

    Args:
        x: reads A (r, n), b (r,) and the damping λ.
        v: out (n,); NaN where there is no damping and A Aᵀ is close to singular.
    """
    if not len(x.b):
        v.fill(0.0)
        return
    gram = x.gram
    np.dot(x.A, x.A.T, out=gram)
    x.gram_diagonal += x.damping2
    factor, y, info = dposv(gram, x.b)
    if x.damping == 0.0 and info == 0:
        pivots = factor.diagonal() ** 2
        info = int(pivots.min() < WELL_CONDITIONED * pivots.max())
    if info == 0:
        np.dot(y, x.A, out=v)
    else:
        v.fill(np.nan)


def projection_cost(A: Array, regularization: float, v0: Array) -> tuple[Array, Array]:
    """P = AᵀA + λ (n, n) and q = -P v0 (n,): ½ vᵀP v + qᵀv is smallest at v0."""
    P = np.dot(A.T, A)
    P.ravel()[:: len(P) + 1] += regularization
    return P, -np.dot(P, v0)
