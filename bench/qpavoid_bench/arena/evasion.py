"""Evasions: a robot drops its task and keeps away from everything, by linear programs on MuJoCo's geometry."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import mujoco
import numpy as np
from scipy.optimize import linprog

from qpavoid import Limits
from qpavoid.problem import Array
from qpavoid.run.mujoco import MujocoModel
from qpavoid_bench.arena.checker import DistanceMonitor

PERIOD = 0.02
"""Time between two decisions of an evasion, in whole control steps [s]."""
PREFERRED_DISTANCE, INFLUENCE_DISTANCE = 0.10, 0.30
"""An evasion parts pairs up to the first distance, and considers those nearer than the second [m]."""
HORIZONS = (0.2, 0.05, 0.5)
"""Prediction horizons of evasions [s]."""
BIASES = 6
"""Evasions with a bias to one side [-]."""
BIAS_COST = 0.01
"""Distance that they trade for each rad/s in that direction [m·s]."""


class JointLimits(NamedTuple):
    """Limits of the joints; (nv,) each, infinite where there is none."""

    speed: Array
    """[rad/s or m/s]."""
    lower: Array
    """[rad or m]."""
    upper: Array
    """[rad or m]."""
    acceleration: Array
    """[rad/s² or m/s²]."""

    @classmethod
    def of(cls, model: MujocoModel, limits: Limits) -> JointLimits:
        """Return the limits of a model's robot."""
        bounds = model.scene.robot.bounds().within(limits)
        lower, upper = np.full_like(bounds.velocity, -np.inf), np.full_like(bounds.velocity, np.inf)
        lower[bounds.v_index], upper[bounds.v_index] = bounds.lower, bounds.upper
        return cls(bounds.velocity, lower, upper, bounds.acceleration)

    def box(self, q: Array, v: Array, dt: float) -> tuple[Array, Array]:
        """Return the smallest and largest velocities (nv,) for the next dt, at q (nv,) after velocity v (nv,)."""
        change = self.acceleration * dt
        low = np.maximum.reduce((-self.speed, v - change, -self._max_speed(q - self.lower, dt)))
        high = np.minimum.reduce((self.speed, v + change, self._max_speed(self.upper - q, dt)))
        return np.minimum(low, high), np.maximum(low, high)

    def _max_speed(self, margin: Array, dt: float) -> Array:
        """Return the speed (nv,) that can be held for dt and then be braked within the margin (nv,) to a limit."""
        braking = 0.5 * np.where(np.isfinite(self.acceleration), self.acceleration, 0.0)  # half: the rest is in reserve
        remaining = np.maximum(margin - braking * dt**2, 0.0)
        return np.where(
            braking > 0.0,
            2.0 * remaining / (dt + np.sqrt(dt**2 + 2.0 * remaining / np.maximum(braking, 1e-9))),
            remaining / dt,
        )


class Rows(NamedTuple):
    """Distances d of near pairs, with ḋ = J v + feedforward."""

    pair: Any
    """(k,)."""
    d: Array
    """(k,) [m]."""
    J: Array
    """(k, nv)."""
    feedforward: Array
    """(k,) [m/s]."""


class Start(NamedTuple):
    """State in which evasions begin, and the time until which they must stay clear."""

    q: Array
    """(nv,)."""
    v: Array
    """(nv,) velocity of the control step before."""
    t: float
    """[s]."""
    until: float
    """[s]."""


class EvasionPolicy(NamedTuple):
    """Rule by which an evasion keeps away from everything."""

    name: str
    horizon: float
    """Prediction horizon [s]; 0 stands still."""
    bias: Array | None
    """(nv,) distance that it trades for speed in that direction [m·s]."""


class Evasion(NamedTuple):
    """Result of an evasion."""

    contact: int | None
    """Pair in contact at its end; None if it stayed clear."""
    t: float
    """Start of its last period [s]."""
    q: Array
    """(nv,) configuration then."""
    v: Array
    """(nv,) velocity before."""
    clearance: float
    """Least distance along it [m]."""


def policies(count: int) -> Iterator[EvasionPolicy]:
    """Yield all policies, for nv joints."""
    yield EvasionPolicy("standing still", 0.0, None)
    for horizon in HORIZONS:
        yield EvasionPolicy(f"evasion, horizon {horizon:g} s,", horizon, None)
    for i in range(BIASES):
        direction = np.random.default_rng(i).normal(size=count)
        yield EvasionPolicy(f"evasion, bias {i},", HORIZONS[0], BIAS_COST * direction / np.linalg.norm(direction))


def evade(
    model: MujocoModel, limits: JointLimits, start: Start, dt: float, policy: EvasionPolicy, pairs: Any
) -> Evasion:
    """Follow a policy with control steps of dt [s], to the end or to the first contact of one of the pairs (m,)."""
    q, v, t, _ = start
    model.place(q, t)
    monitor = DistanceMonitor(model)
    monitor.measure(t)
    pairs = pairs.copy()
    pairs[[contact.pair for contact in monitor.contacts]] = False
    monitor = DistanceMonitor(model, pairs)
    monitor.measure(t)
    steps = int(np.ceil(PERIOD / dt - 1e-9))
    while t < start.until - 1e-9:
        box, begin, q_begin, v_begin = limits.box(q, v, steps * dt), t, q, v
        stop = np.clip(np.zeros(len(q)), *box)
        rows = near_rows(model, q, t, pairs, INFLUENCE_DISTANCE) if policy.horizon else None
        chosen = stop if rows is None else policy_velocity(rows, box, policy)
        # while the velocity stays, several control steps are as good as one
        count = steps if np.isfinite(limits.acceleration).any() else 1
        for _ in range(count):
            v = v + np.clip(chosen - v, *(sign * limits.acceleration * dt for sign in (-1.0, 1.0)))
            q = monitor.follow(q, v, t, steps * dt / count)
            if monitor.contacts:
                return Evasion(monitor.contacts[0].pair, begin, q_begin, v_begin, monitor.distance)
            t += steps * dt / count
    return Evasion(None, t, q, v, monitor.distance)


def near_rows(model: MujocoModel, q: Array, t: float, pairs: Any, max_distance: float) -> Rows:
    """Return the rows of those of the pairs (m,) that are nearer than `max_distance` [m], all by MuJoCo."""
    model.place(q, t)
    scene, mujoco_model, data = model.scene, model.model, model.data
    mujoco.mj_comPos(mujoco_model, data)
    first, second = scene.pairs.T
    centers, radius = model.poses()[0], mujoco_model.geom_rbound[model.geoms]
    gap = np.linalg.norm(centers[first] - centers[second], axis=1) - radius[first] - radius[second]
    near: list[tuple[int, float]] = []
    points = np.empty((len(gap), 6))
    for candidate in np.flatnonzero(pairs & (gap < max_distance)).tolist():
        distance = model.distance(candidate, points[len(near)])
        if 0.0 < distance < max_distance:
            near.append((candidate, distance))
    pair, d = np.array([p for p, _ in near], dtype=np.intp), np.array([distance for _, distance in near])
    ends = points[: len(near)].reshape(-1, 2, 3)
    normal = (ends[:, 1] - ends[:, 0]) / d[:, None]
    jacobian = np.zeros((len(near), 2, 3, mujoco_model.nv))
    velocity = np.zeros((len(near), 3))
    for i, sides in enumerate(scene.pairs[pair].tolist()):
        for side, geometry in enumerate(sides):
            if geometry < model.bodies:
                body = mujoco_model.geom_bodyid[model.geoms[geometry]]
                mujoco.mj_jac(mujoco_model, data, jacobian[i, side], None, ends[i, side], body)
            elif scene.obstacles[scene.obstacle_of[geometry]].moves:
                sample = scene.obstacles[scene.obstacle_of[geometry]].motion.sample(t)
                velocity[i] = sample.linear + np.cross(sample.angular, ends[i, 1] - sample.position)
    J = np.einsum("kx,kxv->kv", normal, jacobian[:, 1] - jacobian[:, 0])[:, model.v_index]
    return Rows(pair, d, J, np.sum(normal * velocity, axis=1))


def policy_velocity(rows: Rows, box: tuple[Array, Array], policy: EvasionPolicy) -> Array:
    """Return the velocity (nv,) of the largest least distance at the horizon, capped, by a linear program."""
    horizon, stop = policy.horizon, np.clip(np.zeros(len(box[0])), *box)
    predicted = rows.d + horizon * rows.feedforward
    if np.all(predicted + horizon * rows.J @ stop >= PREFERRED_DISTANCE):
        return stop
    answer = largest(horizon * rows.J, predicted, box, PREFERRED_DISTANCE, policy.bias)
    return stop if answer is None else np.clip(answer[:-1], *box)


def largest(A: Array, b: Array, box: tuple[Array, Array], cap: float, bias: Array | None) -> Array | None:
    """Return (v, s) with the largest s - bias·v, A v + b >= s, v in the box, s <= cap; None without solution."""
    count = A.shape[1]
    cost = np.append(np.zeros(count) if bias is None else bias, -1.0)
    limits = [*zip(*box, strict=True), (None, None if np.isinf(cap) else cap)]
    result = linprog(cost, A_ub=np.column_stack((-A, np.ones(len(b)))), b_ub=b, bounds=limits, method="highs")
    return np.asarray(result.x) if result.status == 0 else None
