"""The torque level of a robot that stands: contact forces, and a base that no motor moves.

A law solves the same problem as ever, in x = (v, s p) with the impulses p of the contact points: contacts and the six
equations of the base are met by x = start + X y, torque limits and friction cones are rows that are never relaxed. So
all bounded laws that hold contacts, their relaxation and their priorities are used as they are.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid import config, kernels
from qpavoid.control.contacts import ContactRows
from qpavoid.control.dynamics import RobotDynamics
from qpavoid.dynamics import StepDynamics, mirrored
from qpavoid.errors import ConfigError
from qpavoid.kernels.contact_forces import BASE
from qpavoid.kernels.layout import RowLayout
from qpavoid.model.limits import JointBounds
from qpavoid.model.robot import Robot
from qpavoid.problem import Array, Contacts, IntArray, Problem, Solution, Status
from qpavoid.reason import Reason, ReasonKind
from qpavoid.solvers.solver import Solver

_FORCE_WEIGHT = 1e-6
"""ρ [(m/s)² / (N s)²]: weight of impulses, beside λ of velocities; 1e-3 moves the base by centimetres to save force."""
_VELOCITY_WEIGHT = 1e-3
"""λ, the default of the laws [-]."""
_SCALE = float(np.sqrt(_FORCE_WEIGHT / _VELOCITY_WEIGHT))
"""s: what an impulse of 1 N s counts beside velocities."""
_BASE_ACCELERATION = np.array([2.0, 2.0, 2.0, 4.0, 4.0, 4.0])
"""Accelerations of the base on which braking counts at the most [m/s², rad/s²]: what friction of 0.2 gives."""
_LARGEST_ACCELERATION = 20.0
"""Acceleration of a joint on which braking counts at the most, where none is given [rad/s² or m/s²]."""


class StandingDynamics(RobotDynamics):
    """Dynamics of a robot whose base floats, on its contacts."""

    def __init__(
        self, robot: Robot, settings: config.Dynamics, bounds: JointBounds, dt: float, row_gain: float,
        contacts: ContactRows,
    ) -> None:  # fmt: skip
        """Check that robot, settings and contacts suit; lay the matrices out.

        Args:
            robot: of a floating base.
            settings: block of the scenario.
            bounds: limits of its joints.
            dt: control period [s].
            row_gain: ξ of the avoidance rows [1/s].
            contacts: frames that rest.

        Raises:
            ConfigError: see `RobotDynamics`; or a surface has no corners, or all of them cannot carry any wrench.
        """
        n = robot.model.nv
        self.contacts = self._contacts = contacts.own_copy()
        self._full, self._bias = np.zeros((n, n)), np.zeros(n)
        self._margin, self._center, self._center_jacobian = settings.support_margin, np.zeros(3), np.zeros((3, n))
        self._lay_points()
        if settings.observer is not None:
            raise ConfigError(
                "dynamics.observer: of a robot on contacts, forces of the ground are not known; leave it out"
            )
        super().__init__(robot, settings.model_copy(update={"holding_fraction": None}), bounds, dt, row_gain)
        self._M[:] = np.eye(n)
        self._is_answered = self._is_settled = False
        self._weight = np.array([9.81 * float(pin.computeTotalMass(robot.model))])
        self._names = tuple(robot.coordinate_names)

    def _lay_points(self) -> None:
        """List the contact points of all contacts."""
        points, owners = list[Array](), list[int]()
        for i, contact in enumerate(self._contacts.settings):
            corners = contact.vertices or ([] if contact.type == "surface" else [(0.0, 0.0, 0.0)])
            if contact.type == "surface" and len(corners) < 3:
                raise ConfigError(
                    f"dynamics: the surface of contact {contact.frame!r} has {len(corners)} corners, at least 3 are "
                    "needed: give `vertices`"
                )
            if contact.force[0] >= contact.force[1]:
                raise ConfigError(f"dynamics: contact {contact.frame!r}: `force` must grow")
            points += [np.array(corner) for corner in corners]
            owners += [i] * len(corners)
        self._points, self._owners = np.array(points), np.array(owners, dtype=np.intp)
        self._corners = np.bincount(self._owners).tolist()

    def _find_actuated(self, robot: Robot) -> IntArray:
        """Return the coordinates (a,) with a motor: all but those of the base."""
        kinds = [(joint.shortname(), joint.nv) for joint in list(robot.model.joints)[1:]]
        if kinds[0][0] != "JointModelFreeFlyer" or any(nv != 1 for _, nv in kinds[1:]):
            raise ConfigError(
                f"dynamics: contacts hold a robot with a floating base and joints of one coordinate; {robot.name} is "
                "none: leave `contacts` or `dynamics` out"
            )
        return np.arange(BASE, robot.model.nv)

    def _references(self, q: Array) -> Array:
        """Return the accelerations (nv,) that braking counts on at the most; see `RobotDynamics`."""
        references = self._acceleration.copy()
        self.update(q, np.zeros(self._model.nv))
        own = 0.5 * self.limit / np.abs(mirrored(self._full)[BASE:]).sum(axis=1)
        own = np.asarray(np.minimum(own, _LARGEST_ACCELERATION))
        references[BASE:] = np.where(np.isfinite(references[BASE:]), references[BASE:], own)
        references[:BASE] = np.where(np.isfinite(references[:BASE]), references[:BASE], _BASE_ACCELERATION)
        return np.asarray(references)

    def _check(self, q: Array) -> None:
        """Do nothing: a floating base with joints of one coordinate has no joints that mimic others."""

    def lay_out(self, x: RowLayout) -> None:
        """See `RobotDynamics.lay_out`."""
        super().lay_out(x)
        self._x, contacts, settings = x, self._contacts, self._contacts.settings
        normals = np.array([contact.normal for contact in settings])
        self._z = kernels.StandingArrays(
            mass=self._full, bias=self._bias, frame_ids=np.array(contacts.frame_ids, dtype=np.intp),
            support=contacts.support, anchors=contacts.anchors, gains=contacts.gains, surfaces=contacts.surfaces,
            shares=contacts.shares, steps=np.array([min(1.0, self._dt * contact.rate) for contact in settings]),
            normals=normals / np.linalg.norm(normals, axis=1, keepdims=True),
            friction=np.array([contact.friction for contact in settings]),
            force=np.array([contact.force for contact in settings]), points=self._points, owners=self._owners,
            weight=self._weight, center=self._center, center_jacobian=self._center_jacobian,
            jacobians=contacts.jacobians, leaves=contacts.leaves,
            support_margin=-1.0 if self._margin is None else self._margin,
            solved=np.full(len(x.v_prev) + self._points.size, np.nan), scale=_SCALE,
        )  # fmt: skip
        self._packed_z = kernels.pack(self._z)

    def step(self, packed: Any, *arguments: Any) -> Callable[..., int]:
        """See `RobotDynamics.step`."""
        y, z = self.packed, self._packed_z
        code = kernels.direct(kernels.standing_step, packed, y, z, *arguments[:-1])

        def step(x: Any, q: Array, influence_distance: float, moving: bool, from_tasks: bool, measured: bool) -> int:
            outcome, self._stance = code(x, y, z, q, influence_distance, moving, from_tasks)
            self._is_answered = self._is_settled = outcome == kernels.SETTLED
            return int(outcome)

        return step

    def update(self, q: Array, v: Array) -> None:
        """Compute mass matrix and bias torques at q (nq,) and v (nv,)."""
        self._full[:] = pin.crba(self._model, self._data, q)
        self._bias[:] = pin.nonLinearEffects(self._model, self._data, q, v)
        if self._margin is not None:
            self._center_jacobian[:] = pin.jacobianCenterOfMass(self._model, self._data, q)
            self._center[:] = self._data.com[0]

    @property
    def resting(self) -> Contacts:
        """Contacts of the last step, at rest; a step approaches them at their rates, J v = (1 - κ_c) J v̄ + κ_c b."""
        stance = self._stance
        return Contacts(stance.Z, stance.resting, stance.J, stance.b)

    @property
    def _approached(self) -> Contacts:
        """Contacts of the last step, as far as it approaches them."""
        stance = self._stance
        return Contacts(stance.Z, stance.approached, stance.J, stance.b_approached)

    def _contact_set(self, v_measured: Array) -> Contacts:
        """Return contacts and equations of the base as contacts of x = (v, s p)."""
        stance, M = self._stance, self._full[:BASE]
        n, m, c = len(self._bias), len(stance.Jp), len(stance.b)
        rows, right = np.zeros((c + BASE, n + m)), np.empty(c + BASE)
        rows[:c, :n], right[:c] = stance.J, stance.b_approached
        rows[c:, :n], rows[c:, n:] = M, -stance.Jp[:, :BASE].T / _SCALE
        right[c:] = M @ v_measured - self._dt * self._bias[:BASE]
        return Contacts(self._basis, stance.start, rows, right)

    @property
    def _basis(self) -> Array:
        """Orthonormal columns of what contacts and base leave of x = (v, s p)."""
        Z = self._stance.Z
        return np.asarray(kernels.make_orthonormal(self._stance.X, *Z.shape))

    def _hard_rows(self, v_measured: Array) -> StepDynamics:
        """Return the dynamics of x = (v, s p), with the rows of torque limits and cones."""
        stance, m = self._stance, len(self._stance.Jp)
        M = np.hstack((self._full, -stance.Jp.T / _SCALE))
        v = np.concatenate((v_measured, np.zeros(m)))
        points = tuple(self._contacts.settings[i].frame for i in self._owners[stance.used])
        return StepDynamics(
            M, self._bias, v, self._dt, self.actuated, self.limit, stance.rows, stance.rhs, stance.hard, points
        )  # fmt: skip

    def rows(self, v_measured: Array) -> StepDynamics | None:
        """Return None: rows of x = (v, s p) are those of `solve` alone."""
        return None

    def approach(self, v: Array, v_measured: Array) -> Array:
        """See `RobotDynamics.approach`; what is returned meets the contacts."""
        approached = super().approach(v, v_measured)
        if v.ndim > 1:
            return np.array([self._approached.project(row) for row in approached])
        return np.asarray(self._approached.project(approached))

    def _with_impulses(self, v: Array) -> Array:
        """Return x = (v, s p) of a velocity (nv,) that meets the contacts, see `kernels.with_impulses`."""
        return np.asarray(kernels.with_impulses(self._packed_z, self._stance, self._x.v_prev, self._dt, v))

    def solve(self, solver: Solver, problem: Problem) -> Solution:
        """Return the solution of a law, of the problem in x = (v, s p); of one that holds no contacts, in v.

        Of the latter, Jacobians are those of motions that move no contact; `command` then finds the nearest velocity
        that torques and cones allow.
        """
        if not self._stance.is_held or not np.isfinite(problem.v_tracking).all():
            return Solution(problem.v_stop.copy(), Status.STOPPED, (_not_held(),))
        if not solver.holds_contacts:
            return solver.solve(self._supported(problem))
        n, m = len(self._bias), len(self._stance.Jp)
        solution = solver.solve(self._full_problem(problem))
        if solution.v.shape == (n + m,):
            self._take(solution.v)
            solution = solution._replace(v=solution.v[:n].copy())
        if solution.status is Status.STOPPED:
            self._is_answered = False
        return solution

    def _take(self, x: Array) -> None:
        """Take x = (v, s p) as the answer of this step, with its impulses."""
        n = len(self._bias)
        self._z.solved[:n], self._z.solved[n : len(x)] = x[:n], x[n:] / _SCALE
        self._is_answered, self._is_settled = True, False

    def _supported(self, problem: Problem) -> Problem:
        """Return a problem for a law that holds no contacts: its Jacobians are those of motions that move none."""
        Z = self._approached.Z
        A, J = (rows @ Z @ Z.T for rows in (problem.tracking.A, problem.avoidance.J))
        return problem._replace(
            tracking=problem.tracking._replace(A=A),
            avoidance=problem.avoidance._replace(J=np.ascontiguousarray(J)),
        )

    def _full_problem(self, problem: Problem) -> Problem:
        """Return a problem in v as one in x = (v, s p)."""
        m, v_measured = len(self._stance.Jp), self._x.v_prev
        far = np.full(m, np.inf)

        def padded(J: Array) -> Array:
            return np.hstack((J, np.zeros((len(J), m))))

        lower, upper = np.concatenate((problem.lower, -far)), np.concatenate((problem.upper, far))
        is_hard = problem.hard_lower is problem.lower
        tracked = self._with_impulses(problem.v_tracking)
        cascade = problem.cascade
        full = problem._replace(
            tracking=problem.tracking._replace(A=padded(problem.tracking.A)),
            avoidance=problem.avoidance._replace(J=padded(problem.avoidance.J)),
            lower=lower, upper=upper,
            hard_lower=lower if is_hard else np.concatenate((problem.hard_lower, -far)),
            hard_upper=upper if is_hard else np.concatenate((problem.hard_upper, far)),
            v_stop=np.concatenate((problem.v_stop, np.zeros(m))),
            joint_names=(*self._names, *["impulse"] * m), joint_units=(*problem.joint_units, *["N s"] * m),
            v_tracking=tracked, contacts=self._contact_set(v_measured), dynamics=self._hard_rows(v_measured),
            tracking_is_clear=False,
            cascade=None if cascade is None else np.array([self._with_impulses(v) for v in cascade]),
        )  # fmt: skip
        return full._replace(violation=float(kernels.violation(tracked, *full.inequalities, lower, upper)))

    def command(
        self, solution: Solution, v_measured: Array, names: tuple[str, ...], units: tuple[str, ...]
    ) -> Solution:
        """Return the solution with acceleration, torques and forces.

        A velocity that is not the law's, as of a stop, is replaced by the nearest one that torques and cones allow.
        Where there is none, the joints brake as their torques allow, with gravity stance, and the step is a stop.

        Args:
            solution: what is decided.
            v_measured: velocity (nv,) at the begin of the step.
            names: of all nv coordinates.
            units: their units, rad or m.
        """
        n, m, y, z = len(self._bias), len(self._stance.Jp), self._arrays, self._z
        if not (self._is_answered and np.array_equal(z.solved[:n], solution.v)) and not self._nearest(solution.v):
            return self._limp(solution)
        if not self._is_settled:
            kernels.standing_torques(self.packed, self._packed_z, self._stance, v_measured, self._dt)
        forces, by_frame, at = z.solved[n : n + m].reshape(-1, 3) / self._dt, dict[str, Array](), 0
        declared = zip(self._contacts.settings, self._contacts.shares, self._corners, strict=True)
        for contact, fraction, corners in declared:
            if fraction > 0.0:
                by_frame[contact.frame] = forces[at : at + corners]
                at += corners
        return solution._replace(
            v=z.solved[:n].copy(), torque=y.torque.copy(), acceleration=y.change.copy(), forces=by_frame
        )

    def _nearest(self, v: Array) -> bool:
        """Take the velocity nearest to v (nv,) that torques and cones allow; return whether there is one."""
        if not (stance := self._stance).is_held:
            return False
        n, X, start = len(v), self._basis, stance.start
        target = X.T @ (self._with_impulses(self._approached.project(v)) - start)
        free = np.full(X.shape[1], np.inf)
        rows, rhs = stance.rows[: stance.hard], stance.rhs[: stance.hard]
        J, b = np.ascontiguousarray(rows @ X), rhs - rows @ start
        y, is_solved = kernels.project(
            np.ascontiguousarray(X[:n]), _VELOCITY_WEIGHT, target, J, b, -free, free
        )  # fmt: skip
        if is_solved:
            self._take(start + X @ y)
        return bool(is_solved)

    def _limp(self, solution: Solution) -> Solution:
        """Return a stop by torques alone: those that hold gravity, and brake as far as limits allow."""
        v = self._x.v_stop.copy()
        change = (v - self._x.v_prev) / self._dt
        torque = np.clip(self._M[BASE:] @ change + self._h[BASE:], -self.limit, self.limit)
        reasons = solution.reasons if _not_held().key in {reason.key for reason in solution.reasons} else (
            *solution.reasons, _not_held()
        )  # fmt: skip
        return solution._replace(v=v, status=Status.STOPPED, reasons=reasons, torque=torque, acceleration=change)


def _not_held() -> Reason:
    return Reason.of(
        ReasonKind.CONTACTS_INFEASIBLE, "contacts", detail="nor do torques within their limits and forces within cones"
    )
