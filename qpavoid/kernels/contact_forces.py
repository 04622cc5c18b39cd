"""Contact forces of a robot whose base floats: eliminated with the six equations of the base.

    τ dt = M (v - v̄) + dt h - Jcᵀ p,    p = dt f, the impulses of all contact points in one period [N s]

The base has no motor: M_b (v - v̄) + dt h_b = B p with B = Jc_bᵀ. With the contacts, v = rest + Z w, these equations are
solved for p by a right inverse Y of B and a basis N of its null space, so that w and u are free:

    p = Y (M_b (rest - v̄) + dt h_b) + Y M_b Z w + N u

A solver sees x = (v, s p) = start + X y with `scale` s, since impulses weigh less than velocities. Those columns of X
that belong to u are orthonormal, and orthogonal to all of Y, so that XᵀX is 1 + s² (Y M_b Z)ᵀ Y M_b Z of w, and 1 of u.
"""

from __future__ import annotations

import numpy as np

from qpavoid.kernels.cholesky import dot, factorise
from qpavoid.kernels.orthogonal import factorise_rows
from qpavoid.kernels.packing import compiled
from qpavoid.problem import Array, IntArray

BASE = 6
"""Coordinates of a floating base, which come first."""
ROWS_PER_POINT = 6
"""Rows of a contact point: four of its friction pyramid, least and greatest normal force."""
_MARGIN = 1e-7
"""Distance of torque rows from the limits, over the size of M in a row [rad/s or m/s]: more than a solver errs by."""


@compiled
def point_jacobians(J: Array, offsets: Array, frames: IntArray, Jp: Array) -> None:
    """Write the Jacobians of points on frames: ẋ = v_frame + ω × r.

    Args:
        J: (f, 6, n) of the frames, linear then angular, world axes.
        offsets: (k, 3) r, from frame to point, world axes [m].
        frames: (k,) frame of each point.
        Jp: (3 k, n) out.
    """
    for k in range(len(frames)):
        f, (x, y, z) = frames[k], (offsets[k, 0], offsets[k, 1], offsets[k, 2])
        for j in range(J.shape[2]):
            wx, wy, wz = J[f, 3, j], J[f, 4, j], J[f, 5, j]
            Jp[3 * k, j] = J[f, 0, j] + wy * z - wz * y
            Jp[3 * k + 1, j] = J[f, 1, j] + wz * x - wx * z
            Jp[3 * k + 2, j] = J[f, 2, j] + wx * y - wy * x


@compiled
def eliminate_base(
    M: Array, h: Array, v: Array, dt: float, Jp: Array, Z: Array, rest: Array, scale: float,
    X: Array, start: Array, Y: Array, N: Array,
) -> bool:  # fmt: skip
    """Write what meets contacts and base equations: x = (v, s p) = start + X y.

    Args:
        M: (n, n) mass matrix, symmetric.
        h: (n,) Coriolis, centrifugal and gravity torques [Nm or N].
        v: (n,) velocity at the begin of the period, v̄ [rad/s or m/s].
        dt: control period [s].
        Jp: (m, n) Jacobian of the contact points.
        Z: (n, k) basis of the velocities that move no contact.
        rest: (n,) velocity that meets the contacts.
        scale: s.
        X: (n + m, k + m - 6) out; its last m - 6 columns, orthonormal, move no coordinate; see `make_orthonormal`.
        start: (n + m,) out.
        Y: (m, 6) out: right inverse of B.
        N: (m, m - 6) out: orthonormal basis of the forces that do not move the base.

    Returns:
        Whether the points can carry any wrench; else nothing is written.
    """
    n, k, m = len(h), Z.shape[1], len(Jp)
    if m < BASE:
        return False
    B, Q, R = np.empty((BASE, m)), np.empty((m, m)), np.empty((m, BASE))
    order = np.empty(BASE, dtype=np.intp)
    for i in range(BASE):
        for j in range(m):
            B[i, j] = Jp[j, i]
    if factorise_rows(B, Q, R, order) < BASE:
        return False
    N[:] = Q[:, BASE:]
    y = np.empty(BASE)
    for e in range(BASE):  # Y e of a unit vector: Rᵀ y = e[order]
        for i in range(BASE):
            total = 1.0 if order[i] == e else 0.0
            for c in range(i):
                total -= R[c, i] * y[c]
            y[i] = total / R[i, i]
        for j in range(m):
            total = 0.0
            for i in range(BASE):
                total += Q[j, i] * y[i]
            Y[j, e] = total
    X[:] = 0.0
    start[:n] = rest
    X[:n, :k] = Z
    X[n:, k:] = N
    moving, needed = np.zeros((BASE, k)), np.empty(BASE)
    for i in range(BASE):
        needed[i] = dt * h[i]
        for j in range(n):
            needed[i] += M[i, j] * (rest[j] - v[j])
            for c in range(k):
                moving[i, c] += M[i, j] * Z[j, c]
    for j in range(m):
        total = 0.0
        for i in range(BASE):
            weight = scale * Y[j, i]
            total += weight * needed[i]
            for c in range(k):
                X[n + j, c] += weight * moving[i, c]
        start[n + j] = total
    return True


@compiled
def add_gram(X: Array, first: int, k: int, weight: float, G: Array) -> None:
    """Add weight · XᵀX, of the rows of X from `first` on and its first k columns, to the lower triangle of G."""
    for r in range(first, len(X)):
        for i in range(k):
            for c in range(i + 1):
                G[i, c] += weight * X[r, i] * X[r, c]


@compiled
def make_orthonormal(X: Array, n: int, k: int) -> Array:
    """Compute X with its first k columns made orthonormal, of which the first n rows are."""
    G, L, own = np.zeros((k, k)), np.empty((k, k)), X.copy()
    add_gram(X, n, k, 1.0, G)
    for i in range(k):
        G[i, i] += 1.0
    factorise(G, L, k)
    for r in range(len(own)):
        for i in range(k):
            total = own[r, i]
            for c in range(i):
                total -= L[i, c] * own[r, c]
            own[r, i] = total * L[i, i]
    return own


@compiled
def standing_dynamics(M: Array, h: Array, Jp: Array, Y: Array, K: Array, M_own: Array, h_own: Array) -> None:
    """Write the dynamics of the joints where contacts hold, with the least forces that the base needs.

    τ = D a + τ_rest with D = S M (1 - Kᵀ K) and τ_rest = S h, where S = (-Jc_aᵀ Y, 1) takes over what the base needs.

    Args:
        M: (n, n) mass matrix.
        h: (n,) bias torques [Nm or N].
        Jp: (m, n) Jacobian of the contact points.
        Y: (m, 6) see `eliminate_base`.
        K: (r, n) orthonormal basis of the rows of the contacts, see `split_space`.
        M_own: (n, n) out: D, below six rows of zero.
        h_own: (n,) out: τ_rest, behind six zeros [Nm or N].
    """
    n, weights = K.shape[1], np.empty(BASE)
    M_own[:BASE], h_own[:BASE] = 0.0, 0.0
    for i in range(BASE, n):
        weights[:] = 0.0
        for j in range(len(Jp)):
            if Jp[j, i] != 0.0:  # arms move no contact
                for b in range(BASE):
                    weights[b] += Jp[j, i] * Y[j, b]
        h_own[i] = h[i]
        for c in range(n):
            M_own[i, c] = M[i, c]
        for b in range(BASE):
            if weights[b] != 0.0:
                h_own[i] -= weights[b] * h[b]
                for c in range(n):
                    M_own[i, c] -= weights[b] * M[b, c]
        remove_parts(M_own[i], K)


@compiled
def remove_parts(row: Array, K: Array) -> None:
    """Remove from a row (n,) what it has of the orthonormal ones of K (r, n)."""
    parts = np.empty(len(K))
    for k in range(len(K)):
        parts[k] = dot(row, K[k])
    for k in range(len(K)):
        if parts[k] != 0.0:
            for c in range(len(row)):
                row[c] -= parts[k] * K[k, c]


@compiled
def force_torque_rows(
    M: Array, h: Array, v: Array, dt: float, Jp: Array, limit: Array, scale: float, rows: Array, rhs: Array
) -> None:
    """Write the rows of the torque limits in x = (v, s p): M_a v - Jc_aᵀ p within M_a v̄ - dt h_a ± dt τ, over Σ|M_a|.

    Args:
        M: (n, n) mass matrix.
        h: (n,) bias torques [Nm or N].
        v: (n,) v̄ [rad/s or m/s].
        dt: control period [s].
        Jp: (m, n) Jacobian of the contact points.
        limit: (n - 6,) largest torque of each joint [Nm or N].
        scale: s.
        rows: (2 (n - 6), n + m) out: of each joint of the least torque, then of the greatest.
        rhs: (2 (n - 6),) out.
    """
    n = len(h)
    for r in range(len(limit)):
        i, weight, momentum = BASE + r, 0.0, 0.0
        for j in range(n):
            weight += abs(M[i, j])
            momentum += M[i, j] * v[j]
        for j in range(n):
            rows[2 * r, j] = M[i, j] / weight
            rows[2 * r + 1, j] = -M[i, j] / weight
        for j in range(len(Jp)):
            factor = Jp[j, i] / (scale * weight)
            rows[2 * r, n + j] = -factor
            rows[2 * r + 1, n + j] = factor
        middle = momentum - dt * h[i]
        rhs[2 * r] = (middle - dt * limit[r]) / weight + _MARGIN
        rhs[2 * r + 1] = (-middle - dt * limit[r]) / weight + _MARGIN


@compiled
def cone_rows(
    normals: Array, friction: Array, least: Array, most: Array, dt: float, scale: float, first: int,
    rows: Array, rhs: Array,
) -> None:  # fmt: skip
    """Write the rows of friction cones, as pyramids within them, and of the bounds of normal forces.

    ±t_1 p, ±t_2 p <= μ/√2 n p and dt f_min <= n p <= dt f_max for each point, of tangents t_1, t_2 and normal n.

    Args:
        normals: (k, 3) n, world axes, away from the ground.
        friction: (k,) μ.
        least: (k,) f_min [N].
        most: (k,) f_max [N].
        dt: control period [s].
        scale: s of x = (v, s p).
        first: where p begins in x.
        rows: (6 k, ·) out.
        rhs: (6 k,) out.
    """
    t = np.empty((2, 3))
    rows[: ROWS_PER_POINT * len(friction)] = 0.0
    for k in range(len(friction)):
        n, mu = normals[k], friction[k] / np.sqrt(2.0)
        smallest = 0
        for c in range(1, 3):
            if abs(n[c]) < abs(n[smallest]):
                smallest = c
        for c in range(3):
            t[0, c] = (1.0 if c == smallest else 0.0) - n[smallest] * n[c]
        size = np.sqrt(t[0, 0] ** 2 + t[0, 1] ** 2 + t[0, 2] ** 2)
        for c in range(3):
            t[0, c] /= size
        t[1, 0] = n[1] * t[0, 2] - n[2] * t[0, 1]
        t[1, 1] = n[2] * t[0, 0] - n[0] * t[0, 2]
        t[1, 2] = n[0] * t[0, 1] - n[1] * t[0, 0]
        at, column = ROWS_PER_POINT * k, first + 3 * k
        for c in range(3):
            for side in range(2):
                rows[at + 2 * side, column + c] = mu * n[c] + t[side, c]
                rows[at + 2 * side + 1, column + c] = mu * n[c] - t[side, c]
            rows[at + 4, column + c], rows[at + 5, column + c] = n[c], -n[c]
        for side in range(4):
            rhs[at + side] = 0.0
        rhs[at + 4], rhs[at + 5] = scale * dt * least[k], -scale * dt * most[k]
