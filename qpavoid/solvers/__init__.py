"""Solvers, the exchangeable part of a control step: Problem in, Solution out.

A solver derives from `Solver`; those that ship are listed in SOLVERS and chosen by name.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from pydantic import TypeAdapter, ValidationError

from qpavoid.config import SolverConfig, expand_solver
from qpavoid.config.loading import solver_fields
from qpavoid.config.solver import SolverBlock
from qpavoid.errors import ConfigError, UnknownName, nearest
from qpavoid.solvers.analytic import Eq10, TrackingOnly
from qpavoid.solvers.backends import backend_names
from qpavoid.solvers.baselines import GradientProjection, PotentialField
from qpavoid.solvers.hqp import Hqp
from qpavoid.solvers.qp import Qp
from qpavoid.solvers.solver import Solver, check_solver
from qpavoid.solvers.step_search import StepSearch

SOLVERS: dict[str, Callable[[Any], Solver]] = {
    "tracking": TrackingOnly,
    "eq10": Eq10,
    "eq10-literal": Eq10,
    "gradient-projection": GradientProjection,
    "potential-field": PotentialField,
    "step-search": StepSearch,
    "qp": Qp,
    "hqp": Hqp,
}


def parse_solver(name: str, settings: SolverConfig | None = None) -> SolverConfig:
    """Return the configuration of a short form such as `eq10` or `qp:proxqp`.

    Args:
        name: the short form.
        settings: used where they are of the same solver, but for what `name` says.

    Raises:
        ConfigError, UnknownName: there is no such solver, or it takes no back end.
    """
    fields = expand_solver(name)
    if settings is not None and settings.name == fields["name"]:
        fields = {**settings.model_dump(), **fields}
    try:
        return TypeAdapter[SolverConfig](SolverConfig).validate_python(fields)
    except ValidationError:
        if fields["name"] in SOLVERS:
            raise ConfigError(f"solver {name!r}: {fields['name']} takes no backend; only qp and hqp do") from None
        raise UnknownName(f"unknown solver {name!r}{nearest(fields['name'], SOLVERS)}") from None


def make_solver(config: SolverConfig | Mapping[str, Any] | str) -> Solver:
    """Return a new solver of a configuration block or a short form.

    Args:
        config: what the field `solver` of a scenario may be: its block, also as a mapping, or its short form.

    Raises:
        ConfigError, UnknownName, SolverNotInstalled: of the solver or the QP's back end.
    """
    if isinstance(config, str):
        config = parse_solver(config)
    elif isinstance(config, Mapping):
        config = solver_fields(config)
    elif not isinstance(config, SolverBlock):
        raise ConfigError(f"solver: {type(config).__name__} is none; give a name, as in qp, or a mapping of its fields")
    return SOLVERS[config.name](config)


def as_solver(solver: Solver | SolverConfig | Mapping[str, Any] | str) -> Solver:
    """Return a law as it is, and what `make_solver` makes of anything else that it takes."""
    return make_solver(solver) if isinstance(solver, str | Mapping | SolverBlock) else solver


__all__ = ["SOLVERS", "Solver", "as_solver", "backend_names", "check_solver", "make_solver", "parse_solver"]
