"""Flights: a robot that drops its task and keeps away from everything, by linear programs on MuJoCo's geometry."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import mujoco
import numpy as np
from scipy.optimize import linprog

from qpavoid import ScenarioConfig
from qpavoid.arena.referee import Watch
from qpavoid.arena.twin import Twin
from qpavoid.problem import Array

PERIOD = 0.02
"""Time from one decision of a flight to the next, in whole ticks [s]."""
COMFORT, REACH = 0.10, 0.30
"""A flight wants this distance from everything, and looks at pairs nearer than that [m]."""
HORIZONS = (0.2, 0.05, 0.5)
"""How far flights look ahead [s]."""
LEANINGS = 6
"""Flights that lean to one side."""
LEAN = 0.01
"""Distance that they give up for each rad/s in that direction [m·s]."""


@dataclass(frozen=True)
class Means:
    """What the joints can do; (nv,) each, infinite where there is no limit."""

    speed: Array
    """[rad/s or m/s]."""
    lower: Array
    """[rad or m]."""
    upper: Array
    """[rad or m]."""
    acceleration: Array
    """[rad/s² or m/s²]."""

    def box(self, q: Array, v: Array, dt: float) -> tuple[Array, Array]:
        """Smallest and largest velocities (nv,) for the next dt, at q (nv,) after velocity v (nv,)."""
        change = self.acceleration * dt
        low = np.maximum.reduce((-self.speed, v - change, -self._fastest(q - self.lower, dt)))
        high = np.minimum.reduce((self.speed, v + change, self._fastest(self.upper - q, dt)))
        return np.minimum(low, high), np.maximum(low, high)

    def _fastest(self, room: Array, dt: float) -> Array:
        """Speed (nv,) that can be held for dt and then be braked within the room (nv,) left to a position limit."""
        brake = 0.5 * np.where(np.isfinite(self.acceleration), self.acceleration, 0.0)  # half: the rest is in reserve
        left = np.maximum(room - brake * dt**2, 0.0)
        return np.where(
            brake > 0.0, 2.0 * left / (dt + np.sqrt(dt**2 + 2.0 * left / np.maximum(brake, 1e-9))), left / dt
        )


@dataclass(frozen=True)
class Rows:
    """Pairs that are near: apart by d, and d changes at J v + drift."""

    pair: Any
    """(k,)."""
    d: Array
    """(k,) [m]."""
    J: Array
    """(k, nv)."""
    drift: Array
    """(k,) [m/s]."""


class Start(NamedTuple):
    """Where flights begin, and how long they must stay clear."""

    q: Array
    """(nv,)."""
    v: Array
    """(nv,) velocity of the tick before."""
    t: float
    """[s]."""
    until: float
    """[s]."""


class Manner(NamedTuple):
    """A way to flee."""

    name: str
    horizon: float
    """How far it looks ahead [s]; 0 stands still."""
    lean: Array | None
    """(nv,) distance that it gives up for speed in that direction [m·s]."""


@dataclass(frozen=True)
class Flight:
    """How a flight went."""

    touched: int | None
    """Pair that touched; None if none did."""
    t: float
    """Start of its last step [s]."""
    q: Array
    """(nv,) where it was then."""
    v: Array
    """(nv,) velocity of the step before."""
    clearance: float
    """Smallest distance on it [m]."""


def joint_means(twin: Twin, scenario: ScenarioConfig) -> Means:
    """What a scenario lets the joints do."""
    bounds = twin.scene.robot.bounds().within(scenario.limits)
    lower, upper = np.full_like(bounds.velocity, -np.inf), np.full_like(bounds.velocity, np.inf)
    lower[bounds.v_index], upper[bounds.v_index] = bounds.lower, bounds.upper
    return Means(bounds.velocity, lower, upper, bounds.acceleration)


def manners(count: int) -> Iterator[Manner]:
    """All ways to flee, for nv joints."""
    yield Manner("standing still", 0.0, None)
    for horizon in HORIZONS:
        yield Manner(f"fleeing, {horizon:g} s ahead,", horizon, None)
    for i in range(LEANINGS):
        direction = np.random.default_rng(i).normal(size=count)
        yield Manner(f"fleeing, leaning {i},", HORIZONS[0], LEAN * direction / np.linalg.norm(direction))


def fly(twin: Twin, means: Means, start: Start, dt: float, manner: Manner, pairs: Any) -> Flight:
    """Flees with ticks of dt [s], to the end or to the first contact of one of the pairs (m,)."""
    q, v, t, _ = start
    twin.place(q, t)
    watch = Watch(twin)
    watch.look(t)
    pairs = pairs.copy()
    pairs[[contact.pair for contact in watch.contacts]] = False
    watch = Watch(twin, pairs)
    watch.look(t)
    ticks = int(np.ceil(PERIOD / dt - 1e-9))
    while t < start.until - 1e-9:
        box, begin, before, last = means.box(q, v, ticks * dt), t, q, v
        rest = np.clip(np.zeros(len(q)), *box)
        wanted = flee(near_rows(twin, q, t, pairs, REACH), box, manner) if manner.horizon else rest
        # as long as the velocity stays, several ticks are as good as one
        count = ticks if np.isfinite(means.acceleration).any() else 1
        for _ in range(count):
            v = v + np.clip(wanted - v, *(sign * means.acceleration * dt for sign in (-1.0, 1.0)))
            q = watch.follow(q, v, t, ticks * dt / count)
            if watch.contacts:
                return Flight(watch.contacts[0].pair, begin, before, last, watch.distance)
            t += ticks * dt / count
    return Flight(None, t, q, v, watch.distance)


def near_rows(twin: Twin, q: Array, t: float, pairs: Any, reach: float) -> Rows:
    """Rows of those of the pairs (m,) that are nearer than `reach` [m], all by MuJoCo."""
    twin.place(q, t)
    scene, model, data = twin.scene, twin.model, twin.data
    mujoco.mj_comPos(model, data)
    first, second = scene.pairs.T
    centers, radius = twin.poses()[0], model.geom_rbound[twin.geoms]
    gap = np.linalg.norm(centers[first] - centers[second], axis=1) - radius[first] - radius[second]
    found, distance, points = [], [], np.empty((len(gap), 6))
    for pair in np.flatnonzero(pairs & (gap < reach)).tolist():
        d = twin.distance(pair, points[len(found)])
        if 0.0 < d < reach:
            found.append(pair)
            distance.append(d)
    pair, d, ends = np.array(found, dtype=np.intp), np.array(distance), points[: len(found)].reshape(-1, 2, 3)
    normal = (ends[:, 1] - ends[:, 0]) / d[:, None]
    jacobian = np.zeros((len(found), 2, 3, model.nv))
    velocity = np.zeros((len(found), 3))
    for i, sides in enumerate(scene.pairs[pair].tolist()):
        for side, geometry in enumerate(sides):
            if geometry < twin.bodies:
                body = model.geom_bodyid[twin.geoms[geometry]]
                mujoco.mj_jac(model, data, jacobian[i, side], None, ends[i, side], body)
            elif scene.obstacles[scene.obstacle_of[geometry]].moves:
                sample = scene.obstacles[scene.obstacle_of[geometry]].motion.sample(t)
                velocity[i] = sample.linear + np.cross(sample.angular, ends[i, 1] - sample.position)
    J = np.einsum("kx,kxv->kv", normal, jacobian[:, 1] - jacobian[:, 0])[:, twin.v_index]
    return Rows(pair, d, J, np.sum(normal * velocity, axis=1))


def flee(rows: Rows, box: tuple[Array, Array], manner: Manner) -> Array:
    """The velocity (nv,) that maximises the smallest distance at the horizon, up to COMFORT, by a linear program."""
    horizon, rest = manner.horizon, np.clip(np.zeros(len(box[0])), *box)
    ahead = rows.d + horizon * rows.drift
    if np.all(ahead + horizon * rows.J @ rest >= COMFORT):
        return rest
    answer = largest(horizon * rows.J, ahead, box, COMFORT, manner.lean)
    return rest if answer is None else np.clip(answer[:-1], *box)


def largest(A: Array, b: Array, box: tuple[Array, Array], cap: float, lean: Array | None) -> Array | None:
    """(v, s) with the largest s, less lean·v, such that A v + b >= s, v in the box, s <= cap; None without solution."""
    count = A.shape[1]
    cost = np.append(np.zeros(count) if lean is None else lean, -1.0)
    limits = [*zip(*box, strict=True), (None, None if np.isinf(cap) else cap)]
    result = linprog(cost, A_ub=np.column_stack((-A, np.ones(len(b)))), b_ub=b, bounds=limits, method="highs")
    return result.x if result.status == 0 else None
