"""QPs in fewer coordinates, v = v_particular + Z w: equality constraints that are met exactly."""

from __future__ import annotations

import numpy as np

from qpavoid.problem import Array, Contacts
from qpavoid.solvers.backends import Backend


def in_contact_null_space(contacts: Contacts | None, backend: Backend) -> Backend:
    """Return a back end whose answers are restricted to velocities that meet the contacts.

    Variables beyond the nv velocities, such as slacks, are not restricted.

    Args:
        contacts: of the robot; without any, the back end itself is returned.
        backend: solves for w.
    """
    if contacts is None:
        return backend
    nv, dof = contacts.Z.shape

    def solve(P: Array, q: Array, G: Array, h: Array, lower: Array, upper: Array) -> Array | None:
        slacks = len(q) - nv
        Z, start = np.zeros((nv + slacks, dof + slacks)), np.zeros(nv + slacks)
        Z[:nv, :dof], Z[nv:, dof:], start[:nv] = contacts.Z, np.eye(slacks), contacts.v_particular
        return solve_within(backend, Z, start, P, q, G, h, lower, upper)

    return solve


def solve_within(
    backend: Backend, Z: Array, start: Array, P: Array, q: Array, G: Array, h: Array, lower: Array, upper: Array
) -> Array | None:
    """Compute the minimiser (n,) of ½ xᵀP x + qᵀx with G x >= h, lower <= x <= upper, x = start + Z w.

    Bounds become rows where w has other coordinates than x.

    Args:
        backend: solves for w.
        Z: (n, k) orthonormal columns.
        start: a point of the affine space (n,).
        P: (n, n) symmetric, positive definite.
        q: (n,).
        G: (m, n).
        h: (m,).
        lower: (n,), may be infinite.
        upper: (n,), may be infinite.

    Returns:
        x, or None where the back end finds none.
    """
    below, above = lower - start, start - upper
    bounded_below, bounded_above = np.isfinite(below), np.isfinite(above)
    rows = np.concatenate((G @ Z, Z[bounded_below], -Z[bounded_above]))
    right = np.concatenate((h - G @ start, below[bounded_below], above[bounded_above]))
    unbounded = np.full(Z.shape[1], np.inf)
    w = backend(Z.T @ P @ Z, Z.T @ (q + P @ start), np.ascontiguousarray(rows), right, -unbounded, unbounded)
    return None if w is None else start + Z @ w
