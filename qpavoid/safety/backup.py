"""Keeps a way out at hand where obstacles move: goes on with the task only where a flight would still stay clear.

A law that looks at the distances and velocities of one tick can be trapped by obstacles that close in from several
sides: when rows first bind, it is too late. So before a velocity is commanded, flights are tried from where it leads:
the robot drops its tasks and keeps away from everything, for a second or two, while obstacles go on as they are known
to. While one of them stays clear, the velocity may be commanded, and that flight is kept. Where none does, the flight
that was kept is followed in its place: it was found clear, and stays so as long as obstacles do what was foreseen.
This is the scheme of Agrawal, Chen and Panagou 2023, "gatekeeper: Online safety verification and control for nonlinear
systems in dynamic environments", with flights as its backup.

Which flight stays clear cannot be told beforehand. So many are tried, drawn at random, a few in every tick, as long as
none is good enough: from here, and from places on the flight that is kept, whose beginning may be right though its end
is not. What is found in one tick is flown anew in the next one, farther by a tick, from where the robot is then and
among obstacles as they are seen then.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from qpavoid import kernels
from qpavoid.control.obstacles import ObstacleTracker
from qpavoid.model.limits import JointBounds
from qpavoid.model.scene import Scene
from qpavoid.problem import Array, IntArray, Proximity
from qpavoid.safety.policy import TOUCH, BackupPolicy, Flight, Start, Value
from qpavoid.safety.rollout import Flights

_HORIZONS = (0.2, 0.05, 0.5)
"""h of flights [s]."""
_STRAIGHT = 0.25
"""Share of the flights drawn that lean to no side [-]."""
_LEANS = (2.0, 30.0)
"""Range of ‖v̂‖ of the others, with equally likely logarithms [rad/s, m/s]."""
_DECISION = 0.01
"""Time for which a decision holds at the least [s]: not in every tick of a millisecond can flights be flown."""
_SPAN = 0.1
"""Time from one look at bounding spheres to the next [s]."""
_ALIKE = 1e-6
"""Difference of two flights' distances that counts as none [m]."""


class _Paths(NamedTuple):
    """Where what moves will be, every `_SPAN` until the horizon."""

    first: int | None
    """From which multiple of that on; None before anything was looked at."""
    moving: IntArray
    """(k,) numbers of those that do not rest until then."""
    places: Array
    """(t, k, 3) [m]."""
    strides: Array
    """(k,) how far they may be from these in between [m]."""
    fastest: float
    """Largest speed of any point of them [m/s]."""


_NO_PATHS = _Paths(None, np.zeros(0, np.intp), np.zeros((0, 0, 3)), np.zeros(0), 0.0)


class _Apart(NamedTuple):
    """How far what moves stays apart, more than it has to, from a robot that rests."""

    ways: _Paths
    """Of what moves."""
    q: Array
    """(nq,) where that rests."""
    room: float
    """[m]."""


class BackupPlanner:
    """Tries flights, and decides which is commanded."""

    def __init__(
        self, flights: Flights, scene: Scene, bounds: JointBounds, obstacles: ObstacleTracker, dt: float
    ) -> None:
        """Begins with no flight kept.

        Args:
            flights: what is tried.
            scene: robot and obstacles.
            bounds: limits of the joints.
            obstacles: what is known of the obstacles.
            dt: control period [s].
        """
        self.flights, self._settings = flights, flights.settings
        self._model, self._obstacles, self._dt = scene.robot.model, obstacles, dt
        self._braking = 0.5 / bounds.acceleration
        self._held = int(np.ceil(_DECISION / dt - 1e-9)) - 1
        """For how many ticks more than one a decision holds."""
        self.reset()

    def reset(self) -> None:
        """Forgets the flight that was kept; what is drawn from now on is drawn again after the next reset."""
        self._kept: Flight | None = None
        self._wait = 0
        self._random, self._untried = np.random.default_rng(0), list[float]()
        self._apart: _Apart | None = None
        self._ways = _NO_PATHS
        self.flights.drop_predictions()

    def invalidate(self) -> None:
        """What the robot carries, or what may touch, has changed: the flight that is kept has to be flown anew."""
        self.flights.invalidate()
        self._ways, self._apart = _NO_PATHS, None
        if self._kept is not None:
            self._kept = self._kept._replace(until=-np.inf)

    def check(self, q: Array, v: Array, t: float, v_prev: Array, dv_prev: Array, proximity: Proximity) -> Array | None:
        """None where v may be commanded, else what to command in its place (nv,).

        Args:
            q: configuration (nq,).
            v: what the law and the look ahead want (nv,).
            t: now [s].
            v_prev: velocity (nv,) at which the robot moves.
            dv_prev: by how much that changed in the tick before (nv,).
            proximity: distances of this tick; pairs that touch already are left out of account.
        """
        if not self._obstacles.any_may_move:
            self._kept = None
            return None
        self.flights.go_on_to(t - _SPAN)
        watched = self.flights.parted
        next_tick = Start(pin.integrate(self._model, q, self._dt * v), v, v - v_prev, t + self._dt, watched)
        if self._nobody_comes(next_tick):
            self._kept = None
            return None
        touching = proximity.pair[proximity.distance < TOUCH]
        if len(touching):
            watched = watched.copy()
            watched[touching] = False
            next_tick = next_tick._replace(watched=watched)
        wanted, known = v, self._kept
        if known is not None and len(known.v):
            left = self.flights.a_tick_on(known)
            if not self.flights.holds_from(left, next_tick, self._ways.fastest):
                wanted = known.v[0]
            if wanted is v or (self._wait and abs(known.start.t - t) <= self._dt):
                self._kept, self._wait = left, max(self._wait - 1, 0)
                return None if np.array_equal(wanted, v) else wanted
        self._wait = self._held
        return self._decide(next_tick, Start(q, v_prev.copy(), dv_prev.copy(), t, watched))

    def _decide(self, next_tick: Start, now: Start) -> Array | None:
        """None where a flight from the next tick on is good enough, or as good as any from now on; else what begins the
        best one (nv,).
        """
        v = next_tick.v
        onward = self._best(next_tick, self._onward(v))
        if onward.value < self.flights.enough:
            kept, left = self._way_out(now)
            onward = self._best(next_tick, ((self._drawn(), self._going_on(v)) for _ in range(left)), onward)
            if not self._as_good(onward.value, kept.value) and len(kept.v):
                self._kept = self.flights.a_tick_on(kept)
                return None if np.array_equal(kept.v[0], v) else kept.v[0]
        self._kept = onward
        if onward.value >= self.flights.enough:
            self._untried = list(_HORIZONS)
        return None

    def _nobody_comes(self, start: Start) -> bool:
        """Whether what moves stays away from a robot that stops here, which bounding spheres can tell or not.

        Between the times at which they are looked at, obstacles are taken to be no faster than at these. What was found
        counts until the next of these times, less what the robot has moved since.
        """
        ways, stop = self._paths(int(np.floor(start.t / _SPAN))), float(np.square(start.v) @ self._braking)
        if not len(ways.moving):
            return True
        if self._apart is not None and self._apart.ways is ways:
            moved = float(np.abs(pin.difference(self._model, self._apart.q, start.q)).sum())
            if self.flights.lever_arm * (moved + stop) < self._apart.room:
                return True
        self.flights.kinematics.compute(start.q)
        centers, radii = self.flights.query.body_spheres(self.flights.kinematics.data)
        reach = self.flights.query.placing.reach[ways.moving] + ways.strides + self._settings.comfort
        room = kernels.min_sphere_distance(ways.places, centers, reach[:, None] + radii)
        self._apart = _Apart(ways, start.q, room)
        return (self.flights.lever_arm * stop if stop else 0.0) < room

    def _paths(self, first: int) -> _Paths:
        """The ways of all that moves from a multiple of `_SPAN` until the horizon."""
        if first != self._ways.first or self._obstacles.estimates is not None:
            count = int(np.ceil(self._settings.horizon / _SPAN)) + 2
            places, rates = self._obstacles.paths(_SPAN * np.arange(first, first + count, dtype=np.float64))
            moves = np.flatnonzero(rates.any(axis=1) | (places != places[0]).any(axis=(0, 2)))
            moving = self._obstacles.moving[moves]
            speed, spin = rates[moves].T
            # half-spaces have no end: of one that does not turn, 0 · ∞ counts as 0
            radii, turning = self.flights.query.placing.reach[moving], np.zeros_like(spin)
            np.multiply(spin, radii, out=turning, where=spin > 0.0)
            fastest = float(np.max(speed + turning, initial=0.0))
            self._ways = _Paths(first, moving, places[:, moves].copy(), 0.5 * _SPAN * speed, fastest)
        return self._ways

    def _onward(self, v: Array) -> Iterator[tuple[BackupPolicy, Array]]:
        """Flights like the one that is kept, by its manner and its velocities; standing still."""
        held = self._going_on(v)
        if self._kept is not None and len(self._kept.v):
            manner, onward = self._kept.manner, self._kept.v[1:]
            yield manner, held
            yield manner, np.concatenate((held, onward[len(held) :]))
        yield self.flights.still, held

    def _going_on(self, v: Array) -> Array:
        """What a flight begins with when v (nv,) has been decided upon: the same, until there is a new decision."""
        return np.tile(v, (self._held, 1))

    def _best(
        self, start: Start, tried: Iterable[tuple[BackupPolicy, Array | None]], best: Flight | None = None
    ) -> Flight:
        """The first flight that is good enough, or the best of all; no more are flown than that takes."""
        if best is None or best.value < self.flights.enough:
            for manner, given in tried:
                best = self.flights.better(best, start, manner, given) or best
                if best is not None and best.value >= self.flights.enough:
                    break
        assert best is not None
        return best

    def _as_good(self, onward: Value, kept: Value) -> bool:
        """Whether a flight that begins in a tick is as good as one that begins now; times are told to a period."""
        if onward.clear > kept.clear + self.flights.period:
            return True
        return onward.clear + self._dt >= kept.clear and onward.distance >= kept.distance - _ALIKE

    def _way_out(self, start: Start) -> tuple[Flight, int]:
        """The flight that is kept, as good as it is from here and now, or a better one; and attempts that are left."""
        known, attempts = self._kept, self._settings.attempts
        if known is not None and self.flights.holds_from(known, start, self._ways.fastest):
            return known._replace(start=start), attempts
        manner, given = (self.flights.still, None) if known is None else (known.manner, known.v)
        best = self.flights.fly(start, manner, given)
        while attempts and best.value < self.flights.enough:
            attempts -= 1
            turn = (
                self.flights.decision_before(start, int(self._random.integers(len(best.v) + 1))) if attempts % 2 else 0
            )
            best = self.flights.better(best, start, self._drawn(), best.v[:turn]) or best
        return best, attempts

    def _drawn(self) -> BackupPolicy:
        """A manner: where trouble begins, each of those that lean to no side once; then some one or other."""
        if self._untried:
            return BackupPolicy(self._untried.pop(0), self.flights.still.leaning)
        random = self._random
        h = _HORIZONS[random.integers(len(_HORIZONS))]
        if random.random() < _STRAIGHT:
            return BackupPolicy(h, self.flights.still.leaning)
        side, lean = random.normal(size=self._model.nv), np.exp(random.uniform(*np.log(_LEANS)))
        return BackupPolicy(h, lean / np.linalg.norm(side) * side)
