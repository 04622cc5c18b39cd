"""From kinematics and distances to a problem: all rows and bounds of a tick in one call, in memory laid out once."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from qpavoid import kernels
from qpavoid.config import Avoidance, Limits
from qpavoid.control.contacts import ContactRows, tracking_within
from qpavoid.control.distances import DistanceQuery
from qpavoid.control.jerk_stops import Stop, StopFollower
from qpavoid.control.row_layout import hand_over, lay_out
from qpavoid.control.tasks import RowTask, in_order
from qpavoid.control.tasks.layout import TaskRows, task_levels
from qpavoid.model.kinematics import ForwardKinematics, Kinematics, support_masks
from qpavoid.model.limits import JointBounds
from qpavoid.model.scene import Scene
from qpavoid.model.trajectory import Sample
from qpavoid.problem import Array, AvoidanceRows, Problem, Proximity, Tracking
from qpavoid.solvers.analytic import pseudo_inverse

_ROUND_OFF = 1e-9
"""Share of a coordinate's largest change of speed in a tick that counts as round-off [-]."""


class Assembly:
    """Rows and bounds of a tick. What it returns looks into memory that the next tick overwrites."""

    def __init__(
        self,
        scene: Scene,
        tasks: Sequence[RowTask],
        bounds: JointBounds,
        kinematics: ForwardKinematics,
        query: DistanceQuery,
        avoidance: Avoidance,
        limits: Limits,
        damping: float,
        dt: float,
        contacts: ContactRows | None = None,
        looks_ahead: bool = False,
    ) -> None:
        """Lays the memory out; see `Controller` for the arguments, and `RowLayout` for `looks_ahead`."""
        frames, others = in_order(tasks)
        self._masks = support_masks(scene.robot.model)
        # with jerk limits, a stop goes another way; with contacts, v0 does
        looks_ahead = looks_ahead and contacts is None and not np.isfinite(bounds.jerk).any()
        self._layout = lay_out(
            scene, frames, others, bounds, kinematics, query, avoidance, limits, damping, dt, looks_ahead
        )
        x = self._layout
        self._hard = (x.hard_lower, x.hard_upper) if limits.relax_acceleration else (x.lower, x.upper)
        self._packed = kernels.pack(self._layout)
        self._stop, self._dt = StopFollower(x) if x.jerk_limited else None, dt
        robot = scene.robot
        self._names = scene.pair_names, tuple(robot.coordinate_names), tuple(robot.coordinate_units)
        self.targets = self._layout.targets
        """(f, 18) states that the frame tasks are to reach, see `trajectories`; to be written before `compute`."""
        self._views: dict[int, tuple[Proximity, AvoidanceRows]] = {}
        levels, self._task_rows = task_levels(frames, others), TaskRows(others, x.A, x.b)
        self.task_errors = self._task_rows.errors
        """How far each of the tasks that are not frames was from its target in the last step, in its unit."""
        self._tracking = Tracking(self._layout.A, self._layout.b, damping)
        self._levels = levels if len(levels) > 1 else ()
        self._forward, self._contacts = kinematics, contacts
        self._eye = np.eye(len(x.v_tracking))
        self._before, self._change = np.zeros_like(x.v_tracking), np.zeros_like(x.v_tracking)
        self._moving = False
        self.limits_may_give_way = x.jerk_limited or (contacts is not None and x.acceleration_limited)
        """Whether `beyond_limits` has to be asked: bounds alone do not keep to accelerations and jerks then."""
        self.kinematics = Kinematics(self._layout.J_world, self._layout.poses)

    def compute(
        self, q: Array, targets: Sequence[Sample], query: DistanceQuery, reach: float
    ) -> tuple[Proximity, Problem]:
        """Rows and bounds at a configuration, for which kinematics and distances are up to date.

        Args:
            q: configuration (nq,).
            targets: what each task should reach now, in the order of `in_order`.
            query: distances of this tick.
            reach: surface distance below which a pair is near [m].
        """
        x = self._layout
        if self.task_errors.size:
            self._task_rows.write(q, self._forward, targets[len(self.targets) :])
        held = None
        if self._contacts is not None:
            held = self._contacts.update(self._forward)
            x.v_prev[:] = held.project(x.v_prev)
        self._moving = query.placing.moving
        k, worst, clear, room = kernels.assemble(self._packed, q, query.pairs, reach, self._moving)
        proximity, rows = self._views.get(k) or self._view(k)
        if (
            x.task_switching and x.v_tracking[0] != x.v_tracking[0] and np.isfinite(x.A).all()
        ):  # task rows repeat each other
            v_tracking = pseudo_inverse(x.A, 0.0) @ x.b
            along = self._along(rows, v_tracking)
            rows.b[:], rows.b_contact[:] = along.b, along.b_contact
        if held is not None:
            x.v_tracking[:] = tracking_within(held, x.A, x.b, x.damping)
            self._count_from_before()
            if x.task_switching:
                kernels.row_bounds(self._packed, k, self._moving)
            worst = float(kernels.tracking_violation(self._packed, k))
        bounds = x.lower, x.upper, *self._hard, x.v_stop
        return proximity, Problem(
            self._tracking, rows, *bounds, *self._names, x.v_tracking, worst, held, self._levels, x.jerk_limited,
            clear, room,
        )  # fmt: skip

    def look_ahead(self, looks_ahead: bool) -> None:
        """Tell kernels whether to look for velocities that lead nowhere near anything; see `RowLayout.looks_ahead`."""
        x = self._layout
        looks_ahead = looks_ahead and self._contacts is None and not x.jerk_limited
        if looks_ahead != x.looks_ahead:
            self._layout = x._replace(looks_ahead=looks_ahead)
            self._packed = kernels.pack(self._layout)

    def carry(self, query: DistanceQuery) -> None:
        """Takes over which joint carries what, in place."""
        hand_over(self._layout, self._masks, query)

    def clearance_lower_bound(
        self, v: Array, near: int, reach: float, horizon: float, stop: Stop | None = None
    ) -> float:
        """A bound below what is left of the safe distances on the way of v until `horizon` [m].

        See `kernels.clearance_lower_bound`.

        Args:
            v: velocity (nv,).
            near: number of near pairs.
            reach: surface distance below which a pair is near [m].
            horizon: time for which v leads on [s].
            stop: what else there is of the way, if there is.
        """
        left = float(kernels.clearance_lower_bound(self._packed, v, near, reach, horizon))
        if stop is None:
            return left
        return left - 2.0 * float(stop.aside.sum()) - (self._bend(stop.ways) - self._bend(horizon * np.abs(v)))

    def leaves_position_limits(self, q: Array, v: Array, horizon: float) -> bool:
        """Return True if a joint brakes harder for its position limit, see `kernels.leaves_position_limits`.

        Args:
            q: configuration (nq,).
            v: velocity (nv,).
            horizon: time for which v leads on [s].
        """
        return bool(kernels.leaves_position_limits(self._packed, q, v, horizon))

    def _bend(self, ways: Array) -> float:
        """Bound what turning bodies add [m], where coordinates travel `ways` (nv,) in all."""
        x = self._layout
        turned, slid = float(np.max(x.chain_rotation @ ways)), float(np.max(x.chain_translation @ ways))
        return turned * (turned * x.lever_arm + 2.0 * slid)

    def stop(self, q: Array, v: Array) -> Stop:
        """A tick at v and the stop after it, where jerks have limits.

        All of it is along v and the change that has led to v, but for what position and velocity limits forbid.

        Args:
            q: configuration (nq,) at which the tick begins.
            v: velocity (nv,).
        """
        x = self._layout
        assert self._stop is not None
        w = np.clip(v - x.v_prev, -x.v_step, x.v_step)
        way = self._stop.way(q, v, w)
        size = max(float(v @ v), 1e-300)
        shares = way @ v / size
        across = w - (w @ v / size) * v
        beside = way - shares[:, None] * v
        parts = beside @ across / max(float(across @ across), 1e-300)
        beside -= parts[:, None] * across
        kernels.joint_speeds(self._packed, across)
        aside = np.abs(parts) * x.speeds[: len(x.joint_poses)].max()
        if (np.abs(beside).max(axis=0) > _ROUND_OFF * x.v_step).any():
            turned, slid = np.abs(beside) @ x.chain_rotation.T, np.abs(beside) @ x.chain_translation.T
            aside += turned.max(axis=1) * x.lever_arm + slid.max(axis=1)
        return Stop(way, self._dt * np.abs(shares), self._dt * aside, self._dt * np.abs(way).sum(axis=0))

    def follow(self, v: Array, problem: Problem) -> Problem:
        """The problem of this tick with the velocity v (nv,) to follow in place of the tasks."""
        x = self._layout
        x.v_tracking[:] = v if problem.contacts is None else problem.contacts.project(v)
        if x.task_switching:
            kernels.row_bounds(self._packed, len(problem.avoidance.d), self._moving)
        worst = float(kernels.tracking_violation(self._packed, len(problem.avoidance.d)))
        return problem._replace(
            tracking=Tracking(self._eye, x.v_tracking, 0.0), violation=worst, levels=(), tracking_is_clear=False
        )

    def eased(self, problem: Problem) -> Problem:
        """The problem of this tick with as much of its v0 as can be had now without swinging past it.

        The way to v0 within jerk limits is a stop, for one who moves at v0. The velocity that is closest to v0 in every
        tick gets there with an acceleration that cannot be taken back at once: it swings to and fro about v0, for ever.
        """
        x, v_tracking = self._layout, problem.v_tracking
        if v_tracking[0] != v_tracking[0]:
            return problem
        eased = v_tracking + kernels.jerk_limited_stop(x.v_prev - v_tracking, x.dv_prev, x.v_step, x.dv_step)
        if problem.contacts is not None:
            eased = problem.contacts.project(eased)
        tracking = problem.tracking._replace(b=problem.tracking.b + problem.tracking.A @ (eased - v_tracking))
        rows = self._along(problem.avoidance, eased)
        worst = float(kernels.violation(eased, rows.J, rows.b, x.lower, x.upper))
        return problem._replace(tracking=tracking, avoidance=rows, v_tracking=eased, violation=worst)

    def prioritised(self, problem: Problem, tracked: Callable[[Problem], Array]) -> Problem:
        """The problem of this tick with rows for what a cascade tracks, which is not v0.

        Args:
            problem: as `compute` gave it.
            tracked: gives that velocity (nv,).
        """
        if not self._layout.task_switching:
            return problem
        return problem._replace(avoidance=self._along(problem.avoidance, tracked(problem)), tracking_is_clear=False)

    def _along(self, rows: AvoidanceRows, v: Array) -> AvoidanceRows:
        """Rows of this tick as they are where v (nv,) is tracked in place of v0; the same ones if that is no matter."""
        x, k = self._layout, len(rows.d)
        if not (x.task_switching and k):
            return rows
        memory = x.v_tracking, x.rhs[:k], x.rhs_contact[:k]
        kept = [array.copy() for array in memory]
        x.v_tracking[:] = v
        kernels.row_bounds(self._packed, k, self._moving)
        along = rows._replace(b=x.rhs[:k].copy(), b_contact=x.rhs_contact[:k].copy())
        for array, values in zip(memory, kept, strict=True):
            array[:] = values
        return along

    def _count_from_before(self) -> None:
        """Narrows the bounds to what accelerations and jerks allow from the velocity before.

        The kernels count from the nearest one that holds the contacts, which have turned a little since.
        """
        x = self._layout
        low = np.maximum(self._before - x.v_step, self._before + x.dv_prev - x.dv_step)
        high = np.minimum(self._before + x.v_step, self._before + x.dv_prev + x.dv_step)
        low, high = np.minimum(low, x.upper), np.maximum(high, x.lower)
        np.maximum(x.lower, low, out=x.lower)
        np.minimum(x.upper, high, out=x.upper)

    def beyond_limits(self, v: Array) -> tuple[Array, Array]:
        """By how much v (nv,) passes what accelerations and what jerks allow (nv,), negative within [rad/s or m/s]."""
        x, change = self._layout, v - self._before
        return np.abs(change) - x.v_step, np.abs(change - self._change) - x.dv_step

    def remember(self, v: Array) -> None:
        """Takes v (nv,) as the velocity at which the robot moves from this tick to the next."""
        x = self._layout
        if self.limits_may_give_way:
            np.subtract(v, self._before, out=self._change)
            self._before[:] = v
            np.clip(self._change, -x.v_step, x.v_step, out=x.dv_prev)
        x.v_prev[:] = v

    def measured(self, v: Array) -> None:
        """Takes v (nv,) as the velocity at which the robot moves until this tick; accelerations stay as commanded."""
        self._layout.v_prev[:], self._before[:] = v, v

    def restart(self, v: Array) -> None:
        """Takes v (nv,) as the velocity at which the robot has been moving, without any acceleration."""
        self._layout.v_prev[:], self._layout.dv_prev[:] = v, 0.0
        self._before[:], self._change[:] = v, 0.0

    @property
    def v_prev(self) -> Array:
        """Velocity (nv,) at which the robot moves until this tick."""
        return self._layout.v_prev

    @property
    def dv_prev(self) -> Array:
        """By how much that changed in the tick before (nv,); 0 where jerks have no limits."""
        return self._layout.dv_prev

    def _view(self, k: int) -> tuple[Proximity, AvoidanceRows]:
        x = self._layout
        near = x.near_pairs[:k]
        proximity = Proximity(near, x.closest[:k], x.J[:k], x.feedforward[:k])
        self._views[k] = proximity, AvoidanceRows(near, x.d[:k], x.J[:k], x.rhs[:k], x.d1, x.d2, x.rhs_contact[:k])
        return self._views[k]
