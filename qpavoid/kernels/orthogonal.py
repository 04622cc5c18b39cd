"""Rows J v = b of full priority, solved: an orthonormal basis of what they leave, by Householder reflections."""

from __future__ import annotations

import numpy as np

from qpavoid.kernels.packing import compiled
from qpavoid.problem import Array, IntArray

_DEPENDENT = 1e-8
"""Share of the largest pivot below which a row follows from the others, as with two hands on one wall [-]."""


@compiled
def factorise_rows(J: Array, Q: Array, R: Array, order: IntArray) -> int:
    """Factor the rows of J (c, n) as J[order].T = Q R, the row of most that is new before the others.

    Args:
        J: rows.
        Q: (n, n) out: orthonormal columns, of which the first `rank` span the rows, and the others their null space.
        R: (n, c) out: upper triangle.
        order: (c,) out.

    Returns:
        The rank.
    """
    c, n = J.shape
    reflections, scales, size = np.zeros((n, n)), np.zeros(n), np.empty(c)
    for k in range(c):
        order[k] = k
        for i in range(n):
            R[i, k] = J[k, i]
    rank, first = 0, 0.0
    for j in range(min(c, n)):
        size[:] = 0.0
        for i in range(j, n):
            for k in range(j, c):
                size[k] += R[i, k] * R[i, k]
        best = j
        for k in range(j, c):
            if size[k] > size[best]:
                best = k
        norm = np.sqrt(size[best])
        first = max(first, norm)
        if not norm > _DEPENDENT * first:
            break
        order[j], order[best] = order[best], order[j]
        for i in range(n):
            R[i, j], R[i, best] = R[i, best], R[i, j]
        pivot = -norm if R[j, j] > 0.0 else norm
        for i in range(j, n):
            reflections[j, i] = R[i, j]
        reflections[j, j] -= pivot
        scales[j] = 1.0 / (norm * abs(reflections[j, j]))
        _reflect(reflections[j], scales[j], R, j, j, c)
        rank += 1
    for i in range(n):
        for k in range(n):
            Q[i, k] = 1.0 if i == k else 0.0
    for j in range(rank - 1, -1, -1):
        _reflect(reflections[j], scales[j], Q, j, j, n)
    return rank


@compiled
def _reflect(u: Array, scale: float, A: Array, begin: int, first: int, last: int) -> None:
    """Apply 1 - scale u uᵀ, with u zero before `begin`, to the columns first to last of A."""
    products = np.zeros(last - first)
    for i in range(begin, len(u)):
        for k in range(first, last):
            products[k - first] += u[i] * A[i, k]
    for i in range(begin, len(u)):
        factor = scale * u[i]
        for k in range(first, last):
            A[i, k] -= factor * products[k - first]


@compiled
def solve_rows(J: Array, b: Array) -> tuple[Array, Array]:
    """Solve J v = b; rows that follow from others are left out.

    Args:
        J: (c, n) rows.
        b: (c,) right-hand sides.

    Returns:
        Orthonormal basis (n, k) of the null space of J, the least v (n,).
    """
    K, Z, R, order = split_space(J)
    return Z, least_solution(K, R, order, b)


@compiled
def split_space(J: Array) -> tuple[Array, Array, Array, IntArray]:
    """Split the space of v by rows J (c, n); what they do not move, as arms on two feet, costs no work.

    Returns:
        Orthonormal bases K (rank, n) of the rows and Z (n, n - rank) of their null space, R and `order` of
        `factorise_rows`.
    """
    c, n = J.shape
    moved, m = np.empty(n, dtype=np.intp), 0
    for j in range(n):
        is_moved = False
        for r in range(c):
            is_moved |= J[r, j] != 0.0
        if is_moved:
            moved[m] = j
            m += 1
    own, Q, R, order = np.empty((c, m)), np.empty((m, m)), np.empty((m, c)), np.empty(c, dtype=np.intp)
    for r in range(c):
        for i in range(m):
            own[r, i] = J[r, moved[i]]
    rank = factorise_rows(own, Q, R, order)
    K, Z, free, at = np.zeros((rank, n)), np.zeros((n, n - rank)), m - rank, 0
    for i in range(m):
        for k in range(rank):
            K[k, moved[i]] = Q[i, k]
        for k in range(free):
            Z[moved[i], k] = Q[i, rank + k]
    for j in range(n):
        if at < m and moved[at] == j:
            at += 1
        else:
            Z[j, free + j - at] = 1.0
    return K, Z, R, order


@compiled
def least_solution(K: Array, R: Array, order: IntArray, b: Array) -> Array:
    """Compute the least v (n,) with J v = b (c,); see `split_space`."""
    rank, n = K.shape
    v, y = np.zeros(n), np.empty(rank)
    for i in range(rank):
        total = b[order[i]]
        for k in range(i):
            total -= R[k, i] * y[k]
        y[i] = total / R[i, i]
        for k in range(n):
            v[k] += K[i, k] * y[i]
    return v
