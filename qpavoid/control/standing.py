"""The torque level of a robot that stands: contact forces, and a base that no motor moves.

A law solves the same problem as ever, in x = (v, s p) with the impulses p of the contact points: contacts and the six
equations of the base are met by x = start + X y, torque limits and friction cones are rows that are never relaxed. So
all bounded laws that hold contacts, their relaxation and their priorities are used as they are.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from qpavoid import config, kernels
from qpavoid.control.contacts import ContactRows
from qpavoid.control.dynamics import RobotDynamics
from qpavoid.dynamics import StepDynamics, mirrored
from qpavoid.errors import ConfigError
from qpavoid.kernels.contact_forces import BASE
from qpavoid.kernels.layout import RowLayout
from qpavoid.model.kinematics import ForwardKinematics
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

    _mirrors = False

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
        self._x: RowLayout | None = None
        self._lay_points()
        if settings.observer is not None:
            raise ConfigError(
                "dynamics.observer: of a robot on contacts, forces of the ground are not known; leave it out"
            )
        super().__init__(robot, settings.model_copy(update={"holding_fraction": None}), bounds, dt, row_gain)
        self._M[:] = np.eye(n)
        self._solved: tuple[Array, Array] | None = None
        self._is_held = False
        self._weight = 9.81 * float(pin.computeTotalMass(robot.model))
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
        own = 0.5 * self.limit / np.abs(self._full[BASE:]).sum(axis=1)
        own = np.asarray(np.minimum(own, _LARGEST_ACCELERATION))
        references[BASE:] = np.where(np.isfinite(references[BASE:]), references[BASE:], own)
        references[:BASE] = np.where(np.isfinite(references[:BASE]), references[:BASE], _BASE_ACCELERATION)
        return np.asarray(references)

    def _check(self, q: Array) -> None:
        """Do nothing: a floating base with joints of one coordinate has no joints that mimic others."""

    def lay_out(self, x: RowLayout) -> None:
        """See `RobotDynamics.lay_out`."""
        super().lay_out(x)
        self._x = x

    def update(self, q: Array, v: Array) -> None:
        """Compute mass matrix and bias torques at q (nq,) and v (nv,)."""
        self._full[:] = mirrored(pin.crba(self._model, self._data, q))
        self._bias[:] = pin.nonLinearEffects(self._model, self._data, q, v)

    def stand(self, kinematics: ForwardKinematics, v: Array) -> Contacts:
        """Take up contacts and base, for a step from the velocity v (nv,); return the contacts, at rest.

        A step approaches them at their rates: J v = (1 - κ_c) J v̄ + κ_c b.

        Args:
            kinematics: those of the step; `update` was called for it.
            v: as measured.
        """
        contacts, dt = self._contacts, self._dt
        J, b = contacts.rows(kinematics)
        resting = Contacts(*kernels.solve_rows(J, b), J, b)
        rates = np.array([min(1.0, dt * contact.rate) for contact in contacts.settings]) * contacts.shares
        Z, rest, b = resting.Z, resting.v_particular, J @ v + rates[contacts.row_owners()] * (b - J @ v)
        if len(set(rates[contacts.active])) == 1:
            rest = v - Z @ (Z.T @ v) + rates[contacts.active[0]] * (rest - v + Z @ (Z.T @ v))
        else:
            _, rest = kernels.solve_rows(J, b)
        used = np.flatnonzero(np.isin(self._owners, contacts.active))
        owners, n, m = self._owners[used], len(v), 3 * len(used)
        rotations = np.array([kinematics.frame_poses[i, :9].reshape(3, 3).T for i in contacts.frame_ids])
        offsets = np.einsum("kij,kj->ki", rotations[owners], self._points[used])
        Jp, k = np.empty((m, n)), Z.shape[1]
        kernels.point_jacobians(contacts.jacobians, offsets, owners, Jp)
        X, start = np.empty((n + m, max(k + m - BASE, 0))), np.empty(n + m)
        Y, N = np.empty((m, BASE)), np.empty((m, max(m - BASE, 0)))
        self._is_held = bool(kernels.eliminate_base(self._full, self._bias, v, dt, Jp, Z, rest, _SCALE, X, start, Y, N))
        self._v, self._used, self._solved = v.copy(), owners, None
        self._approached, self._Jp, self._N, self._Y = Contacts(Z, rest, J, b), Jp, N, Y
        if not self._is_held:
            self._M[:], self._h[:] = 0.0, 0.0
            self._M[BASE:], self._h[BASE:] = self._full[BASE:], self._bias[BASE:]
            return resting
        kernels.standing_dynamics(self._full, self._bias, Jp, Y, Z, self._M, self._h)
        self._contact_set = self._with_base(X, start, J, b)
        normals = np.array([contact.normal for contact in contacts.settings])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        self._normals = np.einsum("kij,kj->ki", rotations[owners], normals[owners])
        self._hard = self._hard_rows(owners, n, m)
        return resting

    def _with_base(self, X: Array, start: Array, J: Array, b: Array) -> Contacts:
        """Return contacts and equations of the base as contacts of x = (v, s p)."""
        n, m, c = len(self._v), len(self._Jp), len(b)
        rows, right = np.zeros((c + BASE, n + m)), np.empty(c + BASE)
        rows[:c, :n], right[:c] = J, b
        rows[c:, :n], rows[c:, n:] = self._full[:BASE], -self._Jp[:, :BASE].T / _SCALE
        right[c:] = self._full[:BASE] @ self._v - self._dt * self._bias[:BASE]
        return Contacts(X, start, rows, right)

    def _hard_rows(self, owners: IntArray, n: int, m: int) -> StepDynamics:
        """Return the dynamics of x = (v, s p), with the rows of torque limits and cones."""
        settings, shares = self._contacts.settings, self._contacts.shares[owners]
        has_limits = bool(np.isfinite(self.limit).all())
        torques, cones = 2 * len(self.limit) if has_limits else 0, kernels.ROWS_PER_POINT * len(owners)
        rows, rhs = np.empty((torques + cones, n + m)), np.empty(torques + cones)
        if has_limits:
            kernels.force_torque_rows(
                self._full, self._bias, self._v, self._dt, self._Jp, self.limit, _SCALE, rows[:torques], rhs[:torques]
            )
        friction, force = (
            np.array([c.friction for c in settings])[owners],
            np.array([c.force for c in settings])[owners],
        )
        kernels.cone_rows(
            self._normals, friction, force[:, 0] * (shares == 1.0), force[:, 1] * shares, self._dt, _SCALE, n,
            rows[torques:], rhs[torques:],
        )  # fmt: skip
        M = np.hstack((self._full, -self._Jp.T / _SCALE))
        v = np.concatenate((self._v, np.zeros(m)))
        points = tuple(settings[i].frame for i in owners)
        return StepDynamics(
            M, self._bias, v, self._dt, self.actuated, self.limit, rows, rhs, torques + cones, points
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
        """Return x = (v, s p) of a velocity (nv,) that meets the contacts: with the p nearest to equal shares."""
        needed = self._full[:BASE] @ (v - self._v) + self._dt * self._bias[:BASE]
        equal = (self._dt * self._weight / len(self._used) * self._normals).ravel()
        return np.concatenate((v, _SCALE * (self._Y @ needed + self._N @ (self._N.T @ equal))))

    def solve(self, solver: Solver, problem: Problem) -> Solution:
        """Return the solution of a law, of the problem in x = (v, s p); of one that holds no contacts, in v.

        Of the latter, Jacobians are those of motions that move no contact; `command` then finds the nearest velocity
        that torques and cones allow.
        """
        if not self._is_held or not np.isfinite(problem.v_tracking).all():
            return Solution(problem.v_stop.copy(), Status.STOPPED, (_not_held(),))
        if not solver.holds_contacts:
            return solver.solve(self._supported(problem))
        n, m = len(self._v), len(self._Jp)
        solution = solver.solve(self._full_problem(problem))
        if solution.v.shape == (n + m,):
            self._solved = solution.v[:n].copy(), solution.v[n:] / _SCALE
            solution = solution._replace(v=self._solved[0].copy())
        if solution.status is Status.STOPPED:
            self._solved = None
        return solution

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
        m, far = len(self._Jp), np.full(len(self._Jp), np.inf)

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
            v_tracking=tracked, contacts=self._contact_set, dynamics=self._hard, tracking_is_clear=False,
            cascade=None if cascade is None else np.array([self._with_impulses(v) for v in cascade]),
        )  # fmt: skip
        return full._replace(violation=float(kernels.violation(tracked, *full.inequalities, lower, upper)))

    def command(
        self, solution: Solution, v_measured: Array, names: tuple[str, ...], units: tuple[str, ...]
    ) -> Solution:
        """Return the solution with acceleration, torques and forces.

        A velocity that is not the law's, as of a stop, is replaced by the nearest one that torques and cones allow.
        Where there is none, the joints brake as their torques allow, with gravity held, and the step is a stop.

        Args:
            solution: what is decided.
            v_measured: velocity (nv,) at the begin of the step.
            names: of all nv coordinates.
            units: their units, rad or m.
        """
        answer = self._solved
        if answer is None or not np.array_equal(answer[0], solution.v):
            answer = self._nearest(solution.v)
        if answer is None:
            return self._limp(solution)
        v, p = answer
        change = (v - v_measured) / self._dt
        torque = (self._full[BASE:] @ change + self._bias[BASE:]) - self._Jp[:, BASE:].T @ p / self._dt
        forces, settings = p.reshape(-1, 3) / self._dt, self._contacts.settings
        by_frame = {settings[i].frame: forces[self._used == i] for i in np.unique(self._used).tolist()}
        torque = np.clip(torque, -self.limit, self.limit)
        return solution._replace(v=v, torque=torque, acceleration=change, forces=by_frame)

    def _nearest(self, v: Array) -> tuple[Array, Array] | None:
        """Return the velocity (nv,) nearest to another one that torques and cones allow, and its impulses, if any."""
        if not self._is_held:
            return None
        n, hard, (X, start, *_) = len(v), self._hard, self._contact_set
        target = X.T @ (self._with_impulses(self._approached.project(v)) - start)
        free = np.full(X.shape[1], np.inf)
        J, b = np.ascontiguousarray(hard.J @ X), hard.b - hard.J @ start
        y, is_solved = kernels.project(
            np.ascontiguousarray(X[:n]), _VELOCITY_WEIGHT, target, J, b, -free, free
        )  # fmt: skip
        if not is_solved:
            return None
        x = start + X @ y
        return x[:n], x[n:] / _SCALE

    def _limp(self, solution: Solution) -> Solution:
        """Return a stop by torques alone: those that hold gravity, and brake as far as limits allow."""
        assert self._x is not None
        v = self._x.v_stop.copy()
        change = (v - self._v) / self._dt
        torque = np.clip(self._M[BASE:] @ change + self._h[BASE:], -self.limit, self.limit)
        reasons = solution.reasons if _not_held().key in {reason.key for reason in solution.reasons} else (
            *solution.reasons, _not_held()
        )  # fmt: skip
        return solution._replace(v=v, status=Status.STOPPED, reasons=reasons, torque=torque, acceleration=change)


def _not_held() -> Reason:
    return Reason.of(
        ReasonKind.CONTACTS_INFEASIBLE, "contacts", detail="nor do torques within their limits and forces within cones"
    )
