"""Safe joint positions in place of those that a policy asks for: one a control period, or a chunk of them ahead."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from qpavoid import kernels
from qpavoid.controller import Controller
from qpavoid.errors import ConfigError
from qpavoid.model.sample import Sample
from qpavoid.problem import Array, Solution


class Chunk(NamedTuple):
    """Actions of a policy, as they can be followed safely."""

    actions: Array
    """(T, nq) positions to send, one a control period [rad or m]."""
    changed: int | None
    """Number of the first one that had to be changed; None where none was."""


class ActionFilter:
    """The safety filter of a controller, for a program that sends positions; robots of hinges and slides alone.

    What is sent adds up from where the robot was at first: servos that lag are not sent back to where they are.
    """

    tolerance = 1e-6
    """Change of an action that counts as none [rad or m]."""

    def __init__(self, controller: Controller) -> None:
        """Filter with a controller, whose dt is the time between two actions.

        Raises:
            ConfigError: a joint that is neither a hinge nor a slide with limits.
        """
        model, bounds = controller.scene.robot.model, controller.scene.robot.bounds()
        if model.nq != model.nv:
            raise ConfigError(f"{controller.scene.robot.name}: a joint has no limits, or several coordinates; lock it")
        self.controller, self._ahead = controller, controller.clone()
        self._speed, self._acceleration = bounds.velocity, bounds.acceleration
        self._setpoint: Array | None = None
        self._v = np.zeros(model.nv)
        self.solution: Solution | None = None
        """What the last action led to, and why."""

    def __call__(
        self, q: Array, action: Array, t: float | None = None, obstacles: Mapping[str, Any] | None = None
    ) -> Array:
        """Return the positions to send (nq,): the action, or as far towards it as one period leads safely.

        Args:
            q: configuration (nq,) as measured.
            action: positions (nq,) that the policy asks for.
            t: time [s]; see `Controller.step`.
            obstacles: where obstacles are now; see `Controller.step`.
        """
        start = np.array(q, dtype=np.float64) if self._setpoint is None else self._setpoint
        self.solution = self.controller.filter(q, self._towards(start, action, self._v), t, obstacles)
        self._v = self.solution.v
        setpoint: Array = start + self.controller.dt * self._v
        self._setpoint = setpoint
        return np.array(setpoint)

    def chunk(self, q: Array, actions: Array, obstacles: Mapping[str, Any] | None = None) -> Chunk:
        """Return a chunk of actions as it can be followed from now on; nothing is sent or remembered.

        Obstacles go on as they move now. When the actions are carried out, filter each of them with what is seen then.

        Args:
            q: configuration (nq,) as measured.
            actions: positions (T, nq), one a control period.
            obstacles: where obstacles are now; see `Controller.step`.
        """
        dt, out, changed = self.controller.dt, np.array(actions, dtype=np.float64), None
        x = np.array(q, dtype=np.float64) if self._setpoint is None else self._setpoint
        v = self._v
        self._ahead.reset(v)
        for k, action in enumerate(np.asarray(actions, dtype=np.float64)):
            now = {name: _later(value, k * dt) for name, value in (obstacles or {}).items()}
            v = self._ahead.filter(x, self._towards(x, action, v), k * dt, now).v
            x = x + dt * v
            out[k] = x
            if changed is None and np.abs(x - action).max() > self.tolerance:
                changed = k
        return Chunk(out, changed)

    def reset(self) -> None:
        """Begin where the robot is, as before an episode."""
        self._setpoint, self._v = None, np.zeros_like(self._v)
        self.controller.reset()

    def _towards(self, start: Array, action: Array, v_last: Array) -> Array:
        """Return the velocity (nv,) straight to an action, within speeds and accelerations, and able to stop there."""
        dt, missing = self.controller.dt, np.asarray(action, dtype=np.float64) - start
        step, distance = self._acceleration * dt, np.abs(missing)
        with np.errstate(invalid="ignore"):  # of joints without a limit
            stopping = kernels.speed_to_stop(distance, step, dt)
        fastest = np.minimum(self._speed, np.maximum(np.sign(missing) * v_last, 0.0) + step)
        fastest = np.fmin(fastest, np.where(np.isfinite(step), stopping, np.inf))
        speed = distance / dt
        excess = np.max(speed[speed > 0.0] / fastest[speed > 0.0], initial=1.0)
        return np.asarray(missing / dt / excess)


def _later(value: Any, duration: float) -> Any:
    """Return where an obstacle is some time later [s]: moved on at its velocity where that is known."""
    if not isinstance(value, Sample):
        return value
    return Sample(value.position + duration * value.linear, value.rotation, value.linear, value.angular)
