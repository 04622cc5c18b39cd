"""What gives way when rows and bounds contradict each other: margins, then accelerations, as evenly as they must.

First, all pairs get one distance to hold, which falls short of the safe one by no more than the worst of them forces:
the deepest threat decides, and no pair comes nearer than that for the sake of another one's margin. Then margins are
restored as far as that allows, by least squares. Both steps change continuously with the distances, so that the robot
does not jump between threats of the same depth. Acceleration limits give way only where pairs would touch otherwise:
given up earlier, they cost more by the jumps that follow than they gain. Position and velocity limits never give way.

Only a tick that has no safe velocity comes here: its three or six QPs take some tens of microseconds.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from qpavoid import kernels
from qpavoid.problem import Array, Problem
from qpavoid.solvers.backends import Backend

TOLERANCE = 1e-6
"""Largest violation of a row [m/s] or bound [rad/s] with which an answer still counts as a solution."""
_SMALL = 1e-6
"""Weight of the tracking cost beside that of what is given up."""
_TOUCHING = 0.2
"""Share of the safe distance down to which margins are given up before acceleration limits are [-]."""


class Relaxed(NamedTuple):
    """A velocity and what was given up for it."""

    v: Array
    """(n,)."""
    slack: Array
    """(k,) what each avoidance row gave way [m/s]."""
    excess: Array
    """(n,) by how much each coordinate passes what its acceleration limit allows [rad/s or m/s]."""


def relax(P: Array, q: Array, problem: Problem, backend: Backend) -> Relaxed | None:
    """The velocity that gives up least.

    Args:
        P: tracking cost (n, n).
        q: its gradient at 0 (n,).
        problem: rows and bounds that no velocity meets.
        backend: solves the QPs.

    Returns:
        None where the back end fails.
    """
    x, rows = problem, problem.avoidance
    lower, upper = x.lower, x.upper
    held, floor = _shared_floor(P, q, problem, lower, upper, backend)
    surface = rows.d1 - rows.clearance  # what d has more than the distance between surfaces
    if x.hard_lower is not x.lower and not held > surface + _TOUCHING * rows.clearance:
        excess = _least_excess(P, q, problem, surface + _TOUCHING * rows.clearance, backend)
        lower, upper = np.maximum(lower - excess, x.hard_lower), np.minimum(upper + excess, x.hard_upper)
        held, floor = _shared_floor(P, q, problem, lower, upper, backend)
    if floor is None:
        return None
    least = np.maximum(floor, rows.b - _least_slack(P, q, problem, floor, lower, upper, backend)) - TOLERANCE
    for b in (least, floor - TOLERANCE):
        v = closest(backend, P, q, rows.J, b, lower, upper)
        if v is not None:
            slack = np.maximum(rows.b - rows.J @ v, 0.0)
            return Relaxed(v, slack, np.maximum(np.maximum(v - x.upper, x.lower - v), 0.0))
    return None


def closest(backend: Backend, P: Array, q: Array, J: Array, b: Array, lower: Array, upper: Array) -> Array | None:
    """Minimiser of ½ vᵀP v + qᵀv within rows and bounds; None when the back end fails or its answer does not verify."""
    try:
        v = backend(P, q, J, b, lower, upper)
    except Exception:  # whatever a library raises, the robot must get a velocity
        return None
    if v is None or np.shape(v) != q.shape or not kernels.shortfall(v, J, b, lower, upper) <= TOLERANCE:
        return None  # NaN fails the comparison too
    within: Array = np.minimum(np.maximum(v, lower), upper)
    return within


def _approach(problem: Problem) -> Array:
    """What pairs (k,) may lose: to hold a distance z, J v >= ξ z - approach [m/s].

    A pair at distance d that is to hold z must have ḋ >= ξ (z - d). Pairs that are so deep that their rows are capped
    at the recovery speed count as if they were just so deep that they are not.
    """
    rows = problem.avoidance
    deepest = rows.hold - rows.recovery / rows.gain
    return np.asarray(rows.gain * np.maximum(rows.d, deepest) + rows.drift)


def _shared_floor(
    P: Array, q: Array, x: Problem, lower: Array, upper: Array, backend: Backend
) -> tuple[float, Array | None]:
    """The largest distance, up to the safe one, that all pairs can hold together [m], and rows J v >= floor for it."""
    n, rows, approach = len(q), x.avoidance, _approach(x)
    hessian = np.zeros((n + 1, n + 1))
    hessian[:n, :n], hessian[n, n] = _SMALL * P, 1.0
    gradient = np.concatenate((_SMALL * q, [-rows.gain * rows.hold]))
    J = np.hstack((rows.J, np.full((len(rows.d), 1), -1.0)))
    below, above = np.append(lower, -1e6), np.append(upper, rows.gain * rows.hold)
    answer = closest(backend, hessian, gradient, J, -approach, below, above)
    if answer is None:
        return -np.inf, None
    floor = np.minimum(np.minimum(rows.b, answer[n] - approach), rows.J @ answer[:n])
    return float(answer[n]) / rows.gain, floor


def _least_slack(P: Array, q: Array, x: Problem, floor: Array, lower: Array, upper: Array, backend: Backend) -> Array:
    """Slack (k,) of the rows J v >= b that is least in squares, with J v >= floor."""
    n, rows, k = len(q), x.avoidance, len(floor)
    hessian = np.zeros((n + k, n + k))
    hessian[:n, :n], hessian[n:, n:] = _SMALL * P, np.eye(k)
    J = np.zeros((2 * k, n + k))
    J[:k, :n], J[k:, :n], J[k:, n:] = rows.J, rows.J, np.eye(k)
    b = np.concatenate((floor - TOLERANCE, rows.b))
    below, above = np.concatenate((lower, np.zeros(k))), np.concatenate((upper, np.full(k, np.inf)))
    answer = closest(backend, hessian, np.concatenate((_SMALL * q, np.zeros(k))), J, b, below, above)
    v = np.full(n, np.nan) if answer is None else answer[:n]
    return np.where(np.isnan(v).any(), np.inf, np.maximum(rows.b - rows.J @ v, 0.0) + TOLERANCE)


def _least_excess(P: Array, q: Array, x: Problem, distance: float, backend: Backend) -> Array:
    """Least e >= 0 (n,), in units of the speeds, with which lower - e <= v <= upper + e lets all pairs hold `distance`.

    Infinite where nothing does: the velocity limits are all that is left then.
    """
    n, rows = len(q), x.avoidance
    room = np.maximum(x.upper - x.lower, 1e-9)
    eye = np.eye(n)
    J = np.block([[rows.J, np.zeros((len(rows.d), n))], [eye, eye], [-eye, eye]])
    asked = np.minimum(rows.gain * distance - _approach(x), rows.b)
    b = np.concatenate((asked, x.lower, -x.upper))
    finite = np.isfinite(b)
    hessian = np.zeros((2 * n, 2 * n))
    hessian[:n, :n], hessian[n:, n:] = _SMALL * P, np.diag(1.0 / room**2)
    below = np.concatenate((x.hard_lower, np.zeros(n)))
    above = np.concatenate((x.hard_upper, np.full(n, np.inf)))
    gradient = np.concatenate((_SMALL * q, np.zeros(n)))
    answer = closest(backend, hessian, gradient, np.ascontiguousarray(J[finite]), b[finite], below, above)
    return np.full(n, np.inf) if answer is None else np.asarray(answer[n:] + TOLERANCE)
