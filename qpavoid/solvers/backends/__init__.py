"""QP back ends behind one call: min ½ xᵀP x + qᵀx subject to G x >= h, lower <= x <= upper.

daqp, proxqp and osqp are called without a wrapper, the last two with a workspace for each size that is kept and warm
started; every other one goes through qpsolvers. All are asked for tight tolerances: what they return is a velocity,
and a velocity that is off by 1e-2 rad/s is a fault even where the solver reports success.
"""

from __future__ import annotations

from collections.abc import Callable

import qpsolvers

from qpavoid.errors import SolverNotInstalled, UnknownName
from qpavoid.problem import Array
from qpavoid.solvers.backends.direct import Daqp, solve_daqp
from qpavoid.solvers.backends.persistent import OsqpWorkspace, Persistent, ProxqpWorkspace
from qpavoid.solvers.backends.wrapped import through_qpsolvers

Backend = Callable[[Array, Array, Array, Array, Array, Array], "Array | None"]
"""(P, q, G, h, lower, upper) -> x, or None where no solution was found.

P (n, n) is symmetric and positive definite, G (m, n) C-contiguous; m may be 0 and change from call to call; bounds may
be infinite. One of these belongs to one thread: it keeps memory between calls, but no call depends on another one.
"""

_NATIVE: dict[str, Callable[[], Backend]] = {
    "daqp": Daqp,
    "proxqp": lambda: Persistent(ProxqpWorkspace),
    "osqp": lambda: Persistent(OsqpWorkspace),
}
"""Back ends that are called without qpsolvers."""

_PACKAGES = {"jaxopt_osqp": "jaxopt", "mosek": "Mosek", "highs": "highspy", "gurobi": "gurobipy", "proxqp": "proxsuite",
             "qpoases": "qpoases", "hpipm": "hpipm-python"}  # fmt: skip
"""Packages to install, where their name is not that of the back end."""
_KNOWN = {
    *("clarabel", "cvxopt", "ecos", "gurobi", "highs", "hpipm", "jaxopt_osqp", "kvxopt", "mosek", "nppro", "osqp"),
    *("pdlp", "piqp", "proxqp", "pyqpmad", "qpalm", "qpax", "qpoases", "qpswift", "quadprog", "scs", "sip"),
}
"""Names that qpsolvers gives to back ends which may not be installed."""


def backend_names() -> list[str]:
    """Back ends that can be used here, daqp first."""
    return ["daqp", *sorted({*_NATIVE, *qpsolvers.available_solvers} - {"daqp"})]


def make_backend(name: str) -> Backend:
    """A new back end of that name.

    Raises:
        SolverNotInstalled: qpsolvers knows it, but its package is missing.
        UnknownName: nobody knows it.
    """
    if name in _NATIVE:
        return _NATIVE[name]()
    if name in qpsolvers.available_solvers:
        return through_qpsolvers(name)
    usable = ", ".join(backend_names())
    if name in _KNOWN:
        raise SolverNotInstalled(
            f"QP back end {name!r} is not installed: pip install {_PACKAGES.get(name, name)}; usable now: {usable}"
        )
    raise UnknownName(f"unknown QP back end {name!r}; usable are {usable}")


__all__ = ["Backend", "Daqp", "backend_names", "make_backend", "solve_daqp"]
