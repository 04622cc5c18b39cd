"""Task rows that do not bend, as those of a posture: A is constant, and only b changes."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid.kernels.cholesky import dot, factorise, solve_factored
from qpavoid.kernels.packing import compiled
from qpavoid.kernels.singular_values import orthogonalise
from qpavoid.problem import Array

_SHIFT = 1e-11
"""Shift of the normal equations of all rows, over their largest diagonal [-]; two refinements take its effect away."""
_ROUND_OFF = 1e-16
"""Square of a row's part in a null space, over that of its largest entry, below which it has none [-]."""


@compiled
def scale_straight(x: Any, A: Array, b: Array) -> None:
    """Divide the velocity b (r,) of each task of constant rows by how far it exceeds the speeds of the joints."""
    excess = np.ones(x.row_tasks.max() + 1)
    for r in x.straight_rows:
        for c in range(A.shape[1]):
            if x.v_max[c] > 0.0 and A[r, c] != 0.0:
                rate = abs(A[r, c] * b[r]) / (x.scale[r] * x.scale[r] * x.v_max[c])
                excess[x.row_tasks[r]] = max(excess[x.row_tasks[r]], rate)
    for r in x.straight_rows:
        b[r] /= excess[x.row_tasks[r]]


@compiled
def bent_directions(S: Array, B: Array, squares: Array, G: Array, curvatures: Array) -> Array:
    """Compute γ_k n_kᵀ (s, n) of G on what the rows S move of the null space of the v_i.

    With an orthonormal basis Q of that, by Gram and Schmidt with the largest row first, the rows of Q G Qᵀ, made
    orthogonal, are γ_k times its eigenvectors.

    Args:
        S: (s, n).
        B: σ_i v_iᵀ (c, n).
        squares: σ_i² (c,).
        G: curvature (n, n).
        curvatures: out |γ_k| (s,), zero where there are less.
    """
    (count, nv), Q, size = S.shape, S.copy(), 0.0
    for r in range(count):
        for c in range(nv):
            size = max(size, S[r, c] * S[r, c])
        for i in range(len(B)):
            if squares[i] > 0.0:
                along = dot(Q[r], B[i]) / squares[i]
                for c in range(nv):
                    Q[r, c] -= along * B[i, c]
    rank = _orthonormalise(Q, _ROUND_OFF * size)
    H, directions, turned = np.empty((rank, rank)), np.zeros((count, nv)), np.empty(nv)
    for r in range(rank):
        for c in range(nv):
            turned[c] = dot(G[c], Q[r])
        for k in range(rank):
            H[r, k] = dot(Q[k], turned)
    curvatures[:] = 0.0
    orthogonalise(H, curvatures[:rank])
    for r in range(rank):
        curvatures[r] = np.sqrt(curvatures[r])
        for k in range(rank):
            for c in range(nv):
                directions[r, c] += H[r, k] * Q[k, c]
    return directions


@compiled
def _orthonormalise(Q: Array, least: float) -> int:
    """Turn the first rows of Q (c, n) into an orthonormal basis of all rows; return how many those are.

    Rows count whose square exceeds `least` in what the rows before them leave.
    """
    count, nv = Q.shape
    for rank in range(count):
        best, largest = rank, 0.0
        for r in range(rank, count):
            square = dot(Q[r], Q[r])
            if square > largest:
                best, largest = r, square
        if not largest > least:
            return rank
        for c in range(nv):
            Q[rank, c], Q[best, c] = Q[best, c], Q[rank, c]
        for i in range(rank):  # once more: what is left may be small
            along = dot(Q[rank], Q[i])
            for c in range(nv):
                Q[rank, c] -= along * Q[i, c]
        length = np.sqrt(dot(Q[rank], Q[rank]))
        for c in range(nv):
            Q[rank, c] /= length
        for r in range(rank + 1, count):
            along = dot(Q[r], Q[rank])
            for c in range(nv):
                Q[r, c] -= along * Q[rank, c]
    return count


@compiled
def solve_together(A: Array, b: Array, B: Array, damping: Array, v: Array) -> None:
    """Write the least velocity of least ‖A v - b‖² + Σ damping_i (v_iᵀ v)².

    By normal equations with a small shift, refined twice: a direction without rows stays at rest.

    Args:
        A: (r, n).
        b: (r,).
        B: σ_i v_iᵀ (c, n); not read where `damping` is zero.
        damping: (c,).
        v: out (n,).
    """
    nv = len(v)
    M, L, missing, step = np.zeros((nv, nv)), np.zeros((nv, nv)), np.empty(nv), np.empty(nv)
    for r in range(len(A)):
        for i in range(nv):
            if A[r, i] != 0.0:
                for j in range(nv):
                    M[i, j] += A[r, i] * A[r, j]
    for k in range(len(damping)):
        if damping[k] > 0.0:
            square = 0.0
            for c in range(nv):
                square += B[k, c] * B[k, c]
            for i in range(nv):
                for j in range(nv):
                    M[i, j] += damping[k] / square * B[k, i] * B[k, j]
    largest = 0.0
    for i in range(nv):
        largest = max(largest, M[i, i])
    shifted = M.copy()
    for i in range(nv):
        shifted[i, i] += max(_SHIFT * largest, 1e-300)
    factorise(shifted, L, nv)
    v[:] = 0.0
    for _ in range(3):
        for i in range(nv):
            missing[i] = 0.0
            for j in range(nv):
                missing[i] -= M[i, j] * v[j]
        for r in range(len(A)):
            for i in range(nv):
                missing[i] += A[r, i] * b[r]
        solve_factored(L, missing, step, nv)
        for i in range(nv):
            v[i] += step[i]
