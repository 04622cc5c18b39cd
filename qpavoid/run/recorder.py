"""Store the steps of a run in arrays laid out beforehand."""

from __future__ import annotations

import platform
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from qpavoid import kernels
from qpavoid.config import Mesh, PointCloud, ScenarioConfig
from qpavoid.control.tasks import in_order
from qpavoid.control.tick import Tick
from qpavoid.controller import Controller
from qpavoid.geometry.bodies import enclosing_capsule, surface_triangles
from qpavoid.kernels.closed_loop import Periods
from qpavoid.model.kinematics import ForwardKinematics
from qpavoid.model.robot import Robot
from qpavoid.model.sample import POSE
from qpavoid.model.scene import PARKING_DISTANCE, Obstacle, Scene
from qpavoid.problem import Array, Solution, Status
from qpavoid.reason import Reason, ReasonKind
from qpavoid.run.log import STATUSES, WITH_PLANNING, Log
from qpavoid.run.machine import versions
from qpavoid.run.measurement import StateMeasurement
from qpavoid.solvers.solver import NamedSolver

if TYPE_CHECKING:
    from qpavoid.run.torque_plant import TorquePlant

_MAX_EVENTS = 1000
"""Number of events that a log keeps: a run that changes its reasons at every step would fill memory."""

_MAX_POINTS = 60
"""Points of the path of a tool in a forecast that a log keeps: a figure shows no more."""
_CHUNK = 64
"""Steps whose poses and distances are kept until they are stored together: array functions cost as much for one."""

_PLAIN = Solution.solved(np.zeros(0))
"""Stands for solutions of which there is nothing to say."""


class Recorder:
    """Store steps in arrays laid out beforehand, to be taken as a log at any time."""

    def __init__(
        self, controller: Controller, scenario: ScenarioConfig, ticks: int, plant: TorquePlant | None = None
    ) -> None:
        """Lay the arrays out for at most `ticks` steps, of a plant if there is one."""
        scene, model = controller.scene, controller.scene.robot.model
        self._scene, self._scenario = scene, scenario
        self._frames, self._other_tasks = in_order(controller.tasks)
        self._controller, self._plant = controller, plant
        self._measuring = StateMeasurement(controller, _CHUNK)  # of pairs near or not
        self._ends, self._radii = _drawing_axes(scene.robot)
        sizes = {"N": ticks, "nq": model.nq, "nv": model.nv, "k": len(self._frames), "s": len(self._other_tasks)}
        sizes |= {"m": len(plant.torque) if plant else 0, "c": len(plant.point_names) if plant else 0}
        self._arrays = Log.allocate({**sizes, "b": len(scene.body_names), "o": 0})
        self._arrays["closest_pair"].fill(-1)
        self._obstacles: list[Obstacle] = []
        self._descriptions: list[dict[str, Any]] = []
        self._names, self._pairs = scene.pair_names, [list(pair) for pair in scene.pair_names]
        self._pair_numbers = np.append(np.arange(len(self._pairs)), -1)  # of the scene's pairs in that list; of none
        self._moving = [i for i, obstacle in enumerate(scene.slots) if obstacle.moves]
        self._bodies, frames = np.arange(len(self._ends)), len(self._frames)
        self._turning = np.array([k for k, task in enumerate(self._frames) if task.turns], dtype=np.intp)
        self._placed, self._target_rotation = self._measuring.states[..., :POSE], np.zeros((ticks, frames, 3, 3))
        self._count = self._flushed = 0
        self._notice_obstacles()
        self._count_pairs()
        self._events: list[list[Any]] = []
        self._forecasts: list[dict[str, Any]] = []
        self._forecast: Array | None = None  # the last of them
        self._keys: tuple[object, ...] = ()

    def add(self, tick: Tick) -> None:
        """Store one step."""
        i, x, state, solution, near = self._count, self._arrays, tick.state, tick.solution, tick.problem.avoidance
        x["t"][i], x["q"][i], x["v"][i], x["task_error"][i] = state.t, state.q, solution.v, tick.errors
        x["tool"][i], x["tool_rotation"][i] = tick.kinematics.position, tick.kinematics.rotation
        for k, (task, target) in enumerate(zip(self._frames, tick.targets, strict=False)):
            x["target"][i, k] = target.position if task.moves else x["tool"][i, k]
            if task.turns:
                self._target_rotation[i, k] = target.rotation
        for name in ("command_scale", "saturation", "build_time", "solve_time"):
            x[name][i] = getattr(solution, name)
        x["stalled"][i], x["severity"][i] = bool(solution.stalled), solution.severity or 0
        x["planned"][i] = bool(solution.plan)
        x["status"][i] = STATUSES.index(solution.status)
        x["slack"][i] = 0.0 if solution.slack is None else np.max(solution.slack, initial=0.0)
        if len(near.d):
            d = float(near.d.min())
            x["alpha"][i], x["beta"][i] = kernels.alpha(d, near.d2), kernels.beta(d, near.d1, near.d2)
        if self._plant is not None:
            x["torque"][i], x["contact_force"][i] = self._plant.torque, self._plant.forces()
            x["slip"][i] = self._plant.slip()
        self._notice_changes()
        n = self._count - self._flushed
        self._measuring.q[n], self._placed[n] = state.q, tick.obstacles
        for j in self._moving if self._scenario.latency else ():  # the step takes them to be where they are later
            if self._scene.slots[j].name not in self._attached:
                self._placed[n, j] = self._scene.slots[j].motion.sample(state.t).row[:POSE]
        self._measuring.measure(n, n + 1)
        self._count += 1
        if n + 1 == _CHUNK:
            self._flush()
        self._record_events(state.t, solution)
        if solution.forecast is not None and solution.forecast is not self._forecast:
            self._forecast = solution.forecast
            self._forecasts.append({"t": state.t, "tools": self._tool_paths(solution.forecast)})

    def add_periods(self, periods: Periods, count: int, seconds: float, last: Solution | None) -> None:
        """Store plain steps, whose velocities are solutions without anything to say of them.

        Args:
            periods: record of them.
            count: their number.
            seconds: time that they took [s].
            last: solution of the last one, if there is more to say of it.
        """
        self._notice_changes()
        x, first, measuring, done = self._arrays, self._count, self._measuring, 0
        rows = slice(first, first + count)
        for name in ("t", "q", "v", "alpha", "beta"):
            x[name][rows] = getattr(periods, name)[:count]
        poses = periods.poses[:count]
        x["tool"][rows] = poses[..., 9:]
        x["tool_rotation"][rows] = poses[..., :9].reshape(*poses.shape[:2], 3, 3).swapaxes(2, 3)
        targets = periods.targets[:count, :, :POSE]
        self._target_rotation[rows] = targets[..., :9].reshape(*targets.shape[:2], 3, 3).swapaxes(2, 3)
        for k, task in enumerate(self._frames):
            x["target"][rows, k] = targets[:, k, 9:] if task.moves else x["tool"][rows, k]
        x["command_scale"][rows], x["build_time"][rows] = 1.0, seconds / count
        while done < count:
            n = self._count - self._flushed
            part = min(count - done, _CHUNK - n)
            measuring.q[n : n + part] = periods.q[done : done + part]
            self._placed[n : n + part] = periods.obstacles[done : done + part]
            measuring.measure(n, n + part)
            self._count, done = self._count + part, done + part
            if n + part == _CHUNK:
                self._flush()
        if count > 1 or last is None:
            self._record_events(float(x["t"][first]), _PLAIN)
        if last is not None:
            x["stalled"][self._count - 1], x["severity"][self._count - 1] = bool(last.stalled), last.severity or 0
            self._record_events(float(x["t"][self._count - 1]), last)

    def _record_events(self, t: float, solution: Solution) -> None:
        """Store status and reasons where they differ from the previous ones in kind."""
        reasons = (*solution.reasons, *solution.stalled, *solution.assumptions)
        if solution.plan:
            reasons += (Reason.of(ReasonKind.PLAN, detail=solution.plan),)
        keys = (solution.status, *[(*reason.key, reason.severity) for reason in reasons])
        eventful = solution.status is not Status.SOLVED or reasons
        if keys != self._keys and eventful and len(self._events) < _MAX_EVENTS:
            self._events.append([t, solution.status.value, [reason.as_dict() for reason in reasons]])
        self._keys = keys

    def _tool_paths(self, q: Array) -> list[list[list[float]]]:
        """Return the points of each tracked frame along configurations (n, nq), of some of them and the last [m]."""
        ids = [task.frame_id for task in self._frames]
        kinematics, points = ForwardKinematics(self._scene.robot.model, ids), []
        for i in np.unique(np.linspace(0, len(q) - 1, _MAX_POINTS).round().astype(int)):
            kinematics.compute(q[i])
            points.append(kinematics.frame_poses[ids, 9:].round(5))
        return np.array(points).swapaxes(0, 1).tolist()  # type: ignore[no-any-return]

    def _notice_obstacles(self) -> None:
        """Lay out columns for obstacles that are new, and number pairs with other names anew."""
        scene, known, x = self._scene, set(map(id, self._obstacles)), self._arrays
        new = [i for i, obstacle in enumerate(scene.slots) if obstacle.name and id(obstacle) not in known]
        self._obstacles += [scene.slots[i] for i in new]
        self._descriptions += [describe_obstacle(scene, i) for i in new]
        for name in ("obstacle_position", "obstacle_rotation"):
            count, _, *shape = x[name].shape
            x[name] = np.concatenate((x[name], np.full((count, len(new), *shape), np.nan)), axis=1)
        for i, (old, pair) in enumerate(zip(self._names, scene.pair_names, strict=True)):
            if old != pair:
                self._pair_numbers[i] = len(self._pairs)
                self._pairs.append(list(pair))
        self._names = scene.pair_names
        columns = {id(obstacle): column for column, obstacle in enumerate(self._obstacles)}
        self._present = np.array([i for i, obstacle in enumerate(scene.slots) if obstacle.name], dtype=np.intp)
        self._columns = np.array([columns[id(scene.slots[i])] for i in self._present.tolist()], dtype=np.intp)

    def _count_pairs(self) -> None:
        """List the pairs of each body, those of attached objects for the bodies that these count for."""
        scene, attached = self._scene, self._controller.attached
        counted_body = np.arange(len(scene.geometry.geometryObjects))
        for i, obstacle in enumerate(scene.slots):
            if obstacle.name in attached:
                counted_body[np.flatnonzero(scene.obstacle_of == i)] = _attachment_body(scene, attached[obstacle.name])
        bodies, count = counted_body[scene.pairs], len(scene.pairs)
        self._measuring.count_for(bodies)
        lists = [np.flatnonzero((bodies == body).any(axis=1)) for body in range(len(self._ends))]
        self._pairs_of = np.full((len(lists), max(map(len, lists), default=0) + 1), count)  # one that is infinitely far
        for row, pairs in zip(self._pairs_of, lists, strict=True):
            row[: len(pairs)] = pairs
        self._attached = attached

    def _notice_changes(self) -> None:
        """Take in what was added to the scene, removed, attached or released since the last step."""
        if self._scene.pair_names is not self._names or self._controller.attached != self._attached:
            self._flush()
            self._notice_obstacles()
            self._count_pairs()

    def _flush(self) -> None:
        """Store what is kept of the last steps: distances, and poses, NaN of obstacles that are not there."""
        x, first, count, numbers = self._arrays, self._flushed, self._count - self._flushed, self._pair_numbers
        rows, placed = slice(first, first + count), self._placed
        distance, posed = self._measuring.distance, self._measuring.posed[:count]
        x["obstacle_position"][rows, self._columns] = placed[:count, self._present, 9:]
        rotations = placed[:count, self._present, :9].reshape(count, -1, 3, 3)
        x["obstacle_rotation"][rows, self._columns] = rotations.transpose(0, 1, 3, 2)
        distance[distance > 0.5 * PARKING_DISTANCE] = np.inf
        least = distance[:count].argmin(axis=1)
        is_some = distance[np.arange(count), least] < np.inf
        x["closest_pair"][rows] = np.where(is_some, numbers[least], -1)
        near = distance[:count, self._pairs_of]
        nearest = near.argmin(axis=2)
        x["body_distance"][rows] = np.take_along_axis(near, nearest[..., None], axis=2)[..., 0]
        x["body_pair"][rows] = numbers[self._pairs_of[self._bodies, nearest]]
        R, p = posed[..., :9].reshape(count, -1, 3, 3), posed[:, :, None, 9:]  # by columns: that is Rᵀ
        x["body_ends"][rows] = self._ends @ R + p
        distance.fill(np.inf)
        self._flushed = self._count

    def log(self, stopped_by: str | None = None) -> Log:
        """Return the steps stored so far as a log.

        Args:
            stopped_by: why the run ended before its time, if it did.
        """
        self._flush()
        x, turning = self._arrays, self._turning
        x["turn_error"][:, turning] = _angles(self._target_rotation[:, turning], x["tool_rotation"][:, turning])
        scene, robot, plant = self._scene, self._scene.robot, self._plant
        bounds, is_named = robot.bounds(), isinstance(self._controller.solver, NamedSolver)
        meta = {
            "scenario": self._scenario.source.stem,
            "title": self._scenario.title,
            "solver": self._controller.solver.label + f" {WITH_PLANNING}" * bool(self._scenario.planning),
            "config": self._scenario.model_dump(mode="json", exclude=None if is_named else {"solver"}),
            "source": self._scenario.source.name,
            "completed": stopped_by is None and self._count == len(self._arrays["t"]),
            "stopped_by": stopped_by,
            "events": self._events,
            "forecasts": self._forecasts,
            "robot": robot.name,
            "notes": [str(note) for note in robot.notes],
            "positions": robot.position_names,
            "coordinates": robot.coordinate_names,
            "units": robot.coordinate_units,
            "velocity_limit": [v if np.isfinite(v) else None for v in bounds.velocity],
            "position_limits": [
                [robot.coordinate_names[v], lower, upper]
                for v, lower, upper in zip(bounds.v_index, bounds.lower.tolist(), bounds.upper.tolist(), strict=True)
            ],
            "torque_limit": [x if np.isfinite(x) else None for x in plant.torque_limit] if plant else [],
            "contact_points": plant.point_names if plant else [],
            "frames": [task.settings.label for task in self._frames],
            "tasks": [[task.settings.label, task.unit] for task in self._other_tasks],
            "bodies": scene.body_names,
            "body_radii": self._radii,
            "obstacles": self._descriptions,
            "pairs": self._pairs,
            "versions": {"python": platform.python_version(), "machine": platform.machine(), **versions()},
        }
        arrays = {name: array[: self._count].copy() for name, array in self._arrays.items()}
        return Log(**arrays, meta=meta)


def _angles(rotation: Array, other: Array) -> Array:
    """Return the angles (N, k) between rotations (N, k, 3, 3) [rad]."""
    between = rotation @ other.swapaxes(2, 3)
    axis = np.stack([between[..., i, j] - between[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=-1)
    return np.asarray(np.arctan2(np.linalg.norm(axis, axis=-1), np.trace(between, axis1=2, axis2=3) - 1.0))


def _attachment_body(scene: Scene, joint: int) -> int:
    """Return the body that counts an attached object's distances.

    It is the first body on the joint that the object is attached to, or on one above.
    """
    joints, parents = [body.parentJoint for body in scene.robot.bodies.geometryObjects], scene.robot.model.parents
    while joint and joint not in joints:
        joint = int(parents[joint])
    return joints.index(joint) if joint in joints else 0


_MAX_FACES = 2000
"""Triangles or voxels of an obstacle that a log keeps for its figures: a panel shows no more."""


def describe_obstacle(scene: Scene, index: int) -> dict[str, Any]:
    """Return name and shape of an obstacle, and triangles or voxels that come from files."""
    obstacle = scene.slots[index]
    described: dict[str, Any] = {"name": obstacle.name, "shape": obstacle.shape.model_dump(mode="json")}
    if isinstance(obstacle.shape, Mesh):
        solids = [scene.geometry.geometryObjects[int(g)].geometry for g in np.flatnonzero(scene.obstacle_of == index)]
        triangles = np.concatenate([surface_triangles(solid) for solid in solids])
        described["triangles"] = np.round(triangles[:: -(-len(triangles) // _MAX_FACES)], 5).tolist()
    elif isinstance(obstacle.shape, PointCloud):
        centers = scene.clouds[index].centers
        described["voxels"] = np.round(centers[:: -(-len(centers) // _MAX_FACES) or 1], 5).tolist()
    return described


@lru_cache(maxsize=4)
def _drawing_axes(robot: Robot) -> tuple[Array, list[float]]:
    """Return axis ends (b, 2, 3) in the parent joint's frame and radius of each body.

    A body that is no capsule is drawn as the capsule around it.
    """
    bodies = robot.bodies.geometryObjects
    ends, radii = np.empty((len(bodies), 2, 3)), []
    for i, body in enumerate(bodies):
        fit = enclosing_capsule(body.geometry)
        half = 0.5 * fit.length * fit.rotation[:, 2]
        local = np.array([fit.center - half, fit.center + half])
        ends[i] = local @ body.placement.rotation.T + body.placement.translation
        radii.append(fit.radius)
    return ends, radii
