"""Flights: the robot drops its tasks and keeps away from everything, while obstacles go on as they are known to.

In every period a flight maximises the smallest distance at a horizon h, to first order:

    max s - ½ s²/c - ε/2c ‖v - v̂‖²  s.t.  d + h (J v + ḋ_obs) >= s,  s <= c,  lower <= v <= upper,    c: the comfort.

This is greedy, and runs into dead ends; which v̂ leads out of one cannot be told beforehand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from qpavoid import kernels
from qpavoid.ahead.ramps import Ramps
from qpavoid.assembly import Assembly
from qpavoid.config import Avoidance, Escape, Limits
from qpavoid.kinematics import ForwardKinematics, longest_lever
from qpavoid.limits import JointBounds
from qpavoid.obstacles.sensing import Obstacles, Seen
from qpavoid.problem import Array, IntArray, Mask
from qpavoid.proximity import DistanceQuery
from qpavoid.scene import Scene
from qpavoid.solvers.backends import solve_daqp

_GENTLE = 1e-4
"""ε: what the square of a joint speed counts beside that of a distance [m²/(rad/s)²]."""
_DEEPEST = 10.0
"""Penetration that no flight foresees [m]."""
TOUCH = 1e-3
"""Distance below which a pair counts as touching [m]."""
_MANY = 300
"""Times of which it is remembered what was foreseen, before those that are over are forgotten."""
_BEYOND = 0.1
"""How much longer than the horizon flights are, so that they need not be flown anew in every tick [s]."""


class Manner(NamedTuple):
    """A way to flee."""

    horizon: float
    """h [s]; 0 stands still."""
    leaning: Array
    """v̂ (nv,) [rad/s, m/s]."""


class Near(NamedTuple):
    """What a flight looks at; in memory that the next look overwrites."""

    pair: IntArray
    """(k,) numbers of the watched pairs within reach."""
    distance: Array
    """(k,) of these [m]."""
    J: Array
    """(k, nv) velocity Jacobian of these distances."""
    drift: Array
    """(k,) their rate due to the obstacles [m/s]."""
    lower: Array
    """(nv,) bounds on the velocity of the next period."""
    upper: Array
    """(nv,)."""
    least: float
    """Smallest distance; the reach, where nothing is nearer [m]."""


class Start(NamedTuple):
    """Where a flight begins."""

    q: Array
    """(nq,)."""
    v: Array
    """(nv,) velocity that has led there."""
    w: Array
    """(nv,) by how much that changed in the tick before."""
    t: float
    """[s]."""
    watched: Mask
    """(m,) pairs that are not to touch."""


class Value(NamedTuple):
    """How good a flight is, the larger the better."""

    clear: float
    """The horizon of the foresight, less what is left of it, for each pair that touches, when that first does [s].

    Of a pair that touches in every flight, nothing more is lost by keeping the others apart.
    """
    distance: float
    """Smallest distance of pairs that do not touch, up to what counts as safe [m]."""


class Flight(NamedTuple):
    """Velocities, and where they lead."""

    start: Start
    v: list[Array]
    """(nv,) for each tick."""
    manner: Manner
    value: Value
    until: float
    """When something touches; the end, if nothing does before [s]."""
    least: float
    """Smallest distance of pairs that do not touch, up to that at which flights look at pairs [m]."""


class _Tally:
    """What touches in the course of a flight."""

    def __init__(self, start: Start, horizon: float, reach: float) -> None:
        self.watched, self.until, self.least = start.watched, np.inf, np.inf
        self.lost, self._before, self._deadline, self._reach = 0.0, np.inf, start.t + horizon, reach

    def count(self, near: Near, t: float, span: float) -> Near:
        """Takes a look into account, at t, `span` after the last one [s]; gives what of it is to be watched on."""
        touching = near.distance < TOUCH
        if touching.any():
            closing = self._before - near.least
            when = t - span * (TOUCH - near.least) / closing if 0.0 < closing < np.inf else t
            self.until = min(self.until, float(when))
            self.lost += float(touching.sum()) * max(self._deadline - when, 0.0)
            self.watched = self.watched.copy()
            self.watched[near.pair[touching]] = False
            rest = ~touching
            pair, distance = near.pair[rest], near.distance[rest]
            least = float(distance.min(initial=self._reach))
            near = Near(pair, distance, near.J[rest], near.drift[rest], near.lower, near.upper, least)
        self.least, self._before = min(self.least, near.least), near.least
        return near


class Flights:
    """Flies, on kinematics and distances of its own."""

    def __init__(
        self,
        scene: Scene,
        bounds: JointBounds,
        obstacles: Obstacles,
        avoidance: Avoidance,
        limits: Limits,
        dt: float,
        settings: Escape,
    ) -> None:
        """Lays the memory out.

        Args:
            scene: robot and obstacles.
            bounds: limits of the joints.
            obstacles: what is known of the obstacles.
            avoidance: distances and rows of the controller.
            limits: use of the joint limits.
            dt: control period [s].
            settings: how far and how hard to look.
        """
        model = scene.robot.model
        self._model, self._obstacles, self.settings, self._dt = model, obstacles, settings, dt
        self._ticks = max(1, int(np.ceil(settings.period / dt - 1e-9)))
        self.period = self._ticks * dt
        """Time between two decisions [s]."""
        self.kinematics, self.query = ForwardKinematics(model), DistanceQuery(scene)
        # what is wanted may be farther away than jerks get in a period
        free = replace(bounds, jerk=np.full(model.nv, np.inf))
        self._assembly = Assembly(scene, (), free, self.kinematics, self.query, avoidance, limits, 0.01, self.period)
        self.ramps = Ramps(bounds, dt)
        """How it gets from one velocity to another."""
        self.lever = max(1.0, longest_lever(model, self.query.longest_reach()))
        """Farther than this no point of the robot moves when a joint moves by 1 [m/rad, 1]."""
        self.enough = Value(settings.horizon, settings.safe * (avoidance.hold - avoidance.offset))
        """What a flight is worth that need not be any better."""
        self.still = Manner(0.0, np.zeros(model.nv))
        """Standing still."""
        self._foreseen: dict[float, Seen] = {}
        _farthest(np.zeros((1, model.nv)), np.zeros(1), 0.1, np.zeros(model.nv), *2 * [np.zeros(model.nv)])  # compiles

    def go_on_to(self, t: float) -> None:
        """Forgets what was foreseen and is over at t [s]; all of it, where obstacles are told of."""
        if self._obstacles.told:
            self._foreseen.clear()
        elif len(self._foreseen) > _MANY:
            self._foreseen = {at: seen for at, seen in self._foreseen.items() if at > t}

    def forget_foreseen(self) -> None:
        """There is news of the obstacles: where they will be has to be foreseen anew."""
        self._foreseen.clear()

    def foreseen(self, t: float) -> Seen:
        """The obstacles that move, as far as is known, at t [s]."""
        if t not in self._foreseen:
            self._foreseen[t] = self._obstacles.foreseen(t)
        return self._foreseen[t]

    def a_tick_on(self, flight: Flight) -> Flight:
        """What is left of a flight after a tick."""
        (q, before, _, t, watched), v = flight.start, flight.v[0]
        begun = Start(pin.integrate(self._model, q, self._dt * v), v, v - before, t + self._dt, watched)
        return flight._replace(start=begun, v=flight.v[1:])

    def holds_from(self, flight: Flight, start: Start) -> bool:
        """Whether a flight that is good enough is so from a start close to its own, without another look.

        The same velocities lead past the same places, but for how far the start is off, and what is lost until they are
        reached. No point of the robot is farther off than the longest lever times the sum of that over the joints.
        """
        if self._obstacles.told or flight.until < start.t + self.settings.horizon - 1e-9:
            return False
        if abs(start.t - flight.start.t) > 1e-6 or not np.array_equal(flight.start.watched, start.watched):
            return False
        off, v, w = pin.difference(self._model, flight.start.q, start.q), start.v, start.w
        most = float(np.abs(off).sum())
        if self.ramps.accelerated:
            for wanted in flight.v:
                before, (v,) = v, self.ramps.towards(v, w, [wanted])
                w = v - before
                off += self._dt * (v - wanted)
                most = max(most, float(np.abs(off).sum()))
                if np.array_equal(v, wanted):
                    break
        return bool(flight.least - self.lever * most >= self.enough.distance)

    def fly(self, start: Start, manner: Manner, given: Sequence[Array] = ()) -> Flight:
        """Flees with decisions a period apart until the horizon; what has touched is left out of account from then on.

        Distances are looked at as often, and midway where something may come too near and part again before that. All
        flights decide and look at the same times, multiples of the period: only so can their values be compared.

        Args:
            start: where it begins.
            manner: how it flees.
            given: velocities (nv,) of the first ticks, for as many decisions as they suffice; it flees from then on.
        """
        q, v, w, t, _ = start
        horizon, safe = self.enough
        end, plan, tally = t + horizon + _BEYOND, list[Array](), _Tally(start, horizon, self.settings.reach)
        near = tally.count(self._look(q, t, v, tally.watched), t, 0.0)
        count = self._ticks - round(t / self._dt) % self._ticks
        while t < end - 1e-9:
            wanted = given[len(plan) : len(plan) + count]
            held = len(wanted) < count
            if held:
                wanted = [self._flee(near, manner)] * count
            steps = self.ramps.towards(v, w, wanted, held)
            ahead, span = self._moved(q, steps), count * self._dt
            rate = near.J @ steps[len(steps) // 2] + near.drift
            if (near.distance + span * rate < safe).any():
                span *= 0.5
                t += span
                tally.count(self._look(pin.interpolate(self._model, q, ahead, 0.5), t, v, tally.watched), t, span)
            t += span
            near = tally.count(self._look(ahead, t, steps[-1], tally.watched), t, span)
            plan += steps
            w = steps[-1] - (steps[-2] if len(steps) > 1 else v)
            q, v, count = ahead, steps[-1], self._ticks
        value = Value(horizon - tally.lost, min(tally.least, safe))
        return Flight(start, plan, manner, value, min(tally.until, t), tally.least)

    def _moved(self, q: Array, steps: Sequence[Array]) -> Array:
        """Where the velocities (nv,) of some ticks lead from q (nq,)."""
        if steps[0] is steps[-1]:
            return np.asarray(pin.integrate(self._model, q, len(steps) * self._dt * steps[0]))
        for step in steps:
            q = pin.integrate(self._model, q, self._dt * step)
        return q

    def _look(self, q: Array, t: float, v: Array, watched: Mask) -> Near:
        """What is near at q (nq,), reached with v (nv,), with the obstacles where they will be at t [s]."""
        self.query.placing.place(*self.foreseen(t))
        self._assembly.remember(v)
        self.kinematics.compute(q)
        self.query.compute(self.kinematics.data, self.settings.reach)
        (pair, closest, J, drift), problem = self._assembly.compute(q, (), self.query, self.settings.reach)
        distance, counts = closest[:, 0], watched[pair]
        if not counts.all():
            pair, distance, J, drift = pair[counts], distance[counts], J[counts], drift[counts]
        least = float(distance.min(initial=self.settings.reach))
        return Near(pair, distance, J, drift, problem.lower, problem.upper, least)

    def _flee(self, near: Near, manner: Manner) -> Array:
        """Velocity (nv,) of a flight for its next period."""
        h, v = manner.horizon, None
        if h:
            ahead = near.distance + h * near.drift
            v = _farthest(h * near.J, ahead, self.settings.comfort, manner.leaning, near.lower, near.upper)
        return np.minimum(np.maximum(0.0 if v is None else v, near.lower), near.upper)


def _farthest(A: Array, d: Array, comfort: float, v: Array, lower: Array, upper: Array) -> Array | None:
    """v (nv,) with the largest s, A v + d >= s, s <= comfort, close to the one given; None where none is found."""
    if kernels.ACCELERATED:
        from qpavoid.kernels.compiled.active_set import farthest

        w, met = farthest(A, d, comfort, _DEEPEST, _GENTLE, v, lower, upper)
        return w if met else None
    k, n = A.shape
    P = np.diag(np.append(np.full(n, _GENTLE), 1.0))
    G = np.column_stack((A, np.full(k, -1.0)))
    low, high = np.append(lower, -_DEEPEST), np.append(upper, comfort)
    answer = solve_daqp(P, -P @ np.append(v, comfort), G, -d, low, high)
    return None if answer is None else answer[:n]
