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


_FAST = 1e6
"""Change of velocity in a control period of a joint without a limit on it [rad/s or m/s]."""


class ActionFilter:
    """The safety filter of a controller, for a program that sends positions; robots of hinges and slides alone.

    What is sent adds up from where the robot was at first: servos that lag are not made to return to where they are.
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
        self.controller, self._clone = controller, controller.clone()
        self._speed, self._step = bounds.velocity, np.minimum(bounds.acceleration * controller.dt, _FAST)
        none = np.zeros(model.nv)
        self._velocity_towards = kernels.direct(
            kernels.velocity_towards, none, none, none, self._speed, self._step, controller.dt, none.copy()
        )
        self._setpoint: Array | None = None
        self._last: Array | None = None
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
        action = np.array(action, dtype=np.float64)
        start = np.array(q, dtype=np.float64) if self._setpoint is None else self._setpoint
        v_desired = self._towards(start, action, action if self._last is None else self._last, self._v)
        self.solution = self.controller.filter(q, v_desired, t, obstacles)
        self._v, self._last = self.solution.v, action
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
        v, last = self._v, out[0] if self._last is None else self._last
        self._clone.reset(v)
        for k, action in enumerate(out.copy()):
            now = {name: _later(value, k * dt) for name, value in (obstacles or {}).items()}
            v = self._clone.filter(x, self._towards(x, action, last, v), k * dt, now).v
            x, last = x + dt * v, action
            out[k] = x
            if changed is None and np.abs(x - action).max() > self.tolerance:
                changed = k
        return Chunk(out, changed)

    def reset(self) -> None:
        """Begin where the robot is, as before an episode."""
        self._setpoint, self._last, self._v = None, None, np.zeros_like(self._v)
        self.controller.reset()

    def _towards(self, start: Array, action: Array, last: Array, v_last: Array) -> Array:
        """Return the velocity (nv,) straight to an action, within what can be stopped there, or goes on like actions.

        Args:
            start: positions (nq,) that were sent last.
            action: positions (nq,).
            last: the action before (nq,).
            v_last: velocity (nv,) that led to `start`.
        """
        v: Array = np.empty_like(self._v)
        self._velocity_towards(action - start, action - last, v_last, self._speed, self._step, self.controller.dt, v)
        return v


def _later(value: Any, duration: float) -> Any:
    """Return where an obstacle is some time later [s]: moved on at its velocity where that is known."""
    if not isinstance(value, Sample):
        return value
    return Sample(value.position + duration * value.linear, value.rotation, value.linear, value.angular)
