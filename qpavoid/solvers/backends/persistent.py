"""proxqp and osqp, set up once for each size, updated in place and started from the last solution of that size."""

from __future__ import annotations

from collections.abc import Callable
from math import isfinite
from typing import Any, Protocol

import numpy as np
from osqp import OSQP  # type: ignore[import-untyped]
from proxsuite import proxqp  # type: ignore[import-untyped]
from scipy.sparse import csc_matrix

from qpavoid.problem import Array

_MAX_WORKSPACES = 64
"""Largest number of workspaces [-]; the one that was not used for the longest time is dropped first."""
_RESIDUAL = 1e-8
"""Largest residual of the optimality conditions with which a warm-started answer is accepted."""
_INFINITY = 1e20
"""Bound from which both take a side as unbounded [-]."""

Answer = tuple[Array, Array]
"""x (n,) and the multipliers (m,) of G x >= h, not negative at a minimum."""


class Workspace(Protocol):
    """Memory of a back end for one size; made from the first problem, which is then solved cold."""

    def update(self, P: Array, q: Array, G: Array, h: Array, lower: Array, upper: Array) -> None:
        """Replace the problem by another one of the same size."""
        ...

    def solve(self) -> Answer | None:
        """Solve the problem; None without a solution."""
        ...


class Persistent:
    """Back end made of workspaces.

    An earlier problem must never influence an answer, but a warm start can end at a point that is no minimum and report
    success (proxqp 0.8, once in 1500 unrelated problems: a multiplier of the wrong sign, x off by up to 1.8). Hence a
    warm-started answer has to meet the optimality conditions, a check of about 10 µs; else its workspace is dropped and
    the problem solved cold.
    """

    def __init__(self, make: Callable[..., Workspace]) -> None:
        self._make = make
        self._workspaces: dict[tuple[int, ...], Workspace] = {}

    def __call__(self, P: Array, q: Array, G: Array, h: Array, lower: Array, upper: Array) -> Array | None:
        """Compute the solution of a QP, see `Backend`; None where none is found."""
        if not _well_formed(P, q, G, h, lower, upper):
            return None
        workspace = self._workspaces.pop(G.shape, None)
        answer = None
        if workspace is not None:
            workspace.update(P, q, G, h, lower, upper)
            answer = workspace.solve()
        if workspace is None or answer is None or not residual(P, q, G, h, lower, upper, *answer) <= _RESIDUAL:
            workspace = self._make(P, q, G, h, lower, upper)
            answer = workspace.solve()
        if answer is None:
            return None
        self._workspaces[G.shape] = workspace
        if len(self._workspaces) > _MAX_WORKSPACES:
            del self._workspaces[next(iter(self._workspaces))]
        return answer[0]


def _well_formed(P: Array, q: Array, G: Array, h: Array, lower: Array, upper: Array) -> bool:
    """Return True without NaN, on which both iterate to their limit, and with lower <= upper."""
    return all(isfinite(np.vdot(a, a)) for a in (P, q, G, h)) and bool((lower <= upper).all())


def residual(P: Array, q: Array, G: Array, h: Array, lower: Array, upper: Array, x: Array, y: Array) -> float:
    """Compute the natural residual of the optimality conditions, 0 at the minimum only:

    max(‖x - clip(x - (P x + q - Gᵀy), lower, upper)‖∞, ‖min(y, G x - h)‖∞)
    """
    step = np.minimum(np.maximum(x - (P @ x + q - y @ G), lower), upper)
    return max(float(np.abs(x - step).max()), float(np.abs(np.minimum(y, G @ x - h)).max(initial=0.0)))


class ProxqpWorkspace:
    """Proximal augmented Lagrangian method (Bambade et al. 2022), dense, with box constraints.

    The duality gap must be checked: without it, x was off by up to 1e-4 at residuals of 1e-9. PrimalDualLDLT is not
    what `Automatic` picks for these sizes, and up to three times as fast.
    """

    def __init__(self, P: Array, q: Array, G: Array, h: Array, lower: Array, upper: Array) -> None:
        self._rows, n = G.shape
        self._qp = proxqp.dense.QP(n, 0, self._rows, True, dense_backend=proxqp.dense.DenseBackend.PrimalDualLDLT)
        settings = self._qp.settings
        settings.initial_guess = proxqp.InitialGuess.WARM_START_WITH_PREVIOUS_RESULT
        settings.eps_abs, settings.eps_rel = 1e-10, 0.0
        settings.check_duality_gap, settings.eps_duality_gap_abs, settings.eps_duality_gap_rel = True, 1e-12, 1e-13
        settings.max_iter, settings.max_iter_in = 100, 100
        above = np.full(self._rows, _INFINITY)
        self._qp.init(P, q, None, None, *self._rows_or_none(G, h, above), lower, upper)

    def _rows_or_none(self, *rows: Array | None) -> tuple[Array | None, ...]:
        """Return the arguments; None in place of each, in a problem without rows."""
        return rows if self._rows else (None,) * len(rows)

    def update(self, P: Array, q: Array, G: Array, h: Array, lower: Array, upper: Array) -> None:
        """See `Workspace`."""
        self._qp.update(P, q, None, None, *self._rows_or_none(G, h, None), lower, upper, update_preconditioner=False)

    def solve(self) -> Answer | None:
        """See `Workspace`."""
        self._qp.solve()
        results = self._qp.results
        if results.info.status != proxqp.QPSolverOutput.PROXQP_SOLVED:
            return None
        return np.array(results.x), -np.array(results.z[: self._rows])


class OsqpWorkspace:
    """Operator splitting (Stellato et al. 2020) with polishing, which makes it exact.

    Bounds are the first rows of [I; G]. An additional variable is at its bound by its cost: where no row at all is
    active, polishing prints a line to the output of the process, at any settings (osqp 1.1, osqp/osqp#785).
    """

    def __init__(self, P: Array, q: Array, G: Array, h: Array, lower: Array, upper: Array) -> None:
        m, n = G.shape[0], G.shape[1] + 1
        self._n = n - 1
        self._column, self._row = np.tril_indices(n)
        self._P, self._q = np.eye(n), np.full(n, -1.0)
        self._data = np.zeros((n, 1 + m))
        self._data[:, 0] = 1.0
        self._below, self._above = np.full(n + m, -np.inf), np.full(n + m, np.inf)
        self._above[n - 1] = 0.0
        in_column = np.concatenate((np.arange(n)[:, None], np.broadcast_to(np.arange(n, n + m), (n, m))), axis=1)
        starts = np.concatenate(([0], np.cumsum(np.arange(1, n + 1))))
        vectors = self._vectors(P, q, G, h, lower, upper)
        cost = csc_matrix((vectors.pop("Px"), self._row, starts), shape=(n, n))
        rows = csc_matrix((vectors.pop("Ax"), in_column.ravel(), np.arange(n + 1) * (1 + m)), shape=(n + m, n))
        settings: dict[str, Any] = {"eps_abs": 1e-9, "eps_rel": 1e-12, "max_iter": 20000, "polishing": True}
        settings["polish_refine_iter"] = 10  # with the default of 3, polished answers were off by up to 6e-5
        self._qp = OSQP()
        self._qp.setup(P=cost, A=rows, **vectors, **settings, verbose=False)

    def _vectors(self, P: Array, q: Array, G: Array, h: Array, lower: Array, upper: Array) -> dict[str, Array]:
        """Return all entries that can change: upper P and [I; G] by columns, q, bounds."""
        n = self._n
        self._P[:n, :n], self._q[:n], self._data[:n, 1:] = P, q, G.T
        self._below[:n], self._below[n + 1 :], self._above[:n] = lower, h, upper
        triangle = self._P[self._row, self._column]
        return {"Px": triangle, "Ax": self._data.ravel(), "q": self._q, "l": self._below, "u": self._above}

    def update(self, P: Array, q: Array, G: Array, h: Array, lower: Array, upper: Array) -> None:
        """See `Workspace`."""
        self._qp.update(**self._vectors(P, q, G, h, lower, upper))

    def solve(self) -> Answer | None:
        """See `Workspace`."""
        result = self._qp.solve(raise_error=False)
        solved = result.info.status_val == 1
        return (result.x[: self._n].copy(), -result.y[self._n + 1 :]) if solved else None
