"""QP back ends behind one call: min ½ xᵀP x + qᵀx subject to G x >= h, lower <= x <= upper.

daqp is called without a wrapper, every other one through qpsolvers. All have tight tolerances: the result is a
velocity, and an error of 1e-2 rad/s is a fault even where the back end reports success. qpsolvers imports every back
end that is installed, which takes as long as all else: so it is imported where it is used.
"""

from __future__ import annotations

import ctypes
import warnings
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import daqp
import numpy as np

from qpavoid import kernels
from qpavoid.errors import SolverNotInstalled, UnknownName
from qpavoid.problem import Array

Backend = Callable[[Array, Array, Array, Array, Array, Array], "Array | None"]
"""(P, q, G, h, lower, upper) -> x, or None where no solution was found.

P (n, n) is symmetric and positive definite, G (m, n) C-contiguous; m may be 0 and change from call to call; bounds may
be infinite. A back end belongs to one thread: it has memory between calls, but no call depends on another one.
"""

TOLERANCE = 1e-6
"""Largest violation of a row [m/s] or bound [rad/s] with which an answer counts as a solution: what back ends reach."""
_INFINITY = 1e30
"""Bound from which daqp takes a side as unbounded [-]: its own constant DAQP_INF."""
_TIGHT: dict[str, dict[str, Any]] = {
    "proxqp": {
        "eps_abs": 1e-10, "eps_rel": 0.0, "max_iter": 100,
        "mu_in": 1e-2,  # one feasible problem in 800 is called infeasible; with the default of 0.1, one in 150
        # without these, x was off by up to 1e-4 at residuals of 1e-9
        "check_duality_gap": True, "eps_duality_gap_abs": 1e-12, "eps_duality_gap_rel": 1e-13,
    },
    "osqp": {
        "eps_abs": 1e-9, "eps_rel": 1e-12, "max_iter": 20000, "polishing": True, "raise_error": False,
        "polish_refine_iter": 10,  # with the default of 3, polished answers were off by up to 6e-5
    },
    "piqp": {"eps_abs": 1e-10, "eps_rel": 0.0, "eps_duality_gap_abs": 1e-13, "eps_duality_gap_rel": 1e-14},
    "clarabel": {"tol_gap_abs": 1e-12, "tol_gap_rel": 1e-12, "tol_feas": 1e-10},
    "scs": {"eps_abs": 1e-9, "eps_rel": 1e-10},
}  # fmt: skip
"""Tolerances by back end; exact (active-set) ones need none. An error in x is about the root of twice the duality gap
over P's smallest eigenvalue: with 1e-3 there, a gap of 1e-10 still leaves x off by 4e-4. With 1e-15,
clarabel was right on nearly all recorded problems and failed on easy random ones."""


def backend_names() -> list[str]:
    """Return the names of the installed back ends, daqp first."""
    import qpsolvers

    return ["daqp", *sorted({*qpsolvers.available_solvers} - {"daqp"})]


def make_backend(name: str) -> Backend:
    """Return a new back end.

    Args:
        name: one of `backend_names`.

    Raises:
        SolverNotInstalled: qpsolvers knows it, but its package is missing.
        UnknownName: neither this package nor qpsolvers knows it.
    """
    if name == "daqp":
        return Daqp()
    import qpsolvers

    if name in qpsolvers.available_solvers:
        return through_qpsolvers(name)
    usable = ", ".join(backend_names())
    if name.isidentifier() and find_spec(f"qpsolvers.solvers.{name}_"):
        remedy = f"pip install 'qpsolvers[{name}]'"
        raise SolverNotInstalled(f"QP back end {name!r} is not installed: {remedy}; usable now: {usable}")
    raise UnknownName(f"unknown QP back end {name!r}; usable are {usable}")


class Daqp:
    """Dual active-set method (Arnström et al. 2022), with bounds as bounds.

    Every call is a cold start: daqp's own workspace and active set saved about 2 µs a call, but after a bound of the
    active set had become infinite, points were reported as optimal that were off the minimum by more than 1 rad/s.
    """

    def __init__(self) -> None:
        self._allocate(64)

    def _allocate(self, size: int) -> None:
        """Allocate memory for `size` constraints."""
        self._above, self._below = np.full(size, _INFINITY), np.empty(size)
        self._sense = np.zeros(size, dtype=ctypes.c_int)

    def __call__(self, P: Array, q: Array, G: Array, h: Array, lower: Array, upper: Array) -> Array | None:
        """Compute the solution of a QP, see `Backend`; None where daqp finds none."""
        n, size = len(q), len(q) + len(h)
        if size > len(self._sense):
            self._allocate(2 * size)
        above, below = self._above[:size], self._below[:size]
        above[:n], above[n:] = upper, _INFINITY
        below[:n], below[n:] = lower, h
        x, _, flag, _ = daqp.solve(P, q, G, above, below, self._sense[:size], primal_tol=1e-9, dual_tol=1e-12)
        return np.asarray(x) if flag == 1 else None


def solve_daqp(P: Array, q: Array, G: Array, h: Array, lower: Array, upper: Array) -> Array | None:
    """Compute the same as `Daqp`, without memory between calls."""
    return Daqp()(P, q, G, h, lower, upper)


def through_qpsolvers(name: str, options: dict[str, Any] | None = None) -> Backend:
    """Return a back end of qpsolvers.

    Args:
        name: as in `qpsolvers.available_solvers`.
        options: arguments of the back end; tight tolerances if left out.
    """
    import qpsolvers
    from scipy.sparse import csc_matrix

    options = _TIGHT.get(name, {}) if options is None else options
    is_sparse = name in qpsolvers.sparse_solvers and name not in qpsolvers.dense_solvers
    convert = csc_matrix if is_sparse else np.asarray

    def solve(P: Array, q: Array, G: Array, h: Array, lower: Array, upper: Array) -> Array | None:
        if not all(np.isfinite(array).all() for array in (P, q, G, h)) or (lower > upper).any():
            return None  # some iterate on these to their limit
        n = len(q)
        if name == "osqp":
            P, q, G, lower, upper = _with_an_active_bound(P, q, G, lower, upper)
        rows = {"G": convert(-G), "h": -h} if len(h) else {}
        problem = qpsolvers.Problem(convert(P), q, **rows, lb=lower, ub=upper)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # "no solution" is an answer here, and not to be printed
            try:
                solution = qpsolvers.solve_problem(problem, solver=name, **options)
            except qpsolvers.exceptions.QPError:
                return None
        return solution.x[:n] if solution.found else None

    return solve


def _with_an_active_bound(
    P: Array, q: Array, G: Array, lower: Array, upper: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """Add a variable that is at its upper bound by its cost.

    Where no row at all is active, osqp prints a line to the output of the process, at any settings (osqp/osqp#785).
    """
    n = len(q)
    hessian = np.eye(n + 1)
    hessian[:n, :n] = P
    rows = np.column_stack((G, np.zeros(len(G))))
    return hessian, np.append(q, -1.0), rows, np.append(lower, -np.inf), np.append(upper, 0.0)


def verified(backend: Backend, P: Array, q: Array, G: Array, h: Array, lower: Array, upper: Array) -> Array | None:
    """Compute the solution of a QP, see `Backend`, clipped to its bounds.

    Returns:
        (n,); None where the back end fails, whatever it raises, or a violation is above `TOLERANCE`.
    """
    try:
        v = backend(P, q, G, h, lower, upper)
    except Exception:  # the robot must get a velocity
        return None
    if v is None or np.shape(v) != q.shape or not kernels.violation(v, G, h, lower, upper) <= TOLERANCE:
        return None  # NaN fails the comparison too
    return np.asarray(np.minimum(np.maximum(v, lower), upper))


def within(backend: Backend, Z: Array, start: Array) -> Backend:
    """Return a back end whose answers are x = start + Z w: equality constraints are met exactly.

    Bounds become rows, as w has other coordinates than x.

    Args:
        backend: solves for w.
        Z: (n, k) orthonormal columns.
        start: (n,).
    """

    def solve(P: Array, q: Array, G: Array, h: Array, lower: Array, upper: Array) -> Array | None:
        rows, right = reduced_rows(Z, start, G, h, lower, upper)
        free = np.full(Z.shape[1], np.inf)
        w = backend(Z.T @ P @ Z, Z.T @ (q + P @ start), rows, right, -free, free)
        return None if w is None else start + Z @ w

    return solve


def reduced_rows(Z: Array, start: Array, G: Array, h: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
    """Return rows and right-hand sides in w of G x >= h, then of the finite bounds, for x = start + Z w."""
    below, above = lower - start, start - upper
    bounded_below, bounded_above = np.isfinite(below), np.isfinite(above)
    rows = np.concatenate((G @ Z, Z[bounded_below], -Z[bounded_above]))
    right = np.concatenate((h - G @ start, below[bounded_below], above[bounded_above]))
    return np.ascontiguousarray(rows), right
