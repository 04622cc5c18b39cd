"""From the arguments of a control step to its problem: the owner of obstacle states, attached objects and rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot
from threading import get_ident
from typing import Any

import numpy as np
import pinocchio as pin

from qpavoid import kernels
from qpavoid.control.arguments import ArgumentReader, Arguments
from qpavoid.control.assembler import RowAssembler
from qpavoid.control.attach import Attachments
from qpavoid.control.contacts import ContactRows
from qpavoid.control.inputs import LARGEST_VELOCITY, Clock, Configurations
from qpavoid.control.latency import CommandsUnderWay
from qpavoid.control.obstacle_states import Observation, StepUpdate
from qpavoid.control.obstacles import ObstacleTracker
from qpavoid.control.settings import ControlSettings
from qpavoid.control.slots import ObstacleSlots
from qpavoid.control.targets import TargetReader
from qpavoid.control.tasks import RowTask
from qpavoid.errors import NumericalError
from qpavoid.kernels.bounds import OUTSIDE
from qpavoid.model.sample import POSE, Sample
from qpavoid.problem import Array
from qpavoid.reason import Reason

_FLOAT = np.dtype(np.float64)


@dataclass(slots=True)
class StepProblem:
    """What a control step was made of, and how far it came, until the next one; its problem is in `RowAssembler`."""

    q: Array
    """(nq,) where the robot is when it follows the command."""
    t: float
    """When that is [s]."""
    resumed: bool
    """Whether the step begins anew: after a gap, or because the clock was set back."""
    targets: Sequence[Any]
    """Of all tasks."""
    is_settled: bool
    """Whether the velocity of `RowAssembler.v` may be commanded, see `RowAssembler.compute`."""
    faults: tuple[Reason, ...]
    """Why the robot has to stop."""
    assumptions: tuple[Reason, ...]
    is_plain: bool = False
    """Whether it is settled, and nothing stops the robot, nor is there any dynamics or latency to see to."""


class ProblemBuilder:
    """Builds the problem of each control step of one controller."""

    def __init__(self, settings: ControlSettings, tasks: Sequence[RowTask], contacts: ContactRows | None) -> None:
        """Lay the memory out; see `RowAssembler` for the arguments."""
        scene, bounds, dt = settings.scene, settings.bounds, settings.dt
        model, names = scene.robot.model, scene.robot.coordinate_units
        self._model, self._bounds, self._dt, self._latency = model, bounds, dt, settings.latency
        self._under_way = CommandsUnderWay(model.nv, settings.latency, dt)
        self.rows = RowAssembler(settings, tasks, contacts)
        self._q_last = self.rows.q.copy() if settings.latency else self.rows.q
        self._step = StepProblem(self.rows.q, 0.0, False, (), False, (), ())
        self.tracker = ObstacleTracker(scene.slots, settings.sensing, dt, settings.latency)
        self.tracker.load(self.rows.query)
        self.attachments = Attachments(scene, self.rows.query, settings.safety_distance)
        self.slots = ObstacleSlots(scene, self.rows.query, self.tracker, self.attachments)
        self._clock, self._budget = Clock(dt), settings.budget
        units = [names[j] for j in bounds.v_index.tolist()]
        self._configurations = Configurations(model, bounds.q_index, bounds.lower, bounds.upper, units)
        self._targets = TargetReader(tasks, self.rows.targets, settings.latency)
        shapes = self._q_shape, self._v_shape = (model.nq,), (model.nv,)
        reader = ArgumentReader(shapes, self._clock, self._configurations, self._targets, self.tracker)
        self._read = reader.read
        limits, strided = self._configurations.bounds, np.zeros(2 * model.nq)[::2]
        self._usual_arguments = limits, np.zeros(int(limits[2].max()) + 1), self.rows.targets, self.rows.q
        self._take_usual = kernels.direct(kernels.take_usual, strided, *self._usual_arguments)  # q: of any strides
        self.usual_limits = self._usual_arguments[:2]
        """Limits and scratch of `kernels.take_usual`."""
        self.has_plain_steps = self.rows.is_compiled and self.rows.dynamics is None and not settings.latency
        self._thread: int | None = None
        self.begun: StepProblem | None = None
        """Step whose command is not known yet."""

    @property
    def gives_targets(self) -> bool:
        """Whether the program gave any targets in the last step."""
        return self._targets.are_given

    def read(self, q: Any, t: Any, targets: Any, obstacles: Any, v: Any, v_desired: Any = None) -> Arguments:
        """Check the arguments of a step, see `Controller.step`: whatever raises does so here, and changes nothing."""
        if self._budget.is_limited:
            self._budget.begin()
        if self.rows.dynamics is not None and v is None:
            raise NumericalError("v: with `dynamics`, a step needs the velocity (nv,) as measured: step(q, v=…)")
        return self._read(q, t, targets, obstacles, v, v_desired)

    def build(self, arguments: Arguments) -> StepProblem:
        """Take over the arguments of a step, and build its problem.

        Raises:
            RuntimeError: another thread is in the middle of a step.
        """
        if self._thread not in (None, thread := get_ident()):
            raise RuntimeError("a Controller is used by two threads at once; give each one of its own: `clone()`")
        self._thread = thread
        times, q, v, v_desired, targets, update, faults, assumptions = arguments
        if self.begun is not None and q is not None:  # nothing is known of what was commanded then
            self.rows.previous.remember(pin.difference(self._model, self._q_last, q) / (times.periods * self._dt))
            self._under_way.add(self.rows.previous.v)
        self._targets.last = targets
        rows = self.rows
        if times.resumed or (v is not None and self._clock.is_first):
            self._restart(np.zeros(self._model.nv) if v is None else v)
        elif times.periods > 1:
            self._under_way.add(rows.previous.v, times.periods - 1)
        if rows.dynamics is not None and v is not None:
            rows.previous.measure(v)
        if q is None or self._latency:
            q = self._predict(q)
        self._clock.set(times.t)
        if update is not None:
            observed = self._place(update)
            faults, assumptions = faults + observed.stop, assumptions + observed.assumptions
        if rows.dynamics is not None and v is not None:
            rows.dynamics.observe(q, v)
            faults, assumptions = rows.dynamics.touched(faults, assumptions)
        is_settled, step = rows.compute(q, targets, v_desired), self._step
        step.q, step.t, step.resumed, step.targets = rows.q, times.t + self._latency, times.resumed, targets
        step.is_settled, step.faults, step.assumptions, step.is_plain = is_settled, faults, assumptions, False
        return self._finish(step)

    def begin(self, q: Any, t: Any, targets: Any, obstacles: Any, v: Any) -> StepProblem:
        """Build the problem of a step of the tasks from its arguments, see `Controller.step`: whatever raises does so.

        Raises:
            NumericalError, UnknownName: as `Controller.step`.
        """
        step = self._build_plain(q, t, targets, obstacles, v)
        return self.build(self.read(q, t, targets, obstacles, v)) if step is None else step

    def _build_plain(self, q: Any, t: Any, targets: Any, obstacles: Any, v: Any) -> StepProblem | None:
        """Do as `read` and `build` where one compiled call is all of a step, and arguments are plain and as expected.

        Returns:
            None where it is another step, for which nothing has been changed.
        """
        if not (self.has_plain_steps and self.begun is None and self._thread is None and _is_plain(q, self._q_shape)):
            return None
        if v is not None and not (_is_plain(v, self._v_shape) and hypot(*v.tolist()) <= LARGEST_VELOCITY):
            return None
        if (now := self._clock.usual(t)) is None or (samples := self._targets.usual(now, targets)) is None:
            return None
        if self._budget.is_limited:
            self._budget.begin()
        rows = self.rows
        follows = obstacles is None and self.tracker.follows_trajectories and not rows.query.has_planes
        update = None if follows else self.tracker.read(now, obstacles)
        if not self._take_usual(q, *self._usual_arguments):
            return None
        self._thread, self._targets.last, step = get_ident(), samples, self._step
        self._clock.set(now)
        step.q, step.t, step.resumed, step.targets, step.faults, step.assumptions = rows.q, now, False, samples, (), ()
        if follows:
            self.tracker.follow(now, rows.query)
        elif update is not None:
            step.assumptions, step.faults = self._place(update)
        rows.follows_tasks = True
        step.is_settled = rows.run()
        step.is_plain = step.is_settled and not step.faults
        return self._finish(step)

    def is_plain_ahead(self, t: float) -> bool:
        """Return whether a step at t [s] would go on as expected, and all that it needs to know is there already."""
        query, tracker = self.rows.query, self.tracker
        is_expected = self.begun is None and self._thread is None and self._clock.usual(t) is not None
        if not (is_expected and self.rows.settles and tracker.is_foreseen and not query.table.attached):
            return False
        turns_planes = bool(np.isinf(query.obstacle_radii[tracker.current.which]).any())
        return not (turns_planes or self.attachments.is_watching)

    def go_on(self, t: float) -> None:
        """Take a step at t [s] as taken, of which kernels have done everything."""
        self._clock.set(t)

    def _place(self, update: StepUpdate) -> Observation:
        """Take over an update of obstacles, and place them."""
        observed = self.tracker.advance(update)
        self.rows.query.place(self.tracker.current)
        return observed

    def _finish(self, step: StepProblem) -> StepProblem:
        """Do what follows once distances and rows are computed; the command of the step is not known yet."""
        rows = self.rows
        if self.attachments.is_watching:
            self.attachments.update()
        if not step.is_settled and rows.position_margin < -OUTSIDE:
            step.assumptions += self._bounds.outside(rows.q, rows.joint_names, rows.joint_units)
        self.begun = step
        return step

    def _predict(self, q: Array | None) -> Array:
        """Return where the robot is when it follows this step's command, if it follows those under way until then.

        Args:
            q: as measured (nq,); None where it is unknown: it moved as commanded.
        """
        model, latency, displacement = self._model, self._latency, self._under_way.displacement
        if q is None:
            predicted = np.asarray(pin.integrate(model, self.rows.q, self._dt * self.rows.previous.v))
            q = pin.integrate(model, predicted, -displacement) if latency else predicted
        else:
            predicted = pin.integrate(model, q, displacement) if latency else q
        self._q_last[:] = q
        return predicted

    def remember(self, v: Array) -> None:
        """Take v (nv,) as what is commanded from this step to the next one."""
        self.rows.previous.remember(v)
        if self._latency:
            self._under_way.add(v)
        self.begun, self._thread = None, None

    def _restart(self, v: Array) -> None:
        """Take the robot to have been moving at v (nv,), as commanded."""
        self.rows.previous.restart(v)
        self._under_way.fill(v)

    def attach(self, index: int, frame_id: int, q: Array | None, pose: Sample | None = None) -> Array:
        """Attach an obstacle to a frame, at its pose unless one is given, and return q; see `Controller.attach`."""
        q = self._given_or_last(q)
        self.attachments.attach(index, frame_id, q, pose or self._pose(index, q))
        self.tracker.attach(index)
        self._place_attachment(index, q)
        return q

    def release(self, index: int, q: Array | None) -> tuple[Sample, Array]:
        """Release an attached object, and return its world pose, and q; see `Controller.release`."""
        q = self._given_or_last(q)
        sample = self.attachments.release(index, q)
        self.tracker.release(index, sample)
        self._place_attachment(index, q)
        return sample, q

    def _place_attachment(self, index: int, q: Array) -> None:
        self.rows.query.place(self.tracker.current)
        self.attachments.ignore_touching(index, q)

    def pose(self, index: int, q: Array | None) -> Sample:
        """Return the world pose of an obstacle in the last step, attached or not."""
        return self._pose(index, self._given_or_last(q))

    def obstacle_poses(self, q: Array) -> Array:
        """Return the world poses (o, 12) of all obstacles in the last step, at q (nq,)."""
        poses: Array = self.tracker.current.states[:, :POSE].copy()
        for index in self.rows.query.table.attached:
            poses[index] = self.attachments.pose(index, q).row[:POSE]
        return poses

    def _pose(self, index: int, q: Array) -> Sample:
        is_attached = index in self.rows.query.table.attached
        return self.attachments.pose(index, q) if is_attached else self.tracker.pose(index)

    def _given_or_last(self, q: Array | None) -> Array:
        return self._q_last if q is None else self._configurations.require("q", q)

    def reset(self, v: Array) -> None:
        """Forget the steps before; the robot moves at v (nv,). Attached objects stay attached."""
        self._restart(v)
        if (dynamics := self.rows.dynamics) is not None and dynamics.observer is not None:
            dynamics.observer.reset()
        self.begun, self._thread = None, None
        self._clock.reset()
        self._targets.last = ()
        self.tracker.reset()


def _is_plain(value: Any, shape: tuple[int, ...]) -> bool:
    """Return whether a value is an array of that shape that needs no conversion."""
    return type(value) is np.ndarray and (value.dtype is _FLOAT or value.dtype == _FLOAT) and value.shape == shape
