"""What the controller has to know of a solver."""

from __future__ import annotations

from typing import Any

from qpavoid.errors import ConfigError
from qpavoid.problem import Array, Problem, Solution


class Solver:
    """A control law: one velocity for each problem.

    One of your own needs `solve`; it inherits the other answers, which suit a law that knows nothing of limits.
    """

    bounded: bool = False
    """Whether its velocity is within the problem's bounds, so that it is looked ahead and may need a backup trajectory;
    of others, the velocity is scaled and clipped to the bounds."""
    holds_contacts: bool = False
    """Whether its velocity meets `Problem.contacts`; only such a law may drive a robot with contacts."""
    prioritised: bool = False
    """Whether it tracks `Problem.levels` in their order, so that `Problem.cascade` is there, and v_tracking is the last
    velocity of it."""

    compiled_regularization: float = 0.0
    """λ of a law that is v_tracking where `Problem.violation` is not positive, and else the QP of `kernels.project`: a
    control step then solves it by itself, and calls `solve` where that QP is infeasible or a check fails; 0 of all
    others."""

    def solve(self, problem: Problem) -> Solution:
        """Return the velocity of one control step; never raise on a well-formed problem.

        Args:
            problem: rows, bounds and tracking velocity of the step.
        """
        raise NotImplementedError(f"{type(self).__name__} has no `solve`")

    def low_effort(self, problem: Problem, slack: Array | None) -> Array | None:
        """Return a solution (nv,) of less joint motion for the stop look-ahead to try; None without any.

        Args:
            problem: as for `solve`.
            slack: violation of the rows (k,) [m/s] that `solve` has settled for; None where there is none.
        """
        return None

    @property
    def label(self) -> str:
        """Name for messages."""
        return type(self).__name__


class NamedSolver(Solver):
    """A solver that scenarios name, made from its block."""

    def __init__(self, config: Any) -> None:
        self.config = config

    @property
    def label(self) -> str:
        """Short form, as in `qp:proxqp`."""
        return str(self.config.label)


def check_solver(solver: Solver, contacts: bool) -> None:
    """Check that a solver can be used; `contacts` is whether the robot has any.

    Raises:
        ConfigError: it lacks something of `Solver`, or does not hold contacts.
    """
    try:
        _ = solver.solve, solver.bounded, solver.prioritised, solver.low_effort, solver.compiled_regularization
        cannot_hold = contacts and not solver.holds_contacts
    except AttributeError as error:
        name = type(solver).__name__
        raise ConfigError(f"solver: {name} has no `{error.name}`; derive it from `qpavoid.Solver`") from None
    if cannot_hold:
        raise ConfigError(f"contacts: solver {solver.label!r} cannot hold them; use qp or hqp")
