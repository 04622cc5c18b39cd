"""The referee: plays commanded velocities in MuJoCo and looks for contacts, at the ticks and between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.safety.arena import Arena
from qpavoid import Limits, Log
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
    drift: float
    """Largest difference between them and the log's [rad or m]."""
    disagreement: float
    """Largest difference between the log's smallest distance and MuJoCo's of that pair, at ticks without contact [m];
    in deep penetration the two mean different things."""
    speed_excess: float
    """How far a commanded velocity lies beyond its limit, at most; negative: the margin [rad/s or m/s]."""
    position_excess: float
    """The same of the configurations [rad or m]."""
    acceleration_excess: float
    """The same of the change from tick to tick, from rest, over the period; -inf without limit [rad/s² or m/s²]."""
    looks: int
    """Number of instants looked at."""


class Watch:
    """Follows all pairs of an arena while it moves.

    A pair that was d apart when it was last measured cannot be nearer than d less what both bodies moved since. It is
    measured again only when that bound falls below the smallest distance so far, or below contact, or below its own
    greatest depth: what is left out could not have changed the outcome.
    """

    def __init__(self, arena: Arena, pairs: Any = None) -> None:
        """Begins where the arena is.

        Args:
            arena: placed at the start.
            pairs: (m,) which pairs to watch; all if left out.
        """
        self.arena = arena
        self.distance, self.pair, self.time, self.looks = np.inf, -1, np.nan, 0
        self._counts, count = arena.movable, len(arena.scene.pairs)
        self._bound, self._touch, self._depth = np.full(count, -np.inf), np.full(count, np.nan), np.zeros(count)
        if pairs is not None:
            self._bound[~pairs] = np.inf
        self._radius = arena.model.geom_rbound[arena.geoms]
        self._first, self._second = arena.scene.pairs.T
        self._poses = arena.poses()

    def look(self, t: float) -> None:
        """Measures what has to be, where the arena is now."""
        travel = self._travel()
        self._bound -= travel[self._first] + travel[self._second]
        self._poses = self.arena.poses()
        self.looks += 1
        matters = np.where(self._depth > 0.0, -self._depth, max(self.distance, 0.0))
        for pair in np.flatnonzero(self._bound < matters).tolist():
            d = self._bound[pair] = self.arena.distance(pair)
            if d < self.distance and self._counts[pair]:
                self.distance, self.pair, self.time = d, pair, t
            if d < -self._depth[pair]:
                if self._depth[pair] == 0.0:
                    self._touch[pair] = t
                self._depth[pair] = -d

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """Pairs that touched, in the order of time."""
        touched = np.flatnonzero(self._depth > 0.0).tolist()
        found = [Contact(pair, float(self._touch[pair]), float(self._depth[pair])) for pair in touched]
        return tuple(sorted(found, key=lambda contact: contact.time))

    def follow(self, q: Array, v: Array, t: float, dt: float) -> Array:
        """Moves on at constant velocity, with as many looks as that takes; gives q (nv,) at t + dt."""
        arena = self.arena
        arena.place(arena.integrate(q, v, dt), t + dt)
        count = min(max(1, int(np.ceil(self._travel().max(initial=0.0) / STEP))), MOST_LOOKS)
        for i in range(1, count + 1):
            after = arena.integrate(q, v, dt * i / count)
            arena.place(after, t + dt * i / count)
            self.look(t + dt * i / count)
        return after

    def _travel(self) -> Array:
        """(g,) how far any point of a geometry is from where it was at the last look, at most [m]."""
        (old_center, old_axes), (center, axes) = self._poses, self.arena.poses()
        turn = np.sqrt(0.5 * np.square(axes - old_axes).sum(axis=1))  # chord of a point at distance 1 from the centre
        return np.asarray(np.sqrt(np.square(center - old_center).sum(axis=1)) + self._radius * turn)


def referee(arena: Arena, log: Log) -> Findings:
    """Plays a log's velocities from the arena's start, each until the next tick.

    Raises:
        ValueError: the log is of another scene.
    """
    if [list(pair) for pair in arena.scene.pair_names] != log.meta["pairs"]:
        raise ValueError("the log's pairs are not the arena's: it is of another scene")
    q, disagreement = np.empty_like(log.q), 0.0
    arena.place(arena.q0, log.t[0])
    watch = Watch(arena)
    watch.look(log.t[0])
    here, ours = arena.q0, log.min_distance
    for k, t in enumerate(log.t.tolist()):
        q[k] = here
        if 0.0 < ours[k] < np.inf:
            disagreement = max(disagreement, abs(arena.distance(int(log.closest_pair[k])) - float(ours[k])))
        if k + 1 < len(log.t):
            here = watch.follow(here, log.v[k], t, float(log.t[k + 1]) - t)
    bounds = arena.scene.robot.bounds().within(Limits.model_validate(log.meta["config"]["limits"]))
    acceleration = np.diff(log.v, axis=0, prepend=0.0) / log.meta["config"]["dt"]
    limited = q[:, bounds.q_index]
    return Findings(
        distance=watch.distance,
        pair=watch.pair,
        time=watch.time,
        contacts=watch.contacts,
        q=q,
        drift=float(np.max(np.abs(q - log.q), initial=0.0)),
        disagreement=disagreement,
        speed_excess=float(np.max(np.abs(log.v) - bounds.velocity)),
        position_excess=float(np.max(np.maximum(bounds.lower - limited, limited - bounds.upper), initial=-np.inf)),
        acceleration_excess=float(np.max(np.abs(acceleration) - bounds.acceleration)),
        looks=watch.looks,
    )
