"""Dynamics of a control step, as solvers see them: torques are linear in the velocity at the end of the period."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


class StepDynamics(NamedTuple):
    """M a + h = Sᵀ τ with a = (v - v_measured) / dt: S selects the actuated coordinates.

    The rows J v >= b are those of the torques, which are never relaxed, then those that keep gravity holdable. Torque
    rows are M_a v over the sum of |M_a| in a row, so that what they lack is a velocity.
    """

    M: Array
    """(nv, nv) mass matrix, armature included."""
    h: Array
    """(nv,) Coriolis, centrifugal and gravity torques [Nm or N]."""
    v_measured: Array
    """(nv,) velocity at the begin of the control period [rad/s or m/s]."""
    dt: float
    """Control period [s]."""
    actuated: npt.NDArray[np.intp]
    """(a,) coordinates with a motor."""
    torque_limit: Array
    """(a,) largest torque in either direction, infinite without one [Nm or N]."""
    J: Array
    """(m, nv) rows: for each actuated coordinate of the least torque, then of the greatest; those of holding."""
    b: Array
    """(m,) their right-hand sides [rad/s or m/s; 1/s]."""
    torque_rows: int
    """How many of the rows are those of torques, and of friction cones after them."""
    points: tuple[str, ...] = ()
    """Frame of each contact point, of the six rows of its cone."""

    def torque(self, v: Array) -> Array:
        """Return the torques (a,) that lead to v (nv,) at the end of the period [Nm or N]."""
        i = self.actuated
        return np.asarray(self.M[i] @ (v - self.v_measured) / self.dt + self.h[i])

    def with_holding(self, b: Array) -> StepDynamics:
        """Return the same with other right-hand sides of the holding rows; none, without these rows."""
        n = self.torque_rows
        return self._replace(J=self.J[: n + len(b)], b=np.concatenate((self.b[:n], b)))


def mirrored(M: Array) -> Array:
    """Return the symmetric matrix (n, n) of which only the upper triangle is written, as Pinocchio does."""
    return np.asarray(np.triu(M) + np.triu(M, 1).T)
