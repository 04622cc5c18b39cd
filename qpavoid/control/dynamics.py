"""The torque level of a controller: the robot's dynamics in every step, and torques of what is commanded."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid import config, kernels
from qpavoid.control.contacts import ContactRows
from qpavoid.control.observer import MomentumObserver
from qpavoid.dynamics import StepDynamics, mirrored
from qpavoid.errors import ConfigError, require_known
from qpavoid.kernels.layout import RowLayout
from qpavoid.model.limits import JointBounds
from qpavoid.model.robot import Robot
from qpavoid.problem import Array, Contacts, IntArray, Mask, Problem, Solution
from qpavoid.reason import Reason, ReasonKind
from qpavoid.solvers.solver import Solver

_LEAST_RATE = 4.0
"""Rate of rows over the gain of avoidance rows, from which on they do not overshoot [-]."""
_LEAST_LEFT = 0.1
"""Share of a torque that is taken to be left at home, where gravity takes more of it [-]."""
_EXCESS = 1e-9
"""Excess of a torque over its limit that is round-off [Nm or N]."""
_IDENTITY = 1e-9
"""Residual of M a + h - rnea, over the size of the latter, that is round-off [-]."""

_INSTEAD = {
    "latency": "leave it out; of motors that are T late, more than 2 ms, give `tracking_rate` and `row_rate` at most "
    "1 / (5 T)",
    "planning": "leave it out; `plan_to` gives a path whose points can be the targets of steps",
}
"""What to do in place of what does not go together with torques yet."""
Reasons = tuple[Reason, ...]


class RobotDynamics:
    """Mass matrix, bias torques and gravity of a robot, its torque limits, and what kernels make of them."""

    packed: Any
    """`DynamicsArrays` in compiled code, once `lay_out` was called."""
    contacts: ContactRows | None = None
    """Frames that rest, of a base that floats."""

    def __init__(
        self, robot: Robot, settings: config.Dynamics, bounds: JointBounds, dt: float, row_gain: float
    ) -> None:
        """Check that robot and settings suit; lay the matrices out.

        Args:
            robot: of a fixed base.
            settings: block of the scenario.
            bounds: limits of its joints.
            dt: control period [s].
            row_gain: ξ of the avoidance rows [1/s].

        Raises:
            ConfigError: the base floats or rolls, a torque limit is missing, the rate of the rows is too low.
        """
        self._settings, self._dt = settings, dt
        self._model = _with_armature(robot, settings.armature)
        self._data, n = self._model.createData(), robot.model.nv
        self.actuated: IntArray = self._find_actuated(robot)
        """(a,) coordinates with a motor."""
        self.limit = _limits(robot, settings, self.actuated)
        """(a,) largest torque in either direction, infinite without one [Nm or N]."""
        if settings.row_rate < min(_LEAST_RATE * row_gain, 1.0 / dt):
            raise ConfigError(
                f"dynamics.row_rate: {settings.row_rate:g} 1/s is below {_LEAST_RATE:g} times avoidance.row.gain, "
                f"{row_gain:g} 1/s: rows would overshoot"
            )
        self._M, self._gravity_slope = np.zeros((n, n)), np.zeros((n, n))
        self._h, self._gravity = np.zeros(n), np.zeros(n)
        self.approaches: Mask = np.ones(1, dtype=bool)
        """(1,) whether the tracked velocity is approached at the tracking rate, or taken as it is."""
        self.has_torques, self._acceleration = bool(np.isfinite(self.limit).all()), bounds.acceleration
        names, units = tuple(robot.coordinate_names), tuple(robot.coordinate_units)
        self.observer = (
            None if settings.observer is None else MomentumObserver(self._model, settings.observer, names, units)
        )
        """What acts on the robot from outside; None where it is not asked for."""
        self._last_torque, self._touches = np.zeros(n), tuple[Reason, ...]()
        self._first_touches = self._touches
        self._check(robot.home)
        self.bounds = replace(bounds, acceleration=self._references(robot.home))
        """Limits of the joints; the accelerations, on which braking counts, are overwritten by every step."""

    def _find_actuated(self, robot: Robot) -> IntArray:
        """Return the coordinates (a,) with a motor."""
        return _actuated(robot)

    def _check(self, q: Array) -> None:
        """Check that M a + h are the torques at q (nq,), as where joints mimic others they may not be."""
        a = np.linspace(-1.0, 1.0, self._model.nv)
        self.update(q, a)
        M = mirrored(self._M)
        torque = pin.rnea(self._model, self._data, q, a, a)
        if not np.abs(M @ a + self._h - torque).max() <= _IDENTITY * max(1.0, float(np.abs(torque).max())):
            raise ConfigError("dynamics: pinocchio's mass matrix of this robot does not match its inverse dynamics")

    def _references(self, q: Array) -> Array:
        """Return the largest accelerations (nv,) on which braking counts: the limits, else what torques give at q."""
        self.update(q, np.zeros(self._model.nv))
        references: Array = self._acceleration.copy()
        if self.has_torques:
            M = np.abs(mirrored(self._M))[self.actuated]
            left = self._settings.braking_fraction * self.limit - np.abs(self._h[self.actuated])
            own, given = np.maximum(left, _LEAST_LEFT * self.limit) / M.sum(axis=1), references[self.actuated]
            references[self.actuated] = np.where(np.isfinite(given), given, own)
        return references

    def lay_out(self, x: RowLayout) -> None:
        """Lay the rows out, for the memory of a control step."""
        n, a, settings = len(self._h), len(self.actuated), self._settings
        has_holding = self.has_torques and settings.holding_fraction is not None
        self._torque_rows = 2 * a if self.has_torques else 0
        count = self._torque_rows + (2 * a if has_holding else 0)
        arrays = kernels.DynamicsArrays(
            M=self._M, h=self._h, gravity=self._gravity, gravity_slope=self._gravity_slope,
            actuated=self.actuated, limit=self.limit, acceleration=self.bounds.acceleration.copy(),
            acceleration_step=self.bounds.acceleration * self._dt,
            braking=self.bounds.acceleration,
            rows=np.zeros((count + len(x.rhs), n)), rhs=np.zeros(count + len(x.rhs)),
            torque=np.zeros(a), change=np.zeros(n), factor=np.zeros((n, n)), approaches=self.approaches,
            has_torques=self.has_torques, has_holding=has_holding,
            braking_fraction=settings.braking_fraction, holding_fraction=settings.holding_fraction or 0.0,
            tracking_factor=min(1.0, settings.tracking_rate * self._dt),
            row_factor=min(1.0, settings.row_rate * self._dt),
        )  # fmt: skip
        self._arrays, self.packed = arrays, kernels.pack(arrays)
        self._rows = arrays.rows[:count], arrays.rhs[:count]
        zero = np.zeros(n)
        self._inverse = kernels.direct(kernels.inverse_dynamics, self.packed, zero, zero, self._dt)
        if a == n:
            kernels.forward_dynamics(self.packed)
        kernels.project_widened(np.eye(n), 1.0, zero, np.zeros((0, n)), zero[:0], *[zero - 1.0, zero + 1.0] * 2)
        kernels.slow_rows(kernels.pack(x), self.packed, 0)

    def step(self, packed: Any, *arguments: Any) -> Callable[..., int]:
        """Return the code of a control step for this memory, called as `kernels.control_step` is."""
        own = self.packed
        code = kernels.direct(kernels.dynamics_step, packed, own, *arguments)

        def step(x: Any, *rest: Any) -> int:
            return int(code(x, own, *rest))

        return step

    def update(self, q: Array, v: Array) -> None:
        """Compute mass matrix, bias torques and gravity at q (nq,) and v (nv,)."""
        model, data = self._model, self._data
        self._M[:] = pin.crba(model, data, q)
        self._h[:] = pin.nonLinearEffects(model, data, q, v)
        if self._settings.holding_fraction is not None:
            self._gravity_slope[:] = pin.computeGeneralizedGravityDerivatives(model, data, q)
            self._gravity[:] = data.g

    @property
    def resting(self) -> Contacts | None:
        """Contacts of the last step, at rest; None of a fixed base."""
        return None

    def solve(self, solver: Solver, problem: Problem) -> Solution:
        """Return the solution of a law."""
        return solver.solve(problem)

    def observe(self, q: Array, v: Array) -> None:
        """Let the observer see a measured state of a step, after the torques of the step before."""
        if self.observer is not None:
            self._touches = self.observer.update(q, v, self._last_torque, self._dt)

    def touched(self, faults: Reasons, assumptions: Reasons) -> tuple[Reasons, Reasons]:
        """Return faults and assumptions of a step with what touches the robot, where that stops it among the faults."""
        if self.observer is None or not (self._touches or self.observer.is_touched):
            return faults, assumptions
        if not self.observer.stops:
            return faults, assumptions + self._touches
        self._first_touches = self._touches or self._first_touches
        return faults + self._first_touches, assumptions

    def rows(self, v_measured: Array) -> StepDynamics | None:
        """Return dynamics and rows of the last step, at the measured velocity (nv,)."""
        J, b = self._rows
        return StepDynamics(
            self._M, self._h, v_measured, self._dt, self.actuated, self.limit, J, b, self._torque_rows
        )  # fmt: skip

    def approach(self, v: Array, v_measured: Array) -> Array:
        """Return the velocities (..., nv) at which the robot is after a step towards others at the tracking rate."""
        return np.asarray(v_measured + self._arrays.tracking_factor * (v - v_measured))

    def command(
        self, solution: Solution, v_measured: Array, names: tuple[str, ...], units: tuple[str, ...]
    ) -> Solution:
        """Return the solution with acceleration and torques; these are cut at their limits, and v is what follows.

        Args:
            solution: what is decided, from which joints pass their torque limits where no row has kept them.
            v_measured: velocity (nv,) at the begin of the step.
            names: of all nv coordinates.
            units: their units, rad or m.
        """
        x, v = self._arrays, solution.v
        excess = self._inverse(self.packed, v, v_measured, self._dt)
        if not excess <= _EXCESS:
            over = np.abs(x.torque) - x.limit
            reasons = [
                Reason.of(
                    ReasonKind.TORQUE_SATURATED, names[self.actuated[r]], amount=float(over[r]),
                    unit="Nm" if units[self.actuated[r]] == "rad" else "N",
                )
                for r in np.flatnonzero(over > _EXCESS).tolist()
            ]  # fmt: skip
            kernels.forward_dynamics(self.packed)
            solution = solution._replace(v=v_measured + self._dt * x.change).with_reasons(*reasons)
        elif excess > 0.0:
            np.clip(x.torque, -x.limit, x.limit, out=x.torque)
        if self.observer is not None:
            self._last_torque[self.actuated] = x.torque
            solution = solution._replace(external=self.observer.residual.copy())
        return tuple.__new__(Solution, (*solution[:-4], x.torque.copy(), x.change.copy(), *solution[-2:]))


def make_dynamics(
    settings: config.Dynamics | None, robot: Robot, limits: config.Limits, avoidance: config.Avoidance, dt: float,
    contacts: ContactRows | None, **others: Any,
) -> tuple[RobotDynamics | None, JointBounds]:  # fmt: skip
    """Make the torque level of a controller, and the bounds of its joints; None and the limits without settings.

    Args:
        settings: block of the scenario.
        robot: that is controlled.
        limits: block of the scenario.
        avoidance: block of the scenario.
        dt: control period [s].
        contacts: frames that rest, of a base that floats.
        others: what it does not go together with yet, by the names of the controller's arguments.

    Raises:
        ConfigError: see `RobotDynamics`; or it goes with something that it does not know yet.
    """
    bounds = robot.bounds().within(limits)
    if settings is None:
        return None, bounds
    for name, given in others.items():
        if given:
            raise ConfigError(f"dynamics: not together with `{name}`, which knows velocities alone: {_INSTEAD[name]}")
    arguments = robot, settings, bounds, dt, avoidance.row.gain
    if contacts is None:
        dynamics = RobotDynamics(*arguments)
    else:
        from qpavoid.control.standing import StandingDynamics  # which derives from the class above

        dynamics = StandingDynamics(*arguments, contacts)
    return dynamics, dynamics.bounds


def _actuated(robot: Robot) -> IntArray:
    """Return the coordinates (a,) with a motor.

    Raises:
        ConfigError: the base is none of a fixed one.
    """
    for name, joint in zip(robot.model.names[1:], robot.model.joints[1:], strict=True):
        if joint.nv > 1:
            raise ConfigError(
                f"dynamics: {robot.name} moves its base ({name!r}): one that floats stands on `contacts`, others are "
                "not known yet"
            )
    return np.arange(robot.model.nv)


def _limits(robot: Robot, settings: config.Dynamics, actuated: IntArray) -> Array:
    """Return the torque limits (a,) of coordinates that may be used [Nm or N].

    Raises:
        ConfigError: a joint has none.
    """
    if settings.torque_limits is None:
        return np.full(len(actuated), np.inf)
    names, limits = robot.coordinate_names, robot.torque_limits()[actuated]
    if missing := [names[i] for i, limit in zip(actuated, limits, strict=True) if not limit > 0.0]:
        raise ConfigError(
            f"dynamics: no torque limit of {', '.join(missing[:5])}; give `limits: {{torque: …}}` in {robot.source}, "
            "or `torque_limits: null`"
        )
    return np.asarray(settings.torque_limits * limits)


def _with_armature(robot: Robot, armature: Any) -> Any:
    """Return the robot's pinocchio model with other armatures.

    Raises:
        UnknownName: of a joint.
    """
    if armature == {}:
        return robot.model
    model: Any = robot.model.copy()
    values = np.array(model.armature)
    joints = [name for name in robot.joint_names if model.joints[model.getJointId(name)].nv == 1]  # a base has none
    given = armature if isinstance(armature, dict) else dict.fromkeys(joints, armature)
    for name, value in given.items():
        require_known(name, robot.joint_names, "dynamics.armature: no joint")
        joint = model.joints[model.getJointId(name)]
        values[joint.idx_v : joint.idx_v + joint.nv] = value
    model.armature = values
    return model
