"""The referee: plays commanded velocities in MuJoCo and looks for contacts, at the ticks and between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from qpavoid import Limits
from qpavoid.arena.twin import Twin
from qpavoid.problem import Array

STEP = 0.002
"""Nothing moves farther than this from one look to the next [m]."""
MOST_LOOKS = 256
"""In one tick: with more, steps get longer than STEP."""


@dataclass(frozen=True)
class Contact:
    """A pair that touched."""

    pair: int
    """Index in the scene's pairs."""
    time: float
    """Of the first look at which it did [s]."""
    depth: float
    """Deepest penetration of the run [m]."""


@dataclass(frozen=True)
class Findings:
    """What the referee saw in one run."""

    distance: float
    """Smallest of any pair whose distance the robot can change [m]; inf if there is none."""
    pair: int
    """That pair; -1 if there is none."""
    time: float
    """When [s]."""
    contacts: tuple[Contact, ...]
    """In the order of time."""
    q: Array
    """(N, nq) configurations at the ticks, by MuJoCo's integration."""
    nearest: Array
    """(N,) smallest distance of the pairs that the robot can part, at the ticks [m]: as it is where that is below
    `near`, elsewhere some lower bound that is not."""
    speed_excess: float
    """How far a commanded velocity lies beyond its limit, at most; negative: the margin [rad/s or m/s]."""
    position_excess: float
    """The same of the configurations [rad or m]."""
    acceleration_excess: float
    """The same of the change from tick to tick, from rest, over the period; -inf without limit [rad/s² or m/s²]."""
    looks: int
    """Number of instants looked at."""


class Watch:
    """Follows all pairs of a twin while it moves.

    A pair that was d apart when it was last measured cannot be nearer than d less what both bodies moved since. It is
    measured again only when that bound falls below the smallest distance so far, or below contact, or below its own
    greatest depth: what is left out could not have changed the outcome.
    """

    def __init__(self, twin: Twin, pairs: Any = None, near: float = -np.inf) -> None:
        """Begins where the twin is.

        Args:
            twin: placed at the start.
            pairs: (m,) which pairs to watch; all if left out.
            near: pairs that may be nearer than this are measured at every look [m].
        """
        self.twin, self._near = twin, near
        self.distance, self.pair, self.time, self.looks = np.inf, -1, np.nan, 0
        self._counts, count = twin.movable, len(twin.scene.pairs)
        self._bound, self._touch, self._depth = np.full(count, -np.inf), np.full(count, np.nan), np.zeros(count)
        if pairs is not None:
            self._bound[~pairs] = np.inf
        self._radius = twin.model.geom_rbound[twin.geoms]
        self._first, self._second = twin.scene.pairs.T
        self._poses = twin.poses()

    def look(self, t: float) -> None:
        """Measures what has to be, where the twin is now."""
        travel = self._travel()
        self._bound -= travel[self._first] + travel[self._second]
        self._poses = self.twin.poses()
        self.looks += 1
        matters = np.maximum(np.where(self._depth > 0.0, -self._depth, max(self.distance, 0.0)), self._near)
        for pair in np.flatnonzero(self._bound < matters).tolist():
            d = self._bound[pair] = self.twin.distance(pair)
            if d < self.distance and self._counts[pair]:
                self.distance, self.pair, self.time = d, pair, t
            if d < -self._depth[pair]:
                if self._depth[pair] == 0.0:
                    self._touch[pair] = t
                self._depth[pair] = -d

    @property
    def nearest(self) -> float:
        """Lower bound on the distances of pairs that the robot can part [m]; the smallest of them if below `near`."""
        return float(np.min(self._bound[self._counts], initial=np.inf))

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """Pairs that touched, in the order of time."""
        touched = np.flatnonzero(self._depth > 0.0).tolist()
        found = [Contact(pair, float(self._touch[pair]), float(self._depth[pair])) for pair in touched]
        return tuple(sorted(found, key=lambda contact: contact.time))

    def follow(self, q: Array, v: Array, t: float, dt: float) -> Array:
        """Moves on at constant velocity, with as many looks as that takes; gives q (nv,) at t + dt."""
        twin = self.twin
        twin.place(twin.integrate(q, v, dt), t + dt)
        count = min(max(1, int(np.ceil(self._travel().max(initial=0.0) / STEP))), MOST_LOOKS)
        for i in range(1, count + 1):
            after = twin.integrate(q, v, dt * i / count)
            twin.place(after, t + dt * i / count)
            self.look(t + dt * i / count)
        return after

    def _travel(self) -> Array:
        """(g,) how far any point of a geometry is from where it was at the last look, at most [m]."""
        (old_center, old_axes), (center, axes) = self._poses, self.twin.poses()
        turn = np.sqrt(0.5 * np.square(axes - old_axes).sum(axis=1))  # chord of a point at distance 1 from the centre
        return np.asarray(np.sqrt(np.square(center - old_center).sum(axis=1)) + self._radius * turn)


def play(twin: Twin, t: Array, v: Array, limits: Limits, near: float = -np.inf) -> Findings:
    """Plays velocities from the twin's start, each until the next tick.

    Args:
        twin: the scene.
        t: times of the ticks (N,) [s].
        v: velocities commanded at them (N, nv) [rad/s or m/s].
        limits: use of the joint limits, against which velocities are held.
        near: distances below it are measured at every tick [m].
    """
    q, nearest = np.empty((len(t), len(twin.q0))), np.empty(len(t))
    twin.place(twin.q0, t[0])
    watch = Watch(twin, near=near)
    watch.look(t[0])
    here = twin.q0
    for k, now in enumerate(t.tolist()):
        q[k], nearest[k] = here, watch.nearest
        if k + 1 < len(t):
            here = watch.follow(here, v[k], now, float(t[k + 1]) - now)
    bounds = twin.scene.robot.bounds().within(limits)
    acceleration = np.diff(v, axis=0, prepend=0.0) / np.diff(t, append=2.0 * t[-1] - t[-2])[:, None]
    limited = q[:, bounds.q_index]
    return Findings(
        distance=watch.distance,
        pair=watch.pair,
        time=watch.time,
        contacts=watch.contacts,
        q=q,
        nearest=nearest,
        speed_excess=float(np.max(np.abs(v) - bounds.velocity)),
        position_excess=float(np.max(np.maximum(bounds.lower - limited, limited - bounds.upper), initial=-np.inf)),
        acceleration_excess=float(np.max(np.abs(acceleration) - bounds.acceleration)),
        looks=watch.looks,
    )
