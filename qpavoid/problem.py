"""Value types of a control step. numpy only: a problem can be recorded, replayed and benchmarked without a robot.

They are named tuples, frozen and three times as quick to make as frozen dataclasses: a control step makes seven.

Everything is expressed in the joint velocity v, shape (nv,) [rad/s or m/s].
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from math import hypot
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from qpavoid.budget import UNLIMITED, Budget
from qpavoid.dynamics import StepDynamics
from qpavoid.errors import NumericalError
from qpavoid.reason import Reason, Severity

Array = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.intp]
Mask = npt.NDArray[np.bool_]
_MAX_NORM = 1e150
"""Norm from which a velocity counts as overflow [rad/s, m/s]: squares of smaller ones are finite."""


class Status(str, Enum):
    """Outcome of a control step."""

    SOLVED = "SOLVED"
    """Every constraint is met."""
    RELAXED = "RELAXED"
    """The rows contradict each other or the limits; `reasons` names those that are relaxed, and by how much."""
    STOPPED = "STOPPED"
    """No velocity is known to be safe: the robot brakes to a standstill within its acceleration and jerk limits."""


class State(NamedTuple):
    """Measured state of the robot: configuration q (nq,), velocity v (nv,), time t [s]."""

    q: Array
    v: Array
    t: float


class Proximity(NamedTuple):
    """Witness points and distance rates of the k pairs within the influence distance.

    For bodies (a, b) the distance changes at ḋ = n·(ṗ_b - ṗ_a) = J v + `feedforward`, n the unit normal from a to b,
    also in penetration.
    """

    pair: IntArray
    """(k,) index of each pair among those of the scene, in increasing order."""
    closest: Array
    """(k, 10) distance, normal and witness points of each pair; see the properties below."""
    J: Array
    """(k, nv) velocity Jacobian of the distances [m/rad or 1]."""
    feedforward: Array
    """(k,) rate of these distances due to the motion of the obstacles [m/s]."""

    @property
    def distance(self) -> Array:
        """Return the signed distance between surfaces (k,) [m], negative in penetration."""
        return self.closest[:, 0]

    @property
    def normal(self) -> Array:
        """Return the unit normal from body a to body b (k, 3), world axes."""
        return self.closest[:, 1:4]

    @property
    def point_a(self) -> Array:
        """Return the witness point on body a (k, 3), world [m]."""
        return self.closest[:, 4:7]

    @property
    def point_b(self) -> Array:
        """Return the witness point on body b (k, 3), world [m]."""
        return self.closest[:, 7:10]


class Tracking(NamedTuple):
    """Rows A v = b of the tracking tasks, each scaled with the root of its weight: the cost is ‖A v - b‖²."""

    A: Array
    """(r, nv) task Jacobian W½ J."""
    b: Array
    """(r,) task velocity W½ ẋ: feed-forward plus feedback [m/s, rad/s]."""
    b_feasible: Array
    """(r,) `b`, of each task scaled down to what the speeds of the joints allow, its direction kept."""


class Contacts(NamedTuple):
    """Rows J v = b of the frames in contact, of the highest priority, solved: v = v_particular + Z w."""

    Z: Array
    """(nv, n) orthonormal basis of the null space of J: velocities at which no contact moves."""
    v_particular: Array
    """(nv,) the least velocity with J v = b: zero, or the correction of frames that have slid [rad/s or m/s]."""
    J: Array
    """(c, nv) Jacobian of the frames in contact."""
    b: Array
    """(c,) velocity of these frames that corrects their sliding [m/s, rad/s]."""

    def project(self, v: Array) -> Array:
        """Return the velocity (nv,) closest to v with J v = b: v itself if it meets that to `CONTACT_TOLERANCE`."""
        if np.abs(self.J @ v - self.b).max(initial=0.0) <= CONTACT_TOLERANCE:
            return v
        return np.asarray(self.v_particular + self.Z @ (self.Z.T @ v))


CONTACT_TOLERANCE = 1e-6
"""Velocity of a contact up to which it counts as at rest [m/s, rad/s]: the tolerance of a QP, 0.001 mm in a second."""


class AvoidanceRows(NamedTuple):
    """Rows J v >= b for the k pairs within the influence distance."""

    pair: IntArray
    """(k,) index of the pair in `Problem.pair_names`, in increasing order."""
    d: Array
    """(k,) distance that the gains take: between surfaces, plus the scenario's offset [m]."""
    J: Array
    """(k, nv) velocity Jacobian of the distances [m/rad or 1]."""
    b: Array
    """(k,) lower bound on J v: that on ḋ minus the feed-forward [m/s]."""
    d1: float
    """Distance below which β is 1 [m]."""
    d2: float
    """Influence distance: α and β are 0 beyond it [m]."""
    b_contact: Array
    """(k,) lower bound on J v that keeps the pair from contact: that of a row without a margin; at most `b` [m/s]."""


class Problem(NamedTuple):
    """Everything that a solver may know about a control step."""

    tracking: Tracking
    """Rows of the tasks."""
    avoidance: AvoidanceRows
    """Rows of the pairs within the influence distance."""
    lower: Array
    """(nv,) lower bound on v from all joint limits; never above `upper`."""
    upper: Array
    """(nv,) upper bound on v."""
    hard_lower: Array
    """(nv,) lower bound from position and velocity limits alone; `lower` lies between these two."""
    hard_upper: Array
    """(nv,) upper bound from the same."""
    v_stop: Array
    """(nv,) next velocity of a stop: all coordinates slowed by one factor within acceleration and jerk limits."""
    pair_names: Sequence[tuple[str, str]]
    """Names of the bodies of all m pairs."""
    joint_names: Sequence[str]
    """Name of each of the nv coordinates."""
    joint_units: Sequence[str]
    """Unit of each of the nv coordinates: rad or m."""
    v_tracking: Array
    """(nv,) J⁺ẋ, the tracking law's velocity; NaN where a task row has one."""
    violation: float
    """Largest violation of a row or bound by v_tracking [m/s, rad/s]; not positive where it is safe, NaN with it."""
    contacts: Contacts | None = None
    """Contacts of the robot, None without any; v_tracking meets them."""
    levels: tuple[IntArray, ...] = ()
    """Indices of the rows of `tracking` of each priority, the first one first; empty where all have the same."""
    cascade: Array | None = None
    """(levels, nv) velocity of the tasks down to each of these priorities; None where it was not asked for."""
    bent: float = 0.0
    """How far the task rows bend within the control step: the least λ of a QP that tracks [-]."""
    jerk_limited: bool = False
    """Whether `lower` and `upper` contain jerk limits, too."""
    tracking_is_clear: bool = False
    """Whether v_tracking is safe, and a bound shows that no pair comes too near along it and a stop from it."""
    position_margin: float = np.inf
    """Distance to the nearest position limit [rad, m]; negative where a coordinate is outside."""
    budget: Budget = UNLIMITED
    """Time that is left of the control step: a law that takes longer may `check` it, which ends the step."""
    dynamics: StepDynamics | None = None
    """Dynamics of the robot, with rows that a law has to meet beside those of `avoidance`; None at velocity level."""

    @property
    def inequalities(self) -> tuple[Array, Array]:
        """Return all rows J (k + m, nv) and b (k + m,) with J v >= b: of the pairs, then of the dynamics."""
        (_, _, J, b, *_), x = self.avoidance, self.dynamics
        return (J, b) if x is None else (np.concatenate((J, x.J)), np.concatenate((b, x.b)))


def make_problem(
    tracking: Tracking,
    avoidance: AvoidanceRows,
    lower: Array,
    upper: Array,
    pair_names: Sequence[tuple[str, str]],
    hard: tuple[Array, Array] | None = None,
    v_stop: Array | None = None,
) -> Problem:
    """Make a problem by hand, or from changed rows.

    v_tracking is J⁺ẋ of the feasible task velocity, with the Moore-Penrose inverse.

    Args:
        tracking: task rows.
        avoidance: avoidance rows.
        lower: (nv,) lower bound on v.
        upper: (nv,) upper bound on v.
        pair_names: names of the bodies of all pairs.
        hard: bounds (nv,), (nv,) without acceleration and jerk limits; `lower` and `upper` if left out.
        v_stop: next velocity of a stop (nv,); the least that the bounds allow if left out.
    """
    v_tracking = least_squares(tracking.A, tracking.b_feasible)
    outside = np.concatenate((v_tracking - upper, lower - v_tracking, avoidance.b - avoidance.J @ v_tracking))
    stop = np.clip(0.0, lower, upper) if v_stop is None else v_stop
    names = [f"joint{i + 1}" for i in range(len(lower))]
    return Problem(
        tracking, avoidance, lower, upper, *(hard or (lower, upper)), stop, pair_names, names, ["rad"] * len(names),
        v_tracking, float(outside.max()),
    )  # fmt: skip


def least_squares(A: Array, b: Array) -> Array:
    """Compute the least velocity (nv,) of least ‖A v - b‖; NaN where A or b has one.

    Args:
        A: rows (r, nv).
        b: right-hand sides (r,).
    """
    if not (np.isfinite(A).all() and np.isfinite(b).all()):
        return np.full(A.shape[1], np.nan)
    return np.asarray(np.linalg.pinv(A, rcond=1e-10) @ b)


class Solution(NamedTuple):
    """Velocity that a solver commands, and what it relaxed for it."""

    v: Array
    """(nv,) joint velocity [rad/s or m/s]."""
    status: Status = Status.SOLVED
    """Whether every constraint is met, some were relaxed, or the robot brakes to a standstill."""
    reasons: tuple[Reason, ...] = ()
    """What was relaxed, or why the robot stops; empty where neither."""
    slack: Array | None = None
    """(k,) violation of each avoidance row [m/s]; None where there is none."""
    command_scale: float = 1.0
    """Share of the solver's velocity in the command after slow recovery and stop look-ahead; the remainder is that of a
    stop [-]."""
    stalled: tuple[Reason, ...] = ()
    """Why the tasks make no progress, once they have made none for a while."""
    assumptions: tuple[Reason, ...] = ()
    """Assumptions of the step, such as the estimated twist of an obstacle that was given without one."""
    saturation: float = 0.0
    """Largest change of the solver's raw velocity by the limits [rad/s or m/s]; 0 of a `bounded` solver."""
    plan: str = ""
    """Plan that is followed in place of the tasks alone, and why, in a sentence; empty without one."""
    forecast: Array | None = None
    """(n, nq) configurations to which the tasks alone were expected to lead, from when it was decided; else None."""
    forces: dict[str, Array] | None = None
    """Force (k, 3) of the ground on each corner of a contact, by its frame, world [N]; None without such."""
    external: Array | None = None
    """(nv,) torque from outside, of a momentum observer [Nm or N]; None without one."""
    torque: Array | None = None
    """(n_actuated,) torques that lead to `v` [Nm or N], within their limits; None at velocity level."""
    acceleration: Array | None = None
    """(nv,) acceleration of these torques [rad/s² or m/s²]."""
    build_time: float = 0.0
    """Time to read the state and set up the problem [s]; of `qp` with the QP, where both are one compiled call."""
    solve_time: float = 0.0
    """Time to solve it, look-ahead included, as far as it was not done yet [s]."""

    @property
    def severity(self) -> Severity | None:
        """Return the worst severity of all reasons of the step; None without any."""
        severities = [reason.severity for reason in (*self.reasons, *self.stalled, *self.assumptions)]
        return max(severities) if severities else None

    def with_reasons(self, *reasons: Reason) -> Solution:
        """Return the solution with more reasons, as RELAXED; STOPPED stays STOPPED.

        Args:
            reasons: added to those of the solution.
        """
        status = self.status if self.status is Status.STOPPED else Status.RELAXED
        return self._replace(status=status, reasons=(*self.reasons, *reasons))

    @classmethod
    def solved(cls, v: Array, assumed: tuple[Reason, ...] = (), build: float = 0.0, solve: float = 0.0) -> Solution:
        """Return the solution of v (nv,), with assumptions and times [s], in half of the time that `Solution` takes."""
        return tuple.__new__(cls, (v, *_HEAD, assumed, *_TAIL, build, solve))

    def with_times(self, build_time: float, solve_time: float) -> Solution:
        """Return the solution with its times [s]; see the fields."""
        return tuple.__new__(Solution, (*self[:-2], build_time, solve_time))  # a fifth of the time of `_replace`


_HEAD, _TAIL = Solution(np.zeros(0))[1:6], Solution(np.zeros(0))[7:-2]


def as_numbers(name: str, value: Any) -> Array:
    """Return `value` as a float array of any shape and any numbers, NaN and infinity included.

    Raises:
        NumericalError: text, complex numbers, or no numbers; names the argument.
    """
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "biufO":
            raise TypeError
        return array.astype(np.float64, copy=False)
    except (TypeError, ValueError, OverflowError):
        raise NumericalError(f"{name}: not an array of numbers: {value!r:.60}") from None


def as_vector(name: str, value: Any, shape: tuple[int, ...]) -> Array:
    """Return `value` as a float array of `shape`, NaN and infinity included.

    Raises:
        NumericalError: wrong shape, or not numbers; names the argument.
    """
    if type(value) is np.ndarray and value.dtype == np.float64 and value.shape == shape:
        return value
    array = as_numbers(name, value)
    if array.shape != shape:
        raise NumericalError(f"{name}: shape {array.shape}, expected {shape}")
    return array


def is_finite_and_bounded(v: Array) -> bool:
    """Return True if the norm of v (n,) is below `_MAX_NORM`; for a few dozen numbers, quicker than numpy."""
    return hypot(*v.tolist()) < _MAX_NORM


def require_finite(name: str, value: Any, shape: tuple[int, ...]) -> Array:
    """Return `value` as a finite float array of `shape`.

    Raises:
        NumericalError: wrong shape, NaN or infinity; names the argument.
    """
    array = as_vector(name, value, shape)
    if not np.isfinite(array).all():
        raise NumericalError(f"{name}: {not_finite(array)}")
    return array


def not_finite(array: Array) -> str:
    """Return the fault of an array that is not `is_finite_and_bounded`, with the first five indices."""
    bad = np.argwhere(~np.isfinite(array)).ravel()[:5].tolist()
    return f"NaN or infinity at index {', '.join(map(str, bad))}" if bad else "too large"
