"""Keeps a way out at hand where obstacles move: goes on with the task only where a flight would still stay clear.

A law that looks at the distances and velocities of one tick can be trapped by obstacles that close in from several
sides: when rows first bind, it is too late. So before a velocity is commanded, flights are tried from where it leads:
the robot drops its tasks and keeps away from everything, for a second or two, while obstacles go on as they are known
to. While one of them stays clear, the velocity may be commanded, and that flight is kept. Where none does, the flight
that was kept is followed in its place: it was found clear, and stays so as long as obstacles do what was foreseen.
This is the scheme of Agrawal, Chen and Panagou 2023, "gatekeeper: Online safety verification and control for nonlinear
systems in dynamic environments", with flights as its backup.

Flights maximise the smallest distance at a horizon h, to first order, in every period anew:

    max s - ½ s²/c - ε/2c ‖v - v̂‖²  s.t.  d + h (J v + ḋ_obs) >= s,  s <= c,  lower <= v <= upper,    c: the comfort.

This is greedy, and runs into dead ends; which v̂ leads out of one cannot be told beforehand. So many are tried, drawn at
random, a few in every tick, as long as no flight is good enough: from here, and from places on the flight that is kept,
whose beginning may be right though its end is not. What is found in one tick is flown anew in the next one, farther by
a tick, from where the robot is then and among obstacles as they are seen then.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from qpavoid import kernels
from qpavoid.assembly import Assembly
from qpavoid.config import Avoidance, Escape, Limits
from qpavoid.kinematics import ForwardKinematics, longest_lever
from qpavoid.limits import JointBounds
from qpavoid.problem import Array, Mask, Proximity
from qpavoid.proximity import DistanceQuery
from qpavoid.scene import Scene
from qpavoid.sensing import Obstacles, Seen
from qpavoid.solvers.backends import solve_daqp

_HORIZONS = (0.2, 0.05, 0.5)
"""h of flights [s]."""
_STRAIGHT = 0.25
"""Share of the flights drawn that lean to no side [-]."""
_LEANS = (2.0, 30.0)
"""Range of ‖v̂‖ of the others, with equally likely logarithms [rad/s, m/s]."""
_GENTLE = 1e-4
"""ε: what the square of a joint speed counts beside that of a distance [m²/(rad/s)²]."""
_DEEPEST = 10.0
"""Penetration that no flight foresees [m]."""
_TOUCH = 1e-3
"""Distance below which a pair counts as touching [m]."""
_BEYOND = 0.1
"""How much longer than the horizon flights are, so that they need not be flown anew in every tick [s]."""
_SPAN = 0.1
"""Time from one look at bounding spheres to the next [s]."""
_ALIKE = 1e-6
"""Difference of two flights' distances that counts as none [m]."""


class Manner(NamedTuple):
    """A way to flee."""

    horizon: float
    """h [s]; 0 stands still."""
    leaning: Array
    """v̂ (nv,) [rad/s, m/s]."""


class Near(NamedTuple):
    """What a flight looks at; in memory that the next look overwrites."""

    distance: Array
    """(k,) of the watched pairs within reach [m]."""
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
    t: float
    """[s]."""
    watched: Mask
    """(m,) pairs that are not to touch."""


class Value(NamedTuple):
    """How good a flight is, the larger the better."""

    clear: float
    """Time until something touches, up to the horizon of the foresight [s]."""
    distance: float
    """Smallest distance until then, up to what counts as safe [m]."""


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
    """Smallest distance until then, up to that at which flights look at pairs [m]."""


class EscapePlanner:
    """Tries flights, on kinematics and distances of its own."""

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
        self._model, self._obstacles, self._settings, self._dt = model, obstacles, settings, dt
        self._ticks = max(1, int(np.ceil(settings.period / dt - 1e-9)))
        self._kinematics, self.query = ForwardKinematics(model), DistanceQuery(scene)
        self._assembly = Assembly(
            scene, (), bounds, self._kinematics, self.query, avoidance, limits, 0.01, self._ticks * dt
        )
        self._step, self._accelerated = bounds.acceleration * dt, bool(np.isfinite(bounds.acceleration).any())
        self._braking = 0.5 / bounds.acceleration
        self._lever = max(1.0, longest_lever(model, self.query.longest_reach()))
        self._parted = np.any(scene.support != 0.0, axis=1)
        safe = settings.safe * (avoidance.hold - avoidance.offset)
        self._enough = Value(settings.horizon, safe)
        self._still = Manner(0.0, np.zeros(model.nv))
        self._foreseen: dict[float, Seen] = {}
        _farthest(np.zeros((1, model.nv)), np.zeros(1), 0.1, np.zeros(model.nv), *2 * [np.zeros(model.nv)])  # compiles
        self.reset()

    def reset(self) -> None:
        """Forgets the flight that was kept; what is drawn from now on is drawn again after the next reset."""
        self._kept: Flight | None = None
        self._random = np.random.default_rng(0)

    def look_anew(self) -> None:
        """What the robot carries, or what may touch, has changed: the flight that is kept has to be flown anew."""
        if self._kept is not None:
            self._kept = self._kept._replace(until=-np.inf)

    def check(self, q: Array, v: Array, t: float, v_last: Array, proximity: Proximity) -> Array | None:
        """None where v may be commanded, else what to command in its place (nv,).

        Args:
            q: configuration (nq,).
            v: what the law and the look ahead want (nv,).
            t: now [s].
            v_last: velocity (nv,) at which the robot moves.
            proximity: distances of this tick; pairs that touch already are left out of account.
        """
        if not len(self._obstacles.moving):
            return None
        self._foreseen.clear()
        watched = self._parted.copy()
        watched[proximity.pair[proximity.distance < _TOUCH]] = False
        next_tick = Start(pin.integrate(self._model, q, self._dt * v), v, t + self._dt, watched)
        if self._nobody_comes(next_tick):
            self._kept = None
            return None
        onward = self._best(self._onward(next_tick))
        if onward.value < self._enough:
            kept, left = self._way_out(Start(q, v_last.copy(), t, watched))
            onward = self._best((self._fly(next_tick, self._drawn()) for _ in range(left)), onward)
            if not self._as_good(onward.value, kept.value) and kept.v:
                self._kept = self._a_tick_on(kept)
                return None if np.array_equal(kept.v[0], v) else kept.v[0]
        self._kept = onward
        return None

    def _nobody_comes(self, start: Start) -> bool:
        """Whether what moves stays away from a robot that stops here, which bounding spheres can tell or not.

        Between the times at which they are looked at, obstacles are taken to be no faster than at these.
        """
        moving, horizon = self._obstacles.moving, self._settings.horizon
        times = start.t + np.arange(0.0, horizon + _SPAN, _SPAN)
        states = np.array([self._obstacles.foreseen(t).states[moving] for t in times])
        strides = 0.5 * _SPAN * np.sqrt(np.square(states[:, :, 12:15]).sum(axis=2).max(axis=0))
        self._kinematics.compute(start.q)
        centers, radii = self.query.body_spheres(self._kinematics.data)
        apart = np.linalg.norm(states[:, :, None, 9:12] - centers, axis=3) - radii
        stop = float(np.square(start.v) @ self._braking)
        least = self._settings.comfort + (self._lever * stop if stop else 0.0)
        return bool((apart.min(axis=(0, 2)) - self.query.placing.reach[moving] - strides > least).all())

    def _onward(self, start: Start) -> Iterator[Flight]:
        """The flight that is kept, if it holds; flights like it, by its manner and its velocities; standing still."""
        if self._kept is not None and self._kept.v:
            kept = self._a_tick_on(self._kept)
            if self._holds_from(kept, start):
                yield kept
            yield self._fly(start, kept.manner)
            yield self._fly(start, kept.manner, kept.v)
        yield self._fly(start, self._still)

    def _a_tick_on(self, flight: Flight) -> Flight:
        """What is left of a flight after a tick."""
        (q, _, t, watched), v = flight.start, flight.v[0]
        begun = Start(pin.integrate(self._model, q, self._dt * v), v, t + self._dt, watched)
        return flight._replace(start=begun, v=flight.v[1:])

    def _holds_from(self, flight: Flight, start: Start) -> bool:
        """Whether a flight that is good enough is so from a start close to its own, without another look.

        The same velocities lead past the same places, but for how far the start is off, and what is lost until they are
        reached. No point of the robot is farther off than the longest lever times the sum of that over the joints.
        """
        if self._obstacles.told or flight.until < start.t + self._settings.horizon - 1e-9:
            return False
        if abs(start.t - flight.start.t) > 1e-6 or not np.array_equal(flight.start.watched, start.watched):
            return False
        off, v = pin.difference(self._model, flight.start.q, start.q), start.v
        most = float(np.abs(off).sum())
        if self._accelerated:
            for wanted in flight.v:
                (v,) = self._towards(v, [wanted])
                off += self._dt * (v - wanted)
                most = max(most, float(np.abs(off).sum()))
                if np.array_equal(v, wanted):
                    break
        return bool(flight.least - self._lever * most >= self._enough.distance)

    def _best(self, flights: Iterable[Flight], best: Flight | None = None) -> Flight:
        """The first flight that is good enough, or the best of all; no more are flown than that takes."""
        if best is None or best.value < self._enough:
            for flight in flights:
                best = flight if best is None or flight.value > best.value else best
                if best.value >= self._enough:
                    break
        assert best is not None
        return best

    def _as_good(self, onward: Value, kept: Value) -> bool:
        """Whether a flight that begins in a tick is as good as one that begins now; times are told to a period."""
        if onward.clear > kept.clear + self._ticks * self._dt:
            return True
        return onward.clear + self._dt >= kept.clear and onward.distance >= kept.distance - _ALIKE

    def _way_out(self, start: Start) -> tuple[Flight, int]:
        """The flight that is kept, as good as it is from here and now, or a better one; and attempts that are left."""
        known, attempts = self._kept, self._settings.attempts
        if known is not None and self._holds_from(known, start):
            return known._replace(start=start), attempts
        best = self._fly(start, self._still) if known is None else self._fly(start, known.manner, known.v)
        while attempts and best.value < self._enough:
            attempts -= 1
            turn = self._random.integers(len(best.v) + 1) if attempts % 2 else 0
            flight = self._fly(start, self._drawn(), best.v[:turn])
            best = max(best, flight, key=lambda flight: flight.value)
        return best, attempts

    def _drawn(self) -> Manner:
        """Some manner or other."""
        random = self._random
        h = _HORIZONS[random.integers(len(_HORIZONS))]
        if random.random() < _STRAIGHT:
            return Manner(h, self._still.leaning)
        side, lean = random.normal(size=self._model.nv), np.exp(random.uniform(*np.log(_LEANS)))
        return Manner(h, lean / np.linalg.norm(side) * side)

    def _fly(self, start: Start, manner: Manner, given: Sequence[Array] = ()) -> Flight:
        """Flees with decisions a period apart, until something touches or the horizon is reached.

        Distances are looked at as often, and midway where something may come too near and part again before that. All
        flights decide and look at the same times, multiples of the period: only so can their values be compared.

        Args:
            start: where it begins.
            manner: how it flees.
            given: velocities (nv,) of the first ticks, for as many decisions as they suffice; it flees from then on.
        """
        q, v, t, watched = start
        horizon, safe = self._enough
        end, plan = t + horizon + _BEYOND, list[Array]()
        near = self._look(q, t, v, watched)
        least = here = near.least
        count = self._ticks - round(t / self._dt) % self._ticks
        while here >= _TOUCH and t < end - 1e-9:
            wanted = given[len(plan) : len(plan) + count]
            if len(wanted) < count:
                wanted = [self._flee(near, manner)] * count
            steps = self._towards(v, wanted)
            ahead, span, before = self._moved(q, steps), count * self._dt, here
            rate = near.J @ steps[len(steps) // 2] + near.drift
            if (near.distance + span * rate < safe).any():
                span *= 0.5
                t += span
                here = self._look(pin.interpolate(self._model, q, ahead, 0.5), t, v, watched).least
            if here >= _TOUCH:
                before, least = here, min(least, here)
                t += span
                near = self._look(ahead, t, steps[-1], watched)
                here = near.least
            plan += steps
            q, v, count = ahead, steps[-1], self._ticks
        if here >= _TOUCH:
            least = min(least, here)
        elif plan:
            t -= span * (_TOUCH - here) / (before - here)
        value = Value(min(t - start.t, horizon), min(least, safe))
        return Flight(start, plan, manner, value, t, least)

    def _moved(self, q: Array, steps: Sequence[Array]) -> Array:
        """Where the velocities (nv,) of some ticks lead from q (nq,)."""
        if steps[0] is steps[-1]:
            return np.asarray(pin.integrate(self._model, q, len(steps) * self._dt * steps[0]))
        for step in steps:
            q = pin.integrate(self._model, q, self._dt * step)
        return q

    def _towards(self, v: Array, wanted: Sequence[Array]) -> Sequence[Array]:
        """The velocities of some ticks: from v, as close to the wanted ones (nv,) as accelerations allow."""
        if not self._accelerated:
            return wanted
        ramp = []
        for target in wanted:
            v = v + np.minimum(np.maximum(target - v, -self._step), self._step)
            ramp.append(v)
        return ramp

    def _look(self, q: Array, t: float, v: Array, watched: Mask) -> Near:
        """What is near at q (nq,), reached with v (nv,), with the obstacles where they will be at t [s]."""
        if t not in self._foreseen:
            self._foreseen[t] = self._obstacles.foreseen(t)
        self.query.placing.place(*self._foreseen[t])
        self._assembly.remember(v)
        self._kinematics.compute(q)
        self.query.compute(self._kinematics.data, self._settings.reach)
        (pair, closest, J, drift), problem = self._assembly.compute(q, (), self.query, self._settings.reach)
        distance, counts = closest[:, 0], watched[pair]
        if not counts.all():
            distance, J, drift = distance[counts], J[counts], drift[counts]
        least = float(distance.min(initial=self._settings.reach))
        return Near(distance, J, drift, problem.lower, problem.upper, least)

    def _flee(self, near: Near, manner: Manner) -> Array:
        """Velocity (nv,) of a flight for its next period."""
        h, v = manner.horizon, None
        if h:
            ahead = near.distance + h * near.drift
            v = _farthest(h * near.J, ahead, self._settings.comfort, manner.leaning, near.lower, near.upper)
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
