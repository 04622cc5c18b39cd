"""QP back ends behind one call: min ½ xᵀP x + qᵀx subject to G x >= h, lower <= x <= upper.

daqp is called directly; every other one goes through qpsolvers. All are asked for tight tolerances: what they return
is a velocity, and a velocity that is off by 1e-2 rad/s is a fault even where the solver reports success.
"""

from __future__ import annotations

import ctypes
import warnings
from collections.abc import Callable
from typing import Any

import daqp
import numpy as np
import qpsolvers
from scipy.sparse import csc_matrix

from qpavoid.errors import SolverNotInstalled, UnknownName
from qpavoid.problem import Array

Backend = Callable[[Array, Array, Array, Array, Array, Array], "Array | None"]
"""(P, q, G, h, lower, upper) -> x, or None where no solution was found."""

_TIGHT: dict[str, dict[str, Any]] = {
    "proxqp": {"eps_abs": 1e-10, "eps_rel": 0.0},
    "osqp": {"eps_abs": 1e-9, "eps_rel": 1e-9, "max_iter": 20000, "polishing": True, "raise_error": False},
    "piqp": {"eps_abs": 1e-9, "eps_rel": 1e-10},
    "clarabel": {"tol_gap_abs": 1e-10, "tol_gap_rel": 1e-10, "tol_feas": 1e-10},
    "scs": {"eps_abs": 1e-9, "eps_rel": 1e-10},
}
"""Tolerances by back end; exact (active-set) ones need none."""


def backend_names() -> list[str]:
    """Back ends that can be used here, daqp first."""
    return ["daqp", *sorted(name for name in qpsolvers.available_solvers if name != "daqp")]


def make_backend(name: str) -> Backend:
    """The back end of that name.

    Raises:
        SolverNotInstalled: qpsolvers knows it, but its package is missing.
        UnknownName: nobody knows it.
    """
    if name == "daqp":
        return solve_daqp
    if name in qpsolvers.available_solvers:
        return _through_qpsolvers(name)
    usable = ", ".join(backend_names())
    if name in _KNOWN:
        raise SolverNotInstalled(
            f"QP back end {name!r} is not installed: pip install {_PACKAGES.get(name, name)}; usable now: {usable}"
        )
    raise UnknownName(f"unknown QP back end {name!r}; usable are {usable}")


_PACKAGES = {"jaxopt_osqp": "jaxopt", "mosek": "Mosek", "highs": "highspy", "gurobi": "gurobipy", "proxqp": "proxsuite",
             "qpoases": "qpoases", "hpipm": "hpipm-python"}  # fmt: skip
"""Packages to install, where their name is not that of the back end."""
_KNOWN = {
    *("clarabel", "cvxopt", "ecos", "gurobi", "highs", "hpipm", "jaxopt_osqp", "kvxopt", "mosek", "nppro", "osqp"),
    *("pdlp", "piqp", "proxqp", "pyqpmad", "qpalm", "qpax", "qpoases", "qpswift", "quadprog", "scs", "sip"),
}
"""Names that qpsolvers gives to back ends which may not be installed."""

_DAQP_INFINITY = 1e30


def solve_daqp(P: Array, q: Array, G: Array, h: Array, lower: Array, upper: Array) -> Array | None:
    """Dual active-set method (Arnström et al. 2022), called without a wrapper; bounds stay bounds."""
    above = np.full(len(q) + len(h), _DAQP_INFINITY)
    below = np.concatenate((lower, h))
    above[: len(q)] = upper
    sense = np.zeros(len(above), dtype=ctypes.c_int)
    x, _, flag, _ = daqp.solve(P, q, G, above, below, sense, primal_tol=1e-9, dual_tol=1e-12)
    return np.asarray(x) if flag == 1 else None


def _through_qpsolvers(name: str) -> Backend:
    options = _TIGHT.get(name, {})
    sparse = name in qpsolvers.sparse_solvers and name not in qpsolvers.dense_solvers

    def solve(P: Array, q: Array, G: Array, h: Array, lower: Array, upper: Array) -> Array | None:
        as_given = csc_matrix if sparse else np.asarray
        rows = {"G": as_given(-G), "h": -h} if len(h) else {}
        problem = qpsolvers.Problem(as_given(P), q, **rows, lb=lower, ub=upper)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # "no solution" is an answer here, not news for the terminal
            try:
                solution = qpsolvers.solve_problem(problem, solver=name, **options)
            except qpsolvers.exceptions.QPError:
                return None
        return solution.x if solution.found else None

    return solve
