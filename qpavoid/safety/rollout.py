"""Flights: the robot drops its tasks and keeps away from everything, while obstacles go on as they are known to.

In every period a flight maximises the smallest distance at a horizon h, to first order:

    max s - ½ s²/c - ε/2c ‖v - v̂‖²  s.t.  d + h (J v + ḋ_obs) >= s,  s <= c,  lower <= v <= upper,    c: the comfort.

This is greedy, and runs into dead ends; which v̂ leads out of one cannot be told beforehand.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin

from qpavoid import kernels
from qpavoid.config import Avoidance, Backup, Limits
from qpavoid.control.distances import DistanceQuery
from qpavoid.control.estimates import prediction_error_bound
from qpavoid.control.obstacles import ObstacleStates, ObstacleTracker
from qpavoid.control.row_layout import hand_over, lay_out
from qpavoid.model.kinematics import ForwardKinematics, max_lever_arm, support_masks
from qpavoid.model.limits import JointBounds
from qpavoid.model.scene import Scene
from qpavoid.problem import Array, Mask
from qpavoid.safety.jerk import Ramps
from qpavoid.safety.policy import TOUCH, BackupPolicy, Flight, Near, Start, Tally, Value

_GENTLE = 1e-4
"""ε: what the square of a joint speed counts beside that of a distance [m²/(rad/s)²]."""
_DEEPEST = 10.0
"""Penetration that no flight foresees [m]."""
_ROUND_OFF = 1e-6
"""Difference of two times that counts as none [s]."""
_MANY = 300
"""Times of which it is remembered what was foreseen, before those that are over are forgotten."""
_BEYOND = 0.1
"""How much longer than the horizon flights are, so that they need not be flown anew in every tick [s]."""


class Flights:
    """Flies, on kinematics and distances of its own."""

    def __init__(
        self,
        scene: Scene,
        bounds: JointBounds,
        obstacles: ObstacleTracker,
        avoidance: Avoidance,
        limits: Limits,
        dt: float,
        settings: Backup,
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
        self._layout = lay_out(scene, (), (), free, self.kinematics, self.query, avoidance, limits, 0.01, self.period)
        self._packed, self._masks = kernels.pack(self._layout), support_masks(model)
        self._views: dict[int, Near] = {}
        self._none = np.zeros((0, model.nv))
        self._flat = all(joint.nv <= 1 for joint in list(model.joints)[1:])
        """Whether the velocities of some ticks lead as far as their sum: joints of one coordinate at most."""
        self.parted = self._which_part()
        """(m,) pairs that the robot can part."""
        self.ramps = Ramps(bounds, dt)
        """How it gets from one velocity to another."""
        self.lever_arm = max(1.0, max_lever_arm(model, self.query.max_extension()))
        """Farther than this no point of the robot moves when a joint moves by 1 [m/rad, 1]."""
        self.enough = Value(settings.horizon, settings.safe * (avoidance.hold - avoidance.offset))
        """What a flight is worth that need not be any better."""
        self.still = BackupPolicy(0.0, np.zeros(model.nv))
        """Standing still."""
        self._foreseen: dict[float, ObstacleStates] = {}
        self._compile(scene.robot.home)

    def _compile(self, q: Array) -> None:
        """So that no tick waits for the compiler."""
        still = self.still.leaning
        near = self._look(q, 0.0, still, Tally(Start(q, still, still, 0.0, self.parted), 1.0), 0.0)
        kernels.closes_below(*near, still, 1.0, 0.0)
        kernels.min_sphere_distance(np.zeros((1, 1, 3)), np.zeros((1, 3)), np.zeros((1, 1)))
        self.ramps.towards(still, still, self._flee(near, BackupPolicy(0.1, still))[None])
        self.drop_predictions()

    def go_on_to(self, t: float) -> None:
        """Forgets what was foreseen and is over at t [s]; all of it, where obstacles are told of."""
        if self._obstacles.estimates is not None:
            self._foreseen.clear()
        elif len(self._foreseen) > _MANY:
            self._foreseen = {at: seen for at, seen in self._foreseen.items() if at > t}

    def invalidate(self) -> None:
        """What the robot carries, or what may touch, has changed."""
        hand_over(self._layout, self._masks, self.query)
        self.parted = self._which_part()
        self.drop_predictions()

    def drop_predictions(self) -> None:
        """There is news of the obstacles: where they will be has to be foreseen anew."""
        self._foreseen.clear()

    def _which_part(self) -> Mask:
        return np.asarray(np.any(self._layout.support != 0.0, axis=1))

    def predicted(self, t: float) -> ObstacleStates:
        """The obstacles that move, as far as is known, at t [s]."""
        t = round(t, 9)  # the same time may be come to in several ways
        if t not in self._foreseen:
            self._foreseen[t] = self._obstacles.predicted(t)
        return self._foreseen[t]

    def a_tick_on(self, flight: Flight) -> Flight:
        """What is left of a flight after a tick."""
        (q, before, _, t, watched), v = flight.start, flight.v[0]
        begun = Start(pin.integrate(self._model, q, self._dt * v), v, v - before, t + self._dt, watched)
        return flight._replace(start=begun, v=flight.v[1:])

    def holds_from(self, flight: Flight, start: Start, fastest: float = 0.0) -> bool:
        """Whether a flight that is good enough is so from a start close to its own, without another look.

        The same velocities lead past the same places, but for how far the start is off, and what is lost until they are
        reached. No point of the robot is farther off than the longest lever times the sum of that over the joints; and
        no point of an obstacle than what is told of it now differs from what was, and than it moves in the time by
        which the start is early or late.

        Args:
            flight: whether it holds.
            start: from where.
            fastest: largest speed of any point of an obstacle [m/s].
        """
        if flight.until < start.t + self.settings.horizon - 1e-9:
            return False
        late = abs(start.t - flight.start.t)
        if late > self._dt or not np.array_equal(flight.start.watched, start.watched):
            return False
        off = pin.difference(self._model, flight.start.q, start.q)
        most = float(np.abs(off).sum())
        if self.ramps.accelerated:
            steps = self.ramps.towards(start.v, start.w, flight.v, meets=True)
            off = off + self._dt * np.cumsum(steps - flight.v[: len(steps)], axis=0)
            most = max(most, float(np.abs(off).sum(axis=1).max(initial=0.0)))
        span = self.settings.horizon + _BEYOND
        off_too = (late * fastest if late > _ROUND_OFF else 0.0) + prediction_error_bound(
            self._obstacles.estimates, flight.told, span, self.query.placing.reach
        )
        return bool(flight.least - self.lever_arm * most - off_too >= self.enough.distance)

    def fly(self, start: Start, manner: BackupPolicy, given: Array | None = None) -> Flight:
        """`better` than nothing."""
        flight = self.better(None, start, manner, given)
        assert flight is not None
        return flight

    def better(
        self, than: Flight | None, start: Start, manner: BackupPolicy, given: Array | None = None
    ) -> Flight | None:
        """Flees with decisions a period apart until the horizon; what has touched is left out of account from then on.

        Distances are looked at as often, and midway where something may come too near and part again before that. All
        flights decide and look at the same times, multiples of the period, so that their values can be compared; and
        where what is given ends.

        Args:
            than: flight that has to be outdone; one that turns out not to is not flown to its end.
            start: where it begins.
            manner: how it flees.
            given: velocities (k, nv) of the first ticks; it flees from then on.

        Returns:
            The flight; None where it is no better than the other one.
        """
        q, v, w, t, _ = start
        horizon, safe = self.enough
        end, plan, tally = t + horizon + _BEYOND, list[Array](), Tally(start, horizon)
        near = self._look(q, t, v, tally, 0.0)
        left = self._none if given is None else given
        for _ in range(int((horizon + _BEYOND) / self._dt) + 2):
            if t >= end - 1e-9:
                break
            count = self._ticks - round(t / self._dt) % self._ticks
            wanted, left = left[:count], left[count:]
            held = not len(wanted)
            if held:
                wanted = self._flee(near, manner)[None].repeat(count, axis=0)
            count = len(wanted)
            steps = self.ramps.towards(v, w, wanted, held)
            ahead, span = self._moved(q, steps), count * self._dt
            if kernels.closes_below(*near, steps[count // 2], span, safe):
                span *= 0.5
                t += span
                self._look(pin.interpolate(self._model, q, ahead, 0.5), t, v, tally, span)
            t += span
            near = self._look(ahead, t, steps[-1], tally, span)
            value = Value(horizon - tally.lost, min(tally.least, safe))
            if than is not None and value <= than.value:
                return None
            plan.append(steps)
            w = steps[-1] - (steps[-2] if count > 1 else v)
            q, v = ahead, steps[-1]
        return Flight(
            start, np.concatenate(plan), manner, value, min(tally.until, t), tally.least, self._obstacles.estimates
        )

    def decision_before(self, start: Start, k: int) -> int:
        """The last tick at which a flight that begins there decides before its k-th one; 0 where it has not yet."""
        return max(k - (round(start.t / self._dt) + k) % self._ticks, 0)

    def _moved(self, q: Array, steps: Array) -> Array:
        """Where the velocities (k, nv) of some ticks lead from q (nq,)."""
        if self._flat:
            return np.asarray(pin.integrate(self._model, q, self._dt * np.add.reduce(steps)))
        for step in steps:
            q = pin.integrate(self._model, q, self._dt * step)
        return q

    def _look(self, q: Array, t: float, v: Array, tally: Tally, span: float) -> Near:
        """What is near at q (nq,), reached with v (nv,), with the obstacles where they will be at t, `span` after the
        last look [s].
        """
        query, reach = self.query, self.settings.reach
        query.placing.place(*self.predicted(t))
        self.kinematics.compute(q)
        query.compute(self.kinematics.data, reach)
        self._layout.v_prev[:] = v
        k, touching, nearest, rest = kernels.backup_rows(
            self._packed, q, query.pairs, reach, query.placing.moving, tally.watched, TOUCH
        )
        tally.count((touching, nearest, rest), t, span)
        return self._views.get(k) or self._view(k)

    def _view(self, k: int) -> Near:
        x = self._layout
        self._views[k] = Near(x.closest[:k], x.J[:k], x.feedforward[:k])
        return self._views[k]

    def _flee(self, near: Near, manner: BackupPolicy) -> Array:
        """Velocity (nv,) of a flight for its next period."""
        lower, upper, v = self._layout.lower, self._layout.upper, None
        if manner.horizon:
            v = _farthest(near, manner, self.settings.comfort, lower, upper)
        return np.minimum(np.maximum(0.0 if v is None else v, lower), upper)


def _farthest(near: Near, manner: BackupPolicy, comfort: float, lower: Array, upper: Array) -> Array | None:
    """v (nv,) with the largest s, see above, within its bounds (nv,); None where none is found."""
    (closest, J, feedforward), (h, leaning) = near, manner
    v, met = kernels.farthest(h, closest, J, feedforward, comfort, _DEEPEST, _GENTLE, leaning, lower, upper)
    return v if met else None
