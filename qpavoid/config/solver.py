"""Solvers and their settings."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from qpavoid.config.base import Block, NonNegative, Positive


class SolverBlock(Block):
    """What all solvers share."""

    name: str

    @property
    def label(self) -> str:
        """Short form that names it."""
        backend = getattr(self, "backend", "auto")
        return self.name if backend == "auto" else f"{self.name}:{backend}"


class TrackingSolver(SolverBlock):
    """Damped least squares on the tracking task; does not avoid."""

    name: Literal["tracking"] = "tracking"


class Eq10Solver(SolverBlock):
    """Eq. 10: `eq10` with the consistent bracket and α while approaching only, `eq10-literal` as printed."""

    name: Literal["eq10", "eq10-literal"] = "eq10"
    damping: NonNegative = 0.05
    """λ of the damped (J_d N)⁺ [-]."""
    retreat_speed: NonNegative = 0.1
    """ẋ0: speed of backing away along the shortest distance [m/s]."""
    alpha_cap: Positive = 1e6
    """Largest α; eq. 11 grows without bound as d goes to 0 [-]."""


class GradientProjectionSolver(SolverBlock):
    """Tracking, with the gradient of the clearance in its null space (Liégeois 1977)."""

    name: Literal["gradient-projection"] = "gradient-projection"
    gain: NonNegative = 10.0
    """k: self-motion for each m/rad of gradient; joint limits may allow less [rad²/(m s)]."""


class PotentialFieldSolver(SolverBlock):
    """Tracking as attraction, and FIRAS repulsion from every pair in range (Khatib 1986)."""

    name: Literal["potential-field"] = "potential-field"
    gain: Positive = 1.0
    """Push of a pair at distance d1: joints move by J_dᵀ times as much [rad²/(m s)]."""
    cap: Positive = 5.0
    """Largest push of a pair, contact and penetration included [rad²/(m s)]."""


class StepSearchSolver(SolverBlock):
    """Step-wise search: of a grid of next joint steps, the collision-free one with the least error and motion."""

    name: Literal["step-search"] = "step-search"
    speed: Positive = 0.5
    """Longest step of a joint, as a velocity; a quarter and a sixteenth of it are tried, too [rad/s or m/s]."""
    motion_cost: NonNegative = 1e-3
    """μ: cost of the motion beside that of the task's error [(rad/s)⁻²]."""
    candidates: Annotated[int, Field(ge=1, le=100_000)] = 2000
    """Most steps that are compared [-]: with so many, as many joints as possible may move at the same time."""


class QpSolver(SolverBlock):
    """QP: tracking as cost, avoidance rows as inequalities, joint limits as bounds."""

    name: Literal["qp"] = "qp"
    backend: str = "auto"
    """`native` (compiled by numba), `daqp`, `proxqp`, `osqp`, `quadprog`, or whatever else qpsolvers finds
    installed; `auto` is `native`."""
    regularization: Positive = 1e-3
    """λ: cost of leaving the tracking velocity [(rad/s)⁻²]."""


class HqpSolver(SolverBlock):
    """Strict priorities: a cascade of QPs, one for each level of the tasks."""

    name: Literal["hqp"] = "hqp"
    backend: str = "auto"
    """Of the QP of each level, as of `qp`; `auto` and `native` are daqp for these, and compiled code where rows that
    contradict each other are relaxed."""
    regularization: Annotated[float, Field(ge=1e-7, le=1e3)] = 1e-3
    """λ: cost, at each level, of leaving the velocity that the tasks alone would have [(rad/s)⁻²]. As of `qp`, it keeps
    joints from full speed for the last mm/s of a level that obstacles hold up; it gives nothing to later levels."""


def expand_solver(value: Any) -> Any:
    """Expand a short form: `qp:proxqp` to {name: qp, backend: proxqp}, `eq10` to {name: eq10}."""
    if not isinstance(value, str):
        return value
    name, _, backend = value.partition(":")
    return {"name": name, "backend": backend} if backend else {"name": name}


_Solver = Annotated[
    TrackingSolver
    | Eq10Solver
    | GradientProjectionSolver
    | PotentialFieldSolver
    | StepSearchSolver
    | QpSolver
    | HqpSolver,
    Field(discriminator="name"),
]
SolverConfig = Annotated[_Solver, BeforeValidator(expand_solver, json_schema_input_type=str | _Solver)]


class SolverField(Block):
    """The field `solver` alone: as an argument of a program, or as an option."""

    solver: SolverConfig
