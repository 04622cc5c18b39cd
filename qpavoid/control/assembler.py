"""From a configuration to a problem: kinematics, distances, rows and bounds of a control step, in memory of its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from qpavoid import kernels
from qpavoid.budget import UNLIMITED
from qpavoid.control.contacts import ContactRows
from qpavoid.control.distances import DistanceQuery
from qpavoid.control.jerk_stops import JerkStop, JerkStops
from qpavoid.control.previous_velocity import PreviousVelocity
from qpavoid.control.row_layout import lay_out
from qpavoid.control.settings import ControlSettings
from qpavoid.control.tasks import RowTask, in_order
from qpavoid.control.tasks.layout import TaskRows, dead_beat, task_levels
from qpavoid.control.tracked import TrackedVelocities
from qpavoid.kernels import SETTLED, TO_MEASURE
from qpavoid.kernels.layout import RowLayout
from qpavoid.model.kinematics import ForwardKinematics, Kinematics
from qpavoid.problem import Array, AvoidanceRows, Contacts, Problem, Proximity, Solution, Tracking
from qpavoid.solvers.solver import Solver


class _Form(NamedTuple):
    """Rows in one form: memory that all forms share, but for some numbers and gains."""

    layout: RowLayout
    packed: Any
    views: dict[int, tuple[Proximity, AvoidanceRows]]
    """What there is of k near pairs, by k."""


class RowAssembler(TrackedVelocities):
    """Rows and bounds of a control step. What it returns looks into memory that the next step overwrites."""

    def __init__(
        self, settings: ControlSettings, tasks: Sequence[RowTask], contacts: ContactRows | None = None
    ) -> None:
        """Lay the memory out.

        Args:
            settings: of the controller.
            tasks: what to follow.
            contacts: frames that rest; none if left out.
        """
        scene, limits = settings.scene, settings.limits
        frames, row_tasks = in_order(tasks)
        frame_ids = [i for task in (*frames, *row_tasks) for i in task.frame_ids]
        frame_ids += contacts.frame_ids if contacts else ()
        self._forward = ForwardKinematics(scene.robot.model, frame_ids)
        self.query = DistanceQuery(scene)
        """Distances of the control step."""
        self.influence_distance = settings.influence_distance
        """Surface distance below which a pair gets a row [m]."""
        self.query.set_influence_distance(self.influence_distance)
        x = self._layout = lay_out(settings, frames, row_tasks, self._forward, self.query)
        is_hard = limits.relax_acceleration or settings.dynamics is not None
        self._hard = (x.hard_lower, x.hard_upper) if is_hard else (x.lower, x.upper)
        self.packed: Any = kernels.pack(x)
        """Memory of the control step in compiled code, see `RowLayout`."""
        self.dynamics = settings.dynamics
        own = None if self.dynamics is None else self.dynamics.contacts
        self.contacts = self._contacts = own or (None if contacts is None else contacts.own_copy())
        """Frames that rest, and which of them do now; None without any."""
        if self.dynamics is not None:
            self.dynamics.lay_out(x)
        self._scene = scene
        self.joint_names, self.joint_units = tuple(scene.robot.coordinate_names), tuple(scene.robot.coordinate_units)
        """Name and unit of each coordinate."""
        self.previous = PreviousVelocity(x, contacts is not None and self.dynamics is None)
        """Velocity at which the robot moves when a step begins."""
        self._stops = JerkStops(x, self.packed) if x.jerk_limited else None
        self.targets = x.targets
        """(f, 18) states that the frame tasks are to reach, see `trajectories`; to be written before `compute`."""
        self._tracking, levels = Tracking(x.A, x.b, x.b_feasible), task_levels(frames, row_tasks)
        self._following = Tracking(x.identity, x.v_tracking, x.v_tracking)
        self._levels = levels if len(levels) > 1 else ()
        self._task_rows = TaskRows(row_tasks, x.A, x.b)
        self.task_errors = self._task_rows.errors
        """How far each of the tasks that are not frames was from its target in the last step, in its unit."""
        self.frame_errors, self.row_scale, self.row_tasks = x.errors, x.scale, x.row_tasks
        """What frames lack to their targets; root of the weight and number of the task of each row: see `RowLayout`."""
        self.frame_count, self.tasks = len(frames), (*frames, *row_tasks)
        """Tasks in the order of `in_order`; the first `frame_count` are frames."""
        self._b_feasible = np.zeros(len(x.b))
        self.is_compiled = self._forward.is_compiled and self.query.is_compiled and not row_tasks and contacts is None
        """Whether a step at velocity level is one compiled call, but for pairs whose cores meet."""
        self._finds_pairs = self._forward.is_compiled and not self.query.has_clouds
        self.q: Array = scene.robot.home.copy()
        """Configuration (nq,) of the last step."""
        self.v = x.v
        """Velocity (nv,) that may be commanded, where `compute` says so; the next step overwrites it."""
        self.follows_tasks = True
        """Whether the step is of the tasks, or of a velocity that is given."""
        self._contact_rows: Contacts | None = None
        self._find = kernels.direct(kernels.find_near_pairs, self.packed, self.q, self.influence_distance)
        self._forms = [_Form(x, self.packed, {})]
        self._step = self._load_step()
        self.use_form(0)
        self.kinematics = Kinematics(x.J_world, x.poses)
        """World Jacobian and poses of the tracked frames in this step."""

    def adapt(self, law: Solver, looks_ahead: bool) -> None:
        """Let control steps do as much of a law as compiled code can.

        They look ahead neither with contacts nor jerk limits, with which v_tracking or the stop are not what kernels
        take them for.

        Args:
            law: that decides in the next steps.
            looks_ahead: whether a step looks ahead, of a bounded law.
        """
        looks_ahead = looks_ahead and law.bounded and self._contacts is None and not self._layout.jerk_limited
        numbers: dict[str, Any] = {"looks_ahead": looks_ahead, "regularization": law.compiled_regularization}
        if self.dynamics is not None:
            if not self.dynamics.has_torques:  # without torque limits, margins are relaxed before accelerations
                numbers["regularization"] = 0.0
            self.dynamics.approaches[0] = self._approaches = law.bounded
        if numbers != {name: getattr(self._layout, name) for name in numbers}:
            layouts = [form.layout._replace(**numbers) for form in self._forms]
            self._forms = [_Form(layout, kernels.pack(layout), {}) for layout in layouts]
            self.use_form(0)

    def add_dampers(self, row_gain: float, margin: float, gain: float = 0.0) -> int:
        """Lay out velocity dampers as another form of the rows, in the same memory; return its number for `use_form`.

        Args:
            row_gain: ξ [1/s].
            margin: added to the safety distance [m].
            gain: least feedback gain of the frames [1/s].
        """
        x = self._layout
        gains, of_frames = np.maximum(x.gain, gain), x.row_tasks < self.frame_count
        near_one = x.dead_beat.copy()
        near_one[of_frames] = dead_beat(gains, x.dt)[x.row_tasks[of_frames]]
        dampers = x._replace(
            row_gain=row_gain, near_speed=np.inf, task_switching=False, d1=x.d1 + margin, gain=gains, dead_beat=near_one
        )
        self._forms.append(_Form(dampers, kernels.pack(dampers), {}))
        return len(self._forms) - 1

    def use_form(self, number: int) -> None:
        """Choose the form of the rows of the next steps; 0 is that of the settings."""
        self._layout, self.packed, self._views = self._forms[number]
        self._row_count = self._layout.summary.view(np.ndarray)["rows"]

    def _load_step(self) -> Callable[..., int]:
        """Return the code of `kernels.control_step` for all forms, which runs once now: it leaves guesses behind."""
        arguments = self.packed, self.q, self.influence_distance, False, True, False
        if self.dynamics is not None:
            return self.dynamics.step(*arguments)
        return kernels.direct(kernels.control_step, *arguments)

    def compute(self, q: Array, targets: Sequence[Any], v_desired: Array | None = None) -> bool:
        """Compute distances, rows and bounds at a configuration, with the obstacles as placed.

        Args:
            q: configuration (nq,).
            targets: what each task should reach now, in the order of `in_order`.
            v_desired: velocity (nv,) to follow in place of the tasks.

        Returns:
            Whether `v` is what the law and the stop look-ahead lead to; else they have to see `problem`.
        """
        x, from_tasks, self.follows_tasks = self._layout, v_desired is None, v_desired is None
        self.q[:] = q  # the code takes q as it is: in one piece, and writeable
        if v_desired is not None:
            x.v_tracking[:] = v_desired
        if self.dynamics is not None:
            self.dynamics.update(self.q, x.v_prev)
        if self.is_compiled:
            return self.run()
        self._measure()
        if from_tasks and self.task_errors.size:
            self._task_rows.write(q, self._forward, targets[len(self.targets) :])
        if self._contacts is not None:
            self._contacts.advance(x.dt, self._forward)
            if self.dynamics is None:  # which begins at the velocity as measured, and holds contacts by itself
                self._contact_rows = resting = self._contacts.update(self._forward)
                x.v_prev[:] = resting.project(x.v_prev)
        return self._finish()

    def run(self) -> bool:
        """Compute a step at `q` in one call, but for pairs whose cores meet; return what `compute` does."""
        moving, from_tasks = self.query.is_moving, self.follows_tasks
        code = self._step(self.packed, self.q, self.influence_distance, moving, from_tasks, False)
        if code != TO_MEASURE:
            return code == SETTLED
        self.query.finish()
        return self._finish()

    def follow(self, v_desired: Array, at_once: bool = False) -> bool:
        """Follow a velocity (nv,) in place of the tasks in the last step after all; return what `compute` does.

        With `at_once`, a torque level takes it as that of the end of the control period, and does not approach it.
        """
        self.follows_tasks, self._layout.v_tracking[:] = False, v_desired
        if self.dynamics is None or not at_once:
            return self._finish()
        self.dynamics.approaches[0] = False
        is_settled, self.dynamics.approaches[0] = self._finish(), self._approaches
        return is_settled

    def _finish(self) -> bool:
        """Compute a step whose kinematics and distances are up to date."""
        arguments = self.query.is_moving, self.follows_tasks, True
        code = self._step(self.packed, self.q, self.influence_distance, *arguments)
        if self._contact_rows is not None:
            self._hold(self._contact_rows)
        return code == SETTLED

    def _measure(self) -> None:
        """Compute kinematics and distances."""
        if self._finds_pairs:
            self._find(self.packed, self.q, self.influence_distance)
            self.query.finish()
        else:
            self._forward.compute(self.q)
            self.query.compute(self._forward.joint_poses, self.influence_distance)

    @property
    def settles(self) -> bool:
        """Whether a step may settle its velocity, of a law that it knows."""
        return bool(self._layout.looks_ahead and self._layout.regularization > 0.0)

    @property
    def position_margin(self) -> float:
        """Distance to the nearest position limit in the last step [rad, m]; negative outside."""
        return float(self._layout.summary["position_margin"][0])

    def proximity(self) -> Proximity:
        """Return the distances of the last step."""
        return self._view()[0]

    def problem(self) -> Problem:
        """Return the problem of the last step."""
        x, (_, violation, is_clear, position_margin, bent) = self._layout, self._layout.summary.item()
        contacts = self._contact_rows if self.dynamics is None else self.dynamics.resting
        tracking, levels = (self._tracking, self._levels) if self.follows_tasks else (self._following, ())
        return Problem(
            tracking, self._view()[1], x.lower, x.upper, *self._hard, x.v_stop, self._scene.pair_names,
            self.joint_names, self.joint_units, x.v_tracking, violation, contacts, levels, None, bent,
            x.jerk_limited, is_clear, position_margin, UNLIMITED,
            None if self.dynamics is None else self.dynamics.rows(x.v_prev),
        )  # fmt: skip

    def _hold(self, contacts: Contacts) -> None:
        """Let the velocity that is tracked hold the contacts."""
        x, summary = self._layout, self._layout.summary[0]
        if self.follows_tasks:
            summary.bent = self._track_within(contacts)
        else:
            x.v_tracking[:] = contacts.project(x.v_tracking)
        self.previous.tighten_bounds()
        if x.task_switching:
            summary.bent = 0.0
            kernels.row_bounds(self.packed, summary.rows, self.query.is_moving)
        summary.violation = kernels.tracking_violation(self.packed, summary.rows)

    def _track_within(self, contacts: Contacts) -> float:
        """Let the tracking law hold the contacts; return how far the task rows bend."""
        x, v_particular = self._layout, contacts.v_particular
        missing = x.b - x.A @ v_particular
        A = x.A @ contacts.Z @ contacts.Z.T
        bent = float(kernels.tracking_law(self.packed, A, missing, x.v_tracking, x.b_feasible))
        x.v_tracking[:] += v_particular
        x.b_feasible[:] += x.A @ v_particular
        return bent

    def torques(self, solution: Solution) -> Solution:
        """Return a solution with its torques, see `RobotDynamics.command`."""
        assert self.dynamics is not None
        return self.dynamics.command(solution, self._layout.v_prev, self.joint_names, self.joint_units)

    def stop(self, q: Array, v: Array) -> JerkStop | None:
        """Return the stop after a step at v (nv,) from q (nq,); None without jerk limits, where it is straight."""
        return None if self._stops is None else self._stops.stop(q, v)

    def clearance_lower_bound(self, v: Array, near: int, horizon: float, stop: JerkStop | None = None) -> float:
        """Bound the clearance beyond the safety distances along the path of v from below [m].

        See `kernels.clearance_lower_bound`.

        Args:
            v: velocity (nv,).
            near: number of near pairs.
            horizon: time for which v leads on [s].
            stop: what else there is of the path, with jerk limits.
        """
        bound = float(kernels.clearance_lower_bound(self.packed, v, near, self.influence_distance, horizon))
        if stop is None or self._stops is None:
            return bound
        return bound - self._stops.clearance_lost(stop, v, horizon)

    def leaves_position_limits(self, q: Array, v: Array, horizon: float) -> bool:
        """Return True if a joint brakes harder for its position limit, see `kernels.leaves_position_limits`.

        Args:
            q: configuration (nq,).
            v: velocity (nv,).
            horizon: time for which v leads on [s].
        """
        return bool(kernels.leaves_position_limits(self.packed, q, v, horizon))

    def _view(self) -> tuple[Proximity, AvoidanceRows]:
        """Return what there is of the near pairs of the last step."""
        x, k = self._layout, int(self._row_count[0])
        if k not in self._views:
            near = x.near_pairs[:k]
            proximity = Proximity(near, x.closest[:k], x.J[:k], x.feedforward[:k])
            self._views[k] = proximity, AvoidanceRows(near, x.d[:k], x.J[:k], x.rhs[:k], x.d1, x.d2, x.rhs_contact[:k])
        return self._views[k]
