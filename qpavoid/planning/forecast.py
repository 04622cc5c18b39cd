"""Forecasts: the law, or another drive of its QP, rolled out ahead in memory of its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, cast

import numpy as np
import pinocchio as pin

from qpavoid.config import Planning, RelativeTask, Sensing, SolverConfig
from qpavoid.control.builder import ProblemBuilder
from qpavoid.control.contacts import ContactRows
from qpavoid.control.obstacle_states import ObstacleStates
from qpavoid.control.scene_changes import SceneChanges
from qpavoid.control.settings import ControlSettings
from qpavoid.control.tasks import FrameTask, RowTask
from qpavoid.control.tasks.relative import Relative
from qpavoid.control.trajectories import extrapolate
from qpavoid.model.cloud import Points, Voxels
from qpavoid.model.sample import Sample
from qpavoid.model.trajectory import Trajectory
from qpavoid.planning.drive import Drive, Driver
from qpavoid.problem import Array, AvoidanceRows
from qpavoid.reason import Reason
from qpavoid.safety.arbiter import Arbiter
from qpavoid.solvers import make_solver

MAX_SPREAD = 0.03
"""Largest margin for where obstacles may get that do not go on as they do now [m]: with more, nothing arrives."""
_PRESENT = 1e-3
"""How much nearer than it is now a pair may come that is too near [m]."""


class Snapshot(NamedTuple):
    """State of a controller in which a control step begins."""

    t: float
    """[s]."""
    q: Array
    """(nq,)."""
    v: Array
    """(nv,) velocity commanded in the step before."""
    dv: Array
    """(nv,) change of velocity in that step."""
    drive: Drive
    """What it follows."""
    obstacles: tuple[str, ...]
    """Names of those that a program gives."""
    states: Array
    """(k, 18) their states."""
    clouds: Mapping[str, Voxels]
    """What is in point clouds among them that were given points."""
    targets: Mapping[str, Any]
    """Targets that a program gives, by name of the task; they are taken to stay where they are."""
    spread: float = 0.0
    """Rate at which a margin around the `obstacles` grows, up to `MAX_SPREAD` [m/s]: they may turn."""


class Expected(NamedTuple):
    """What a forecast lets one expect: all of it that a controller compares with what comes."""

    t: Array
    """(n + 1,) [s]."""
    q: Array
    """(n + 1, nq)."""
    errors: Array
    """(n + 1,) largest error of a frame [m, rad]."""


class Forecast(NamedTuple):
    """What drives lead to; row i is of the control step i, and the last one is the end."""

    t: Array
    """(n + 1,) [s]."""
    q: Array
    """(n + 1, nq)."""
    v: Array
    """(n + 1, nv) velocity at which the step begins."""
    dv: Array
    """(n + 1, nv) change of velocity in the step before."""
    errors: Array
    """(n + 1,) largest error of a frame [m, rad]."""
    clearance: Array
    """(n + 1,) least distance beyond the one that has to be kept [m]."""
    stalled_at: str = ""
    """What the tasks are stalled at in the end, if they are."""

    def step_at(self, t: float) -> int:
        """Return the control step at a time [s], at most the last one."""
        steps = len(self.t) - 1
        return min(max(round(float((t - self.t[0]) / (self.t[-1] - self.t[0]) * steps)), 0), steps) if steps else 0

    @property
    def expected(self) -> Expected:
        """What it lets one expect."""
        return Expected(self.t, self.q, self.errors)

    @property
    def rms_error(self) -> float:
        """Root mean square of the errors [m, rad]."""
        return float(np.sqrt(np.mean(self.errors**2)))

    @property
    def final_error(self) -> float:
        """Largest error of a frame at the end [m, rad]."""
        return float(self.errors[-1])


class Forecaster(SceneChanges):
    """A second controller of the same robot, tasks and scene, which is run ahead."""

    def __init__(
        self,
        settings: ControlSettings,
        tasks: Sequence[RowTask],
        contacts: ContactRows | None,
        law: SolverConfig,
        config: Planning,
    ) -> None:
        """Lay the memory out.

        Args:
            settings: of the controller.
            tasks: of the controller, frames first.
            contacts: frames that rest.
            law: of the controller.
            config: what is planned, and how.
        """
        scene = settings.scene.own_copy() if settings.scene.spare else settings.scene
        unlimited = Sensing(stale_after=None, stop_after=None)
        self._settings = replace(settings, scene=scene, sensing=unlimited, latency=0.0)
        self.scene, self._tasks, self._config = scene, tasks, config
        self._builder = ProblemBuilder(self._settings, tasks, contacts)
        rows, tracker = self._builder.rows, self._builder.tracker
        self._arbiter = Arbiter(self._settings, make_solver(law), rows, tracker)
        self._driver = Driver(rows, self._arbiter, config, scene.robot.model, settings.dt)
        rows.adapt(self._arbiter.solver, settings.avoidance.look_ahead)
        ends = [task.motion.end_time if isinstance(task.motion, Trajectory) else np.inf for task in tasks]
        self._settled = max(ends[: rows.frame_count]) + config.settle
        """Time until which the targets of the motions are to be reached [s]."""
        self._least = np.zeros(len(scene.pairs))
        """(m,) distance that each pair has to keep [m]."""

    def change_law(self, law: SolverConfig) -> None:
        """Forecast another law from now on."""
        self._arbiter.solver = make_solver(law)
        self._builder.rows.adapt(self._arbiter.solver, self._settings.avoidance.look_ahead)

    def attach_at(self, index: int, frame_id: int, q: Array, pose: Sample) -> None:
        """Attach an obstacle as it is attached to the robot; see `ProblemBuilder.attach`."""
        self._builder.attach(index, frame_id, q, pose)

    def end_of(self, start: Snapshot) -> float:
        """Return the time at which a forecast ends [s]."""
        config, now = self._config, start.t + 0.5 * self._settings.dt
        settled = start.t + config.settle
        times = settled if start.targets else self._settled, np.inf if config.deadline is None else config.deadline
        return min(min((time for time in times if time > now), default=settled), start.t + config.horizon)

    def run(self, start: Snapshot, end: float) -> Forecast:
        """Roll a drive out.

        Args:
            start: where it begins.
            end: when it ends [s].
        """
        builder, rows, dt, model = self._builder, self._builder.rows, self._settings.dt, self.scene.robot.model
        count = max(1, round((end - start.t) / dt))
        q, v, dv = (np.zeros((count + 1, n)) for n in (model.nq, model.nv, model.nv))
        errors, clearance = np.zeros((count + 1, len(rows.frame_errors))), np.full(count + 1, np.inf)
        q[0], v[0], dv[0] = start.q, start.v, start.dv
        self._restart(start)
        obstacles, spreading = _updates(start), [builder.tracker.index(name) for name in start.obstacles]
        stalled: tuple[Reason, ...] = ()
        for k in range(count + 1):
            updates = obstacles if k == 0 else None
            if start.spread or k == 0:  # the forecast before may have left a margin
                builder.tracker.widen(spreading, min(k * dt * start.spread, MAX_SPREAD))
            step = builder.build(builder.read(q[k], start.t + k * dt, start.targets or None, updates, None))
            distances = rows.problem().avoidance
            if k == 0:
                self._write_least(distances)
            errors[k] = rows.frame_errors
            clearance[k] = np.min(distances.d - self._least[distances.pair], initial=np.inf)
            if k == count or step.faults:
                break
            solution = self._driver.decide(step)
            stalled = solution.stalled
            builder.remember(solution.v)
            v[k + 1], dv[k + 1] = solution.v, rows.previous.dv
            q[k + 1] = pin.integrate(model, q[k], solution.v * dt)
        n = k + 1
        t = start.t + dt * np.arange(n, dtype=np.float64)
        errors = np.linalg.norm(errors[:n].reshape(n, -1, 3), axis=2).max(axis=1)
        return Forecast(t, q[:n], v[:n], dv[:n], errors, clearance[:n], _pair_of(stalled))

    def later(self, start: Snapshot, forecast: Forecast, step: int) -> Snapshot:
        """Return the state of a forecast that began at `start`, when one of its steps begins."""
        states, t = start.states.copy(), float(forecast.t[step])
        extrapolate(states, t - start.t)
        return start._replace(t=t, q=forecast.q[step], v=forecast.v[step], dv=forecast.dv[step], states=states)

    def obstacles_at(self, start: Snapshot, t: float) -> ObstacleStates:
        """Return where obstacles are at a time [s], as known in the state in which a forecast begins."""
        tracker = self._builder.tracker
        states = tracker.at(t).states.copy()
        margin = np.array([obstacle.uncertainty for obstacle in self.scene.slots])
        for name, row in zip(start.obstacles, start.states, strict=True):
            index = tracker.index(name)
            states[index] = row
            extrapolate(states[index : index + 1], t - start.t)
            margin[index] += min((t - start.t) * start.spread, MAX_SPREAD)
        return tracker.current._replace(states=states, margin=margin)

    def targets_at(self, start: Snapshot, t: float) -> dict[str | tuple[str, str], Any]:
        """Return targets of the frames at a time [s], in the axes of the world or of another frame."""
        targets: dict[str | tuple[str, str], Any] = {}
        for task in self._tasks:
            if not isinstance(task, FrameTask | Relative):
                continue
            target = start.targets.get(task.settings.label) or task.motion.sample(t)
            if isinstance(task, FrameTask):
                targets[task.settings.frame] = _part(target, task.moves, task.turns)
            else:
                block = cast(RelativeTask, task.settings)
                targets[block.frame, block.relative_to] = _part(target, task.moves, block.rows != "position")
        return targets

    def _restart(self, start: Snapshot) -> None:
        """Bring the controller into a state."""
        self._builder.reset(start.v)
        self._builder.rows.previous.dv[:] = start.dv
        self._builder.rows.query.table.forget_guesses()  # so that nothing depends on earlier forecasts
        self._arbiter.reset()
        self._driver.begin(start.drive)

    def _write_least(self, distances: AvoidanceRows) -> None:
        """Write the distances that pairs have to keep: the safety distance, or nearly what they have at the start."""
        is_movable = (self._builder.rows.query.table.support != 0.0).any(axis=1)
        self._least[:] = np.where(is_movable, distances.d1, -np.inf)
        pairs = distances.pair
        self._least[pairs] = np.minimum(self._least[pairs], distances.d - _PRESENT)


def _updates(start: Snapshot) -> dict[str, Sample | Points] | None:
    """Return what a step is given of obstacles, None of none; points stay as they are."""
    samples = {name: Sample.of_row(row) for name, row in zip(start.obstacles, start.states, strict=True)}
    points = {name: Points(voxels, samples[name], at_rest=True) for name, voxels in start.clouds.items()}
    return {**samples, **points} or None


def _part(target: Any, moves: bool, turns: bool) -> Any:
    """Return what of a target counts: its pose, its position or its orientation."""
    return target if moves and turns else target.position if moves else target.rotation


def _pair_of(stalled: tuple[Reason, ...]) -> str:
    """Return the subject of the strongest reason for which tasks are stalled; empty without one."""
    return " - ".join(stalled[0].subject) if stalled else ""
