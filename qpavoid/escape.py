"""Keeps a way out at hand where obstacles move: goes on with the task only where a flight would still stay clear.

A law that looks at the distances and velocities of one tick can be trapped by obstacles that close in from several
sides: when rows first bind, it is too late. So before a velocity is commanded, flights are tried from where it leads:
the robot drops its tasks and keeps away from everything, for a second or two, while obstacles go on as they are known
to. While one of them stays clear, the velocity may be commanded, and that flight is kept. Where none does, the flight
that was kept is followed in its place: it was found clear, and stays so as long as obstacles do what was foreseen.
This is the scheme of Agrawal, Chen and Panagou 2023, "gatekeeper: Online safety verification and control for nonlinear
systems in dynamic environments", with flights as its backup.

Flights maximise the smallest distance at a horizon h, to first order, in every period anew:

    max s - ε/2 ‖v - v̂‖²  s.t.  d + h (J v + ḋ_obs) >= s,  s <= comfort,  lower <= v <= upper,

with several h and several v̂, since one way out may be closed and another one not.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from qpavoid import kernels
from qpavoid.assembly import Assembly
from qpavoid.config import Avoidance, Escape, Limits
from qpavoid.kinematics import ForwardKinematics
from qpavoid.limits import JointBounds
from qpavoid.problem import Array, Problem, Proximity
from qpavoid.proximity import DistanceQuery
from qpavoid.scene import Scene
from qpavoid.sensing import Obstacles, Seen
from qpavoid.solvers.backends import solve_daqp

_HORIZONS = (0.2, 0.05, 0.5)
"""h of the flights that lean to no side [s]."""
_LEANINGS = 4
"""How many flights lean to one side, with the first of the horizons."""
_LEAN = 2.0
"""‖v̂‖ of those [rad/s, m/s]."""
_GENTLE = 1e-4
"""ε: what the square of a joint speed counts beside that of a distance [m²/(rad/s)²]."""
_DEEPEST = 10.0
"""Penetration that no flight foresees [m]."""
_TOUCH = 1e-3
"""Distance below which a pair counts as touching [m]."""
Mask = npt.NDArray[np.bool_]


class Manner(NamedTuple):
    """A way to flee."""

    horizon: float
    """h [s]; 0 stands still."""
    leaning: Array
    """v̂ (nv,) [rad/s, m/s]."""


class Value(NamedTuple):
    """How good a flight is, the larger the better."""

    clear: float
    """Time until something touches, up to the horizon of the foresight [s]."""
    distance: float
    """Smallest distance until then, up to what counts as safe [m]."""


class Flight(NamedTuple):
    """Velocities, and where they lead."""

    value: Value
    v: list[Array]
    """(nv,) for each tick."""
    manner: Manner


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
        self._parted = np.any(scene.support != 0.0, axis=1)
        self._safe = settings.safe * (avoidance.hold - avoidance.offset)
        self._manners = list(_manners(model.nv))
        self._next = 0
        self._foreseen: dict[float, Seen] = {}
        self._kept: Flight | None = None
        self._enough = Value(settings.horizon, self._safe)

    def reset(self) -> None:
        """Forgets the flight that was kept."""
        self._kept = None

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
        onward = self._best(pin.integrate(self._model, q, self._dt * v), v, t + self._dt, watched)
        if onward.value >= self._enough:
            self._kept = onward
            return None
        kept = self._kept
        if kept is None or not kept.v or kept.value.clear < 0.5 * self._settings.horizon:
            away = self._best(q, v_last.copy(), t, watched)
            if kept is None or not kept.v or away.value.clear > kept.value.clear + self._settings.period:
                kept = away
        if onward.value.clear + self._dt >= kept.value.clear and onward.value.distance >= kept.value.distance - 1e-4:
            self._kept = onward
            return None
        self._kept = Flight(Value(kept.value.clear - self._dt, kept.value.distance), kept.v[1:], kept.manner)
        return None if np.array_equal(kept.v[0], v) else kept.v[0]

    def _best(self, q: Array, v: Array, t: float, watched: Mask) -> Flight:
        """The best of some flights from q (nq,) after velocity v (nv,); others have their turn at the next ticks."""
        best: Flight | None = None
        for manner in self._in_turn():
            flight = self._fly(q, v, t, manner, watched)
            if best is None or flight.value > best.value:
                best = flight
            if flight.value >= self._enough:
                break
        assert best is not None
        return best

    def _in_turn(self) -> Iterator[Manner]:
        """The manner that is kept, standing still, and some of the others."""
        if self._kept is not None and self._kept.manner is not self._manners[0]:
            yield self._kept.manner
        yield self._manners[0]
        for _ in range(self._settings.attempts):
            self._next = self._next % (len(self._manners) - 1) + 1
            yield self._manners[self._next]

    def _fly(self, q: Array, v: Array, t: float, manner: Manner, watched: Mask) -> Flight:
        """Flees with decisions a period apart, until something touches or the horizon is reached."""
        plan: list[Array] = []
        distance, begin = self._safe, t
        while True:
            proximity, problem = self._look(q, t, v)
            here = float(np.min(proximity.distance, initial=np.inf, where=watched[proximity.pair]))
            if here < _TOUCH or t - begin >= self._settings.horizon:
                return Flight(Value(min(t - begin, self._settings.horizon), distance), plan, manner)
            distance = min(distance, here)
            wanted = self._flee(proximity, problem, manner, watched)
            for step, ticks in self._towards(v, wanted):
                q = pin.integrate(self._model, q, ticks * self._dt * step)
                plan += [step] * ticks
            v = plan[-1]
            t += self._ticks * self._dt

    def _towards(self, v: Array, wanted: Array) -> list[tuple[Array, int]]:
        """The velocities of a period, each with its number of ticks: as fast as accelerations allow to the wanted."""
        if not self._accelerated:
            return [(wanted, self._ticks)]
        ramp = []
        for _ in range(self._ticks):
            v = v + np.minimum(np.maximum(wanted - v, -self._step), self._step)
            ramp.append((v, 1))
        return ramp

    def _look(self, q: Array, t: float, v: Array) -> tuple[Proximity, Problem]:
        """Distances and bounds at q (nq,), reached with v (nv,), with the obstacles where they will be at t [s]."""
        if t not in self._foreseen:
            self._foreseen[t] = self._obstacles.foreseen(t)
        self.query.placing.place(*self._foreseen[t])
        self._assembly.remember(v)
        self._kinematics.compute(q)
        self.query.compute(self._kinematics.data, self._settings.reach)
        return self._assembly.compute(q, (), self.query, self._settings.reach)

    def _flee(self, proximity: Proximity, problem: Problem, manner: Manner, watched: Mask) -> Array:
        """Velocity (nv,) of a flight for its next period."""
        rest = np.minimum(np.maximum(0.0, problem.lower), problem.upper)
        near = watched[proximity.pair]
        h, J = manner.horizon, proximity.J[near]
        ahead = proximity.distance[near] + h * proximity.drift[near]
        if not h or (not manner.leaning.any() and (ahead + h * (J @ rest) >= self._settings.comfort).all()):
            return rest
        v = _farthest(h * J, ahead, self._settings.comfort, manner.leaning, problem.lower, problem.upper)
        return rest if v is None else np.minimum(np.maximum(v, problem.lower), problem.upper)


def _farthest(A: Array, d: Array, comfort: float, v: Array, lower: Array, upper: Array) -> Array | None:
    """v (nv,) with the largest s, A v + d >= s, s <= comfort, close to the one given; None where none is found."""
    k, n = A.shape
    P = np.diag(np.append(np.full(n, _GENTLE), 1.0))
    G = np.empty((k, n + 1))
    G[:, :n], G[:, n] = A, -1.0
    low, high = np.append(lower, -_DEEPEST), np.append(upper, comfort)
    x = np.append(v, comfort)
    if kernels.ACCELERATED:
        from qpavoid.kernels.compiled.active_set import minimize

        return x[:n] if minimize(P, x, G, -d, low, high, np.zeros(k)) else None
    answer = solve_daqp(P, -P @ x, G, -d, low, high)
    return None if answer is None else answer[:n]


def _manners(nv: int) -> Iterator[Manner]:
    """Standing still, fleeing with several horizons, and leaning to some sides that are the same every time."""
    straight = np.zeros(nv)
    yield Manner(0.0, straight)
    for horizon in _HORIZONS:
        yield Manner(horizon, straight)
    for side in range(_LEANINGS):
        direction = np.random.default_rng(side).normal(size=nv)
        yield Manner(_HORIZONS[0], _LEAN * direction / np.linalg.norm(direction))
