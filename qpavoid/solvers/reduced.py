"""QPs in fewer coordinates: v = v̄ + Z w, for what must hold exactly whatever else gives way."""

from __future__ import annotations

import numpy as np

from qpavoid.problem import Array, Contacts
from qpavoid.solvers.backends import Backend


def in_contact_null_space(contacts: Contacts | None, backend: Backend) -> Backend:
    """A back end that answers with velocities that hold the contacts, as if there were no others.

    Variables beyond the nv velocities, such as slacks, are left as they are.

    Args:
        contacts: solved; without any, the back end is given back.
        backend: solves for w.
    """
    if contacts is None:
        return backend
    nv, free = contacts.Z.shape

    def solve(P: Array, q: Array, G: Array, h: Array, lower: Array, upper: Array) -> Array | None:
        more = len(q) - nv
        Z, start = np.zeros((nv + more, free + more)), np.zeros(nv + more)
        Z[:nv, :free], Z[nv:, free:], start[:nv] = contacts.Z, np.eye(more), contacts.v_particular
        return solve_within(backend, Z, start, P, q, G, h, lower, upper)

    return solve


def solve_within(
    backend: Backend, Z: Array, start: Array, P: Array, q: Array, G: Array, h: Array, lower: Array, upper: Array
) -> Array | None:
    """Minimiser (n,) of ½ xᵀP x + qᵀx subject to G x >= h, lower <= x <= upper, among x = start + Z w.

    Bounds become rows where w has other coordinates than x.

    Args:
        backend: solves for w.
        Z: (n, k) orthonormal columns.
        start: (n,).
        P: (n, n) symmetric, positive definite.
        q: (n,).
        G: (m, n).
        h: (m,).
        lower: (n,), may be infinite.
        upper: (n,), likewise.

    Returns:
        None where the back end finds none.
    """
    below, above = lower - start, start - upper
    some_below, some_above = np.isfinite(below), np.isfinite(above)
    rows = np.concatenate((G @ Z, Z[some_below], -Z[some_above]))
    right = np.concatenate((h - G @ start, below[some_below], above[some_above]))
    unbounded = np.full(Z.shape[1], np.inf)
    w = backend(Z.T @ P @ Z, Z.T @ (q + P @ start), np.ascontiguousarray(rows), right, -unbounded, unbounded)
    return None if w is None else start + Z @ w
