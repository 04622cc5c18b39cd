"""Independent checker: run commanded velocities in MuJoCo and look for contacts, at the control steps and between them.

A robot that was simulated with its dynamics is placed where it was, at its control steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from qpavoid import Limits
from qpavoid.problem import Array
from qpavoid.run.mujoco import MujocoModel

STEP = 0.002
"""Largest travel of any point between two instants that are checked [m]: two bodies that touch and part in between
overlap by less."""
MAX_INSTANTS = 256
"""Largest number of instants in one control step: with more, travel between them exceeds STEP."""


@dataclass(frozen=True)
class Contact:
    """A pair that touched."""

    pair: int
    """Index in the scene's pairs."""
    time: float
    """Time of the first instant at which the pair touched [s]."""
    depth: float
    """Deepest penetration of the run [m]."""


@dataclass(frozen=True)
class Findings:
    """Result of checking one run."""

    distance: float
    """Smallest distance of any pair whose distance the robot can change [m]; inf if there is none."""
    pair: int
    """Index of the pair of that distance; -1 if there is none."""
    time: float
    """Time of that distance [s]."""
    contacts: tuple[Contact, ...]
    """Pairs that touched, in the order of time."""
    q: Array
    """(N, nq) configurations at the steps, by MuJoCo."""
    nearest: Array
    """(N,) smallest distance of the pairs that the robot can move, at the steps [m]: exact where below
    `measured_below`, elsewhere a lower bound that is not below it."""
    speed_excess: float
    """Largest excess of a commanded velocity over its limit; negative: the margin [rad/s or m/s]."""
    position_excess: float
    """Largest excess of a configuration over its limits; negative: the margin [rad or m]."""
    acceleration_excess: float
    """Largest excess of the velocity change over a period, from rest; -inf without limit [rad/s² or m/s²]."""
    instants: int
    """Number of instants that were checked."""


class DistanceMonitor:
    """Distances of all pairs of a MuJoCo model while it moves.

    A pair that was d apart when it was last measured cannot be nearer than d less what both bodies moved since. It is
    measured again only when that bound falls below the smallest distance so far, or below contact, or below its own
    greatest depth: what is left out could not have changed the outcome.
    """

    def __init__(self, model: MujocoModel, pairs: Any = None, measured_below: float = -np.inf) -> None:
        """Begin at the current pose of the model.

        Args:
            model: placed at the start.
            pairs: (m,) which pairs to watch; all if left out.
            measured_below: pairs that may be nearer than this are measured at every look [m].
        """
        self.model, self._measured_below = model, measured_below
        self.distance, self.pair, self.time, self.instants = np.inf, -1, np.nan, 0
        self._movable, count = model.movable, len(model.scene.pairs)
        self._bound, self._contact_time, self._depth = np.full(count, -np.inf), np.full(count, np.nan), np.zeros(count)
        if pairs is not None:
            self._bound[~pairs] = np.inf
        self._radius = model.model.geom_rbound[model.geoms]
        self._body_a, self._body_b = model.scene.pairs.T
        self._poses = model.poses()

    def measure(self, t: float) -> None:
        """Measure pairs whose bound says that they may matter, at the current pose of the model."""
        travel = self._geometry_travel()
        self._bound -= travel[self._body_a] + travel[self._body_b]
        self._poses = self.model.poses()
        self.instants += 1
        threshold = np.maximum(np.where(self._depth > 0.0, -self._depth, max(self.distance, 0.0)), self._measured_below)
        for pair in np.flatnonzero(self._bound < threshold).tolist():
            d = self._bound[pair] = self.model.distance(pair)
            if d < self.distance and self._movable[pair]:
                self.distance, self.pair, self.time = d, pair, t
            if d < -self._depth[pair]:
                if self._depth[pair] == 0.0:
                    self._contact_time[pair] = t
                self._depth[pair] = -d

    @property
    def nearest(self) -> float:
        """Return a lower bound on the distances of pairs that the robot can move [m].

        It is the smallest of them if below `measured_below`.
        """
        return float(np.min(self._bound[self._movable], initial=np.inf))

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """Return the pairs that touched, in the order of time."""
        touched = np.flatnonzero(self._depth > 0.0).tolist()
        contacts = [Contact(pair, float(self._contact_time[pair]), float(self._depth[pair])) for pair in touched]
        return tuple(sorted(contacts, key=lambda contact: contact.time))

    def follow(self, q: Array, v: Array, t: float, dt: float) -> Array:
        """Move at constant velocity for dt and check; return q (nv,) at t + dt."""
        model = self.model
        model.place(model.integrate(q, v, dt), t + dt)
        count = min(max(1, int(np.ceil(self._geometry_travel().max(initial=0.0) / STEP))), MAX_INSTANTS)
        for i in range(1, count + 1):
            q_step = model.integrate(q, v, dt * i / count)
            model.place(q_step, t + dt * i / count)
            self.measure(t + dt * i / count)
        return q_step

    def _geometry_travel(self) -> Array:
        """Bound the travel of any point of each geometry since the last instant, (g,) [m]."""
        (old_center, old_axes), (center, axes) = self._poses, self.model.poses()
        turn = np.sqrt(0.5 * np.square(axes - old_axes).sum(axis=1))  # chord of a point at distance 1 from the centre
        return np.asarray(np.sqrt(np.square(center - old_center).sum(axis=1)) + self._radius * turn)


def check_run(
    model: MujocoModel, t: Array, v: Array, limits: Limits, measured_below: float = -np.inf, q: Array | None = None
) -> Findings:
    """Run velocities from the start of the model, each until the next step, and check them.

    Args:
        model: the scene.
        t: times of the ticks (N,) [s].
        v: velocities commanded at them (N, nv) [rad/s or m/s].
        limits: use of the joint limits, against which velocities are held.
        measured_below: distances below it are measured at every tick [m].
        q: configurations (N, nq) at the ticks, of a robot that has not followed v exactly; nothing is checked between
            them.
    """
    known, q, nearest = q, np.empty((len(t), len(model.q0))), np.empty(len(t))
    model.place(model.q0, t[0])
    monitor = DistanceMonitor(model, measured_below=measured_below)
    monitor.measure(t[0])
    q_now = model.q0
    for k, now in enumerate(t.tolist()):
        q[k], nearest[k] = q_now, monitor.nearest
        if k + 1 < len(t) and known is not None:
            q_now = known[k + 1]
            model.place(q_now, t[k + 1])
            monitor.measure(t[k + 1])
        elif k + 1 < len(t):
            q_now = monitor.follow(q_now, v[k], now, float(t[k + 1]) - now)
    bounds = model.scene.robot.bounds().within(limits)
    acceleration = np.diff(v, axis=0, prepend=0.0) / np.diff(t, append=2.0 * t[-1] - t[-2])[:, None]
    limited = q[:, bounds.q_index]
    return Findings(
        distance=monitor.distance,
        pair=monitor.pair,
        time=monitor.time,
        contacts=monitor.contacts,
        q=q,
        nearest=nearest,
        speed_excess=float(np.max(np.abs(v) - bounds.velocity)),
        position_excess=float(np.max(np.maximum(bounds.lower - limited, limited - bounds.upper), initial=-np.inf)),
        acceleration_excess=float(np.max(np.abs(acceleration) - bounds.acceleration)),
        instants=monitor.instants,
    )
