"""When a look ahead is due, and what becomes of its result; the part of a controller that plans."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from qpavoid import kernels
from qpavoid.config import Planning
from qpavoid.control.builder import ProblemBuilder, StepProblem
from qpavoid.control.contacts import ContactRows
from qpavoid.control.settings import ControlSettings
from qpavoid.control.tasks import FrameTask, RowTask
from qpavoid.model.cloud import Voxels
from qpavoid.model.sample import POSE, STATE, Sample
from qpavoid.planning.candidates import Decision, is_sound
from qpavoid.planning.drive import TRACK, Driver
from qpavoid.planning.forecast import Expected, Snapshot
from qpavoid.planning.worker import Answer, Parts, Question, Worker, make_worker
from qpavoid.problem import Array, IntArray, Solution
from qpavoid.reason import Reason, ReasonKind
from qpavoid.safety.arbiter import Arbiter
from qpavoid.solvers import Solver
from qpavoid.solvers.solver import NamedSolver

_LONGEST_WAIT = 4.0
"""Longest time between two looks that find nothing [s]."""
_CHANGED = 0.02
"""Difference of a task's error, or of an obstacle's position, from the forecast, after which it does not count [m]."""
_TURNED = 0.1
"""The same of a joint, or of an obstacle's orientation [rad]."""
_CHECKED = 0.05
"""Time between two comparisons of the robot and its targets with a forecast [s]: a fraction of `lead`."""
_STEADY = 1e-3
"""Rate at which obstacles may leave their courses that counts as none [m/s]: round-off, and slow turns."""
_SOONEST = 0.1
"""Time after a look at which an obstacle that has left its course lets the next one begin [s]."""
_NOISE = 1e-3
"""Root mean square of what an obstacle's position differs from that of a step before and its twist, from which on
twists are too noisy to plan with [m]: at 10 m/s², it is half as much."""
_FORGETTING = 0.05
"""Weight of the newest difference in that mean, and of the newest step in the share of those below [-]."""
_UNSTEADY = 0.5
"""Share of steps whose twist leads elsewhere within `period` than that of the step before, from which on twists are too
noisy to plan with [-]."""
_MEASURED = 20
"""Differences after which the mean counts; before that, obstacles that move may be noisy [-]."""
_ROUND_OFF = 1e-9
"""Difference of two times that counts as none [s]."""
_NO_STATES: Array = np.zeros((0, STATE))


class Replanning:
    """Looks ahead when it is due, and lets another drive begin where that arrives and the present one does not."""

    def __init__(
        self,
        settings: ControlSettings,
        tasks: Sequence[RowTask],
        contacts: ContactRows | None,
        builder: ProblemBuilder,
        arbiter: Arbiter,
        config: Planning,
    ) -> None:
        """Begin with the tasks alone.

        Args:
            settings: of the controller.
            tasks: of the controller.
            contacts: frames that rest.
            builder: of the controller.
            arbiter: of the controller.
            config: what is planned, and how.
        """
        self._builder, self._config, self._settings, self._tasks = builder, config, settings, tasks
        self._driver = Driver(builder.rows, arbiter, config, settings.scene.robot.model, settings.dt)
        self._number, law = 0, arbiter.solver
        self._no_plan = _exclusion(tasks, law)
        self._notes = tuple[Reason, ...]()  # what of plans is excluded
        self._worker: Worker | None = None
        if self._no_plan is None and isinstance(law, NamedSolver):
            self._worker = make_worker(Parts(settings, tasks, contacts, law.config, config))
        self._load_kernels()
        self.reset()

    def _load_kernels(self) -> None:
        """Load the kernels that compare what comes with a forecast: no step compiles them."""
        which, states = self._builder.tracker.external[:0], self._builder.tracker.current.states
        q, errors = self._builder.rows.q, self._builder.rows.frame_errors
        kernels.strays(q, errors, 0.0, np.zeros(1), q[None].copy(), np.zeros(1), _CHANGED, _TURNED)
        kernels.any_off_course(states, which, _NO_STATES, 0.0, 0.0, _CHANGED, _TURNED)
        kernels.note_courses(states, which, _NO_STATES, 0.0, _NO_STATES.copy())
        self._surprise_arguments = float(self._settings.dt), float(self._config.period), _CHANGED
        none = _NO_STATES.copy(), *self._surprise_arguments
        self._surprise = kernels.direct(kernels.surprise, states, which, *none)

    def reset(self) -> None:
        """Drop all plans; the next step looks ahead."""
        self._driver.begin(TRACK)
        self._pending: Decision | None = None
        self._expected: Expected | None = None
        self._rejected: Array | None = None  # configurations of the forecast that led to what is followed, or pending
        self._question: Question | None = None
        self._asked_states = _NO_STATES  # of obstacles that a program gives, in the last look
        self._asked_clouds = dict[int, Voxels]()  # what was in clouds then
        self._named: IntArray | None = None  # numbers of obstacles that have these names
        self._names = tuple[str, ...]()
        self._last_look, self._next_look, self._wait = -np.inf, -np.inf, self._config.period
        self._next_check = -np.inf  # of robot and targets against the forecast [s]
        self._idle_until = -np.inf  # time before which steps are the law's alone, as far as is known [s]
        self._looks = 0
        self._last_states = _NO_STATES  # in the step before
        self._noise, self._measured = 0.0, 0  # mean square [m²], number of differences
        self._unsteady = 0.0  # share of steps whose twist leads elsewhere than that of the step before
        self._compared_at = -np.inf  # step of the last difference [s]
        self._spread = 0.0  # mean square of the rate at which obstacles left their courses between looks [m²/s²]

    def change_law(self, law: Solver) -> None:
        """Forecast another law from now on; nothing is forecast if the first one could not be."""
        self.reset()
        if self._worker is not None:
            self._no_plan = _exclusion(self._tasks, law)
            if self._no_plan is None and isinstance(law, NamedSolver):
                self._worker.change("change_law", law.config)

    def drop(self) -> None:
        """Drop what is followed: the next step is of a given velocity."""
        if self._driver.drive is not TRACK:
            self.reset()
        self._pending = self._question = None

    def change_scene(self, method: str, *arguments: Any) -> None:
        """Change the scene of forecasts like that of the controller, if at all; what was planned is dropped."""
        if self._worker is not None and method:
            self._worker.change(method, *arguments)
        self.reset()

    def leaves_alone(self, step: StepProblem) -> bool:
        """Return whether a step is the law's alone: nothing is followed, is to begin, or is to be said.

        What is to be asked or taken over is, if that does not change it.
        """
        if step.t < self._idle_until:
            return True
        if self._worker is None or self._driver.drive is not TRACK or self._pending is not None:
            return False
        if self._no_plan is not None or self._notes:
            return False
        self._look_ahead(step, self._worker)
        if self._pending is not None or self._no_plan is not None or self._notes:
            return False
        if self._question is None and not self._has_given:
            self._idle_until = min(step.t + _CHECKED, self._next_look) - _ROUND_OFF
        return True

    def _look_ahead(self, step: StepProblem, worker: Worker) -> None:
        """Ask for a look ahead where one is due, and take an answer over where there is one."""
        self._compare(step.t)
        if self._pending is None and self._question is None and self._is_due(step):
            self._ask(step, worker)
        if worker.has_answer() and (answer := worker.poll()) is not None:
            self._take(answer, step.t)

    def _compare(self, t: float) -> None:
        """Compare obstacles that a program gives with what the step before led to, once in each step."""
        if t != self._compared_at and len(self._builder.tracker.external):
            self._compared_at = t
            self._measure_noise()

    def decide(self, step: StepProblem) -> Solution:
        """Return the solution of a step, and look ahead from it where that is due."""
        if step.resumed:
            self.reset()
        drive, worker, dt = self._driver.drive, self._worker, self._settings.dt
        if self._pending is not None and step.t > self._pending.t + dt:  # steps were left out, or stops
            self._pending, self._next_look = None, step.t
        if self._no_plan is None and worker is not None:
            self._look_ahead(step, worker)
        self._idle_until = -np.inf  # what follows may change that
        solution = self._driver.decide(step)
        if self._driver.drive.mode is not drive.mode:  # a path has ended
            self._next_look = step.t
        if solution.stalled and self._pending is None:
            self._next_look = min(self._next_look, self._last_look + self._wait)
        if self._pending is not None and step.t + dt >= self._pending.t - _ROUND_OFF:
            self._driver.begin(self._pending.drive)
            self._expected, self._next_look = self._pending.expected, step.t + self._config.period
            self._pending = None
        notes = self._notes if self._no_plan is None else (self._no_plan,)
        if drive.reason or notes:
            forecast = self._rejected if drive.reason else None
            return solution._replace(plan=drive.reason, forecast=forecast, assumptions=(*solution.assumptions, *notes))
        return solution

    def _is_due(self, step: StepProblem) -> bool:
        """Return whether to look ahead: time has come, or what was forecast does not come true."""
        t, period = step.t, self._config.period
        if t >= self._next_look - _ROUND_OFF:
            return True
        since = t - self._last_look + _ROUND_OFF
        is_watched = self._has_given and since >= (period if self._is_noisy else min(_SOONEST, period))
        if is_watched and self._is_off_course(t):
            return True
        if since < period or t < self._next_check:
            return False
        self._next_check = t + _CHECKED - _ROUND_OFF
        return self._has_changed(step)

    @property
    def _has_given(self) -> bool:
        """Whether a program gives obstacles now, or did in the last look."""
        return bool(len(self._builder.tracker.external) or len(self._asked_states))

    def _has_changed(self, step: StepProblem) -> bool:
        """Return whether the robot or targets are elsewhere than in the forecast, or clouds have other points."""
        expected, clouds = self._expected, self._builder.tracker.current.voxels
        if expected is None or any(voxels is not self._asked_clouds.get(i) for i, voxels in clouds.items()):
            return True
        errors = self._builder.rows.frame_errors
        return bool(kernels.strays(step.q, errors, step.t, expected.t, expected.q, expected.errors, _CHANGED, _TURNED))

    def _is_off_course(self, t: float) -> bool:
        """Return whether an obstacle that a program gives is elsewhere than the last look had it, at a time [s]."""
        which, states = self._builder.tracker.external, self._builder.tracker.current.states
        if len(which) != len(self._asked_states):
            return True
        elapsed = t - self._last_look
        horizon = self._config.period
        return bool(kernels.any_off_course(states, which, self._asked_states, elapsed, horizon, _CHANGED, _TURNED))

    @property
    def _is_noisy(self) -> bool:
        """Whether twists are too noisy to plan with, or it is not known yet."""
        return self._measured < _MEASURED or self._noise > _NOISE**2 or self._unsteady > _UNSTEADY

    def _measure_noise(self) -> None:
        """Compare obstacles with what their twists in the step before led to, once a step."""
        tracker, last = self._builder.tracker, self._last_states
        which, states = tracker.external, tracker.current.states
        if len(last) == len(which):
            worst, turns = self._surprise(states, which, last, *self._surprise_arguments)
            self._measured += 1
            weight = max(_FORGETTING, 1.0 / self._measured)
            self._noise += weight * (worst - self._noise)
            self._unsteady += weight * (turns - self._unsteady)
        else:
            self._last_states = states[which]

    def _ask(self, step: StepProblem, worker: Worker) -> None:
        """Ask for a look ahead from a step."""
        tracker, previous, t = self._builder.tracker, self._builder.rows.previous, step.t
        which, clouds = tracker.external, tracker.current.voxels
        asked = np.empty((len(which), STATE))
        earlier, elapsed = self._asked_states, t - self._last_look
        is_moving, rate = kernels.note_courses(tracker.current.states, which, earlier, elapsed, asked)
        if 0 < len(which) == len(earlier) and elapsed > 0.0:
            self._spread += 0.5 * ((rate if rate > _STEADY else 0.0) ** 2 - self._spread)
        if is_noisy := is_moving and self._is_noisy:  # a single twist is no base for what an obstacle does in a second
            asked[:, POSE:] = tracker.twists[which]
        if which is not self._named:
            slots = self._settings.scene.slots
            self._named, self._names = which, tuple(slots[i].name for i in which.tolist())
        points = _named(clouds, which, self._names) if clouds else {}
        given = self._given_targets(step) if self._builder.gives_targets else {}
        start = Snapshot(
            t, step.q.copy(), previous.v.copy(), previous.dv.copy(), self._driver.drive, self._names, asked,
            points, given, math.sqrt(self._spread) if is_moving else 0.0,
        )  # fmt: skip
        self._number += 1
        self._question = Question(self._number, start, is_moving, is_noisy, self._looks)
        self._asked_states, self._asked_clouds = asked, dict(clouds)
        self._looks, self._last_look = self._looks + 1, t
        worker.ask(self._question)

    def _take(self, answer: Answer, t: float) -> None:
        """Take over an answer at a time [s], and decide when to look again."""
        question, outcome, period = self._question, answer.outcome, self._config.period
        if answer.no_paths:
            self._notes = (Reason.of(ReasonKind.NO_PLAN, "paths", detail=answer.no_paths),)
        if answer.number < 0:
            self._no_plan = Reason.of(ReasonKind.NO_PLAN, "worker", detail=answer.failure)
        if question is None or answer.number != question.number:
            return
        self._question = None
        is_fine = answer.is_checked or (outcome is not None and is_sound(outcome, self._settings.scene.robot.model))
        if outcome is None or not is_fine:
            detail = answer.failure or "what it answers has the wrong shape, or is not finite"
            self._no_plan = Reason.of(ReasonKind.NO_PLAN, "worker", detail=detail)
            return
        self._expected = outcome.expected
        if outcome.arrives:
            self._next_look, self._wait = t + (period if question.is_moving else np.inf), period
        elif outcome.decision is None:
            self._next_look = t + self._wait
            self._wait = period if question.is_moving else min(2.0 * self._wait, _LONGEST_WAIT)
        else:
            self._next_look, self._wait = t + period, period
            if outcome.decision.t >= t - _ROUND_OFF:  # else it comes too late
                self._pending, self._rejected = outcome.decision, outcome.expected.q

    def _given_targets(self, step: StepProblem) -> dict[str, Any]:
        """Return targets that are not those of the tasks' motions, by name."""
        given = {}
        for task, target in zip(self._tasks, step.targets, strict=True):
            planned = task.motion.sample(step.t)
            a, b = (x.row if isinstance(x, Sample) else x for x in (planned, target))
            if not np.array_equal(a, b):
                given[task.settings.label] = target
        return given


def _named(clouds: dict[int, Voxels], which: IntArray, names: tuple[str, ...]) -> dict[str, Voxels]:
    """Return by name what is in those of some obstacles that are point clouds."""
    return {name: clouds[i] for i, name in zip(which.tolist(), names, strict=True) if i in clouds}


def _exclusion(tasks: Sequence[RowTask], law: Solver) -> Reason | None:
    """Return what excludes forecasts, if anything does."""
    if not any(isinstance(task, FrameTask) for task in tasks):
        return Reason.of(ReasonKind.NO_PLAN, "tasks", detail="no frame follows a motion")
    if isinstance(law, NamedSolver) and law.bounded:
        return None
    return Reason.of(ReasonKind.NO_PLAN, "solver", detail=f"{law.label} is neither qp nor hqp")
