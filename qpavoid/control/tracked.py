"""Velocities that are tracked in place of the tracking law's: of several priorities, or within jerk limits."""

from __future__ import annotations

from typing import Any

import numpy as np

from qpavoid import kernels
from qpavoid.control.distances import DistanceQuery
from qpavoid.control.dynamics import RobotDynamics
from qpavoid.control.jerk_stops import JerkStops
from qpavoid.kernels.layout import RowLayout
from qpavoid.problem import Array, AvoidanceRows, IntArray, Problem
from qpavoid.solvers.hqp import cascade

_LACKING = 1e-6
"""Share of a task's velocity up to which it lacks nothing [-]: round-off of the tracking law."""


class TrackedVelocities:
    """Part of a `RowAssembler`: changes the tracked velocity of a problem that is written already."""

    query: DistanceQuery
    dynamics: RobotDynamics | None
    frame_errors: Array
    row_scale: Array
    _layout: RowLayout
    packed: Any
    _stops: JerkStops | None
    _b_feasible: Array

    def _velocity(self, A: Array, b: Array) -> Array:
        """Return the velocity (nv,) of the tracking law for rows A (r, nv) and b (r,), zero but for some tasks."""
        x, feedback = self._layout, self._layout.feedback.copy()
        x.feedback[~A[: len(feedback)].any(axis=1)] = 0.0
        v = np.empty(A.shape[1])
        kernels.tracking_law(self.packed, A, b, v, self._b_feasible)
        x.feedback[:] = feedback
        return v

    def _bending(self, rows: IntArray, v: Array) -> Array:
        """Return -dt G(r) / ‖A‖² (nv, nv): what motion costs the task rows at second order, with r what v lacks."""
        x, frames = self._layout, rows[rows < len(self.frame_errors)]
        lacking, asked = np.zeros_like(self.frame_errors), self._b_feasible[frames]
        lacking[frames] = self.row_scale[frames] * (asked - x.A[frames] @ v)
        if not np.linalg.norm(lacking) > _LACKING * np.linalg.norm(asked):
            return np.zeros_like(self._layout.identity)
        return -x.dt / float(np.linalg.norm(x.A[rows], 2)) ** 2 * self.curvature(lacking)

    def curvature(self, w: Array) -> Array:
        """Return Σ w_r ∂²x_r/∂q² (nv, nv) of the rows of all frames; see `kernels.add_curvature`."""
        G = np.zeros_like(self._layout.identity)
        for part in range(len(w) // 3):
            kernels.add_curvature(self.packed, part, w[3 * part : 3 * part + 3], G)
        return G

    def within_jerks(self, problem: Problem) -> Problem:
        """Return the problem of this step with a tracking velocity that jerks allow, see `JerkStops.reachable`."""
        v_tracking = problem.v_tracking
        if self._stops is None or v_tracking[0] != v_tracking[0]:
            return problem
        reachable = self._stops.reachable(v_tracking)
        if problem.contacts is not None:
            reachable = problem.contacts.project(reachable)
        change = problem.tracking.A @ (reachable - v_tracking)
        tracking = problem.tracking._replace(b=problem.tracking.b + change)
        problem = problem._replace(
            tracking=tracking, avoidance=self._tracking_rows(problem.avoidance, reachable), v_tracking=reachable
        )
        return problem._replace(violation=_violation(problem))

    def prioritised(self, problem: Problem) -> Problem:
        """Return the problem of this step with the velocities of its priorities, and rows for the last one.

        Args:
            problem: of several levels, as `compute` gave it.
        """
        velocities = cascade(problem, self._velocity, self._bending)
        if self.dynamics is not None:
            velocities = self.dynamics.approach(velocities, self._layout.v_prev)
        v, rows = velocities[-1], self._tracking_rows(problem.avoidance, velocities[-1])
        problem = problem._replace(avoidance=rows, v_tracking=v, cascade=velocities, tracking_is_clear=False)
        return problem._replace(violation=_violation(problem))

    def _tracking_rows(self, rows: AvoidanceRows, v: Array) -> AvoidanceRows:
        """Return the rows for another tracked velocity (nv,); the same ones if they do not depend on it."""
        x, k = self._layout, len(rows.d)
        if not (x.task_switching and k):
            return rows
        memory = x.v_tracking, x.rhs[:k], x.rhs_contact[:k]
        saved = [array.copy() for array in memory]
        x.v_tracking[:] = v
        kernels.row_bounds(self.packed, k, self.query.is_moving)
        if self.dynamics is not None:
            kernels.slow_rows(self.packed, self.dynamics.packed, k)
        rows = rows._replace(b=x.rhs[:k].copy(), b_contact=x.rhs_contact[:k].copy())
        for array, values in zip(memory, saved, strict=True):
            array[:] = values
        return rows


def _violation(problem: Problem) -> float:
    """Return the largest violation of a row or bound by v_tracking."""
    return float(kernels.violation(problem.v_tracking, *problem.inequalities, problem.lower, problem.upper))
