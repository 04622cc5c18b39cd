"""Value types of one tick. numpy only: a problem can be recorded, replayed and benchmarked without a robot.

They are named tuples, frozen and three times as quick to make as frozen dataclasses: a tick makes seven of them.

Everything is expressed in the joint velocity v, shape (nv,) [rad/s or m/s].
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from math import hypot
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from qpavoid.errors import NumericalError
from qpavoid.reason import Reason, Severity

Array = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.intp]
Mask = npt.NDArray[np.bool_]
_MAX_NORM = 1e150
"""Length that no vector of a robot has."""


class Status(str, Enum):
    """How a tick ended."""

    SOLVED = "SOLVED"
    """Every row and bound is met."""
    RELAXED = "RELAXED"
    """The rows contradict each other or the limits; `reasons` says which gave way and by how much."""
    STOPPED = "STOPPED"
    """No velocity can be answered for: the robot is braked to a standstill within its acceleration and jerk limits."""


class State(NamedTuple):
    """What is read from the robot: configuration q (nq,), velocity v (nv,), time t [s]."""

    q: Array
    v: Array
    t: float


class Proximity(NamedTuple):
    """Closest points of the k pairs within reach, and the rate of their distance.

    For bodies (a, b) the distance changes at ḋ = n·(ṗ_b - ṗ_a) = J v + drift, n the unit normal from a to b, also in
    penetration.
    """

    pair: IntArray
    """(k,) which of the scene's pairs, in increasing order."""
    closest: Array
    """(k, 10) distance, normal and witness points of each pair; see the properties below."""
    J: Array
    """(k, nv) velocity Jacobian of the distances [m/rad or 1]."""
    feedforward: Array
    """(k,) rate of these distances due to the obstacles' own motion [m/s]."""

    @property
    def distance(self) -> Array:
        """(k,) signed distance between surfaces [m], negative in penetration."""
        return self.closest[:, 0]

    @property
    def normal(self) -> Array:
        """(k, 3) unit normal from body a to body b, world axes."""
        return self.closest[:, 1:4]

    @property
    def point_a(self) -> Array:
        """(k, 3) witness point on body a, world [m]."""
        return self.closest[:, 4:7]

    @property
    def point_b(self) -> Array:
        """(k, 3) witness point on body b, world [m]."""
        return self.closest[:, 7:10]


class Tracking(NamedTuple):
    """Rows A v = b of the tracking tasks, each scaled with the root of its weight: the cost is ‖A v - b‖²."""

    A: Array
    """(r, nv) task Jacobian W½ J."""
    b: Array
    """(r,) task velocity W½ ẋ: feed-forward plus feedback [m/s, rad/s]."""
    damping: float
    """λ of the damped J⁺, the same for every solver [-]."""


class Contacts(NamedTuple):
    """Rows J v = b of the frames that rest, which come before everything else, solved: v = rest + Z w."""

    Z: Array
    """(nv, n) orthonormal basis of the velocities with which no contact moves."""
    rest: Array
    """(nv,) the least velocity with J v = b: zero but for what frames have slid."""
    J: Array
    """(c, nv)."""
    b: Array
    """(c,) [m/s, rad/s]."""

    def held(self, v: Array) -> Array:
        """The velocity (nv,) closest to v that holds the contacts; v itself where it does."""
        if np.abs(self.J @ v - self.b).max() <= CONTACT_TOLERANCE:
            return v
        return np.asarray(self.rest + self.Z @ (self.Z.T @ v))


CONTACT_TOLERANCE = 1e-6
"""Velocity of a contact up to which it counts as held [m/s, rad/s]."""


class AvoidanceRows(NamedTuple):
    """Rows J v >= b for the k pairs within the influence distance.

    `d` is the distance that the gains take: between surfaces plus the scenario's offset.
    """

    pair: IntArray
    """(k,) index of the pair in `Problem.pair_names`, in increasing order."""
    d: Array
    """(k,) [m]."""
    J: Array
    """(k, nv)."""
    b: Array
    """(k,) lower bound on ḋ less the drift [m/s]."""
    d1: float
    """Distance below which β is 1 [m]."""
    d2: float
    """Influence distance: α and β are 0 beyond it [m]."""
    touch: Array
    """(k,) lower bound on J v that keeps the pair from touching: that of a row with no margin; at most `b` [m/s]."""


class Problem(NamedTuple):
    """Everything that a solver may know about a tick."""

    tracking: Tracking
    avoidance: AvoidanceRows
    lower: Array
    """(nv,) lower bound on v from all joint limits; never above `upper`."""
    upper: Array
    """(nv,) upper bound on v."""
    hard_lower: Array
    """(nv,) lower bound from position and velocity limits alone; `lower` lies between these two."""
    hard_upper: Array
    """(nv,) upper bound from the same."""
    v_stop: Array
    """(nv,) next velocity of a stop: all coordinates slowed alike within their acceleration and jerk limits."""
    pair_names: Sequence[tuple[str, str]]
    """Names of the bodies of all m pairs."""
    joint_names: Sequence[str]
    """Name of each of the nv coordinates."""
    joint_units: Sequence[str]
    """Unit of each of the nv coordinates: rad or m."""
    v_tracking: Array
    """(nv,) J⁺ẋ, the tracking law's velocity; NaN where λ is 0 and rows repeat each other."""
    violation: float
    """By how much v0 violates the worst row or bound [m/s, rad/s]; not positive where it is safe, NaN with v0."""
    contacts: Contacts | None = None
    """What holds the contacts, where there are any; v0 does."""
    levels: tuple[IntArray, ...] = ()
    """Which rows of `tracking` belong to each priority, the first one first; empty where all have the same."""
    jerked: bool = False
    """Whether `lower` and `upper` keep to jerk limits, beside those of accelerations."""
    clear: bool = False
    """Whether v0 is safe and known to lead nowhere near anything, nor a stop from it."""
    room: float = np.inf
    """What is left to the nearest position limit [rad, m]; negative where a coordinate is outside."""


def make_problem(
    tracking: Tracking,
    avoidance: AvoidanceRows,
    lower: Array,
    upper: Array,
    pair_names: Sequence[tuple[str, str]],
    hard: tuple[Array, Array] | None = None,
    v_stop: Array | None = None,
) -> Problem:
    """A problem made by hand, or one whose rows were changed: works out v0 and its shortfall by their definitions.

    Args:
        tracking: task rows.
        avoidance: avoidance rows.
        lower: (nv,) lower bound on v.
        upper: (nv,) upper bound on v.
        pair_names: names of the bodies of all pairs.
        hard: bounds without acceleration and jerk limits; `lower` and `upper` if left out.
        v_stop: next velocity of a stop; as little as the bounds allow if left out.
    """
    A, b, damping = tracking
    gram = A @ A.T + damping**2 * np.eye(len(b))
    if not np.isfinite(gram).all() or (damping == 0.0 and len(b) and np.linalg.cond(gram) > 1e6):
        v_tracking = np.full(len(lower), np.nan)
    else:
        v_tracking = np.linalg.solve(gram, b) @ A
    outside = np.concatenate((v_tracking - upper, lower - v_tracking, avoidance.b - avoidance.J @ v_tracking))
    stop = np.clip(0.0, lower, upper) if v_stop is None else v_stop
    names = [f"joint{i + 1}" for i in range(len(lower))]
    return Problem(
        tracking, avoidance, lower, upper, *(hard or (lower, upper)), stop, pair_names, names, ["rad"] * len(names),
        v_tracking, float(outside.max()),
    )  # fmt: skip


class Solution(NamedTuple):
    """What a solver commands, and what it had to give up for it."""

    v: Array
    """(nv,) joint velocity [rad/s or m/s]."""
    status: Status = Status.SOLVED
    reasons: tuple[Reason, ...] = ()
    """What was relaxed, or why the robot stops; empty when nothing was."""
    slack: Array | None = None
    """(k,) what each avoidance row gave way [m/s]; None when none did."""
    share: float = 1.0
    """How much of the law's velocity is left after looking ahead; the rest is the velocity of a stop."""
    stalled: tuple[Reason, ...] = ()
    """What keeps the tasks from making progress, once they have made none for a while."""
    assumptions: tuple[Reason, ...] = ()
    """What the step took for granted, such as the twist of an obstacle that was given without one."""
    saturation: float = 0.0
    """Largest change that the limits made to the law's raw velocity [rad/s or m/s]; 0 for laws that know limits."""
    build_time: float = 0.0
    """Time to read the state and set up the problem [s]."""
    solve_time: float = 0.0
    """Time to solve it and to look ahead [s]."""

    @property
    def severity(self) -> Severity | None:
        """The worst severity of all reasons of the step; None where there is no reason."""
        found = [reason.severity for reason in (*self.reasons, *self.stalled, *self.assumptions)]
        return max(found) if found else None

    def relaxed(self, *reasons: Reason) -> Solution:
        """Return the same with more reasons, as RELAXED; a stop stays one."""
        status = self.status if self.status is Status.STOPPED else Status.RELAXED
        return self._replace(status=status, reasons=(*self.reasons, *reasons))

    def timed(self, build_time: float, solve_time: float) -> Solution:
        """Return the same with its times [s]."""
        return Solution(*self[:-2], build_time, solve_time)  # a third of the time of `_replace`


def as_numbers(name: str, value: Any) -> Array:
    """Return `value` as a float array of whatever shape, and whatever its numbers are.

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
    """`value` as a float array of `shape`, whatever its numbers are.

    Raises:
        NumericalError: wrong shape, or not numbers; names the argument.
    """
    if type(value) is np.ndarray and value.dtype == np.float64 and value.shape == shape:
        return value
    array = as_numbers(name, value)
    if array.shape != shape:
        raise NumericalError(f"{name}: shape {array.shape}, expected {shape}")
    return array


def sane(v: Array) -> bool:
    """Whether a vector (n,) is finite and not absurdly large; for a few dozen numbers, quicker than numpy."""
    return hypot(*v.tolist()) < _MAX_NORM


def require_finite(name: str, value: Any, shape: tuple[int, ...]) -> Array:
    """`value` as a float array of `shape`.

    Raises:
        NumericalError: wrong shape, NaN or infinity; names the argument.
    """
    array = as_vector(name, value, shape)
    if not np.isfinite(array).all():
        raise NumericalError(f"{name}: {not_finite(array)}")
    return array


def not_finite(array: Array) -> str:
    """Say what is wrong with an array that is not `sane`, and where."""
    bad = np.argwhere(~np.isfinite(array)).ravel()[:5].tolist()
    return f"NaN or infinity at index {', '.join(map(str, bad))}" if bad else "too large"
